"""The paper's quadrotor with rotors in wind: rigid body, X layout, two rotor models, compiled.

Model P is the paper's Fig. 2 as momentum theory: downflow adds thrust (a real rotor loses it). Model G solves Glauert's inflow:
downflow takes thrust away. State x (13,): p, v (NED), q (w,x,y,z), omega (FRD).
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad.jit import kernel

G = 9.81
MODEL_P, MODEL_G = 0, 1


class Quad(NamedTuple):
    """Vehicle of the reference scenarios: motors 1 FR, 2 RL (CCW), 3 FL, 4 RR (CW) at (+-d, +-d)."""

    mass_kg: float = 0.74
    ix_kg_m2: float = 0.004
    iy_kg_m2: float = 0.004
    iz_kg_m2: float = 0.0084
    d_m: float = 0.1485
    thrust_coefficient: float = 2.92e-6
    yaw_arm_m: float = 0.0384
    rotor_inertia_kg_m2: float = 7.321e-5
    air_density: float = 1.293
    disc_m2: float = 0.01
    k_drag: float = 0.01
    t_min_n: float = 0.04
    t_max_n: float = 4.0
    model: int = MODEL_P
    motor_lag_s: float = 0.0


@kernel
def rotor_thrusts(quad, t0, u, v, w, dp, dq, out):
    """Thrusts (4,) in wind: (u, v, w) air past the body (FRD), dp = p_g - p, dq = q_g - q."""
    d = quad.d_m
    horizontal = u * u + v * v
    for i in range(4):
        x = d if (i == 0 or i == 2) else -d
        y = d if (i == 0 or i == 3) else -d
        wi = w + dp * y - dq * x
        vd = math.sqrt(t0[i] / (2.0 * quad.air_density * quad.disc_m2))
        if quad.model == MODEL_P:
            out[i] = 2.0 * quad.air_density * quad.disc_m2 * vd * math.sqrt(horizontal + (vd + wi) * (vd + wi))
        else:
            vi = vd
            for _ in range(4):
                root = math.sqrt(horizontal + (vi + wi) * (vi + wi))
                vi += 0.5 * (vd * vd / max(root, 0.3 * vd) - vi)
            out[i] = max(0.0, t0[i] * (1.0 - 0.45 * (vi + wi - vd) / vd))


@kernel
def rotation(q0, q1, q2, q3):
    """R, rows as a flat tuple: body to world."""
    return (
        1.0 - 2.0 * (q2 * q2 + q3 * q3),
        2.0 * (q1 * q2 - q0 * q3),
        2.0 * (q1 * q3 + q0 * q2),
        2.0 * (q1 * q2 + q0 * q3),
        1.0 - 2.0 * (q1 * q1 + q3 * q3),
        2.0 * (q2 * q3 - q0 * q1),
        2.0 * (q1 * q3 - q0 * q2),
        2.0 * (q2 * q3 + q0 * q1),
        1.0 - 2.0 * (q1 * q1 + q2 * q2),
    )


@kernel
def derivative(quad, x, t0, wind, thrusts, dx):
    """x' (13,) under still-air thrusts t0 (4,) and wind (5,) u, v, w NED [m/s], p_g, q_g [rad/s]."""
    r11, r12, r13, r21, r22, r23, r31, r32, r33 = rotation(x[6], x[7], x[8], x[9])
    wn, we, wd = wind[0] - x[3], wind[1] - x[4], wind[2] - x[5]
    u = r11 * wn + r21 * we + r31 * wd
    v = r12 * wn + r22 * we + r32 * wd
    w = r13 * wn + r23 * we + r33 * wd
    p, q, r = x[10], x[11], x[12]
    rotor_thrusts(quad, t0, u, v, w, wind[3] - p, wind[4] - q, thrusts)
    t1, t2, t3, t4 = thrusts[0], thrusts[1], thrusts[2], thrusts[3]
    lift = t1 + t2 + t3 + t4
    speed = math.sqrt(u * u + v * v + w * w)
    fx, fy, fz = quad.k_drag * speed * u, quad.k_drag * speed * v, quad.k_drag * speed * w
    if quad.model == MODEL_G:
        fx += 0.05 * u
        fy += 0.05 * v
    fz -= lift
    m = quad.mass_kg
    dx[0], dx[1], dx[2] = x[3], x[4], x[5]
    dx[3] = (r11 * fx + r12 * fy + r13 * fz) / m
    dx[4] = (r21 * fx + r22 * fy + r23 * fz) / m
    dx[5] = G + (r31 * fx + r32 * fy + r33 * fz) / m
    q0, q1, q2, q3 = x[6], x[7], x[8], x[9]
    dx[6] = 0.5 * (-q1 * p - q2 * q - q3 * r)
    dx[7] = 0.5 * (q0 * p + q2 * r - q3 * q)
    dx[8] = 0.5 * (q0 * q - q1 * r + q3 * p)
    dx[9] = 0.5 * (q0 * r + q1 * q - q2 * p)
    k = quad.thrust_coefficient
    spin = math.sqrt(t0[2] / k) + math.sqrt(t0[3] / k) - math.sqrt(t0[0] / k) - math.sqrt(t0[1] / k)
    ix, iy, iz = quad.ix_kg_m2, quad.iy_kg_m2, quad.iz_kg_m2
    dx[10] = ((iy - iz) * q * r + quad.d_m * (-t1 + t2 + t3 - t4) - quad.rotor_inertia_kg_m2 * q * spin) / ix
    dx[11] = ((iz - ix) * p * r + quad.d_m * (t1 - t2 + t3 - t4) + quad.rotor_inertia_kg_m2 * p * spin) / iy
    dx[12] = ((ix - iy) * p * q + quad.yaw_arm_m * (t1 + t2 - t3 - t4)) / iz


class Work(NamedTuple):
    """Scratch of one flight."""

    thrusts: np.ndarray
    k1: np.ndarray
    k2: np.ndarray
    k3: np.ndarray
    k4: np.ndarray
    tmp: np.ndarray


def work() -> Work:
    return Work(np.zeros(4), np.zeros(13), np.zeros(13), np.zeros(13), np.zeros(13), np.zeros(13))


@kernel
def advance(quad, x, t0, command, wind, dt, steps, work, f_true):
    """`steps` RK4 steps of dt in place: motors t0 (4,) follow `command`, wind held. f_true (6,): mean f and tau/I left over.

    f = v' - g e3 + (sum T0/m) R e3 with the commanded T0; the angular part likewise, without the cross term.
    """
    k1, k2, k3, k4, tmp = work.k1, work.k2, work.k3, work.k4, work.tmp
    lag = 1.0 - math.exp(-dt / quad.motor_lag_s) if quad.motor_lag_s > 0.0 else 1.0
    total = command[0] + command[1] + command[2] + command[3]
    ix, iy, iz = quad.ix_kg_m2, quad.iy_kg_m2, quad.iz_kg_m2
    ax = quad.d_m * (-command[0] + command[1] + command[2] - command[3]) / ix
    ay = quad.d_m * (command[0] - command[1] + command[2] - command[3]) / iy
    az = quad.yaw_arm_m * (command[0] + command[1] - command[2] - command[3]) / iz
    for i in range(6):
        f_true[i] = 0.0
    for _ in range(steps):
        for i in range(4):
            t0[i] += lag * (command[i] - t0[i])
        derivative(quad, x, t0, wind, work.thrusts, k1)
        r = rotation(x[6], x[7], x[8], x[9])
        u = total / quad.mass_kg
        p, q, w = x[10], x[11], x[12]
        f_true[0] += (k1[3] + u * r[2]) / steps
        f_true[1] += (k1[4] + u * r[5]) / steps
        f_true[2] += (k1[5] - G + u * r[8]) / steps
        f_true[3] += (k1[10] - (iy - iz) * q * w / ix - ax) / steps
        f_true[4] += (k1[11] - (iz - ix) * p * w / iy - ay) / steps
        f_true[5] += (k1[12] - (ix - iy) * p * q / iz - az) / steps
        for i in range(13):
            tmp[i] = x[i] + 0.5 * dt * k1[i]
        derivative(quad, tmp, t0, wind, work.thrusts, k2)
        for i in range(13):
            tmp[i] = x[i] + 0.5 * dt * k2[i]
        derivative(quad, tmp, t0, wind, work.thrusts, k3)
        for i in range(13):
            tmp[i] = x[i] + dt * k3[i]
        derivative(quad, tmp, t0, wind, work.thrusts, k4)
        for i in range(13):
            x[i] += dt / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
        n = math.sqrt(x[6] * x[6] + x[7] * x[7] + x[8] * x[8] + x[9] * x[9])
        for i in range(6, 10):
            x[i] /= n


@kernel
def allocate(quad, lift, tau_x, tau_y, tau_z, out):
    """Still-air thrusts (4,) for U and torques: the yaw part is clipped first, then each motor. Returns what is applied."""
    a, b = 1.0 / (4.0 * quad.d_m), 1.0 / (4.0 * quad.yaw_arm_m)
    yaw = min(0.15 * lift, max(-0.15 * lift, b * tau_z))
    tx, ty = a * tau_x, a * tau_y
    out[0] = 0.25 * lift - tx + ty + yaw
    out[1] = 0.25 * lift + tx - ty + yaw
    out[2] = 0.25 * lift + tx + ty - yaw
    out[3] = 0.25 * lift - tx - ty - yaw
    for i in range(4):
        out[i] = min(quad.t_max_n, max(quad.t_min_n, out[i]))
    d, c = quad.d_m, quad.yaw_arm_m
    return (
        out[0] + out[1] + out[2] + out[3],
        d * (-out[0] + out[1] + out[2] - out[3]),
        d * (out[0] - out[1] + out[2] - out[3]),
        c * (out[0] + out[1] - out[2] - out[3]),
    )
