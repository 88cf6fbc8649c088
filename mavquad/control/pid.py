"""PID with feed-forward of the path's acceleration and of the airframe's own drag: the honest everyday rival.

a = a_ref + drag(v_ref) + kp e_p + kd e_v + ki int(e_p), critically damped at wc = a third of the attitude loop's bandwidth.
`pd.py` is the same law without the integral. Anti-windup: the integral stands still while the demand is beyond what the vehicle
may do, and is bounded.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from mavquad.airframe import Airframe
from mavquad.errors import ConfigError
from mavquad.jit import kernel
from mavquad.linalg import clip
from mavquad.signals import NAN3, ZERO3, Command, Demand, Estimate, Vec3


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """wc = 0: from the airframe's attitude response."""

    wc_rad_s: float = 0.0
    damping: float = 1.0
    integral: float = 0.35  # ki = integral wc^3 (0: a PD)
    drag_feed_forward: float = 1.0  # share of the airframe file's drag along the path that is fed forward
    accel_max_m_s2: float = 8.0  # 39 degrees, below the gate's 40: less is lost upwind
    integral_max_m_s2: float = 4.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.wc_rad_s <= 20.0 or not 0.3 <= self.damping <= 3.0 or not 0.0 <= self.integral < 1.0:
            raise ConfigError(
                f"pid: wc_rad_s = {self.wc_rad_s}, damping = {self.damping}, integral = {self.integral}:"
                " expected 0 to 20 rad/s, 0.3 to 3 and 0 to 1 (1 is the edge of stability)"
            )


class Gains(NamedTuple):
    kp: float
    kd: float
    ki: float
    drag_linear_1_s: Vec3
    drag_quadratic_1_m: Vec3
    accel_max_m_s2: float
    integral_max_m_s2: float


class State(NamedTuple):
    integral_m_s2: Vec3


def bandwidth(airframe: Airframe) -> float:
    """A position bandwidth [rad/s] that leaves the attitude response its phase: a quarter of 1/(lag + delay + 30 ms)."""
    response = airframe.attitude
    return 0.3 / (response.lag_s + response.delay_s + 0.03)


def gains(params: Params, airframe: Airframe) -> Gains:
    wc = params.wc_rad_s or bandwidth(airframe)
    k = params.drag_feed_forward / airframe.body.mass_kg
    linear, quadratic = airframe.drag.linear_n_s_m, airframe.drag.quadratic_n_s2_m2
    return Gains(
        wc * wc,
        2.0 * params.damping * wc,
        params.integral * wc**3,
        (k * linear[0], k * linear[1], k * linear[2]),
        (k * quadratic[0], k * quadratic[1], k * quadratic[2]),
        params.accel_max_m_s2,
        params.integral_max_m_s2,
    )


def init(gains: Gains) -> State:
    return State(ZERO3)


@kernel
def drag_at(gains: Gains, v: Vec3) -> Vec3:
    """The acceleration that keeps the airframe's own drag off at this velocity in still air; NED."""
    d1, d2 = gains.drag_linear_1_s, gains.drag_quadratic_1_m
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return ((d1[0] + d2[0] * speed) * v[0], (d1[1] + d2[1] * speed) * v[1], (d1[2] + d2[2] * speed) * v[2])


@kernel
def law(
    gains: Gains, integral: Vec3, p: Vec3, v: Vec3, p_ref: Vec3, v_ref: Vec3, a_ref: Vec3, dt_s: float
) -> tuple[Vec3, Vec3]:
    """(integral, acceleration), NED."""
    kp, kd, ki, _, _, a_max, i_max = gains
    drag = drag_at(gains, v_ref)
    ex, ey, ez = p_ref[0] - p[0], p_ref[1] - p[1], p_ref[2] - p[2]
    ax = a_ref[0] + drag[0] + kp * ex + kd * (v_ref[0] - v[0]) + integral[0]
    ay = a_ref[1] + drag[1] + kp * ey + kd * (v_ref[1] - v[1]) + integral[1]
    az = a_ref[2] + drag[2] + kp * ez + kd * (v_ref[2] - v[2]) + integral[2]
    size = math.sqrt(ax * ax + ay * ay)
    ix, iy, iz = integral
    if size > a_max:
        ax, ay = ax * a_max / size, ay * a_max / size
        if ex * ax < 0.0:  # only unwinding while the horizontal demand is cut
            ix += ki * dt_s * ex
        if ey * ay < 0.0:
            iy += ki * dt_s * ey
    else:
        ix += ki * dt_s * ex
        iy += ki * dt_s * ey
    if -a_max < az < a_max or ez * az < 0.0:
        iz += ki * dt_s * ez
    az = clip(az, -a_max, a_max)
    return (clip(ix, -i_max, i_max), clip(iy, -i_max, i_max), clip(iz, -i_max, i_max)), (ax, ay, az)


@kernel
def _flown(
    gains: Gains, integral: Vec3, p: Vec3, v: Vec3, p_ref: Vec3, v_ref: Vec3, a_ref: Vec3, dt_s: float
) -> tuple[Vec3, Vec3, Vec3]:
    """`law`, and what it cancels already: the integral and the drag of the present speed. A compensator must not do so again."""
    integral, a = law(gains, integral, p, v, p_ref, v_ref, a_ref, dt_s)
    drag = drag_at(gains, v)
    return integral, a, (-integral[0] - drag[0], -integral[1] - drag[1], -integral[2] - drag[2])


def step(gains: Gains, state: State, estimate: Estimate, demand: Demand, preview: object, dt_s: float) -> tuple[State, Command]:
    """One control step."""
    integral, a, cancelled = _flown(
        gains,
        state.integral_m_s2,
        estimate.p_ned_m,
        estimate.v_ned_m_s,
        demand.p_ned_m,
        demand.v_ned_m_s,
        demand.a_ned_m_s2,
        dt_s,
    )
    return State(integral), Command(a, demand.yaw_rad, demand.yaw_rate_rad_s, NAN3, cancelled)


def track(gains: Gains, state: State, estimate: Estimate, cancelled_m_s2: Vec3) -> State:
    """The integral as it stands for what a compensator cancels in its place: it cannot wind up, and it takes over without a bump."""
    drag, most = drag_at(gains, estimate.v_ned_m_s), gains.integral_max_m_s2
    if gains.ki == 0.0:
        return state
    integral = tuple(clip(-f - d, -most, most) for f, d in zip(cancelled_m_s2, drag, strict=True))
    return State(integral if all(map(math.isfinite, integral)) else state.integral_m_s2)
