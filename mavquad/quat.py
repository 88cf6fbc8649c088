"""Unit quaternions as kernels.

Conventions, stated once: Hamilton, scalar first (w, x, y, z), body to world, FRD body, NED world, radians. A quaternion is a
tuple of four floats; q and -q are one attitude.
"""

import math

from mavquad.jit import kernel

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]

IDENTITY: Quat = (1.0, 0.0, 0.0, 0.0)


@kernel
def mul(a: Quat, b: Quat) -> Quat:
    """Hamilton product a (x) b: first b, then a, when both rotate body vectors into the world."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@kernel
def conj(q: Quat) -> Quat:
    return (q[0], -q[1], -q[2], -q[3])


@kernel
def norm(q: Quat) -> float:
    return math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])


@kernel
def normalize(q: Quat) -> Quat:
    """q/|q|; a zero or non-finite q gives NaN, for the caller to have refused before."""
    n = norm(q)
    if not n > 0.0:
        return (math.nan, math.nan, math.nan, math.nan)
    return (q[0] / n, q[1] / n, q[2] / n, q[3] / n)


@kernel
def rotate(q: Quat, v: Vec3) -> Vec3:
    """A body vector in the world: v + 2 w (u x v) + 2 u x (u x v)."""
    tx = 2.0 * (q[2] * v[2] - q[3] * v[1])
    ty = 2.0 * (q[3] * v[0] - q[1] * v[2])
    tz = 2.0 * (q[1] * v[1] - q[2] * v[0])
    return (
        v[0] + q[0] * tx + q[2] * tz - q[3] * ty,
        v[1] + q[0] * ty + q[3] * tx - q[1] * tz,
        v[2] + q[0] * tz + q[1] * ty - q[2] * tx,
    )


@kernel
def rotate_back(q: Quat, v: Vec3) -> Vec3:
    """A world vector in the body."""
    return rotate(conj(q), v)


@kernel
def exp(phi: Vec3) -> Quat:
    """The unit quaternion of a rotation vector [rad]."""
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if angle2 < 1e-12:
        s = 0.5 - angle2 / 48.0
        return (1.0 - angle2 / 8.0, s * phi[0], s * phi[1], s * phi[2])
    angle = math.sqrt(angle2)
    s = math.sin(0.5 * angle) / angle
    return (math.cos(0.5 * angle), s * phi[0], s * phi[1], s * phi[2])


@kernel
def log(q: Quat) -> Vec3:
    """The shortest rotation vector [rad] of a unit quaternion: log(q) = log(-q), norm <= pi."""
    sign = 1.0 if q[0] >= 0.0 else -1.0
    w = sign * q[0]
    s2 = q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    s = math.sqrt(s2)
    if s < 1e-8:
        k = sign * 2.0 / max(w, 0.5)
    else:
        k = sign * 2.0 * math.atan2(s, w) / s
    return (k * q[1], k * q[2], k * q[3])


@kernel
def cayley(xi: Vec3) -> Quat:
    """The Cayley map of the quaternion algebra; xi in rotation-vector scale, xi/4 = tan(angle/4) n (paper 000, Eq. 21)."""
    n2 = xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2]
    d = 1.0 / (16.0 + n2)
    return ((16.0 - n2) * d, 8.0 * xi[0] * d, 8.0 * xi[1] * d, 8.0 * xi[2] * d)


@kernel
def cayley_inverse(q: Quat) -> Vec3:
    """cay^-1(q) = 4 v(q)/(1 + q0)."""
    k = 4.0 / (1.0 + q[0])
    return (k * q[1], k * q[2], k * q[3])


@kernel
def from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quat:
    """ZYX Euler angles: yaw first, then pitch, then roll."""
    cr, sr = math.cos(0.5 * roll_rad), math.sin(0.5 * roll_rad)
    cp, sp = math.cos(0.5 * pitch_rad), math.sin(0.5 * pitch_rad)
    cy, sy = math.cos(0.5 * yaw_rad), math.sin(0.5 * yaw_rad)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@kernel
def to_euler(q: Quat) -> Vec3:
    """(roll, pitch, yaw) [rad], ZYX; at pitch +-90 deg roll and yaw share one freedom and roll carries it."""
    w, x, y, z = q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    s = 2.0 * (w * y - z * x)
    pitch = math.asin(min(1.0, max(-1.0, s)))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return (roll, pitch, yaw)


@kernel
def yaw(q: Quat) -> float:
    """Heading [rad] of the body x axis."""
    return math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))


@kernel
def integrate(q: Quat, omega_rad_s: Vec3, dt_s: float) -> Quat:
    """q after dt at constant body rates: q (x) exp(w dt)."""
    return mul(q, exp((omega_rad_s[0] * dt_s, omega_rad_s[1] * dt_s, omega_rad_s[2] * dt_s)))
