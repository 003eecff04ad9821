"""How the inertial filter's float twin judges the magnetic field: inertial_float.py says what it is about.

Plain Python without numpy; runs on CPython.
"""

import math

from reference.earth_float import EarthFloat, wrap

# decisions, as lib/upright/inertial.py has them in its state
NEAR_REFERENCE = 2  # field near the reference
NEAR_CANDIDATE = 4  # field and heading near the candidate for a new reference
TURNING = 8  # turning quickly enough to learn a field
CONSISTENT = 16  # heading error no larger than what the gyro explains
NEAR_OLD = 64  # field near the reference before, and nearer than to this one
SAME = 4096  # field still that of the reference
FORGET = 8192  # so little is known of the heading that any field will do

FIELD_SMOOTH = 0.05  # s
SAME_TOLERANCE = 0.08
FOR_MOST, NEED, BACK_AFTER, STEADY_MOST = 60.0, 5.0, 3.0, 1.0  # s
STILL_TAU, STILL_E = 5.0, 0.1  # s, rad
CANDIDATE_E = 0.35  # rad
FORGOTTEN = 0.3  # rad**2
GATE_DOUBT = 1.125
SURE, ANY = (
    0.3,
    1.5,
)  # rad: so much doubt, and a rest says nothing of the heading; any heading is as likely


class FieldFloat(EarthFloat):
    """What InertialFloat knows of the field: times are counted in pairs of blocks."""

    def _compass(self):
        """The heading error, and the pair (horizontal, vertical) field."""
        self.since = min(16, self.since + 1)
        self.j = 0
        if not self.mag_n:
            return
        n, w, up = (v / self.mag_n for v in self.mag_sum)
        self.mag_sum, self.mag_n = [0.0] * 3, 0
        self.j, self.since = self.since, 0
        self.e = math.atan2(-w, n)
        self.now = math.hypot(n, w), up

    def _smooth_field(self):
        """The field smoothed, and what it is like."""
        p, e, doubt = self.p, self.e, self.doubt
        if self.field is None:
            self.field, self.candidate, self.candidate_e = list(self.now), list(self.now), e
        f, r = self.field, self.reference
        t = self.j * self.T2
        for i in range(2):
            f[i] += t / (FIELD_SMOOTH + t) * (self.now[i] - f[i])

        def away(r):
            return math.hypot(f[0] - r[0], f[1] - r[1]) / math.hypot(*r) if r else math.inf

        def distance(r):
            return math.hypot(f[0] - r[0], f[1] - r[1])

        near = r is not None and away(r) < p["field_tolerance"]
        self.decide(NEAR_REFERENCE, near)
        old = self.old is not None and away(self.old) < p["field_tolerance"]
        self.decide(NEAR_OLD, old and not (near and distance(self.old) >= distance(r)))
        self.decide(SAME, r is not None and away(r) < SAME_TOLERANCE)
        self.decide(TURNING, self.rate >= math.radians(p["field_dps"]) ** 2)
        consistent = abs(e) < p["field_gate"] + GATE_DOUBT * doubt or doubt > ANY
        if r is not None and self.still_set and self.rest and doubt < SURE:
            consistent = consistent and abs(wrap(e - self.still_e)) <= STILL_E
        self.decide(CONSISTENT, consistent)
        candidate = away(self.candidate) < p["field_tolerance"]
        if r is not None and not self.good:
            candidate = candidate and abs(wrap(e - self.candidate_e)) < CANDIDATE_E + doubt
        self.decide(NEAR_CANDIDATE, candidate)
        self.decide(FORGET, self.P[0][0] > FORGOTTEN)

    def _judge_field(self):
        """Whether the heading of this field is believed; whether another field takes the reference's place."""
        p, j, e, f, has = self.p, self.j, self.e, self.field, self.decided
        after = max(1, self.pairs(p["field_after"]))
        good = False
        near = 0
        if has & NEAR_REFERENCE and has & CONSISTENT:
            near = min(after, self.near + j)
            good = near == after
            if good and has & TURNING:
                self.seen = min(self.pairs(FOR_MOST), self.seen + j)
        if good or not has & NEAR_CANDIDATE:
            self.candidate_for = 0
        elif self.reference is None or has & (TURNING | FORGET):
            self.candidate_for += j
        k = min(1 / 16, j * self.T2 / (p["field_tau"] + j * self.T2))
        for i in range(2):
            if good:
                self.reference[i] += k * (f[i] - self.reference[i])
            if has & NEAR_CANDIDATE:
                self.candidate[i] += k * (f[i] - self.candidate[i])
            else:
                self.candidate[i] = f[i]
        if not has & NEAR_CANDIDATE or good or self.reference is None:
            self.candidate_e = e
        else:
            self.candidate_e = wrap(self.candidate_e + k * wrap(e - self.candidate_e))
        restart = self._own_error()
        if good:
            self.back = 0
        if restart:
            near, good, self.candidate_for = after, True, 0
        elif not good and near == 0:
            taken = self._another_reference()
            if taken:
                near, good, self.candidate_for = after, True, 0
                restart = taken == "restart"
        self.near, self.good = near, good
        if restart:
            # the heading may be off by e, and the bias is what made it so
            self.open_heading(e * e)
            self.open_bias()
        self.weight = int(good or self.reference is None)
        if self.weight:
            if self.still_set and self.rest and self.doubt < SURE:
                k = self.T2 / (STILL_TAU + self.T2)
                self.still_e += k * wrap(e - self.still_e)
            else:
                self.still_set, self.still_e = True, e

    def _own_error(self):
        """The field is what it was, and its heading is another, for restart_after: the attitude is wrong."""
        has, j, most = self.decided, self.j, max(1, self.pairs(STEADY_MOST))
        # a turn that was not measured mixes two headings, for a moment
        self.steady = min(most, self.steady + j) if has & SAME else max(0, self.steady - 2 * j)
        if self.reference is None or has & CONSISTENT:
            self.lost = max(0, self.lost - 2 * j)
            self.own = self.steady == most
        elif self.own and self.steady:
            self.lost += 2 * j if has & TURNING else j
            if self.lost > self.pairs(2 * self.p["restart_after"]):
                self.lost = 0
                return True
        else:
            self.lost, self.own = 0, False
        return False

    def _another_reference(self):
        """The candidate becomes the reference -> True, "restart" where the heading is another's; False: it does not."""
        p, has = self.p, self.decided
        r = self.reference
        need, n, returns = self.pairs(p["field_first"]), self.candidate_for, False
        if r is not None:
            if not has & FORGET:
                need = 2 * self.seen + self.pairs(NEED)
                if has & CONSISTENT:
                    need = min(need, self.pairs(p["field_new"]))
            if has & NEAR_OLD:
                self.back += self.j
                need = min(need, self.pairs(BACK_AFTER))
                returns = self.back >= n
                n = max(n, self.back)
            else:
                self.back = 0
        if n < need:
            return False
        restart = r is not None and (not has & CONSISTENT or returns)
        n = min(n, self.pairs(FOR_MOST))
        if returns:
            n = max(n, self.old_seen)
        if r is not None and not has & SAME and (restart or not has & NEAR_REFERENCE):
            self.old, self.old_seen, self.back = r, self.seen, 0
        self.reference, self.seen = list(self.candidate), n
        return "restart" if restart else True
