"""A wanted inertial acceleration and heading as attitude and specific thrust.

v' = g e3 - T R e3, so the thrust vector is T R e3 = g e3 - a. (Paper 003, Eq. 19, without Euler angles.)
"""

import math

from mavquad.jit import kernel
from mavquad.signals import Quat, Vec3

G_M_S2 = 9.80665


@kernel
def thrust_vector(a_ned_m_s2: Vec3, tilt_max_rad: float, vertical_min_m_s2: float, vertical_max_m_s2: float) -> Vec3:
    """g e3 - a inside a cone: the vertical part is clipped first, then the horizontal one; NED, pointing down along +z body."""
    down = G_M_S2 - a_ned_m_s2[2]
    if down < vertical_min_m_s2:
        down = vertical_min_m_s2
    elif down > vertical_max_m_s2:
        down = vertical_max_m_s2
    north, east = -a_ned_m_s2[0], -a_ned_m_s2[1]
    horizontal = math.sqrt(north * north + east * east)
    most = down * math.tan(tilt_max_rad)
    if horizontal > most:
        north, east = north * most / horizontal, east * most / horizontal
    return (north, east, down)


@kernel
def attitude(thrust_ned_m_s2: Vec3, yaw_rad: float) -> tuple[Quat, float]:
    """(q_wxyz, specific thrust [m/s^2]) whose body z axis lies along the thrust vector and whose heading is yaw."""
    x, y, z = thrust_ned_m_s2
    size = math.sqrt(x * x + y * y + z * z)
    zx, zy, zz = x / size, y / size, z / size
    # the shortest turn from vertical to the thrust axis, then yaw about the body axis so that heading comes out as wanted
    w = math.sqrt(max(0.0, 0.5 * (1.0 + zz)))
    tx, ty = -zy / (2.0 * w), zx / (2.0 * w)
    # heading of the tilted frame with no twist: body x = (1 - 2 ty^2, 2 tx ty, .); twist until atan2 gives yaw
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    # body x must lie in the vertical plane of the heading: x_b ~ z_b cross-free direction (cos, sin, s) with x_b . z_b = 0
    bx, by, bz = cy * zz, sy * zz, -(cy * zx + sy * zy)
    n = math.sqrt(bx * bx + by * by + bz * bz)
    bx, by, bz = bx / n, by / n, bz / n
    # twist angle between the untwisted x axis and the wanted one, about the thrust axis
    ux, uy, uz = 1.0 - 2.0 * ty * ty, 2.0 * tx * ty, -2.0 * w * ty
    vx, vy, vz = zy * uz - zz * uy, zz * ux - zx * uz, zx * uy - zy * ux
    twist = math.atan2(bx * vx + by * vy + bz * vz, bx * ux + by * uy + bz * uz)
    c, s = math.cos(0.5 * twist), math.sin(0.5 * twist)
    # (w, tx, ty, 0) (x) (c, 0, 0, s)
    return ((w * c, tx * c + ty * s, ty * c - tx * s, w * s), size)


@kernel
def pointing(a_ned_m_s2: Vec3, yaw_rad: float, tilt_max_rad: float) -> tuple[Quat, float, float]:
    """(q_wxyz, specific thrust, its vertical part [m/s^2]) for an acceleration and a heading, thrust within 0.2 to 1.8 g."""
    thrust = thrust_vector(a_ned_m_s2, tilt_max_rad, 0.2 * G_M_S2, 1.8 * G_M_S2)
    q, size = attitude(thrust, yaw_rad)
    return q, size, thrust[2]
