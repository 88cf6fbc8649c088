"""Paths to fly: position, velocity, acceleration and jerk at any time, starting and ending at rest.

A path is a curve r(s) from the point where the vehicle engages, and a timing s(t) that speeds up and slows down smoothly, so
v = r' s', a = r'' s'^2 + r' s'', j = r''' s'^3 + 3 r'' s' s'' + r' s'''. Legs of `line` and `rectangle` are flown from rest to rest.
"""

import math
from typing import Literal, NamedTuple

from mavquad import config
from mavquad.errors import ConfigError
from mavquad.jit import kernel
from mavquad.signals import Demand

Vec3 = tuple[float, float, float]
NAMES = ("hover", "circle", "spiral", "rectangle", "line", "ellipse")
_HOVER, _CIRCLE, _SPIRAL, _RECTANGLE, _LINE, _ELLIPSE = range(6)


class Path(config.Section, frozen=True):
    """[path] of a companion file. Only the keys of the named path are used."""

    name: Literal["hover", "circle", "spiral", "rectangle", "line", "ellipse"] = "hover"
    duration_s: float = 30.0  # hover
    radius_m: float = 3.0  # circle
    speed_m_s: float = 2.0
    turns: float = 2.0  # circle, ellipse, spiral
    accel_m_s2: float = 1.0  # largest along the path while it speeds up and slows down
    length_m: float = 200.0  # line
    size_m: tuple[float, float] = (4.0, 3.0)  # rectangle: north, east
    semi_axes_m: tuple[float, float] = (20.0, 17.5)  # ellipse: north, east; speed_m_s is at the mean of both
    period_s: float = 40.0  # spiral
    course_deg: float = 0.0  # turns the whole path about the vertical

    def __post_init__(self) -> None:
        for key in ("duration_s", "radius_m", "speed_m_s", "turns", "accel_m_s2", "length_m", "period_s"):
            if not 0.0 < getattr(self, key) < 1e5:
                raise ConfigError(f"path.{key} = {getattr(self, key)}: expected a number > 0")
        if min(*self.size_m, *self.semi_axes_m) <= 0.0:
            raise ConfigError(f"path.size_m = {self.size_m}, path.semi_axes_m = {self.semi_axes_m}: expected numbers > 0")
        if self.speed_m_s > 30.0 or self.accel_m_s2 > 10.0:
            raise ConfigError(
                f"path.speed_m_s = {self.speed_m_s}, path.accel_m_s2 = {self.accel_m_s2}: at most 30 m/s, 10 m/s^2"
            )


class Plan(NamedTuple):
    """A path as numbers: kind, the two sizes, timing in units of the curve's parameter, and its course."""

    kind: int
    a: float
    b: float
    s_end: float  # length of one leg, or the whole angle
    s_dot: float  # cruise
    ramp_s: float  # time to cruise and from it
    duration_s: float
    cos_course: float
    sin_course: float


def plan(path: Path) -> Plan:
    """The numbers of a path, its duration among them."""
    c, s = math.cos(math.radians(path.course_deg)), math.sin(math.radians(path.course_deg))
    ramp_s = 1.875 * path.speed_m_s / path.accel_m_s2  # the quintic ramp's steepest slope is 1.875 times its mean
    kind = NAMES.index(path.name)
    if kind == _HOVER:
        return Plan(kind, 0.0, 0.0, 0.0, 0.0, 1.0, path.duration_s, c, s)
    if kind in (_LINE, _RECTANGLE):
        a, b = (path.length_m, 0.0) if kind == _LINE else path.size_m
        legs = 2.0 * _leg_time(a, path.speed_m_s, ramp_s)
        if kind == _RECTANGLE:
            legs += 2.0 * _leg_time(b, path.speed_m_s, ramp_s)
        return Plan(kind, a, b, a, path.speed_m_s, ramp_s, legs, c, s)
    if kind == _SPIRAL:
        rate = 2.0 * math.pi / path.period_s
        return Plan(kind, 0.5, 2.0, 2.0 * math.pi * path.turns, rate, 2.0, 2.0 + path.turns * path.period_s, c, s)
    a, b = (path.radius_m, path.radius_m) if kind == _CIRCLE else path.semi_axes_m
    rate = path.speed_m_s / (0.5 * (a + b))
    angle = 2.0 * math.pi * path.turns
    return Plan(kind, a, b, angle, rate, ramp_s, _leg_time(angle, rate, ramp_s), c, s)


@kernel
def _leg_time(length: float, speed: float, ramp_s: float) -> float:
    """Time for a leg from rest to rest; a leg too short for cruise is flown by ramps at a lower speed."""
    if length < speed * ramp_s:
        return 2.0 * math.sqrt(length * ramp_s / speed)
    return length / speed + ramp_s


@kernel
def _timing(t_s: float, length: float, speed: float, ramp_s: float) -> tuple[float, float, float, float]:
    """s, s', s'', s''' of a leg from rest to rest: quintic ramps (zero slope and curvature of s' at both ends) around a cruise."""
    if length < speed * ramp_s:  # keep the acceleration: shorten the ramp and the speed alike
        shrink = math.sqrt(length / (speed * ramp_s))
        speed *= shrink
        ramp_s *= shrink
    end = length / speed + ramp_s
    if t_s <= 0.0:
        return (0.0, 0.0, 0.0, 0.0)
    if t_s >= end:
        return (length, 0.0, 0.0, 0.0)
    if ramp_s <= t_s <= end - ramp_s:
        return (speed * (t_s - 0.5 * ramp_s), speed, 0.0, 0.0)
    backwards = t_s > end - ramp_s
    x = (end - t_s if backwards else t_s) / ramp_s
    x3 = x * x * x
    s = speed * ramp_s * x3 * x * (2.5 - 3.0 * x + x * x)
    s1 = speed * x3 * (10.0 - 15.0 * x + 6.0 * x * x)
    s2 = speed / ramp_s * 30.0 * x * x * (1.0 - 2.0 * x + x * x)
    s3 = speed / (ramp_s * ramp_s) * 60.0 * x * (1.0 - 3.0 * x + 2.0 * x * x)
    if backwards:
        return (length - s, s1, -s2, s3)
    return (s, s1, s2, s3)


@kernel
def _curve(kind: int, a: float, b: float, s: float) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """r, r', r'', r''' of a closed curve at its angle s, with r(0) = 0 and r' due north at the start."""
    c, d = math.cos(s), math.sin(s)
    if kind == _SPIRAL:  # paper 003: (0.5 cos s, 0.5 sin s) and height 3 - 2 cos s, from its lowest point
        return (
            (a * (c - 1.0), a * d, -b * (1.0 - c)),
            (-a * d, a * c, -b * d),
            (-a * c, -a * d, -b * c),
            (a * d, -a * c, b * d),
        )
    return ((a * d, b * (1.0 - c), 0.0), (a * c, b * d, 0.0), (-a * d, b * c, 0.0), (-a * c, -b * d, 0.0))


@kernel
def evaluate(plan: Plan, t_s: float) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """(position, velocity, acceleration, jerk) t_s after the start, from the start point, NED [m, m/s, m/s^2, m/s^3]."""
    kind, a, b, s_end, s_dot, ramp_s, _, cc, sc = plan
    zero = (0.0, 0.0, 0.0)
    if kind == _HOVER:
        return (zero, zero, zero, zero)
    if kind in (_LINE, _RECTANGLE):
        x0, y0, dx, dy, leg, t = 0.0, 0.0, 1.0, 0.0, a, t_s
        t_a = _leg_time(a, s_dot, ramp_s)
        if kind == _LINE:
            if t > t_a:
                x0, dx, t = a, -1.0, t - t_a
        else:
            t_b = _leg_time(b, s_dot, ramp_s)
            if t > 2.0 * t_a + t_b:
                y0, dx, dy, leg, t = b, 0.0, -1.0, b, t - 2.0 * t_a - t_b
            elif t > t_a + t_b:
                x0, y0, dx, t = a, b, -1.0, t - t_a - t_b
            elif t > t_a:
                x0, dx, dy, leg, t = a, 0.0, 1.0, b, t - t_a
        s, s1, s2, s3 = _timing(t, leg, s_dot, ramp_s)
        p = (x0 + dx * s, y0 + dy * s, 0.0)
        v = (dx * s1, dy * s1, 0.0)
        acc = (dx * s2, dy * s2, 0.0)
        j = (dx * s3, dy * s3, 0.0)
    else:
        s, s1, s2, s3 = _timing(t_s, s_end, s_dot, ramp_s)
        p, r1, r2, r3 = _curve(kind, a, b, s)
        v = (r1[0] * s1, r1[1] * s1, r1[2] * s1)
        k = s1 * s1
        acc = (r2[0] * k + r1[0] * s2, r2[1] * k + r1[1] * s2, r2[2] * k + r1[2] * s2)
        k3, k2 = s1 * k, 3.0 * s1 * s2
        j = (r3[0] * k3 + r2[0] * k2 + r1[0] * s3, r3[1] * k3 + r2[1] * k2 + r1[1] * s3, r3[2] * k3 + r2[2] * k2 + r1[2] * s3)
    return (_turn(p, cc, sc), _turn(v, cc, sc), _turn(acc, cc, sc), _turn(j, cc, sc))


@kernel
def _turn(x: Vec3, c: float, s: float) -> Vec3:
    return (c * x[0] - s * x[1], s * x[0] + c * x[1], x[2])


def demand(plan: Plan, t0_us: int, p0_ned_m: Vec3, yaw_rad: float, t_us: int) -> Demand:
    """Where the path that started at t0 from p0 wants the vehicle at t; before its start and after its end: at rest."""
    p, v, a, j = evaluate(plan, 1e-6 * (t_us - t0_us))
    return Demand(t_us, (p0_ned_m[0] + p[0], p0_ned_m[1] + p[1], p0_ned_m[2] + p[2]), v, a, j, yaw_rad, 0.0)
