"""The cascade of the IADRC paper as kernels: position law, thrust direction, command filter, attitude law, mixer, motors.

Source: Xiao & Tong 2023, Eqs. (8), (9), (31), (32). Every part is a pure function; `iadrc` and `adrc` fly the first two over
MAVLink, the whole runs in the paper's experiments.

Deviations from the paper:
  Eqs. (31), (32)  velocity and acceleration references added and the known part subtracted: as printed a ramp is followed
                   2/wc late and gravity is never cancelled.
  Eq. (8)          cos(phi) restored in u_x and u_y.
  -                limits, mixer priority and the applied (clipped, lagged) input: the paper has none.
"""

import math
from typing import NamedTuple

from mavquad.jit import kernel

Vec3 = tuple[float, float, float]
Four = tuple[float, float, float, float]


class Body(NamedTuple):
    """The vehicle as the law knows it: a plus quadrotor, rotor 1 front, 2 right, 3 rear, 4 left; 2 and 4 turn CCW from above."""

    mass_kg: float
    gravity_m_s2: float
    drag_1_s: float  # kf/m
    inertia_kg_m2: Vec3
    rate_drag_nm_s: float
    arm_m: float
    kappa_m: float  # drag torque per thrust
    f_min_n: float  # of one rotor
    f_max_n: float
    motor_lag_s: float


class CommandFilter(NamedTuple):
    """Angle, rate and acceleration of one filtered angle command."""

    angle: float
    rate: float
    accel: float


@kernel
def position_law(wc: Vec3, p: Vec3, v: Vec3, f: Vec3, p_ref: Vec3, v_ref: Vec3, a_ref: Vec3) -> Vec3:
    """Inertial acceleration wanted [m/s^2, NED]: critically damped at wc on each axis, the disturbance f cancelled (Eq. (31))."""
    return (
        a_ref[0] + 2.0 * wc[0] * (v_ref[0] - v[0]) + wc[0] * wc[0] * (p_ref[0] - p[0]) - f[0],
        a_ref[1] + 2.0 * wc[1] * (v_ref[1] - v[1]) + wc[1] * wc[1] * (p_ref[1] - p[1]) - f[1],
        a_ref[2] + 2.0 * wc[2] * (v_ref[2] - v[2]) + wc[2] * wc[2] * (p_ref[2] - p[2]) - f[2],
    )


@kernel
def limit_force(body: Body, a: Vec3, v: Vec3, tilt_max_rad: float) -> Vec3:
    """-(T/m) R e3 that gives the acceleration `a` at the velocity v, inside thrust and tilt: vertical first."""
    up = -(a[2] - body.gravity_m_s2 + body.drag_1_s * v[2])
    up = min(max(up, 0.25 * body.gravity_m_s2), 0.85 * 4.0 * body.f_max_n / body.mass_kg)
    x, y = a[0] + body.drag_1_s * v[0], a[1] + body.drag_1_s * v[1]
    flat = math.sqrt(x * x + y * y)
    most = up * math.tan(tilt_max_rad)
    if flat > most:
        x, y = x * most / flat, y * most / flat
    return (x, y, -up)


@kernel
def thrust_and_angles(force_m_s2: Vec3, yaw_rad: float) -> Vec3:
    """(T/m, roll, pitch) that push along force_m_s2 at a heading."""
    t = math.sqrt(force_m_s2[0] ** 2 + force_m_s2[1] ** 2 + force_m_s2[2] ** 2)
    x, y, z = -force_m_s2[0] / t, -force_m_s2[1] / t, -force_m_s2[2] / t
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    across = -s * x + c * y
    return (t, -math.asin(min(1.0, max(-1.0, across))), math.atan2(c * x + s * y, z))


@kernel
def filter_command(state: CommandFilter, target: float, w: float, dt_s: float) -> CommandFilter:
    """Second order, critically damped at w: acceleration, then rate, then angle."""
    accel = w * w * (target - state.angle) - 2.0 * w * state.rate
    rate = state.rate + dt_s * accel
    return CommandFilter(state.angle + dt_s * rate, rate, accel)


@kernel
def attitude_law(
    body: Body, wc: Vec3, eta: Vec3, w: Vec3, tau: Vec3, ref: tuple[CommandFilter, CommandFilter, CommandFilter]
) -> Vec3:
    """Torque [N m] that follows the filtered angles, the disturbance tau [rad/s^2] cancelled (Eq. (32), gyroscopic terms known)."""
    jx, jy, jz = body.inertia_kg_m2
    kr = body.rate_drag_nm_s
    turn = 2.0 * math.pi
    error = ref[2].angle - eta[2]
    error -= turn * math.floor(error / turn + 0.5)
    ax = ref[0].accel + 2.0 * wc[0] * (ref[0].rate - w[0]) + wc[0] * wc[0] * (ref[0].angle - eta[0]) - tau[0]
    ay = ref[1].accel + 2.0 * wc[1] * (ref[1].rate - w[1]) + wc[1] * wc[1] * (ref[1].angle - eta[1]) - tau[1]
    az = ref[2].accel + 2.0 * wc[2] * (ref[2].rate - w[2]) + wc[2] * wc[2] * error - tau[2]
    return (
        jx * ax + kr * w[0] - (jy - jz) * w[1] * w[2],
        jy * ay + kr * w[1] - (jz - jx) * w[2] * w[0],
        jz * az + kr * w[2] - (jx - jy) * w[0] * w[1],
    )


@kernel
def mix(body: Body, thrust_n: float, torque_nm: Vec3) -> Four:
    """Thrust of each rotor [N] inside its limits. Roll and pitch come first, then the collective, then yaw."""
    lo, hi = body.f_min_n, body.f_max_n
    a = torque_nm[1] / (2.0 * body.arm_m)
    c = torque_nm[0] / (2.0 * body.arm_m)
    most = max(abs(a), abs(c))
    half = 0.5 * (hi - lo)
    if most > half:
        a, c = a * half / most, c * half / most
        most = half
    base = min(max(0.25 * thrust_n, lo + most), hi - most)
    yaw = 0.25 * torque_nm[2] / body.kappa_m
    above = min(base - abs(a) - lo, hi - base - abs(c))  # rotors 1, 3 carry base +- a - yaw and 2, 4 base -+ c + yaw
    below = min(hi - base - abs(a), base - abs(c) - lo)
    yaw = min(max(yaw, -max(below, 0.0)), max(above, 0.0))
    return (base + a - yaw, base - c + yaw, base - a - yaw, base + c + yaw)


@kernel
def unmix(body: Body, f: Four) -> tuple[float, Vec3]:
    """Total thrust [N] and torque [N m] of four rotor thrusts."""
    torque = (body.arm_m * (f[3] - f[1]), body.arm_m * (f[0] - f[2]), body.kappa_m * (-f[0] + f[1] - f[2] + f[3]))
    return (f[0] + f[1] + f[2] + f[3], torque)


@kernel
def lag(f: Four, target: Four, tau_s: float, dt_s: float) -> tuple[Four, Four]:
    """First-order motors under a held command: thrust at the end of dt, and its mean over dt (exact)."""
    keep = math.exp(-dt_s / tau_s)
    mean = tau_s / dt_s * (1.0 - keep)
    d0, d1, d2, d3 = f[0] - target[0], f[1] - target[1], f[2] - target[2], f[3] - target[3]
    return (
        (target[0] + keep * d0, target[1] + keep * d1, target[2] + keep * d2, target[3] + keep * d3),
        (target[0] + mean * d0, target[1] + mean * d1, target[2] + mean * d2, target[3] + mean * d3),
    )
