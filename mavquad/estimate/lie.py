"""Lie-group integration of attitude and body rates: steps in the Lie algebra, carried to the unit sphere by one map.

Every step multiplies the quaternion by a unit quaternion, so the norm is kept by construction and never reset. `xi` and every
other algebra element is in rotation-vector scale [rad]; `gyro` is ((J2-J3)/J1, (J3-J1)/J2, (J1-J2)/J3) and zero where the
inertia is unknown; `a0, a1, a2` are torque over inertia [rad/s^2] at the beginning, the middle and the end of the step; `i1`
[rad/s] and `i2` [rad/s^2] are an observer's injections, frozen within the step (never evaluate a sign inside a stage).

Source: An et al. 2013, Eqs. (19)-(25), (30); Munthe-Kaas' method with the Cayley map of the quaternion algebra.

Deviations from the paper:
  Eq. (22)  in vectors, for the body-side product used here, the bracket has a plus: right multiplication reverses the order.
            As printed (minus) it belongs to q = cay(xi) (x) q0 with world rates: `dcay_inv_world`. Only order 4 sees the slip.
  Eq. (30)  order 1 only; orders 2 (midpoint) and 4 (classical) are ours.
"""

import math

from mavquad import linalg, quat
from mavquad.jit import kernel
from mavquad.quat import Quat, Vec3

CAYLEY, EXP, EULER = 0, 1, 2  # maps from the algebra to the group; EULER is q + h q'/2 brought back to unit length


@kernel
def dcay_inv_body(xi: Vec3, w: Vec3) -> Vec3:
    """dcay^-1_xi(w) for q(t) = q0 (x) cay(xi(t)) and body rates w: the kinematics of modified Rodrigues parameters."""
    return dcay_inv(xi, w, 0.5)


@kernel
def dcay_inv_world(xi: Vec3, w: Vec3) -> Vec3:
    """dcay^-1_xi(w) for q(t) = cay(xi(t)) (x) q0 and world rates w."""
    return dcay_inv(xi, w, -0.5)


@kernel
def dcay_inv(xi: Vec3, w: Vec3, bracket: float) -> Vec3:
    """(1 - |xi|^2/16) w + bracket xi x w + (xi.w) xi / 8: Eq. (22) in vectors, +1/2 for the body side, -1/2 for the world."""
    c = linalg.cross(xi, w)
    keep = 1.0 - linalg.dot(xi, xi) / 16.0
    along = linalg.dot(xi, w) / 8.0
    return (
        keep * w[0] + bracket * c[0] + along * xi[0],
        keep * w[1] + bracket * c[1] + along * xi[1],
        keep * w[2] + bracket * c[2] + along * xi[2],
    )


@kernel
def rate_derivative(gyro: Vec3, w: Vec3, a: Vec3) -> Vec3:
    """Euler's equation J w' = M - w x J w per axis, with a = M/J [rad/s^2]."""
    return (a[0] + gyro[0] * w[1] * w[2], a[1] + gyro[1] * w[2] * w[0], a[2] + gyro[2] * w[0] * w[1])


@kernel
def increment(group_map: int, xi: Vec3) -> Quat:
    """The unit quaternion of an algebra element: Cayley (Eq. 21), exponential, or normalised Euler."""
    if group_map == CAYLEY:
        return quat.cayley(xi)
    if group_map == EXP:
        return quat.exp(xi)
    n = 1.0 / math.sqrt(1.0 + 0.25 * linalg.dot(xi, xi))
    return (n, 0.5 * n * xi[0], 0.5 * n * xi[1], 0.5 * n * xi[2])


@kernel
def step_1(group_map: int, gyro: Vec3, q: Quat, w: Vec3, a0: Vec3, i1: Vec3, i2: Vec3, h: float) -> tuple[Quat, Vec3]:
    """The paper's Lie-Euler step, Eq. (30): xi from the old rate, q from the new xi, w from the old w."""
    xi = (h * (w[0] - i1[0]), h * (w[1] - i1[1]), h * (w[2] - i1[2]))
    f = rate_derivative(gyro, w, a0)
    return quat.mul(q, increment(group_map, xi)), linalg.axpy(h, linalg.sub(f, i2), w)


@kernel
def step_2(group_map: int, gyro: Vec3, q: Quat, w: Vec3, a0: Vec3, a1: Vec3, i1: Vec3, i2: Vec3, h: float) -> tuple[Quat, Vec3]:
    """Midpoint step, order 2. With the exponential (and Euler) the midpoint rate is taken over the whole step: same order."""
    f = rate_derivative(gyro, w, a0)
    w_mid = linalg.axpy(0.5 * h, linalg.sub(f, i2), w)
    xi = linalg.scale(h, linalg.sub(w_mid, i1))
    if group_map == CAYLEY:
        xi = dcay_inv_body(linalg.scale(0.5 * h, linalg.sub(w, i1)), xi)
    f = rate_derivative(gyro, w_mid, a1)
    return quat.mul(q, increment(group_map, xi)), linalg.axpy(h, linalg.sub(f, i2), w)


@kernel
def step_4(gyro: Vec3, q: Quat, w: Vec3, a0: Vec3, a1: Vec3, a2: Vec3, i1: Vec3, i2: Vec3, h: float) -> tuple[Quat, Vec3]:
    """Classical Runge-Kutta-Munthe-Kaas step of order 4 with the Cayley map."""
    l1 = linalg.sub(rate_derivative(gyro, w, a0), i2)
    k1 = linalg.sub(w, i1)
    w2 = linalg.axpy(0.5 * h, l1, w)
    l2 = linalg.sub(rate_derivative(gyro, w2, a1), i2)
    k2 = dcay_inv_body(linalg.scale(0.5 * h, k1), linalg.sub(w2, i1))
    w3 = linalg.axpy(0.5 * h, l2, w)
    l3 = linalg.sub(rate_derivative(gyro, w3, a1), i2)
    k3 = dcay_inv_body(linalg.scale(0.5 * h, k2), linalg.sub(w3, i1))
    w4 = linalg.axpy(h, l3, w)
    l4 = linalg.sub(rate_derivative(gyro, w4, a2), i2)
    k4 = dcay_inv_body(linalg.scale(h, k3), linalg.sub(w4, i1))
    c = h / 6.0
    xi = (
        c * (k1[0] + 2.0 * k2[0] + 2.0 * k3[0] + k4[0]),
        c * (k1[1] + 2.0 * k2[1] + 2.0 * k3[1] + k4[1]),
        c * (k1[2] + 2.0 * k2[2] + 2.0 * k3[2] + k4[2]),
    )
    w_next = (
        w[0] + c * (l1[0] + 2.0 * l2[0] + 2.0 * l3[0] + l4[0]),
        w[1] + c * (l1[1] + 2.0 * l2[1] + 2.0 * l3[1] + l4[1]),
        w[2] + c * (l1[2] + 2.0 * l2[2] + 2.0 * l3[2] + l4[2]),
    )
    return quat.mul(q, quat.cayley(xi)), w_next


@kernel
def attitude_error(q_meas: Quat, q_hat: Quat) -> Vec3:
    """Rotation vector [rad] of q_meas* (x) q_hat, Eq. (23), by the shortest way: q and -q are one attitude."""
    return quat.log(quat.mul(quat.conj(q_meas), q_hat))


@kernel
def vector_error(q_meas: Quat, q_hat: Quat) -> Vec3:
    """e = 2 sgn(q_e0) v(q_e) with q_e = q_meas* (x) q_hat: Eq. (23) with the sign of the double cover."""
    qe = quat.mul(quat.conj(q_meas), q_hat)
    s = 2.0 if qe[0] >= 0.0 else -2.0
    return (s * qe[1], s * qe[2], s * qe[3])
