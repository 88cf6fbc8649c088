"""estimate/ekf against filterpy's filter and an Euler-angle vehicle written apart, and against what goes wrong in flight."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad import linalg, quat
from mavquad.errors import ConfigError
from mavquad.estimate import ekf
from tests.oracles import euler_quadrotor as oracle

MODEL = ekf.EkfModel(9.8, 0.125, (0.005, 0.006, 0.0095), 0.002)
PARAMS = ekf.EkfParams(q_velocity=0.3, q_rate=1.0, sigma_angle_rad=0.003, sigma_position_m=0.01)
G = ekf.gains(PARAMS, MODEL)
DT = 0.005
angle, rate, small = st.floats(-1.0, 1.0), st.floats(-4.0, 4.0), st.floats(-2.0, 2.0)


def euler_state(state):
    return np.array([*state.p_ned_m, *state.v_ned_m_s, *quat.to_euler(state.q_wxyz), *state.omega_rad_s])


def noisy_flight(n, seed, keep=1.0):
    """Truth flown by the oracle under random thrust and torque, and noisy rows of which a share `keep` arrives."""
    rng = np.random.default_rng(seed)
    x, rows, inputs = np.zeros(12), [], []
    for k in range(n):
        aim = np.array([0.6 * np.sin(0.02 * k), 0.4 * np.sin(0.03 * k), 0.009 * k])  # the heading passes pi
        back = np.array([0.1, 0.1, 0.1]) * (aim - x[6:9]) - 0.04 * x[9:12]
        u = (9.8 + np.sin(0.01 * k), back, 0.1 * rng.standard_normal(3), rng.standard_normal(3))
        inputs.append(u)
        x = oracle.rk4(x, DT, *u, MODEL.gravity_m_s2, MODEL.drag_1_s, MODEL.inertia_kg_m2, MODEL.rate_drag_nm_s)
        z = x + np.sqrt(G.noise[ekf.R]) * rng.standard_normal(12)
        rows.append(np.where(rng.random(12) < keep, z, np.nan))
    return inputs, rows


def as_input(u):
    return (float(u[0]), tuple(map(float, u[1])), tuple(map(float, u[2])), tuple(map(float, u[3])))


@pytest.mark.parametrize(("n", "keep"), [(600, 1.0), (200, 0.4)])
def test_the_filter_agrees_with_filterpy_over_a_whole_noisy_flight(n, keep):
    inputs, rows = noisy_flight(n, seed=3, keep=keep)
    state = ekf.init(G, (0.0,) * 12)
    peer = oracle.Filter(np.zeros(12), G.noise[ekf.P0], G.noise[ekf.Q], G.noise[ekf.R], DT, tuple(MODEL))
    tilt = 0.0
    for u, z in zip(inputs, rows, strict=True):
        state = ekf.step(G, state, as_input(u), tuple(z), DT)
        peer.predict(u)
        peer.absorb(z)
        tilt = max(tilt, *np.abs(peer.x[6:8]))
        np.testing.assert_allclose(oracle.wrapped(euler_state(state), peer.x), 0.0, atol=1e-9)
    np.testing.assert_allclose(state.P, peer.P, atol=1e-9 * np.abs(peer.P).max())
    assert 0.25 < tilt < 1.0
    assert n < 400 or peer.x[8] > math.pi


@given(eta=st.tuples(angle, angle, angle), w=st.tuples(rate, rate, rate), v=st.tuples(small, small, small))
def test_the_jacobian_is_the_derivative_of_an_independent_vehicle(eta, w, v):
    x = np.array([0, 0, 0, *v, *eta, *w])
    args = (11.0, np.array([0.01, 0.02, -0.01]), np.zeros(3), np.zeros(3), *MODEL)
    A = np.zeros((12, 12))
    assert not ekf.jacobian(MODEL, 11.0, eta, w, A)
    np.testing.assert_allclose(A, oracle.jacobian(x, *args), atol=5e-8)  # central differences with h = 1e-6
    np.testing.assert_allclose(A, oracle.jacobian_exact(x, *args), atol=1e-11)


@given(seed=st.integers(0, 10_000), keep=st.floats(0.0, 1.0))
def test_the_covariance_stays_symmetric_and_positive_whatever_arrives(seed, keep):
    rng = np.random.default_rng(seed)
    state = ekf.init(G, (0.0,) * 12)
    for _ in range(20):
        z = np.where(rng.random(12) < keep, 0.3 * rng.standard_normal(12), np.nan)
        u = (9.8, tuple(0.01 * rng.standard_normal(3)), (0.0,) * 3, (0.0,) * 3)
        state = ekf.step(G, state, u, tuple(z), float(rng.uniform(1e-4, 0.05)))
    np.testing.assert_allclose(state.P, state.P.T, atol=1e-15)
    assert np.linalg.eigvalsh(state.P).min() > 0.0
    assert quat.norm(state.q_wxyz) == pytest.approx(1.0, abs=1e-12)


def test_rows_that_are_not_finite_change_nothing():
    state = ekf.init(G, (0.1,) * 12)
    for bad in (math.nan, math.inf, -math.inf):
        after = ekf.update(G, state, (bad,) * 12)
        np.testing.assert_array_equal(after.P, state.P)
        np.testing.assert_allclose(euler_state(after), euler_state(state), atol=1e-15)


def test_an_attitude_measured_across_the_seam_of_the_angles_turns_the_short_way():
    z = [0.0] * 12
    z[8] = math.pi - 0.01
    state = ekf.init(G, tuple(z))
    z[8] = -math.pi + 0.01  # 0.02 rad further on, not 2 pi back
    after = ekf.update(G, state, tuple(z))
    turned = (quat.yaw(after.q_wxyz) - (math.pi - 0.01)) % (2 * math.pi)
    assert 0.015 < turned < 0.02


def test_a_loop_through_the_singular_pitch_is_flagged_and_never_a_nan():
    state, q, flags = ekf.init(G, (0.0,) * 12), quat.IDENTITY, []
    for _ in range(500):  # two turns about the body's y axis, measured throughout
        q = quat.integrate(q, (0.0, 5.0, 0.0), DT)
        z = [math.nan] * 12
        z[6:12] = [*quat.to_euler(q), 0.0, 5.0, 0.0]
        state = ekf.step(G, state, (9.8, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3), tuple(z), DT)
        flags.append(state.singular)
        assert np.isfinite(euler_state(state)).all()
        assert np.isfinite(state.P).all()
    assert 20 < sum(flags) < 250
    assert linalg.norm(quat.log(quat.mul(quat.conj(q), state.q_wxyz))) < 0.1


def test_wrap_is_the_remainder_of_a_turn():
    for a in (-7.0, -math.pi, -0.1, 0.0, 3.0, 3.2, 9.5, 1e4):
        assert math.isclose(math.remainder(ekf.wrap(a) - a, 2 * math.pi), 0.0, abs_tol=1e-9)
        assert -math.pi <= ekf.wrap(a) < math.pi


@pytest.mark.parametrize(("name", "value"), [("q_rate", 0.0), ("sigma_angle_rad", -1.0), ("p0_rate", float("nan"))])
def test_impossible_settings_are_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=f"ekf.{name}"):
        ekf.EkfParams(**{name: value})
