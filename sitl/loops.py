"""The autopilot's loops: position -> attitude -> rates -> rotors, as compiled steps on the vehicle and setpoint records.

Position: p and v errors, an integral on velocity, feed-forwards as given (the structure of both autopilots).
Attitude: the rotation vector from the present attitude to the wanted one, times a gain per axis, is the wanted rate (PX4);
ArduPilot's own way is in `shaping.py`.
Rates: P on the error, D on the filtered gyro, a bounded integral; inertia of the airframe's file turns them into torque.
"""

import math

from mavquad.jit import kernel
from sitl import rotation, rotors, shaping
from sitl.plant import GRAVITY_M_S2
from sitl.state import ARDUPILOT, ATTITUDE, CLIMB, IDLE, OFF, POSITION, RATES

YAW_SHARE = 0.4  # of the mean thrust at most goes into yaw
_INTEGRAL_RAD_S2 = 30.0  # bound of the rate integral, as an angular acceleration
_ACCEL_FEED = 0.7  # of a shaped target's own acceleration: the rate error behind the gyro's filter asks for the rest
_LIFT_FLOOR = 0.1  # of gravity: the position loop never asks for less
_VELOCITY_INTEGRAL_M_S2 = 5.0


@kernel
def run(s, sp, c):
    """One pass of all loops that are due: leaves s.outputs."""
    kind = sp.kind
    if kind in (OFF, IDLE):
        rest(s, 0.0 if kind == OFF else c.idle)
        return
    if kind in (POSITION, CLIMB):
        if s.step % c.position_every == 0:
            if c.personality == ARDUPILOT:
                shaping.aim(s, sp, c)
            else:
                aim(s, sp)
            position(s, sp, c)
    else:
        s.thrust = sp.thrust
    if kind in (ATTITUDE, CLIMB):
        for i in range(9):
            s.wanted_R[i] = sp.R[i]
    if c.personality == ARDUPILOT:
        shaping.attitude(s, sp, c, kind)
    else:
        _attitude(s, sp, c)
    _rates(s, c)


@kernel
def rest(s, output):
    """Rotors stopped or idling, everything that remembers at its beginning."""
    for i in range(4):
        s.outputs[i] = output
        s.pwm_us[i] = int(1000.5 + 1000.0 * output)
    for i in range(3):
        s.velocity_integral[i] = 0.0
        s.rate_integral[i] = 0.0
        s.target_rates_rad_s[i] = 0.0
        s.shaped_rates_rad_s[i] = 0.0
        s.target_accel_rad_s2[i] = 0.0
        s.aim_p[i], s.aim_v[i], s.aim_a[i] = s.nav_p_ned_m[i], 0.0, 0.0
    level = rotation.from_euler(0.0, 0.0, s.ahrs_euler_rad[2])
    for i in range(9):
        s.wanted_R[i] = level[i]
        s.target_R[i] = level[i]
        s.shaped_R[i] = level[i]
    s.thrust = output
    s.lift = output


@kernel
def aim(s, sp):
    """PX4: the position loop is after the setpoint itself."""
    for i in range(3):
        s.aim_p[i], s.aim_v[i], s.aim_a[i] = sp.p_ned_m[i], sp.v_ned_m_s[i], sp.a_ned_m_s2[i]


@kernel
def position(s, sp, c):
    """Wanted attitude and thrust from the aim; an axis without position or velocity is led by the rest. CLIMB takes the thrust."""
    vn, ve, vd = _velocity(s, c, 0), _velocity(s, c, 1), _velocity(s, c, 2)
    k = min(1.0, c.speed_max[0] / max(1e-9, math.hypot(vn, ve)))
    en, ee = k * vn - s.nav_v_ned_m_s[0], k * ve - s.nav_v_ned_m_s[1]
    ed = min(c.speed_max[2], max(-c.speed_max[1], vd)) - s.nav_v_ned_m_s[2]
    an, ae, ad = _accel(s, c, 0, en), _accel(s, c, 1, ee), _accel(s, c, 2, ed)
    up = max(_LIFT_FLOOR * GRAVITY_M_S2, GRAVITY_M_S2 - ad)
    _integrate(s, c, 2, ed)
    if sp.kind == CLIMB:
        s.thrust = min(1.0, c.hover_thrust / GRAVITY_M_S2 * up)
        return
    level = math.hypot(an, ae)
    most = min(c.accel_max, up * math.tan(c.tilt_max_rad))
    if level > most:  # the integral waits while the tilt is at its limit
        an *= most / level
        ae *= most / level
    else:
        _integrate(s, c, 0, en)
        _integrate(s, c, 1, ee)
    R = rotation.towards((an, ae, -up), sp.yaw_rad)
    for i in range(9):
        s.wanted_R[i] = R[i]
    lift = up if c.personality == ARDUPILOT else math.sqrt(an * an + ae * ae + up * up)  # ArduPilot adds the tilt's share later
    s.thrust = min(1.0, c.hover_thrust / GRAVITY_M_S2 * lift)


@kernel
def _velocity(s, c, i):
    """Wanted velocity of one axis."""
    v = 0.0 if math.isnan(s.aim_v[i]) else s.aim_v[i]
    if not math.isnan(s.aim_p[i]):
        v += c.position_p[i] * (s.aim_p[i] - s.nav_p_ned_m[i])
    return v


@kernel
def _only_accel(s, i):
    return math.isnan(s.aim_p[i]) and math.isnan(s.aim_v[i]) and not math.isnan(s.aim_a[i])


@kernel
def _accel(s, c, i, error):
    """Wanted acceleration of one axis."""
    feed = 0.0 if math.isnan(s.aim_a[i]) else s.aim_a[i]
    if _only_accel(s, i):
        return feed
    return feed + c.velocity_p[i] * error + s.velocity_integral[i]


@kernel
def _integrate(s, c, i, error):
    if _only_accel(s, i):
        s.velocity_integral[i] = 0.0
        return
    moved = s.velocity_integral[i] + c.position_every * c.dt_s * c.velocity_i[i] * error
    s.velocity_integral[i] = min(_VELOCITY_INTEGRAL_M_S2, max(-_VELOCITY_INTEGRAL_M_S2, moved))


@kernel
def _attitude(s, sp, c):
    """PX4: wanted rates from the rotation that is still to be made; a yaw rate (about the world's vertical) is added."""
    s.lift = s.thrust
    if sp.kind == RATES:
        for i in range(3):
            s.target_rates_rad_s[i] = sp.rates_rad_s[i]
        return
    A, D = rotation.matrix(s.ahrs_R), rotation.matrix(s.wanted_R)
    e = rotation.log(rotation.mul_t(A, D))
    yaw_rate = sp.rates_rad_s[2] if sp.kind == ATTITUDE else 0.0
    for i in range(3):
        s.target_rates_rad_s[i] = towards(c.attitude_p[i], e[i], yaw_rate * A[6 + i], c.rate_limit[i])
    for i in range(9):
        s.target_R[i] = D[i]


@kernel
def _rates(s, c):
    w = (s.rates_rad_s[0], s.rates_rad_s[1], s.rates_rad_s[2])
    J = (c.tuned_inertia[0], c.tuned_inertia[1], c.tuned_inertia[2])
    a0, a1, a2 = _spin(s, c, 0), _spin(s, c, 1), _spin(s, c, 2)
    tau = torque(J, w, (a0, a1, a2))
    full = c.tuned_thrust_max_n
    T = rotors.allocate(c.allocation, 4.0 * full * s.lift, tau, YAW_SHARE, c.idle * full, full)
    for i in range(4):
        s.outputs[i] = T[i] / full
        s.pwm_us[i] = int(1000.5 + 1000.0 * s.outputs[i])


@kernel
def _spin(s, c, i):
    """Wanted angular acceleration of one axis."""
    slope, feed, integral = s.rates_slope[i], s.target_accel_rad_s2[i], s.rate_integral[i]
    error = s.target_rates_rad_s[i] - s.rates_rad_s[i]
    alpha, moved = spin(error, slope, feed, integral, c.rate_p[i], c.dt_s * c.rate_i[i], c.rate_d[i])
    if not s.grounded:
        s.rate_integral[i] = moved
    return alpha


# ---- the arithmetic of an axis: floats, or `tools.bulk.lanes` -----------------------------------------------------------------
@kernel
def towards(p, e, yaw, limit):
    """Wanted rate of one axis, from the angle e that is still to be turned."""
    return min(limit, max(-limit, p * e + yaw))


@kernel
def spin(error, slope, feed, integral, p, i_dt, d):
    """(wanted angular acceleration of one axis, its integral afterwards)."""
    alpha = _ACCEL_FEED * feed + p * error + integral - d * slope
    return alpha, min(_INTEGRAL_RAD_S2, max(-_INTEGRAL_RAD_S2, integral + i_dt * error))


@kernel
def torque(J, w, alpha):
    """Torques that turn a body of inertia J at rates w with these accelerations."""
    return (
        J[0] * alpha[0] + (J[2] - J[1]) * w[1] * w[2],
        J[1] * alpha[1] + (J[0] - J[2]) * w[2] * w[0],
        J[2] * alpha[2] + (J[1] - J[0]) * w[0] * w[1],
    )
