"""ASMF with all outputs in one update: the paper's Eq. (26), corrected or as printed. For comparison; flight takes strips.

Source: Song et al. 2011 (paper 004), Eq. (26). R = m diag(e^2) for a box of m outputs.

Deviations from the paper:
  Eq. (26)  second term of P over (1 - rho)^2, rho on outputs scaled by R^-1/2 (both as printed on request).
  no text   delta <= 0: dropped twice, the third time P grows by the smallest factor that brings delta to 0.2. delta <= 0 is
            sufficient for an empty set, not necessary: some contradictions pass unseen.
"""

import math

import numpy as np

from mavquad.estimate import ellipsoid
from mavquad.estimate.asmf import OUTLIERS, Gains, State, judged
from mavquad.jit import kernel

INFLATED_DELTA = 0.2


@kernel
def update(gains: Gains, state: State, y: np.ndarray, r: np.ndarray, scaled: bool, printed: bool, t_us: int) -> State:
    """Intersect with all finite y (m,) at once; r (m,) the diagonal of R for as many outputs as are finite."""
    arrived = 0
    for i in range(y.shape[0]):
        if math.isfinite(y[i]):
            arrived += 1
    if arrived == 0:
        return state
    n = state.x.shape[0]
    c, values, shape = np.empty((arrived, n)), np.empty(arrived), np.empty(arrived)
    row = 0
    for i in range(y.shape[0]):
        if math.isfinite(y[i]):
            for j in range(n):
                c[row, j] = gains.c[i, j]
            values[row], shape[row] = y[i], r[i]
            row += 1
    x, p, n_bad = state.x.copy(), state.p.copy(), state.n_bad.copy()
    delta = ellipsoid.joint(x, p, c, values, shape, scaled, printed)
    empty, inflations = 0, 0
    if delta > 0.0:
        n_bad[0] = 0
    else:
        empty = 1
        n_bad[0] += 1
        if n_bad[0] > OUTLIERS:
            n_bad[0] = 0
            factor = inflation_factor(x, p, c, values, shape, scaled)
            if math.isfinite(factor):
                p *= factor
                ellipsoid.joint(x, p, c, values, shape, scaled, printed)
                inflations = 1
    return judged(gains, state, x, p, n_bad, empty, inflations, delta, t_us)


@kernel
def inflation_factor(x: np.ndarray, p: np.ndarray, c: np.ndarray, y: np.ndarray, r: np.ndarray, scaled: bool) -> float:
    """The smallest factor on P that brings delta of Eq. (26) to 0.2, by bisection; inf where none below 1e30 does."""
    _, g, rho = ellipsoid.innovation_shape(p, c, r, scaled)
    nu = ellipsoid.innovation(x, c, y)
    ratio = (1.0 - rho) / rho  # sqrt(p_m/r_m), grows with the square root of the factor
    low, high = 0.0, 0.0
    while not ellipsoid.joint_delta(math.exp(high) * g, 1.0 / (1.0 + math.exp(0.5 * high) * ratio), r, nu) >= INFLATED_DELTA:
        low, high = high, high + 1.0
        if high > 69.0:
            return math.inf
    for _ in range(60):
        middle = 0.5 * (low + high)
        if ellipsoid.joint_delta(math.exp(middle) * g, 1.0 / (1.0 + math.exp(0.5 * middle) * ratio), r, nu) >= INFLATED_DELTA:
            high = middle
        else:
            low = middle
    return math.exp(high)
