"""The figures of merit of the IADRC note (section 10), from one run."""

import itertools
import math

import numpy as np

from tools.papers.joint_observer.cases import DT_S, Scenario, reference, times
from tools.papers.joint_observer.flight import Run

DEG = 180.0 / math.pi
UNITS = {
    "zdev": "m",
    "z_rms1": "m",
    "phi1": "deg",
    "phi2": "deg",
    "lag_z": "s",
    "lag_phi": "s",
    "o_phi": "deg",
    "o_rate": "deg/s",
    "tv_5_10": "N/s",
    "tv_15_25": "N/s",
    "rmse_xy": "m",
    "max_xy": "m",
    "rmse_z": "m",
    "z_overshoot": "m",
    "settle": "s",
    "att_max": "deg",
    "att_rms": "deg",
    "tv": "N/s",
    "wind_max": "deg",
    "wind_rms": "deg",
    "quiet_rms": "deg",
    "impact_peak": "deg",
    "recovery": "s",
    "rebound": "deg",
    "lag": "s",
    "overshoot": "m",
    "d_max": "m/s^2",
}


def lag_s(truth: np.ndarray, estimate: np.ndarray, window: np.ndarray, longest_s: float = 0.5) -> float:
    """How much later the estimate is: peak of the correlation of the truth in the window (n,) with the shifted estimate.

    Between samples by a parabola through the three highest; NaN for an estimate that is flat or not finite. Raises ValueError
    where the window is nearer than longest_s to an end of the record.
    """
    at = np.flatnonzero(window)
    a = truth[at]
    most = round(longest_s / DT_S)
    shifts = np.arange(-most, most + 1)
    if at[0] < most or at[-1] + most >= estimate.size:
        raise ValueError(f"a lag of up to {longest_s} s needs that much of the record on both sides of the window")
    around = estimate[at[0] - most : at[-1] + most + 1]
    if not (np.isfinite(around).all() and np.ptp(around) > 0.0 and np.ptp(a) > 0.0):
        return math.nan
    c = np.array([np.corrcoef(a, estimate[at + s])[0, 1] for s in shifts])  # 1 where the shift is the lag of a mere delay
    k = int(np.argmax(c))
    if k in (0, c.size - 1):
        return math.nan
    bend = c[k - 1] - 2.0 * c[k] + c[k + 1]
    return DT_S * float(shifts[k] + 0.5 * (c[k - 1] - c[k + 1]) / bend)


def variation(rotors: np.ndarray) -> float:
    """Total variation of the rotor commands per second, mean of the four [N/s]."""
    return float(np.abs(np.diff(rotors, axis=0)).sum(axis=0).mean() / (DT_S * len(rotors)))


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def settled_s(t: np.ndarray, error: np.ndarray, limit: float) -> float:
    """Time from the first sample until |error| stays below the limit; infinite where it never does."""
    outside = np.flatnonzero(~(np.abs(error) < limit))
    if outside.size == 0:
        return 0.0
    if outside[-1] == error.size - 1:
        return math.inf
    return float(t[outside[-1] + 1] - t[0])


def hover(scenario: Scenario, run: Run, d: np.ndarray) -> dict[str, float]:
    """S1: noise at 5-10 s, square waves at 15-25 s."""
    t = times(scenario)
    noisy, pushed = (t >= 5.0) & (t < 10.0), (t >= 15.0) & (t < 25.0)
    z_error, roll = -run.truth[:, 2] - 3.0, run.truth[:, 6] * DEG
    miss = (run.used - run.truth)[noisy] * DEG
    return {
        "zdev": float(np.abs(z_error[pushed]).max()),
        "z_rms1": rms(z_error[noisy]),
        "phi1": float(np.abs(roll[noisy]).max()),
        "phi2": float(np.abs(roll[pushed]).max()),
        "lag_z": lag_s(d[:, 2], run.f[:, 2], pushed),
        "lag_phi": lag_s(d[:, 3], run.f[:, 3], pushed),
        "o_phi": rms(miss[:, 6]),
        "o_rate": rms(miss[:, 9]),
        "tv_5_10": variation(run.rotors[noisy]),
        "tv_15_25": variation(run.rotors[pushed]),
    }


def rectangle(scenario: Scenario, run: Run, d: np.ndarray) -> dict[str, float]:
    """S3: the path from 4 s on, corners at 8, 11, 15, 18 s."""
    t, ref = times(scenario), reference(scenario)
    late = t >= 4.0
    error = run.truth[:, :3] - ref[:, :3]
    xy = np.hypot(error[:, 0], error[:, 1])
    tilt = (run.truth[late, 6:8] - run.reference[late, :2]) * DEG
    corners = (8.0, 11.0, 15.0, 18.0, scenario.duration_s)
    settle = [settled_s(t[leg], xy[leg], 0.1) for a, b in itertools.pairwise(corners) if (leg := (t >= a) & (t < b)).any()]
    return {
        "rmse_xy": rms(xy[late]),
        "max_xy": float(xy[late].max()),
        "rmse_z": rms(error[late, 2]),
        "z_overshoot": float((-run.truth[:, 2]).max() - 1.0),
        "settle": max(settle),
        "att_max": float(np.abs(tilt).max()),
        "att_rms": rms(tilt),
        "tv": variation(run.rotors),
    }


def bench(scenario: Scenario, run: Run, d: np.ndarray) -> dict[str, float]:
    """S4: wind at 5-20 s, quiet at 25-35 s, a blow at 35 s."""
    t, roll = times(scenario), run.truth[:, 6] * DEG
    wind, quiet, after = (t >= 5.0) & (t < 20.0), (t >= 25.0) & (t < 35.0), t >= 35.0
    return {
        "wind_max": float(np.abs(roll[wind]).max()),
        "wind_rms": rms(roll[wind]),
        "quiet_rms": rms(roll[quiet]),
        "impact_peak": float(np.abs(roll[after]).max()),
        "recovery": settled_s(t[after], roll[after], 1.0),
        "rebound": float(-roll[after].min()),
        "lag": lag_s(d[:, 3], run.f[:, 3], wind),
        "tv": variation(run.rotors),
    }


def climb(scenario: Scenario, run: Run, d: np.ndarray) -> dict[str, float]:
    """The 15 m step: overshoot and the largest disturbance believed."""
    return {"overshoot": float((-run.truth[:, 2]).max() - 15.0), "d_max": float(np.abs(run.f[:, 2]).max())}


def measure(scenario: Scenario, run: Run, d: np.ndarray) -> dict[str, float]:
    """All figures of a run, NaN or infinite where the run was lost."""
    how = {"S1": hover, "S3": rectangle, "S4": bench, "st": climb}[scenario.name[:2]]
    return how(scenario, run, d)
