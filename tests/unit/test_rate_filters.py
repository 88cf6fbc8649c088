"""rate_filters.py, rate_baselines.py and mekf.py beside scipy, filterpy and plain formulas."""

import math

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy import signal

from mavquad import quat
from mavquad.estimate import mekf, rate_baselines, rate_filters

H = 0.01
T = np.arange(2000) * H


def test_butterworth_is_scipys_started_at_rest_on_the_first_value():
    x = np.stack([np.sin(3.0 * T) + 2.0, np.cos(40.0 * T), np.ones_like(T)], axis=1)
    sos = signal.butter(2, 5.0, fs=1.0 / H, output="sos")
    expected = np.stack([signal.sosfilt(sos, c, zi=signal.sosfilt_zi(sos) * c[0])[0] for c in x.T], axis=1)
    np.testing.assert_allclose(rate_filters.low_pass(x, 5.0, H), expected, atol=1e-12)


@pytest.mark.parametrize(("cutoff_hz", "delay_ms"), [(5.0, 44.6), (8.0, 27.5), (12.0, 17.9), (3.0, 74.8)])
def test_the_butterworth_delays_slow_motion_as_stated(cutoff_hz, delay_ms):
    ramp = T[:, None]
    assert 1e3 * (T[-1] - rate_filters.low_pass(ramp, cutoff_hz, H)[-1, 0]) == pytest.approx(delay_ms, abs=0.06)
    assert 1e3 * rate_filters.butterworth_delay_s(cutoff_hz, H) == pytest.approx(delay_ms, abs=0.06)


def test_zero_phase_does_not_move_a_slow_signal_and_squares_the_attenuation():
    slow, fast = np.sin(2.0 * T)[:, None], np.sin(2.0 * math.pi * 15.0 * T)[:, None]
    assert np.abs(rate_filters.zero_phase(slow, 5.0, H) - slow)[200:-200].max() < 2e-3
    once, twice = (np.abs(f(fast, 5.0, H))[500:-500].max() for f in (rate_filters.low_pass, rate_filters.zero_phase))
    assert twice == pytest.approx(once**2, rel=0.02)


def test_the_low_pass_is_scipys_at_rest_on_the_first_value():
    x = np.random.default_rng(2).standard_normal((40, 2))
    b, a = signal.butter(2, 5.0, fs=1.0 / H)
    rest = signal.lfilter_zi(b, a)[:, None] * x[0]
    wanted, _ = signal.lfilter(b, a, x, axis=0, zi=rest)
    np.testing.assert_allclose(rate_filters.low_pass(x, 5.0, H), wanted, atol=1e-12)


def test_zero_phase_goes_on_straight_at_both_ends():
    ramp = (3.0 + 2.0 * T)[:, None]
    np.testing.assert_allclose(rate_filters.zero_phase(ramp, 5.0, H), ramp, atol=0.05)
    assert rate_filters.zero_phase(ramp[:4], 5.0, H).shape == (4, 1)


def test_the_model_following_filter_takes_the_torque_of_its_own_half_tick():
    w = np.zeros((3, 3))
    a = np.arange(21.0).reshape(7, 3) ** 2
    found = rate_filters.follow_model_run((0.0, 0.0, 0.0), w, a, 1e-9, H)  # nothing of w is let in
    np.testing.assert_allclose(found, [[0.0] * 3, H * a[1], H * (a[1] + a[3])], atol=1e-9)


def test_the_model_following_filter_does_not_lag_where_the_torque_is_known():
    w = np.stack([np.sin(T), -np.cos(T), 0.0 * T], axis=1)
    half = 0.5 * H * np.arange(2 * len(T) + 1)
    a = np.stack([np.cos(half), np.sin(half), 0.0 * half], axis=1)
    noisy = w + 0.1 * np.random.default_rng(1).standard_normal(w.shape)
    error = rate_filters.follow_model_run((0.0, 0.0, 0.0), noisy, a, 2.0, H) - w
    assert np.sqrt((error[300:] ** 2).mean()) < 0.1 * math.sqrt(2.0 * math.pi * 2.0 * H / 2.0) * 1.1  # noise alone, no lag
    np.testing.assert_allclose(error[300:].mean(axis=0), 0.0, atol=0.01)


def test_differences_of_a_turn_that_speeds_up_evenly():
    t_us = np.arange(0, 400_000, 10_000)
    t = 1e-6 * t_us
    angle = 0.5 * 3.0 * t**2 + 0.7 * t
    q = np.stack([np.cos(0.5 * angle), np.sin(0.5 * angle), 0 * t, 0 * t], axis=1)
    true = 3.0 * t + 0.7
    plain, line, central = (
        f(t_us, q)[:, 0]
        for f in (
            rate_baselines.plain_difference,
            rate_baselines.extrapolated_difference,
            rate_baselines.central_difference,
        )
    )
    np.testing.assert_allclose(plain[1:], true[1:] - 3.0 * 0.005, atol=1e-9)
    np.testing.assert_allclose(line[2:], true[2:], atol=1e-9)
    np.testing.assert_allclose(central[1:-1], true[1:-1], atol=1e-9)


def test_about_one_axis_the_multiplicative_filter_is_a_linear_one():
    gains = mekf.Gains(0.3, 0.2, 0.01, 0.1, 1.0, 0.5, (0.0, 0.0, 0.0))
    dense = KalmanFilter(dim_x=3, dim_z=1)
    dense.F = np.array([[1, H, H * H / 2], [0, 1, H], [0, 0, 1]])
    dense.H = np.array([[1.0, 0.0, 0.0]])
    dense.R[:] = 0.01**2
    qa, qd = 0.3**2, 0.2**2
    dense.Q = np.array(
        [
            [qa * H**3 / 3, qa * H**2 / 2, 0],
            [qa * H**2 / 2, qa * H + qd * H**3 / 3, qd * H**2 / 2],
            [0, qd * H**2 / 2, qd * H],
        ]
    )
    dense.P = np.diag([0.1**2, 1.0, 0.5**2])
    state = mekf.init(gains, (1.0, 0.0, 0.0, 0.0), (0.2, 0.0, 0.0))
    dense.x = np.array([[0.0], [0.2], [0.0]])
    rng = np.random.default_rng(2)
    for k in range(100):
        angle = 0.3 * math.sin(0.05 * k) + 0.01 * rng.standard_normal()
        state = mekf.update(gains, state, quat.exp((angle, 0.0, 0.0)))
        dense.update(angle)
        np.testing.assert_allclose(
            [quat.log(state.q)[0], state.w[0], state.d[0]], dense.x[:, 0], atol=1e-5
        )  # the Cayley step: W (W h)^2/48 = 7e-6 rad/s at 1.5 rad/s
        np.testing.assert_allclose(state.p[0:7:3, 0:7:3], dense.P, rtol=1e-7, atol=1e-12)
        state = mekf.predict(gains, state, (0.1, 0.0, 0.0), (0.1, 0.0, 0.0), H)
        dense.predict()
        dense.x[:2, 0] += 0.1 * np.array([H * H / 2, H])


@pytest.mark.parametrize("scheme", [rate_baselines.EULER, rate_baselines.RK4, rate_baselines.ADDITIVE])
def test_the_traditional_observers_are_brought_back_to_unit_length(scheme):
    gains = rate_baselines.Gains(scheme, False, 4.0, 8.0, (0.1, -0.2, 0.1))
    state = rate_baselines.State((1.0, 0.0, 0.0, 0.0), (1.0, 2.0, -1.0), quat.exp((0.3, 0.1, -0.2)))
    for _ in range(50):
        state = rate_baselines.tick(gains, state, (0.1, 0.0, 0.2), (0.1, 0.0, 0.2), (0.1, 0.0, 0.2), H)
    assert quat.norm(state.q) == pytest.approx(1.0, abs=1e-15)
