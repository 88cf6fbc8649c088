"""The flown model of `mpc_flight.py` and `iadrc_flight.py`, and the MPC's law, as kernels: lagged thrust acceleration, drag, limits.

States of an axis are p, v and the thrust acceleration a with a' = (u - a)/tau; the flight faces make the gains and run the steps.
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad import linalg, quat
from mavquad.airframe import Airframe
from mavquad.jit import kernel
from mavquad.signals import Quat, Vec3

G_M_S2 = 9.80665
RATE_FILTER_S = 0.04


class Law(NamedTuple):
    """What the kernels need."""

    k: Vec3  # horizontal: on position, velocity, acceleration
    k_down: Vec3
    k_soft: Vec3  # for a delay beyond what is predicted
    lag_s: float
    lag_down_s: float
    jerk: float
    compensate: float  # 0 or 1
    drag_linear_1_s: Vec3
    drag_quadratic_1_m: Vec3
    drag: float
    integral: float
    tan_tilt: float
    down_min_m_s2: float
    down_max_m_s2: float
    slew_m_s3: float


class Vehicle(NamedTuple):
    """The part of it that says how the vehicle answers and what it may do, for a law of another kind."""

    lag_s: float
    lag_down_s: float
    drag_linear_1_s: Vec3
    drag_quadratic_1_m: Vec3
    tan_tilt: float
    down_min_m_s2: float
    down_max_m_s2: float


def response(airframe: Airframe, lag_s: float, delay_s: float) -> tuple[float, float]:
    """(lag, delay) of a first-order response with the mean delay and spread of the airframe's second-order one; >= 0 wins."""
    a = airframe.attitude
    mean = 2.0 * a.damping / a.natural_frequency_rad_s
    spread = math.sqrt(max(mean * mean - 2.0 / a.natural_frequency_rad_s**2, (0.4 * mean) ** 2))
    return (lag_s if lag_s >= 0.0 else spread), (delay_s if delay_s >= 0.0 else a.delay_s + mean - spread)


@kernel
def drag_along(linear: Vec3, quadratic: Vec3, v: Vec3, a: Vec3) -> tuple[Vec3, Vec3]:
    """Acceleration by drag at the velocity v, and its rate of change under the acceleration a."""
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    along = (v[0] * a[0] + v[1] * a[1] + v[2] * a[2]) / speed if speed > 1e-6 else 0.0
    c0, c1, c2 = linear[0] + quadratic[0] * speed, linear[1] + quadratic[1] * speed, linear[2] + quadratic[2] * speed
    d = (-c0 * v[0], -c1 * v[1], -c2 * v[2])
    rate = (
        -c0 * a[0] - quadratic[0] * along * v[0],
        -c1 * a[1] - quadratic[1] * along * v[1],
        -c2 * a[2] - quadratic[2] * along * v[2],
    )
    return d, rate


@kernel
def ahead(
    g: Law | Vehicle, p: Vec3, v: Vec3, a: Vec3, rest: Vec3, queue: np.ndarray, now_s: float, delay_s: float, span_s: float
) -> tuple[Vec3, Vec3, Vec3]:
    """(p, v, a) after span_s: each command acts delay_s after its stamp, the acceleration follows it with the lag.

    rest: disturbance beyond the airframe's drag, constant on the way. Exact between the instants at which commands take over,
    but for the drag, which is taken at the beginning of each piece.
    """
    last = len(queue) - 1
    i = last
    while i > 0 and queue[i, 0] > now_s - delay_s:
        i -= 1
    at = 0.0  # seconds from now
    while at < span_s:
        until = span_s
        if i < last:
            until = min(span_s, queue[i + 1, 0] + delay_s - now_s)
        h = until - at
        if h > 0.0:
            d, _ = drag_along(g.drag_linear_1_s, g.drag_quadratic_1_m, v, (0.0, 0.0, 0.0))
            eh, ed = math.exp(-h / g.lag_s), math.exp(-h / g.lag_down_s)
            u = (a[0], a[1], a[2])
            if queue[i, 0] > -1e8:
                u = (queue[i, 1], queue[i, 2], queue[i, 3])
            pn, vn, an = _piece(p[0], v[0], a[0], u[0], d[0] + rest[0], h, g.lag_s, eh)
            pe, ve, ae = _piece(p[1], v[1], a[1], u[1], d[1] + rest[1], h, g.lag_s, eh)
            pd, vd, ad = _piece(p[2], v[2], a[2], u[2], d[2] + rest[2], h, g.lag_down_s, ed)
            p, v, a = (pn, pe, pd), (vn, ve, vd), (an, ae, ad)
        at = until
        if i < last:
            i += 1
        elif at < span_s:
            break
    return p, v, a


@kernel
def _piece(p, v, a, u, f, h, lag_s, keep):
    """p, v, a after h of constant u and f: v' = a + f, a' = (u - a)/lag; keep = exp(-h/lag)."""
    gap = a - u
    fall = lag_s * (1.0 - keep)  # integral of exp(-t/lag)
    return (
        p + h * v + 0.5 * h * h * (u + f) + gap * lag_s * (h - fall),
        v + h * (u + f) + gap * fall,
        u + keep * gap,
    )


@kernel
def limited(g: Law | Vehicle, u: Vec3) -> Vec3:
    """Vertical first, then the horizontal part into the cone: the acceleration of a thrust vector that the vehicle may have."""
    down = min(g.down_max_m_s2, max(g.down_min_m_s2, G_M_S2 - u[2]))
    north, east = u[0], u[1]
    size, most = math.sqrt(north * north + east * east), down * g.tan_tilt
    if size > most:
        north, east = north * most / size, east * most / size
    return (north, east, G_M_S2 - down)


@kernel
def slewed(u: Vec3, last: Vec3, most: float) -> Vec3:
    """Each axis at most `most` from the last command; NaN: there is none."""
    if not math.isfinite(last[0]):
        return u
    return (
        min(last[0] + most, max(last[0] - most, u[0])),
        min(last[1] + most, max(last[1] - most, u[1])),
        min(last[2] + most, max(last[2] - most, u[2])),
    )


@kernel
def path_part(g: Law, v: Vec3, rest: Vec3, v_ref: Vec3, a_ref: Vec3, j_ref: Vec3) -> tuple[Vec3, Vec3]:
    """(thrust acceleration the path needs, command that brings it about with the lag)."""
    d, rate = drag_along(g.drag_linear_1_s, g.drag_quadratic_1_m, v_ref, a_ref)
    felt, _ = drag_along(g.drag_linear_1_s, g.drag_quadratic_1_m, v, a_ref)
    # drag along the path fed forward (share 1), or what is felt now cancelled (share 0)
    s, c = g.drag, (1.0 - g.drag) * g.compensate
    n = a_ref[0] - s * d[0] - c * felt[0] - g.compensate * rest[0]
    e = a_ref[1] - s * d[1] - c * felt[1] - g.compensate * rest[1]
    w = a_ref[2] - s * d[2] - c * felt[2] - g.compensate * rest[2]
    k, kd = g.jerk * g.lag_s, g.jerk * g.lag_down_s
    return (n, e, w), (n + k * (j_ref[0] - s * rate[0]), e + k * (j_ref[1] - s * rate[1]), w + kd * (j_ref[2] - s * rate[2]))


@kernel
def feedback(k: Vec3, k_down: Vec3, e_p: Vec3, e_v: Vec3, e_a: Vec3) -> Vec3:
    """-K e on every axis."""
    return (
        -(k[0] * e_p[0] + k[1] * e_v[0] + k[2] * e_a[0]),
        -(k[0] * e_p[1] + k[1] * e_v[1] + k[2] * e_a[1]),
        -(k_down[0] * e_p[2] + k_down[1] * e_v[2] + k_down[2] * e_a[2]),
    )


@kernel
def grown(integral: Vec3, e: Vec3, wanted: Vec3, given: Vec3, dt_s: float) -> Vec3:
    """The integral of the position error [m s], frozen on an axis that is cut and would be driven further, clamped."""
    out = (0.0, 0.0, 0.0)
    for i in range(3):
        x = integral[i]
        if not (abs(wanted[i] - given[i]) > 1e-9 and e[i] * (wanted[i] - given[i]) < 0.0):
            x = min(2.0, max(-2.0, x + dt_s * e[i]))
        if i == 0:
            out = (x, out[1], out[2])
        elif i == 1:
            out = (out[0], x, out[2])
        else:
            out = (out[0], out[1], x)
    return out


@kernel
def turning(a: Vec3, axis: Vec3, yaw_rad: float, yaw_rate_rad_s: float, dt_s: float) -> tuple[Vec3, Vec3]:
    """(filtered axis, body rates): how fast the thrust axis of the command turns, through a 40 ms filter."""
    x, y, z = -a[0], -a[1], G_M_S2 - a[2]
    size = math.sqrt(x * x + y * y + z * z)
    n = (x / size, y / size, z / size)
    if not math.isfinite(axis[0]):
        axis = n
    keep = math.exp(-dt_s / RATE_FILTER_S)
    new = (n[0] + keep * (axis[0] - n[0]), n[1] + keep * (axis[1] - n[1]), n[2] + keep * (axis[2] - n[2]))
    dx, dy, dz = (new[0] - axis[0]) / dt_s, (new[1] - axis[1]) / dt_s, (new[2] - axis[2]) / dt_s
    # world rate n x n', plus the heading's
    wx, wy, wz = n[1] * dz - n[2] * dy, n[2] * dx - n[0] * dz, n[0] * dy - n[1] * dx + yaw_rate_rad_s
    # body axes: z along n, x in the vertical plane of the heading
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    bx, by, bz = cy * n[2], sy * n[2], -(cy * n[0] + sy * n[1])
    size = math.sqrt(bx * bx + by * by + bz * bz)
    bx, by, bz = bx / size, by / size, bz / size
    ex, ey, ez = n[1] * bz - n[2] * by, n[2] * bx - n[0] * bz, n[0] * by - n[1] * bx
    return new, (wx * bx + wy * by + wz * bz, wx * ex + wy * ey + wz * ez, wx * n[0] + wy * n[1] + wz * n[2])


@kernel
def thrust_acceleration(q: Quat, thrust_m_s2: float) -> Vec3:
    """g e3 - T R e3."""
    up = quat.rotate(q, (0.0, 0.0, thrust_m_s2))
    return (-up[0], -up[1], G_M_S2 - up[2])


@kernel
def law_of(record):
    """The Law in a record's item."""
    linear, quadratic = record.drag_linear_1_s, record.drag_quadratic_1_m
    return Law(
        (record.k[0], record.k[1], record.k[2]),
        (record.k_down[0], record.k_down[1], record.k_down[2]),
        (record.k_soft[0], record.k_soft[1], record.k_soft[2]),
        record.lag_s,
        record.lag_down_s,
        record.jerk,
        record.compensate,
        (linear[0], linear[1], linear[2]),
        (quadratic[0], quadratic[1], quadratic[2]),
        record.drag,
        record.integral,
        record.tan_tilt,
        record.down_min_m_s2,
        record.down_max_m_s2,
        record.slew_m_s3,
    )


@kernel
def rest_of(g: Law, f_max: float, f: Vec3, v: Vec3) -> Vec3:
    """The disturbance beyond the airframe's own drag, clipped."""
    if not (math.isfinite(f[0]) and math.isfinite(f[1]) and math.isfinite(f[2])):
        return (0.0, 0.0, 0.0)
    d, _ = drag_along(g.drag_linear_1_s, g.drag_quadratic_1_m, v, (0.0, 0.0, 0.0))
    m = f_max
    return (min(m, max(-m, f[0] - d[0])), min(m, max(-m, f[1] - d[1])), min(m, max(-m, f[2] - d[2])))


@kernel
def aimed(g, f_max, predict, queue, integral, begun, estimate, delays, demand, dt_s):
    """The closed form: (v, rest, path's command, integral's share, errors of p v a, free command, the last one, command in its limits).

    estimate: p, v, q, thrust [m/s^2], f, now [s]; delays: until a command reaches the vehicle, until the attitude begins to follow, until
    the thrust does [s], whether to fly gently; demand: p, v, a, jerk where the prediction ends; begun: a command was sent before.
    """
    p, v, q, thrust, f, now_s = estimate
    link_s, level_s, down_s, gently = delays
    p_ref, v_ref, a_ref, j_ref = demand
    a = thrust_acceleration(q, thrust if math.isfinite(thrust) else G_M_S2)
    rest = rest_of(g, f_max, f, v)
    if predict:
        level = ahead(g, p, v, a, rest, queue, now_s, level_s - link_s, level_s)
        down = ahead(g, p, v, a, rest, queue, now_s, down_s - link_s, down_s)
        p, v, a = mixed(level[0], down[0]), mixed(level[1], down[1]), mixed(level[2], down[2])
    wanted, forward = path_part(g, v, rest, v_ref, a_ref, j_ref)
    e_p, e_v, e_a = linalg.sub(p, p_ref), linalg.sub(v, v_ref), linalg.sub(a, wanted)
    slow = linalg.scale(-g.integral, integral)
    free = linalg.add(linalg.add(forward, slow), feedback(g.k_soft if gently else g.k, g.k_down, e_p, e_v, e_a))
    last = (math.nan, math.nan, math.nan)
    if begun:
        newest = len(queue) - 1
        last = (queue[newest, 1], queue[newest, 2], queue[newest, 3])
    return v, rest, forward, slow, e_p, e_v, e_a, free, last, slewed(limited(g, free), last, g.slew_m_s3 * max(dt_s, 1e-3))


@kernel
def sent(g, queue, integral, e_p, free, command, f, acts_s, dt_s):
    """(queue with the command, integral, disturbance that the command cancels)."""
    if g.integral > 0.0:
        integral = grown(integral, e_p, free, command, dt_s)
    out = np.empty_like(queue)
    n = len(queue)
    out[: n - 1] = queue[1:]
    out[n - 1, 0] = max(acts_s, out[n - 2, 0])  # none overtakes another
    for i in range(3):
        out[n - 1, 1 + i] = command[i]
    return out, integral, linalg.scale(g.compensate, f) if math.isfinite(f[0]) else (0.0, 0.0, 0.0)


@kernel
def closed(law, f_max, predict, queue, integral, begun, estimate, delays, demand, dt_s):
    """A step without constraints: (queue, integral, command, disturbance that it cancels). law: its record (1,); the rest as for `aimed`."""
    g = law_of(law[0])
    _, _, _, _, e_p, _, _, free, _, command = aimed(g, f_max, predict, queue, integral, begun, estimate, delays, demand, dt_s)
    queue, integral, cancelled = sent(g, queue, integral, e_p, free, command, estimate[4], estimate[5] + delays[0], dt_s)
    return queue, integral, command, cancelled


@kernel
def delays_of(predict, own_s, own_down_s, most_s, link_s):
    """(until a command reaches the vehicle, until the attitude begins to follow, until the thrust does [s], whether to fly gently).

    A delay out of range is not predicted through, but flown gently.
    """
    if not predict:
        return 0.0, 0.0, 0.0, False
    link, gently = link_s if math.isfinite(link_s) else 0.0, False
    if not 0.0 <= own_s + link <= most_s:
        gently, link = True, min(max(0.0, most_s - own_s), max(0.0, link))
    return link, own_s + link, own_down_s + link, gently


@kernel
def mixed(level: Vec3, down: Vec3) -> Vec3:
    """The horizontal axes of one, the vertical one of the other."""
    return (level[0], level[1], down[2])


@kernel
def between(knots: np.ndarray, stages: int, every: int) -> np.ndarray:
    """Linear interpolation of the rows of `knots`, `every` stages apart."""
    out = np.empty((stages, 3))
    for j in range(stages):
        i = j // every
        w = (j - i * every) / every
        for c in range(3):
            out[j, c] = (1.0 - w) * knots[i, c] + w * knots[i + 1, c]
    return out
