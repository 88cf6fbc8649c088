"""Geometric sliding mode observer: body rates from measured attitude, and from the motors' torque where that is known.

One interface for the whole family; `Params.variant` names the member:

  relay, sat, tanh, scheduled, super-twisting     explicit (gsmo_relay): the paper's, its boundary layers and its relatives
  implicit-relay, implicit-super-twisting,
  implicit-third-order                            implicit (gsmo_implicit): no chattering

Source: An et al. 2013; the deviations are listed in gsmo_relay and lie, the other variants' sources in gsmo_implicit.
The same kernels serve live (`observe`, one sample) and in bulk (`run_record`, a whole record): equal results, bit for bit.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mavquad import linalg, signals
from mavquad.airframe import Airframe
from mavquad.errors import ConfigError
from mavquad.estimate import gsmo_implicit, gsmo_relay, gsmo_stream, lie, torque
from mavquad.estimate.gsmo_stream import Counts, Stream
from mavquad.jit import kernel
from mavquad.quat import Quat, Vec3

EXPLICIT = {
    "relay": gsmo_relay.SIGN,
    "sat": gsmo_relay.SAT,
    "tanh": gsmo_relay.TANH,
    "scheduled": gsmo_relay.SCHEDULED,
    "super-twisting": gsmo_relay.SUPER_TWISTING,
}
IMPLICIT = {
    "implicit-relay": gsmo_implicit.RELAY,
    "implicit-super-twisting": gsmo_implicit.SUPER_TWISTING,
    "implicit-third-order": gsmo_implicit.THIRD_ORDER,
}
VARIANTS = (*EXPLICIT, *IMPLICIT)
DEFAULT_K = {
    "relay": (4.0, 8.0),
    "sat": (4.0, 20.0),
    "tanh": (4.0, 20.0),
    "scheduled": (6.0, 30.0),
    "implicit-relay": (6.0, 120.0),
}
STALE_PERIODS = 5.0  # a sample older than this no longer corrects an explicit observer
MAX_RATE_RAD_S = 1e3  # an observer beyond it is lost
HORIZON_US = 2_000_000  # `read` predicts no further than this past the last sample


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """What a person tunes. A gain left at None takes the variant's own default."""

    variant: str = "implicit-third-order"
    source: str = "ahrs"  # "ahrs": signals.Attitude, "mocap": signals.Mocap
    torque: str = "unknown"  # "motors": signals.Motors through the airframe's mixer, with its inertia
    inertia: str = "unknown"  # "airframe": the gyroscopic term is used (a wrong inertia is worse than none)
    k1_rad_s: float | None = None  # relay, boundary layers, scheduled, implicit-relay
    k2_rad_s2: float | None = None
    quiet_k1_rad_s: float = 0.5  # scheduled: once the error is small
    quiet_k2_rad_s2: float = 2.5
    layer_rad: float = 0.2  # sat, tanh
    L: float = 5.0  # super-twisting [rad/s^2], third order [rad/s^3]: bound of what is not modelled
    order: int = 2  # explicit variants: 1 (the paper), 2 or 4
    group_map: str = "cayley"  # or "exp": no bias in a fast spin, one sine and cosine more
    tick_s: float = 0.01  # longest integration step
    forget_s: float = 1.0  # third order: time constant of the torque state while no sample comes

    def __post_init__(self) -> None:
        _one_of("variant", self.variant, VARIANTS)
        _one_of("source", self.source, ("ahrs", "mocap"))
        _one_of("torque", self.torque, ("unknown", "motors"))
        _one_of("inertia", self.inertia, ("unknown", "airframe"))
        _one_of("group_map", self.group_map, ("cayley", "exp"))
        if self.order not in (1, 2, 4):
            raise ConfigError(f"gsmo.order = {self.order}: expected 1, 2 or 4")
        if self.order == 4 and self.group_map != "cayley":
            raise ConfigError('gsmo.order = 4 needs group_map = "cayley"')
        positive = ("k1_rad_s", "k2_rad_s2", "quiet_k1_rad_s", "quiet_k2_rad_s2", "layer_rad", "L", "tick_s", "forget_s")
        for name in positive:
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ConfigError(f"gsmo.{name} = {value}: expected a positive finite number")
        if self.tick_s > 0.1:
            raise ConfigError(f"gsmo.tick_s = {self.tick_s}: expected at most 0.1 s")


def _one_of(key: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ConfigError(f"gsmo.{key} = {value!r}: expected one of {', '.join(allowed)}")


class Kernel(NamedTuple):
    """The part of the gains that kernels take."""

    explicit: bool
    relay: gsmo_relay.Gains
    implicit: gsmo_implicit.Gains
    tick_s: float


class Gains(NamedTuple):
    kernel: Kernel
    source: str
    mixer: torque.Mixer | None  # None: torque unknown


class Core(NamedTuple):
    """The observer itself, at the time of the last accepted sample."""

    q: Quat
    w: Vec3
    z: Quat  # explicit: the last sample, moved along
    d: Vec3  # third order: torque over inertia not modelled [rad/s^2]
    calm: int  # scheduled


class State(NamedTuple):
    stream: Stream
    core: Core
    spin: torque.Spin


class Health(NamedTuple):
    """What a person is shown beside the rates."""

    counts: Counts
    age_s: float  # of the last accepted sample; inf before the first
    period_s: float
    coasting: bool  # more than 2.5 periods without a sample: the rate is a prediction
    stale: bool  # more than 5 periods, or nothing yet: do not use
    settled: bool  # false in the first second of samples, where noise still shows


def gains(params: Params, airframe: Airframe | None = None) -> Gains:
    """Gains for one vehicle. Raises ConfigError where the airframe is needed and missing, or has no rotors."""
    gyro = (0.0, 0.0, 0.0)
    mixer = None
    if params.torque == "motors" or params.inertia == "airframe":
        if airframe is None:
            raise ConfigError('gsmo: torque = "motors" and inertia = "airframe" need an airframe; give one or set "unknown"')
        gyro = torque.gyro_ratios(airframe.body.inertia_kg_m2)
    if params.torque == "motors" and airframe is not None:
        mixer = torque.mixer(airframe)
    return Gains(kernel_gains(params, gyro), params.source, mixer)


def kernel_gains(params: Params, gyro: Vec3) -> Kernel:
    """The kernels' part, for an inertia given by its gyroscopic ratios."""
    k1, k2 = DEFAULT_K.get(params.variant, (0.0, 0.0))
    if params.variant == "super-twisting":
        k1, k2 = 1.5 * math.sqrt(params.L), 1.1 * params.L
    if params.variant == "implicit-super-twisting":
        k1, k2 = 1.5 * math.sqrt(params.L), 1.1 * params.L
    k1 = k1 if params.k1_rad_s is None else params.k1_rad_s
    k2 = k2 if params.k2_rad_s2 is None else params.k2_rad_s2
    group_map = lie.EXP if params.group_map == "exp" else lie.CAYLEY
    shape = EXPLICIT.get(params.variant, gsmo_relay.SIGN)
    relay = gsmo_relay.Gains(
        shape,
        params.order,
        group_map,
        False,
        float(k1),
        float(k2),
        params.quiet_k1_rad_s,
        params.quiet_k2_rad_s2,
        params.layer_rad,
        gyro,
    )
    kind = IMPLICIT.get(params.variant, gsmo_implicit.RELAY)
    implicit = gsmo_implicit.Gains(kind, group_map, float(k1), float(k2), float(params.L), 200.0, params.forget_s, gyro)
    return Kernel(params.variant in EXPLICIT, relay, implicit, params.tick_s)


def init(gains: Gains) -> State:
    """Nothing known: the first sample gives the attitude, the rates start at zero."""
    return State(gsmo_stream.init(), _core((1.0, 0.0, 0.0, 0.0)), torque.AT_REST)


@kernel
def _core(q: Quat) -> Core:
    return Core(q, (0.0, 0.0, 0.0), q, (0.0, 0.0, 0.0), 0)


@kernel
def advance(gains: Kernel, core: Core, period_s: float, a: Vec3, dt_s: float) -> Core:
    """From the last sample on by dt_s >= 0, in equal ticks no longer than tick_s, at a constant torque over inertia."""
    if not dt_s > 0.0:
        return core
    n = max(1, math.ceil(dt_s / gains.tick_s - 1e-9))
    h = dt_s / n
    stale_s = STALE_PERIODS * period_s if period_s > 0.0 else math.inf
    gap_s = gsmo_stream.GAP_PERIODS * period_s if period_s > 0.0 else math.inf
    if gains.explicit:
        r = gsmo_relay.State(core.q, core.w, core.z, core.calm)
        for k in range(n):
            r = gsmo_relay.tick(gains.relay, r, k * h > stale_s, a, a, a, h)
        return Core(r.q, r.w, r.z, core.d, r.calm)
    s = gsmo_implicit.State(core.q, core.w, core.d)
    for k in range(n):
        s = gsmo_implicit.predict(gains.implicit, s, k * h > gap_s, a, a, h)
    return Core(s.q, s.w, core.z, s.d, core.calm)


@kernel
def take(gains: Kernel, core: Core, q_meas: Quat, dt_s: float) -> Core:
    """One sample, dt_s after the last: the implicit variants correct, the explicit ones compare from now on."""
    if gains.explicit:
        return Core(core.q, core.w, q_meas, core.d, core.calm)
    s = gsmo_implicit.correct(gains.implicit, gsmo_implicit.State(core.q, core.w, core.d), q_meas, dt_s)
    return Core(s.q, s.w, core.z, s.d, core.calm)


@kernel
def sane(core: Core) -> bool:
    """Finite and inside what any vehicle does."""
    total = core.q[0] + core.q[1] + core.q[2] + core.q[3] + core.d[0] + core.d[1] + core.d[2]
    return math.isfinite(total) and linalg.norm(core.w) <= MAX_RATE_RAD_S


@kernel
def on_attitude(gains: Kernel, stream: Stream, core: Core, t_us: int, q: Quat) -> tuple[Stream, Core]:
    """One attitude sample, whatever it is worth."""
    verdict, stream, dt_s, unit, a = gsmo_stream.admit(stream, t_us, q)
    if verdict == gsmo_stream.REFUSED:
        return stream, core
    if verdict == gsmo_stream.FIRST:
        return stream, _core(unit)
    core = take(gains, advance(gains, core, stream.clock.period_s, a, dt_s), unit, dt_s)
    if not sane(core):
        return gsmo_stream.lost(stream), _core(unit)
    return stream, core


def observe(gains: Gains, state: State, sample: Any) -> State:
    """One arriving sample of any kind; kinds that are not used, and samples that are refused, leave the rates as they are."""
    if isinstance(sample, signals.Mocap if gains.source == "mocap" else signals.Attitude):
        stream, core = on_attitude(gains.kernel, state.stream, state.core, sample.t_us, sample.q_wxyz)
        return State(stream, core, state.spin)
    if gains.mixer is not None and isinstance(sample, signals.Motors):
        spun = torque.spin_up(gains.mixer, state.spin, sample.t_us, sample.command)
        spin, a = spun if spun is not None else (state.spin, signals.NAN3)
        return State(gsmo_stream.heard_torque(state.stream, sample.t_us, a), state.core, spin)
    return state


def read(gains: Gains, state: State, t_us: int) -> tuple[Quat, Vec3, Health]:
    """Attitude and rates predicted to t_us (not before the last sample, at most 2 s after it), and what they are worth.

    Before the first sample: identity, zero rates, stale.
    """
    clock = state.stream.clock
    if clock.fresh == 0:
        return (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), Health(state.stream.counts, math.inf, 0.0, True, True, False)
    age_s = 1e-6 * max(0, t_us - clock.t_us)
    ahead_s = 1e-6 * min(max(0, t_us - clock.t_us), HORIZON_US)
    core = advance(gains.kernel, state.core, clock.period_s, state.stream.torque.now, ahead_s)
    if not sane(core):
        core = state.core
    unknown = clock.fresh < 2
    return core.q, core.w, _health(state.stream, age_s, unknown)


def _health(stream: Stream, age_s: float, unknown: bool) -> Health:
    clock = stream.clock
    periods = age_s / clock.period_s if clock.period_s > 0.0 else math.inf
    settled = not unknown and (clock.fresh - 1) * clock.period_s >= 1.0
    coasting = unknown or periods > gsmo_stream.GAP_PERIODS
    return Health(stream.counts, age_s, clock.period_s, coasting, unknown or periods > STALE_PERIODS, settled)


def run_record(
    gains: Gains,
    t_us: npt.NDArray[np.int64],
    q_wxyz: npt.NDArray[np.float64],
    torque_rad_s2: npt.NDArray[np.float64] | None = None,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], Counts]:
    """A whole record at once: rates (n,3) [rad/s], attitudes (n,4) right after each sample, and the counts.

    t_us (n,), q_wxyz (n,4); torque_rad_s2 (n,3): torque over inertia heard with each sample and held until the next, or None.
    Rows before the first good sample are identity and zero. Raises ConfigError for shapes that do not match.
    """
    n = len(t_us)
    if q_wxyz.shape != (n, 4) or (torque_rad_s2 is not None and torque_rad_s2.shape != (n, 3)):
        got = None if torque_rad_s2 is None else torque_rad_s2.shape
        raise ConfigError(f"gsmo.run_record: {n} stamps need q_wxyz ({n}, 4) and torque ({n}, 3), got {q_wxyz.shape} and {got}")
    a = np.zeros((0, 3)) if torque_rad_s2 is None else np.ascontiguousarray(torque_rad_s2, dtype=np.float64)
    omega, q = np.zeros((n, 3)), np.zeros((n, 4))
    q[:, 0] = 1.0
    stamps = np.ascontiguousarray(t_us, dtype=np.int64)
    counts = _run(gains.kernel, stamps, np.ascontiguousarray(q_wxyz, dtype=np.float64), a, omega, q)
    return omega, q, counts


@kernel
def _run(gains: Kernel, t_us: np.ndarray, q_wxyz: np.ndarray, a: np.ndarray, omega: np.ndarray, q_out: np.ndarray) -> Counts:
    stream = gsmo_stream.init()
    core = _core((1.0, 0.0, 0.0, 0.0))
    for k in range(len(t_us)):
        q = (q_wxyz[k, 0], q_wxyz[k, 1], q_wxyz[k, 2], q_wxyz[k, 3])
        stream, core = on_attitude(gains, stream, core, t_us[k], q)
        if len(a) > 0:
            stream = gsmo_stream.heard_torque(stream, t_us[k], (a[k, 0], a[k, 1], a[k, 2]))
        if stream.counts.accepted > 0:
            for i in range(3):
                omega[k, i] = core.w[i]
            for i in range(4):
                q_out[k, i] = core.q[i]
    return stream.counts
