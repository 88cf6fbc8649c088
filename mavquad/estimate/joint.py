"""Joint observer: extended Kalman filter, then a linear extended state observer per channel, each knowing of the other.

Source: Xiao & Tong 2023, Fig. 1 and Eqs. (22)-(30). Six channels: x, y, z (NED), roll, pitch, yaw. The observers take the
filter's position and angles as their measurement, and the filter takes their plain disturbance as an input (form J2).

Deviations from the paper:
  Fig. 1  the filter knows the disturbance: without it (J1) it rests with a bias that the loop follows; fed with the
          compensated one instead of the plain one (J2C) the pair is unstable unless the filter is much the faster.
  -       without the filter (use_ekf False) this is the plain ADRC observer on raw position and angles.
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad import quat
from mavquad.estimate import ekf, leso
from mavquad.jit import kernel

Vec3 = tuple[float, float, float]

J1, J2, J2C = 0, 1, 2  # the filter is fed nothing, the plain z3, the compensated z3


class JointGains(NamedTuple):
    ekf: ekf.EkfGains
    leso: leso.LesoGains
    use_ekf: bool
    feed: int


class JointState(NamedTuple):
    ekf: ekf.EkfState
    leso: leso.LesoState


class JointEstimate(NamedTuple):
    """What a control law may use. Rates of the observers are Euler rates."""

    p_ned_m: Vec3
    v_ned_m_s: Vec3
    eta_rad: Vec3
    omega_rad_s: Vec3
    f_ned_m_s2: Vec3
    tau_rad_s2: Vec3


@kernel
def _channels(gains: JointGains, state: ekf.EkfState, z: ekf.Row12, before: np.ndarray) -> np.ndarray:
    """What the observers measure: from the filter or raw; angles continued from `before` past +-pi."""
    out = np.empty(6)
    eta = quat.to_euler(state.q_wxyz)
    for i in range(3):
        out[i] = state.p_ned_m[i] if gains.use_ekf else z[i]
        angle = eta[i] if gains.use_ekf else z[6 + i]
        out[3 + i] = before[3 + i] + ekf.wrap(angle - before[3 + i])
    return out


@kernel
def init(gains: JointGains, z: ekf.Row12) -> JointState:
    """The state at the first measurement z = (p, v, eta, w), NaN where unmeasured."""
    state = ekf.init(gains.ekf, z)
    return JointState(state, leso.init(_channels(gains, state, z, np.zeros(6))))


@kernel
def known_acceleration(model: ekf.Vehicle, eta: Vec3, v: Vec3, w: Vec3, thrust_m_s2: float, torque_nm: Vec3) -> np.ndarray:
    """u + f of the six channels (6,): gravity, drag and applied thrust; applied torque and gyroscopic terms."""
    sf, cf = math.sin(eta[0]), math.cos(eta[0])
    st, ct = math.sin(eta[1]), math.cos(eta[1])
    sp, cp = math.sin(eta[2]), math.cos(eta[2])
    turning = ekf.angular_acceleration(model, torque_nm, w)
    out = np.empty(6)
    out[0] = -thrust_m_s2 * (cp * st * cf + sp * sf) - model.drag_1_s * v[0]
    out[1] = -thrust_m_s2 * (sp * st * cf - cp * sf) - model.drag_1_s * v[1]
    out[2] = -thrust_m_s2 * cf * ct + model.gravity_m_s2 - model.drag_1_s * v[2]
    for i in range(3):
        out[3 + i] = turning[i]
    return out


@kernel
def step(
    gains: JointGains, state: JointState, thrust_m_s2: float, torque_nm: Vec3, known: np.ndarray, z: ekf.Row12, dt_s: float
) -> JointState:
    """One sample. Thrust/m, torque and `known` (6,) are what acted over the dt_s before z (delayed as z is)."""
    filtered = state.ekf
    if gains.use_ekf:
        if gains.feed == J2:
            d = state.leso.z[:, 2]
        elif gains.feed == J2C:
            d = leso.compensated(gains.leso, state.leso)[:, 2]
        else:
            d = np.zeros(6)
        u = (thrust_m_s2, torque_nm, (d[0], d[1], d[2]), (d[3], d[4], d[5]))
        filtered = ekf.step(gains.ekf, state.ekf, u, z, dt_s)
    y = _channels(gains, filtered, z, state.leso.y)
    return JointState(filtered, leso.step(gains.leso, state.leso, y, known))


@kernel
def read(gains: JointGains, state: JointState, states_from_ekf: bool) -> JointEstimate:
    """The estimate for a control law: disturbance with feed-forward; the states of the filter, or the observers' plain ones."""
    zc = leso.compensated(gains.leso, state.leso)
    f, tau = (zc[0, 2], zc[1, 2], zc[2, 2]), (zc[3, 2], zc[4, 2], zc[5, 2])
    if states_from_ekf:
        s = state.ekf
        return JointEstimate(s.p_ned_m, s.v_ned_m_s, quat.to_euler(s.q_wxyz), s.omega_rad_s, f, tau)
    z = state.leso.z
    return JointEstimate(
        (z[0, 0], z[1, 0], z[2, 0]),
        (z[0, 1], z[1, 1], z[2, 1]),
        (z[3, 0], z[4, 0], z[5, 0]),
        (z[3, 1], z[4, 1], z[5, 1]),
        f,
        tau,
    )
