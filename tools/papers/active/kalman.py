"""A plain Kalman filter as kernels, scalar updates: the rival that has the same model and no guaranteed bounds."""

import math

import numpy as np

from mavquad.jit import kernel


@kernel
def predict(x: np.ndarray, p: np.ndarray, f: np.ndarray, drive: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(x, P) one tick later. f (n, n), drive (n,), q (n,) variances."""
    n = x.shape[0]
    moved, fp, out = drive.copy(), np.zeros((n, n)), np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            if f[i, k] != 0.0:
                moved[i] += f[i, k] * x[k]
                for j in range(n):
                    fp[i, j] += f[i, k] * p[k, j]
    for i in range(n):
        for k in range(n):
            if f[i, k] != 0.0:
                for j in range(n):
                    out[j, i] += fp[j, k] * f[i, k]
        out[i, i] += q[i]
    return moved, out


@kernel
def update(x: np.ndarray, p: np.ndarray, c: np.ndarray, y: np.ndarray, r: np.ndarray) -> None:
    """One output after another, in place; NaN is skipped. c (m, n), y (m,), r (m,) variances."""
    n = x.shape[0]
    for row in range(y.shape[0]):
        if not math.isfinite(y[row]):
            continue
        pc = np.zeros(n)
        nu, s = y[row], r[row]
        for i in range(n):
            for j in range(n):
                pc[i] += p[i, j] * c[row, j]
        for i in range(n):
            nu -= c[row, i] * x[i]
            s += c[row, i] * pc[i]
        for i in range(n):
            x[i] += pc[i] * nu / s
            for j in range(n):
                p[i, j] -= pc[i] * pc[j] / s
