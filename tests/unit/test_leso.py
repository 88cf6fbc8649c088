"""estimate/leso against dense matrix exponentials, against the theory of its lag, and against the higher-order observer."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg as dense

from mavquad.errors import ConfigError
from mavquad.estimate import leso

DT = 0.005
w0s = st.floats(2.0, 60.0)
patterns = st.sampled_from(leso.PATTERNS)
orders = st.sampled_from((3, 4))


def make(w0=20.0, dt=DT, **more):
    return leso.gains(leso.LesoParams(w0_rad_s=(w0,), dt_s=dt, **more))


def run(gains, y, a, first=None):
    """All states and compensated outputs of one channel over a record."""
    state = leso.init(np.array([y[0] if first is None else first]))
    z, zc = [state.z[0]], [leso.compensated(gains, state)[0]]
    for k in range(1, len(y)):
        state = leso.step(gains, state, np.array([y[k]]), np.array([a[k - 1]]))
        z.append(state.z[0])
        zc.append(leso.compensated(gains, state)[0])
    return np.array(z), np.array(zc)


def parabola(d, n, dt=DT):
    """Position under a disturbance that is constant over each step, from rest."""
    x, v, out = 0.0, 0.0, []
    for k in range(n):
        out.append(x)
        x, v = x + dt * v + 0.5 * dt * dt * d[k], v + dt * d[k]
    return np.array(out)


@given(w0=w0s, pattern=patterns, order=orders)
def test_the_current_form_has_the_poles_it_was_asked_for(w0, pattern, order):
    Lc = leso.current_gains(w0, DT, order, pattern)
    phi = dense.expm(np.diag(np.ones(order - 1), 1) * DT)
    got = np.linalg.eigvals((np.eye(order) - np.outer(Lc, np.eye(order)[0])) @ phi)
    wanted = np.exp(leso.poles(w0, order, pattern) * DT)
    np.testing.assert_allclose(np.poly(got), np.real(np.poly(wanted)), atol=1e-10)


@given(w0=w0s)
def test_the_current_gains_are_the_note_s_closed_form(w0):
    b = np.exp(-w0 * DT)
    expected = [1 - b**3, 1.5 * (1 - b) ** 2 * (1 + b) / DT, (1 - b) ** 3 / DT**2]
    np.testing.assert_allclose(leso.current_gains(w0, DT), expected, rtol=1e-11)


@given(w0=w0s, pattern=patterns, dt=st.floats(1e-3, 0.03))
def test_the_closed_form_is_the_placement_and_its_ramp_gains_are_the_steady_state(w0, pattern, dt):
    Lc = leso.current_gains(w0, dt, 3, pattern)
    np.testing.assert_allclose(leso.closed_form(w0, dt, pattern == "butterworth"), Lc, rtol=1e-7)
    phi, w = dense.expm(np.diag([1.0, 1.0], 1) * dt), np.array([dt**3 / 6, dt**2 / 2, dt])
    left = np.eye(3) - np.outer(Lc, [1.0, 0.0, 0.0])
    eps = np.linalg.solve(np.eye(3) - left @ phi, left @ w)  # the error equation at rest under a ramp of slope 1
    np.testing.assert_allclose(leso.ramp_gains(tuple(map(float, Lc)), dt), eps / (phi @ eps + w)[0], rtol=1e-6)


def test_the_note_s_ramp_gain():
    Lc = leso.closed_form(20.0, 0.005, False)
    assert leso.ramp_gains(Lc, 0.005)[2] == pytest.approx(1017.8, abs=0.05)


@given(w0=w0s, pattern=patterns, order=orders, seed=st.integers(0, 1000))
def test_both_forms_agree_with_a_dense_oracle(w0, pattern, order, seed):
    rng = np.random.default_rng(seed)
    y, a = rng.standard_normal(40), rng.standard_normal(40)
    A, C = np.diag(np.ones(order - 1), 1), np.eye(order)[0]
    B = np.eye(order)[1]
    b = leso.continuous_gains(w0, order, pattern)
    # zoh: the continuous observer integrated under held y and a, by a truncated Taylor series of its own exponential
    M = np.zeros((order + 2, order + 2))
    M[:order, :order], M[:order, order], M[:order, order + 1] = A - np.outer(b, C), B, b
    E, term = np.eye(order + 2), np.eye(order + 2)
    for k in range(1, 40):
        term = term @ (M * DT) / k
        E = E + term
    z, expected = np.array([y[0], *np.zeros(order - 1)]), []
    for k in range(40):
        expected.append(z)
        z = E[:order] @ np.concatenate([z, [a[k], y[k]]])
    got, _ = run(make(w0, form="zoh", pattern=pattern, order=order), y, a)
    np.testing.assert_allclose(got[:, :order], expected, atol=1e-7 * max(1.0, np.abs(expected).max()))
    # current: predict exactly, correct with the newest sample
    phi, gam = dense.expm(A * DT), dense.expm(np.block([[A, B[:, None]], [np.zeros((1, order + 1))]]) * DT)[:order, order]
    Lc = leso.current_gains(w0, DT, order, pattern)
    z, expected = np.array([y[0], *np.zeros(order - 1)]), [np.array([y[0], *np.zeros(order - 1)])]
    for k in range(1, 40):
        zp = phi @ z + gam * a[k - 1]
        z = zp + Lc * (y[k] - zp[0])
        expected.append(z)
    got, _ = run(make(w0, pattern=pattern, order=order), y, a)
    np.testing.assert_allclose(got[:, :order], expected, atol=1e-7 * max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize(
    ("w0", "pattern", "lag"), [(20.0, "binomial", 0.150), (27.0, "binomial", 3 / 27), (24.2, "butterworth", 2 / 24.2)]
)
@pytest.mark.parametrize("form", ["current", "zoh"])
def test_a_growing_disturbance_is_seen_late_by_the_theory_s_lag_and_at_once_with_feed_forward(form, w0, pattern, lag):
    dt = DT if form == "current" else 0.0005  # held samples ripple with speed; see the test of constant speed
    n = round(3.0 / dt)
    d = dt * np.arange(n)  # 1 m/s^2 per second
    gains = make(w0, dt, form=form, pattern=pattern, feedforward=(1.0,), tau_f_s=0.0)
    z, zc = run(gains, parabola(d, n, dt), np.zeros(n))
    assert d[-1] - z[-1, 2] == pytest.approx(lag, abs=0.006)
    if form == "current":
        assert d[-1] - zc[-1, 2] == pytest.approx(0.0, abs=1.5 * dt)  # d is held over each step


def test_feed_forward_with_tau_1_over_w0_is_the_observer_of_order_4():
    dt, w0 = 0.001, 20.0
    n = 1500
    d = np.where(np.arange(n) * dt > 0.1, 1.0, 0.0)
    y = parabola(d, n, dt)
    _, zc = run(make(w0, dt, feedforward=(1.0,), tau_f_s=1.0 / w0), y, np.zeros(n))
    z4, _ = run(make(w0, dt, order=4), y, np.zeros(n))
    peak = np.abs(z4[:, 2]).max()
    assert np.abs(zc[:, 2] - z4[:, 2]).max() < 0.01 * peak
    z3, _ = run(make(w0, dt), y, np.zeros(n))
    assert np.abs(z3[:, 2] - z4[:, 2]).max() > 0.1 * peak  # without feed-forward they differ


def test_at_constant_speed_the_current_form_is_right_and_the_held_measurement_invents_a_disturbance():
    n, v = 800, 1.0
    y = v * DT * np.arange(n)
    for form, expected in (("current", 0.0), ("zoh", 3.1)):
        _, zc = run(make(20.0, form=form, feedforward=(1.0,), tau_f_s=0.0), y, np.zeros(n))
        assert abs(zc[-1, 2]) == pytest.approx(expected, abs=0.1)


def _noise(A, B):
    """Standard deviation of each state of x+ = A x + B y under white y of variance 1."""
    return np.sqrt(np.diag(dense.solve_discrete_lyapunov(A, np.outer(B, B))))


def test_noise_of_the_disturbance_grows_with_the_bandwidth_to_the_power_2_5_and_faster_with_euler():
    wide, narrow = make(20.0, 0.001, form="zoh"), make(10.0, 0.001, form="zoh")
    ratio = _noise(wide.A[0, :3, :3], wide.Y[0, :3])[2] / _noise(narrow.A[0, :3, :3], narrow.Y[0, :3])[2]
    assert ratio == pytest.approx(2.0**2.5, rel=0.01)
    for w0_dt, factor in ((0.05, 1.07), (0.1, 1.14)):
        euler, zoh = make(w0_dt / DT, form="euler"), make(w0_dt / DT, form="zoh")
        got = _noise(euler.A[0, :3, :3], euler.Y[0, :3])[2] / _noise(zoh.A[0, :3, :3], zoh.Y[0, :3])[2]
        assert got == pytest.approx(factor, abs=0.01)


def test_a_missing_sample_is_predicted_and_the_others_are_not_touched():
    gains = leso.gains(leso.LesoParams(w0_rad_s=(10.0, 10.0), dt_s=DT))
    state = leso.init(np.array([1.0, np.nan]))
    assert state.z[1, 0] == 0.0
    for k in range(200):
        y = np.array([1.0 + DT * (k + 1), np.inf if k % 2 else np.nan])
        state = leso.step(gains, state, y, np.array([0.0, 2.0]))
    t = 200 * DT
    assert state.z[0, 1] == pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(state.z[1, :3], [t * t, 2 * t, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"w0_rad_s": (130.0,), "dt_s": DT}, "w0.dt = 0.65, limit 0.6"),
        ({"w0_rad_s": (30.0,), "dt_s": DT, "form": "euler"}, "limit 0.1"),
        ({"w0_rad_s": (0.0,), "dt_s": DT}, "must be > 0"),
        ({"w0_rad_s": (10.0,), "dt_s": -1.0}, "dt_s"),
        ({"w0_rad_s": (10.0,), "dt_s": DT, "form": "tustin"}, "current, zoh, euler"),
        ({"w0_rad_s": (10.0,), "dt_s": DT, "pattern": "bessel"}, "binomial, butterworth"),
        ({"w0_rad_s": (10.0,), "dt_s": DT, "order": 5}, "3 or 4"),
        ({"w0_rad_s": (10.0,), "dt_s": DT, "feedforward": (0.5, 0.5)}, "one per channel"),
        ({"w0_rad_s": (10.0,), "dt_s": DT, "feedforward": (1.5,)}, "within 0..1"),
        ({"w0_rad_s": (10.0,), "dt_s": DT, "feedforward": (1.0,), "order": 4}, "twice"),
        ({"w0_rad_s": (10.0,), "dt_s": DT, "tau_f_s": -0.1}, "tau_f_s"),
    ],
)
def test_impossible_settings_are_refused_with_the_reason(settings, message):
    with pytest.raises(ConfigError, match=message):
        leso.LesoParams(**settings)
