"""Bounds for the set-membership filter of a quadrotor, from a calibration flight of that very vehicle.

Source: Song et al. 2011 (paper 004), section 3.1 (unknown but bounded errors); the ten-state model is the design note's of the ASMF,
section 8. e is the largest error of what is measured, b the largest change per tick of what the model does not know. Quantisation,
delay and motor lag are inside them because they are inside the residuals.

The guarantee that rests on these numbers is one of this flight: what did not happen in it is covered by the margin only.
"""

from typing import NamedTuple

import numpy as np
from scipy import signal

from mavquad.errors import LogError
from mavquad.identify.timebase import Held, held_at

G_M_S2 = 9.80665
TICK_S = 0.02
MARGIN = 1.3  # over the largest seen
SMOOTH_S = 0.3  # slower is the force; faster may be error or force (a motor at its limit): both bounds hold it
ATTITUDE_SMOOTH_S = 0.12  # attitude moves up to 5 Hz and carries less noise
SLOW_S = 2.0  # the accelerometer's offset against the velocity is told over this
SHORTEST_S = 30.0


class Calm(NamedTuple):
    """A commanded flight on even ticks of 20 ms, no gap inside."""

    t_s: np.ndarray  # (n,)
    euler_rad: np.ndarray  # (n, 3)
    accel_m_s2: np.ndarray  # (n, 3) body specific force
    v_ned_m_s: np.ndarray  # (n, 3)
    roll: Held
    pitch: Held
    thrust_m_s2: Held  # commanded specific force
    tau_s: float
    delay_s: float  # from command to what acts, on the attitude
    thrust_lag_s: float


class Bound(NamedTuple):
    value: float
    largest_seen: float
    at_s: float  # the part of the log that set it
    unit: str


def bounds(flight: Calm) -> dict[str, Bound]:
    """The seven bounds by their names in an airframe file. Raises LogError where the flight is too short."""
    n = flight.t_s.size
    if n * TICK_S < SHORTEST_S:
        raise LogError(
            f"{n * TICK_S:.0f} s of commanded flight without a gap; needs {SHORTEST_S:g} s with manoeuvres like those to be flown"
        )
    t = flight.t_s
    attitude = [flight.euler_rad[:, i] for i in (0, 1)]
    thrust = _lagged(held_at(flight.thrust_m_s2, t), flight.thrust_lag_s)
    rotation = _rotations(flight.euler_rad)
    nominal = -rotation[:, :, 2] * thrust[:, None]
    nominal[:, 2] += G_M_S2
    raw_f = np.einsum("nij,nj->ni", rotation, flight.accel_m_s2 + np.array([0.0, 0.0, 1.0]) * thrust[:, None])
    smooth_v = _smooth(flight.v_ned_m_s)
    by_velocity = np.gradient(smooth_v, TICK_S, axis=0) - nominal
    smooth_f = _smooth(raw_f)
    f = smooth_f + _smooth(by_velocity - smooth_f, SLOW_S)
    edge = round(SLOW_S / TICK_S)
    inner = slice(edge, n - edge)

    angle = np.column_stack([_smooth(a, ATTITUDE_SMOOTH_S) for a in attitude])
    command = np.column_stack([held_at(u, t - flight.delay_s) for u in (flight.roll, flight.pitch)])
    decay = np.exp(-TICK_S / flight.tau_s)
    rate = np.gradient(angle, TICK_S, axis=0)
    f_angle = rate - (command - angle) / flight.tau_s
    f_angle = _smooth(f_angle, 0.1)  # commands step; what they leave is spread over some ticks
    step_left = angle[1:] - decay * angle[:-1] - (1.0 - decay) * command[:-1] - flight.tau_s * (1.0 - decay) * f_angle[:-1]
    v_left = np.diff(smooth_v, axis=0) - TICK_S * 0.5 * (nominal + f)[1:] - TICK_S * 0.5 * (nominal + f)[:-1]

    def largest(x: np.ndarray, unit: str, floor: float) -> Bound:
        size = np.abs(x[inner]).max(axis=1)
        k = int(np.argmax(size))
        return Bound(max(floor, MARGIN * float(size[k])), float(size[k]), float(t[inner][k]), unit)

    stamp = 0.5e-3  # stamps are whole milliseconds
    error_angle = np.abs(np.column_stack(attitude) - angle) + stamp * np.abs(rate)
    error_v = np.abs(flight.v_ned_m_s - smooth_v) + stamp * np.abs(np.gradient(smooth_v, TICK_S, axis=0))
    return {
        "e_velocity_m_s": largest(error_v, "m/s", 1e-3),
        "e_attitude_rad": largest(error_angle, "rad", 2e-4),
        "e_acceleration_m_s2": largest(raw_f - f, "m/s^2", 0.02),
        "b_velocity_m_s": largest(_padded(v_left), "m/s per tick", 5e-4),
        "b_f_m_s2": largest(_padded(np.diff(raw_f, axis=0)), "m/s^2 per tick", 0.005),
        "b_attitude_rad": largest(_padded(step_left), "rad per tick", 5e-4),
        "b_f_attitude_rad_s": largest(_padded(np.diff(f_angle, axis=0)), "rad/s per tick", 0.01),
    }


def widened(found: dict[str, Bound], names: tuple[str, ...], factor: float) -> dict[str, Bound]:
    """The same bounds with some of them larger."""
    return {key: one._replace(value=one.value * factor) if key in names else one for key, one in found.items()}


def _smooth(x: np.ndarray, span_s: float = SMOOTH_S) -> np.ndarray:
    """Local parabolas over `span_s` along the first axis."""
    return signal.savgol_filter(x, round(span_s / TICK_S) | 1, 2, axis=0)


def _lagged(x: np.ndarray, lag_s: float) -> np.ndarray:
    if lag_s <= 0.0:
        return x
    keep = np.exp(-TICK_S / lag_s)
    return signal.lfilter([1.0 - keep], [1.0, -keep], x, zi=[keep * x[0]])[0]


def _padded(steps: np.ndarray) -> np.ndarray:
    return np.vstack([steps, steps[-1:]])


def _rotations(euler_rad: np.ndarray) -> np.ndarray:
    """(n, 3, 3) body to NED."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in euler_rad.T)
    return np.stack(
        [
            np.column_stack([cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy]),
            np.column_stack([cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy]),
            np.column_stack([-sp, sr * cp, cr * cp]),
        ],
        axis=1,
    )
