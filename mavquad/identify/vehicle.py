"""What a flight tells of the vehicle besides its attitude loop: hover thrust, thrust gain, drag, gyro filter, torque per command.

Mass and inertia alone cannot be had from a log: only force over mass and torque over inertia show.

Source: identification note, sections 4 and 7. Spreads come from leaving out one tenth of the record at a time, because the residuals
of a flight are not independent.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mavquad.errors import LogError
from mavquad.identify import spectrum
from mavquad.identify.spectrum import Record, Response

G_M_S2 = 9.80665
BLOCKS = 10


class Motion(NamedTuple):
    """A flight on one even clock; a column that the log does not have is NaN throughout."""

    dt_s: float
    t_s: np.ndarray  # (n,)
    euler_rad: np.ndarray  # (n, 3) roll, pitch, yaw unwrapped
    accel_m_s2: np.ndarray  # (n, 3) body specific force
    gyro_rad_s: np.ndarray  # (n, 3)
    v_ned_m_s: np.ndarray  # (n, 3)
    thrust: np.ndarray  # (n,) collective 0..1, as the autopilot acts on it
    flying: np.ndarray  # (n,) bool: airborne, every stream alive


class Figure(NamedTuple):
    """One number with its standard deviation and what it rests on."""

    value: float
    sd: float
    seconds: float


class Thrust(NamedTuple):
    hover: Figure  # collective that carries the weight
    gain_m_s2: Figure  # specific force per unit collective
    over_cosine: bool  # the vehicle itself divides the collective by the cosine of its tilt


class Drag(NamedTuple):
    """Acceleration -(linear + quadratic |v|) v along each body axis, v relative to a constant wind."""

    linear_1_s: tuple[Figure, Figure]  # forward, right
    quadratic_1_m: tuple[Figure, Figure]
    fastest_m_s: float
    wind_ned_m_s: tuple[float, float]
    residual_m_s2: float


class GyroFilter(NamedTuple):
    """Two equal-damped poles between the attitude's own rate and the rate that is sent."""

    cutoff_hz: Figure
    lag_s: float


class Torque(NamedTuple):
    """Angular acceleration per unit of differential motor command, every motor moved by its share of the pattern."""

    gain_rad_s2: Figure
    pattern: tuple[float, ...]  # of every motor, -1..1; 0 where it takes no part
    lag_s: float  # from motor command to the gyro as sent
    explained: float  # share of the variance, 0..1


def hover(m: Motion) -> Thrust:
    """Hover thrust and thrust gain. Raises LogError where thrust, accelerometer or a hover is missing."""
    tilt_cos = np.cos(m.euler_rad[:, 0]) * np.cos(m.euler_rad[:, 1])
    up = -m.accel_m_s2[:, 2]
    known = m.flying & np.isfinite(m.thrust) & np.isfinite(up)
    if not known.any():
        raise LogError("no thrust (ATTITUDE_TARGET) beside an accelerometer (HIGHRES_IMU) in flight; record both at 50 Hz")
    n = max(1, round(1.0 / m.dt_s))
    thrust, up_slow, cos_slow = (_mean(x, n) for x in (m.thrust, up, tilt_cos))
    known &= _mean(known.astype(float), n) > 0.999
    still = known & (np.abs(up_slow - G_M_S2) < 0.03 * G_M_S2) & (cos_slow > 0.98)
    if m.dt_s * still.sum() < 5.0:
        raise LogError(f"{m.dt_s * still.sum():.1f} s of steady hover in flight; needs 5 s; record a calm hover")

    def at_hover(use: np.ndarray) -> float:
        return float(np.median(thrust[use] * G_M_S2 / up_slow[use]))

    gains = []
    for over_cosine in (False, True):
        acting = thrust / cos_slow if over_cosine else thrust

        def slope(use: np.ndarray, acting: np.ndarray = acting) -> float:
            return float(np.sum(acting[use] * up_slow[use]) / np.sum(acting[use] ** 2))

        left = float(np.std((up_slow - slope(known) * acting)[known]))
        gains.append((left, over_cosine, jackknife(slope, known, m.dt_s)))
    _, over_cosine, gain = min(gains, key=lambda entry: entry[0])
    return Thrust(jackknife(at_hover, still, m.dt_s), gain, over_cosine)


def drag(m: Motion) -> Drag:
    """Drag from the accelerometer, which feels nothing else along the body's x and y. Raises LogError below 2 m/s."""
    known = m.flying & np.all(np.isfinite(m.accel_m_s2), axis=1) & np.all(np.isfinite(m.v_ned_m_s), axis=1)
    if not known.any():
        raise LogError("no velocity (LOCAL_POSITION_NED) beside an accelerometer (HIGHRES_IMU) in flight; record both")
    n = max(1, round(0.3 / m.dt_s))
    speed = np.where(known, np.linalg.norm(np.nan_to_num(m.v_ned_m_s), axis=1), 0.0)
    fastest = float(np.percentile(speed[known], 99.0))
    if fastest < 2.0:
        raise LogError(f"the vehicle never went faster than {fastest:.1f} m/s; needs 2 m/s; record a circle or a dash")
    forward, right = _body_rows(m.euler_rad)
    rows = []
    for axis, row in ((0, forward), (1, right)):
        v_body = np.einsum("ni,ni->n", row, np.nan_to_num(m.v_ned_m_s))
        a = _mean(np.nan_to_num(m.accel_m_s2[:, axis]), n)
        # -(l + q |v|) v along the body, and the wind's share l w through the heading
        rows.append((np.column_stack([-v_body, -speed * v_body, row[:, 0], row[:, 1], np.ones_like(v_body)]), a))
    rows = [(np.apply_along_axis(_mean, 0, x, n), a) for x, a in rows]

    def solve(axis: int, use: np.ndarray) -> np.ndarray:
        x, a = rows[axis]
        solution, *_ = np.linalg.lstsq(x[use], a[use], rcond=None)
        return solution

    def one(axis: int, k: int) -> Figure:
        return jackknife(lambda use: float(solve(axis, use)[k]), known, m.dt_s)

    figures = [[one(axis, k) for k in (0, 1)] for axis in (0, 1)]
    both = [solve(axis, known) for axis in (0, 1)]
    linear = max(1e-6, 0.5 * (both[0][0] + both[1][0]))
    wind = tuple(float(0.5 * (both[0][k] + both[1][k]) / linear) for k in (2, 3))
    left = np.concatenate([(a - x @ solution)[known] for (x, a), solution in zip(rows, both, strict=True)])
    return Drag(
        (figures[0][0], figures[1][0]),
        (figures[0][1], figures[1][1]),
        fastest,
        (wind[0], wind[1]),
        float(np.sqrt(np.mean(left**2))),
    )


def gyro_filter(dt_s: float, angle_rad: np.ndarray, rate_rad_s: np.ndarray) -> tuple[GyroFilter, Response]:
    """The filter of the rate that is sent, from a swept angle (N,) and that rate (N,). Raises LogError where too little moves."""
    record = Record(dt_s, angle_rad[:, None], angle_rad[:, None], rate_rad_s[:, None])
    found = spectrum.lpm([record], 2.0 * np.pi * np.geomspace(0.5, min(6.0, 0.2 / dt_s), 25))
    f = found.h[:, 0, 0] / (1j * found.omega_rad_s)
    use = found.coherence[:, 0, 0] > 0.9
    if use.sum() < 6:
        raise LogError("the attitude moves too little between 0.5 and 6 Hz to see the gyro's filter; sweep to 5 Hz")
    omega, weight = found.omega_rad_s[use], 1.0 / np.maximum(found.sd[use, 0, 0], 1e-4) ** 2
    # the phase of a slow pair of poles is -omega lag: one number, linear in it; the pair with damping 0.707 has lag sqrt(2)/wc
    late = -np.angle(f[use])
    lag = float(np.sum(weight * omega * late) / np.sum(weight * omega**2))
    left = late - lag * omega
    sd = float(np.sqrt(np.sum(weight * left**2) / np.sum(weight * omega**2) / max(1, use.sum() - 1)))
    if lag <= 2.0 * sd or lag <= 0.0:
        return GyroFilter(Figure(np.inf, np.inf, dt_s * len(angle_rad)), lag), found._replace(h=f[:, None, None])
    cutoff = np.sqrt(2.0) / lag / (2.0 * np.pi)
    return GyroFilter(Figure(float(cutoff), float(cutoff * sd / lag), dt_s * len(angle_rad)), lag), found._replace(
        h=f[:, None, None]
    )


def torque(t_s: np.ndarray, gyro_rad_s: np.ndarray, t_motor_s: np.ndarray, motors: np.ndarray) -> Torque:
    """Angular acceleration per differential command from gyro (n,) and motors (k, j). Raises LogError where the two do not go together."""
    dt = 0.02
    t = np.arange(max(t_s[0], t_motor_s[0]) + 0.2, min(t_s[-1], t_motor_s[-1]) - 0.2, dt)
    if t.size < 500:
        raise LogError(f"{dt * t.size:.0f} s of gyro and motor commands together; needs 10 s")
    turn = _mean(np.gradient(np.interp(t, t_s, gyro_rad_s), dt), 3)
    best: tuple[float, float, np.ndarray, np.ndarray] | None = None
    for lag in np.arange(0.0, 0.1, 0.005):
        each = np.column_stack([np.interp(t - lag, t_motor_s, motors[:, i]) for i in range(motors.shape[1])])
        each = each - each.mean(axis=1, keepdims=True)  # what lifts is not what turns
        each = np.apply_along_axis(_mean, 0, each - each.mean(axis=0), 3)
        _, size, patterns = np.linalg.svd(each, full_matrices=False)
        for pattern in patterns[size > 0.02 * size[0]]:  # the motors move in a few patterns: one of them turns this axis
            share = pattern / np.abs(pattern).max()
            share[np.abs(share) < 0.25] = 0.0
            u = each @ share / np.sum(share**2)
            r = float(np.corrcoef(u, turn)[0, 1]) if min(np.std(u), np.std(turn)) > 0.0 else 0.0
            if best is None or r * r > best[0]:
                best = (r * r, float(lag), share * np.sign(r), u * np.sign(r))
    if best is None or best[0] < 0.5:
        raise LogError(
            f"motor commands explain {100 * (best[0] if best else 0):.0f} % of the turning (needs 50 %): this axis was not excited"
        )
    explained, lag, pattern, u = best

    def slope(use: np.ndarray) -> float:
        return float(np.cov(u[use], turn[use])[0, 1] / np.var(u[use], ddof=1))

    return Torque(jackknife(slope, np.ones(t.size, bool), dt), tuple(float(p) for p in pattern), lag, explained)


def jackknife(estimate: Callable[[np.ndarray], float], use: np.ndarray, dt_s: float) -> Figure:
    """An estimate over the samples of `use` (n,) bool, and its spread by leaving out one tenth of them at a time."""
    index = np.flatnonzero(use)
    whole = estimate(use)
    parts = []
    for block in np.array_split(index, BLOCKS):
        rest = use.copy()
        rest[block] = False
        parts.append(estimate(rest))
    spread = np.sqrt((BLOCKS - 1) / BLOCKS * np.sum((np.array(parts) - np.mean(parts)) ** 2))
    return Figure(whole, float(spread), dt_s * index.size)


def _mean(x: np.ndarray, n: int) -> np.ndarray:
    """Moving mean over n samples, same length, edges shortened."""
    n = min(n, len(x))
    total = np.convolve(x, np.ones(n), "same")
    return total / np.convolve(np.ones(len(x)), np.ones(n), "same")


def _body_rows(euler_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Body x and y axes in NED, (n, 3) each."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in euler_rad.T)
    forward = np.column_stack([cp * cy, cp * sy, -sp])
    right = np.column_stack([sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, sr * cp])
    return forward, right
