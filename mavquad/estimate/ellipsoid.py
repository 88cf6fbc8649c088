"""Ellipsoids E(x, P) = {z: (z - x)^T P^-1 (z - x) <= 1} as kernels: the set algebra under the adaptive set-membership filter.

Source: Song et al. 2011 (paper 004), Eq. (26), after Zhou & Han 2008. x (n,) and P (n, n) are changed in place. Noise is a box:
|v_i| <= e_i on every output, |w_i| <= b_i on every state and step. A box of m sides lies in the ellipsoid m diag(e^2): without
the factor m the truth is lost.

Deviations from the paper:
  Eq. (26)  second term of P over (1 - rho)^2, the update of P/(1 - rho); as printed the set is valid but looser.
  Eq. (26)  r_m and p_m are eigenvalues of outputs scaled by R^-1/2, else rho depends on the units.
  Eq. (26)  traces in scaled units, sum P_ii/S_i^2: any beta in (0, 1) keeps the guarantee, S only says what is to be tight.
  strips    one output at a time: a strip |y_i - c^T z| <= e_i needs no factor m, and its emptiness test is exact.
"""

import math

import numpy as np

from mavquad import linalg
from mavquad.jit import kernel

RHO_STEPS = 38  # rho = k/38: only tightness hangs on it, never the guarantee
DELTA_MIN = 0.02  # joint form: enlarging is always safe
STRIP_DELTA_MIN = 1e-6
EIGENVALUE_MIN = 1e-12  # of P in scaled units


@kernel
def strip(x: np.ndarray, p: np.ndarray, c: np.ndarray, y: float, e: float, inv_s2: np.ndarray) -> float:
    """Intersect with the strip |y - c^T z| <= e, rho of least scaled trace among k/38. Returns delta, or -1 where it is empty.

    c (n,), inv_s2 (n,) = 1/S_i^2. Empty means |y - c^T x| >= sqrt(c^T P c) + e, exactly; then nothing is changed.
    """
    n = x.shape[0]
    pc = np.zeros(n)
    for j in range(n):
        if c[j] != 0.0:
            for i in range(n):
                pc[i] += p[i, j] * c[j]
    g, nu, trace, trace_pc = 0.0, y, 0.0, 0.0
    for i in range(n):
        g += c[i] * pc[i]
        nu -= c[i] * x[i]
        trace += p[i, i] * inv_s2[i]
        trace_pc += pc[i] * pc[i] * inv_s2[i]
    if not abs(nu) < math.sqrt(max(g, 0.0)) + e:
        return -1.0
    r = e * e
    best, best_rho, best_w, best_d = trace, 0.0, 1.0, 1.0
    for k in range(1, RHO_STEPS):
        rho = k / RHO_STEPS
        w = g / (1.0 - rho) + r / rho
        d = 1.0 - nu * nu / w
        if d <= 0.0:
            continue
        cost = d / (1.0 - rho) * (trace - trace_pc / ((1.0 - rho) * w))
        if cost < best:
            best, best_rho, best_w, best_d = cost, rho, w, d
    if best_rho == 0.0:
        return 1.0
    d = max(best_d, STRIP_DELTA_MIN)
    first = d / (1.0 - best_rho)
    second = first / ((1.0 - best_rho) * best_w)
    gain = nu / ((1.0 - best_rho) * best_w)
    for i in range(n):
        x[i] += gain * pc[i]
        for j in range(i + 1):
            value = first * p[i, j] - second * pc[i] * pc[j]
            p[i, j] = value
            p[j, i] = value
    return best_d


@kernel
def innovation_shape(p: np.ndarray, c: np.ndarray, r: np.ndarray, scaled: bool) -> tuple[np.ndarray, np.ndarray, float]:
    """(P C^T, C P C^T, rho) of Eq. (26). c (m, n), r (m,) the diagonal of R; `scaled` takes rho on R^-1/2-scaled outputs."""
    m, n = c.shape
    pct = np.zeros((n, m))
    for i in range(n):
        for k in range(m):
            total = 0.0
            for j in range(n):
                total += p[i, j] * c[k, j]
            pct[i, k] = total
    g = np.zeros((m, m))
    for k in range(m):
        for l in range(m):
            total = 0.0
            for j in range(n):
                total += c[k, j] * pct[j, l]
            g[k, l] = total
    linalg.symmetrize(g)
    shape = g.copy()
    r_m = 0.0
    for k in range(m):
        r_m = max(r_m, r[k])
    if scaled:
        r_m = 1.0
        for k in range(m):
            for l in range(m):
                shape[k, l] = g[k, l] / math.sqrt(r[k] * r[l])
    p_m = max(largest_eigenvalue(shape), 0.0)
    rho = math.sqrt(r_m) / (math.sqrt(r_m) + math.sqrt(p_m))
    return pct, g, min(max(rho, 1e-9), 1.0 - 1e-9)


@kernel
def innovation(x: np.ndarray, c: np.ndarray, y: np.ndarray) -> np.ndarray:
    """y - C x, (m,)."""
    nu = y.copy()
    for k in range(c.shape[0]):
        for j in range(c.shape[1]):
            nu[k] -= c[k, j] * x[j]
    return nu


@kernel
def largest_eigenvalue(symmetric: np.ndarray) -> float:
    """Of a small symmetric matrix, by cyclic Jacobi rotations (LAPACK's takes longer to compile than all kernels here)."""
    a = symmetric.copy()
    n = a.shape[0]
    for _ in range(30):
        off, diagonal = 0.0, 0.0
        for i in range(n):
            diagonal += a[i, i] * a[i, i]
            for j in range(i):
                off += a[i, j] * a[i, j]
        if off <= 1e-30 * diagonal:
            break
        for i in range(n):
            for j in range(i):
                if a[i, j] == 0.0:
                    continue
                theta = 0.5 * (a[i, i] - a[j, j]) / a[i, j]
                t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + math.sqrt(theta * theta + 1.0))
                cos = 1.0 / math.sqrt(t * t + 1.0)
                sin = t * cos
                for k in range(n):
                    a_ki, a_kj = a[k, i], a[k, j]
                    a[k, i], a[k, j] = cos * a_ki + sin * a_kj, cos * a_kj - sin * a_ki
                for k in range(n):
                    a_ik, a_jk = a[i, k], a[j, k]
                    a[i, k], a[j, k] = cos * a_ik + sin * a_jk, cos * a_jk - sin * a_ik
    largest = -math.inf
    for i in range(n):
        largest = max(largest, a[i, i])
    return largest


@kernel
def joint_delta(g: np.ndarray, rho: float, r: np.ndarray, nu: np.ndarray) -> float:
    """delta = 1 - nu^T W^-1 nu with W = G/(1 - rho) + R/rho; g (m, m), r and nu (m,). NaN where W is not positive."""
    w = _innovation_matrix(g, rho, r)
    lower = np.empty_like(w)
    if not linalg.cholesky(w, lower):
        return math.nan
    z = nu.copy().reshape(-1, 1)
    linalg.cholesky_solve(lower, z)
    total = 0.0
    for k in range(nu.shape[0]):
        total += nu[k] * z[k, 0]
    return 1.0 - total


@kernel
def joint(x: np.ndarray, p: np.ndarray, c: np.ndarray, y: np.ndarray, r: np.ndarray, scaled: bool, printed: bool) -> float:
    """Measurement update of Eq. (26) with all m outputs at once. Returns delta; where delta <= 0 or NaN nothing is changed.

    c (m, n), y (m,), r (m,) diagonal of the shape matrix R: m e_i^2 for a box. `printed` takes the second term of P over
    (1 - rho), as in the paper; else the corrected, Joseph-like form, whose delta is held >= 0.02.
    """
    m, n = c.shape
    pct, g, rho = innovation_shape(p, c, r, scaled)
    nu = innovation(x, c, y)
    delta = joint_delta(g, rho, r, nu)
    if not delta > 0.0:
        return delta
    w = _innovation_matrix(g, rho, r)
    lower = np.empty_like(w)
    linalg.cholesky(w, lower)
    gain_t = pct.T.copy()
    linalg.cholesky_solve(lower, gain_t)  # W^-1 C P: the gain is its transpose over (1 - rho)
    for i in range(n):
        for k in range(m):
            x[i] += gain_t[k, i] * nu[k] / (1.0 - rho)
    if printed:
        for i in range(n):
            for j in range(i + 1):
                total = p[i, j]
                for k in range(m):
                    total -= pct[i, k] * gain_t[k, j]
                p[i, j] = delta * total / (1.0 - rho)
                p[j, i] = p[i, j]
        return delta
    _joseph(p, c, gain_t, r, rho, max(delta, DELTA_MIN))
    return delta


@kernel
def propagate(x: np.ndarray, p: np.ndarray, f: np.ndarray, drive: np.ndarray, q: np.ndarray, inv_s2: np.ndarray) -> None:
    """Predict: x = F x + drive, P = F P F^T/(1 - beta) + Q/beta, beta of least scaled trace. f (n, n), drive (n,), q (n,) diag Q.

    drive is G u and whatever else is known; q = n_b b_i^2 for a box, n_b the number of sides that are not zero.
    """
    n = x.shape[0]
    moved = np.empty(n)
    fp = np.zeros((n, n))
    for i in range(n):
        total = drive[i]
        for k in range(n):
            f_ik = f[i, k]
            if f_ik != 0.0:
                total += f_ik * x[k]
                for j in range(n):
                    fp[i, j] += f_ik * p[k, j]
        moved[i] = total
    trace_m, trace_q = 0.0, 0.0
    for i in range(n):
        x[i] = moved[i]
        for j in range(i + 1):
            p[i, j] = 0.0
        for k in range(n):
            f_ik = f[i, k]
            if f_ik != 0.0:
                for j in range(i + 1):
                    p[i, j] += fp[j, k] * f_ik
        trace_m += p[i, i] * inv_s2[i]
        trace_q += q[i] * inv_s2[i]
    beta = 0.0
    if trace_q > 0.0:
        beta = math.sqrt(trace_q) / (math.sqrt(trace_q) + math.sqrt(max(trace_m, 0.0)))
    for i in range(n):
        for j in range(i + 1):
            value = p[i, j] / (1.0 - beta) if beta < 1.0 else 0.0
            if i == j and beta > 0.0:
                value += q[i] / beta
            p[i, j] = value
            p[j, i] = value


@kernel
def keep_positive(p: np.ndarray, inv_s2: np.ndarray) -> bool:
    """Enlarge P until its smallest eigenvalue in scaled units is >= 1e-12. True where it had to (enlarging is safe)."""
    n = p.shape[0]
    added, step = False, EIGENVALUE_MIN
    shifted, lower = np.empty((n, n)), np.empty((n, n))
    for _ in range(60):
        for i in range(n):
            for j in range(n):
                shifted[i, j] = p[i, j] * math.sqrt(inv_s2[i] * inv_s2[j])
            shifted[i, i] -= EIGENVALUE_MIN
        if linalg.cholesky(shifted, lower):
            return added
        added = True
        for i in range(n):
            p[i, i] += step / inv_s2[i]
        step *= 4.0
    return added


@kernel
def form(x: np.ndarray, p: np.ndarray, z: np.ndarray) -> float:
    """(z - x)^T P^-1 (z - x): z is inside where this is <= 1. Infinite where P is not positive definite."""
    n = x.shape[0]
    lower = np.empty((n, n))
    if not linalg.cholesky(p, lower):
        return math.inf
    error = np.empty((n, 1))
    for i in range(n):
        error[i, 0] = z[i] - x[i]
    solved = error.copy()
    linalg.cholesky_solve(lower, solved)
    total = 0.0
    for i in range(n):
        total += error[i, 0] * solved[i, 0]
    return total


@kernel
def _innovation_matrix(g: np.ndarray, rho: float, r: np.ndarray) -> np.ndarray:
    w = g / (1.0 - rho)
    for k in range(r.shape[0]):
        w[k, k] += r[k] / rho
    return w


@kernel
def _joseph(p: np.ndarray, c: np.ndarray, gain_t: np.ndarray, r: np.ndarray, rho: float, delta: float) -> None:
    """P = delta [(I - K C) P (I - K C)^T/(1 - rho) + K R K^T/rho] with K = gain_t^T/(1 - rho)."""
    m, n = c.shape
    left = np.zeros((n, n))
    for i in range(n):
        left[i, i] = 1.0
        for k in range(m):
            gain = gain_t[k, i] / (1.0 - rho)
            for j in range(n):
                left[i, j] -= gain * c[k, j]
    half = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            if left[i, k] != 0.0:
                for j in range(n):
                    half[i, j] += left[i, k] * p[k, j]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += half[i, k] * left[j, k]
            noise = 0.0
            for k in range(m):
                noise += gain_t[k, i] * r[k] * gain_t[k, j]
            value = delta * (total / (1.0 - rho) + noise / ((1.0 - rho) * (1.0 - rho) * rho))
            p[i, j] = value
            p[j, i] = value
