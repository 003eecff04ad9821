"""Trials of synthetic motions, in the form in which recorded ones are kept."""

import json
import math

import motions
import numpy as np
from upright_host import scoring, trials

EVERY = 4


def as_trial(motion):
    """A rendered motion as a recorded trial without a truth."""
    return trials.Trial(
        name=motion.name,
        counts=motion.counts,
        rate=motion.rate,
        accel_lsb_per_g=motion.accel_lsb_per_g,
        gyro_scale=motion.gyro_scale,
        mag_uT_per_lsb=None,
        gt_every=None,
        q_gt=None,
        movement=None,
        header={},
    )


def save(path, motion="hand", rate=100, seconds=4.0, without=(), unknown_s=0, **header):
    """A trial of a synthetic motion, as recorded ones are kept; its truth counts from 1 s on."""
    made = motions.render(motion, rate=(rate, 1), seconds=seconds)
    east_north = scoring._multiply(np.array([[1, 0, 0, 1]]) * math.sqrt(0.5), made.q_true)
    q_gt = east_north[::EVERY]
    q_gt[: -(-unknown_s * rate // EVERY)] = math.nan
    num, den = made.gyro_scale
    header = {
        "name": path.stem,
        "rate_hz": rate,
        "gt_every": EVERY,
        "gyr_dps_per_lsb": den / num,
        "acc_mps2_per_lsb": trials.STANDARD_GRAVITY / made.accel_lsb_per_g,
        "mag_uT_per_lsb": motions.MAG_UT_PER_LSB,
    } | header
    arrays = {
        "acc": made.counts[:, 0:3],
        "gyr": made.counts[:, 3:6],
        "mag": made.counts[:, 6:9],
        "q_gt": q_gt.astype("f4"),
        "movement": np.packbits(np.arange(len(q_gt)) * EVERY >= rate),
        "header": np.frombuffer(json.dumps(header).encode(), np.uint8),
    }
    np.savez(path, **{name: array for name, array in arrays.items() if name not in without})
    return path
