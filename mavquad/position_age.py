"""How far an autopilot's velocity and position are behind its accelerometer, and what they would be now. Pure.

Some autopilots stamp LOCAL_POSITION_NED when they send it: it is 8 to 50 ms older than its stamp, constant within a boot, which at
12 m/s is up to 0.6 m that no controller can see. The accelerometer can: e = v - integral(R a + g e3) is -age times the acceleration, and
a drift. Both are washed out twice (a constant bias of the accelerometer makes a ramp) and regressed over two minutes. A vehicle that
does not accelerate tells nothing, and an age below 6 ms is none.
"""

import math
from typing import NamedTuple

from mavquad import linalg, quat
from mavquad.jit import kernel

Vec3 = tuple[float, float, float]

G_M_S2 = 9.80665
GAP_S = 0.1  # without an accelerometer: begin again
SMOOTH_S = 0.02  # of the acceleration
WASH_S = 1.5
MEMORY_S = 120.0
NOISE_M_S = 0.03  # of a velocity, one sigma
SPIKE_M_S = 0.7  # no age explains more
PRIOR_S = 0.03  # of the age
LEAST_S, MOST_S = 0.006, 0.15
SURE_S = 0.004  # an age told less surely than this is not used
SLEW = 0.02  # s per s: a correction comes without a jump


class Washed(NamedTuple):
    """Two cascaded washouts."""

    first: Vec3
    second: Vec3


class State(NamedTuple):
    imu_us: int  # of the newest accelerometer sample; 0: none
    raw_m_s2: Vec3  # its acceleration, NED
    a_ned_m_s2: Vec3  # smoothed
    v_ned_m_s: Vec3  # integrated from the first velocity on
    position_us: int  # of the newest velocity; 0: none
    e: Washed
    a: Washed
    aa: float
    ae: float
    age_s: float  # as corrected now


_ZERO3 = (0.0, 0.0, 0.0)
_STILL = Washed(_ZERO3, _ZERO3)
START = State(0, _ZERO3, _ZERO3, _ZERO3, 0, _STILL, _STILL, 0.0, 0.0, 0.0)


@kernel
def feel(state: State, t_us: int, accel_m_s2: Vec3, q_wxyz: tuple[float, float, float, float]) -> State:
    """An accelerometer's sample, body axes, turned by the newest attitude."""
    a = quat.rotate(q_wxyz, accel_m_s2)
    a = (a[0], a[1], a[2] + G_M_S2)
    dt_s = 1e-6 * (t_us - state.imu_us)
    if not math.isfinite(a[0] + a[1] + a[2]):
        return state
    if state.imu_us == 0 or not 0.0 < dt_s <= GAP_S:
        return State(t_us, a, a, state.v_ned_m_s, 0, _STILL, _STILL, state.aa, state.ae, state.age_s)
    smooth = linalg.axpy(1.0 - math.exp(-dt_s / SMOOTH_S), linalg.sub(a, state.a_ned_m_s2), state.a_ned_m_s2)
    v = linalg.axpy(0.5 * dt_s, linalg.add(a, state.raw_m_s2), state.v_ned_m_s)
    return State(t_us, a, smooth, v, state.position_us, state.e, state.a, state.aa, state.ae, state.age_s)


@kernel
def hear(state: State, t_us: int, v_ned_m_s: Vec3) -> State:
    """A velocity by its stamp: what it tells of its age."""
    if state.imu_us == 0 or not linalg.finite3(v_ned_m_s):
        return state
    raw, a = state.raw_m_s2, state.a_ned_m_s2
    dt_s = 1e-6 * (t_us - state.position_us)
    if state.position_us == 0 or not 0.0 < dt_s <= 1.0:
        moving = Washed(a, _ZERO3)
        return State(state.imu_us, raw, a, v_ned_m_s, t_us, _STILL, moving, state.aa, state.ae, state.age_s)
    felt = linalg.axpy(1e-6 * (t_us - state.imu_us), raw, state.v_ned_m_s)
    e, e_out = _wash(state.e, linalg.sub(v_ned_m_s, felt), dt_s)
    b, a_out = _wash(state.a, a, dt_s)
    aa, ae = state.aa, state.ae
    if linalg.norm(e_out) < SPIKE_M_S:
        keep = math.exp(-dt_s / MEMORY_S)
        aa, ae = keep * aa + linalg.dot(a_out, a_out), keep * ae + linalg.dot(a_out, e_out)
    ridge = (NOISE_M_S / PRIOR_S) ** 2
    found = -ae / (aa + ridge)
    sure = NOISE_M_S / math.sqrt(aa + ridge) < SURE_S
    wanted = min(found, MOST_S) if sure and found > LEAST_S else 0.0
    age = linalg.clip(wanted, state.age_s - SLEW * dt_s, state.age_s + SLEW * dt_s)
    return State(state.imu_us, raw, a, state.v_ned_m_s, t_us, e, b, aa, ae, age)


@kernel
def _wash(washed: Washed, x: Vec3, dt_s: float) -> tuple[Washed, Vec3]:
    k = 1.0 - math.exp(-dt_s / WASH_S)
    first = linalg.axpy(k, linalg.sub(x, washed.first), washed.first)
    rest = linalg.sub(x, first)
    second = linalg.axpy(k, linalg.sub(rest, washed.second), washed.second)
    return Washed(first, second), linalg.sub(rest, second)


@kernel
def carried(state: State, p_ned_m: Vec3, v_ned_m_s: Vec3) -> tuple[Vec3, Vec3]:
    """(p, v) at their stamp, from what was stamped too late."""
    h, a = state.age_s, state.a_ned_m_s2
    if h <= 0.0:
        return p_ned_m, v_ned_m_s
    return linalg.axpy(0.5 * h * h, a, linalg.axpy(h, v_ned_m_s, p_ned_m)), linalg.axpy(h, a, v_ned_m_s)
