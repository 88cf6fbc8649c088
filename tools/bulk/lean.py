"""The simulated autopilot's sensors as far as a flight in bulk hears them: gyro, AHRS, position; equal to `sitl.sensors.sense` bit for bit.

Left out, because nothing here reads them: accelerometer, magnetometer, barometer, motion capture, Euler angles; the quaternion is
made where it is sent (`sitl.sensors` makes it each step; two samples of it are near enough for the same sign).
"""

from mavquad.jit import kernel
from sitl import rotation, sensors
from tools.bulk import normals, state


@kernel
def draw(s, c, noise):
    """The normals of one step, each from its sensor's own generator and in the simulated autopilot's order; those that this step
    does not read are passed over."""
    normals.draw(noise, state.GYRO, sensors.GYRO, 3)
    normals.draw(noise, state.DRIFT, sensors.DRIFT, 3)
    if (s.step + 1) % c.nav_every == 0:  # sensors sample after the plant's step
        normals.draw(noise, state.POSITION, sensors.POSITION, 6)
    else:
        normals.skip(noise, state.POSITION, 6)
    if c.turbulent:
        if s.step % c.air_every == 0:
            normals.draw(noise, state.AIR, sensors.AIR, 7)
        else:
            normals.skip(noise, state.AIR, 7)


@kernel
def sense(s, c, n):
    """Sample at the vehicle's present instant; n (25,) normals of this step."""
    dt = c.dt_s
    R = rotation.matrix(s.R)
    for i in range(3):
        s.gyro_rad_s[i] = s.omega_rad_s[i] + c.gyro_bias[i] + c.gyro_sigma * n[sensors.GYRO + i]
        s.drift_rad[i] = c.drift_keep * s.drift_rad[i] + c.drift_draw * n[sensors.DRIFT + i]
    A = rotation.matrix(s.ahrs_R)
    reference = rotation.mul(R, rotation.exp((s.drift_rad[0], s.drift_rad[1], s.drift_rad[2])))
    E = rotation.mul_t(A, reference)
    e = (0.5 * (E[7] - E[5]), 0.5 * (E[2] - E[6]), 0.5 * (E[3] - E[1]))
    turn = (
        dt * (s.gyro_rad_s[0] - s.gyro_bias_rad_s[0] + sensors._PULL_1_S * e[0]),
        dt * (s.gyro_rad_s[1] - s.gyro_bias_rad_s[1] + sensors._PULL_1_S * e[1]),
        dt * (s.gyro_rad_s[2] - s.gyro_bias_rad_s[2] + sensors._PULL_1_S * e[2]),
    )
    A = rotation.orthonormal(rotation.mul(A, rotation.exp(turn)))
    for i in range(9):
        s.ahrs_R[i] = A[i]
    for i in range(3):
        s.gyro_bias_rad_s[i] -= dt * sensors._LEARN_1_S2 * e[i]
        s.rates_slope[i] += (
            c.filter_b * (s.gyro_rad_s[i] - s.gyro_bias_rad_s[i] - s.rates_rad_s[i]) - c.filter_a * s.rates_slope[i]
        )
        s.rates_rad_s[i] += dt * s.rates_slope[i]
    now = s.step % sensors.RING
    for i in range(3):
        s.past[now, i] = s.p_ned_m[i]
        s.past[now, 3 + i] = s.v_ned_m_s[i]
    if s.step % c.nav_every == 0:
        for i in range(3):
            s.nav_noise[i] = c.position_sigma * n[sensors.POSITION + i]
            s.nav_noise[3 + i] = c.velocity_sigma * n[sensors.VELOCITY + i]
    then = max(0, s.step - c.nav_delay) % sensors.RING
    for i in range(3):
        s.nav_p_ned_m[i] = s.past[then, i] + c.position_bias[i] + s.nav_noise[i]
        s.nav_v_ned_m_s[i] = s.past[then, 3 + i] + c.velocity_bias[i] + s.nav_noise[3 + i]


@kernel
def quaternion(s):
    """The AHRS's quaternion, on the side of the last one: a stream of them does not jump from q to -q."""
    q = rotation.to_quaternion(rotation.matrix(s.ahrs_R))
    sign = 1.0
    if q[0] * s.ahrs_q_wxyz[0] + q[1] * s.ahrs_q_wxyz[1] + q[2] * s.ahrs_q_wxyz[2] + q[3] * s.ahrs_q_wxyz[3] < 0.0:
        sign = -1.0
    for i in range(4):
        s.ahrs_q_wxyz[i] = sign * q[i]
