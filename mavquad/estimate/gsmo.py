"""Geometric sliding mode observer: body rates from measured attitude, and from the motors' torque where that is known.

One interface for the whole family; `Params.variant` names the member:

  online                                          a bank of observers judged by prediction (gsmo_online): nothing to tune
  relay, sat, tanh, scheduled, super-twisting     explicit (gsmo_relay): the paper's, its boundary layers and its relatives
  implicit-relay, implicit-super-twisting,
  implicit-third-order                            implicit (gsmo_implicit): no chattering

Source: An et al. 2013; the deviations are listed in gsmo_relay and lie, the other variants' sources in their files.
The same kernels serve live (`observe`, one sample) and in bulk (`run_record`, a whole record): equal results, bit for bit.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mavquad import signals
from mavquad.airframe import Airframe
from mavquad.errors import ConfigError
from mavquad.estimate import gsmo_core, gsmo_implicit, gsmo_members, gsmo_online, gsmo_relay, gsmo_stream, lie, torque
from mavquad.estimate.gsmo_stream import Counts
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
VARIANTS = ("online", *EXPLICIT, *IMPLICIT)
DEFAULT_K = {
    "relay": (4.0, 8.0),
    "sat": (4.0, 20.0),
    "tanh": (4.0, 20.0),
    "scheduled": (6.0, 30.0),
    "implicit-relay": (6.0, 120.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """What a person tunes. A gain left at None takes the variant's own default."""

    variant: str = "online"
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


class Gains(NamedTuple):
    fixed: tuple[Any, ...]  # gsmo_core.Fixed as nested plain tuples: what crosses the border to compiled code
    online: bool
    gyro: Vec3
    tick_s: float
    source: str
    mixer: torque.Mixer | None  # None: torque unknown


class State(NamedTuple):
    """Read it with `read`; the arrays' layout is that of gsmo_stream.pack and gsmo_core.pack_core."""

    ints: npt.NDArray[np.int64]
    floats: npt.NDArray[np.float64]
    bank: npt.NDArray[np.float64]  # gsmo_online.of it is the bank; empty for the other variants
    spin: torque.Spin


class Health(NamedTuple):
    """What a person is shown beside the rates."""

    counts: Counts
    age_s: float  # of the last accepted sample; inf before the first
    period_s: float
    coasting: bool  # more than 2.5 periods without a sample: the rate is a prediction
    stale: bool  # more than 5 periods, or fewer than two samples: do not use
    settled: bool  # false in the first second of samples, where noise still shows
    noise_rad: float  # of the samples, per axis, as the bank sees it; NaN for the other variants
    member: int  # the bank's best member; -1 for the other variants


def gains(params: Params, airframe: Airframe | None = None) -> Gains:
    """Gains for one vehicle. Raises ConfigError where the airframe is needed and missing, or has no rotors."""
    gyro = (0.0, 0.0, 0.0)
    mixer = None
    if params.torque == "motors" or params.inertia == "airframe":
        if airframe is None:
            raise ConfigError('gsmo: torque = "motors" and inertia = "airframe" need an airframe; give one or set "unknown"')
        gyro = torque.gyro_ratios(airframe.body.inertia_kg_m2)
        mixer = torque.mixer(airframe) if params.torque == "motors" else None
    return from_ratios(params, gyro, mixer)


def from_ratios(params: Params, gyro: Vec3, mixer: torque.Mixer | None = None) -> Gains:
    """Gains for an inertia given by its gyroscopic ratios (zeros: unknown), as `torque.gyro_ratios` has them."""
    fixed = fixed_gains(params, gyro)
    plain = (fixed.explicit, tuple(fixed.relay), tuple(fixed.implicit), fixed.tick_s)
    return Gains(plain, params.variant == "online", gyro, float(params.tick_s), params.source, mixer)


def fixed_gains(params: Params, gyro: Vec3) -> gsmo_core.Fixed:
    """The gains of a fixed-gain variant as its kernels take them."""
    k1, k2 = DEFAULT_K.get(params.variant, (0.0, 0.0))
    if params.variant in ("super-twisting", "implicit-super-twisting"):
        k1, k2 = 1.5 * math.sqrt(params.L), 1.1 * params.L  # Levant's pair
    k1 = float(k1 if params.k1_rad_s is None else params.k1_rad_s)
    k2 = float(k2 if params.k2_rad_s2 is None else params.k2_rad_s2)
    group_map = lie.EXP if params.group_map == "exp" else lie.CAYLEY
    shape = EXPLICIT.get(params.variant, gsmo_relay.SIGN)
    quiet = (float(params.quiet_k1_rad_s), float(params.quiet_k2_rad_s2))
    relay = gsmo_relay.Gains(shape, params.order, group_map, False, k1, k2, *quiet, float(params.layer_rad), gyro)
    kind = IMPLICIT.get(params.variant, gsmo_implicit.RELAY)
    implicit = gsmo_implicit.Gains(kind, group_map, k1, k2, float(params.L), gsmo_members.D_MAX, float(params.forget_s), gyro)
    return gsmo_core.Fixed(params.variant in EXPLICIT, relay, implicit, float(params.tick_s))


def init(gains: Gains) -> State:
    """Nothing known: the first sample gives the attitude, the rates start at zero."""
    ints, floats = np.zeros(gsmo_core.INTS, np.int64), np.zeros(gsmo_core.FLOATS)
    gsmo_core.pack_core(gsmo_core.begin((1.0, 0.0, 0.0, 0.0)), ints, floats)
    bank = gsmo_online.new((1.0, 0.0, 0.0, 0.0)) if gains.online else np.zeros(0)
    return State(ints, floats, bank, torque.AT_REST)


def uses(gains: Gains) -> tuple[str, ...]:
    """The kinds of samples that `observe` takes anything from."""
    kind = "Mocap" if gains.source == "mocap" else "Attitude"
    return (kind,) if gains.mixer is None else (kind, "Motors")


def observe(gains: Gains, state: State, sample: Any) -> State:
    """One arriving sample of any kind; kinds that are not used, and samples that are refused, leave the rates as they are."""
    if isinstance(sample, signals.Mocap if gains.source == "mocap" else signals.Attitude):
        return _attitude(gains, state, sample.t_us, sample.q_wxyz)
    if gains.mixer is not None and isinstance(sample, signals.Motors):
        if abs(sample.t_us) > gsmo_stream.MAX_STAMP_US:
            return _bad_stamp(state)
        spun = torque.spin_up(gains.mixer, state.spin, sample.t_us, sample.command)
        spin, a = spun if spun is not None else (state.spin, signals.NAN3)
        ints, floats = state.ints.copy(), state.floats.copy()
        gsmo_core.torque_sample(ints, floats, sample.t_us, a)
        return State(ints, floats, state.bank, spin)
    return state


def _attitude(gains: Gains, state: State, t_us: int, q_wxyz: Quat) -> State:
    if abs(t_us) > gsmo_stream.MAX_STAMP_US:
        return _bad_stamp(state)
    w, x, y, z = q_wxyz
    q = (float(w), float(x), float(y), float(z))
    ints, floats, bank = state.ints.copy(), state.floats.copy(), state.bank.copy()
    if gains.online:
        gsmo_core.sample_online(gains.gyro, gains.tick_s, ints, floats, bank, t_us, q)
    else:
        gsmo_core.sample(gains.fixed, ints, floats, t_us, q)
    return State(ints, floats, bank, state.spin)


def _bad_stamp(state: State) -> State:
    ints = state.ints.copy()
    ints[gsmo_stream.BAD_STAMP] += 1
    return state._replace(ints=ints)


def read(gains: Gains, state: State, t_us: int) -> tuple[Quat, Vec3, Health]:
    """Attitude and rates predicted to t_us (not before the last sample, at most 2 s after it), and what they are worth.

    Before the first sample: identity, zero rates, stale.
    """
    return *predict(gains, state, t_us), health(state, _near(t_us))


def predict(gains: Gains, state: State, t_us: int) -> tuple[Quat, Vec3]:
    """Attitude and rates as `read` gives them."""
    if gains.online:
        return gsmo_core.predict_online(gains.gyro, gains.tick_s, state.ints, state.floats, state.bank, _near(t_us))
    return gsmo_core.predict(gains.fixed, state.ints, state.floats, _near(t_us))


def _near(t_us: int) -> int:
    return min(max(t_us, -gsmo_stream.MAX_STAMP_US), gsmo_stream.MAX_STAMP_US)


def health(state: State, t_us: int) -> Health:
    """What the rates of `read` at t_us are worth."""
    numbers = state.ints.tolist()
    counts = Counts(*numbers[: len(Counts._fields)])
    last_us, fresh = numbers[10], numbers[11]
    period_s = float(state.floats[0])
    age_s = 1e-6 * max(0, t_us - last_us) if fresh > 0 else math.inf
    periods = age_s / period_s if fresh > 1 else math.inf
    settled = fresh > 1 and (fresh - 1) * period_s >= 1.0
    noise_rad, member = math.nan, -1
    if len(state.bank):
        _, best, variance = state.bank[-3:].tolist()
        noise_rad, member = math.sqrt(max(variance, 0.0)), int(best)
    coasting = periods > gsmo_stream.GAP_PERIODS
    return Health(counts, age_s, period_s, coasting, periods > gsmo_core.STALE_PERIODS, settled, noise_rad, member)


def published(h: Health) -> tuple[float, ...]:
    """The health as numbers for the wire: age, period [s], noise [rad], best member, coasting, stale, settled (0 or 1), the counts."""
    flags = (float(h.coasting), float(h.stale), float(h.settled))
    return (h.age_s, h.period_s, h.noise_rad, float(h.member), *flags, *(float(n) for n in h.counts))


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
    omega, q, counts = np.zeros((n, 3)), np.zeros((n, 4)), np.zeros(len(Counts._fields), np.int64)
    stamps, samples = np.ascontiguousarray(t_us, dtype=np.int64), np.ascontiguousarray(q_wxyz, dtype=np.float64)
    if gains.online:
        gsmo_core.run_online(gains.gyro, gains.tick_s, stamps, samples, a, omega, q, counts)
    else:
        gsmo_core.run(gains.fixed, stamps, samples, a, omega, q, counts)
    return omega, q, Counts(*counts.tolist())
