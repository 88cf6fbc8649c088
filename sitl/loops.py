"""The autopilot's loops: position -> attitude -> rates -> rotors, as compiled steps on the vehicle and setpoint records.

Position: p and v errors, an integral on velocity, feed-forwards as given (PX4's structure and its default gains).
Attitude: the rotation vector from the present attitude to the wanted one, times a gain per axis, is the wanted rate.
Rates: P on the error, D on the filtered gyro, a bounded integral; inertia of the airframe's file turns them into torque.
"""

import math

from mavquad.jit import kernel
from sitl import rotation, rotors
from sitl.plant import GRAVITY_M_S2
from sitl.state import IDLE, OFF, POSITION, RATES

_YAW_SHARE = 0.4  # of the mean thrust at most goes into yaw
_INTEGRAL_RAD_S2 = 30.0  # bound of the rate integral, as an angular acceleration
_LIFT_FLOOR = 0.1  # of gravity: the position loop never asks for less
_VELOCITY_INTEGRAL_M_S2 = 5.0


@kernel
def run(s, sp, c):
    """One pass of all loops that are due: leaves s.outputs."""
    kind = sp.kind
    if kind in (OFF, IDLE):
        rest = 0.0 if kind == OFF else c.idle
        for i in range(4):
            s.outputs[i] = rest
            s.pwm_us[i] = int(1000.5 + 1000.0 * rest)
        _reset(s)
        s.thrust = rest
        return
    if kind == POSITION:
        if s.step % c.position_every == 0:
            _position(s, sp, c)
        _attitude(s, c, 0.0)
    elif kind == RATES:
        for i in range(3):
            s.target_rates_rad_s[i] = sp.rates_rad_s[i]
        s.thrust = sp.thrust
    else:
        for i in range(9):
            s.target_R[i] = sp.R[i]
        s.thrust = sp.thrust
        _attitude(s, c, sp.rates_rad_s[2])
    _rates(s, c)


@kernel
def _reset(s):
    for i in range(3):
        s.velocity_integral[i] = 0.0
        s.rate_integral[i] = 0.0
        s.target_rates_rad_s[i] = 0.0
        s.force_m_s2[i] = 0.0
    yaw = rotation.from_euler(0.0, 0.0, s.ahrs_euler_rad[2])
    for i in range(9):
        s.target_R[i] = yaw[i]
        s.shaped_R[i] = yaw[i]


@kernel
def _position(s, sp, c):
    """Wanted force from position, velocity and acceleration setpoints; an axis without position or velocity is led by the rest."""
    vn, ve, vd = _velocity(s, sp, c, 0), _velocity(s, sp, c, 1), _velocity(s, sp, c, 2)
    k = min(1.0, c.speed_max[0] / max(1e-9, math.hypot(vn, ve)))
    en, ee = k * vn - s.nav_v_ned_m_s[0], k * ve - s.nav_v_ned_m_s[1]
    ed = min(c.speed_max[2], max(-c.speed_max[1], vd)) - s.nav_v_ned_m_s[2]
    an, ae, ad = _accel(s, sp, c, 0, en), _accel(s, sp, c, 1, ee), _accel(s, sp, c, 2, ed)
    up = max(_LIFT_FLOOR * GRAVITY_M_S2, GRAVITY_M_S2 - ad)
    level = math.hypot(an, ae)
    most = min(c.accel_max, up * math.tan(c.tilt_max_rad))
    if level > most:  # the integral waits while the tilt is at its limit
        an *= most / level
        ae *= most / level
    else:
        _integrate(s, sp, c, 0, en)
        _integrate(s, sp, c, 1, ee)
    _integrate(s, sp, c, 2, ed)
    s.force_m_s2[0], s.force_m_s2[1], s.force_m_s2[2] = an, ae, -up
    R = rotation.towards((an, ae, -up), sp.yaw_rad)
    for i in range(9):
        s.target_R[i] = R[i]
    s.thrust = min(1.0, c.hover_thrust / GRAVITY_M_S2 * math.sqrt(an * an + ae * ae + up * up))


@kernel
def _velocity(s, sp, c, i):
    """Wanted velocity of one axis."""
    v = 0.0 if math.isnan(sp.v_ned_m_s[i]) else sp.v_ned_m_s[i]
    if not math.isnan(sp.p_ned_m[i]):
        v += c.position_p[i] * (sp.p_ned_m[i] - s.nav_p_ned_m[i])
    return v


@kernel
def _only_accel(sp, i):
    return math.isnan(sp.p_ned_m[i]) and math.isnan(sp.v_ned_m_s[i]) and not math.isnan(sp.a_ned_m_s2[i])


@kernel
def _accel(s, sp, c, i, error):
    """Wanted acceleration of one axis."""
    feed = 0.0 if math.isnan(sp.a_ned_m_s2[i]) else sp.a_ned_m_s2[i]
    if _only_accel(sp, i):
        return feed
    return feed + c.velocity_p[i] * error + s.velocity_integral[i]


@kernel
def _integrate(s, sp, c, i, error):
    if _only_accel(sp, i):
        s.velocity_integral[i] = 0.0
        return
    moved = s.velocity_integral[i] + c.position_every * c.dt_s * c.velocity_i[i] * error
    s.velocity_integral[i] = min(_VELOCITY_INTEGRAL_M_S2, max(-_VELOCITY_INTEGRAL_M_S2, moved))


@kernel
def _attitude(s, c, yaw_rate):
    """Wanted rates from the rotation that is still to be made, with the yaw rate (about the world's vertical) as feed-forward."""
    A = (s.ahrs_R[0], s.ahrs_R[1], s.ahrs_R[2], s.ahrs_R[3], s.ahrs_R[4], s.ahrs_R[5], s.ahrs_R[6], s.ahrs_R[7], s.ahrs_R[8])
    D = (
        s.target_R[0],
        s.target_R[1],
        s.target_R[2],
        s.target_R[3],
        s.target_R[4],
        s.target_R[5],
        s.target_R[6],
        s.target_R[7],
        s.target_R[8],
    )
    e = rotation.log(rotation.mul_t(A, D))
    for i in range(3):
        wanted = c.attitude_p[i] * e[i] + yaw_rate * A[6 + i]
        s.target_rates_rad_s[i] = min(c.rate_limit[i], max(-c.rate_limit[i], wanted))


@kernel
def _rates(s, c):
    w = (s.rates_rad_s[0], s.rates_rad_s[1], s.rates_rad_s[2])
    J = (c.tuned_inertia[0], c.tuned_inertia[1], c.tuned_inertia[2])
    a0, a1, a2 = _spin(s, c, 0), _spin(s, c, 1), _spin(s, c, 2)
    tau = (
        J[0] * a0 + (J[2] - J[1]) * w[1] * w[2],
        J[1] * a1 + (J[0] - J[2]) * w[2] * w[0],
        J[2] * a2 + (J[1] - J[0]) * w[0] * w[1],
    )
    full = c.tuned_thrust_max_n
    T = rotors.allocate(c.allocation, 4.0 * full * s.thrust, tau, _YAW_SHARE, c.idle * full, full)
    for i in range(4):
        s.outputs[i] = T[i] / full
        s.pwm_us[i] = int(1000.5 + 1000.0 * s.outputs[i])


@kernel
def _spin(s, c, i):
    """Wanted angular acceleration of one axis."""
    error = s.target_rates_rad_s[i] - s.rates_rad_s[i]
    alpha = c.rate_p[i] * error + s.rate_integral[i] - c.rate_d[i] * s.rates_slope[i]
    if not s.grounded:
        moved = s.rate_integral[i] + c.dt_s * c.rate_i[i] * error
        s.rate_integral[i] = min(_INTEGRAL_RAD_S2, max(-_INTEGRAL_RAD_S2, moved))
    return alpha
