"""One observer of the family with its sample stream, compiled: the same kernels for one sample and for a whole record.

`on_attitude` serves every fixed-gain variant, `on_attitude_online` the bank. What crosses the border from Python is two flat arrays
(and the bank's), copies that are changed in place: an array that is returned, or a named tuple, costs more than the observer.
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad import linalg, quat
from mavquad.estimate import gsmo_implicit, gsmo_online, gsmo_relay, gsmo_stream
from mavquad.estimate.gsmo_online import Bank
from mavquad.estimate.gsmo_stream import Stream
from mavquad.jit import kernel
from mavquad.quat import Quat, Vec3

STALE_PERIODS = 5.0  # a sample older than this no longer corrects an explicit observer
MAX_RATE_RAD_S = 1e3  # an observer beyond it is lost
HORIZON_US = 2_000_000  # `read` predicts no further than this past the last sample
INTS, FLOATS = gsmo_stream.INTS + 1, gsmo_stream.FLOATS + 14


class Fixed(NamedTuple):
    """Gains of a variant with fixed gains."""

    explicit: bool
    relay: gsmo_relay.Gains
    implicit: gsmo_implicit.Gains
    tick_s: float  # longest integration step


class Core(NamedTuple):
    """A fixed-gain observer at the time of the last accepted sample."""

    q: Quat
    w: Vec3
    z: Quat  # explicit: the last sample, moved along
    d: Vec3  # third order: torque over inertia not modelled [rad/s^2]
    calm: int  # scheduled


@kernel
def begin(q: Quat) -> Core:
    """At a first sample: its attitude, at rest."""
    return Core(q, (0.0, 0.0, 0.0), q, (0.0, 0.0, 0.0), 0)


@kernel
def advance(gains: Fixed, core: Core, period_s: float, a: Vec3, dt_s: float) -> Core:
    """From the last sample on by dt_s >= 0, in equal ticks no longer than tick_s, at a constant torque over inertia."""
    if not dt_s > 0.0:
        return core
    n = max(1, math.ceil(dt_s / gains.tick_s - 1e-9))
    h = dt_s / n
    if gains.explicit:
        stale_s = STALE_PERIODS * period_s if period_s > 0.0 else math.inf
        r = gsmo_relay.State(core.q, core.w, core.z, core.calm)
        for k in range(n):
            r = gsmo_relay.tick(gains.relay, r, k * h > stale_s, a, a, a, h)
        return Core(r.q, r.w, r.z, core.d, r.calm)
    gap_s = gsmo_stream.GAP_PERIODS * period_s if period_s > 0.0 else math.inf
    s = gsmo_implicit.State(core.q, core.w, core.d)
    for k in range(n):
        s = gsmo_implicit.predict(gains.implicit, s, k * h > gap_s, a, a, h)
    return Core(s.q, s.w, core.z, s.d, core.calm)


@kernel
def take(gains: Fixed, core: Core, q_meas: Quat, dt_s: float) -> Core:
    """One sample, dt_s after the last: the implicit variants correct, the explicit ones compare from now on."""
    if gains.explicit:
        return Core(core.q, core.w, q_meas, core.d, core.calm)
    s = gsmo_implicit.correct(gains.implicit, gsmo_implicit.State(core.q, core.w, core.d), q_meas, dt_s)
    return Core(s.q, s.w, core.z, s.d, core.calm)


@kernel
def sane(q: Quat, w: Vec3, d: Vec3) -> bool:
    """Finite, and inside what any vehicle does."""
    return math.isfinite(quat.norm(q)) and linalg.finite3(d) and linalg.norm(w) <= MAX_RATE_RAD_S


@kernel
def on_attitude(gains: Fixed, stream: Stream, core: Core, counts: np.ndarray, t_us: int, q: Quat) -> tuple[Stream, Core]:
    """One attitude sample, whatever it is worth. counts in place."""
    verdict, what, stream, dt_s, unit, a = gsmo_stream.admit(stream, t_us, q)
    gsmo_stream.tally(counts, what)
    if verdict == gsmo_stream.REFUSED:
        return stream, core
    if verdict == gsmo_stream.FIRST:
        return stream, begin(unit)
    core = take(gains, advance(gains, core, stream.clock.period_s, a, dt_s), unit, dt_s)
    if not sane(core.q, core.w, core.d):
        gsmo_stream.tally(counts, gsmo_stream.LOST)
        return gsmo_stream.lost(stream), begin(unit)
    return stream, core


@kernel
def on_attitude_online(gyro: Vec3, tick_s: float, stream: Stream, bank: Bank, counts: np.ndarray, t_us: int, q: Quat) -> Stream:
    """One attitude sample for the bank. counts and bank in place."""
    verdict, what, stream, dt_s, unit, a = gsmo_stream.admit(stream, t_us, q)
    gsmo_stream.tally(counts, what)
    if verdict == gsmo_stream.REFUSED:
        return stream
    if verdict == gsmo_stream.FIRST:
        gsmo_online.start(bank, unit)
        return stream
    period_s = stream.clock.period_s
    gsmo_online.advance(bank, gyro, a, dt_s, tick_s, gsmo_stream.GAP_PERIODS * period_s)
    gsmo_online.correct(bank, unit, dt_s, period_s, stream.clock.fresh - 1)
    q_hat, w_hat = gsmo_online.mixed(bank)
    if not sane(q_hat, w_hat, (0.0, 0.0, 0.0)):
        gsmo_stream.tally(counts, gsmo_stream.LOST)
        gsmo_online.start(bank, unit)
        return gsmo_stream.lost(stream)
    return stream


# ---- the border to Python: plain tuples and flat arrays, changed in place ---------------------------------------------------
@kernel
def fixed(g: tuple) -> Fixed:
    """Gains from the nested plain tuple that crosses the border."""
    return Fixed(g[0], gsmo_relay.Gains(*g[1]), gsmo_implicit.Gains(*g[2]), g[3])


@kernel
def pack_core(c: Core, ints: np.ndarray, floats: np.ndarray) -> None:
    """Behind the stream, in the same arrays."""
    k = gsmo_stream.FLOATS
    ints[gsmo_stream.INTS] = c.calm
    floats[k], floats[k + 1], floats[k + 2], floats[k + 3] = c.q
    floats[k + 4], floats[k + 5], floats[k + 6] = c.w
    floats[k + 7], floats[k + 8], floats[k + 9], floats[k + 10] = c.z
    floats[k + 11], floats[k + 12], floats[k + 13] = c.d


@kernel
def unpack_core(ints: np.ndarray, floats: np.ndarray) -> Core:
    """What `pack_core` wrote."""
    f = floats[gsmo_stream.FLOATS :]
    return Core(
        (f[0], f[1], f[2], f[3]),
        (f[4], f[5], f[6]),
        (f[7], f[8], f[9], f[10]),
        (f[11], f[12], f[13]),
        ints[gsmo_stream.INTS],
    )


@kernel
def sample(g: tuple, ints: np.ndarray, floats: np.ndarray, t_us: int, q: Quat) -> None:
    """One attitude sample for a fixed-gain variant, in place."""
    stream, core = on_attitude(fixed(g), gsmo_stream.unpack(ints, floats), unpack_core(ints, floats), ints, t_us, q)
    gsmo_stream.pack(stream, ints, floats)
    pack_core(core, ints, floats)


@kernel
def sample_online(
    gyro: Vec3, tick_s: float, ints: np.ndarray, floats: np.ndarray, bank: np.ndarray, t_us: int, q: Quat
) -> None:
    """One attitude sample for the bank, in place."""
    stream = on_attitude_online(gyro, tick_s, gsmo_stream.unpack(ints, floats), gsmo_online.of(bank), ints, t_us, q)
    gsmo_stream.pack(stream, ints, floats)


@kernel
def torque_sample(ints: np.ndarray, floats: np.ndarray, t_us: int, a: Vec3) -> None:
    """One torque over inertia [rad/s^2], in place."""
    used, stream = gsmo_stream.heard_torque(gsmo_stream.unpack(ints, floats), t_us, a)
    if not used:
        gsmo_stream.tally(ints, gsmo_stream.BAD_TORQUE)
    gsmo_stream.pack(stream, ints, floats)


@kernel
def ahead_s(stream: Stream, t_us: int) -> float:
    """How far `read` predicts past the last sample."""
    return 1e-6 * min(max(t_us - stream.clock.t_us, 0), HORIZON_US)


@kernel
def predict(g: tuple, ints: np.ndarray, floats: np.ndarray, t_us: int) -> tuple[Quat, Vec3]:
    """Attitude and rates of a fixed-gain variant at t_us."""
    stream, core = gsmo_stream.unpack(ints, floats), unpack_core(ints, floats)
    after = advance(fixed(g), core, stream.clock.period_s, stream.torque.now, ahead_s(stream, t_us))
    return (after.q, after.w) if sane(after.q, after.w, after.d) else (core.q, core.w)


@kernel
def predict_online(
    gyro: Vec3, tick_s: float, ints: np.ndarray, floats: np.ndarray, bank: np.ndarray, t_us: int
) -> tuple[Quat, Vec3]:
    """Attitude and rates of the bank at t_us."""
    stream, now = gsmo_stream.unpack(ints, floats), gsmo_online.of(bank)
    dt_s = ahead_s(stream, t_us)
    if not dt_s > 0.0:
        return gsmo_online.mixed(now)
    after = gsmo_online.of(bank.copy())
    gap_s = gsmo_stream.GAP_PERIODS * stream.clock.period_s if stream.clock.period_s > 0.0 else math.inf
    gsmo_online.advance(after, gyro, stream.torque.now, dt_s, tick_s, gap_s)
    q, w = gsmo_online.mixed(after)
    return (q, w) if sane(q, w, (0.0, 0.0, 0.0)) else gsmo_online.mixed(now)


# ---- whole records ---------------------------------------------------------------------------------------------------------
@kernel
def run(
    g: tuple, t_us: np.ndarray, q_wxyz: np.ndarray, a: np.ndarray, omega: np.ndarray, q_out: np.ndarray, counts: np.ndarray
) -> None:
    """A fixed-gain variant over a record; a (n,3) or (0,3). Fills omega and q_out, tallies counts."""
    gains, stream, core = fixed(g), gsmo_stream.init(), begin((1.0, 0.0, 0.0, 0.0))
    for k in range(len(t_us)):
        q = (q_wxyz[k, 0], q_wxyz[k, 1], q_wxyz[k, 2], q_wxyz[k, 3])
        stream, core = on_attitude(gains, stream, core, counts, t_us[k], q)
        stream = _heard(stream, counts, t_us, a, k)
        omega[k, 0], omega[k, 1], omega[k, 2] = core.w
        q_out[k, 0], q_out[k, 1], q_out[k, 2], q_out[k, 3] = core.q


@kernel
def run_online(
    gyro: Vec3,
    tick_s: float,
    t_us: np.ndarray,
    q_wxyz: np.ndarray,
    a: np.ndarray,
    omega: np.ndarray,
    q_out: np.ndarray,
    counts: np.ndarray,
) -> None:
    """The bank over a record, likewise."""
    stream, bank = gsmo_stream.init(), gsmo_online.of(gsmo_online.new((1.0, 0.0, 0.0, 0.0)))
    for k in range(len(t_us)):
        q = (q_wxyz[k, 0], q_wxyz[k, 1], q_wxyz[k, 2], q_wxyz[k, 3])
        stream = on_attitude_online(gyro, tick_s, stream, bank, counts, t_us[k], q)
        stream = _heard(stream, counts, t_us, a, k)
        q_hat, w_hat = gsmo_online.mixed(bank)
        omega[k, 0], omega[k, 1], omega[k, 2] = w_hat
        q_out[k, 0], q_out[k, 1], q_out[k, 2], q_out[k, 3] = q_hat


@kernel
def _heard(stream: Stream, counts: np.ndarray, t_us: np.ndarray, a: np.ndarray, k: int) -> Stream:
    """The torque of row k, where there is one."""
    if len(a) == 0:
        return stream
    used, stream = gsmo_stream.heard_torque(stream, t_us[k], (a[k, 0], a[k, 1], a[k, 2]))
    if not used:
        gsmo_stream.tally(counts, gsmo_stream.BAD_TORQUE)
    return stream
