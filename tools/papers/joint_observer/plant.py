"""The vehicles of the IADRC paper's experiments: a plus quadrotor with motor lag, drag and rotor gyroscopics, RK4, compiled."""

import math
from typing import NamedTuple

from mavquad import quat
from mavquad.control.iadrc import Body, Four, unmix
from mavquad.jit import kernel

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
SUBSTEPS = 4


class Plant(NamedTuple):
    """The true vehicle: what the model knows, with the truth's numbers, and what the model does not know."""

    body: Body
    rotor_inertia_kg_m2: float  # Jr
    thrust_n_s2: float  # C_T: thrust per rotor speed squared
    fixed: bool  # on a bench: turns, does not move


class Truth(NamedTuple):
    p_ned_m: Vec3
    v_ned_m_s: Vec3
    q_wxyz: Quat
    omega_rad_s: Vec3
    rotors_n: Four


@kernel
def _slope(plant: Plant, x: Truth, target: Four, f: Vec3, tau: Vec3) -> Truth:
    b = plant.body
    F, w, q, v = x.rotors_n, x.omega_rad_s, x.q_wxyz, x.v_ned_m_s
    thrust, torque = unmix(b, F)
    root = math.sqrt(1.0 / plant.thrust_n_s2)
    spin = root * (
        math.sqrt(max(F[0], 0.0)) - math.sqrt(max(F[1], 0.0)) + math.sqrt(max(F[2], 0.0)) - math.sqrt(max(F[3], 0.0))
    )
    jx, jy, jz = b.inertia_kg_m2
    kr, jr = b.rate_drag_nm_s, plant.rotor_inertia_kg_m2
    dw = (
        ((jy - jz) * w[1] * w[2] + torque[0] - kr * w[0] - jr * w[1] * spin) / jx + tau[0],
        ((jz - jx) * w[2] * w[0] + torque[1] - kr * w[1] + jr * w[0] * spin) / jy + tau[1],
        ((jx - jy) * w[0] * w[1] + torque[2] - kr * w[2]) / jz + tau[2],
    )
    turning = quat.mul(q, (0.0, 0.5 * w[0], 0.5 * w[1], 0.5 * w[2]))
    dp, dv = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if not plant.fixed:
        push = quat.rotate(quat.normalize(q), (0.0, 0.0, -thrust / b.mass_kg))
        dp = v
        dv = (
            push[0] - b.drag_1_s * v[0] + f[0],
            push[1] - b.drag_1_s * v[1] + f[1],
            push[2] - b.drag_1_s * v[2] + f[2] + b.gravity_m_s2,
        )
    k = 1.0 / b.motor_lag_s
    dF = (k * (target[0] - F[0]), k * (target[1] - F[1]), k * (target[2] - F[2]), k * (target[3] - F[3]))
    return Truth(dp, dv, turning, dw, dF)


@kernel
def _ahead(x: Truth, s: float, d: Truth) -> Truth:
    p, v, q, w, F = x
    return Truth(
        (p[0] + s * d[0][0], p[1] + s * d[0][1], p[2] + s * d[0][2]),
        (v[0] + s * d[1][0], v[1] + s * d[1][1], v[2] + s * d[1][2]),
        (q[0] + s * d[2][0], q[1] + s * d[2][1], q[2] + s * d[2][2], q[3] + s * d[2][3]),
        (w[0] + s * d[3][0], w[1] + s * d[3][1], w[2] + s * d[3][2]),
        (F[0] + s * d[4][0], F[1] + s * d[4][1], F[2] + s * d[4][2], F[3] + s * d[4][3]),
    )


@kernel
def advance(plant: Plant, x: Truth, target: Four, f_ned_m_s2: Vec3, tau_rad_s2: Vec3, dt_s: float) -> Truth:
    """The vehicle after dt under held rotor commands and disturbances (accelerations): four RK4 steps."""
    h = dt_s / SUBSTEPS
    for _ in range(SUBSTEPS):
        k1 = _slope(plant, x, target, f_ned_m_s2, tau_rad_s2)
        k2 = _slope(plant, _ahead(x, 0.5 * h, k1), target, f_ned_m_s2, tau_rad_s2)
        k3 = _slope(plant, _ahead(x, 0.5 * h, k2), target, f_ned_m_s2, tau_rad_s2)
        k4 = _slope(plant, _ahead(x, h, k3), target, f_ned_m_s2, tau_rad_s2)
        x = _ahead(_ahead(_ahead(_ahead(x, h / 6.0, k1), h / 3.0, k2), h / 3.0, k3), h / 6.0, k4)
        x = Truth(x.p_ned_m, x.v_ned_m_s, quat.normalize(x.q_wxyz), x.omega_rad_s, x.rotors_n)
    return x
