import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad.errors import ConfigError
from mavquad.estimate import asmf, asmf_joint, ellipsoid, interval

DT_S = 0.02
F = np.array([[1.0, DT_S], [0.0, 1.0]])  # velocity and model error
C = np.array([[1.0, 0.0], [0.0, 1.0]])
ON_TIME = np.zeros(2)
BOUNDS = {"e": (0.06, 0.35), "b": (0.004, 0.12), "p0": (1.0, 25.0), "model_error": (1,)}


def make(**changes):
    return asmf.gains(asmf.Params(**{**BOUNDS, **changes}), C)


def fly(gains, steps, rng, spike=None, wrong_bound=1.0, form="strips"):
    """States, truths: a truth that keeps its bounds (times wrong_bound); spike(k) is added to the velocity output."""
    z = np.array([0.3, -0.5])
    state = asmf.init(gains, np.zeros(2))
    out = []
    for k in range(steps):
        z = F @ z + rng.uniform(-1, 1, 2) * np.array(BOUNDS["b"])
        y = z + wrong_bound * rng.uniform(-1, 1, 2) * gains.e
        y[0] += 0.0 if spike is None else spike(k)
        state = asmf.predict(gains, state, F, np.zeros(2), 1.0, k * 20_000)
        if form == "strips":
            state = asmf.update(gains, state, y, ON_TIME, k * 20_000)
        else:
            state = asmf_joint.update(gains, state, y, 2 * gains.e**2, True, form == "printed", k * 20_000)
        out.append((state, z))
    return out


def inside(state, z):
    return ellipsoid.form(state.x, state.p, z) <= 1.0


@pytest.mark.parametrize("form", ["strips", "joint", "printed"])
def test_truth_stays_inside_while_the_bounds_hold(form):
    flown = fly(make(), 400, np.random.default_rng(1), form=form)
    assert all(inside(state, z) for state, z in flown)
    assert flown[-1][0].empty == 0
    assert flown[-1][0].guarantee


def test_two_outliers_are_dropped_and_the_guarantee_returns_after_fifty_clean_updates():
    flown = fly(make(), 200, np.random.default_rng(2), spike=lambda k: 5.0 if k in (100, 101) else 0.0)
    states = [state for state, _ in flown]
    assert states[99].guarantee
    assert not states[100].guarantee
    assert states[101].n_bad[0] == 2
    assert states[101].inflations == 0
    assert not states[150].guarantee
    assert states[151].guarantee
    assert states[-1].empty == 2
    assert all(inside(state, z) for state, z in flown)


def test_the_third_contradiction_in_a_row_enlarges_the_set_until_it_fits():
    flown = fly(make(), 110, np.random.default_rng(3), spike=lambda k: 5.0 if k >= 100 else 0.0)
    before, after = flown[101][0], flown[102][0]
    assert (before.inflations, after.inflations) == (0, 1)
    assert after.n_bad[0] == 0
    assert abs(after.x[0] - flown[102][1][0]) > 1.0  # it follows the output: the model was declared wrong


def test_joint_inflation_reaches_delta_0_2():
    rng = np.random.default_rng(4)
    for _ in range(50):
        root = rng.normal(size=(5, 5))
        p, c, r, y = root @ root.T + 0.01 * np.eye(5), rng.normal(size=(3, 5)), rng.uniform(0.01, 1, 3), 30 * rng.normal(size=3)
        for scaled in (False, True):
            factor = asmf_joint.inflation_factor(np.zeros(5), p, c, y, r, scaled)
            delta = ellipsoid.joint(np.zeros(5), factor * p, c, y, r, scaled, False)
            assert abs(delta - 0.2) < 1e-6 or factor == 1.0
            assert factor >= 1.0


def test_a_joint_filter_survives_contradictions_without_nan():
    flown = fly(make(), 300, np.random.default_rng(5), lambda k: 9.0 if 100 <= k < 130 else 0.0, form="joint")
    last = flown[-1][0]
    assert last.inflations >= 1
    assert np.isfinite(last.p).all()
    assert not flown[120][0].guarantee
    assert inside(*flown[-1])


def test_wrong_bounds_are_visible():
    flown = fly(make(), 400, np.random.default_rng(6), wrong_bound=3.0)
    assert flown[-1][0].empty > 10
    assert not flown[-1][0].guarantee


def test_many_inflations_take_authority_and_widen_the_rate_of_f():
    state = asmf.init(make(), np.zeros(2))
    stamps = state.inflated_us.copy()
    for count, expected in ((5, 1.0), (6, 0.5), (20, 0.5), (21, 0.0)):
        stamps[:count] = 1_000_000
        state = state._replace(inflated_us=stamps)
        assert asmf.authority(state, 2_000_000) == expected
        assert asmf.authority(state, 11_000_001) == 1.0  # ten seconds later all is forgotten
    calm = asmf.predict(make(), state, F, np.zeros(2), 1.0, 12_000_000)
    alarmed = asmf.predict(make(), state, F, np.zeros(2), 1.0, 2_000_000)
    assert asmf.half_widths(alarmed)[1] > asmf.half_widths(calm)[1]


def test_a_missing_output_is_skipped_and_a_late_one_counts_less():
    gains = make(p0=(1.0, 1.0))
    state = asmf.init(gains, np.zeros(2))
    nothing = asmf.update(gains, state, np.array([math.nan, math.inf]), ON_TIME, 0)
    np.testing.assert_array_equal(nothing.p, state.p)
    assert nothing.empty == 0
    partial = asmf.update(gains, state, np.array([0.1, math.nan]), ON_TIME, 0)
    late = asmf.update(gains, state, np.array([0.1, math.nan]), np.array([0.5, 0.0]), 0)
    assert asmf.half_widths(partial)[0] < asmf.half_widths(late)[0] < asmf.half_widths(state)[0]


def test_the_step_leaves_its_input_alone():
    gains = make()
    state = asmf.init(gains, np.zeros(2))
    x, p = state.x.copy(), state.p.copy()
    asmf.update(gains, asmf.predict(gains, state, F, np.ones(2), 1.0, 0), np.array([0.1, 0.2]), ON_TIME, 0)
    np.testing.assert_array_equal(state.x, x)
    np.testing.assert_array_equal(state.p, p)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"e": (0.06, 0.0)}, r"asmf\.e = \(0\.06, 0\.0\)"),
        ({"e": (0.06, math.nan)}, r"asmf\.e"),
        ({"b": (-1.0, 0.1)}, r"asmf\.b"),
        ({"p0": (1.0,)}, r"asmf\.p0"),
        ({"p0": (1.0, -2.0)}, r"asmf\.p0"),
        ({"model_error": (2,)}, r"asmf\.model_error"),
        ({"e": (0.06,)}, r"C is 2 x 2"),
    ],
)
def test_impossible_bounds_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        make(**changes)


@given(seed=st.integers(0, 1000), square=st.booleans())
def test_interval_observer_holds_the_truth_and_its_width_is_bounded(seed, square):
    rng = np.random.default_rng(seed)
    e, b, truth, state = 0.35, 0.05, 0.0, interval.init()
    for k in range(200):
        truth += b * rng.uniform(-1, 1)
        side = (1.0 if (k // 10) % 2 else -1.0) if square else rng.uniform(-1, 1)
        noise = (e - 1e-12) * side  # at the bound itself rounding decides
        state = interval.update(interval.predict(state, b), truth + noise, e)
        assert state.low <= truth <= state.high
        assert state.high - state.low <= 2 * e + 2 * b
    assert state.empty == 0


def test_interval_observer_drops_spikes_and_opens_again_for_a_jump_that_stays():
    state = interval.update(interval.init(), 0.0, 0.3)
    assert interval.update(state, math.nan, 0.3) == state
    for _ in range(2):
        state = interval.update(interval.predict(state, 0.01), 5.0, 0.3)
        assert state.high < 0.4
    state = interval.update(interval.predict(state, 0.01), 5.0, 0.3)
    assert state.low < 0.0
    assert state.high == 5.3
    assert state.empty == 3


def test_intervals_that_share_nothing_give_their_hull_and_say_so():
    assert interval.cut(0.0, 2.0, 1.0, 3.0) == (1.0, 2.0, True)
    assert interval.cut(0.0, 1.0, 2.0, 3.0) == (0.0, 3.0, False)
