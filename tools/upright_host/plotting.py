"""What the pictures of score, compare and tune share. matplotlib is an optional extra."""

import numpy as np

from upright_host import console, scoring
from upright_host.console import Unavailable, Wrong

INSTALL = ".venv/bin/pip install -c tools/constraints.txt -e '.[plot]'"


def figure(width: float, height: float):
    """An empty figure of so many inches. Raises Unavailable where matplotlib is not installed."""
    try:
        import matplotlib.figure
    except ImportError as why:
        raise Unavailable(f"no picture: matplotlib is not installed: {INSTALL}") from why
    return matplotlib.figure.Figure(figsize=(width, height), dpi=110)


def colours(n: int) -> list:
    """n colours that can be told apart, as far as there are so many."""
    from matplotlib import colormaps

    of = colormaps["tab20" if n > 10 else "tab10"].colors
    return [of[i % len(of)] for i in range(n)]


def tidy(panel, axis: str = "both") -> None:
    """A faint grid behind the lines, and no frame where there is no scale."""
    panel.grid(axis=axis, alpha=0.3)
    panel.set_axisbelow(True)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)


def save(figure, path) -> None:
    """Raises Wrong where the file cannot be written, and for an ending that no kind of picture has."""
    try:
        with console.writing(path):
            figure.savefig(path)
    except Wrong:
        raise
    except ValueError as why:
        raise Wrong(f"no picture: {path}: {why}") from why


# ------------------------------------------------------------------------------------------ attitudes
ANGLES = ("roll", "pitch", "yaw")
SMOOTHED_S = 1.0  # errors are drawn as the root mean square over so long
_POINTS = 3000  # a line; the picture is not wider
_LEAST_DEG = 0.02  # the errors' scale begins here


def euler(q) -> np.ndarray:
    """Roll, pitch, yaw in deg, order zyx, of the attitudes (n, 4): (n, 3)."""
    w, x, y, z = np.asarray(q, float).T
    return np.degrees(
        np.stack(
            [
                np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
                np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
                np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
            ],
            1,
        )
    )


def wrap(angle):
    """Into -180..180 deg."""
    return (angle + 180) % 360 - 180


def attitudes(trial, rows, path) -> None:
    """Draw a trial's truth and its filters' roll, pitch, yaw, and their errors below.

    rows: score.Row with their attitudes. A heading that is scored after the best constant offset is drawn after it.
    Raises what figure() and save() raise.
    """
    num, den = trial.rate
    t = times = np.arange(max(len(row.q) for row in rows)) * den / num
    known = np.ones(len(t), bool)
    truth = trial.has_truth and trial.t_gt[np.isfinite(trial.q_gt[:, 0])][0] <= times[-1]
    if truth:
        t = trial.t_gt[trial.t_gt <= times[-1]]
        known = np.isfinite(trial.q_gt[: len(t), 0])
    of = figure(14, 13 if truth else 8.5)
    panels = of.subplots(5 if truth else 3, 1, sharex=True)
    turned = [
        scoring._at(t, times[: len(row.q)], row.q / np.linalg.norm(row.q, axis=1)[:, None])
        for row in rows
    ]
    for i, row in enumerate(rows):
        if row.measure == "best heading" and np.isfinite(row.score.offset):
            half = np.radians(row.score.offset) / 2
            turned[i] = scoring._multiply(
                np.array([[np.cos(half), 0, 0, -np.sin(half)]]), turned[i]
            )
    step = max(1, len(t) // _POINTS)
    looks = _looks(rows)

    if truth:
        reference = np.where(known[:, None], euler(trial.q_true()[: len(t)]), np.nan)
    for k, (panel, name) in enumerate(zip(panels, ANGLES, strict=False)):
        if truth:
            shown = _broken(reference[::step, k])
            panel.plot(t[::step], shown, color="0.72", linewidth=4, label="truth")
        for q, look in zip(turned, looks, strict=True):
            angle = euler(q)[::step, k]
            panel.plot(t[::step], _broken(angle), linewidth=0.9, **look)
        panel.set_ylabel(f"{name}, deg")
    if truth:
        _errors(trial, rows, turned, t, known, panels[3:], step, looks)
    for panel in panels:
        tidy(panel)
    panels[-1].set_xlabel("s")
    panels[-1].set_xlim(t[0], t[-1])
    of.align_ylabels(panels)
    below = _head(of, trial.name, rows, looks, truth)
    of.tight_layout(rect=(0, 0, 1, below), h_pad=0.6)
    save(of, path)


def _errors(trial, rows, turned, t, known, panels, step, looks):
    """Inclination and heading error, each the root mean square over the last second."""
    truth = np.where(known[:, None], trial.q_true()[: len(t)], [1.0, 0, 0, 0])
    span = max(1, round(SMOOTHED_S * trial.rate[0] / (trial.rate[1] * trial.gt_every)))
    limits = [[], []]  # of each panel: the least and the most of each line
    for q, look in zip(turned, looks, strict=True):
        error = scoring._multiply(q, truth * [1, -1, -1, -1])
        inclination = 2 * np.arccos(np.clip(np.hypot(error[:, 0], error[:, 3]), 0, 1))
        heading = 2 * np.arctan2(error[:, 3], error[:, 0])
        for panel, angle, ends in zip(panels, (inclination, heading), limits, strict=True):
            square = np.where(known, wrap(np.degrees(angle)) ** 2, 0)
            sums = [np.convolve(v, np.ones(span))[: len(t)] for v in (square, known.astype(float))]
            with np.errstate(invalid="ignore", divide="ignore"):
                line = np.sqrt(sums[0] / np.round(sums[1]))
            line = np.maximum(line, _LEAST_DEG / 10)  # a logarithm's scale knows no 0
            panel.plot(t[::step], line[::step], linewidth=1.1, **look)
            ends += np.nanquantile(line, [0.01, 1]).tolist()
    for panel, name, ends in zip(panels, ("inclination", "heading"), limits, strict=True):
        panel.set_yscale("log")
        panel.set_ylim(max(_LEAST_DEG, min(ends) / 1.5), 1.3 * max(*ends, 1))
        panel.yaxis.set_major_formatter(lambda v, _: f"{v:g}")
        panel.set_ylabel(f"{name} error,\ndeg, RMS over {SMOOTHED_S:g} s")
        # what is not scored
        scored = trial.movement[: len(t)] & known
        panel.fill_between(
            t, 0, 1, ~scored, color="0.93", linewidth=0, transform=panel.get_xaxis_transform()
        )


def _broken(line):
    """With a gap where an angle jumps."""
    line = np.array(line, float)
    line[1:][np.abs(np.diff(line)) > 120] = np.nan
    return line


def _looks(rows) -> list[dict]:
    """A colour for the filters that differ in their axes alone; six axes are dashed beside nine."""
    kinds = [row.filter.replace(str(row.axes), "") for row in rows]
    names = list(dict.fromkeys(kinds))
    tints = colours(len(names))
    return [
        {
            "color": tints[names.index(kind)],
            "linestyle": (0, (4, 1.5)) if row.axes == 6 and kinds.count(kind) > 1 else "-",
        }
        for row, kind in zip(rows, kinds, strict=True)
    ]


def _head(of, name, rows, looks, truth) -> float:
    """Title and legend -> where they end, as a part of the height."""
    from matplotlib.lines import Line2D

    entries = [Line2D([], [], color="0.72", linewidth=4, label="truth")] if truth else []
    for row, look in zip(rows, looks, strict=True):
        s = row.score
        figures = f": {s.inclination:.2f}, {row.heading:.2f}" if s.samples else ""
        entries.append(Line2D([], [], linewidth=2, label=row.filter + figures, **look))
    inch = 1 / of.get_figheight()
    of.text(0.008, 1 - 0.1 * inch, name, va="top", fontsize=12, fontweight="bold")
    if any(row.score.samples for row in rows):
        says = "RMSE in deg: inclination, heading (of six axes: after the best constant)"
        of.text(0.99, 1 - 0.1 * inch, says, ha="right", va="top", fontsize=9)
    lines = -(-len(entries) // 5)
    of.legend(
        handles=entries,
        loc="upper left",
        bbox_to_anchor=(0, 1 - 0.28 * inch),
        ncols=-(-len(entries) // lines),
        frameon=False,
        fontsize=9,
    )
    return 1 - (0.3 + 0.18 * lines) * inch
