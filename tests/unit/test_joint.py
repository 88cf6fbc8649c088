"""estimate/joint: why the filter must know the disturbance, and which one; the plain observer; the seam of the heading."""

import math

import numpy as np
import pytest

from mavquad.estimate import ekf, joint, leso

DT = 0.005
MODEL = ekf.EkfModel(9.8, 0.0, (0.005, 0.005, 0.0095), 0.0)


def gains(feed, sigma_p=0.01, q_velocity=0.3, use_ekf=True, feedforward=(0.0,) * 6):
    params = ekf.EkfParams(q_velocity=q_velocity, q_rate=1.0, sigma_position_m=sigma_p)
    observers = leso.LesoParams(w0_rad_s=(20.0,) * 6, dt_s=DT, feedforward=feedforward)
    return joint.JointGains(ekf.gains(params, MODEL), leso.gains(observers), use_ekf, feed)


def pushed(gains, seconds, push=1.0):
    """A hovering vehicle whose thrust is right and which is pushed down: (true height, estimate) over time, position measured."""
    state, z, v = joint.init(gains, (0.0,) * 12), 0.0, 0.0
    rows = []
    for _ in range(round(seconds / DT)):
        z, v = z + DT * v + 0.5 * DT * DT * push, v + DT * push
        row = [math.nan] * 12
        row[0], row[1], row[2] = 0.0, 0.0, z
        row[6] = row[7] = row[8] = 0.0
        known = joint.known_acceleration(MODEL, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, 9.8, (0.0,) * 3)
        state = joint.step(gains, state, 9.8, (0.0,) * 3, known, tuple(row), DT)
        rows.append((z, joint.read(gains, state, True)))
    return rows


def test_a_filter_that_does_not_know_the_disturbance_rests_with_a_bias_and_one_that_does_has_none():
    l2 = 0.3**0.5 / (0.01 * DT**0.5)  # its velocity gain: bandwidth squared, (q/(r dt))^(1/2)
    z, blind = pushed(gains(joint.J1), 3.0)[-1]
    assert blind.p_ned_m[2] - z == pytest.approx(-1.0 / l2, rel=0.1)
    z, told = pushed(gains(joint.J2), 3.0)[-1]
    assert abs(told.p_ned_m[2] - z) < 1e-6
    assert told.f_ned_m_s2[2] == pytest.approx(1.0, abs=1e-3)


def test_feeding_the_compensated_disturbance_to_a_slow_filter_runs_away():
    slow = {"sigma_p": 0.1, "q_velocity": 0.1, "feedforward": (1.0,) * 6}
    tame = [abs(e.f_ned_m_s2[2]) for _, e in pushed(gains(joint.J2, **slow), 8.0)]
    wild = [abs(e.f_ned_m_s2[2]) for _, e in pushed(gains(joint.J2C, **slow), 8.0)]
    assert max(tame[-200:]) < 1.2
    assert max(wild[-200:]) > 100.0


def test_without_the_filter_the_observers_take_the_raw_sample():
    g = gains(joint.J2, use_ekf=False)
    state = joint.init(g, (0.0,) * 12)
    row = [0.0] * 12
    row[2] = 1.0
    after = joint.step(g, state, 9.8, (0.0,) * 3, np.zeros(6), tuple(row), DT)
    assert after.leso.y[2] == 1.0
    np.testing.assert_array_equal(after.ekf.P, state.ekf.P)


@pytest.mark.parametrize("use_ekf", [True, False])
def test_the_heading_channel_runs_on_through_the_seam(use_ekf):
    g = gains(joint.J2, use_ekf=use_ekf)
    state = joint.init(g, (0.0,) * 12)
    for k in range(800):
        yaw = 0.005 * k  # 1 rad/s, past pi
        row = [0.0] * 12
        row[8], row[11] = ekf.wrap(yaw), 1.0
        state = joint.step(g, state, 9.8, (0.0,) * 3, np.zeros(6), tuple(row), DT)
    assert state.leso.z[5, 0] == pytest.approx(0.005 * 799, abs=0.02)
    assert state.leso.z[5, 1] == pytest.approx(1.0, abs=0.05)


def test_known_acceleration_is_gravity_less_thrust_along_the_body_and_drag():
    model = MODEL._replace(drag_1_s=0.2, rate_drag_nm_s=0.01)
    a = joint.known_acceleration(model, (0.0, 0.3, 0.0), (1.0, 2.0, 3.0), (0.1, 0.0, 0.0), 10.0, (0.02, 0.0, 0.0))
    expected = [-10 * math.sin(0.3) - 0.2, -0.4, 9.8 - 10 * math.cos(0.3) - 0.6, (0.02 - 0.001) / 0.005, 0.0, 0.0]
    np.testing.assert_allclose(a, expected, atol=1e-12)
