"""Eq. (26) of paper 004 in dense numpy, written from the formulas; slow and obvious."""

import numpy as np


def joint(x, p, c, y, r, scaled, printed):
    """(x, P, delta) after a measurement update; r is the diagonal of R."""
    r_matrix = np.diag(r)
    g = c @ p @ c.T
    if scaled:
        root = np.diag(r**-0.5)
        r_m, p_m = 1.0, np.linalg.eigvalsh(root @ g @ root)[-1]
    else:
        r_m, p_m = r.max(), np.linalg.eigvalsh(g)[-1]
    rho = np.sqrt(r_m) / (np.sqrt(r_m) + np.sqrt(p_m))
    w = g / (1 - rho) + r_matrix / rho
    gain = p @ c.T @ np.linalg.inv(w) / (1 - rho)
    nu = y - c @ x
    delta = 1 - nu @ np.linalg.inv(w) @ nu
    if printed:
        after = delta * (p / (1 - rho) - p @ c.T @ np.linalg.inv(w) @ c @ p / (1 - rho))
    else:
        after = max(delta, 0.02) * (p / (1 - rho) - p @ c.T @ np.linalg.inv(w) @ c @ p / (1 - rho) ** 2)
    return x + gain @ nu, after, delta


def strip(x, p, c, y, e, s):
    """(x, P, delta) after the strip |y - c z| <= e, or None where the strip misses the ellipsoid."""
    nu, g, r = y - c @ x, c @ p @ c, e * e
    if abs(nu) >= np.sqrt(g) + e:
        return None
    best = (np.sum(np.diag(p) / s**2), x, p, 1.0)
    for rho in np.arange(1, 38) / 38:
        w = g / (1 - rho) + r / rho
        delta = 1 - nu * nu / w
        if delta <= 0:
            continue
        shape = delta * (p / (1 - rho) - np.outer(p @ c, p @ c) / ((1 - rho) ** 2 * w))
        cost = np.sum(np.diag(shape) / s**2)
        if cost < best[0]:
            centre = x + p @ c / ((1 - rho) * w) * nu
            best = (cost, centre, shape * max(delta, 1e-6) / delta, delta)
    return best[1:]


def propagate(x, p, f, drive, q, s):
    """(x, P) one tick later; q is the diagonal of Q."""
    m = f @ p @ f.T
    beta = 0.0
    if q.any():
        root_q, root_m = np.sqrt(np.sum(q / s**2)), np.sqrt(np.sum(np.diag(m) / s**2))
        beta = root_q / (root_q + root_m)
        m = m / (1 - beta) + np.diag(q) / beta
    return f @ x + drive, m
