"""control/mpc_flight.py: its prediction against the differential equation, its rates against a turning attitude, its guards."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from mavquad import airframe, quat
from mavquad.control import lagged, mpc_flight
from mavquad.errors import ConfigError
from mavquad.setpoint.attitude import attitude, thrust_vector
from mavquad.signals import NAN3, ZERO3, Demand, Estimate

G = 9.80665
FRAME = airframe.load("x500")
GAINS = mpc_flight.gains(mpc_flight.Params(), FRAME)
LAW = GAINS.law
HOVER = Demand(0, ZERO3, ZERO3, ZERO3, ZERO3, 0.0, 0.0)


def _estimate(t_us=1_000_000, p=ZERO3, v=ZERO3, f=ZERO3, delay_s=0.02):
    return Estimate(t_us, p, v, quat.IDENTITY, ZERO3, f, NAN3, delay_s, G)


@given(seed=st.integers(0, 10**6), delay_s=st.floats(0.01, 0.3))
def test_prediction_follows_the_differential_equation(seed, delay_s):
    rng = np.random.default_rng(seed)
    g = LAW._replace(drag_linear_1_s=ZERO3, drag_quadratic_1_m=ZERO3)
    now, n = 5.0, 60
    queue = np.zeros((mpc_flight.QUEUE, 4))
    queue[:, 0] = -1e9
    queue[-n:, 0] = now - 0.008 * np.arange(n, 0, -1)
    queue[-n:, 1:] = rng.normal(size=(n, 3))
    p, v, a, f = (rng.normal(size=3) for _ in range(4))
    lag = np.array([g.lag_s, g.lag_s, g.lag_down_s])
    starts = np.concatenate([queue[-n:, 0] + delay_s - now])
    edges = [0.0, *[s for s in starts if 0.0 < s < delay_s], delay_s]
    x = np.concatenate([p, v, a])
    for low, high in itertools.pairwise(edges):
        u = queue[-n:, 1:][np.searchsorted(starts, 0.5 * (low + high)) - 1]
        x = solve_ivp(lambda t, x, u=u: np.concatenate([x[3:6], x[6:] + f, (u - x[6:]) / lag]), (low, high), x, rtol=1e-9).y[
            :, -1
        ]
    found = lagged.ahead(g, tuple(p), tuple(v), tuple(a), tuple(f), queue, now, delay_s, delay_s)
    np.testing.assert_allclose(np.concatenate(found), x, atol=1e-6)


def test_at_rest_on_the_point_nothing_is_wanted():
    _, command = mpc_flight.step(GAINS, mpc_flight.init(GAINS), _estimate(), HOVER, lambda t: HOVER, 0.008)
    np.testing.assert_allclose(command.a_ned_m_s2, ZERO3, atol=1e-12)
    assert math.isnan(command.omega_rad_s[0])


def test_thrust_waits_for_the_link_only_an_attitude_for_its_own_delay_too():
    """A path that runs away from a vehicle at rest is met where each axis' prediction ends."""

    def runs(t_us):
        return HOVER._replace(p_ned_m=(1e-6 * t_us, 1e-6 * t_us, 1e-6 * t_us))

    gains = GAINS._replace(design=None, law=LAW._replace(slew_m_s3=1e6))
    assert gains.delay_s > 0.05
    at = _estimate(t_us=100_000, delay_s=0.02)
    _, command = mpc_flight.step(gains, mpc_flight.init(gains), at, runs(at.t_us), runs, 0.008)
    level = LAW.k[0] * (0.12 + gains.delay_s)
    np.testing.assert_allclose(command.a_ned_m_s2, (level, level, LAW.k_down[0] * 0.12), rtol=1e-9)


def test_a_command_acts_when_it_reaches_the_vehicle_and_overtakes_none():
    state = mpc_flight.init(GAINS)
    for i, delay_s in enumerate((0.05, 0.09, 0.03)):
        at = _estimate(t_us=1_000_000 + 8000 * i, delay_s=delay_s)
        state, _ = mpc_flight.step(GAINS, state, at, HOVER, lambda t: HOVER, 0.008)
    np.testing.assert_allclose(state.queue[-3:, 0], [1.05, 1.098, 1.098], rtol=1e-12)


def test_a_disturbance_is_cancelled_once():
    f = (1.0, -0.5, 0.7)
    _, command = mpc_flight.step(
        GAINS._replace(predict=False), mpc_flight.init(GAINS), _estimate(f=f), HOVER, lambda t: HOVER, 0.008
    )
    k = LAW.k[2], LAW.k[2], LAW.k_down[2]  # level now, the lean that carries f is still to come
    np.testing.assert_allclose(command.a_ned_m_s2, [-x * (1.0 + ka) for x, ka in zip(f, k, strict=True)], rtol=1e-12)
    assert command.f_cancelled_m_s2 == f


@given(a=st.tuples(*[st.floats(-60, 60)] * 3))
def test_what_is_sent_stays_inside_the_cone(a):
    n, e, d = lagged.limited(LAW, a)
    down = G - d
    assert LAW.down_min_m_s2 <= down + 1e-12
    assert down <= LAW.down_max_m_s2 + 1e-12
    assert math.hypot(n, e) <= down * LAW.tan_tilt * (1.0 + 1e-12)
    np.testing.assert_allclose(lagged.limited(LAW, (n, e, d)), (n, e, d), rtol=1e-12, atol=1e-12)


def _turning(t, heading):
    return (2.0 * math.sin(1.5 * t), 1.5 * math.cos(1.5 * t), 0.5 * math.sin(t)), heading


@pytest.mark.parametrize("heading", [0.0, 0.9, -2.5])
def test_rates_are_those_of_the_commanded_attitude(heading):
    axis, dt = NAN3, 0.001
    for i in range(1600):
        axis, omega = lagged.turning(_turning(i * dt, heading)[0], axis, heading, 0.0, dt)

    def rate(t):  # of the attitude that the setpoint stage makes of the same command
        before, after = (
            attitude(thrust_vector(_turning(t + h, heading)[0], 1.0, 1.0, 20.0), heading)[0] for h in (-1e-4, 1e-4)
        )
        return np.array(quat.log(quat.mul(quat.conj(before), after))) / 2e-4

    now, late = rate(1.599), rate(1.599 - 0.04)  # the filter is 40 ms late
    np.testing.assert_allclose(omega[:2], late[:2], atol=0.012)
    assert np.abs(late[:2] - now[:2]).max() > 0.012  # ... which this can tell


def test_a_heading_that_turns_is_a_rate_about_the_vertical():
    a, axis = (1.0, -2.0, 0.5), NAN3
    axis, _ = lagged.turning(a, axis, 0.4, 0.0, 0.004)
    _, omega = lagged.turning(a, axis, 0.4, 0.3, 0.004)
    q, _ = attitude(thrust_vector(a, 1.0, 1.0, 20.0), 0.4)
    np.testing.assert_allclose(quat.rotate(q, omega), (0.0, 0.0, 0.3), atol=1e-12)


def test_a_delay_out_of_range_lowers_the_gain_instead_of_guessing():
    at = _estimate(p=(1.0, 0.0, 0.0))
    _, near = mpc_flight.step(GAINS, mpc_flight.init(GAINS), at, HOVER, lambda t: HOVER, 0.008)
    _, far = mpc_flight.step(GAINS, mpc_flight.init(GAINS), at._replace(delay_s=0.9), HOVER, lambda t: HOVER, 0.008)
    assert 0.1 < far.a_ned_m_s2[0] / near.a_ned_m_s2[0] < 0.5
    _, unknown = mpc_flight.step(GAINS, mpc_flight.init(GAINS), at._replace(delay_s=math.nan), HOVER, lambda t: HOVER, 0.008)
    assert math.isfinite(unknown.a_ned_m_s2[0])


def test_an_unknown_disturbance_is_none():
    _, command = mpc_flight.step(GAINS, mpc_flight.init(GAINS), _estimate(f=NAN3), HOVER, lambda t: HOVER, 0.008)
    np.testing.assert_allclose(command.a_ned_m_s2, ZERO3, atol=1e-12)
    assert command.f_cancelled_m_s2 == ZERO3


def test_the_integral_freezes_where_the_command_is_cut():
    far = _estimate(p=(-30.0, 0.0, 0.0))
    state = mpc_flight.init(GAINS)
    for _ in range(50):
        state, command = mpc_flight.step(GAINS, state, far, HOVER, lambda t: HOVER, 0.008)
    assert command.a_ned_m_s2[0] == pytest.approx(LAW.tan_tilt * G, rel=1e-6)
    assert state.integral_m_s == ZERO3


@pytest.mark.parametrize("change", [{"r_input": 0.0}, {"tilt_max_deg": 80.0}, {"delay_max_s": 2.0}, {"integral_1_s3": -1.0}])
def test_impossible_parameters_are_refused(change):
    with pytest.raises(ConfigError, match="eskf-mpc"):
        mpc_flight.Params(**change)


def _far(gains, steps=30):
    state, commands = mpc_flight.init(gains), []
    for i in range(steps):
        at = _estimate(t_us=1_000_000 + 8000 * i, p=(-6.0, 2.0, 0.5))
        state, command = mpc_flight.step(gains, state, at, HOVER, lambda t: HOVER, 0.008)
        commands.append(command.a_ned_m_s2)
    return mpc_flight.diagnostics(state), np.array(commands)


def test_a_solver_made_to_fail_leaves_the_closed_form_flagged_and_counted():
    closed, expected = _far(mpc_flight.gains(mpc_flight.Params(constrained="off"), FRAME))
    failing, found = _far(mpc_flight.gains(mpc_flight.Params(max_iter=1), FRAME))
    np.testing.assert_array_equal(found, expected)
    assert failing["qp_fallbacks"] == failing["steps"] == 30
    assert closed["qp_fallbacks"] == 0
    good, planned = _far(GAINS)
    assert good["qp_solves"] > 0
    assert good["qp_fallbacks"] == 0
    assert not np.array_equal(planned, expected)


def test_commands_turn_no_faster_than_the_vehicle():
    for kind in ("off", "needed", "always"):
        _, commands = _far(mpc_flight.gains(mpc_flight.Params(constrained=kind), FRAME))
        assert np.abs(np.diff(commands, axis=0)).max() <= 60.0 * 0.008 + 5e-3
