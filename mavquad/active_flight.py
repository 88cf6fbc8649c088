"""The compensator `asmf` in flight: model error from `estimate/quad_error`, cancelled by `compensate/active_model`. Pure.

It corrects any nominal controller whose command is an acceleration. What that controller already cancels on its own
(`Command.f_cancelled_m_s2`: an observer's estimate, an integral) is given back first, so that the disturbance is cancelled once;
`published` says how much was given back. Where authority is taken away the controller's own estimate takes over, as far as the
bounds allow (an integral that was given back for long has wound up).

The bounds are guaranteed while the stated noise and rate bounds hold; the flag says when the data contradict them. They belong to
a vehicle (`[bounds]` of its airframe file) and come from its calibration log.

It stands beside the pipeline because it composes two stages, which do not know each other.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Literal, NamedTuple

import numpy as np

from mavquad import active_common, linalg, quat
from mavquad.airframe import Airframe, ModelBounds
from mavquad.compensate import active_model
from mavquad.errors import ConfigError
from mavquad.estimate import command_line, quad_error
from mavquad.jit import kernel
from mavquad.signals import NAN3, ZERO3, Applied, Attitude, Command, Demand, Estimate, Imu, Position, Target, Vec3

G_M_S2 = 9.80665
GAP_S = 0.5  # a longer silence, or a clock that goes back: begin again
ECHO_S = 0.3  # an echo older than this says nothing
FOLLOWED_RAD = 0.03  # the autopilot acts on our setpoints where its echo is this close to one of them
STALE_S, STALE_TAU_S = 1.0, 2.0  # without velocity: f fades
SETTLE_TICKS = 400  # in which the half-width of a quiet vehicle is reached
WOUND_UP_M_S2 = 1.0  # how far beyond the bounds a controller's own estimate is believed

PUBLISHED = (
    "f_n", "f_e", "f_d", "f_n_low", "f_e_low", "f_d_low", "f_n_high", "f_e_high", "f_d_high", "f_roll", "f_pitch",
    "half_width", "guarantee", "empty", "inflations", "authority", "given_back_n", "given_back_e", "given_back_d",
    "thrust",  # specific, as the model thinks it acts: what f is measured against
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """0 or -1 where the airframe file says it (bounds, lag) or the link is measured (delay)."""

    mode: Literal["centre", "minmax", "vertex"] = "centre"
    authority: float = 1.0
    ramp_s: float = 2.0
    bound_aware: bool = True  # a lost sensor widens the bounds: then correct gently
    horizontal_max_m_s2: float = 9.0
    vertical_max_m_s2: float = 6.0
    attitude_tau_s: float = 0.0
    thrust_lag_s: float = -1.0
    delay_s: float = -1.0  # from a setpoint sent to the vehicle, the autopilot's own delay not included
    e_velocity_m_s: float = 0.0
    e_attitude_rad: float = 0.0
    e_acceleration_m_s2: float = 0.0
    b_velocity_m_s: float = 0.0
    b_f_m_s2: float = 0.0
    b_attitude_rad: float = 0.0
    b_f_attitude_rad_s: float = 0.0

    def __post_init__(self) -> None:
        active_common.check(self.authority, self.delay_s)


class Gains(NamedTuple):
    model: quad_error.Gains
    correction: active_model.Gains
    mode: str
    authority: float
    bound_aware: bool
    hover_thrust: float
    delay_s: float  # -1: as measured
    own_delay_s: float  # of the autopilot's attitude loop


class State(NamedTuple):
    model: quad_error.State | None  # none until there is an attitude and a velocity
    line: command_line.Line  # roll, pitch, specific thrust as sent
    t_us: int  # of the last step
    active: bool  # a nominal command was there to be corrected
    attitude: Attitude | None
    velocity: Position | None
    echo: Target | None
    followed_us: int  # when an echo last agreed with what was sent
    imu_sum_m_s2: Vec3
    imu_count: int
    imu_us: int  # sum of the stamps
    authority: float
    cuts: quad_error.Cuts | None  # published bounds of f
    left: float  # authority by the filter's own judgement
    velocity_us: int  # of the newest velocity taken
    f_ned_m_s2: Vec3  # as cancelled
    given_back_m_s2: Vec3


def gains(params: Params, airframe: Airframe) -> Gains:
    """Raises ConfigError for a helicopter, mode `vertex` and impossible bounds."""
    if airframe.kind != "quadrotor":
        raise ConfigError(f"asmf: {airframe.name} is a {airframe.kind}; this compensator models a quadrotor's attitude loop")
    own = {f.name: getattr(params, f.name) for f in fields(Params) if f.name[:2] in ("e_", "b_")}
    bounds = ModelBounds(
        **{name: value or getattr(airframe.bounds, name) for name, value in own.items()}, tick_s=airframe.bounds.tick_s
    )
    tau_s = params.attitude_tau_s or airframe.attitude.lag_s
    lag_s = params.thrust_lag_s if params.thrust_lag_s >= 0.0 else (airframe.rotors.lag_s if airframe.rotors else 0.0)
    model = quad_error.gains(quad_error.Params(bounds=bounds, attitude_tau_s=tau_s, thrust_lag_s=lag_s))
    correction = active_model.Params(
        mode=params.mode,
        horizontal_max_m_s2=params.horizontal_max_m_s2,
        vertical_max_m_s2=params.vertical_max_m_s2,
        attitude_tau_s=tau_s,
        ramp_s=params.ramp_s,
        half_width_m_s2=quiet_half_width(model) if params.bound_aware else math.inf,
    )
    return Gains(
        model,
        active_model.gains(correction, in_flight=True),
        params.mode,
        params.authority,
        params.bound_aware,
        airframe.hover_thrust,
        params.delay_s,
        airframe.attitude.delay_s,
    )


def init(gains: Gains) -> State:
    """Nothing heard, nothing sent."""
    return State(
        None,
        command_line.init(np.array([0.0, 0.0, G_M_S2])),
        0, False, None, None, None, -(1 << 62), ZERO3, 0, 0, 0.0, None, 0.0, 0, ZERO3, ZERO3,
    )  # fmt: skip


def uses(gains: Gains) -> tuple[str, ...]:
    """The kinds of samples that `observe` takes."""
    return ("Attitude", "Position", "Imu", "Target")


def observe(gains: Gains, state: State, sample: object) -> State:
    """Keep what arrived until the next step; what is not finite is dropped."""
    if isinstance(sample, Imu):
        if not active_common.finite(sample.accel_m_s2):
            return state
        total = linalg.add(state.imu_sum_m_s2, sample.accel_m_s2)
        return state._replace(imu_sum_m_s2=total, imu_count=state.imu_count + 1, imu_us=state.imu_us + sample.t_us)
    if isinstance(sample, Attitude):
        return state._replace(attitude=sample) if active_common.finite(sample.q_wxyz) else state
    if isinstance(sample, Position):
        return state._replace(velocity=sample) if active_common.finite(sample.v_ned_m_s) else state
    if isinstance(sample, Target):
        if not (active_common.finite(sample.q_wxyz) and math.isfinite(sample.thrust)):
            return state
        return state._replace(echo=sample, followed_us=sample.t_us if _followed(state, sample) else state.followed_us)
    return state


def step(
    gains: Gains,
    state: State,
    estimate: Estimate,
    nominal: Command,
    applied: Applied,
    t_us: int,
    demand_at: Callable[[int], Demand] | None = None,
) -> tuple[State, Command]:
    """One control tick: the model error up to t_us, and the nominal command corrected by it."""
    active = active_common.finite(nominal.a_ned_m_s2)
    if state.attitude is None or state.velocity is None:
        return state._replace(t_us=t_us, active=active, authority=0.0), nominal
    roll, pitch, _ = quat.to_euler(applied.q_wxyz)
    if active_common.finite(applied.q_wxyz) and math.isfinite(applied.thrust_m_s2):
        sent = np.array([roll, pitch, applied.thrust_m_s2])
        state = state._replace(line=command_line.push(state.line, state.t_us, sent))
    dt_s = 1e-6 * (t_us - state.t_us)
    begin = state.model is None or not 0.0 < dt_s <= GAP_S or (active and not state.active)
    command = _acting(gains, state, applied, t_us, dt_s)
    if begin:
        attitude = quat.to_euler(state.attitude.q_wxyz)
        model = quad_error.init(gains.model, state.velocity.v_ned_m_s, attitude, command[2])
        state = state._replace(model=model, authority=0.0, velocity_us=t_us, cuts=quad_error.bounds(model), left=1.0)
    else:
        state = _estimate(gains, state, command, t_us, dt_s)
    state = state._replace(t_us=t_us, active=active, imu_sum_m_s2=ZERO3, imu_count=0, imu_us=0)
    if not active:
        return state._replace(authority=0.0, given_back_m_s2=ZERO3), nominal
    return _correct(gains, state, nominal, t_us, 0.0 if begin else dt_s)


def published(state: State) -> tuple[float, ...]:
    """What is shown, named by PUBLISHED. NaN before there is an estimate."""
    if state.model is None or state.cuts is None:
        return (math.nan,) * 12 + (0.0,) * 3 + (state.authority, *state.given_back_m_s2, math.nan)
    inner = state.model.filter
    n, e, d = state.cuts
    x = inner.x
    return (
        float(x[3]), float(x[4]), float(x[5]), n.low, e.low, d.low, n.high, e.high, d.high, float(x[8]), float(x[9]),
        _half_width(state.model), 1.0 if inner.guarantee and n.consistent and e.consistent and d.consistent else 0.0,
        float(inner.empty), float(inner.inflations), state.authority, *state.given_back_m_s2, state.model.thrust_m_s2,
    )  # fmt: skip


def quiet_half_width(model: quad_error.Gains) -> float:
    """The ellipsoid's half-width of f [m/s^2] where everything arrives and nothing happens: what wide is measured against."""
    state = quad_error.init(model, ZERO3, ZERO3, G_M_S2)
    measured = quad_error.Measured(ZERO3, ZERO3, (0.0, 0.0, -G_M_S2), 0.0, 0.0, 0.0)
    for k in range(SETTLE_TICKS):
        state = quad_error.step(model, state, (0.0, 0.0, G_M_S2), measured, model.tick_s, round(1e6 * k * model.tick_s))
    return _half_width(state)


def _half_width(model: quad_error.State) -> float:
    p = model.filter.p
    return math.sqrt(max(float(p[3, 3]), float(p[4, 4]), float(p[5, 5]), 0.0))


def _followed(state: State, echo: Target) -> bool:
    roll, pitch, _ = quat.to_euler(echo.q_wxyz)
    for i in range(state.line.t_us.shape[0]):
        if not 0 <= echo.t_us - state.line.t_us[i] <= 1e6 * ECHO_S:
            continue
        if abs(roll - state.line.value[i, 0]) < FOLLOWED_RAD and abs(pitch - state.line.value[i, 1]) < FOLLOWED_RAD:
            return True
    return False


def _acting(gains: Gains, state: State, applied: Applied, t_us: int, dt_s: float) -> Vec3:
    """(roll, pitch, specific thrust) that the vehicle acted on since the last step: ours, or the autopilot's own target."""
    echo = state.echo
    fresh = echo is not None and 0.0 <= 1e-6 * (t_us - echo.t_us) <= ECHO_S
    if echo is not None and fresh and t_us - state.followed_us > 1e6 * ECHO_S:
        roll, pitch, _ = quat.to_euler(echo.q_wxyz)
        return (roll, pitch, G_M_S2 * echo.thrust / gains.hover_thrust)
    delay_s = gains.delay_s if gains.delay_s >= 0.0 else active_common.measured_delay_s(applied)
    middle_us = t_us - round(1e6 * (0.5 * dt_s + delay_s))
    thrust = state.line.value[command_line.index_at(state.line, middle_us), 2]
    tilt = state.line.value[command_line.index_at(state.line, middle_us - round(1e6 * gains.own_delay_s))]
    return (float(tilt[0]), float(tilt[1]), float(thrust))


def _estimate(gains: Gains, state: State, command: Vec3, t_us: int, dt_s: float) -> State:
    """The model error at t_us from what arrived since the last step."""
    attitude, velocity, model = state.attitude, state.velocity, state.model
    assert attitude is not None
    assert velocity is not None
    assert model is not None
    new_attitude = attitude.t_us > state.t_us
    new_velocity = velocity.t_us > state.velocity_us
    accel, accel_us = NAN3, t_us
    if state.imu_count:
        accel, accel_us = linalg.scale(1.0 / state.imu_count, state.imu_sum_m_s2), state.imu_us // state.imu_count
    measured = quad_error.Measured(
        quat.to_euler(attitude.q_wxyz) if new_attitude else NAN3,
        velocity.v_ned_m_s if new_velocity else NAN3,
        accel,
        max(0.0, 1e-6 * (t_us - attitude.t_us)),
        max(0.0, 1e-6 * (t_us - velocity.t_us)),
        max(0.0, 1e-6 * (t_us - accel_us)),
    )
    model, cuts, left = quad_error.judged_step(gains.model, model, command, measured, dt_s, t_us)
    velocity_us = velocity.t_us if new_velocity else state.velocity_us
    return state._replace(model=model, cuts=cuts, left=left, velocity_us=velocity_us)


def _correct(gains: Gains, state: State, nominal: Command, t_us: int, dt_s: float) -> tuple[State, Command]:
    model = state.model
    assert model is not None
    x = model.filter.x
    f: Vec3 = (float(x[3]), float(x[4]), float(x[5]))
    cuts = state.cuts
    assert cuts is not None
    if gains.mode == "minmax":
        f = (0.5 * (cuts[0].low + cuts[0].high), 0.5 * (cuts[1].low + cuts[1].high), 0.5 * (cuts[2].low + cuts[2].high))
    stale_s = 1e-6 * (t_us - state.velocity_us) - STALE_S
    if stale_s > 0.0:
        f = linalg.scale(math.exp(-dt_s / STALE_TAU_S), state.f_ned_m_s2)
    own = nominal.f_cancelled_m_s2 if active_common.finite(nominal.f_cancelled_m_s2) else ZERO3
    authority, a, given_back, cancelled = _share(
        gains.correction, state.authority, gains.authority * state.left, _half_width(model), dt_s,
        nominal.a_ned_m_s2, nominal.yaw_rad, own, cuts, f, (float(x[8]), float(x[9])),
    )  # fmt: skip
    state = state._replace(authority=authority, f_ned_m_s2=f, given_back_m_s2=given_back)
    return state, nominal._replace(a_ned_m_s2=a, f_cancelled_m_s2=cancelled)


@kernel
def _share(correction, before, wanted, half_width, dt_s, nominal, yaw_rad, own, cuts, f, f_attitude):
    """(authority, acceleration to command, given back, cancelled): the controller's own estimate takes what authority leaves."""
    wanted *= active_model.gain_of_bounds(correction, half_width)
    authority = active_model.ramped(correction, before, wanted, dt_s)
    rest, most = 1.0 - authority, WOUND_UP_M_S2
    believed = (
        rest * linalg.clip(own[0], cuts[0].low - most, cuts[0].high + most),
        rest * linalg.clip(own[1], cuts[1].low - most, cuts[1].high + most),
        rest * linalg.clip(own[2], cuts[2].low - most, cuts[2].high + most),
    )
    given_back = linalg.sub(own, believed)
    a = active_model.correct(correction, linalg.add(nominal, given_back), yaw_rad, f, f_attitude, authority)
    return authority, a, given_back, linalg.axpy(authority, f, believed)
