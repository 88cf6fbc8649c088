"""AUG18 of the IADRC note: one Kalman filter of 18 states, the six disturbances as random walks beside the twelve of `ekf`."""

import math
from typing import NamedTuple

import numpy as np

from mavquad import quat
from mavquad.estimate import ekf, joint
from mavquad.jit import kernel


class AugmentedGains(NamedTuple):
    ekf: ekf.EkfGains
    q_disturbance: float  # per second
    p0_disturbance: float


class AugmentedState(NamedTuple):
    ekf: ekf.EkfState  # its P is unused
    d: np.ndarray  # (6,) force over mass, torque over inertia
    P: np.ndarray  # (18,18) p v eta w d


@kernel
def init(gains: AugmentedGains, z: ekf.Row12) -> AugmentedState:
    """The state after the first measurement, no disturbance."""
    state = ekf.init(gains.ekf, z)
    P = np.zeros((18, 18))
    for i in range(12):
        P[i, i] = gains.ekf.noise[ekf.P0, i]
        if i < 6:
            P[12 + i, 12 + i] = gains.p0_disturbance
    return AugmentedState(state, np.zeros(6), P)


@kernel
def step(
    gains: AugmentedGains, state: AugmentedState, thrust_m_s2: float, torque_nm: ekf.Vec3, z: ekf.Row12, dt_s: float
) -> AugmentedState:
    """Predict over dt under the applied input and the present disturbance, then absorb z (NaN rows left out)."""
    model, s, d = gains.ekf, state.ekf, state.d
    u = (thrust_m_s2, torque_nm, (d[0], d[1], d[2]), (d[3], d[4], d[5]))
    A = np.zeros((18, 18))
    ekf.jacobian(model, thrust_m_s2, quat.to_euler(s.q_wxyz), s.omega_rad_s, A)
    for i in range(3):
        A[3 + i, 12 + i] = 1.0
        A[9 + i, 15 + i] = 1.0
    p, v, q, w = ekf.motion(model, u, s.p_ned_m, s.v_ned_m_s, s.q_wxyz, s.omega_rad_s, dt_s)
    P = ekf.spread(ekf.transition(A, dt_s), state.P)
    for i in range(12):
        P[i, i] += gains.ekf.noise[ekf.Q, i] * dt_s
    for i in range(12, 18):
        P[i, i] += gains.q_disturbance * dt_s
    eta = quat.to_euler(q)
    prior = p + v + eta + w
    dx, scratch = np.zeros(18), np.empty((2, 18))
    for i in range(12):
        residual = z[i] - prior[i]
        if 6 <= i < 9:
            residual = ekf.wrap(residual)
        if math.isfinite(residual):
            ekf.absorb(P, dx, i, residual, gains.ekf.noise[ekf.R, i], scratch)
    moved = ekf.EkfState(
        (p[0] + dx[0], p[1] + dx[1], p[2] + dx[2]),
        (v[0] + dx[3], v[1] + dx[4], v[2] + dx[5]),
        quat.from_euler(eta[0] + dx[6], eta[1] + dx[7], eta[2] + dx[8]),
        (w[0] + dx[9], w[1] + dx[10], w[2] + dx[11]),
        s.P,
        False,
    )
    after = np.empty(6)
    for i in range(6):
        after[i] = d[i] + dx[12 + i]
    return AugmentedState(moved, after, P)


@kernel
def read(state: AugmentedState) -> joint.JointEstimate:
    """The estimate for a control law."""
    s, d = state.ekf, state.d
    return joint.JointEstimate(
        s.p_ned_m, s.v_ned_m_s, quat.to_euler(s.q_wxyz), s.omega_rad_s, (d[0], d[1], d[2]), (d[3], d[4], d[5])
    )
