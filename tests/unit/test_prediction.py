"""control/prediction.py: the gains of the design note, and the recursion against the condensed solve."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from mavquad.control import attitude_mpc, prediction

DT = 0.01


def test_default_gains_are_those_of_the_design_note():
    k = prediction.lqr(prediction.position_model(0.05), np.array([4.0, 0.5, 1.0]), 0.02)
    np.testing.assert_allclose(k, [14.65800, 6.78356, 5.82676], atol=6e-6)  # printed to five digits
    g = attitude_mpc.gains()
    np.testing.assert_allclose(g.roll, [92.40086, 15.08282], atol=6e-6)
    np.testing.assert_allclose(g.yaw, [29.98446, 10.24316], atol=6e-6)


@pytest.mark.parametrize(
    ("q", "r", "omega", "kp", "kv"),
    [
        ((25.0, 1.0, 2.0), 0.05 * 0.74**2, 1.0, 3.71, 3.46),
        ((25.0, 1.0, 2.0), 0.05 * 0.74**2, 60.0, 30.8, 10.3),
        ((70.0, 8.0, 5.0), 20.0 / 9.81**2, 1.0, 1.37, 3.45),
        ((70.0, 8.0, 5.0), 20.0 / 9.81**2, 60.0, 11.8, 9.24),
        ((70.0, 5.0, 3.0), 20.0 / 9.81**2, 1.0, 1.42, 2.30),
        ((70.0, 5.0, 3.0), 20.0 / 9.81**2, 60.0, 12.8, 7.88),
    ],
)
def test_printed_weights_give_the_gains_of_the_table(q, r, omega, kp, kv):
    weights = np.array(q)
    stacked = prediction.stack(prediction.position_model(DT, "euler"), 10, weights, r, np.diag(omega * weights))
    np.testing.assert_allclose(prediction.first_gain(stacked)[:2], [kp, kv], rtol=4e-3)  # printed to three digits
    targets, inputs = np.zeros((10, 2)), np.zeros(10)
    for i, k in enumerate(prediction.first_gain(stacked)):
        x = tuple(float(i == j) for j in range(3))
        assert prediction.first_move(10, DT, True, *q, omega, r, x, targets, inputs) == pytest.approx(-k, rel=1e-9)


@given(
    seed=st.integers(0, 10**6), euler=st.booleans(), omega=st.floats(1.0, 60.0), r=st.floats(1e-3, 10.0), n=st.integers(1, 25)
)
def test_recursion_with_targets_is_the_condensed_solve_of_eq_15(seed, euler, omega, r, n):
    rng = np.random.default_rng(seed)
    q = rng.uniform(0.5, 80.0, 3)
    x, targets, inputs = rng.normal(size=3), rng.normal(size=(n, 2)), rng.normal(size=n)
    model = prediction.position_model(DT, "euler" if euler else "zoh")
    s = prediction.stack(model, n, q, r, np.diag(omega * q))
    weight = np.kron(np.eye(n), np.diag(q))
    weight[-3:, -3:] *= omega
    wanted = np.hstack([targets, np.zeros((n, 1))]).ravel()
    expected = np.linalg.solve(s.h.T @ weight @ s.h + r * np.eye(n), s.h.T @ weight @ (wanted - s.p @ x) + r * inputs)[0]
    found = prediction.first_move(n, DT, euler, *q, omega, r, tuple(x), targets, inputs)
    assert found == pytest.approx(expected, rel=1e-8, abs=1e-9)


@given(n=st.integers(1, 30), dt_s=st.floats(0.005, 0.1))
def test_a_dare_terminal_makes_any_horizon_the_infinite_one(n, dt_s):
    q, r = np.array([4.0, 0.5, 1.0]), 0.02
    model = prediction.position_model(dt_s)
    stacked = prediction.stack(model, n, q, r, prediction.terminal(model, q, r))
    np.testing.assert_allclose(prediction.first_gain(stacked), prediction.lqr(model, q, r), rtol=1e-7)


@given(dt_s=st.floats(0.005, 0.1), tau_s=st.floats(0.02, 0.5))
def test_the_lagged_model_is_the_exact_one(dt_s, tau_s):
    a = np.zeros((4, 4))
    a[0, 1] = a[1, 2] = 1.0
    a[2, 2], a[2, 3] = -1.0 / tau_s, 1.0 / tau_s
    e = expm(dt_s * a)
    model = prediction.lagged_model(dt_s, tau_s)
    np.testing.assert_allclose(model.a, e[:3, :3], atol=1e-12)
    np.testing.assert_allclose(model.b, e[:3, 3], atol=1e-12)


def test_the_yardsticks_gain_of_the_outer_loop_note():
    # discretised at 20 ms the continuous K = 11.55, 6.83, .30 comes out a little lower
    k = prediction.lqr(prediction.lagged_model(0.001, 0.05), np.array([4.0, 0.5, 0.0]), 0.03)
    np.testing.assert_allclose(k, [11.55, 6.83, 0.30], rtol=0.02)
