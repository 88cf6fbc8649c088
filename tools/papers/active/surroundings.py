"""Wind and paths of the ASMF experiments, drawn before a run so that every controller meets the same."""

import math
from typing import NamedTuple

import numpy as np

MEAN_WIND_M_S, WIND_FROM_RAD = 4.5, math.radians(225.0)
TURBULENCE_M_S, TURBULENCE_TAU_S = 0.5, 2.0


class Path(NamedTuple):
    """One row per tick. NED."""

    p_m: np.ndarray  # (N, 3)
    v_m_s: np.ndarray  # (N, 3)
    a_m_s2: np.ndarray  # (N, 3)
    yaw_rad: np.ndarray  # (N,) along the path


def wind(rng: np.random.Generator, steps: int, dt_s: float, *, gust_m_s: float = 1.5) -> np.ndarray:
    """(steps, 3) NED: mean 4.5 m/s from 225 deg, 1-cos gusts of up to +-gust_m_s along it, first-order turbulence of 0.5 m/s."""
    along = np.full(steps, MEAN_WIND_M_S)
    t_s, end_s = rng.uniform(1.0, 5.0), steps * dt_s
    while t_s < end_s:
        length_s, size = rng.uniform(1.5, 4.0), gust_m_s * rng.uniform(-1.0, 1.0)
        first, last = round(t_s / dt_s), min(round((t_s + length_s) / dt_s), steps)
        phase = np.arange(last - first) * dt_s / length_s
        along[first:last] += size * 0.5 * (1.0 - np.cos(2.0 * math.pi * phase))
        t_s += length_s + rng.uniform(1.0, 5.0)
    keep = math.exp(-dt_s / TURBULENCE_TAU_S)
    white = rng.normal(size=(steps, 3)) * TURBULENCE_M_S * math.sqrt(1.0 - keep * keep)
    turbulence = np.empty((steps, 3))
    value = rng.normal(size=3) * TURBULENCE_M_S
    for i in range(steps):
        turbulence[i] = value
        value = keep * value + white[i]
    towards = np.array([-math.cos(WIND_FROM_RAD), -math.sin(WIND_FROM_RAD), 0.0])
    return along[:, None] * towards + turbulence


def hover(duration_s: float, dt_s: float) -> Path:
    """Standing at the origin, heading north."""
    n = round(duration_s / dt_s)
    return Path(np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n))


def line(speed_m_s: float, course_rad: float, dt_s: float, *, length_m: float = 200.0, accel_m_s2: float = 2.5) -> Path:
    """Hover 3 s, `length_m` there and back with 3 s of hover at each end. Heading stays north."""
    there = _rest_to_rest(length_m, speed_m_s, accel_m_s2, dt_s)
    still = np.zeros(round(3.0 / dt_s))
    speed = np.concatenate([still, there, still, -there, still])
    along = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * dt_s)])
    accel = np.gradient(speed, dt_s)
    course = np.array([math.cos(course_rad), math.sin(course_rad), 0.0])
    return Path(along[:, None] * course, speed[:, None] * course, accel[:, None] * course, np.zeros(speed.size))


def there_and_back(course_rad: float, dt_s: float, *, speed_m_s: float = 10.0, length_m: float = 650.0) -> Path:
    """Paper 004, section 4.3: hover, turn to the course at 25 s, cruise from 50 s, hover, turn about at 150 s, return from 160 s.

    Turns at 0.4 rad/s, 1 m/s^2 along the path; the first turn is half a circle, too.
    """
    n = round(250.0 / dt_s)
    speed = np.zeros(n)
    leg = _rest_to_rest(length_m, speed_m_s, 1.0, dt_s)
    for start_s, sign in ((50.0, 1.0), (160.0, -1.0)):
        first = round(start_s / dt_s)
        speed[first : first + leg.size] = sign * leg
    speed = _smooth(speed, dt_s)
    rate = np.zeros(n)
    turn = round(math.pi / 0.4 / dt_s)
    for start_s in (25.0, 150.0):
        first = round(start_s / dt_s)
        rate[first : first + turn] = math.pi / (turn * dt_s)
    rate = _smooth(rate, dt_s)
    along = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * dt_s)])
    yaw = course_rad - math.pi + np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * dt_s)])
    course = np.array([math.cos(course_rad), math.sin(course_rad), 0.0])
    return Path(along[:, None] * course, speed[:, None] * course, np.gradient(speed, dt_s)[:, None] * course, yaw)


def ellipse(
    speed_m_s: float, duration_s: float, dt_s: float, *, axes_m: tuple[float, float] = (20.0, 17.5), accel_m_s2: float = 2.5
) -> Path:
    """Hover 3 s, then along an ellipse (semi-axes north, east) at constant speed, reached at accel_m_s2. Yaw is the course."""
    n = round(duration_s / dt_s)
    t_s = np.arange(n) * dt_s
    speed = _smooth(np.clip((t_s - 3.0) * accel_m_s2, 0.0, speed_m_s), dt_s)
    length = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * dt_s)])
    a, b = axes_m
    fine = np.linspace(0.0, 2.0 * math.pi * (1.0 + length[-1] / (math.pi * (a + b))), 200_001)
    arc = np.hypot(a * np.sin(fine), b * np.cos(fine))
    angle = np.interp(length, np.concatenate([[0.0], np.cumsum(0.5 * (arc[1:] + arc[:-1]) * np.diff(fine))]), fine)
    c, s = np.cos(angle), np.sin(angle)
    per_angle = np.hypot(a * s, b * c)
    tangent = np.column_stack([-a * s, b * c]) / per_angle[:, None]
    curvature = a * b / per_angle**3
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    accel = np.gradient(speed, dt_s)[:, None] * tangent + (curvature * speed**2)[:, None] * normal
    flat = np.zeros((n, 1))
    return Path(
        np.hstack([np.column_stack([a * (c - 1.0), b * s]), flat]),
        np.hstack([speed[:, None] * tangent, flat]),
        np.hstack([accel, flat]),
        np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0])),
    )


def _rest_to_rest(length_m: float, speed_m_s: float, accel_m_s2: float, dt_s: float) -> np.ndarray:
    ramp_s = speed_m_s / accel_m_s2
    cruise_s = length_m / speed_m_s - ramp_s
    n = round((2.0 * ramp_s + cruise_s) / dt_s)
    t_s = np.arange(n) * dt_s
    return np.clip(np.minimum(t_s, n * dt_s - t_s) * accel_m_s2, 0.0, speed_m_s)


def _smooth(values: np.ndarray, dt_s: float, *, width_s: float = 0.4) -> np.ndarray:
    """A moving average: the jerk stays finite."""
    k = max(round(width_s / dt_s), 1)
    padded = np.concatenate([np.full(k, values[0]), values, np.full(k, values[-1])])
    return np.convolve(padded, np.full(k, 1.0 / k), mode="same")[k:-k]
