"""Design-time algebra of linear models, dense numpy: a held input, an optimal gain. Never inside a loop."""

import numpy as np


def zoh(a: np.ndarray, b: np.ndarray, dt_s: float) -> tuple[np.ndarray, np.ndarray]:
    """(A_d, B_d) of x' = A x + B u with u held over dt. a (n, n), b (n, m)."""
    from scipy.linalg import expm

    n, m = b.shape
    block = expm(dt_s * np.block([[a, b], [np.zeros((m, n + m))]]))
    return np.ascontiguousarray(block[:n, :n]), np.ascontiguousarray(block[:n, n:])


def dlqr(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """K (m, n) of u = -K x for x(k+1) = a x + b u, cost x^T q x + u^T r u."""
    from scipy.linalg import solve_discrete_are

    p = solve_discrete_are(a, b, q, r)
    return np.ascontiguousarray(np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a))
