"""What every observer of an attitude stream does before it observes: refuse, count, time, and average the torque.

A sample is taken whole or refused whole, and every refusal is counted by its reason. Stamps are integer microseconds of the
sender's boot clock; a clock that has started again is told from late samples by ten of them in a row, each newer than the one
before.
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad import linalg, quat
from mavquad.jit import kernel
from mavquad.quat import Quat, Vec3

REFUSED, FIRST, NEXT = 0, 1, 2  # verdicts on a sample
ACCEPTED, NOT_FINITE, BAD_NORM, DUPLICATE, LATE, GAP, RESTART, LOST, BAD_TORQUE, BAD_STAMP = range(10)  # places in Counts

MIN_PERIOD_US = 100  # closer stamps are one sample sent twice
MAX_GAP_US = 20_000_000  # after a longer silence the observer starts afresh
LATE_RUN = 10  # this many older samples in a row, themselves in order: the clock was restarted
SLOW_RUN = 10  # this many long periods in a row are the new period
GAP_PERIODS = 2.5  # a longer silence is a gap, not a period
MAX_STAMP_US = 1 << 62
MAX_TORQUE_RAD_S2 = 1e5  # torque over inertia; a small racing quadrotor reaches 1e3


class Counts(NamedTuple):
    """Samples by what became of them."""

    accepted: int
    not_finite: int
    bad_norm: int
    duplicate: int
    late: int  # older than what was already used
    gaps: int  # accepted after more than 2.5 periods of silence
    restarts: int  # the sender's clock started again, or 20 s of silence
    lost: int  # the observer's own state was no longer finite
    bad_torque: int
    bad_stamp: int  # no time of any clock: beyond +-2^62 us


class Clock(NamedTuple):
    t_us: int  # of the last accepted sample; no meaning before the first
    fresh: int  # samples accepted since the start or the last restart
    period_s: float  # running mean of the sample period; 0 before the second sample
    slow: int  # long periods in a row
    slow_s: float  # the shortest of them
    late_run: int  # older samples in a row
    late_t_us: int


class Torque(NamedTuple):
    """Torque over inertia, held between what is heard and averaged over one sample period."""

    now: Vec3  # as last heard [rad/s^2]
    from_us: int  # the beginning of the integral ...
    since_us: int  # ... its end, from where `now` counts ...
    total: Vec3  # ... and the integral itself [rad/s]


class Stream(NamedTuple):
    clock: Clock
    torque: Torque


@kernel
def init() -> Stream:
    zero = (0.0, 0.0, 0.0)
    return Stream(Clock(0, 0, 0.0, 0, 0.0, 0, 0), Torque(zero, 0, 0, zero))


@kernel
def tally(counts: np.ndarray, what: int) -> None:
    """One more in counts, in place; a sample after a gap or a restart is an accepted one too."""
    counts[what] += 1
    if what in (GAP, RESTART):
        counts[ACCEPTED] += 1


@kernel
def begin(s: Stream, t_us: int) -> Stream:
    """The stream after a first sample. The torque last heard goes on to count."""
    clock = Clock(t_us, 1, 0.0, 0, 0.0, 0, 0)
    return Stream(clock, Torque(s.torque.now, t_us, t_us, (0.0, 0.0, 0.0)))


@kernel
def late(s: Stream, t_us: int) -> tuple[int, int, Stream]:
    """Judge a sample that is older than the last accepted one."""
    c = s.clock
    run = c.late_run + 1 if c.late_run > 0 and t_us > c.late_t_us else 1
    if run >= LATE_RUN:
        return FIRST, RESTART, begin(s, t_us)
    clock = Clock(c.t_us, c.fresh, c.period_s, c.slow, c.slow_s, run, t_us)
    return REFUSED, LATE, Stream(clock, s.torque)


@kernel
def advance_clock(c: Clock, t_us: int, dt_s: float) -> Clock:
    """The clock after an accepted sample; a gap does not enter the mean period, ten in a row replace it."""
    if c.fresh == 1:
        return Clock(t_us, 2, dt_s, 0, 0.0, 0, 0)
    if dt_s < GAP_PERIODS * c.period_s:
        return Clock(t_us, c.fresh + 1, c.period_s + (dt_s - c.period_s) / min(c.fresh, 50), 0, 0.0, 0, 0)
    slow_s = min(c.slow_s, dt_s) if c.slow > 0 else dt_s
    if c.slow + 1 >= SLOW_RUN:
        return Clock(t_us, c.fresh + 1, slow_s, 0, 0.0, 0, 0)
    return Clock(t_us, c.fresh + 1, c.period_s, c.slow + 1, slow_s, 0, 0)


@kernel
def integrate_torque(torque: Torque, until_us: int) -> Torque:
    """The integral carried on until a later time; an earlier one changes nothing."""
    if until_us <= torque.since_us:
        return torque
    total = linalg.axpy(1e-6 * (until_us - torque.since_us), torque.now, torque.total)
    return Torque(torque.now, torque.from_us, until_us, total)


@kernel
def admit(s: Stream, t_us: int, q: Quat) -> tuple[int, int, Stream, float, Quat, Vec3]:
    """Judge one sample: (verdict, place in Counts, stream, seconds since the last, unit quaternion, mean torque over inertia)."""
    zero = (0.0, 0.0, 0.0)
    n = quat.norm(q)
    if not math.isfinite(n):
        return REFUSED, NOT_FINITE, s, 0.0, q, zero
    if abs(n - 1.0) > 0.05:
        return REFUSED, BAD_NORM, s, 0.0, q, zero
    unit = (q[0] / n, q[1] / n, q[2] / n, q[3] / n)
    elapsed_us = t_us - s.clock.t_us
    if s.clock.fresh == 0:
        return FIRST, ACCEPTED, begin(s, t_us), 0.0, unit, zero
    if elapsed_us > MAX_GAP_US:
        return FIRST, RESTART, begin(s, t_us), 0.0, unit, zero
    if elapsed_us < -MIN_PERIOD_US:
        verdict, what, after = late(s, t_us)
        return verdict, what, after, 0.0, unit, zero
    if elapsed_us <= MIN_PERIOD_US:
        return REFUSED, DUPLICATE, s, 0.0, unit, zero
    dt_s = 1e-6 * elapsed_us
    what = GAP if s.clock.fresh > 1 and dt_s >= GAP_PERIODS * s.clock.period_s else ACCEPTED
    torque = integrate_torque(s.torque, t_us)
    mean = torque.now
    if torque.since_us > torque.from_us:
        mean = linalg.scale(1e6 / (torque.since_us - torque.from_us), torque.total)
    torque = Torque(torque.now, torque.since_us, torque.since_us, zero)
    return NEXT, what, Stream(advance_clock(s.clock, t_us, dt_s), torque), dt_s, unit, mean


@kernel
def heard_torque(s: Stream, t_us: int, a: Vec3) -> tuple[bool, Stream]:
    """A new torque over inertia [rad/s^2] from t_us on; False, and unused, where it is not finite, absurd or of another time."""
    size = abs(a[0]) + abs(a[1]) + abs(a[2])
    if not size <= MAX_TORQUE_RAD_S2 or (s.clock.fresh > 0 and abs(t_us - s.clock.t_us) > MAX_GAP_US):
        return False, s
    if s.clock.fresh == 0:
        return True, Stream(s.clock, Torque(a, t_us, t_us, (0.0, 0.0, 0.0)))
    so_far = integrate_torque(s.torque, t_us)
    return True, Stream(s.clock, Torque(a, so_far.from_us, so_far.since_us, so_far.total))


@kernel
def lost(s: Stream) -> Stream:
    """The observer has lost itself: the next good sample is a first one again."""
    zero = (0.0, 0.0, 0.0)
    t_us = s.clock.t_us
    return Stream(Clock(t_us, 0, 0.0, 0, 0.0, 0, 0), Torque(zero, t_us, t_us, zero))


# ---- as arrays: what crosses the border between Python and compiled code, 10 times as fast as nested NamedTuples ----------------
INTS, FLOATS = 17, 8  # the first 10 integers are Counts


@kernel
def pack(s: Stream, ints: np.ndarray, floats: np.ndarray) -> None:
    """Into the arrays, in place; the counts, and what lies behind, are left alone."""
    c, m = s.clock, s.torque
    ints[10], ints[11], ints[12], ints[13], ints[14] = c.t_us, c.fresh, c.slow, c.late_run, c.late_t_us
    ints[15], ints[16] = m.from_us, m.since_us
    floats[0], floats[1] = c.period_s, c.slow_s
    floats[2], floats[3], floats[4] = m.now
    floats[5], floats[6], floats[7] = m.total


@kernel
def unpack(ints: np.ndarray, floats: np.ndarray) -> Stream:
    """What `pack` wrote."""
    i, f = ints, floats
    clock = Clock(i[10], i[11], f[0], i[12], f[1], i[13], i[14])
    return Stream(clock, Torque((f[2], f[3], f[4]), i[15], i[16], (f[5], f[6], f[7])))
