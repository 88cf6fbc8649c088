"""The MPC over MAVLink: the attitude response as a state, the delay predicted through, the path's jerk and drag fed forward.

Per axis the states are p, v and the thrust acceleration a, with a' = (u - a)/tau after a pure delay; u is what is sent. The
commands under way are predicted through, the reference is read where the prediction ends, and u = u_path - K e with u_path =
a_path + tau a_path'. Unconstrained this is the MPC of `prediction.py` with its DARE terminal weight; with `constrained` a QP takes
over where that would break a limit (`constrained.py`). Source: Yang, Lyu, Chai 2022, and measurements on a real autopilot.

Deviations from the paper:
  input      an acceleration of the thrust vector; the autopilot closes the attitude loop.
  model      the attitude response belongs to the plant: without it the gain must be a third.
  drag       the airframe's drag along the path is fed forward, what the observer saw of it is not cancelled again.
  integral   slow, on the position error: it removes what telemetry's inconsistency leaves.
  rates      on request the turning rate of the commanded attitude goes along, which halves the autopilot's lag.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mavquad import quat
from mavquad.airframe import Airframe
from mavquad.control import prediction
from mavquad.errors import ConfigError
from mavquad.jit import kernel
from mavquad.signals import NAN3, ZERO3, Command, Demand, Estimate, Quat, Vec3

G_M_S2 = 9.80665
QUEUE = 64  # commands remembered
_RATE_FILTER_S = 0.04


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """Weights on position, velocity, acceleration and input; the rest switches parts on and off. < 0: from the airframe."""

    q_position: float = 4.0
    q_velocity: float = 0.5
    r_input: float = 0.03
    lag_s: float = -1.0  # of the attitude behind its setpoint, beyond the delay
    delay_s: float = -1.0  # of the attitude, beyond the measured delay of the link
    predict: bool = True
    jerk_feed_forward: float = 1.0
    drag_feed_forward: float = 1.0
    compensate: bool = True
    integral_1_s3: float = 2.0
    rates: bool = False
    tilt_max_deg: float = 35.0
    f_max_m_s2: float = 8.0
    delay_max_s: float = 0.4  # a longer total delay is not predicted through: the gains are lowered instead

    def __post_init__(self) -> None:
        for name in ("q_position", "r_input", "f_max_m_s2", "delay_max_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"eskf-mpc.{name} must be a finite number > 0, got {value}")
        for name in ("q_velocity", "jerk_feed_forward", "drag_feed_forward", "integral_1_s3"):
            value = getattr(self, name)
            if not 0.0 <= value < 100.0:
                raise ConfigError(f"eskf-mpc.{name} must lie in 0..100, got {value}")
        if not 5.0 <= self.tilt_max_deg <= 60.0:
            raise ConfigError(f"eskf-mpc.tilt_max_deg = {self.tilt_max_deg}: expected 5 to 60")
        if not (self.lag_s <= 1.0 and self.delay_s <= 1.0 and self.delay_max_s <= 0.6):
            raise ConfigError(
                f"eskf-mpc: lag_s = {self.lag_s}, delay_s = {self.delay_s}, delay_max_s = {self.delay_max_s}:"
                " expected at most 1, 1 and 0.6 s"
            )


class Gains(NamedTuple):
    k: Vec3  # horizontal: on position, velocity, acceleration
    k_down: Vec3
    k_soft: Vec3  # for a delay beyond what is predicted
    lag_s: float
    lag_down_s: float
    delay_s: float
    predict: bool
    jerk: float
    compensate: float  # 0 or 1
    drag_linear_1_s: Vec3
    drag_quadratic_1_m: Vec3
    drag: float
    integral: float
    rates: bool
    tan_tilt: float
    down_min_m_s2: float
    down_max_m_s2: float
    f_max: float
    delay_max_s: float


class State(NamedTuple):
    """queue (QUEUE, 4): vehicle time [s] and command, oldest first; axis integrals; filtered thrust direction."""

    queue: np.ndarray
    integral_m_s: Vec3
    axis: Vec3  # NaN before the first command


def response(airframe: Airframe, lag_s: float, delay_s: float) -> tuple[float, float]:
    """(lag, delay) of a first-order response with the mean delay and spread of the airframe's second-order one."""
    a = airframe.attitude
    mean = 2.0 * a.damping / a.natural_frequency_rad_s
    spread = math.sqrt(max(mean * mean - 2.0 / a.natural_frequency_rad_s**2, (0.4 * mean) ** 2))
    return (lag_s if lag_s >= 0.0 else spread), (delay_s if delay_s >= 0.0 else a.delay_s + mean - spread)


def lqr(lag_s: float, weights: tuple[float, float, float], r_input: float) -> Vec3:
    """The continuous-time gain on (p, v, a), to a part in a thousand: a step of 1 ms."""
    k = prediction.lqr(prediction.lagged_model(0.001, max(lag_s, 0.002)), np.array(weights), r_input)
    return (float(k[0]), float(k[1]), float(k[2]))


def gains(params: Params, airframe: Airframe) -> Gains:
    lag_s, delay_s = response(airframe, params.lag_s, params.delay_s)
    lag_down_s = airframe.rotors.lag_s if airframe.rotors else lag_s
    weights = (params.q_position, params.q_velocity, 0.0)
    linear, quadratic, m = airframe.drag.linear_n_s_m, airframe.drag.quadratic_n_s2_m2, airframe.body.mass_kg
    return Gains(
        k=lqr(lag_s, weights, params.r_input),
        k_down=lqr(lag_down_s, weights, params.r_input),
        k_soft=lqr(lag_s, weights, 30.0 * params.r_input),
        lag_s=max(lag_s, 0.002),
        lag_down_s=max(lag_down_s, 0.002),
        delay_s=delay_s,
        predict=params.predict,
        jerk=params.jerk_feed_forward,
        compensate=1.0 if params.compensate else 0.0,
        drag_linear_1_s=(linear[0] / m, linear[1] / m, linear[2] / m),
        drag_quadratic_1_m=(quadratic[0] / m, quadratic[1] / m, quadratic[2] / m),
        drag=params.drag_feed_forward,
        integral=params.integral_1_s3,
        rates=params.rates,
        tan_tilt=math.tan(math.radians(params.tilt_max_deg)),
        down_min_m_s2=0.25 * G_M_S2,
        down_max_m_s2=1.7 * G_M_S2,
        f_max=params.f_max_m_s2,
        delay_max_s=params.delay_max_s,
    )


def init(gains: Gains) -> State:
    queue = np.zeros((QUEUE, 4))
    queue[:, 0] = -1e9
    return State(queue, ZERO3, NAN3)


@kernel
def drag_along(linear: Vec3, quadratic: Vec3, v: Vec3, a: Vec3) -> tuple[Vec3, Vec3]:
    """Acceleration by drag at the velocity v, and its rate of change under the acceleration a."""
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    along = (v[0] * a[0] + v[1] * a[1] + v[2] * a[2]) / speed if speed > 1e-6 else 0.0
    c0, c1, c2 = linear[0] + quadratic[0] * speed, linear[1] + quadratic[1] * speed, linear[2] + quadratic[2] * speed
    d = (-c0 * v[0], -c1 * v[1], -c2 * v[2])
    rate = (
        -c0 * a[0] - quadratic[0] * along * v[0],
        -c1 * a[1] - quadratic[1] * along * v[1],
        -c2 * a[2] - quadratic[2] * along * v[2],
    )
    return d, rate


@kernel
def ahead(
    g: Gains, p: Vec3, v: Vec3, a: Vec3, rest: Vec3, queue: np.ndarray, now_s: float, delay_s: float
) -> tuple[Vec3, Vec3, Vec3]:
    """(p, v, a) after delay_s: each command acts delay_s after its stamp, the acceleration follows it with the lag.

    rest: disturbance beyond the airframe's drag, constant on the way. Exact between the instants at which commands take over,
    but for the drag, which is taken at the beginning of each piece.
    """
    last = len(queue) - 1
    i = last
    while i > 0 and queue[i, 0] > now_s - delay_s:
        i -= 1
    at = 0.0  # seconds from now
    while at < delay_s:
        until = delay_s
        if i < last:
            until = min(delay_s, queue[i + 1, 0] + delay_s - now_s)
        h = until - at
        if h > 0.0:
            d, _ = drag_along(g.drag_linear_1_s, g.drag_quadratic_1_m, v, (0.0, 0.0, 0.0))
            eh, ed = math.exp(-h / g.lag_s), math.exp(-h / g.lag_down_s)
            u = (a[0], a[1], a[2])
            if queue[i, 0] > -1e8:
                u = (queue[i, 1], queue[i, 2], queue[i, 3])
            pn, vn, an = _piece(p[0], v[0], a[0], u[0], d[0] + rest[0], h, g.lag_s, eh)
            pe, ve, ae = _piece(p[1], v[1], a[1], u[1], d[1] + rest[1], h, g.lag_s, eh)
            pd, vd, ad = _piece(p[2], v[2], a[2], u[2], d[2] + rest[2], h, g.lag_down_s, ed)
            p, v, a = (pn, pe, pd), (vn, ve, vd), (an, ae, ad)
        at = until
        if i < last:
            i += 1
        elif at < delay_s:
            break
    return p, v, a


@kernel
def _piece(p, v, a, u, f, h, lag_s, keep):
    """p, v, a after h of constant u and f: v' = a + f, a' = (u - a)/lag; keep = exp(-h/lag)."""
    gap = a - u
    fall = lag_s * (1.0 - keep)  # integral of exp(-t/lag)
    return (
        p + h * v + 0.5 * h * h * (u + f) + gap * lag_s * (h - fall),
        v + h * (u + f) + gap * fall,
        u + keep * gap,
    )


@kernel
def limited(g: Gains, u: Vec3) -> Vec3:
    """Vertical first, then the horizontal part into the cone: the acceleration of a thrust vector that the vehicle may have."""
    down = min(g.down_max_m_s2, max(g.down_min_m_s2, G_M_S2 - u[2]))
    north, east = u[0], u[1]
    size, most = math.sqrt(north * north + east * east), down * g.tan_tilt
    if size > most:
        north, east = north * most / size, east * most / size
    return (north, east, G_M_S2 - down)


@kernel
def law(
    g: Gains, k: Vec3, p: Vec3, v: Vec3, a: Vec3, rest: Vec3, integral: Vec3, p_ref: Vec3, v_ref: Vec3, a_ref: Vec3, j_ref: Vec3
) -> tuple[Vec3, Vec3]:
    """(command, path part of the command, position error), thrust accelerations NED."""
    d, d_rate = drag_along(g.drag_linear_1_s, g.drag_quadratic_1_m, v_ref, a_ref)
    d_now, _ = drag_along(g.drag_linear_1_s, g.drag_quadratic_1_m, v, a_ref)
    u = (0.0, 0.0, 0.0)
    path = (0.0, 0.0, 0.0)
    for i in range(3):
        lag = g.lag_down_s if i == 2 else g.lag_s
        # feed-forward of drag along the path (1), or cancelling what is felt now (0)
        air = g.drag * d[i] + (1.0 - g.drag) * g.compensate * d_now[i]
        wanted = a_ref[i] - air - g.compensate * rest[i]
        forward = wanted + g.jerk * lag * (j_ref[i] - g.drag * d_rate[i])
        gain = g.k_down if i == 2 else k
        x = forward - gain[0] * (p[i] - p_ref[i]) - gain[1] * (v[i] - v_ref[i]) - gain[2] * (a[i] - wanted)
        x -= g.integral * integral[i]
        if i == 0:
            u, path = (x, u[1], u[2]), (forward, path[1], path[2])
        elif i == 1:
            u, path = (u[0], x, u[2]), (path[0], forward, path[2])
        else:
            u, path = (u[0], u[1], x), (path[0], path[1], forward)
    return u, path


@kernel
def grown(integral: Vec3, e: Vec3, wanted: Vec3, given: Vec3, dt_s: float) -> Vec3:
    """The integral of the position error [m s], frozen on an axis that is cut and would be driven further, clamped."""
    out = (0.0, 0.0, 0.0)
    for i in range(3):
        x = integral[i]
        if not (abs(wanted[i] - given[i]) > 1e-9 and e[i] * (wanted[i] - given[i]) < 0.0):
            x = min(2.0, max(-2.0, x + dt_s * e[i]))
        if i == 0:
            out = (x, out[1], out[2])
        elif i == 1:
            out = (out[0], x, out[2])
        else:
            out = (out[0], out[1], x)
    return out


@kernel
def turning(a: Vec3, axis: Vec3, yaw_rad: float, yaw_rate_rad_s: float, dt_s: float) -> tuple[Vec3, Vec3]:
    """(filtered axis, body rates): how fast the thrust axis of the command turns, through a 40 ms filter."""
    x, y, z = -a[0], -a[1], G_M_S2 - a[2]
    size = math.sqrt(x * x + y * y + z * z)
    n = (x / size, y / size, z / size)
    if not math.isfinite(axis[0]):
        axis = n
    keep = math.exp(-dt_s / _RATE_FILTER_S)
    new = (n[0] + keep * (axis[0] - n[0]), n[1] + keep * (axis[1] - n[1]), n[2] + keep * (axis[2] - n[2]))
    dx, dy, dz = (new[0] - axis[0]) / dt_s, (new[1] - axis[1]) / dt_s, (new[2] - axis[2]) / dt_s
    # world rate n x n', plus the heading's
    wx, wy, wz = n[1] * dz - n[2] * dy, n[2] * dx - n[0] * dz, n[0] * dy - n[1] * dx + yaw_rate_rad_s
    # body axes: z along n, x in the vertical plane of the heading
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    bx, by, bz = cy * n[2], sy * n[2], -(cy * n[0] + sy * n[1])
    size = math.sqrt(bx * bx + by * by + bz * bz)
    bx, by, bz = bx / size, by / size, bz / size
    ex, ey, ez = n[1] * bz - n[2] * by, n[2] * bx - n[0] * bz, n[0] * by - n[1] * bx
    return new, (wx * bx + wy * by + wz * bz, wx * ex + wy * ey + wz * ez, wx * n[0] + wy * n[1] + wz * n[2])


@kernel
def thrust_acceleration(q: Quat, thrust_m_s2: float) -> Vec3:
    """g e3 - T R e3."""
    up = quat.rotate(q, (0.0, 0.0, thrust_m_s2))
    return (-up[0], -up[1], G_M_S2 - up[2])


def step(
    gains: Gains, state: State, estimate: Estimate, demand: Demand, preview: Callable[[int], Demand], dt_s: float
) -> tuple[State, Command]:
    """One control step."""
    p, v, f = estimate.p_ned_m, estimate.v_ned_m_s, estimate.f_ned_m_s2
    now_s = 1e-6 * estimate.t_us
    delay_s, k = _delay(gains, estimate)
    thrust = estimate.thrust_m_s2 if math.isfinite(estimate.thrust_m_s2) else G_M_S2
    a = thrust_acceleration(estimate.q_wxyz, thrust)
    rest = _rest(gains, f, v)
    if delay_s > 0.0:
        p, v, a = ahead(gains, p, v, a, rest, state.queue, now_s, delay_s)
        demand = preview(estimate.t_us + round(1e6 * delay_s))
    ref = (demand.p_ned_m, demand.v_ned_m_s, demand.a_ned_m_s2, demand.j_ned_m_s3)
    wanted, _ = law(gains, k, p, v, a, rest, state.integral_m_s, *ref)
    command = limited(gains, wanted)
    e = (p[0] - ref[0][0], p[1] - ref[0][1], p[2] - ref[0][2])
    integral = state.integral_m_s
    if gains.integral > 0.0:
        integral = grown(integral, e, wanted, command, dt_s)
    queue = np.empty_like(state.queue)
    queue[:-1] = state.queue[1:]
    queue[-1] = now_s, *command
    omega, axis = NAN3, state.axis
    if gains.rates:
        axis, omega = turning(command, axis, demand.yaw_rad, demand.yaw_rate_rad_s, max(dt_s, 1e-3))
    c = gains.compensate
    cancelled = (c * f[0], c * f[1], c * f[2]) if math.isfinite(f[0]) else ZERO3
    return State(queue, integral, axis), Command(command, demand.yaw_rad, demand.yaw_rate_rad_s, omega, cancelled)


def _delay(gains: Gains, estimate: Estimate) -> tuple[float, Vec3]:
    """The delay to predict through and the gain to fly with: a delay out of range is not predicted, but flown gently."""
    if not gains.predict:
        return 0.0, gains.k
    total = gains.delay_s + (estimate.delay_s if math.isfinite(estimate.delay_s) else 0.0)
    if not 0.0 <= total <= gains.delay_max_s:
        return min(gains.delay_max_s, max(0.0, total)), gains.k_soft
    return total, gains.k


def _rest(gains: Gains, f: Vec3, v: Vec3) -> Vec3:
    """The disturbance beyond the airframe's own drag, clipped."""
    if not (math.isfinite(f[0]) and math.isfinite(f[1]) and math.isfinite(f[2])):
        return ZERO3
    d, _ = drag_along(gains.drag_linear_1_s, gains.drag_quadratic_1_m, v, ZERO3)
    m = gains.f_max
    return (min(m, max(-m, f[0] - d[0])), min(m, max(-m, f[1] - d[1])), min(m, max(-m, f[2] - d[2])))
