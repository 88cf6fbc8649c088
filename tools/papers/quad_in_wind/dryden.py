"""Dryden turbulence, MIL-F-8785C at low altitude, exactly discretised.

Lengths in metres unless named _ft. The frozen-field speed V, the altitude and W20 are fixed for a flight. Channels: u along the
mean wind (north), v east, w down; p_g, q_g about the body axes. H(s) is written for white noise with E[n n] = delta(t); the
form with sigma sqrt(2L/(pi V)) belongs to one-sided spectra over rad/s, and mixing them costs a factor pi in variance.
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad.errors import ConfigError
from mavquad.jit import kernel

FOOT_M = 0.3048


class Dryden(NamedTuple):
    """Scales of one condition."""

    length_u_m: float  # L_u = L_v
    length_w_m: float
    sigma_u_m_s: float  # = sigma_v
    sigma_w_m_s: float
    speed_m_s: float  # V, the frozen-field speed
    mean_m_s: float  # mean wind at this height
    sigma_p_rad_s: float
    span_m: float


def dryden(w20_m_s: float, height_m: float, span_m: float = 0.42) -> Dryden:
    """Scales for a wind of W20 (at 20 ft) and a height (clamped to 10..1000 ft)."""
    if not (math.isfinite(w20_m_s) and w20_m_s > 0.0 and math.isfinite(height_m)):
        raise ConfigError(f"dryden: W20 must be > 0 m/s and the height finite, got {w20_m_s} and {height_m}")
    h_ft = min(1000.0, max(10.0, height_m / FOOT_M))
    base = 0.177 + 0.000823 * h_ft
    length_u, length_w = FOOT_M * h_ft / base**1.2, FOOT_M * h_ft
    sigma_w = 0.1 * w20_m_s
    mean = w20_m_s * math.log(h_ft / 0.15) / math.log(20.0 / 0.15)
    sigma_p = 1.9 * sigma_w / math.sqrt(length_w * span_m)
    return Dryden(length_u, length_w, sigma_w / base**0.4, sigma_w, max(mean, 1.0), mean, sigma_p, span_m)


class Shaper(NamedTuple):
    """A linear filter of white noise: x+ = F x + L n, y = C x, x(0) = S n (stationary from the start)."""

    f: np.ndarray
    noise: np.ndarray
    out: np.ndarray
    start: np.ndarray


def _factor(p: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(0.5 * (p + p.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def shaper(a: np.ndarray, b: np.ndarray, c: np.ndarray, dt_s: float) -> Shaper:
    """x' = a x + b n discretised exactly (Van Loan), started from its stationary covariance (Lyapunov)."""
    from scipy.linalg import expm, solve_continuous_lyapunov

    n = len(a)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -a, np.outer(b, b), a.T
    e = expm(block * dt_s)
    f = e[n:, n:].T
    return Shaper(f, _factor(f @ e[:n, n:]), c, _factor(solve_continuous_lyapunov(a, -np.outer(b, b))))


def shapers(d: Dryden, dt_s: float) -> tuple[Shaper, Shaper, Shaper, Shaper]:
    """u, v, (w, q_g), p_g."""
    tu, tw = d.length_u_m / d.speed_m_s, d.length_w_m / d.speed_m_s
    t4 = 4.0 * d.span_m / (math.pi * d.speed_m_s)

    def lag(tau: float, sigma: float) -> Shaper:
        return shaper(np.array([[-1.0 / tau]]), np.array([sigma * math.sqrt(2.0 / tau)]), np.eye(1), dt_s)

    def second(tau: float, sigma: float) -> tuple[np.ndarray, np.ndarray]:
        gain = sigma / tau**1.5
        return np.array([[0.0, 1.0], [-1.0 / tau**2, -2.0 / tau]]), gain * np.array([1.0, math.sqrt(3.0) * tau])

    a_v, c_v = second(tu, d.sigma_u_m_s)  # L_v = L_u, sigma_v = sigma_u
    a_w, c_w = second(tw, d.sigma_w_m_s)
    a_wq = np.zeros((3, 3))
    a_wq[:2, :2], a_wq[2, :2], a_wq[2, 2] = a_w, c_w / t4, -1.0 / t4
    c_wq = np.zeros((2, 3))
    c_wq[0, :2] = c_w
    c_wq[1, :2], c_wq[1, 2] = c_w / (t4 * d.speed_m_s), -1.0 / (t4 * d.speed_m_s)
    return (
        lag(tu, d.sigma_u_m_s),
        shaper(a_v, np.array([0.0, 1.0]), c_v[None, :], dt_s),
        shaper(a_wq, np.array([0.0, 1.0, 0.0]), c_wq, dt_s),
        lag(t4, d.sigma_p_rad_s),
    )


@kernel
def _run(f, noise, c, x, white, out):
    n = len(x)
    new = np.empty(n)
    for k in range(len(white)):
        for i in range(c.shape[0]):
            total = 0.0
            for j in range(n):
                total += c[i, j] * x[j]
            out[k, i] = total
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += f[i, j] * x[j] + noise[i, j] * white[k, j]
            new[i] = total
        x[:] = new


def realise(d: Dryden, rng: np.random.Generator, steps: int, dt_s: float) -> np.ndarray:
    """One realisation, (steps, 5): u, v, w [m/s], p_g, q_g [rad/s]. Draws u, v, (w,q), p: initial state, then white input."""
    columns = []
    for s in shapers(d, dt_s):
        n = len(s.f)
        x = s.start @ rng.standard_normal(n)
        out = np.empty((steps, len(s.out)))
        _run(s.f, s.noise, s.out, x, rng.standard_normal((steps, n)), out)
        columns.append(out)
    u, v, wq, p = columns
    return np.hstack([u, v, wq[:, :1], p, wq[:, 1:]])
