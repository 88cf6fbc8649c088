"""The extended-state filter on telemetry: position, velocity and disturbance acceleration of a MAVLink vehicle.

One filter per axis of the world. Its known input is what the vehicle really does: the thrust that the autopilot echoes, along
the attitude that it reports, and the airframe's own drag at the estimated velocity. What is left is the disturbance. Filter time
is vehicle time: a sample acts at its stamp, however late it arrives.

Deviations from the paper (beside those of `extended_state_kf.py`):
  input     the thrust that acts by its echo, not the commanded one: 100 ms of unmodelled delay makes the vertical estimate
            oscillate. An echo of a setpoint of ours puts the line of those sent in time, which tells what acts between echoes.
  drag      modelled from the airframe file, so that f changes with the wind and not with the path.
  offset    telemetry's velocity is not the derivative of its position (0.02 m/s is common), which holds any filter that trusts
            both some centimetres off: the slow part of the position is anchored to the raw one.
  Q         a share of the growth of f, by whether innovations of velocity resemble the ones before (Mehra 1970): calm air is not
            answered with the noise that gusts are worth.
  R         adapted from the residuals, if wished.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from mavquad import quat
from mavquad.airframe import Airframe
from mavquad.errors import ConfigError
from mavquad.estimate import extended_state_kf as eskf
from mavquad.estimate.extended_state_kf import KfGains, KfState
from mavquad.jit import kernel
from mavquad.signals import NAN3, ZERO3, Applied, Attitude, Estimate, Position, Quat, Target, Vec3

G_M_S2 = 9.80665
_NO_RATE = 1e9  # variance of a velocity that did not come
_LATE_S = 0.25  # a position older than the filter by more is not used
_COAST_S = 1.5  # the longest silence that is integrated over; beyond it the filter begins again where it is
_ECHO_S = 0.3  # an echo older than this is not the present thrust
_SAME = 1e-6  # collectives this near are one: a float's rounding
_JUDGE = 0.04  # how quickly the growth of f follows the innovations, per sample
_KEPT = 0.7  # of the sum of past innovations that a new one is compared with, per sample: one alone says half as much
_TREND = math.sqrt(1.0 - _KEPT**2)  # the sum varies like one innovation
# vertical innovation times that sum over its variance, at a share of 0.1 and 0.5: -0.14 and -0.17 in calm air, 0.4 to 1.2 and 0 to 0.16 in gusts
_CALM = -0.06
_MEAN = 0.02  # weight of an innovation in their mean: what telemetry's inconsistency leaves is no gust
_SCALE_S = 1.0  # memory of the scale between echoed and specific thrust


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """Noise as 1 sigma of telemetry; growth of f per 10 ms, (m/s^2)^2."""

    position_sigma_m: float = 0.02
    velocity_sigma_m_s: float = 0.03
    f_growth: float = 0.02
    f_growth_down: float = 0.02
    f_growth_least: float = 0.03  # share of it that is left in calm air, as the innovations say; 1: it stays as it is
    adapt: float = 0.0  # weight of a new residual in R (0: R stays)
    anchor_s: float = 1.5  # time constant of the raw position's slow part (0: off)
    drag: float = 1.0  # share of the airframe file's drag taken as known
    echo: bool = True  # ATTITUDE_TARGET says which thrust acts; else it is what was sent, delayed by the measured round trip
    thrust_lag_s: float = -1.0  # of the rotors; < 0: from the airframe

    def __post_init__(self) -> None:
        for name in ("position_sigma_m", "velocity_sigma_m_s", "f_growth", "f_growth_down"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"eskf.{name} must be a finite number > 0, got {value}")
        if not 0.001 <= self.f_growth_least <= 1.0:
            raise ConfigError(f"eskf.f_growth_least = {self.f_growth_least}: expected 0.001 to 1 (off)")
        if not 0.0 <= self.adapt <= 0.2:
            raise ConfigError(f"eskf.adapt = {self.adapt}: expected 0 (off) to 0.2")
        if not (self.anchor_s == 0.0 or 0.2 <= self.anchor_s <= 60.0):
            raise ConfigError(f"eskf.anchor_s = {self.anchor_s}: expected 0 (off) or 0.2 to 60 s")
        if not 0.0 <= self.drag <= 2.0 or not self.thrust_lag_s <= 1.0:
            raise ConfigError(f"eskf.drag = {self.drag}, thrust_lag_s = {self.thrust_lag_s}: expected 0 to 2 and at most 1 s")


class Growth(NamedTuple):
    """The share of the growth of f that the filter believes in, and what it is judged by: innovations of velocity."""

    share: float
    trend: Vec3  # the newest less their mean, summed with a memory of _KEPT
    mean: Vec3


FULL = Growth(1.0, ZERO3, ZERO3)


class Gains(NamedTuple):
    horizontal: KfGains
    vertical: KfGains
    least: float
    adapt: float
    anchor_s: float
    drag_linear_1_s: Vec3
    drag_quadratic_1_m: Vec3
    thrust_lag_s: float
    echo: bool


class Sent(NamedTuple):
    """One setpoint: the vehicle time at which it acts, its specific thrust, and the collective that carries it."""

    acts_us: int
    thrust_m_s2: float
    collective: float


class State(NamedTuple):
    """What is known, at vehicle time t_us of the filter; axes None before the first position."""

    t_us: int
    axes: tuple[KfState, KfState, KfState] | None
    growth: Growth
    q_wxyz: Quat
    omega_rad_s: Vec3
    thrust_m_s2: float  # specific thrust of the rotors now, lagged
    echoed: float  # newest collective of ATTITUDE_TARGET
    echo_us: int
    scale: float  # specific thrust per echoed collective
    sent: tuple[Sent, ...]  # the last setpoints, oldest first
    known_us: int  # newest echo that was one of them; 0: none yet
    acts_us: int  # when the setpoint of the last control step reaches the vehicle
    delay_s: float
    offset_m: Vec3  # slow part of raw minus filtered position
    position_us: int


def gains(params: Params, airframe: Airframe) -> Gains:
    def axis(growth: float) -> KfGains:
        return eskf.gains(
            eskf.KfParams(q_per_step=growth, r_first=params.position_sigma_m**2, r_second=params.velocity_sigma_m_s**2)
        )

    k = params.drag / airframe.body.mass_kg
    linear, quadratic = airframe.drag.linear_n_s_m, airframe.drag.quadratic_n_s2_m2
    lag_s = params.thrust_lag_s if params.thrust_lag_s >= 0.0 else (airframe.rotors.lag_s if airframe.rotors else 0.0)
    return Gains(
        axis(params.f_growth),
        axis(params.f_growth_down),
        params.f_growth_least,
        params.adapt,
        params.anchor_s,
        (k * linear[0], k * linear[1], k * linear[2]),
        (k * quadratic[0], k * quadratic[1], k * quadratic[2]),
        lag_s,
        params.echo,
    )


def init(gains: Gains) -> State:
    return State(0, None, FULL, quat.IDENTITY, ZERO3, G_M_S2, math.nan, 0, math.nan, (), 0, 0, 0.0, ZERO3, 0)


@kernel
def drag(linear: Vec3, quadratic: Vec3, v: Vec3) -> Vec3:
    """Acceleration by drag at the velocity v, world axes (the airframe's two horizontal coefficients are alike)."""
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return (
        -(linear[0] + quadratic[0] * speed) * v[0],
        -(linear[1] + quadratic[1] * speed) * v[1],
        -(linear[2] + quadratic[2] * speed) * v[2],
    )


@kernel
def known_acceleration(g: Gains, q: Quat, thrust_m_s2: float, v: Vec3) -> Vec3:
    """g e3 - T R e3 + drag(v)."""
    up = quat.rotate(q, (0.0, 0.0, thrust_m_s2))
    d = drag(g.drag_linear_1_s, g.drag_quadratic_1_m, v)
    return (d[0] - up[0], d[1] - up[1], G_M_S2 + d[2] - up[2])


@kernel
def advance(
    g: Gains, axes: tuple[KfState, KfState, KfState], growth: Growth, q: Quat, thrust_m_s2: float, dt_s: float
) -> tuple[KfState, KfState, KfState]:
    """All three axes over dt."""
    n, e, d = axes
    a = known_acceleration(g, q, thrust_m_s2, (n.x[1], e.x[1], d.x[1]))
    level, vertical = _growing(g.horizontal, growth.share), _growing(g.vertical, growth.share)
    return (eskf.advance(level, n, a[0], dt_s), eskf.advance(level, e, a[1], dt_s), eskf.advance(vertical, d, a[2], dt_s))


@kernel
def _growing(g: KfGains, share: float) -> KfGains:
    return KfGains(g.dt_s, share * g.q, g.r_first, g.r_second, g.p0, g.delta)


@kernel
def _axis(g: KfGains, adapt: float, s: KfState, p: float, v: float, a: float, age_s: float) -> tuple[KfState, float, float]:
    """(axis corrected, innovation of its velocity, variance that was expected of it)."""
    total = a + s.x[2]
    p += age_s * v + 0.5 * age_s * age_s * total  # the sample carried forward to the filter's time
    v += age_s * total
    innovation, expected = v - s.x[1], s.p[3] + s.r[1]
    s = eskf.update(g, s, p, v)
    if adapt > 0.0:
        s = eskf.adapt(s, p, v, adapt)
    return s, innovation, expected


@kernel
def correct(
    g: Gains,
    axes: tuple[KfState, KfState, KfState],
    growth: Growth,
    p: Vec3,
    v: Vec3,
    q: Quat,
    thrust_m_s2: float,
    age_s: float,
) -> tuple[tuple[KfState, KfState, KfState], Growth]:
    """All three axes, and the growth of f, with a sample that is age_s older than the filter."""
    n, e, d = axes
    a = known_acceleration(g, q, thrust_m_s2, (n.x[1], e.x[1], d.x[1]))
    n, e_n, s_n = _axis(g.horizontal, g.adapt, n, p[0], v[0], a[0], age_s)
    e, e_e, s_e = _axis(g.horizontal, g.adapt, e, p[1], v[1], a[1], age_s)
    d, e_d, s_d = _axis(g.vertical, g.adapt, d, p[2], v[2], a[2], age_s)
    if g.least < 1.0:
        growth = _judged(g.least, growth, (e_n, e_e, e_d), (s_n, s_e, s_d))
    return (n, e, d), growth


@kernel
def _judged(least: float, growth: Growth, e: Vec3, expected: Vec3) -> Growth:
    """Vertical innovations against those before: the filter follows mere noise, the air is calm. Like those before: it is not.

    Gusts along the ground are slower: only strong ones show.
    """
    m = growth.mean
    m = (m[0] + _MEAN * (e[0] - m[0]), m[1] + _MEAN * (e[1] - m[1]), m[2] + _MEAN * (e[2] - m[2]))
    now = (e[0] - m[0], e[1] - m[1], e[2] - m[2])
    t = growth.trend
    level = max(now[0] * t[0] / expected[0], now[1] * t[1] / expected[1])
    drive = now[2] * t[2] / expected[2] - _CALM + max(0.0, level - 4.0)
    t = (_KEPT * t[0] + _TREND * now[0], _KEPT * t[1] + _TREND * now[1], _KEPT * t[2] + _TREND * now[2])
    return Growth(min(1.0, max(least, growth.share * math.exp(_JUDGE * min(10.0, drive)))), t, m)


def observe(gains: Gains, state: State, sample: object) -> State:
    """Attitude moves the filter on, Position corrects it, Target says which thrust acts."""
    if isinstance(sample, Attitude):
        if not all(map(math.isfinite, (*sample.q_wxyz, *sample.omega_rad_s))):
            return state
        return _to(gains, state, sample.t_us)._replace(q_wxyz=sample.q_wxyz, omega_rad_s=sample.omega_rad_s)
    if isinstance(sample, Position):
        return _position(gains, state, sample)
    if isinstance(sample, Target):
        return _target(gains, state, sample)
    return state


def _to(gains: Gains, state: State, t_us: int) -> State:
    """The filter at t: by the present attitude, and the thrust that acts between."""
    dt_s = 1e-6 * (t_us - state.t_us)
    if dt_s <= 0.0:
        return state
    if not state.t_us or dt_s > _COAST_S:
        return state._replace(t_us=t_us, axes=None)
    wanted = _thrust(gains, state, t_us)
    keep = math.exp(-dt_s / gains.thrust_lag_s) if gains.thrust_lag_s > 1e-4 else 0.0
    thrust = wanted + keep * (state.thrust_m_s2 - wanted)
    axes = state.axes
    if axes is not None:
        axes = advance(gains, axes, state.growth, state.q_wxyz, 0.5 * (state.thrust_m_s2 + thrust), dt_s)
    return state._replace(t_us=t_us, axes=axes, thrust_m_s2=thrust)


def _thrust(gains: Gains, state: State, t_us: int) -> float:
    """Specific thrust commanded at t: what was sent, as long as its echo comes back; another's as echoed; else what was sent."""
    heard = gains.echo and state.echo_us and t_us - state.echo_us <= 1e6 * _ECHO_S and math.isfinite(state.scale)
    if heard and t_us - state.known_us > 1e6 * _ECHO_S:
        return state.scale * state.echoed
    return _sent_at(state, t_us)


def _sent_at(state: State, t_us: int) -> float:
    found = G_M_S2
    for sent in state.sent:
        if sent.acts_us > t_us:
            break
        found = sent.thrust_m_s2
    return found


def _position(gains: Gains, state: State, sample: Position) -> State:
    p, v = sample.p_ned_m, sample.v_ned_m_s
    if not all(map(math.isfinite, p)):
        return state
    if state.axes is None:
        level, vertical = gains.horizontal, gains.vertical
        v0 = v if all(map(math.isfinite, v)) else ZERO3
        axes = (eskf.init(level, p[0], v0[0]), eskf.init(level, p[1], v0[1]), eskf.init(vertical, p[2], v0[2]))
        return state._replace(t_us=max(state.t_us, sample.t_us), axes=axes, position_us=sample.t_us, offset_m=ZERO3)
    if sample.t_us > state.t_us:
        state = _to(gains, state, sample.t_us)
    age_s = 1e-6 * (state.t_us - sample.t_us)
    if age_s > _LATE_S or state.axes is None:
        return state
    n, e, d = state.axes
    if not all(map(math.isfinite, v)):  # position alone: the velocity of the filter stands in and weighs nothing
        v = (n.x[1], e.x[1], d.x[1])
        n, e, d = _deaf(n), _deaf(e), _deaf(d)
    axes, growth = correct(gains, (n, e, d), state.growth, p, v, state.q_wxyz, state.thrust_m_s2, age_s)
    n, e, d = axes
    if gains.adapt == 0.0:
        axes = (_hears(gains.horizontal, n), _hears(gains.horizontal, e), _hears(gains.vertical, d))
    offset = state.offset_m
    if gains.anchor_s > 0.0 and state.position_us:
        since_s = min(1.0, 1e-6 * max(0, sample.t_us - state.position_us))
        w = 1.0 - math.exp(-since_s / gains.anchor_s)
        at = [x.x[0] - age_s * x.x[1] for x in (n, e, d)]  # the filter at the sample's stamp
        offset = (
            offset[0] + w * (p[0] - at[0] - offset[0]),
            offset[1] + w * (p[1] - at[1] - offset[1]),
            offset[2] + w * (p[2] - at[2] - offset[2]),
        )
    return state._replace(axes=axes, growth=growth, offset_m=offset, position_us=max(sample.t_us, state.position_us))


def _deaf(axis: KfState) -> KfState:
    return axis._replace(r=(axis.r[0], _NO_RATE))


def _hears(g: KfGains, axis: KfState) -> KfState:
    return axis._replace(r=(g.r_first, g.r_second))


def _target(gains: Gains, state: State, sample: Target) -> State:
    """The echo's thrust, what it says of our own line, and its scale: what acts by our own line over what is echoed, slowly averaged."""
    u = sample.thrust
    if not (math.isfinite(u) and 0.02 < u <= 1.0):
        return state
    if gains.echo:
        state = _recognised(state, u, sample.t_us)
    ratio = _sent_at(state, sample.t_us) / u
    scale = state.scale
    if not math.isfinite(scale) or not state.sent:
        scale = ratio
    else:
        since_s = min(_SCALE_S, 1e-6 * max(0, sample.t_us - state.echo_us))
        scale += (since_s / _SCALE_S) * 0.5 * (ratio - scale)
    return state._replace(echoed=u, echo_us=sample.t_us, scale=scale)


def _recognised(state: State, u: float, t_us: int) -> State:
    """An echo of a setpoint of ours says which one acts at t: those before it are over, those behind it had not arrived."""
    found, apart_us = -1, round(1e6 * _ECHO_S)
    for i, sent in enumerate(state.sent):
        if abs(sent.collective - u) < _SAME and abs(sent.acts_us - t_us) < apart_us:
            found, apart_us = i, abs(sent.acts_us - t_us)
    if found < 0:
        return state
    line = [
        sent._replace(acts_us=min(sent.acts_us, t_us) if i <= found else max(sent.acts_us, t_us + 1))
        for i, sent in enumerate(state.sent)
    ]
    return state._replace(sent=tuple(line), known_us=t_us)


def step(gains: Gains, state: State, applied: Applied, t_us: int) -> tuple[State, Estimate]:
    """Once per control tick: remember what was sent, and say where the vehicle is at t."""
    thrust = applied.thrust_m_s2
    if math.isfinite(thrust) and thrust >= 0.0:  # a rotor does not pull: a negative thrust was never applied
        state = state._replace(sent=(*state.sent[-63:], Sent(state.acts_us, thrust, applied.collective)))
    if math.isfinite(applied.delay_s):
        state = state._replace(delay_s=min(1.0, max(0.0, applied.delay_s)))
    delay_s = max(0.0, state.delay_s + (applied.age_s if math.isfinite(applied.age_s) else 0.0))
    state = state._replace(acts_us=max(state.acts_us, t_us + round(1e6 * delay_s)))
    state = _to(gains, state, t_us)
    if state.axes is None:
        return state, Estimate(t_us, NAN3, NAN3, state.q_wxyz, state.omega_rad_s, NAN3, NAN3)
    n, e, d = state.axes
    o = state.offset_m
    v = (n.x[1], e.x[1], d.x[1])
    air = drag(gains.drag_linear_1_s, gains.drag_quadratic_1_m, v)
    return state, Estimate(
        t_us,
        (n.x[0] + o[0], e.x[0] + o[1], d.x[0] + o[2]),
        v,
        state.q_wxyz,
        state.omega_rad_s,
        (n.x[2] + air[0], e.x[2] + air[1], d.x[2] + air[2]),
        NAN3,
        delay_s,
        state.thrust_m_s2,
    )


def uses(gains: Gains) -> tuple[str, ...]:
    """The kinds of samples that `observe` keeps."""
    return ("Attitude", "Position", "Target")
