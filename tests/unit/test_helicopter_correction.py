"""The helicopter's model error and its two corrections against plain numpy."""

import math

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st

from mavquad.compensate import helicopter, matching
from mavquad.errors import ConfigError
from mavquad.estimate import augment, heli_error
from mavquad.identify import models

REF = models.ref_13()
GAINS = helicopter.gains(helicopter.Params(), REF.a, REF.b, REF.states)
FILTER = heli_error.gains(heli_error.Params(), REF.a, REF.b, REF.states)


def test_static_gains_are_those_of_the_residualised_model():
    expected = [[-22.03, 4.77, 0, 0], [6.32, 55.40, 0, 0], [0, 0, 33.1, -3.33], [0, 0, 0, -13.96]]
    np.testing.assert_allclose(helicopter.static_gain(REF.a, REF.b), expected, atol=0.005)
    assert GAINS.pedal_s == pytest.approx((4.13 + 33.1 * 2.16 / 8.26) / 33.1)


@given(seed=st.integers(0, 1000))
def test_the_target_solves_the_eleven_rows(seed):
    rng = np.random.default_rng(seed)
    f, x_now = rng.normal(size=6), np.zeros(19)
    x_now[2], x_now[7] = rng.uniform(-0.3, 0.3, 2)
    turn, v, a = rng.uniform(-0.5, 0.5), tuple(rng.uniform(-8, 8, 3)), tuple(rng.uniform(-2, 2, 3))
    memory = helicopter.Target(f, (0.0, 0.0, 0.0))  # as if f had stood there for long
    _, x, u = helicopter.target(GAINS, memory, x_now, f, v, a, turn)
    theta, phi = x_now[2], x_now[7]
    body = np.array([[1, 0, 0], [0, math.cos(phi), math.sin(phi)], [0, -math.sin(phi), math.cos(phi)]]) @ np.array(
        [[math.cos(theta), 0, -math.sin(theta)], [0, 1, 0], [math.sin(theta), 0, math.cos(theta)]]
    )
    np.testing.assert_allclose(x[[0, 5, 10]], body @ v, atol=1e-12)
    rate = REF.a @ x + REF.b @ u
    rate[[0, 1, 5, 6, 10, 11]] += f
    gravity = 9.80665 * np.array(
        [theta - math.sin(theta), math.cos(theta) * math.sin(phi) - phi, math.cos(theta) * math.cos(phi) - 1.0]
    )
    np.testing.assert_allclose(rate[[0, 5, 10]] + gravity, body @ a, atol=1e-9)  # u' + q w - r v, ... of the path
    np.testing.assert_allclose(rate[[1, 3, 4, 6, 8, 9, 11, 12]], 0.0, atol=1e-9)


def test_the_paper_s_correction_tilts_against_surge_and_sway_and_balances_the_rest():
    f = np.array([0.5, 1.0, -0.4, -2.0, 0.8, 0.3])
    filtered = np.zeros(6)
    for _ in range(500):
        filtered = helicopter.paper_correction(GAINS, filtered, np.zeros(13), f, np.zeros(13))
    np.testing.assert_allclose(filtered[:2], [0.5 / 9.80665, 0.4 / 9.80665], rtol=1e-6)
    left = helicopter.static_gain(REF.a, REF.b) @ filtered[2:] + f[[1, 3, 5, 4]]
    np.testing.assert_allclose(left, 0.0, atol=1e-6)


def test_the_integral_and_the_position_error_are_bounded():
    memory, x = helicopter.init_target(), np.zeros(19)
    for _ in range(5000):
        memory, near = helicopter.target_sticks(GAINS, memory, x[:13], x[:13], np.zeros(4), (4.0, 0.0, 0.0), 0.0)
    assert memory.integral_m == (1.5, 0.0, 0.0)
    _, far = helicopter.target_sticks(GAINS, memory, x[:13], x[:13], np.zeros(4), (400.0, 0.0, 0.0), 0.0)
    np.testing.assert_allclose(near, far)


def test_known_terms_are_the_rigid_body_beyond_its_linear_part():
    x = np.random.default_rng(1).uniform(-0.4, 0.4, 19)
    u, q, theta, _, _, v, p, phi, _, _, w, r, _ = x[:13]
    g = 9.80665
    k = heli_error.known_terms(x)
    expected = np.zeros(13)
    expected[[0, 5, 10]] = -np.cross([p, q, r], [u, v, w]) + g * np.array(
        [-math.sin(theta) + theta, math.cos(theta) * math.sin(phi) - phi, math.cos(theta) * math.cos(phi) - 1]
    )
    expected[2] = q * math.cos(phi) - r * math.sin(phi) - q
    expected[7] = p + (q * math.sin(phi) + r * math.cos(phi)) * math.tan(theta) - p
    np.testing.assert_allclose(k, expected, atol=1e-12)


def test_looking_ahead_is_stepping_the_filter_s_model():
    rng = np.random.default_rng(2)
    x, sticks = 0.1 * rng.normal(size=19), 0.1 * rng.normal(size=(3, 4))
    expected = x
    for stick in sticks:
        expected = FILTER.f @ expected + FILTER.g @ stick + FILTER.known @ heli_error.known_terms(expected)
    np.testing.assert_allclose(heli_error.ahead(FILTER, x, sticks), expected, atol=1e-12)


def test_another_order_of_states_is_refused():
    other = models.reordered(REF)
    with pytest.raises(ConfigError, match="expected u, q, theta"):
        helicopter.gains(helicopter.Params(), other.a, other.b, other.states)
    with pytest.raises(ConfigError, match="expected u, q, theta"):
        heli_error.gains(heli_error.Params(), other.a, other.b, other.states)


# ---- the paper's own rule ---------------------------------------------------------------------------------------------------
def one_step(delta=0.7):
    """The 19-state model one tick ahead, with a filter's W and box."""
    plant = augment.with_model_error(REF.a, REF.b, REF.c, REF.states, heli_error.ROWS, 0.02)
    rng = np.random.default_rng(3)
    root = 0.05 * rng.normal(size=(8, 8))
    w = root @ root.T + np.diag(np.full(8, 0.02))
    return matching.Step(b=plant.g[:13], b_f=plant.f[:13, 13:], c=REF.c, w=w, half_width=0.6 * np.sqrt(np.diag(w)), delta=delta)


def test_least_squares_is_the_minimum_of_the_paper_s_cost():
    step, rng = one_step(), np.random.default_rng(4)
    u0, f, y = 0.1 * rng.normal(size=4), rng.normal(size=6), 0.01 * rng.normal(size=8)

    def cost(u):
        mismatch = step.c @ (step.b @ u + step.b_f @ f - step.b @ u0)
        rest = y - step.c @ step.b @ u
        return 0.7 * mismatch @ mismatch + 0.3 * rest @ np.linalg.solve(step.w, rest)

    found = scipy.optimize.minimize(cost, u0, method="BFGS", options={"gtol": 1e-14}).x
    best = matching.least_squares(step, u0, f, y)
    assert cost(best) <= cost(found) + 1e-15
    for direction in np.eye(4):
        assert cost(best + 1e-3 * direction) > cost(best)


def test_the_worst_vertex_costs_more_than_the_centre_and_the_centre_is_nearly_the_true_min_max():
    step, u0 = one_step(), np.array([-0.049, -0.071, 0.055, -0.006])
    f = 0.1 * np.random.default_rng(5).normal(size=6)
    centre, min_max, vertex = (matching.correct(step, u0, f, mode) for mode in matching.MODES)
    assert min_max.cost <= centre.cost + 1e-9
    assert centre.cost < 1.05 * min_max.cost
    assert vertex.cost > 1.5 * centre.cost
    assert np.abs(vertex.u - u0).max() > 5.0 * np.abs(centre.u - u0).max()  # it jumps into a far corner


def test_an_unknown_mode_is_refused():
    with pytest.raises(ConfigError, match="expected one of centre, minmax, vertex"):
        matching.correct(one_step(), np.zeros(4), np.zeros(6), "middle")
