"""Dryden turbulence by exact discretisation, mean wind with a height profile, discrete gusts.

Source: MIL-F-8785C, low altitude; numbers as in Yang, Lyu, Chai 2022. Sampled each 10 ms and held between.

Deviations from the paper:
  intensity  the MIL form sigma sqrt(2 L/(pi V)) belongs to spectra one-sided over rad/s; here noise has E[n n] = delta(t), so pi is gone
  V          the airspeed of the filters is frozen (a hovering vehicle has none of its own), never below 1 m/s
"""

import functools
import math
from typing import NamedTuple

import numpy as np
from scipy import linalg

from mavquad.jit import kernel
from sitl.config import Gust

FOOT_M = 0.3048
SAMPLE_S = 0.01


class Intensity(NamedTuple):
    """Lengths and standard deviations at one height."""

    length_u_m: float
    length_w_m: float
    sigma_u_m_s: float
    sigma_w_m_s: float
    sigma_p_rad_s: float


class Dryden(NamedTuple):
    """Exact one-sample transitions of (u | v, v2 | w, w2, lag of q | p), and what is read from them.

    F: (7, 7), B: (7, 7) lower factors of the noise, C: (5, 7) to (u, v, w, p_g, q_g), P0: (7, 7) factor of the stationary covariance.
    """

    F: np.ndarray
    B: np.ndarray
    C: np.ndarray
    P0: np.ndarray


def intensity(w20_m_s: float, height_m: float, span_m: float) -> Intensity:
    """Scale lengths and intensities of MIL-F-8785C at a height, clamped to 10..1000 ft."""
    h_ft = min(1000.0, max(10.0, height_m / FOOT_M))
    k = 0.177 + 0.000823 * h_ft
    length_w = h_ft * FOOT_M
    sigma_w = 0.1 * w20_m_s
    return Intensity(length_w / k**1.2, length_w, sigma_w / k**0.4, sigma_w, 1.9 * sigma_w / math.sqrt(length_w * span_m))


def mean_at(w20_m_s: float, height_m: float) -> float:
    """Mean wind of the logarithmic profile whose speed at 20 ft is given; 0 below 0.15 ft."""
    return w20_m_s * max(0.0, math.log(max(1e-9, height_m / FOOT_M) / 0.15) / math.log(20.0 / 0.15))


@functools.lru_cache(maxsize=64)  # the flights of a campaign mostly share it
def dryden(w20_m_s: float, height_m: float, span_m: float, airspeed_m_s: float, dt_s: float = SAMPLE_S) -> Dryden:
    """The turbulence at one height and airspeed, discretised exactly for dt_s."""
    i = intensity(w20_m_s, height_m, span_m)
    v = max(1.0, airspeed_m_s)
    tau_u, tau_w, lag = i.length_u_m / v, i.length_w_m / v, 4.0 * span_m / (math.pi * v)
    A, G, C = np.zeros((7, 7)), np.zeros((7, 4)), np.zeros((5, 7))
    A[0, 0], G[0, 0], C[0, 0] = -1.0 / tau_u, 1.0 / tau_u, i.sigma_u_m_s * math.sqrt(2.0 * tau_u)
    for row, tau, sigma, noise, out in ((1, tau_u, i.sigma_u_m_s, 1, 1), (3, tau_w, i.sigma_w_m_s, 2, 2)):
        A[row, row + 1] = 1.0
        A[row + 1, row], A[row + 1, row + 1] = -1.0 / tau**2, -2.0 / tau
        G[row + 1, noise] = 1.0 / tau**2
        C[out, row], C[out, row + 1] = sigma * math.sqrt(tau), sigma * math.sqrt(tau) * math.sqrt(3.0) * tau
    A[5] = C[2] / lag  # the lag that makes q_g of w: z' = (w - z)/lag, q_g = (w - z)/(V lag)
    A[5, 5] = -1.0 / lag
    C[4] = C[2] / (v * lag)
    C[4, 5] = -1.0 / (v * lag)
    A[6, 6], G[6, 3], C[3, 6] = -1.0 / lag, 1.0 / lag, i.sigma_p_rad_s * math.sqrt(2.0 * lag)
    n = 7  # Van Loan
    block = np.zeros((14, 14))
    block[:n, :n], block[:n, n:], block[n:, n:] = -A, G @ G.T, A.T
    e = linalg.expm(block * dt_s)
    F = e[n:, n:].T
    Q = F @ e[:n, n:]
    P = linalg.solve_continuous_lyapunov(A, -G @ G.T)
    return Dryden(F, _factor(Q), C, _factor(P))


def _factor(M: np.ndarray) -> np.ndarray:
    """B with B B^T = M (symmetric, perhaps singular): states of very different size, so scaled to ones first."""
    scale = np.sqrt(np.maximum(np.diag(M), 1e-300))
    values, vectors = np.linalg.eigh(0.5 * (M + M.T) / np.outer(scale, scale))
    return np.ascontiguousarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def gust_table(gusts: list[Gust]) -> np.ndarray:
    """(n, 4): start s, duration s, velocity north, east m/s (where the air goes)."""
    rows = [
        (
            g.t_s,
            g.duration_s,
            -g.speed_m_s * math.cos(math.radians(g.from_deg)),
            -g.speed_m_s * math.sin(math.radians(g.from_deg)),
        )
        for g in gusts
    ]
    return np.array(rows, dtype=float).reshape(-1, 4)


@kernel
def gust_shape(t_s, start_s, duration_s):
    """0..1: 1-cosine up over the first quarter, held, 1-cosine down over the last."""
    x = (t_s - start_s) / duration_s
    if x <= 0.0 or x >= 1.0:
        return 0.0
    edge = min(x, 1.0 - x)
    return 1.0 if edge >= 0.25 else 0.5 - 0.5 * math.cos(4.0 * math.pi * edge)


@kernel
def turbulence(F, B, C, x, n, out):
    """One sample: x (7,) is moved on in place by the normals n (7,); out (5,) becomes (u, v, w, p_g, q_g)."""
    y0, y1, y2, y3, y4, y5, y6 = x[0], x[1], x[2], x[3], x[4], x[5], x[6]
    for i in range(7):
        total = F[i, 0] * y0 + F[i, 1] * y1 + F[i, 2] * y2 + F[i, 3] * y3 + F[i, 4] * y4 + F[i, 5] * y5 + F[i, 6] * y6
        for j in range(7):
            total += B[i, j] * n[j]
        x[i] = total
    for i in range(5):
        total = 0.0
        for j in range(7):
            total += C[i, j] * x[j]
        out[i] = total


@kernel
def series(F, B, C, x, normals, out):
    """Many samples at once, for tests and figures: normals (n, 7) -> out (n, 5)."""
    for k in range(normals.shape[0]):
        turbulence(F, B, C, x, normals[k], out[k])
