"""control/mpc.py and attitude_mpc.py: limits, directions, delay prediction, integral, and what cannot be."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from mavquad import quat
from mavquad.control import attitude_mpc, mpc
from mavquad.errors import ConfigError

PARAMS = mpc.MpcParams(mass_kg=0.74, u_min_n=1.45, u_max_n=14.4, gravity_m_s2=9.81)
G = mpc.gains(PARAMS)
accelerations = st.tuples(st.floats(-30, 30), st.floats(-30, 30), st.floats(-30, 30))


@given(a=accelerations, cos_tilt=st.floats(0.2, 1.0))
def test_limited_thrust_stays_in_its_bounds_and_cone(a, cos_tilt):
    t = mpc.thrust(G, a, cos_tilt)
    assert PARAMS.u_min_n <= t.u_n <= PARAMS.u_max_n
    assert math.hypot(t.ux, t.uy) <= math.sin(PARAMS.tilt_max_rad) + 1e-12
    back = mpc.acceleration(G, t, cos_tilt)
    if not t.saturated:
        np.testing.assert_allclose(back, a, atol=1e-9)
    again = mpc.thrust(G, back, cos_tilt)  # what is inside the limits is left alone
    np.testing.assert_allclose(again[:3], t[:3], rtol=1e-9, atol=1e-9)


@given(a=st.tuples(st.floats(-4, 4), st.floats(-4, 4), st.floats(-4, 4)), yaw=st.floats(-3.1, 3.1))
def test_angles_point_the_thrust_where_it_was_wanted(a, yaw):
    t = mpc.thrust(G, a, 1.0)
    roll, pitch = mpc.angles(t.ux, t.uy, yaw)
    up = quat.rotate(quat.from_euler(roll, pitch, yaw), (0.0, 0.0, 1.0))
    np.testing.assert_allclose(up[:2], (t.ux, t.uy), atol=1e-12)


@given(seed=st.integers(0, 10**6), steps=st.integers(1, 12))
def test_prediction_through_the_delay_follows_the_differential_equation(seed, steps):
    rng = np.random.default_rng(seed)
    wn, zeta, dt = 8.0, 0.8, 0.01
    p, v, a, j, f = (rng.normal(size=3) for _ in range(5))
    queue = rng.normal(size=(steps, 3))

    def rate(t, x):
        c = queue[min(steps - 1, int(t / dt))]
        lagged = wn * wn * (c[:2] - x[6:8]) - 2.0 * zeta * wn * x[8:10]
        return np.concatenate([x[3:6], [x[6] + f[0], x[7] + f[1], c[2] + f[2]], x[8:10], lagged])

    x = np.concatenate([p, v, a[:2], j[:2]])
    for i in range(steps):
        span = (i * dt + 1e-9, (i + 1) * dt - 1e-9)
        x = solve_ivp(rate, span, x, rtol=1e-9, atol=1e-12).y[:, -1]
    response = mpc.second_order(wn, zeta, dt)
    found_p, found_v = mpc.ahead(tuple(p), tuple(v), tuple(a), tuple(j), tuple(f), queue, steps, dt, response)
    np.testing.assert_allclose(found_p, x[:3], atol=2e-4)  # trapezoid of the acceleration over 10 ms
    np.testing.assert_allclose(found_v, x[3:6], atol=2e-3)


def test_the_integral_freezes_only_where_it_would_wind_up():
    grown = mpc.integrate((1.0, -1.0, 4.999), (1.0, 1.0, 1.0), 0.01, False)
    np.testing.assert_allclose(grown, (1.01, -0.99, mpc.INTEGRAL_LIMIT_M_S))
    held = mpc.integrate((1.0, -1.0, 0.0), (1.0, 1.0, 1.0), 0.01, True)
    np.testing.assert_allclose(held, (1.0, -0.99, 0.01))


@given(v=st.tuples(*[st.floats(-50, 50)] * 3), rates=st.tuples(*[st.floats(-8, 8)] * 3))
def test_torque_inverts_eulers_equations(v, rates):
    inertia = (0.004, 0.005, 0.0084)
    tau = np.array(attitude_mpc.torque(inertia, v, rates))
    j = np.diag(inertia)
    found = np.linalg.solve(j, tau - np.cross(rates, j @ np.array(rates)))
    np.testing.assert_allclose(found, v, atol=1e-9)


def test_yaw_goes_the_short_way_round():
    g = attitude_mpc.gains()
    turn = attitude_mpc.angular(g, (0.0, 0.0, 3.1), (0.0, 0.0, 0.0), (0.0, 0.0, -3.1))
    assert turn[2] == pytest.approx(g.yaw[0] * (2.0 * math.pi - 6.2))


@pytest.mark.parametrize(
    "change",
    [
        {"mass_kg": 0.0},
        {"u_min_n": -1.0},
        {"u_max_n": 1.0},
        {"tilt_max_rad": 2.0},
        {"preset": "best"},
        {"f_max_m_s2": math.nan},
    ],
)
def test_impossible_parameters_are_refused(change):
    with pytest.raises(ConfigError, match="mpc"):
        mpc.MpcParams(**{"mass_kg": 0.74, "u_min_n": 1.45, "u_max_n": 14.4, **change})


def test_a_nan_stays_a_nan_for_the_gate_to_see():
    t = mpc.thrust(G, (math.nan, 0.0, 0.0), 1.0)
    assert math.isnan(t.ux)
