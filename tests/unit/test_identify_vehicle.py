"""Hover thrust, drag, gyro filter, torque and noise from made-up flights whose truth is known."""

import numpy as np
import pytest
from scipy import signal

from mavquad.errors import LogError
from mavquad.identify import noise, vehicle
from mavquad.identify.vehicle import Motion

G = 9.80665
DT_S = 0.02


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def rotation(euler):
    cr, cp, cy = np.cos(euler)
    sr, sp, sy = np.sin(euler)
    return np.array(
        [
            [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
            [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
            [-sp, sr * cp, cr * cp],
        ]
    )


def flight(rng, *, linear=0.26, quadratic=0.025, hover=0.37, over_cosine=True, wind=(1.5, -0.7), seconds=120.0):
    """A slow figure of eight in a steady wind with hovers at both ends; forces by rotation matrices."""
    t = np.arange(0.0, seconds, DT_S)
    on = np.clip((t - 20.0) / 5.0, 0.0, 1.0) * np.clip((seconds - 20.0 - t) / 5.0, 0.0, 1.0)
    euler = np.column_stack([0.25 * on * np.sin(0.5 * t), 0.2 * on * np.sin(0.31 * t), 0.4 + 0.3 * on * np.sin(0.1 * t)])
    v = np.column_stack([4.0 * on * np.sin(0.31 * t + 1.0), 4.0 * on * np.cos(0.5 * t), 0.2 * on * np.sin(0.2 * t)])
    accel = np.empty((t.size, 3))
    thrust = np.empty(t.size)
    for k in range(t.size):
        r = rotation(euler[k])
        lift = G * (1.0 + 0.08 * on[k] * np.sin(0.7 * t[k]))
        air = r.T @ (v[k] - np.array([*wind, 0.0]))
        fastness = np.linalg.norm(v[k])
        accel[k] = -(linear + quadratic * fastness) * air
        accel[k, 2] = -lift
        thrust[k] = hover * lift / G * (np.cos(euler[k, 0]) * np.cos(euler[k, 1]) if over_cosine else 1.0)
    accel += 0.05 * rng.standard_normal(accel.shape)
    return Motion(DT_S, t, euler, accel, np.zeros_like(accel), v, thrust, np.ones(t.size, bool))


@pytest.mark.parametrize("over_cosine", [True, False])
def test_hover_thrust_and_gain_come_back_and_the_cosine_is_told(rng, over_cosine):
    found = vehicle.hover(flight(rng, over_cosine=over_cosine))
    assert found.hover.value == pytest.approx(0.37, abs=5e-4)
    assert found.gain_m_s2.value == pytest.approx(G / 0.37, rel=2e-3)
    assert found.over_cosine == over_cosine
    assert 0.0 < found.hover.sd < 0.005


def test_drag_comes_back_although_a_wind_blows(rng):
    found = vehicle.drag(flight(rng, wind=(0.4, -0.2)))
    for linear, quadratic in zip(found.linear_1_s, found.quadratic_1_m, strict=True):
        assert linear.value == pytest.approx(0.26, abs=max(0.03, 4.0 * linear.sd))
        assert quadratic.value == pytest.approx(0.025, abs=max(0.01, 4.0 * quadratic.sd))


def test_a_flight_too_slow_or_without_a_sensor_says_so(rng):
    slow = flight(rng)
    with pytest.raises(LogError, match="never went faster"):
        vehicle.drag(slow._replace(v_ned_m_s=0.2 * slow.v_ned_m_s))
    with pytest.raises(LogError, match="LOCAL_POSITION_NED"):
        vehicle.drag(slow._replace(v_ned_m_s=np.full_like(slow.v_ned_m_s, np.nan)))
    with pytest.raises(LogError, match="HIGHRES_IMU"):
        vehicle.hover(slow._replace(accel_m_s2=np.full_like(slow.accel_m_s2, np.nan)))
    with pytest.raises(LogError, match="steady hover"):
        vehicle.hover(slow._replace(accel_m_s2=1.2 * slow.accel_m_s2))


def test_the_filter_of_the_gyro_is_found_from_the_attitude_beside_it(rng):
    h, dt = 1e-3, 0.01  # the filter runs in the autopilot, ten times as fast as what is sent
    t = np.arange(0.0, 70.0, h)
    phase = 2.0 * np.pi * np.cumsum(np.geomspace(0.2, 6.0, t.size)) * h
    angle = 0.1 * np.sin(phase)
    b, a = signal.butter(2, 20.0, fs=1000.0)
    sent = signal.lfilter(b, a, np.gradient(angle, h))[::10]
    angle = angle[::10]
    sent = sent + 1e-4 * rng.standard_normal(sent.size)
    found, _ = vehicle.gyro_filter(dt, angle, sent)
    assert found.cutoff_hz.value == pytest.approx(20.0, rel=0.03)
    assert found.lag_s == pytest.approx(np.sqrt(2.0) / (2.0 * np.pi * 20.0), rel=0.03)


def turning(rng, pattern, gain=700.0, lag=0.03):
    t = np.arange(0.0, 60.0, 0.01)
    u = 0.01 * signal.lfilter([0.1], [1.0, -0.9], rng.standard_normal(t.size))
    motors = 0.55 + np.outer(u, pattern) + 0.02 * np.sin(0.3 * t)[:, None] + 1e-5 * rng.standard_normal((t.size, 4))
    gyro = np.cumsum(gain * np.interp(t - lag, t, u)) * 0.01
    return t, gyro, t[::2], motors[::2]


@pytest.mark.parametrize("pattern", [(-1.0, 1.0, 1.0, -1.0), (0.0, 0.0, 1.0, -1.0)])
def test_torque_per_command_finds_which_motors_turn_the_axis(rng, pattern):
    found = vehicle.torque(*turning(rng, pattern))
    assert tuple(np.sign(found.pattern)) == pattern
    assert found.gain_rad_s2.value == pytest.approx(700.0, rel=0.08)
    assert found.lag_s == pytest.approx(0.03, abs=0.011)


def test_motors_that_explain_nothing_are_refused(rng):
    t, _, t_motor, motors = turning(rng, (-1.0, 1.0, 1.0, -1.0))
    with pytest.raises(LogError, match="not excited"):
        vehicle.torque(t, np.cumsum(rng.standard_normal(t.size)), t_motor, motors)


def test_noise_is_told_from_motion(rng):
    t = np.arange(0.0, 60.0, 0.01)
    found = noise.noise(t, np.sin(2.0 * t) + 0.01 * rng.standard_normal(t.size))
    assert found.white == pytest.approx(0.01, rel=0.1)
    assert found.slow == pytest.approx(0.01, rel=0.2)
    coarse = noise.noise(t, np.round((np.sin(2.0 * t) + 0.01 * rng.standard_normal(t.size)) / 0.005) * 0.005)
    assert coarse.step == pytest.approx(0.005)
    with pytest.raises(LogError, match="too few"):
        noise.noise(t[:20], t[:20])


def test_the_spread_by_leaving_out_is_that_of_independent_samples(rng):
    x = rng.standard_normal(4000)
    found = vehicle.jackknife(lambda use: float(np.mean(x[use])), np.ones(4000, bool), 0.01)
    assert found.sd == pytest.approx(1.0 / np.sqrt(4000), rel=0.6)
    assert found.seconds == 40.0
