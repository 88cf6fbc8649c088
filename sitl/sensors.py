"""What the autopilot knows: gyro, accelerometer, its AHRS and position, a motion capture; from truth, normals and constants.

The AHRS integrates the gyro (noise, bias and all) and is pulled to a slowly drifting reference at 0.5 per second; it learns the
gyro's bias. So its attitude is smooth and already contains the gyro. The motion capture is white and knows nothing of the gyro.
Position and velocity are the truth of `nav_delay` steps ago plus noise that is drawn anew at 50 Hz.
"""

import math

from mavquad.jit import kernel
from sitl import rotation
from sitl.plant import GRAVITY_M_S2
from sitl.rotation import apply_t

DRIFT_S = 20.0  # correlation time of the AHRS's reference
RING = 256  # steps remembered for delays
_PULL_1_S, _LEARN_1_S2 = 0.5, 0.05
_ACCEL_RANGE_M_S2 = 157.0  # 16 g
_MAG_N_GAUSS, _MAG_E_GAUSS, _MAG_D_GAUSS = 0.21, 0.013, 0.43

# columns of the block of normals
GYRO, ACCEL, DRIFT, POSITION, VELOCITY, MOCAP, AIR, COLUMNS = 0, 3, 6, 9, 12, 15, 18, 25


@kernel
def sense(s, c, n):
    """Sample every sensor at the vehicle's present instant; n (25,) normals of this step."""
    dt = c.dt_s
    R = rotation.matrix(s.R)
    felt = apply_t(R, (s.accel_ned_m_s2[0], s.accel_ned_m_s2[1], s.accel_ned_m_s2[2] - GRAVITY_M_S2))
    for i in range(3):
        s.gyro_rad_s[i] = s.omega_rad_s[i] + c.gyro_bias[i] + c.gyro_sigma * n[GYRO + i]
        measured = felt[i] + c.accel_bias[i] + c.accel_sigma * n[ACCEL + i]
        s.accel_m_s2[i] = min(_ACCEL_RANGE_M_S2, max(-_ACCEL_RANGE_M_S2, measured))
        s.drift_rad[i] = c.drift_keep * s.drift_rad[i] + c.drift_draw * n[DRIFT + i]
    _ahrs(s, c, R, dt)
    _remember(s, R)
    if s.step % c.nav_every == 0:
        for i in range(3):
            s.nav_noise[i] = c.position_sigma * n[POSITION + i]
            s.nav_noise[3 + i] = c.velocity_sigma * n[VELOCITY + i]
    then = max(0, s.step - c.nav_delay) % RING
    for i in range(3):
        s.nav_p_ned_m[i] = s.past[then, i] + c.position_bias[i] + s.nav_noise[i]
        s.nav_v_ned_m_s[i] = s.past[then, 3 + i] + c.velocity_bias[i] + s.nav_noise[3 + i]
    field = apply_t(R, (_MAG_N_GAUSS, _MAG_E_GAUSS, _MAG_D_GAUSS))
    for i in range(3):
        s.magnetometer_gauss[i] = field[i]
    altitude = c.altitude_m - s.nav_p_ned_m[2]
    s.barometer[0] = 1013.25 * math.exp(5.255 * math.log(1.0 - altitude / 44330.77))  # the standard atmosphere
    s.barometer[2] = altitude
    if s.step % c.mocap_every == 0:
        _mocap(s, c, n)


@kernel
def _ahrs(s, c, R, dt):
    A = rotation.matrix(s.ahrs_R)
    reference = rotation.mul(R, rotation.exp((s.drift_rad[0], s.drift_rad[1], s.drift_rad[2])))
    E = rotation.mul_t(A, reference)
    e = (0.5 * (E[7] - E[5]), 0.5 * (E[2] - E[6]), 0.5 * (E[3] - E[1]))
    turn = (
        dt * (s.gyro_rad_s[0] - s.gyro_bias_rad_s[0] + _PULL_1_S * e[0]),
        dt * (s.gyro_rad_s[1] - s.gyro_bias_rad_s[1] + _PULL_1_S * e[1]),
        dt * (s.gyro_rad_s[2] - s.gyro_bias_rad_s[2] + _PULL_1_S * e[2]),
    )
    A = rotation.orthonormal(rotation.mul(A, rotation.exp(turn)))
    q = rotation.to_quaternion(A)
    sign = 1.0  # a stream of quaternions does not jump from q to -q
    if q[0] * s.ahrs_q_wxyz[0] + q[1] * s.ahrs_q_wxyz[1] + q[2] * s.ahrs_q_wxyz[2] + q[3] * s.ahrs_q_wxyz[3] < 0.0:
        sign = -1.0
    euler = rotation.to_euler(A)
    for i in range(9):
        s.ahrs_R[i] = A[i]
    for i in range(4):
        s.ahrs_q_wxyz[i] = sign * q[i]
    for i in range(3):
        s.ahrs_euler_rad[i] = euler[i]
        s.gyro_bias_rad_s[i] -= dt * _LEARN_1_S2 * e[i]
        # two-pole low-pass of the gyro, its slope kept for the rate loop
        s.rates_slope[i] += (
            c.filter_b * (s.gyro_rad_s[i] - s.gyro_bias_rad_s[i] - s.rates_rad_s[i]) - c.filter_a * s.rates_slope[i]
        )
        s.rates_rad_s[i] += dt * s.rates_slope[i]


@kernel
def _remember(s, R):
    now = s.step % RING
    for i in range(3):
        s.past[now, i] = s.p_ned_m[i]
        s.past[now, 3 + i] = s.v_ned_m_s[i]
    for i in range(9):
        s.past_R[now, i] = R[i]


@kernel
def _mocap(s, c, n):
    then = max(0, s.step - c.mocap_delay) % RING
    R = rotation.matrix(s.past_R[then])
    error = (c.mocap_sigma * n[MOCAP], c.mocap_sigma * n[MOCAP + 1], c.mocap_sigma * n[MOCAP + 2])
    q = rotation.to_quaternion(rotation.mul(R, rotation.exp(error)))
    for i in range(4):
        s.mocap_q_wxyz[i] = q[i]
    for i in range(3):
        s.mocap_p_ned_m[i] = s.past[then, i]
