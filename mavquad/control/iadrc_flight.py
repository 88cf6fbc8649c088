"""IADRC over MAVLink: the paper's outer loop on the joint observer's estimate, made for an autopilot's attitude lag and a link.

The law is Eq. (31): a_ref + 2 wc (v_ref - v) + wc^2 (p_ref - p) less the estimated disturbance. It is evaluated where the vehicle
will be when the command takes effect: the commands still under way are carried through, the reference is read there, and what the
attitude's lag would swallow is added in advance (quicken times the step still to be made, and the lag's share of the path's jerk).

Deviations from the paper:
  Eq. (31)  delay, attitude lag and the path's acceleration are known; with `predict` off and quicken 1 it is the law as printed.
  drag      the airframe's drag along the path is fed forward; what the observer saw of it is not cancelled again.
  rates     on request the attitude loop is closed here too and body rates are sent; above 20 ms of delay it is not.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mavquad import quat
from mavquad.airframe import Airframe
from mavquad.control.iadrc import position_law
from mavquad.control.lagged import G_M_S2, Vehicle, ahead, drag_along, limited, response, thrust_acceleration
from mavquad.errors import ConfigError
from mavquad.jit import kernel
from mavquad.linalg import axpy, clip, finite3
from mavquad.signals import NAN3, ZERO3, Command, Demand, Estimate, Quat, Vec3

_QUEUE = 64  # commands remembered
RATES_DELAY_S = 0.02  # above this the attitude loop belongs to the autopilot


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """0 or < 0: from the airframe's attitude response."""

    wc_xy_rad_s: float = 0.0
    wc_z_rad_s: float = 0.0
    quicken: float = 1.5  # how much faster than the attitude's own lag the acceleration is to come
    lag_s: float = -1.0  # first-order part of the attitude response
    delay_s: float = -1.0  # its pure delay, beyond the link's
    predict: bool = True
    jerk_feed_forward: float = 1.0
    drag_feed_forward: float = 1.0
    tilt_max_deg: float = 39.0  # below the gate's 40: less is lost upwind
    f_max_m_s2: float = 8.0
    delay_max_s: float = 0.4
    loop: str = "attitude"  # rates: the attitude loop is closed here too, and body rates are sent
    attitude_rad_s: float = 0.0  # its bandwidth

    def __post_init__(self) -> None:
        if not (0.0 <= self.wc_xy_rad_s <= 20.0 and 0.0 <= self.wc_z_rad_s <= 20.0 and 1.0 <= self.quicken <= 4.0):
            raise ConfigError(
                f"iadrc: wc_xy_rad_s = {self.wc_xy_rad_s}, wc_z_rad_s = {self.wc_z_rad_s}, quicken = {self.quicken}:"
                " expected 0 (from the airframe) to 20 rad/s, and 1 to 4"
            )
        if not (self.lag_s <= 1.0 and self.delay_s <= 1.0 and 0.0 < self.delay_max_s <= 0.6):
            raise ConfigError(
                f"iadrc: lag_s = {self.lag_s}, delay_s = {self.delay_s}, delay_max_s = {self.delay_max_s}:"
                " expected at most 1, 1 and 0.6 s"
            )
        if not (0.0 <= self.jerk_feed_forward <= 2.0 and 0.0 <= self.drag_feed_forward <= 2.0):
            raise ConfigError(
                f"iadrc: jerk_feed_forward = {self.jerk_feed_forward}, drag_feed_forward = {self.drag_feed_forward}:"
                " expected 0 to 2"
            )
        if self.loop not in ("attitude", "rates"):
            raise ConfigError(f'iadrc.loop = "{self.loop}": expected attitude or rates')
        if not (5.0 <= self.tilt_max_deg <= 60.0 and 0.0 < self.f_max_m_s2 <= 30.0 and 0.0 <= self.attitude_rad_s <= 40.0):
            raise ConfigError(
                f"iadrc: tilt_max_deg = {self.tilt_max_deg}, f_max_m_s2 = {self.f_max_m_s2}, attitude_rad_s ="
                f" {self.attitude_rad_s}: expected 5 to 60, 0 to 30 and 0 (from the airframe) to 40"
            )


class Gains(NamedTuple):
    wc: Vec3
    quicken: Vec3
    vehicle: Vehicle
    delay_s: float
    predict: bool
    jerk: float
    drag: float
    f_max: float
    delay_max_s: float
    attitude_rad_s: float  # 0: the autopilot's loop


class State(NamedTuple):
    """queue (QUEUE, 4): vehicle time [s] and command, oldest first."""

    queue: np.ndarray


def gains(params: Params, airframe: Airframe) -> Gains:
    """Bandwidths from the attitude response where none are given: wc = 0.3/(lag/quicken + delay/2), vertically from the motors'."""
    lag_s, delay_s = response(airframe, params.lag_s, params.delay_s)
    lag_z = airframe.rotors.lag_s if airframe.rotors else lag_s
    k = 1.0 / airframe.body.mass_kg
    linear, quadratic = airframe.drag.linear_n_s_m, airframe.drag.quadratic_n_s2_m2
    wc_xy = params.wc_xy_rad_s or bandwidth(lag_s, delay_s, params.quicken)
    wc_z = params.wc_z_rad_s or bandwidth(lag_z, delay_s, 1.0)
    return Gains(
        wc=(wc_xy, wc_xy, wc_z),
        quicken=(params.quicken, params.quicken, 1.0),
        vehicle=Vehicle(
            lag_s=max(lag_s, 2e-3),
            lag_down_s=max(lag_z, 2e-3),
            drag_linear_1_s=(k * linear[0], k * linear[1], k * linear[2]),
            drag_quadratic_1_m=(k * quadratic[0], k * quadratic[1], k * quadratic[2]),
            tan_tilt=math.tan(math.radians(params.tilt_max_deg)),
            down_min_m_s2=0.25 * G_M_S2,
            down_max_m_s2=1.7 * G_M_S2,
        ),
        delay_s=delay_s,
        predict=params.predict,
        jerk=params.jerk_feed_forward,
        drag=params.drag_feed_forward,
        f_max=params.f_max_m_s2,
        delay_max_s=params.delay_max_s,
        attitude_rad_s=(params.attitude_rad_s or own_attitude(airframe)) if params.loop == "rates" else 0.0,
    )


def own_attitude(airframe: Airframe) -> float:
    """The attitude gain [1/s] that makes the airframe's response of a rate loop with its natural frequency and damping."""
    return 0.5 * airframe.attitude.natural_frequency_rad_s / airframe.attitude.damping


def bandwidth(lag_s: float, delay_s: float, quicken: float) -> float:
    """What the lag (quickened) and half the predicted delay leave room for [rad/s], 5 at most."""
    return min(5.0, 0.3 / (lag_s / quicken + 0.5 * delay_s + 0.01))


def init(gains: Gains) -> State:
    queue = np.zeros((_QUEUE, 4))
    queue[:, 0] = -1e9
    return State(queue)


@kernel
def law(
    g: Gains, p: Vec3, v: Vec3, a: Vec3, rest: Vec3, p_ref: Vec3, v_ref: Vec3, a_ref: Vec3, j_ref: Vec3
) -> tuple[Vec3, Vec3]:
    """(thrust acceleration g e3 - T R e3 wanted, the disturbance it cancels): Eq. (31), then the lag made up for."""
    x = g.vehicle
    along, along_rate = drag_along(x.drag_linear_1_s, x.drag_quadratic_1_m, v_ref, a_ref)
    felt, _ = drag_along(x.drag_linear_1_s, x.drag_quadratic_1_m, v, a_ref)
    cancelled = axpy(g.drag, along, axpy(1.0 - g.drag, felt, rest))
    wanted = position_law(g.wc, p, v, cancelled, p_ref, v_ref, a_ref)
    k, k_down = g.jerk * x.lag_s, g.jerk * x.lag_down_s
    slope = axpy(-g.drag, along_rate, j_ref)
    return (
        wanted[0] + (g.quicken[0] - 1.0) * (wanted[0] - a[0]) + k * slope[0],
        wanted[1] + (g.quicken[1] - 1.0) * (wanted[1] - a[1]) + k * slope[1],
        wanted[2] + (g.quicken[2] - 1.0) * (wanted[2] - a[2]) + k_down * slope[2],
    ), cancelled


@kernel
def body_rates(q: Quat, a: Vec3, yaw_rad: float, bandwidth_rad_s: float) -> Vec3:
    """Rates [rad/s, body] that turn the attitude q towards the thrust axis of `a` at a heading, proportional to the turn left."""
    z = (-a[0], -a[1], G_M_S2 - a[2])
    up = quat.rotate(q, (0.0, 0.0, 1.0))
    n = math.sqrt(z[0] * z[0] + z[1] * z[1] + z[2] * z[2])
    cross = (
        (up[1] * z[2] - up[2] * z[1]) / n,
        (up[2] * z[0] - up[0] * z[2]) / n,
        (up[0] * z[1] - up[1] * z[0]) / n,
    )
    sine = math.sqrt(cross[0] ** 2 + cross[1] ** 2 + cross[2] ** 2)
    cosine = (up[0] * z[0] + up[1] * z[1] + up[2] * z[2]) / n
    k = math.atan2(sine, cosine) / sine if sine > 1e-9 else 1.0
    turn = quat.rotate_back(q, (k * cross[0], k * cross[1], k * cross[2]))
    left = yaw_rad - quat.yaw(q)
    left -= 2.0 * math.pi * math.floor(left / (2.0 * math.pi) + 0.5)
    b = bandwidth_rad_s
    return (b * turn[0], b * turn[1], 0.4 * b * left + b * turn[2])


def step(
    gains: Gains, state: State, estimate: Estimate, demand: Demand, preview: Callable[[int], Demand], dt_s: float
) -> tuple[State, Command]:
    """One control step."""
    p, v, q = estimate.p_ned_m, estimate.v_ned_m_s, estimate.q_wxyz
    now_s = 1e-6 * estimate.t_us
    f = estimate.f_ned_m_s2 if finite3(estimate.f_ned_m_s2) else ZERO3
    felt, _ = drag_along(gains.vehicle.drag_linear_1_s, gains.vehicle.drag_quadratic_1_m, v, ZERO3)
    most = gains.f_max
    rest = (clip(f[0] - felt[0], -most, most), clip(f[1] - felt[1], -most, most), clip(f[2] - felt[2], -most, most))
    a = thrust_acceleration(q, estimate.thrust_m_s2 if math.isfinite(estimate.thrust_m_s2) else G_M_S2)
    late_s = estimate.delay_s if math.isfinite(estimate.delay_s) else 0.0
    if gains.predict:
        delay_s = min(gains.delay_max_s, gains.delay_s + max(0.0, late_s))
        p, v, a = ahead(gains.vehicle, p, v, a, rest, state.queue, now_s, delay_s, delay_s)
        demand = preview(estimate.t_us + round(1e6 * delay_s))
    wanted, cancelled = law(gains, p, v, a, rest, demand.p_ned_m, demand.v_ned_m_s, demand.a_ned_m_s2, demand.j_ned_m_s3)
    command = limited(gains.vehicle, wanted)
    omega = NAN3
    if gains.attitude_rad_s > 0.0 and late_s <= RATES_DELAY_S:
        omega = body_rates(q, command, demand.yaw_rad, gains.attitude_rad_s)
    queue = np.empty_like(state.queue)
    queue[:-1] = state.queue[1:]
    queue[-1] = now_s, *command
    return State(queue), Command(command, demand.yaw_rad, demand.yaw_rate_rad_s, omega, cancelled)
