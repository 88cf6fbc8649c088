"""Small dense algebra as kernels: vectors are tuples of three floats, matrices are arrays."""

import math

import numpy as np

from mavquad.jit import kernel

Vec3 = tuple[float, float, float]


@kernel
def add(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@kernel
def sub(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@kernel
def scale(s: float, a: Vec3) -> Vec3:
    return (s * a[0], s * a[1], s * a[2])


@kernel
def axpy(s: float, a: Vec3, b: Vec3) -> Vec3:
    """s a + b."""
    return (s * a[0] + b[0], s * a[1] + b[1], s * a[2] + b[2])


@kernel
def dot(a: Vec3, b: Vec3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a: Vec3, b: Vec3) -> Vec3:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@kernel
def norm(a: Vec3) -> float:
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@kernel
def finite3(a: Vec3) -> bool:
    return math.isfinite(a[0]) and math.isfinite(a[1]) and math.isfinite(a[2])


@kernel
def clip(x: float, lo: float, hi: float) -> float:
    """x inside [lo, hi]; a NaN stays a NaN, for the limits gate to see."""
    if x < lo:
        return lo
    if x > hi:
        return hi
    return x


@kernel
def symmetrize(p: np.ndarray) -> None:
    """p := (p + p^T)/2 in place."""
    n = p.shape[0]
    for i in range(n):
        for j in range(i):
            mean = 0.5 * (p[i, j] + p[j, i])
            p[i, j] = mean
            p[j, i] = mean


@kernel
def cholesky(a: np.ndarray, lower: np.ndarray) -> bool:
    """Lower factor of a symmetric positive definite (n,n) into `lower`; False (and no promise) where a is not."""
    n = a.shape[0]
    for i in range(n):
        for j in range(n):
            lower[i, j] = 0.0
    for j in range(n):
        total = a[j, j]
        for k in range(j):
            total -= lower[j, k] * lower[j, k]
        if not total > 0.0:
            return False
        pivot = math.sqrt(total)
        lower[j, j] = pivot
        for i in range(j + 1, n):
            total = a[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = total / pivot
    return True


@kernel
def cholesky_solve(lower: np.ndarray, b: np.ndarray) -> None:
    """Solve (L L^T) x = b in place; b is (n,m)."""
    n = lower.shape[0]
    for c in range(b.shape[1]):
        for i in range(n):
            total = b[i, c]
            for k in range(i):
                total -= lower[i, k] * b[k, c]
            b[i, c] = total / lower[i, i]
        for i in range(n - 1, -1, -1):
            total = b[i, c]
            for k in range(i + 1, n):
                total -= lower[k, i] * b[k, c]
            b[i, c] = total / lower[i, i]
