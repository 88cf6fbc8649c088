"""The paper's own correction for matrices: weighted least squares on one step, and its three ways to choose the next output.

Source: Song et al. 2011 (paper 004), Eqs. (27)-(38). For comparison and design; nothing flies on it: on a helicopter B acts on
measured states through flapping only, and matching one step over-drives the servos about twelve times.

Deviations from the paper:
  Eqs. (34), (35)  the term C^a A^a x(k, k) is restored, else the correction is proportional to the absolute output.
  Eq. (33)         alpha = 1 - delta varies and is clipped with delta to [0.02, 1].
  Eq. (36)         the box is that of the predicted P, about the predicted centre; eight outputs give 256 vertices, not 2^13.
  Eqs. (36)-(38)   taking the worst vertex is max-min: it jumps between far corners. `centre` takes the predicted centre,
                   `minmax` the stick that is best against the worst vertex.
"""

import itertools
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from mavquad.errors import ConfigError

MODES = ("centre", "minmax", "vertex")


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One step of the augmented model, discretised; n states, m outputs, k sticks."""

    b: np.ndarray  # (n, k) B_d
    b_f: np.ndarray  # (n, n_f) B_fd
    c: np.ndarray  # (m, n)
    w: np.ndarray  # (m, m) W of the filter, predicted
    half_width: np.ndarray  # (m,) of the predicted outputs
    delta: float


class Choice(NamedTuple):
    u: np.ndarray  # (k,)
    cost: float  # J_k + alpha max over the box of J^delta: what the paper wants small


def correct(step: Step, u_nominal: np.ndarray, f: np.ndarray, mode: Literal["centre", "minmax", "vertex"]) -> Choice:
    """Sticks for this step, by `mode`. u_nominal (k,), f (n_f,). Raises ConfigError for an unknown mode."""
    if mode not in MODES:
        raise ConfigError(f"matching mode {mode!r}: expected one of {', '.join(MODES)}")
    centre = step.c @ (step.b @ u_nominal)  # of the next output beyond C A x, when the error is cancelled
    if mode == "centre":
        return _judged(step, least_squares(step, u_nominal, f, centre), u_nominal, f)
    corners = _corners(step)
    if mode == "vertex":
        candidates = [least_squares(step, u_nominal, f, centre + corner) for corner in corners]
        worst = [_form(step, centre + corner - step.c @ step.b @ u) for corner, u in zip(corners, candidates, strict=True)]
        return _judged(step, candidates[int(np.argmax(worst))], u_nominal, f)
    return _judged(step, _min_max(step, u_nominal, f, corners), u_nominal, f)


def least_squares(step: Step, u_nominal: np.ndarray, f: np.ndarray, output: np.ndarray) -> np.ndarray:
    """Eq. (35), corrected: U for a given next output less C A x, (m,)."""
    delta, alpha = _weights(step)
    h = delta * step.c.T @ step.c
    cb = step.c @ step.b
    m = step.b.T @ h @ step.b + alpha * cb.T @ np.linalg.solve(step.w, cb)
    right = alpha * cb.T @ np.linalg.solve(step.w, output) - step.b.T @ h @ (step.b_f @ f - step.b @ u_nominal)
    return np.linalg.solve(m, right)


def _min_max(step: Step, u_nominal: np.ndarray, f: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """min over U of J_k + alpha max over corners: a quadratic program with one bound per corner."""
    from scipy.optimize import minimize

    start = least_squares(step, u_nominal, f, step.c @ step.b @ u_nominal)
    cb, w_inverse = step.c @ step.b, np.linalg.inv(step.w)
    _, alpha = _weights(step)

    def rest(u: np.ndarray) -> np.ndarray:
        return cb @ (u_nominal - u) + corners

    def limits(z: np.ndarray) -> np.ndarray:
        d = rest(z[:-1])
        return z[-1] - np.einsum("ij,jk,ik->i", d, w_inverse, d)

    def slopes(z: np.ndarray) -> np.ndarray:
        return np.hstack([2.0 * rest(z[:-1]) @ w_inverse @ cb, np.ones((corners.shape[0], 1))])

    def cost(z: np.ndarray) -> float:
        return _matching_cost(step, z[:-1], u_nominal, f) + alpha * float(z[-1])

    first = np.append(start, -limits(np.append(start, 0.0)).min())
    bound = {"type": "ineq", "fun": limits, "jac": slopes}
    found = minimize(cost, first, method="SLSQP", constraints=[bound], options={"maxiter": 200, "ftol": 1e-12})
    return np.asarray(found.x[:-1])


def _weights(step: Step) -> tuple[float, float]:
    delta = min(max(step.delta, 0.02), 1.0)
    return delta, 1.0 - delta


def _corners(step: Step) -> np.ndarray:
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=step.c.shape[0])))
    return signs * step.half_width


def _form(step: Step, d: np.ndarray) -> float:
    return float(d @ np.linalg.solve(step.w, d))


def _matching_cost(step: Step, u: np.ndarray, u_nominal: np.ndarray, f: np.ndarray) -> float:
    """Eq. (28)."""
    d = step.c @ (step.b @ u + step.b_f @ f - step.b @ u_nominal)
    return _weights(step)[0] * float(d @ d)


def _judged(step: Step, u: np.ndarray, u_nominal: np.ndarray, f: np.ndarray) -> Choice:
    d = step.c @ step.b @ (u_nominal - u) + _corners(step)
    worst = float(np.einsum("ij,jk,ik->i", d, np.linalg.inv(step.w), d).max())
    return Choice(u, _matching_cost(step, u, u_nominal, f) + _weights(step)[1] * worst)
