"""Sweep records of the linear hover models, with the gust and the noise of the identification note: what the paper is tried on."""

import math
from typing import NamedTuple

import numpy as np
import scipy.linalg

from mavquad.identify import excitation, fit, models
from mavquad.identify.excitation import Sweep
from mavquad.identify.models import Model
from mavquad.identify.spectrum import Record
from mavquad.identify.structures import REF_LAT, REF_LON, REF_YAW, T1_LAT, T1_LON, Structure

DT_S = 0.02
GUST_RMS_M_S, GUST_TAU_S = 0.1, 2.0
NOISE_TAU_S, WHITE_SHARE = 0.08, 0.3
NOISE = {"u": 0.03, "v": 0.03, "w": 0.03, "q": 0.004, "p": 0.004, "r": 0.004, "theta": 0.002, "phi": 0.002}
LINE_HZ, LINE_RAD_S = 19.3, 0.005  # rotor vibration on the rate


class Case(NamedTuple):
    """A model to recover, the loop it is flown in and the size of its sweeps."""

    name: str
    truth: Model
    parameters: dict[str, float]
    structure: Structure
    weights: tuple[float, ...]  # state weights of the feedback
    input_weight: float
    amplitude: float


def case(name: str) -> Case:
    return {
        "REF-lon": Case(name, models.ref_lon(), dict(models.REF_LON), REF_LON, (0.05, 1, 1, 0, 0), 20.0, 0.2),
        "REF-lat": Case(name, models.ref_lat(), dict(models.REF_LAT), REF_LAT, (0.05, 1, 1, 0, 0), 20.0, 0.12),
        "REF-yaw": Case(name, models.ref_yaw_heave(), dict(models.REF_YAW_HEAVE), REF_YAW, (0.05, 1, 0), 20.0, 0.1),
        "T1-lon": Case(name, models.table1_lon(), dict(models.TABLE1_LON), T1_LON, (0.05, 1, 1, 0, 0), 5.0, 0.4),
        "T1-lat": Case(name, models.table1_lat(), dict(models.TABLE1_LAT), T1_LAT, (0.05, 1, 1, 0, 0), 5.0, 0.3),
    }[name]


def feedback(one: Case, dt_s: float = DT_S) -> np.ndarray:
    """K (m, n) of u = -K x + r: discrete LQR on the true state."""
    ad, bd = fit.discretized(one.truth.a, one.truth.b, dt_s)
    weight = one.input_weight * np.eye(bd.shape[1])
    p = scipy.linalg.solve_discrete_are(ad, bd, np.diag(np.asarray(one.weights, dtype=float)), weight)
    return np.linalg.solve(weight + bd.T @ p @ bd, bd.T @ p @ ad)


def sweeps(one: Case, seed: int, *, noisy: bool = True, per_axis: int = 2) -> list[Record]:
    """Four records of 100 s: two sweeps on each input, small known noise on the other."""
    rng = np.random.default_rng(seed)
    plan = Sweep(amplitude=one.amplitude)
    return [fly(one, excitation.record(plan, DT_S, axis, 2, rng), rng, noisy) for axis in (0, 1) for _ in range(per_axis)]


def paper_sweeps(one: Case, seed: int) -> list[Record]:
    """The paper's recipe: 30 s, linear 1-20 Hz, once per input."""
    rng = np.random.default_rng(seed)
    return [fly(one, excitation.linear_record(one.amplitude, 1.0, 20.0, 30.0, DT_S, axis, 2, rng), rng) for axis in (0, 1)]


def fly(one: Case, r: np.ndarray, rng: np.random.Generator, noisy: bool = True, x0: np.ndarray | None = None) -> Record:
    """One record of the closed loop u = -K x + r under gust and measurement noise; the stick saturates at +-1."""
    y, u, _ = flown(one, r, rng, noisy, x0)
    return Record(DT_S, r, u, y)


def flown(
    one: Case, r: np.ndarray, rng: np.random.Generator, noisy: bool = True, x0: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Outputs (N, p), applied inputs (N, m) and the true states (N, n) of `fly`."""
    model = one.truth
    count, n = len(r), model.a.shape[0]
    gust = excitation.ar1(count, DT_S, GUST_RMS_M_S, GUST_TAU_S, rng) if noisy else np.zeros(count)
    ad, driven = fit.discretized(model.a, np.hstack([model.b, -model.a[:, :1]]), DT_S)
    bd, ed = driven[:, :-1], driven[:, -1]
    k = feedback(one)
    x = np.zeros(n) if x0 is None else np.array(x0, dtype=float)
    states, u = np.empty((count, n)), np.empty_like(r)
    for i in range(count):
        states[i] = x
        u[i] = np.clip(r[i] - k @ x, -1.0, 1.0)
        x = ad @ x + bd @ u[i] + ed * gust[i]
    y = states @ model.c.T
    return (y + noise(model.outputs, count, rng) if noisy else y), u, states


def noise(outputs: tuple[str, ...], count: int, rng: np.random.Generator) -> np.ndarray:
    """Measurement noise (N, p): coloured, 30 % of it white on top, and the vibration line on the rate."""
    out = np.empty((count, len(outputs)))
    for i, name in enumerate(outputs):
        sigma = NOISE[name]
        out[:, i] = excitation.ar1(count, DT_S, sigma, NOISE_TAU_S, rng) + WHITE_SHARE * sigma * rng.standard_normal(count)
    line = LINE_RAD_S * np.sin(2.0 * math.pi * LINE_HZ * np.arange(count) * DT_S + rng.uniform(0.0, 2.0 * math.pi))
    out[:, 1] += line
    return out
