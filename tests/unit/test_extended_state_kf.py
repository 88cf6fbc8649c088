"""estimate/extended_state_kf.py against the printed recursion in dense matrices, the DARE, and the poles of the design note."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad.errors import ConfigError
from mavquad.estimate import extended_state_kf as eskf

DT = 0.01
A = np.array([[1.0, DT, 0.5 * DT**2], [0.0, 1.0, DT], [0.0, 0.0, 1.0]])
D = np.eye(2, 3)
B = np.array([0.5 * DT**2, DT, 0.0])


def _dense(p: tuple[float, ...]) -> np.ndarray:
    a, b, c, d, e, f = p
    return np.array([[a, b, c], [b, d, e], [c, e, f]])


def _printed(x, p, y, a, r, q, delta):
    """Eqs. (7)-(9) as printed, L negative; delta = 0 leaves the factor 1 + 1/delta out."""
    gain = -A @ p @ D.T @ np.linalg.inv(D @ p @ D.T + r / (1.0 + delta))
    closed = A + gain @ D
    growth = np.diag([0.0, 0.0, q]) * (1.0 + 1.0 / delta if delta > 0.0 else 1.0)
    return A @ x + B * a - gain @ (y - D @ x), (1.0 + delta) * closed @ p @ closed.T + gain @ r @ gain.T + growth


@given(seed=st.integers(0, 10**6), q=st.floats(1e-3, 10.0), fading=st.sampled_from(["none", "constant", "per-step"]))
def test_posterior_then_prediction_is_the_printed_recursion(seed, q, fading):
    rng = np.random.default_rng(seed)
    g = eskf.gains(eskf.KfParams(q_per_step=q, r_first=0.02, r_second=0.005, fading=fading))
    state = eskf.init(g, 0.3, -0.2)
    x, p = np.array(state.x), _dense(state.p)
    for _ in range(25):
        y, a = rng.normal(size=2), float(rng.normal())
        delta = {"none": 0.0, "constant": np.sqrt(q / 3.0), "per-step": np.sqrt(q / np.trace(p))}[fading]
        x, p = _printed(x, p, y, a, np.diag([0.02, 0.005]), q, delta)
        state = eskf.advance(g, eskf.update(g, state, y[0], y[1]), a, DT)
    np.testing.assert_allclose(state.x, x, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(_dense(state.p), p, rtol=1e-8, atol=1e-14)
    np.testing.assert_allclose(_dense(eskf.schedule(g, 25)[1]), p, rtol=1e-8, atol=1e-14)


@pytest.mark.parametrize("fading", ["none", "constant"])
@pytest.mark.parametrize(("q", "r"), [(0.3, 0.01), (1.0, 1e-4), (0.005, 1e-3)])
def test_the_recursion_ends_at_the_dare(q, r, fading):
    g = eskf.gains(eskf.KfParams(q_per_step=q, r_first=r, r_second=r, fading=fading))
    table, last = eskf.schedule(g, 3000)
    gain, p = eskf.limit(g)
    np.testing.assert_allclose(_dense(last), p, rtol=1e-8)
    np.testing.assert_allclose(table[-1], gain, rtol=1e-8)


@pytest.mark.parametrize(
    ("q", "r", "p0", "fading", "poles"),
    [
        (1.0, 0.01, 1.0, "constant", (0.634, 0.552, 0.552)),
        (1.0, 1e-4, 1.0, "constant", (0.634, 0.267, 0.267)),
        (0.005, 1e-3, 0.5, "constant", (0.944, 0.778, 0.778)),
        (0.1, 0.01, 1.0, "none", (0.990, 0.882, 0.882)),
        (0.1, 1e-4, 1.0, "none", (0.990, 0.669, 0.669)),
    ],
)
def test_poles_of_the_design_note(q, r, p0, fading, poles):
    gain, _ = eskf.limit(eskf.gains(eskf.KfParams(q_per_step=q, r_first=r, r_second=r, p0=p0, fading=fading)))
    found = np.sort(np.abs(np.linalg.eigvals(A @ (np.eye(3) - np.reshape(gain, (3, 2)) @ D))))[::-1]
    np.testing.assert_allclose(found, poles, atol=6e-4)  # printed to three digits


def test_the_printed_deltas():
    assert eskf.gains(eskf.KfParams(q_per_step=1.0, p0=1.0, fading="constant")).delta == pytest.approx(0.5774, abs=5e-5)
    assert eskf.gains(eskf.KfParams(q_per_step=0.005, p0=0.5, fading="constant")).delta == pytest.approx(0.0577, abs=5e-5)


def test_a_bank_of_six_is_six_single_axes():
    rng = np.random.default_rng(4)
    k, x, y, a = rng.normal(size=(6, 6)), rng.normal(size=(6, 3)), rng.normal(size=(6, 2)), rng.normal(size=6)
    both = eskf.step_bank(k, x, y, a, DT)
    for i in range(6):
        posterior = eskf.correct(tuple(k[i]), tuple(x[i]), y[i, 0], y[i, 1])
        np.testing.assert_allclose(both[0, i], posterior, rtol=1e-14)
        np.testing.assert_allclose(both[1, i], eskf.predict(posterior, a[i], DT), rtol=1e-14)


def _f_error(adaptive: bool, r_known: float | None) -> float:
    """RMSE of f on one axis when the true variance jumps from 1e-4 to 1e-2 at 10 s; the first 3 s after it are not scored."""
    rng = np.random.default_rng(11)
    steps, jump = 4000, 1000
    f = np.zeros(steps)
    for k in range(1, steps):  # a gust of 1.17 m/s^2 with 0.355 s of memory
        keep = np.exp(-DT / 0.355)
        f[k] = keep * f[k - 1] + 1.17 * np.sqrt(1.0 - keep**2) * rng.standard_normal()
    g = eskf.gains(eskf.KfParams(q_per_step=0.1, r_first=1e-4, r_second=1e-4))
    p = v = 0.0
    state = eskf.init(g, p, v)
    squares = []
    for k in range(steps):
        sigma = 1e-2 if k < jump else 0.1
        if r_known is not None and k == jump:
            state = state._replace(r=(r_known, r_known))
        y = p + sigma * rng.standard_normal(), v + sigma * rng.standard_normal()
        state = eskf.update(g, state, *y)
        if adaptive:
            state = eskf.adapt(state, *y, 0.01)
        if k >= jump + 300:
            squares.append((state.x[2] - f[k]) ** 2)
        state = eskf.advance(g, state, 0.0, DT)
        p += DT * v + 0.5 * DT**2 * f[k]
        v += DT * f[k]
    return float(np.sqrt(np.mean(squares)))


def test_adaptive_r_does_as_well_as_the_known_variance_after_a_jump():
    known, adapted, stale = _f_error(False, 1e-2), _f_error(True, None), _f_error(False, None)
    assert adapted < 1.1 * known
    assert stale > 2.0 * known


@pytest.mark.parametrize("change", [{"q_per_step": 0.0}, {"r_first": -1.0}, {"dt_s": float("nan")}, {"fading": "some"}])
def test_impossible_parameters_are_refused(change):
    with pytest.raises(ConfigError, match=r"eskf\."):
        eskf.KfParams(**change)


def test_a_per_step_delta_has_no_riccati_limit():
    with pytest.raises(ConfigError, match="schedule"):
        eskf.limit(eskf.gains(eskf.KfParams(fading="per-step")))
