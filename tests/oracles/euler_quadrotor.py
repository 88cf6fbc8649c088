"""The IADRC note's vehicle in Euler angles with numpy: slow, obvious, and sharing nothing with `estimate/ekf`.

State [p v eta w], NED, ZYX. `run` is filterpy's own filter set up as the note says.
"""

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter


def rotation(eta):
    f, t, s = eta
    rx = np.array([[1, 0, 0], [0, np.cos(f), -np.sin(f)], [0, np.sin(f), np.cos(f)]])
    ry = np.array([[np.cos(t), 0, np.sin(t)], [0, 1, 0], [-np.sin(t), 0, np.cos(t)]])
    rz = np.array([[np.cos(s), -np.sin(s), 0], [np.sin(s), np.cos(s), 0], [0, 0, 1]])
    return rz @ ry @ rx


def slope(x, thrust_m_s2, torque, f, tau, g, drag, inertia, kr):
    """xdot of the twelve states; J w' = torque - w x J w - kr w, disturbances as accelerations."""
    v, eta, w = x[3:6], x[6:9], x[9:12]
    phi, theta, _ = eta
    J = np.diag(inertia)
    W = np.array(
        [
            [1, np.sin(phi) * np.tan(theta), np.cos(phi) * np.tan(theta)],
            [0, np.cos(phi), -np.sin(phi)],
            [0, np.sin(phi) / np.cos(theta), np.cos(phi) / np.cos(theta)],
        ]
    )
    dv = np.array([0, 0, g]) - thrust_m_s2 * rotation(eta)[:, 2] - drag * v + f
    dw = np.linalg.solve(J, torque - np.cross(w, J @ w) - kr * w) + tau
    return np.concatenate([v, dv, W @ w, dw])


def rk4(x, dt, *args):
    k1 = slope(x, *args)
    k2 = slope(x + 0.5 * dt * k1, *args)
    k3 = slope(x + 0.5 * dt * k2, *args)
    k4 = slope(x + dt * k3, *args)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def jacobian(x, *args, h=1e-6):
    """Central differences of `slope`."""
    return np.stack([(slope(x + h * e, *args) - slope(x - h * e, *args)) / (2 * h) for e in np.eye(12)], axis=1)


def wrapped(a, b):
    """Innovation with the angles in (-pi, pi]; both are full rows of twelve."""
    y = a - b
    y[6:9] = (y[6:9] + np.pi) % (2 * np.pi) - np.pi
    return y


class Filter(ExtendedKalmanFilter):
    """filterpy's extended Kalman filter: F from the old x, then x by RK4, as the note asks."""

    def __init__(self, x0, p0, q, r, dt, model):
        super().__init__(dim_x=12, dim_z=12)
        self.x, self.P, self.Q, self.variances = np.array(x0, float), np.diag(p0), np.diag(q) * dt, np.asarray(r)
        self.dt, self.model = dt, model

    def predict_x(self, u=0):
        args = (*u, *self.model)
        A = jacobian_exact(self.x, *args) * self.dt
        self.F = np.eye(12) + A + A @ A / 2
        self.x = rk4(self.x, self.dt, *args)

    def absorb(self, z):
        """The finite rows of z (12,)."""
        rows = np.isfinite(z)
        H = np.eye(12)[rows]
        full = np.where(rows, z, self.x)

        self.update(
            full[rows],
            lambda x: H,
            lambda x: x[rows],
            R=np.diag(self.variances[rows]),
            residual=lambda a, b: wrapped(full, self.x)[rows],
        )


def jacobian_exact(x, *args):
    """d slope/dx by complex steps: exact to rounding, no formula shared with the filter under test."""
    out = np.empty((12, 12))
    for j in range(12):
        moved = x.astype(complex)
        moved[j] += 1e-30j
        out[:, j] = slope_complex(moved, *args).imag / 1e-30
    return out


def slope_complex(x, thrust_m_s2, torque, f, tau, g, drag, inertia, kr):
    v, (phi, theta, psi), w = x[3:6], x[6:9], x[9:12]
    s, c = np.sin, np.cos
    re3 = np.array(
        [c(psi) * s(theta) * c(phi) + s(psi) * s(phi), s(psi) * s(theta) * c(phi) - c(psi) * s(phi), c(phi) * c(theta)]
    )
    jx, jy, jz = inertia
    dv = np.array([0, 0, g]) - thrust_m_s2 * re3 - drag * v + f
    deta = np.array(
        [
            w[0] + np.tan(theta) * (w[1] * s(phi) + w[2] * c(phi)),
            w[1] * c(phi) - w[2] * s(phi),
            (w[1] * s(phi) + w[2] * c(phi)) / c(theta),
        ]
    )
    turn = np.array([(jy - jz) * w[1] * w[2], (jz - jx) * w[2] * w[0], (jx - jy) * w[0] * w[1]])
    dw = (np.asarray(torque) + turn - kr * w) / np.array(inertia) + np.asarray(tau)
    return np.concatenate([v, dv, deta, dw])
