"""Rotation matrices as tuples of nine floats, row by row: body FRD into world NED. The simulator's own maths.

`R v` takes a body vector into the world. Euler angles are yaw, pitch, roll about z, y, x. Quaternions (w, x, y, z) appear only
where MAVLink wants them.
"""

import math

from mavquad.jit import kernel

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@kernel
def matrix(a):
    """Nine floats of an array as a tuple."""
    return (a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8])


@kernel
def apply(R, v):
    """R v."""
    return (
        R[0] * v[0] + R[1] * v[1] + R[2] * v[2],
        R[3] * v[0] + R[4] * v[1] + R[5] * v[2],
        R[6] * v[0] + R[7] * v[1] + R[8] * v[2],
    )


@kernel
def apply_t(R, v):
    """R^T v."""
    return (
        R[0] * v[0] + R[3] * v[1] + R[6] * v[2],
        R[1] * v[0] + R[4] * v[1] + R[7] * v[2],
        R[2] * v[0] + R[5] * v[1] + R[8] * v[2],
    )


@kernel
def mul(A, B):
    """A B."""
    return (
        A[0] * B[0] + A[1] * B[3] + A[2] * B[6],
        A[0] * B[1] + A[1] * B[4] + A[2] * B[7],
        A[0] * B[2] + A[1] * B[5] + A[2] * B[8],
        A[3] * B[0] + A[4] * B[3] + A[5] * B[6],
        A[3] * B[1] + A[4] * B[4] + A[5] * B[7],
        A[3] * B[2] + A[4] * B[5] + A[5] * B[8],
        A[6] * B[0] + A[7] * B[3] + A[8] * B[6],
        A[6] * B[1] + A[7] * B[4] + A[8] * B[7],
        A[6] * B[2] + A[7] * B[5] + A[8] * B[8],
    )


@kernel
def mul_t(A, B):
    """A^T B: the rotation from the axes of A to those of B."""
    return mul((A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8]), B)


@kernel
def exp(r):
    """Rodrigues: the rotation by the vector r (angle about its own direction)."""
    a, b = shares(square(r))
    return turned(r, a, b)


@kernel
def square(r):
    """The length of r, squared."""
    x, y, z = r
    return x * x + y * y + z * z


@kernel
def shares(n2):
    """sin n/n and (1 - cos n)/n^2 of an angle n, from its square."""
    if n2 < 1e-8:  # the series: its next term is below 1e-17
        return 1.0 - n2 / 6.0, 0.5 - n2 / 24.0
    n = math.sqrt(n2)
    return math.sin(n) / n, (1.0 - math.cos(n)) / n2


@kernel
def turned(r, a, b):
    """`exp` of r, whose `shares` are a and b."""
    x, y, z = r
    return (
        1.0 - b * (y * y + z * z),
        b * x * y - a * z,
        b * x * z + a * y,
        b * x * y + a * z,
        1.0 - b * (x * x + z * z),
        b * y * z - a * x,
        b * x * z - a * y,
        b * y * z + a * x,
        1.0 - b * (x * x + y * y),
    )


@kernel
def log(R):
    """The rotation vector of R, angle 0..pi; `exp` turns it back."""
    x, y, z = 0.5 * (R[7] - R[5]), 0.5 * (R[2] - R[6]), 0.5 * (R[3] - R[1])
    c = 0.5 * (R[0] + R[4] + R[8] - 1.0)
    s = math.sqrt(x * x + y * y + z * z)
    angle = math.atan2(s, c)
    if c > 0.0 or s > 1e-5:
        k = 1.0 if s < 1e-12 else angle / s
        return (k * x, k * y, k * z)
    # near half a turn the axis is read from the symmetric part, its sign from the other
    a = math.sqrt(max(0.0, (R[0] - c) / (1.0 - c)))
    b = math.sqrt(max(0.0, (R[4] - c) / (1.0 - c)))
    d = math.sqrt(max(0.0, (R[8] - c) / (1.0 - c)))
    if a >= b and a >= d:
        b, d = math.copysign(b, R[1] + R[3]), math.copysign(d, R[2] + R[6])
    elif b >= d:
        a, d = math.copysign(a, R[1] + R[3]), math.copysign(d, R[5] + R[7])
    else:
        a, b = math.copysign(a, R[2] + R[6]), math.copysign(b, R[5] + R[7])
    k = -angle if a * x + b * y + d * z < 0.0 else angle
    return (k * a, k * b, k * d)


@kernel
def orthonormal(R):
    """The nearest proper rotation to first order: rows made unit and square by one symmetric correction."""
    half = 0.5 * (R[0] * R[3] + R[1] * R[4] + R[2] * R[5])
    ax, ay, az = R[0] - half * R[3], R[1] - half * R[4], R[2] - half * R[5]
    bx, by, bz = R[3] - half * R[0], R[4] - half * R[1], R[5] - half * R[2]
    ka = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
    kb = 1.0 / math.sqrt(bx * bx + by * by + bz * bz)
    ax, ay, az, bx, by, bz = ka * ax, ka * ay, ka * az, kb * bx, kb * by, kb * bz
    return (ax, ay, az, bx, by, bz, ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


@kernel
def from_euler(roll, pitch, yaw):
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr, cp, sp, cy, sy = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw)
    return (
        cp * cy,
        sr * sp * cy - cr * sy,
        cr * sp * cy + sr * sy,
        cp * sy,
        sr * sp * sy + cr * cy,
        cr * sp * sy - sr * cy,
        -sp,
        sr * cp,
        cr * cp,
    )


@kernel
def to_euler(R):
    """(roll, pitch, yaw) of R."""
    return (math.atan2(R[7], R[8]), math.asin(max(-1.0, min(1.0, -R[6]))), math.atan2(R[3], R[0]))


@kernel
def from_quaternion(q):
    """R of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@kernel
def to_quaternion(R):
    """(w, x, y, z) of R with w >= 0; the largest component is found first, so nothing is lost near half a turn."""
    t = R[0] + R[4] + R[8]
    if t >= R[0] and t >= R[4] and t >= R[8]:
        w = 0.5 * math.sqrt(1.0 + t)
        k = 0.25 / w
        return (w, k * (R[7] - R[5]), k * (R[2] - R[6]), k * (R[3] - R[1]))
    if R[0] >= R[4] and R[0] >= R[8]:
        x = 0.5 * math.sqrt(1.0 + R[0] - R[4] - R[8])
        k = 0.25 / x
        q = (k * (R[7] - R[5]), x, k * (R[1] + R[3]), k * (R[2] + R[6]))
    elif R[4] >= R[8]:
        y = 0.5 * math.sqrt(1.0 - R[0] + R[4] - R[8])
        k = 0.25 / y
        q = (k * (R[2] - R[6]), k * (R[1] + R[3]), y, k * (R[5] + R[7]))
    else:
        z = 0.5 * math.sqrt(1.0 - R[0] - R[4] + R[8])
        k = 0.25 / z
        q = (k * (R[3] - R[1]), k * (R[2] + R[6]), k * (R[5] + R[7]), z)
    if q[0] < 0.0:
        return (-q[0], -q[1], -q[2], -q[3])
    return q


@kernel
def towards(force, yaw):
    """The attitude whose thrust axis (-z) points along `force` (world, upwards) and whose nose has the heading `yaw`."""
    n = math.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
    zx, zy, zz = -force[0] / n, -force[1] / n, -force[2] / n
    # x axis: square to z and to the horizontal that lies to the right of the heading
    cy, sy = math.cos(yaw), math.sin(yaw)
    xx, xy, xz = cy * zz, sy * zz, -sy * zy - cy * zx
    k = 1.0 / math.sqrt(xx * xx + xy * xy + xz * xz)
    xx, xy, xz = k * xx, k * xy, k * xz
    yx, yy, yz = zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx
    return (xx, yx, zx, xy, yy, zy, xz, yz, zz)
