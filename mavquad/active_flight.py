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

from mavquad import active_common, active_tick, flat
from mavquad.airframe import Airframe, ModelBounds
from mavquad.compensate import active_model
from mavquad.errors import ConfigError
from mavquad.estimate import quad_error
from mavquad.signals import ZERO3, Applied, Attitude, Command, Demand, Estimate, Imu, Position, Target, Vec3

_NEVER_US = -(1 << 62)
_NO_ECHO = (_NEVER_US, (1.0, 0.0, 0.0, 0.0), 0.0)
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
    hover_thrust: float
    delay_s: float  # -1: as measured
    own_delay_s: float  # of the autopilot's attitude loop
    flat: np.ndarray  # (1,) the model, for the kernel


class State(NamedTuple):
    """What arrived since the last step, and the record of `active_tick`."""

    record: np.ndarray  # its bytes
    attitude: Attitude | None
    velocity: Position | None
    echo: Target | None
    followed_us: int  # when an echo last agreed with what was sent
    imu_sum_m_s2: Vec3
    imu_count: int
    imu_us: int  # sum of the stamps


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
    record = flat.of(model)
    correction = active_model.Params(
        mode=params.mode,
        horizontal_max_m_s2=params.horizontal_max_m_s2,
        vertical_max_m_s2=params.vertical_max_m_s2,
        attitude_tau_s=tau_s,
        ramp_s=params.ramp_s,
        half_width_m_s2=active_tick.quiet_half_width(record) if params.bound_aware else math.inf,
    )
    return Gains(
        model,
        active_model.gains(correction, in_flight=True),
        params.mode,
        params.authority,
        airframe.hover_thrust,
        params.delay_s,
        airframe.attitude.delay_s,
        record,
    )


def init(gains: Gains) -> State:
    """Nothing heard, nothing sent."""
    return State(active_tick.start(), None, None, None, _NEVER_US, ZERO3, 0, 0)


def uses(gains: Gains) -> tuple[str, ...]:
    """The kinds of samples that `observe` takes."""
    return ("Attitude", "Position", "Imu", "Target")


def observe(gains: Gains, state: State, sample: object) -> State:
    """Keep what arrived until the next step; what is not finite is dropped."""
    record, attitude, velocity, echo, followed_us, imu_sum, imu_count, imu_us = state
    if isinstance(sample, Imu):
        a = sample.accel_m_s2
        if not active_common.finite(a):
            return state
        imu_sum = (imu_sum[0] + a[0], imu_sum[1] + a[1], imu_sum[2] + a[2])
        return State(record, attitude, velocity, echo, followed_us, imu_sum, imu_count + 1, imu_us + sample.t_us)
    if isinstance(sample, Attitude) and active_common.finite(sample.q_wxyz):
        return State(record, sample, velocity, echo, followed_us, imu_sum, imu_count, imu_us)
    if isinstance(sample, Position) and active_common.finite(sample.v_ned_m_s):
        return State(record, attitude, sample, echo, followed_us, imu_sum, imu_count, imu_us)
    if isinstance(sample, Target) and active_common.finite(sample.q_wxyz) and math.isfinite(sample.thrust):
        if active_tick.followed(record, sample.t_us, sample.q_wxyz):
            followed_us = sample.t_us
        return State(record, attitude, velocity, sample, followed_us, imu_sum, imu_count, imu_us)
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
    record, attitude, velocity, echo, followed_us, imu_sum, imu_count, imu_us = state
    active = active_common.finite(nominal.a_ned_m_s2)
    if attitude is None or velocity is None:
        return state._replace(record=active_tick.blind(record, t_us, active)), nominal
    told = (echo.t_us, echo.q_wxyz, echo.thrust) if echo is not None else _NO_ECHO
    record, a, cancelled = active_tick.tick(
        gains.flat,
        gains.correction,
        (gains.authority, 1.0 if gains.mode == "minmax" else 0.0, gains.hover_thrust, gains.delay_s, gains.own_delay_s),
        record,
        t_us,
        active,
        (applied.q_wxyz, applied.thrust_m_s2, applied.delay_s),
        (attitude.t_us, attitude.q_wxyz, velocity.t_us, velocity.v_ned_m_s, *told, followed_us, imu_sum, imu_count, imu_us),
        (nominal.a_ned_m_s2, nominal.yaw_rad, nominal.f_cancelled_m_s2),
    )
    state = State(record, attitude, velocity, echo, followed_us, ZERO3, 0, 0)
    if not active:
        return state, nominal
    return state, Command(a, nominal.yaw_rad, nominal.yaw_rate_rad_s, nominal.omega_rad_s, cancelled, nominal.sticks)


def published(state: State) -> tuple[float, ...]:
    """What is shown, named by PUBLISHED. NaN before there is an estimate."""
    return tuple(state.record.view(active_tick.RECORD)["shown"][0].tolist())
