"""The MPC over MAVLink: the attitude response as a state, the delay predicted through, the path's jerk and drag fed forward.

Per axis the states are p, v and the thrust acceleration a, with a' = (u - a)/tau after a pure delay; u is what is sent. The
commands under way are predicted through, the reference is read where the prediction ends, and u = u_path - K e with u_path =
a_path + tau a_path'. Where this breaks a limit within the horizon a quadratic program takes over (`constrained.py`); without limits
both are the same law. A program that fails leaves the closed form, cut to the limits, and is counted. Source: Yang, Lyu, Chai 2022, and measurements on a real autopilot.

Deviations from the paper:
  input      an acceleration of the thrust vector; the autopilot closes the attitude loop.
  model      the attitude response belongs to the plant: without it the gain must be a third. Thrust waits for the link only, so
             each axis is predicted over its own delay.
  drag       the airframe's drag along the path is fed forward, what the observer saw of it is not cancelled again.
  integral   slow, on the position error: it removes what telemetry's inconsistency leaves.
  rates      on request the turning rate of the commanded attitude goes along, which halves the autopilot's lag.
"""

import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from mavquad import flat
from mavquad.airframe import Airframe
from mavquad.control import constrained, prediction, qp
from mavquad.control.lagged import (
    G_M_S2,
    Law,
    aimed,
    between,
    closed,
    delays_of,
    limited,
    path_part,
    response,
    sent,
    turning,
)
from mavquad.errors import ConfigError
from mavquad.signals import NAN3, ZERO3, Command, Demand, Estimate, Vec3

QUEUE = 64  # commands remembered
STAGE_S, HORIZON = 0.05, 20
Delays = tuple[float, float, float, bool]  # of `lagged.delays_of`
_KNOT = 5  # stages between two looks at the path, interpolated between


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """Weights on position, velocity, acceleration and input; the rest switches parts on and off. < 0: from the airframe."""

    q_position: float = 4.0
    q_velocity: float = 0.5
    r_input: float = 0.022
    lag_s: float = -1.0  # of the attitude behind its setpoint, beyond the delay
    delay_s: float = -1.0  # of the attitude, beyond the measured delay of the link
    delay_down_s: float = 0.0  # of the thrust, likewise: an autopilot hands it on at once
    predict: bool = True
    jerk_feed_forward: float = 1.0
    drag_feed_forward: float = 1.0
    compensate: bool = True
    integral_1_s3: float = 2.0
    rates: bool = False
    tilt_max_deg: float = 38.0
    slew_m_s3: float = 60.0  # of the commanded acceleration: 60 m/s^3 turn the attitude at 6 rad/s
    constrained: Literal["off", "needed", "always"] = "needed"  # when a program is solved
    max_iter: int = qp.MAX_ITER
    f_max_m_s2: float = 8.0
    delay_max_s: float = 0.4  # a longer total delay is not predicted through: the gains are lowered instead

    def __post_init__(self) -> None:
        for name in ("q_position", "r_input", "f_max_m_s2", "slew_m_s3", "delay_max_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"eskf-mpc.{name} must be a finite number > 0, got {value}")
        for name in ("q_velocity", "jerk_feed_forward", "drag_feed_forward", "integral_1_s3"):
            value = getattr(self, name)
            if not 0.0 <= value < 100.0:
                raise ConfigError(f"eskf-mpc.{name} must lie in 0..100, got {value}")
        if self.constrained not in ("off", "needed", "always") or self.max_iter < 1:
            raise ConfigError(
                f'eskf-mpc.constrained = "{self.constrained}", max_iter = {self.max_iter}:'
                ' expected "off", "needed" or "always", and at least 1'
            )
        if not 5.0 <= self.tilt_max_deg <= 60.0:
            raise ConfigError(f"eskf-mpc.tilt_max_deg = {self.tilt_max_deg}: expected 5 to 60")
        if not (self.lag_s <= 1.0 and self.delay_s <= 1.0 and 0.0 <= self.delay_down_s <= 1.0 and self.delay_max_s <= 0.6):
            raise ConfigError(
                f"eskf-mpc: lag_s = {self.lag_s}, delay_s = {self.delay_s}, delay_down_s = {self.delay_down_s},"
                f" delay_max_s = {self.delay_max_s}: expected at most 1, 1, 1 and 0.6 s"
            )


class Gains(NamedTuple):
    law: Law
    f_max: float
    delay_s: float
    delay_down_s: float
    delay_max_s: float
    predict: bool
    rates: bool
    design: constrained.Design | None
    always: bool
    flat: np.ndarray  # (1,) the law, for the kernels


class State(NamedTuple):
    """queue (QUEUE, 4): when it reaches the vehicle [s] and command, oldest first; integral of the position error; filtered thrust axis."""

    queue: np.ndarray
    integral_m_s: Vec3
    axis: Vec3  # NaN before the first command
    programs: constrained.State | None
    steps: int


def gains(params: Params, airframe: Airframe) -> Gains:
    lag_s, delay_s = response(airframe, params.lag_s, params.delay_s)
    lag_s, lag_down_s = max(lag_s, 0.002), max(airframe.rotors.lag_s if airframe.rotors else lag_s, 0.002)
    model, model_down = (prediction.lagged_model(STAGE_S, lag) for lag in (lag_s, lag_down_s))
    weights, r = np.array([params.q_position, params.q_velocity, 0.0]), params.r_input
    linear, quadratic, m = airframe.drag.linear_n_s_m, airframe.drag.quadratic_n_s2_m2, airframe.body.mass_kg
    law = Law(
        k=_row(prediction.lqr(model, weights, r)),
        k_down=_row(prediction.lqr(model_down, weights, r)),
        k_soft=_row(prediction.lqr(model, weights, 30.0 * r)),
        lag_s=lag_s,
        lag_down_s=lag_down_s,
        jerk=params.jerk_feed_forward,
        compensate=1.0 if params.compensate else 0.0,
        drag_linear_1_s=(linear[0] / m, linear[1] / m, linear[2] / m),
        drag_quadratic_1_m=(quadratic[0] / m, quadratic[1] / m, quadratic[2] / m),
        drag=params.drag_feed_forward,
        integral=params.integral_1_s3,
        tan_tilt=math.tan(math.radians(params.tilt_max_deg)),
        down_min_m_s2=0.25 * G_M_S2,
        down_max_m_s2=1.7 * G_M_S2,
        slew_m_s3=params.slew_m_s3,
    )
    design = None
    if params.constrained != "off":
        design = constrained.design(model, model_down, weights, r, STAGE_S, HORIZON, params.max_iter)
    return Gains(
        law,
        params.f_max_m_s2,
        delay_s,
        params.delay_down_s,
        params.delay_max_s,
        params.predict,
        params.rates,
        design,
        params.constrained == "always",
        flat.of(law),
    )


def _row(k: np.ndarray) -> Vec3:
    return (float(k[0]), float(k[1]), float(k[2]))


def init(gains: Gains) -> State:
    queue = np.zeros((QUEUE, 4))
    queue[:, 0] = -1e9
    return State(queue, ZERO3, NAN3, constrained.init(gains.design) if gains.design else None, 0)


def step(
    gains: Gains, state: State, estimate: Estimate, demand: Demand, preview: Callable[[int], Demand], dt_s: float
) -> tuple[State, Command]:
    """One control step."""
    delays = delays_of(gains.predict, gains.delay_s, gains.delay_down_s, gains.delay_max_s, estimate.delay_s)
    if gains.predict:
        demand = _demand(preview, estimate.t_us, delays)
    now_s, f = 1e-6 * estimate.t_us, estimate.f_ned_m_s2
    at = (estimate.p_ned_m, estimate.v_ned_m_s, estimate.q_wxyz, estimate.thrust_m_s2, f, now_s)
    wanted = (demand.p_ned_m, demand.v_ned_m_s, demand.a_ned_m_s2, demand.j_ned_m_s3)
    queue, integral, programs, begun = state.queue, state.integral_m_s, state.programs, state.steps > 0
    if gains.design is None or programs is None:
        queue, integral, command, cancelled = closed(
            gains.flat, gains.f_max, gains.predict, queue, integral, begun, at, delays, wanted, dt_s
        )
    else:
        g = gains.law
        v, rest, forward, slow, e_p, e_v, e_a, free, last, command = aimed(
            g, gains.f_max, gains.predict, queue, integral, begun, at, delays, wanted, dt_s
        )
        if not delays[3] and math.isfinite(free[0] + free[1] + free[2]):
            path = _horizon(gains, v, rest, forward, preview, estimate.t_us, delays)
            path += slow
            error = np.array([e_p, e_v, e_a]).T.copy()
            limits = constrained.Horizon(
                G_M_S2 - g.down_max_m_s2, G_M_S2 - g.down_min_m_s2, g.tan_tilt, g.slew_m_s3, max(dt_s, 1e-3)
            )
            before = last if begun else command
            programs, move = constrained.solve(gains.design, programs, error, path, before, limits, G_M_S2, gains.always)
            if move.usable:
                command = limited(g, move.u)  # the octagon is drawn around the cone
        queue, integral, cancelled = sent(g, queue, integral, e_p, free, command, f, now_s + delays[0], dt_s)
    omega, axis = NAN3, state.axis
    if gains.rates:
        axis, omega = turning(command, axis, demand.yaw_rad, demand.yaw_rate_rad_s, max(dt_s, 1e-3))
    return (
        State(queue, integral, axis, programs, state.steps + 1),
        Command(command, demand.yaw_rad, demand.yaw_rate_rad_s, omega, cancelled),
    )


def _demand(preview: Callable[[int], Demand], t_us: int, delays: Delays) -> Demand:
    """The path where each axis' prediction ends."""
    _, level_s, down_s, _ = delays
    level = preview(t_us + round(1e6 * level_s))
    if down_s == level_s:
        return level
    down = preview(t_us + round(1e6 * down_s))
    return Demand(
        level.t_us,
        _mixed(level.p_ned_m, down.p_ned_m),
        _mixed(level.v_ned_m_s, down.v_ned_m_s),
        _mixed(level.a_ned_m_s2, down.a_ned_m_s2),
        _mixed(level.j_ned_m_s3, down.j_ned_m_s3),
        level.yaw_rad,
        level.yaw_rate_rad_s,
    )


def _mixed(level: Vec3, down: Vec3) -> Vec3:
    return (level[0], level[1], down[2])


def _horizon(
    gains: Gains, v: Vec3, rest: Vec3, forward: Vec3, preview: Callable[[int], Demand], t_us: int, delays: Delays
) -> np.ndarray:
    """(HORIZON, 3): the path's part of the command at every stage, looked up at some and interpolated between."""
    knots = [forward]
    for j in range(_KNOT, HORIZON + _KNOT, _KNOT):
        d = _demand(preview, t_us + round(1e6 * STAGE_S * j), delays)
        knots.append(path_part(gains.law, v, rest, d.v_ned_m_s, d.a_ned_m_s2, d.j_ned_m_s3)[1])
    return between(np.array(knots), HORIZON, _KNOT)


def diagnostics(state: State) -> dict[str, float]:
    """What the solver did so far, for a summary; times are the solver's own and no part of the flight."""
    programs = state.programs
    if programs is None:
        return {"steps": float(state.steps), "qp_solves": 0.0, "qp_fallbacks": 0.0, "qp_p99_s": math.nan}
    times = programs.seconds
    p99 = statistics.quantiles(times, n=100)[98] if len(times) > 1 else (times[0] if times else math.nan)
    return {
        "steps": float(state.steps),
        "qp_solves": float(programs.solves),
        "qp_fallbacks": float(programs.fallbacks),
        "qp_p99_s": p99,
    }
