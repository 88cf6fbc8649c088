"""How far an autopilot's velocity and position are behind its accelerometer, and what they would be now. Pure.

Some autopilots stamp LOCAL_POSITION_NED when they send it: it is 8 to 50 ms older than its stamp, constant within a boot, which at
12 m/s is up to 0.6 m that no controller can see. The accelerometer can: e = v - integral(R a + g e3) is -age times the acceleration, and
a drift. Both are washed out twice (a constant bias of the accelerometer makes a ramp) and regressed over two minutes. A vehicle that
does not accelerate tells nothing, and an age below 6 ms is none.
"""

import math

import numpy as np

from mavquad import flat, linalg, quat
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


RECORD = flat.record(
    [
        ("imu_us", "i8"),  # of the newest accelerometer sample; 0: none
        ("raw_m_s2", "f8", 3),  # its acceleration, NED
        ("a_ned_m_s2", "f8", 3),  # smoothed
        ("v_ned_m_s", "f8", 3),  # integrated from the first velocity on
        ("position_us", "i8"),  # of the newest velocity; 0: none
        ("e", "f8", (2, 3)),  # two cascaded washouts each
        ("a", "f8", (2, 3)),
        ("aa", "f8"),
        ("ae", "f8"),
        ("age_s", "f8"),  # as corrected now
    ]
)
START = np.zeros(1, RECORD).view(np.uint8)


def age_s(state: np.ndarray) -> float:
    """How much older than its stamp a position is taken to be now [s]."""
    return float(state.view(RECORD)["age_s"][0])


@kernel
def feel(state: np.ndarray, t_us: int, accel_m_s2: Vec3, q_wxyz: tuple[float, float, float, float]) -> np.ndarray:
    """An accelerometer's sample, body axes, turned by the newest attitude."""
    out = state.copy()
    feel_in(out.view(RECORD)[0], t_us, accel_m_s2, q_wxyz)
    return out


@kernel
def hear(state: np.ndarray, t_us: int, v_ned_m_s: Vec3) -> np.ndarray:
    """A velocity by its stamp: what it tells of its age."""
    out = state.copy()
    hear_in(out.view(RECORD)[0], t_us, v_ned_m_s)
    return out


@kernel
def carried(state: np.ndarray, p_ned_m: Vec3, v_ned_m_s: Vec3) -> tuple[Vec3, Vec3]:
    """(p, v) at their stamp, from what was stamped too late."""
    return carried_by(state.view(RECORD)[0], p_ned_m, v_ned_m_s)


# ---- on a record's item, in place ---------------------------------------------------------------------------------------
@kernel
def carried_by(s, p_ned_m, v_ned_m_s):
    """`carried` of an item."""
    h = s.age_s
    if h <= 0.0:
        return p_ned_m, v_ned_m_s
    a = flat.vec3(s.a_ned_m_s2)
    return linalg.axpy(0.5 * h * h, a, linalg.axpy(h, v_ned_m_s, p_ned_m)), linalg.axpy(h, a, v_ned_m_s)


@kernel
def feel_in(s, t_us, accel_m_s2, q_wxyz):
    """`feel` in place."""
    a = quat.rotate(q_wxyz, accel_m_s2)
    a = (a[0], a[1], a[2] + G_M_S2)
    dt_s = 1e-6 * (t_us - s.imu_us)
    if not math.isfinite(a[0] + a[1] + a[2]):
        return
    begun = s.imu_us != 0 and 0.0 < dt_s <= GAP_S
    s.imu_us = t_us
    if not begun:
        flat.put3(s.raw_m_s2, a)
        flat.put3(s.a_ned_m_s2, a)
        s.position_us = 0
        _still(s.e)
        _still(s.a)
        return
    before, smooth = flat.vec3(s.raw_m_s2), flat.vec3(s.a_ned_m_s2)
    flat.put3(s.a_ned_m_s2, linalg.axpy(1.0 - math.exp(-dt_s / SMOOTH_S), linalg.sub(a, smooth), smooth))
    flat.put3(s.v_ned_m_s, linalg.axpy(0.5 * dt_s, linalg.add(a, before), flat.vec3(s.v_ned_m_s)))
    flat.put3(s.raw_m_s2, a)


@kernel
def hear_in(s, t_us, v_ned_m_s):
    """`hear` in place."""
    if s.imu_us == 0 or not linalg.finite3(v_ned_m_s):
        return
    raw, a = flat.vec3(s.raw_m_s2), flat.vec3(s.a_ned_m_s2)
    dt_s = 1e-6 * (t_us - s.position_us)
    if s.position_us == 0 or not 0.0 < dt_s <= 1.0:
        flat.put3(s.v_ned_m_s, v_ned_m_s)
        s.position_us = t_us
        _still(s.e)
        flat.put3(s.a[0], a)
        flat.put3(s.a[1], (0.0, 0.0, 0.0))
        return
    felt = linalg.axpy(1e-6 * (t_us - s.imu_us), raw, flat.vec3(s.v_ned_m_s))
    e_out = _wash(s.e, linalg.sub(v_ned_m_s, felt), dt_s)
    a_out = _wash(s.a, a, dt_s)
    if linalg.norm(e_out) < SPIKE_M_S:
        keep = math.exp(-dt_s / MEMORY_S)
        s.aa, s.ae = keep * s.aa + linalg.dot(a_out, a_out), keep * s.ae + linalg.dot(a_out, e_out)
    ridge = (NOISE_M_S / PRIOR_S) ** 2
    found = -s.ae / (s.aa + ridge)
    sure = NOISE_M_S / math.sqrt(s.aa + ridge) < SURE_S
    wanted = min(found, MOST_S) if sure and found > LEAST_S else 0.0
    s.age_s = linalg.clip(wanted, s.age_s - SLEW * dt_s, s.age_s + SLEW * dt_s)
    s.position_us = t_us


@kernel
def _wash(washed, x, dt_s):
    """Through both washouts, which go on: what is left."""
    k = 1.0 - math.exp(-dt_s / WASH_S)
    first = linalg.axpy(k, linalg.sub(x, flat.vec3(washed[0])), flat.vec3(washed[0]))
    rest = linalg.sub(x, first)
    second = linalg.axpy(k, linalg.sub(rest, flat.vec3(washed[1])), flat.vec3(washed[1]))
    flat.put3(washed[0], first)
    flat.put3(washed[1], second)
    return linalg.sub(rest, second)


@kernel
def _still(washed):
    for i in range(2):
        flat.put3(washed[i], (0.0, 0.0, 0.0))
