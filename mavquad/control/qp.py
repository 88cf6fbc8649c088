"""Quadratic programs by OSQP: set up once, update the vectors, solve from a given start. The only import of osqp.

A result depends on the problem's data and on the start it is given, never on what was solved before: rho stays as designed
(with adaptive rho the same problem gives other bits after another history), and x and y come from the caller's state. No time
limit: it would make the result depend on the machine's load; the iteration limit bounds the time instead.
"""

from typing import Any, NamedTuple

import numpy as np
import osqp
from scipy import sparse

SOLVED, INACCURATE = 1, 2
REFUSED = -1  # data that OSQP must not see: not finite, or a lower bound above its upper one
ALPHA = 1.6  # over-relaxation
EPS, MAX_ITER = 1e-4, 600


class Problem(NamedTuple):
    """min 1/2 x'P x + q'x, l <= A x <= u with P and A fixed. `solver` holds the factorisation, and no memory that matters."""

    solver: Any
    rows: np.ndarray  # A, dense (m, n)
    weights: np.ndarray  # (m,): the solver sees w A, w l, w u


class Start(NamedTuple):
    """Where a solve begins: (n,) and (m,); belongs to the caller's state."""

    x: np.ndarray
    y: np.ndarray


class QpResult(NamedTuple):
    x: np.ndarray
    y: np.ndarray
    status: int
    iterations: int
    seconds: float  # of the solver, for statistics only

    @property
    def usable(self) -> bool:
        return self.status in (SOLVED, INACCURATE)


def problem(
    p: np.ndarray,
    rows: np.ndarray,
    *,
    rho: float,
    weights: np.ndarray | None = None,
    alpha: float = ALPHA,
    eps: float = EPS,
    max_iter: int = MAX_ITER,
) -> Problem:
    """Factorise once. p (n,n) positive definite, rows (m,n). A weight w of a row gives it the step rho w^2; None: 1 each."""
    n, m = p.shape[0], rows.shape[0]
    weights = np.ones(m) if weights is None else weights
    solver = osqp.OSQP()
    solver.setup(
        sparse.csc_matrix(np.triu(p)),
        np.zeros(n),
        sparse.csc_matrix(weights[:, None] * rows),
        -np.ones(m),
        np.ones(m),
        rho=rho,
        adaptive_rho=False,
        scaling=0,  # by the weights, at design time: OSQP's own would undo them
        alpha=alpha,
        eps_abs=eps,
        eps_rel=eps,
        max_iter=max_iter,
        check_termination=5,
        warm_starting=True,
        polishing=False,
        verbose=False,
    )
    return Problem(solver, rows, weights)


def cold(problem: Problem) -> Start:
    m, n = problem.rows.shape
    return Start(np.zeros(n), np.zeros(m))


def solve(problem: Problem, q: np.ndarray, lower: np.ndarray, upper: np.ndarray, start: Start) -> QpResult:
    """One solve from `start`. A result that is not `usable` comes with the cold start to go on from."""
    if not (np.isfinite(q).all() and np.isfinite(lower).all() and np.isfinite(upper).all() and (lower <= upper).all()):
        return _failed(problem, REFUSED, 0, 0.0)
    # OSQP keeps old bounds where l > u, and a NaN for ever: both are kept from it
    w = problem.weights
    problem.solver.update(q=q, l=w * lower, u=w * upper)
    problem.solver.warm_start(x=start.x, y=start.y / w)
    found = problem.solver.solve(raise_error=False)
    info = found.info
    status, iterations, seconds = int(info.status_val), int(info.iter), float(info.solve_time)
    if status not in (SOLVED, INACCURATE) or not (np.isfinite(found.x).all() and np.isfinite(found.y).all()):
        return _failed(problem, status, iterations, seconds)
    return QpResult(np.array(found.x), w * found.y, status, iterations, seconds)


def _failed(problem: Problem, status: int, iterations: int, seconds: float) -> QpResult:
    x, y = cold(problem)
    return QpResult(x, y, status if status not in (SOLVED, INACCURATE) else REFUSED, iterations, seconds)
