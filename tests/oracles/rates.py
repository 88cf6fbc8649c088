"""The rate observers' note in numpy and scipy: rotation matrices, dense covariances, root finding. Slow, and shares nothing with them.

Quaternions are arrays (w, x, y, z); J is known by its gyroscopic ratios; `a` is torque over inertia at a time after the step's start.
"""

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation


def rotation(q):
    return Rotation.from_quat(np.asarray(q)[[1, 2, 3, 0]])


def quaternion(r, near):
    """Of a rotation, with the sign nearest to `near`."""
    x, y, z, w = r.as_quat()
    q = np.array([w, x, y, z])
    return q if np.dot(q, near) >= 0.0 else -q


def generator(w):
    """A(w) of the paper's Eq. (26), corrected."""
    x, y, z = w
    return 0.5 * np.array([[0, -x, -y, -z], [x, 0, z, -y], [y, -z, 0, x], [z, y, -x, 0]])


def cayley_matrix(xi):
    u = generator(xi)
    return np.linalg.solve(np.eye(4) - u / 2, np.eye(4) + u / 2)


def dcay_inverse(xi, w):
    u, v = generator(xi), generator(w)
    return 2.0 * (v - 0.5 * (u @ v - v @ u) - 0.25 * u @ v @ u)[1:, 0]


def euler_equation(gyro, w, a):
    return np.asarray(a) + np.asarray(gyro) * np.array([w[1] * w[2], w[2] * w[0], w[0] * w[1]])


def midpoint(gyro, q, w, a0, a1, i1, i2, h, exponential=False):
    """One step of order 2 (note, section 5, step 7)."""
    w_mid = w + h / 2 * (euler_equation(gyro, w, a0) - i2)
    xi = h * (w_mid - i1)
    if exponential:
        turned = quaternion(rotation(q) * Rotation.from_rotvec(xi), q)
    else:
        turned = cayley_matrix(dcay_inverse(h / 2 * (w - i1), xi)) @ q
    return turned, w + h * (euler_equation(gyro, w_mid, a1) - i2)


def lie_euler(gyro, q, w, a0, i1, i2, h):
    """One step of the paper's Eq. (30)."""
    return cayley_matrix(h * (w - i1)) @ q, w + h * (euler_equation(gyro, w, a0) - i2)


def classical(gyro, q, w, a0, a1, a2, i1, i2, h):
    """One step of order 4 (note, section 5), with the tableau written out."""
    kappa, slope = [], []
    for xi_c, a in ((0.0, a0), (0.5, a1), (0.5, a1), (1.0, a2)):
        w_i = w + xi_c * h * (slope[-1] if slope else 0.0)
        xi = xi_c * h * (kappa[-1] if kappa else np.zeros(3))
        kappa.append(dcay_inverse(xi, w_i - i1))
        slope.append(euler_equation(gyro, w_i, a) - i2)
    b = np.array([1, 2, 2, 1]) / 6.0
    return cayley_matrix(h * b @ kappa) @ q, w + h * b @ slope


def error(q_meas, q_hat):
    """e = 2 sgn(q_e0) v(q_e), Eq. (23)."""
    r = (rotation(q_meas).inv() * rotation(q_hat)).as_rotvec()
    angle = np.linalg.norm(r)
    return 2.0 * np.sin(angle / 2) * r / angle if angle > 0 else r


def third_order(b, T, L):
    """One axis of G9: (y, decrement of w, decrement of d), the root by bisection."""
    G = 1.1 * T**3 * L
    if abs(b) <= G:
        return 0.0, 1.1 * T**2 * L * b / G, 1.1 * T * L * b / G
    A2, A1 = 2.0 * T * L ** (1 / 3), 2.12 * T**2 * L ** (2 / 3)
    z = brentq(lambda z: z**3 + A2 * z**2 + A1 * z + G - abs(b), 0.0, 10.0, xtol=1e-15)
    sign = np.sign(b)
    return sign * z**3, sign * (2.12 * T * L ** (2 / 3) * z + 1.1 * T**2 * L), sign * 1.1 * T * L


def super_twisting(b, T, k1, k2):
    """One axis of G8: y solves y + T k1 sqrt|y| sgn y + T^2 k2 sgn y = b."""
    if abs(b) <= T**2 * k2:
        return 0.0, b / T, 0.0
    y = brentq(lambda y: y + T * k1 * np.sqrt(y) + T**2 * k2 - abs(b), 0.0, abs(b), xtol=1e-16)
    return np.sign(b) * y, np.sign(b) * T * k2, 0.0


class Bank:
    """Section 7.1 of the note with its later members: coloured noise, doubt in the beginning, rates that turn with the attitude."""

    TAUS = (*[None] * 12, *(tau for tau in (0.05, 0.2, 0.8) for _ in range(4)))
    INDEX = (*(10.0**k for k in range(-8, 4)), *(10.0**k for _ in range(3) for k in range(-6, -2)))
    JERK = (0.1**0.5, 1.0, 10.0**0.5, 10.0, 1000.0**0.5)
    DOUBT = np.array([0.5 * k for k in range(12)] + [5.0] * 12 + [3.0] * 5)
    HANDICAP = np.array([1.0] * 12 + [1.3] * 12 + [1.0] * 5)  # factor on the score

    def __init__(self, q, gyro):
        self.K = len(self.INDEX) + len(self.JERK)
        self.gyro = np.array(gyro)
        self.q = [np.array(q, float) for _ in range(self.K)]
        self.w, self.d, self.n = (np.zeros((self.K, 3)) for _ in range(3))
        P = np.zeros((4, 4))  # angle, rate, acceleration, noise; the first sample's error is all of the attitude's
        P[0, 0], P[3, 3] = 1.0, 1.0
        P[0, 3] = P[3, 0] = -1.0
        self.P = [P.copy() for _ in self.INDEX]
        self.V = np.zeros((self.K, 3))
        p = np.exp(-self.DOUBT)
        self.p = np.tile((p / p.sum())[:, None], (1, 3))
        self.S = None
        self.N, self.noise, self.best = 0.0, 0.0, 0
        self.seen, self.rescued = 1, 0  # samples, lost members

    def advance(self, a, dt, tick, gap):
        steps = max(1, int(np.ceil(dt / tick - 1e-9)))
        h = dt / steps
        for i in range(self.K):
            for k in range(steps):
                f = np.asarray(a) + self.d[i]
                self.q[i], self.w[i] = midpoint(self.gyro, self.q[i], self.w[i], f, f, np.zeros(3), np.zeros(3), h)
                if k * h > gap:
                    self.d[i] = self.d[i] * np.exp(-h)

    def correct(self, q_meas, T, period):
        first = self.seen == 1
        r = np.zeros((self.K, 3))
        for i in range(self.K):
            e = (rotation(self.q[i]).inv() * rotation(q_meas)).as_rotvec()
            if i >= len(self.INDEX):
                found = np.array([third_order(-x, T, self.JERK[i - len(self.INDEX)]) for x in e])
                self.q[i] = quaternion(rotation(self.q[i]) * Rotation.from_rotvec(e + found[:, 0]), self.q[i])
                self.w[i] = self.w[i] - found[:, 1]
                self.d[i] = np.clip(self.d[i] - found[:, 2], -500.0, 500.0)
                r[i] = e
                continue
            if first:
                self.P[i][1, 1] = min(1e4, self.INDEX[i] / T**3) / T**2
                self.P[i][2, 2] = min(1e2, self.INDEX[i] / T) / T**4
            phi = 0.0 if self.TAUS[i] is None else np.exp(-T / self.TAUS[i])
            white = 0.0 if self.TAUS[i] is None else 0.01
            F = np.array([[1, T, T * T / 2, 0], [0, 1, T, 0], [0, 0, 1, 0], [0, 0, 0, phi]])
            Q = np.zeros((4, 4))
            Q[:3, :3] = [[T**5 / 20, T**4 / 8, T**3 / 6], [T**4 / 8, T**3 / 3, T**2 / 2], [T**3 / 6, T**2 / 2, T]]
            Q *= self.INDEX[i] / period**5
            Q[3, 3] = 1.0 - phi**2
            M = F @ self.P[i] @ F.T + Q
            H = np.array([1.0, 0.0, 0.0, 1.0])
            g = M @ H / (H @ M @ H + white)
            self.P[i] = M - np.outer(g, H @ M)
            self.n[i] = phi * self.n[i]
            r[i] = e - self.n[i]
            turn = Rotation.from_rotvec(g[0] * r[i])
            self.w[i] = turn.inv().apply(self.w[i] + g[1] * r[i])
            self.d[i] = np.clip(self.d[i] + g[2] * r[i], -500.0, 500.0)
            self.n[i] = self.n[i] + g[3] * r[i]
            self.q[i] = quaternion(rotation(self.q[i]) * turn, self.q[i])
        if self.seen >= 2 and 2.5 * period > T:
            self._judge(r)
        far = np.linalg.norm(r, axis=1)
        for i in np.flatnonzero((far > 0.2) & (far > 5.0 * far[self.best])):  # lost: goes on from the best
            self.q[i], self.w[i], self.d[i], self.n[i] = self.q[self.best], self.w[self.best], self.d[self.best], 0.0
            self.rescued += 1
        self.seen += 1

    def _judge(self, r):
        x = (self.p * r**2).sum(axis=0)
        self.N = 0.99 * self.N + 1.0
        if self.S is None:
            self.S = np.maximum(x, 1e-16)
        rate = np.maximum(np.where(x < self.S, 0.1, 0.01), 1.0 / max(self.seen - 1, 1))
        before = self.S.copy()
        self.S = np.maximum(self.S + rate * (x - self.S), 1e-16)
        self.V = 0.99 * self.V + r**2 / before
        score = (self.V + 1e-12) * self.HANDICAP[:, None]
        doubt = max(0.0, 1.0 - self.N / 30.0)
        p = (score / score.min(axis=0)) ** (-self.N / 4) * np.exp(-doubt * self.DOUBT)[:, None]
        self.p = p / p.sum(axis=0)
        self.best = int(np.argmin(np.log(score).sum(axis=1)))
        quiet = int(np.argmin(self.V[:12].sum(axis=1)))
        self.noise += (np.mean(r[quiet] ** 2) * (1.0 - self.P[quiet][0, 0]) - self.noise) / self.N

    def rates(self):
        return (self.p * self.w).sum(axis=0)
