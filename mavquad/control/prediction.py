"""Stacked prediction of the MPC: plain numpy at design time, and the first gain of a finite horizon as a kernel.

Source: Yang, Lyu, Chai 2022, Eqs. (12)-(15). States e = [p - p_r, v - v_r, integral of (p - p_r)] of one axis, the input is an
acceleration (b = 1): an input u with gain b is the same problem with R/b^2.

Deviations from the paper:
  Eq. (12)       zero-order hold by default; "euler" is the printed form (up to 11 % less gain at 10 ms).
  Eqs. (13)-(15) targets are zero: e is already the error against the moving reference. The printed increments belong to an
                 error against the frozen one and lead the path by half a horizon; `first_move` takes them for comparison.
  weights        the undefined omega_sigma multiplies the last stage only.
"""

from typing import Literal, NamedTuple

import numpy as np

from mavquad.errors import ConfigError
from mavquad.jit import kernel


class Model(NamedTuple):
    a: np.ndarray  # (n,n)
    b: np.ndarray  # (n,)


class Stacked(NamedTuple):
    """xhat = P x + H u over the horizon, and the condensed cost 1/2 u'G u + (F x)'u."""

    p: np.ndarray  # (N n, n): block row j is A^(j+1)
    h: np.ndarray  # (N n, N): block (j,i) is A^(j-i) B
    g: np.ndarray  # (N, N)
    f: np.ndarray  # (N, n)


def position_model(dt_s: float, form: Literal["zoh", "euler"] = "zoh") -> Model:
    """[p, v, integral of p] driven by an acceleration, Eq. (12)."""
    if form == "euler":
        return Model(np.array([[1.0, dt_s, 0.0], [0.0, 1.0, 0.0], [dt_s, 0.0, 1.0]]), np.array([0.0, dt_s, 0.0]))
    a = np.array([[1.0, dt_s, 0.0], [0.0, 1.0, 0.0], [dt_s, 0.5 * dt_s**2, 1.0]])
    return Model(a, np.array([0.5 * dt_s**2, dt_s, dt_s**3 / 6.0]))


def angle_model(dt_s: float, form: Literal["zoh", "euler"] = "zoh") -> Model:
    """[angle, rate] driven by an angular acceleration, Eq. (21)."""
    return Model(np.array([[1.0, dt_s], [0.0, 1.0]]), np.array([0.5 * dt_s**2 if form == "zoh" else 0.0, dt_s]))


def lagged_model(dt_s: float, tau_s: float) -> Model:
    """[p, v, a] driven by a commanded acceleration that a follows with time constant tau: a' = (u - a)/tau. Exact."""
    e = float(np.exp(-dt_s / tau_s))
    # v gains the integral of a, p its double integral
    a_v = tau_s * (1.0 - e)
    a_p = tau_s * (dt_s - a_v)
    a = np.array([[1.0, dt_s, a_p], [0.0, 1.0, a_v], [0.0, 0.0, e]])
    return Model(a, np.array([0.5 * dt_s**2 - a_p, dt_s - a_v, 1.0 - e]))


def terminal(model: Model, q: np.ndarray, r: float) -> np.ndarray:
    """Terminal weight (n,n) with which any horizon gives the infinite one: the DARE's solution. q is the diagonal.

    Raises ConfigError where these weights have none, or none in double precision.
    """
    from scipy.linalg import solve_discrete_are

    try:
        return np.asarray(solve_discrete_are(model.a, model.b[:, None], np.diag(q), np.array([[r]])))
    except (np.linalg.LinAlgError, ValueError) as error:
        weights = ", ".join(f"{x:g}" for x in q)
        raise ConfigError(
            f"no gain belongs to state weights {weights} and input weight {r:g}: {error}; expected them within about"
            " 1e-12 to 1e12 of each other"
        ) from None


def lqr(model: Model, q: np.ndarray, r: float) -> np.ndarray:
    """The gain (n,) of the infinite horizon: u = -K x."""
    s = terminal(model, q, r)
    return np.asarray((model.b @ s @ model.a) / (r + model.b @ s @ model.b))


def stack(model: Model, horizon: int, q: np.ndarray, r: float, last: np.ndarray) -> Stacked:
    """Stage weight diag(q), input weight r, weight `last` (n,n) on the final state; Eqs. (13)-(15)."""
    n = len(q)
    powers = [np.eye(n)]
    for _ in range(horizon):
        powers.append(model.a @ powers[-1])
    p = np.vstack(powers[1:])
    h = np.zeros((horizon * n, horizon))
    for j in range(horizon):
        for i in range(j + 1):
            h[j * n : (j + 1) * n, i] = powers[j - i] @ model.b
    weight = np.kron(np.eye(horizon), np.diag(q))
    weight[-n:, -n:] = last
    g = h.T @ weight @ h + r * np.eye(horizon)
    return Stacked(p, h, 0.5 * (g + g.T), h.T @ weight @ p)


def first_gain(stacked: Stacked) -> np.ndarray:
    """The unconstrained law's first row: u(k) = -K x."""
    return np.asarray(np.linalg.solve(stacked.g, stacked.f)[0])


@kernel
def first_move(horizon, dt, euler, q1, q2, q3, omega, r, x, targets, inputs):
    """First input of the unconstrained horizon for [p, v, integral] with targets, by the backward recursion of its cost.

    Stage weights q1..q3, times omega on the last stage; input weight r; x (p, v, integral); targets (N,2) of position and
    velocity error and inputs (N,) of the input error (zeros: the moving reference). The condensed solve of Eq. (15) gives
    the same number; this needs no matrix, so a gain that changes with thrust costs a microsecond.
    """
    h2 = 0.0 if euler else 0.5 * dt * dt
    h3 = 0.0 if euler else dt * dt * dt / 6.0
    # V(x) = x'S x - 2 s'x
    t1, t2 = targets[horizon - 1, 0], targets[horizon - 1, 1]
    s11, s12, s13, s22, s23, s33 = omega * q1, 0.0, 0.0, omega * q2, 0.0, omega * q3
    l1, l2, l3 = omega * q1 * t1, omega * q2 * t2, 0.0
    u = 0.0
    for j in range(horizon - 1, -1, -1):
        # S B and B'S B, B = (h2, dt, h3)
        b1 = s11 * h2 + s12 * dt + s13 * h3
        b2 = s12 * h2 + s22 * dt + s23 * h3
        b3 = s13 * h2 + s23 * dt + s33 * h3
        m = r + h2 * b1 + dt * b2 + h3 * b3
        # K = B'S A / m;  A = [1 dt 0; 0 1 0; dt h2 1]
        k1 = (b1 + b3 * dt) / m
        k2 = (b1 * dt + b2 + b3 * h2) / m
        k3 = b3 / m
        w = (h2 * l1 + dt * l2 + h3 * l3 + r * inputs[j]) / m  # the part that follows the targets
        if j == 0:
            u = w - k1 * x[0] - k2 * x[1] - k3 * x[2]
            break
        # A'S A
        a11 = s11 + dt * s13
        a13 = s13 + dt * s33
        a12 = s12 + dt * s23
        n11 = a11 + dt * a13
        n12 = dt * a11 + a12 + h2 * a13
        n13 = a13
        c2 = dt * s13 + s23 + h2 * s33
        n22 = dt * (dt * s11 + s12 + h2 * s13) + (dt * s12 + s22 + h2 * s23) + h2 * c2
        n23 = c2
        n33 = s33
        # A'(l - S B w) + Q t: the linear term
        d1, d2, d3 = l1 - b1 * w, l2 - b2 * w, l3 - b3 * w
        e1 = d1 + dt * d3
        e2 = dt * d1 + d2 + h2 * d3
        e3 = d3
        s11 = q1 + n11 - m * k1 * k1
        s12 = n12 - m * k1 * k2
        s13 = n13 - m * k1 * k3
        s22 = q2 + n22 - m * k2 * k2
        s23 = n23 - m * k2 * k3
        s33 = q3 + n33 - m * k3 * k3
        l1 = e1 + q1 * targets[j - 1, 0]
        l2 = e2 + q2 * targets[j - 1, 1]
        l3 = e3
    return u
