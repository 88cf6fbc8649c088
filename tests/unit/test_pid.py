"""pd and pid on a point mass behind a second-order attitude response."""

import math

import numpy as np
import pytest

from mavquad import airframe
from mavquad.control import pd, pid
from mavquad.errors import ConfigError
from mavquad.signals import NAN3, ZERO3, Demand, Estimate

FRAME = airframe.load("x500")


def fly(module, disturbance, seconds=20.0, limit=1e9, reference=(1.0, 0.0, -1.0)):
    """Position error at the end and the largest overshoot, with the airframe's own attitude lag between command and acceleration."""
    gains = module.gains(module.Params(), FRAME)
    state = module.init(gains)
    wn, zeta, dt = FRAME.attitude.natural_frequency_rad_s, FRAME.attitude.damping, 0.008
    p, v, a, adot = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    overshoot = 0.0
    for k in range(round(seconds / dt)):
        estimate = Estimate(k, tuple(p), tuple(v), (1.0, 0.0, 0.0, 0.0), ZERO3, NAN3, NAN3)
        demand = Demand(k, reference, ZERO3, ZERO3, ZERO3, 0.0, 0.0)
        state, command = module.step(gains, state, estimate, demand, None, dt)
        wanted = np.clip(np.array(command.a_ned_m_s2), -limit, limit)
        adot += dt * (wn * wn * (wanted - a) - 2 * zeta * wn * adot)
        a = a + dt * adot
        v = v + dt * (a + disturbance)
        p = p + dt * v
        overshoot = max(overshoot, p[0] - 1.0)
    return np.array(reference) - p, overshoot, state


def test_pid_reaches_its_point_against_a_constant_force_and_pd_rests_short_of_it():
    push = np.array([1.0, -0.5, 0.8])
    error, _, state = fly(pid, push)
    np.testing.assert_allclose(error, 0.0, atol=1e-3)
    np.testing.assert_allclose(state.integral_m_s2, -push, atol=1e-2)
    error, _, _ = fly(pd, push)
    gains = pd.gains(pd.Params(), FRAME)
    np.testing.assert_allclose(error, -push / gains.kp, rtol=1e-3)


def test_a_step_is_damped_behind_the_attitude_lag():
    assert fly(pd, np.zeros(3))[1] < 0.1
    assert fly(pid, np.zeros(3))[1] < 0.40  # the price of an integral that fights gusts; paths have no steps


def test_the_integral_does_not_wind_up_while_the_demand_is_cut():
    far = (60.0, 0.0, 0.0)
    error, overshoot, state = fly(pid, np.zeros(3), seconds=40.0, limit=6.0, reference=far)
    _, without_integral, _ = fly(pd, np.zeros(3), seconds=40.0, limit=6.0, reference=far)
    assert abs(error[0]) < 0.1
    assert overshoot < 1.1 * without_integral + 0.4  # braking with 6 m/s^2 from 60 m overshoots by itself
    assert abs(state.integral_m_s2[0]) < 0.1


def test_what_the_integral_cancels_is_said_so_that_nobody_cancels_it_again():
    gains = pid.gains(pid.Params(), FRAME)
    estimate = Estimate(0, ZERO3, ZERO3, (1.0, 0.0, 0.0, 0.0), ZERO3, NAN3, NAN3)
    demand = Demand(0, (1.0, 2.0, 3.0), ZERO3, ZERO3, ZERO3, 0.0, 0.0)
    state, command = pid.step(gains, pid.State((0.1, 0.2, 0.3)), estimate, demand, None, 0.01)
    assert command.f_cancelled_m_s2 == tuple(-x for x in state.integral_m_s2)


def test_drag_along_the_path_is_fed_forward():
    gains = pd.gains(pd.Params(), FRAME)
    estimate = Estimate(0, ZERO3, (2.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), ZERO3, NAN3, NAN3)
    demand = Demand(0, ZERO3, (2.0, 0.0, 0.0), ZERO3, ZERO3, 0.0, 0.0)
    _, command = pd.step(gains, pd.init(gains), estimate, demand, None, 0.01)
    assert command.a_ned_m_s2[0] == pytest.approx((0.5 * 2.0 + 0.03 * 2.0 * 2.0) / 2.0)


def test_an_integral_at_the_edge_of_stability_is_refused():
    with pytest.raises(ConfigError, match="edge of stability"):
        pid.Params(integral=1.0)


def test_the_drag_fed_forward_counts_as_cancelled_at_the_present_speed():
    gains = pid.gains(pid.Params(), FRAME)
    moving = Estimate(0, ZERO3, (4.0, -3.0, 0.0), (1.0, 0.0, 0.0, 0.0), ZERO3, NAN3, NAN3)
    demand = Demand(0, ZERO3, (4.0, -3.0, 0.0), ZERO3, ZERO3, 0.0, 0.0)
    _, command = pid.step(gains, pid.init(gains), moving, demand, None, 0.008)
    np.testing.assert_allclose(np.array(command.a_ned_m_s2) + command.f_cancelled_m_s2, 0.0, atol=1e-12)
    per_speed = (FRAME.drag.linear_n_s_m[0] + 5.0 * FRAME.drag.quadratic_n_s2_m2[0]) / FRAME.body.mass_kg
    np.testing.assert_allclose(command.f_cancelled_m_s2[0], -4.0 * per_speed)


def test_behind_a_compensator_the_integral_stands_for_what_is_cancelled_and_does_not_wind_up():
    gains = pid.gains(pid.Params(), FRAME)
    state = pid.init(gains)
    v = (4.0, 0.0, 0.0)
    estimate = Estimate(0, (-1.0, 0.0, 0.0), v, (1.0, 0.0, 0.0, 0.0), ZERO3, NAN3, NAN3)
    demand = Demand(0, ZERO3, v, ZERO3, ZERO3, 0.0, 0.0)
    for _ in range(3000):
        state, _ = pid.step(gains, state, estimate, demand, None, 0.008)
        state = pid.track(gains, state, estimate, (-1.5, 0.4, -0.2))
    drag = pid.drag_at(gains, v)
    assert state.integral_m_s2 == pytest.approx((1.5 - drag[0], -0.4, 0.2))
    assert pid.track(gains, state, estimate, (math.nan, 0.0, 0.0)) == state
    assert pid.track(pd.gains(pd.Params(), FRAME), pid.init(gains), estimate, (9.0, 0.0, 0.0)) == pid.init(gains)
