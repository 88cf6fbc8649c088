"""The vehicle as nature has it: rigid body in rotation matrices, rotor lag, drag, wind at the rotors, flat ground.

    p' = v,   v' = g e3 - (sum T_i/m) R e3 + (R F_drag + F_push)/m,   R' = R [w]x,   J w' = tau - w x J w + tau_push

Explicit midpoint rule with R on the group (local error third order: 1e-8 at 2 ms); rotor thrust by its exact first-order answer.
On the ground nothing slides; the legs turn a tilted body level at 10 per second.

The disturbance is what the still-air, healthy vehicle would not feel: f = v' - g e3 + (sum T0/m) R e3, and likewise in rotation.
"""

import math

from mavquad.jit import kernel
from sitl import rotation, rotors
from sitl.rotation import apply, apply_t

GRAVITY_M_S2 = 9.80665
_LEGS_1_S = 10.0


@kernel
def rates_of_change(v, R, w, T0, wind, p_gust, q_gust, c):
    """(v', w', f, alpha): accelerations and the disturbance part of each; T0 (4,) thrusts in still air, c the constants."""
    air = apply_t(R, (wind[0] - v[0], wind[1] - v[1], wind[2] - v[2]))  # relative to the body
    ax, ay, az = air
    if c.rotor_model == rotors.NO_INFLOW:
        T = (
            c.effectiveness[0] * T0[0],
            c.effectiveness[1] * T0[1],
            c.effectiveness[2] * T0[2],
            c.effectiveness[3] * T0[3],
        )
    else:
        T = (
            c.effectiveness[0] * _inflow(T0[0], 0, ax, ay, az, p_gust - w[0], q_gust - w[1], c),
            c.effectiveness[1] * _inflow(T0[1], 1, ax, ay, az, p_gust - w[0], q_gust - w[1], c),
            c.effectiveness[2] * _inflow(T0[2], 2, ax, ay, az, p_gust - w[0], q_gust - w[1], c),
            c.effectiveness[3] * _inflow(T0[3], 3, ax, ay, az, p_gust - w[0], q_gust - w[1], c),
        )
    return under(R, w, air, T0, T, c)


@kernel
def under(R, w, air, T0, T, c):
    """`rates_of_change` in the air relative to the body, under thrusts T (T0 in still air); floats, or `tools.bulk.lanes`."""
    ax, ay, az = air
    m = c.mass_kg
    speed = math.sqrt(ax * ax + ay * ay + az * az)
    drag = (
        (c.drag_linear[0] + c.drag_quadratic[0] * speed) * ax,
        (c.drag_linear[1] + c.drag_quadratic[1] * speed) * ay,
        (c.drag_linear[2] + c.drag_quadratic[2] * speed) * az,
    )
    U, tx, ty, tz = rotors.wrench(c.x_m, c.y_m, c.spin, c.torque_per_thrust_m, T)
    U0, tx0, ty0, tz0 = rotors.wrench(c.x_m, c.y_m, c.spin, c.torque_per_thrust_m, T0)
    fx, fy, fz = apply(R, (drag[0], drag[1], drag[2] - (U - U0)))
    f = ((fx + c.push_n[0]) / m, (fy + c.push_n[1]) / m, (fz + c.push_n[2]) / m)
    dv = (f[0] - U0 / m * R[2], f[1] - U0 / m * R[5], f[2] - U0 / m * R[8] + GRAVITY_M_S2)
    jx, jy, jz = c.inertia_kg_m2[0], c.inertia_kg_m2[1], c.inertia_kg_m2[2]
    alpha = ((tx - tx0 + c.push_nm[0]) / jx, (ty - ty0 + c.push_nm[1]) / jy, (tz - tz0 + c.push_nm[2]) / jz)
    dw = (
        alpha[0] + (tx0 + (jy - jz) * w[1] * w[2]) / jx,
        alpha[1] + (ty0 + (jz - jx) * w[2] * w[0]) / jy,
        alpha[2] + (tz0 + (jx - jy) * w[0] * w[1]) / jz,
    )
    return dv, dw, f, alpha


@kernel
def _inflow(T0, i, u, v, w, p, q, c):
    """Thrust of rotor i in the air that it meets: gust and own rotation change the axial part with its place."""
    return rotors.in_wind(c.rotor_model, T0, u, v, w + p * c.y_m[i] - q * c.x_m[i], c.air_density, c.rotor_disk_m2)


@kernel
def step(s, c):
    """Move the vehicle record on by one loop period under its rotor outputs."""
    dt = c.dt_s
    v = (s.v_ned_m_s[0], s.v_ned_m_s[1], s.v_ned_m_s[2])
    w = (s.omega_rad_s[0], s.omega_rad_s[1], s.omega_rad_s[2])
    R = rotation.matrix(s.R)
    wind = (s.wind_ned_m_s[0], s.wind_ned_m_s[1], s.wind_ned_m_s[2])
    T = (s.thrust_n[0], s.thrust_n[1], s.thrust_n[2], s.thrust_n[3])
    keep = kept(dt, c.lag_s)
    T_mid = lagged(T, s.outputs, c.thrust_max_n, keep)
    T_end = lagged(T_mid, s.outputs, c.thrust_max_n, keep)
    p_gust, q_gust = s.gust[3], s.gust[4]

    k1, j1, _, _ = rates_of_change(v, R, w, T, wind, p_gust, q_gust, c)
    h = 0.5 * dt
    v_mid, w_mid = after(v, k1, h), after(w, j1, h)
    R_mid = rotation.mul(R, rotation.exp((h * w[0], h * w[1], h * w[2])))
    k2, j2, f, alpha = rates_of_change(v_mid, R_mid, w_mid, T_mid, wind, p_gust, q_gust, c)

    if s.grounded and k2[2] >= 0.0:  # weight still on the legs: they turn the body level and hold it
        k2 = (-v[0] / dt, -v[1] / dt, -v[2] / dt)
        v_mid = (0.0, 0.0, 0.0)
        w_mid = levelling(R)
        w = w_mid
        j2 = (0.0, 0.0, 0.0)
    else:
        s.grounded = 0
        for i in range(3):
            s.disturbance_m_s2[i] += f[i]
            s.disturbance_rad_s2[i] += alpha[i]
        s.summed += 1
    R_new = rotation.orthonormal(rotation.mul(R, rotation.exp((dt * w_mid[0], dt * w_mid[1], dt * w_mid[2]))))
    for i in range(9):
        s.R[i] = R_new[i]
    for i in range(3):
        s.p_ned_m[i] += dt * v_mid[i]
        s.v_ned_m_s[i] = v[i] + dt * k2[i]
        s.omega_rad_s[i] = w[i] + dt * j2[i]
        s.accel_ned_m_s2[i] = k2[i]
    for i in range(4):
        s.thrust_n[i] = T_end[i]
    meet_ground(s, c)
    s.step += 1


@kernel
def meet_ground(s, c):
    """What sinks below the ground stands on it."""
    if s.p_ned_m[2] > c.ground_d_m and s.v_ned_m_s[2] >= 0.0:
        s.impact_m_s = s.v_ned_m_s[2]
        s.grounded = 1
        s.p_ned_m[2] = c.ground_d_m
        for i in range(3):
            s.accel_ned_m_s2[i] -= s.v_ned_m_s[i] / c.dt_s
            s.v_ned_m_s[i] = 0.0


@kernel
def after(x, slope, dt):
    """A vector x of three, moved on along its slope; floats, or `tools.bulk.lanes`."""
    return (x[0] + dt * slope[0], x[1] + dt * slope[1], x[2] + dt * slope[2])


@kernel
def kept(dt, lag_s):
    """Share of a rotor's distance from what is asked of it that is left after half a step."""
    return math.exp(-0.5 * dt / lag_s) if lag_s > 0.0 else 0.0


@kernel
def lagged(T, outputs, full, keep):
    """Thrusts after half a step under these outputs."""
    return (
        full * outputs[0] + keep * (T[0] - full * outputs[0]),
        full * outputs[1] + keep * (T[1] - full * outputs[1]),
        full * outputs[2] + keep * (T[2] - full * outputs[2]),
        full * outputs[3] + keep * (T[3] - full * outputs[3]),
    )


@kernel
def levelling(R):
    """Body rates that turn the body level about a horizontal axis, its heading kept."""
    # world e3 in body axes is the third row; level is (0, 0, 1): turn along their cross product
    return (-_LEGS_1_S * R[7], _LEGS_1_S * R[6], 0.0)
