"""ArduPilot's shaping: targets that a vehicle can follow, made of what was asked for, and its way with body rates and tilt.

Attitude: each axis of the rotation still to be made goes through a square-root controller (gain 1/ATC_INPUT_TC) into a target rate
whose slope is bounded by ATC_ACCEL; the target attitude is the integral. Position and velocity go through the same kind of
controller with bounded acceleration and jerk. Body rates beside an attitude are rotated by the *wanted attitude*, and the wanted
attitude turns with them: so they act about the world's axes, as observed on the real one.

Source: ArduPilot, AC_AttitudeControl::input_quaternion and AP_Math/control, rewritten.
"""

import math

from mavquad.jit import kernel
from sitl import rotation
from sitl.state import RATES

_TILT_FLOOR = 0.1  # of the cosine that thrust is divided by


@kernel
def sqrt_controller(error, p, limit, dt):
    """A rate towards zero error: p times it when near, falling with at most `limit` from far; never past it within dt."""
    linear = limit / (p * p)
    if error > linear:
        rate = math.sqrt(2.0 * limit * (error - 0.5 * linear))
    elif error < -linear:
        rate = -math.sqrt(2.0 * limit * (-error - 0.5 * linear))
    else:
        rate = p * error
    most = abs(error) / dt
    return min(most, max(-most, rate))


@kernel
def towards(value, wanted, step):
    """`wanted`, or as near to it as one step from `value` comes."""
    return min(value + step, max(value - step, wanted))


@kernel
def attitude(s, sp, c, kind):
    """Move the shaped target on by one period and leave target_R and target_rates_rad_s for the rate loop."""
    dt = c.dt_s
    w = (s.shaped_rates_rad_s[0], s.shaped_rates_rad_s[1], s.shaped_rates_rad_s[2])
    T = rotation.orthonormal(rotation.mul(rotation.matrix(s.shaped_R), rotation.exp((dt * w[0], dt * w[1], dt * w[2]))))
    if kind == RATES:
        for i in range(3):
            s.shaped_rates_rad_s[i] = towards(w[i], sp.rates_rad_s[i], c.shaping_accel[i] * dt)
    else:
        D = rotation.matrix(s.wanted_R)
        r = rotation.apply(D, (sp.rates_rad_s[0], sp.rates_rad_s[1], sp.rates_rad_s[2]))
        e = rotation.log(rotation.mul_t(T, D))
        for i in range(3):
            wanted = r[i] + sqrt_controller(e[i], 1.0 / c.input_tc_s, c.shaping_accel[i], dt)
            s.shaped_rates_rad_s[i] = towards(w[i], wanted, c.shaping_accel[i] * dt)
        if r[0] != 0.0 or r[1] != 0.0 or r[2] != 0.0:
            D = rotation.orthonormal(rotation.mul(D, rotation.exp((dt * r[0], dt * r[1], dt * r[2]))))
            for i in range(9):
                sp.R[i] = D[i]
    A = rotation.matrix(s.ahrs_R)
    E = rotation.mul_t(A, T)
    e = rotation.log(E)
    feed = rotation.apply(E, (s.shaped_rates_rad_s[0], s.shaped_rates_rad_s[1], s.shaped_rates_rad_s[2]))
    for i in range(9):
        s.shaped_R[i] = T[i]
        s.target_R[i] = T[i]
    slope = rotation.apply(
        E,
        (
            (s.shaped_rates_rad_s[0] - w[0]) / dt,
            (s.shaped_rates_rad_s[1] - w[1]) / dt,
            (s.shaped_rates_rad_s[2] - w[2]) / dt,
        ),
    )
    for i in range(3):
        s.target_accel_rad_s2[i] = slope[i]
        s.target_rates_rad_s[i] = min(c.rate_limit[i], max(-c.rate_limit[i], c.attitude_p[i] * e[i] + feed[i]))
    s.lift = min(1.0, s.thrust / max(_TILT_FLOOR, T[8]))


@kernel
def aim(s, sp, c):
    """Move the shaped position, velocity and acceleration on towards the setpoint, axis by axis."""
    dt = c.position_every * c.dt_s
    for i in range(3):
        jerk, most = c.aim_jerk, c.aim_accel[0] if i < 2 else c.aim_accel[1]
        gain = jerk / most
        feed_v = 0.0 if math.isnan(sp.v_ned_m_s[i]) else sp.v_ned_m_s[i]
        feed_a = 0.0 if math.isnan(sp.a_ned_m_s2[i]) else sp.a_ned_m_s2[i]
        a = feed_a
        if not (math.isnan(sp.p_ned_m[i]) and math.isnan(sp.v_ned_m_s[i])):
            v = feed_v
            if not math.isnan(sp.p_ned_m[i]):
                v += sqrt_controller(sp.p_ned_m[i] - s.aim_p[i], 0.5 * gain, most, dt)
            up, down = (c.speed_max[0], c.speed_max[0]) if i < 2 else (c.speed_max[2], c.speed_max[1])
            v = min(up, max(-down, v))
            a += min(most, max(-most, sqrt_controller(v - s.aim_v[i], gain, jerk, dt)))
        s.aim_a[i] = towards(s.aim_a[i], a, jerk * dt)
        s.aim_p[i] += dt * s.aim_v[i] + 0.5 * dt * dt * s.aim_a[i]
        s.aim_v[i] += dt * s.aim_a[i]
