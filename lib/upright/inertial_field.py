# Integer kernels of the inertial filter (inertial.py): which magnetic field is believed. Needs inertial_kalman.py and
# the viper emitter. As inertial_tilt.py, it is made for a hard interrupt.

import micropython
from micropython import const

from upright.inertial_kalman import open_bias, open_heading

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)  # always -1, see fixmath.py
_DECIDED = const(65)  # yes/no decisions, for the tests' float twin
_J = const(74)  # blocks that the heading of this block stands for; 0: none
_HEADING = const(75)  # Q28: heading error, rad
_NOW = const(76)  # 2, Q13: horizontal and vertical field, counts
_STILL = const(99)  # blocks without motion, no more than REST_AFTER
_REST_AFTER = const(100)  # blocks
_RATE = const(127)  # squared turn rate of the block, (4 counts)**2
_P = const(192)  # 16, Q30: covariance of heading (2.5 rad) and bias (bias_start * 2**0.5), 4 x 4
_HAVE = const(242)  # 1: field and candidate are set; 2: reference, too; 4: the one before, too
_F = const(243)  # 2, Q13: smoothed field, counts, horizontal and vertical
_FR = const(245)  # 2, Q13: reference; F, FR, FO and FC stand together
_FO = const(247)  # 2, Q13: the reference before this one
_FC = const(249)  # 2, Q13: candidate
_NEAR = const(251)  # blocks near the reference, no more than FIELD_AFTER
_FOR = const(252)  # blocks for which the reference was seen while turning
_FOR_MOST = const(253)  # most of it
_FO_FOR = const(254)  # the same of the reference before
_CAND = const(255)  # the same of the candidate
_BACK = const(256)  # blocks near the reference before
_BACK_AFTER = const(257)  # blocks
_CAND_E = const(258)  # Q28: heading error in the candidate's field, rad
_STILL_E = const(259)  # Q28: slow mean of the heading error at rest, rad
_STILL_SET = const(260)  # 1: it is set
_STILL_K = const(261)  # Q15: its gain
_STEADY = const(262)  # blocks with the field near to the reference, no more than STEADY_MOST
_STEADY_MOST = const(263)  # blocks
_OWN = const(264)  # 1: the heading error is the attitude's own, not another field's
_LOST = const(265)  # half blocks of such an error
_RESTART_AFTER = const(266)  # half blocks
_WEIGHT = const(267)  # 1: the heading is taken up
_TOL = const(268)  # Q15: tolerance squared
_SAME = const(269)  # Q15: the same for a field that has not changed
_SMOOTH = const(270)  # Q10: blocks of 0.05 s
_REF = const(271)  # Q10: blocks of the reference's time constant
_FIELD_AFTER = const(272)  # blocks
_FIELD_FIRST = const(273)  # blocks
_FIELD_NEW = const(274)  # blocks
_NEED = const(275)  # blocks of 5 s
_TURNING_MIN = const(276)  # squared turn rate, (4 counts)**2
_GATE = const(277)  # Q28: heading error that is believed, beside the doubt, rad
_GOOD = const(278)  # 1: the field is the reference's, and its heading is believed
_DOUBT = const(279)  # Q28: heading uncertainty, rad
# -- end of the words

# decisions
_NEAR_REFERENCE = const(2)
_NEAR_CANDIDATE = const(4)
_TURNING = const(8)
_CONSISTENT = const(16)
_NEAR_OLD = const(64)
_SAME_BIT = const(4096)
_FORGET = const(8192)

_PI28 = const(843314857)  # pi, Q28
_FORGOTTEN = const(51539608)  # 0.3 rad**2 in units of (2.5 rad)**2, Q30
_TENTH = const(26843546)  # 0.1 rad, Q28
_SURE = const(80530637)  # 0.3 rad, Q28
_ANY = const(402653184)  # 1.5 rad, Q28: any heading is as likely
_CAND_TOL = const(93952410)  # 0.35 rad, Q28


@micropython.viper
def smooth_field(s: ptr32):
    """F, the field smoothed; and what it is like: the reference, the one before, the candidate; is the body turning?"""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    j = s[_J]
    have = s[_HAVE]
    e = s[_HEADING] << k >> k
    # F += k (NOW - F), k = j T / (0.05 s + j T)
    gain = (j << 24) // ((j << 10) + s[_SMOOTH])  # Q14
    i = 0
    while i < 2:
        x = s[_NOW + i] << k >> k
        if have == 0:
            s[_F + i] = x
            s[_FC + i] = x
            s[_CAND_E] = e
        y = s[_F + i] << k >> k
        x -= y
        n = x >> 14
        s[_F + i] = y + n * gain + ((x - (n << 14)) * gain >> 14)
        i += 1
    s[_HAVE] = have | 1
    # all fields shifted alike, so that their parts are below 2**14
    n = 0
    i = 0
    while i < 8:
        x = s[_F + i] << k >> k
        if x < 0:
            x = 0 - x
        n |= x
        i += 1
    shift = 0
    while n > 16383:
        n >>= 1
        shift += 1
    x = (s[_F] << k >> k) >> shift
    y = (s[_F + 1] << k >> k) >> shift
    bits = 0
    nearest = 0
    # near: |F - r| < field_tolerance |r|
    i = 2
    while i < 8:
        n = (s[_F + i] << k >> k) >> shift
        m = (s[_F + i + 1] << k >> k) >> shift
        size = n * n + m * m >> 15
        n -= x
        m -= y
        away = n * n + m * m
        if away < size * s[_TOL]:
            if i == 2:
                bits |= _NEAR_REFERENCE
            elif i == 4:
                if bits & _NEAR_REFERENCE == 0 or away < nearest:
                    bits |= _NEAR_OLD
            else:
                bits |= _NEAR_CANDIDATE
        if i == 2:
            nearest = away
            if away < size * s[_SAME]:
                bits |= _SAME_BIT
        i += 2
    if have & 2 == 0:
        bits &= _NEAR_CANDIDATE
    elif have & 4 == 0:
        bits &= _NEAR_CANDIDATE | _NEAR_REFERENCE | _SAME_BIT
    if s[_RATE] >= s[_TURNING_MIN]:
        bits |= _TURNING
    # consistent: |e| < gate + 1.12 doubt; at rest it is where it was to 0.1 rad
    x = e
    if x < 0:
        x = 0 - x
    doubt = s[_DOUBT]
    if x - s[_GATE] < doubt + (doubt >> 3) or doubt > _ANY:
        bits |= _CONSISTENT
        if have & 2 and s[_STILL_SET] and s[_STILL] == s[_REST_AFTER] and doubt < _SURE:
            x = e - (s[_STILL_E] << k >> k)
            if x < 0:
                x = 0 - x
            if x > _PI28:
                x = _PI28 - (x - _PI28)
            if x > _TENTH:
                bits ^= _CONSISTENT
    # a candidate has its own heading, as nearly as the doubt allows
    if have & 2 and s[_GOOD] == 0:
        x = e - (s[_CAND_E] << k >> k)
        if x < 0:
            x = 0 - x
        if x > _PI28:
            x = _PI28 - (x - _PI28)
        if x - _CAND_TOL >= doubt:
            bits = (bits | _NEAR_CANDIDATE) ^ _NEAR_CANDIDATE
    if s[_P] > _FORGOTTEN:
        bits |= _FORGET
    m = _NEAR_REFERENCE | _NEAR_CANDIDATE | _NEAR_OLD | _TURNING | _CONSISTENT | _SAME_BIT | _FORGET
    s[_DECIDED] = (s[_DECIDED] | m) ^ m | bits


@micropython.viper
def judge_field(state):
    """WEIGHT: whether the heading of this field is believed.

    It is when the field is that of the reference, and its heading what the gyro can explain. Another field, or another
    heading, takes the reference's place when it has stayed for longer than the reference had, while the body turned.
    """
    s = ptr32(state)
    k = 0
    if s[_PROBE] > 0:
        k = 32
    j = s[_J]
    bits = s[_DECIDED]
    have = s[_HAVE]
    e = s[_HEADING] << k >> k
    # good: near the reference and consistent for field_after
    good = 0
    near = 0
    if bits & _NEAR_REFERENCE and bits & _CONSISTENT:
        near = s[_NEAR] + j
        if near >= s[_FIELD_AFTER]:
            near = s[_FIELD_AFTER]
            good = 1
            if bits & _TURNING:
                n = s[_FOR] + j
                if n > s[_FOR_MOST]:
                    n = s[_FOR_MOST]
                s[_FOR] = n
    # the candidate: how long it has stayed, while turning
    count = s[_CAND]
    if good or bits & _NEAR_CANDIDATE == 0:
        count = 0
    elif have & 2 == 0 or bits & (_TURNING | _FORGET):
        count += j
    # reference and candidate follow F: r += k (F - r), k = j T / (field_tau + j T), no more than 1/16
    gain = (j << 26) // ((j << 10) + s[_REF] >> 4)  # Q20
    if gain > 65535:
        gain = 65535
    i = 0
    while i < 2:
        if good:
            y = s[_FR + i] << k >> k
            x = (s[_F + i] << k >> k) - y
            n = x >> 15
            s[_FR + i] = y + (n * gain + ((x - (n << 15)) * gain >> 15) + 16 >> 5)
        y = s[_FC + i] << k >> k
        x = (s[_F + i] << k >> k) - y
        if bits & _NEAR_CANDIDATE == 0:
            y += x
        else:
            n = x >> 15
            y += n * gain + ((x - (n << 15)) * gain >> 15) + 16 >> 5
        s[_FC + i] = y
        i += 1
    x = e - (s[_CAND_E] << k >> k)
    if bits & _NEAR_CANDIDATE == 0 or good or have & 2 == 0:
        s[_CAND_E] = e
    else:
        if x > _PI28:
            x = x - _PI28 - _PI28
        elif x < 0 - _PI28:
            x = x + _PI28 + _PI28
        n = x >> 15
        x = (s[_CAND_E] << k >> k) + (n * gain + ((x - (n << 15)) * gain >> 15) + 16 >> 5)
        if x > _PI28:
            x = x - _PI28 - _PI28
        elif x < 0 - _PI28:
            x = x + _PI28 + _PI28
        s[_CAND_E] = x
    # own: the field is what it was, and its heading is another: the attitude is wrong
    steady = s[_STEADY] + j
    if bits & _SAME_BIT == 0:
        # a turn that was not measured mixes two headings, for a moment
        steady -= 3 * j
        if steady < 0:
            steady = 0
    elif steady > s[_STEADY_MOST]:
        steady = s[_STEADY_MOST]
    s[_STEADY] = steady
    lost = s[_LOST]
    own = s[_OWN]
    restart = False
    if have & 2 == 0 or bits & _CONSISTENT:
        lost -= j << 1
        if lost < 0:
            lost = 0
        own = 0
        if steady >= s[_STEADY_MOST]:
            own = 1
    elif own and steady:
        lost += j
        if bits & _TURNING:
            lost += j
        if lost > s[_RESTART_AFTER]:
            lost = 0
            restart = True
    else:
        lost = 0
        own = 0
    s[_LOST] = lost
    s[_OWN] = own
    back = s[_BACK]
    if good:
        back = 0
    if restart:
        near = s[_FIELD_AFTER]
        good = 1
        count = 0
    elif good + near == 0:
        # another reference, after field_first, field_new, or twice as long as this one was seen and 5 s
        need = s[_FIELD_FIRST]
        n = count
        returns = False
        if have & 2:
            if bits & _FORGET == 0:
                need = (s[_FOR] << 1) + s[_NEED]
                if bits & _CONSISTENT and need > s[_FIELD_NEW]:
                    need = s[_FIELD_NEW]
            if bits & _NEAR_OLD:
                # the one before, soon
                back += j
                if need > s[_BACK_AFTER]:
                    need = s[_BACK_AFTER]
                if back >= n:
                    n = back
                    returns = True
            else:
                back = 0
        if n >= need:
            near = s[_FIELD_AFTER]
            good = 1
            count = 0
            if have & 2 and (bits & _CONSISTENT == 0 or returns):
                restart = True
            if n > s[_FOR_MOST]:
                n = s[_FOR_MOST]
            if returns and n < s[_FO_FOR]:
                n = s[_FO_FOR]
            if have & 2 and bits & _SAME_BIT == 0 and (restart or bits & _NEAR_REFERENCE == 0):
                s[_FO] = s[_FR]
                s[_FO + 1] = s[_FR + 1]
                s[_FO_FOR] = s[_FOR]
                have = 7
                back = 0
            s[_FR] = s[_FC]
            s[_FR + 1] = s[_FC + 1]
            s[_FOR] = n
            s[_HAVE] = have | 3
    s[_BACK] = back
    s[_CAND] = count
    s[_NEAR] = near
    s[_GOOD] = good
    if restart:
        # the heading may be off by e, and the bias is what made it so
        x = e >> 15
        x *= x
        if x > 201326592:
            x = 201326592
        open_heading(state, (x >> 8) * 655)
        open_bias(state)
    # the heading error at rest, slowly
    if good or s[_HAVE] & 2 == 0:
        x = e - (s[_STILL_E] << k >> k)
        if s[_STILL_SET] == 0 or s[_STILL] < s[_REST_AFTER] or s[_DOUBT] >= _SURE:
            s[_STILL_SET] = 1
            s[_STILL_E] = e
        else:
            if x > _PI28:
                x = x - _PI28 - _PI28
            elif x < 0 - _PI28:
                x = x + _PI28 + _PI28
            s[_STILL_E] = (s[_STILL_E] << k >> k) + (x >> 15) * s[_STILL_K]
    n = 0
    if good or s[_HAVE] & 2 == 0:
        n = 1
    s[_WEIGHT] = n
