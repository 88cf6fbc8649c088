"""Han's ADRC kernels against his definitions, written out with numpy, and against what they are for."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad.control import adrc
from mavquad.errors import ConfigError

G = adrc.gains(adrc.HanParams(h_s=0.01))
numbers = st.floats(-5.0, 5.0)


@given(e=numbers, alpha=st.floats(0.1, 1.0), delta=st.floats(1e-3, 0.5))
def test_fal_is_odd_continuous_and_a_power_outside_its_linear_part(e, alpha, delta):
    assert adrc.fal(-e, alpha, delta) == -adrc.fal(e, alpha, delta)
    expected = np.sign(e) * abs(e) ** alpha if abs(e) > delta else e * delta ** (alpha - 1.0)
    assert adrc.fal(e, alpha, delta) == pytest.approx(expected, rel=1e-12, abs=1e-15)
    assert adrc.fal(delta * (1 + 1e-9), alpha, delta) == pytest.approx(adrc.fal(delta, alpha, delta), rel=1e-8)


def test_observer_gains_follow_han_s_rule():
    assert G.b == pytest.approx((1.0, 5.0, 2.0 / (25 * 0.01**1.2)), rel=1e-12)
    assert G.b[2] == pytest.approx(20.1, abs=0.05)


@given(x1=numbers, x2=numbers)
def test_fhan_never_exceeds_r_and_is_odd(x1, x2):
    u = adrc.fhan(x1, x2, 200.0, 0.05)
    assert abs(u) <= 200.0 + 1e-9
    assert adrc.fhan(-x1, -x2, 200.0, 0.05) == pytest.approx(-u, abs=1e-9)


def test_the_differentiator_reaches_a_step_without_overshoot_in_the_time_optimal_time():
    x, path = (0.0, 0.0), []
    for _ in range(200):
        x = adrc.differentiate(G, x, 1.0)
        path.append(x[0])
    assert max(path) < 1.0 + 1e-3
    assert abs(path[-1] - 1.0) < 1e-6
    fastest = 2.0 * math.sqrt(1.0 / 200.0)  # bang-bang over 1 m at 200 m/s^2: 0.14 s
    arrival = 0.01 * next(k for k, value in enumerate(path) if value > 0.95)
    assert fastest * 0.8 < arrival < fastest + 3 * 0.05  # h0 = 0.05 s of smoothing


def test_the_loop_cancels_a_disturbance_it_is_never_told_of():
    state, truth, d = adrc.init(0.0), np.array([0.0, 0.0]), -3.0
    z, x = state
    for _ in range(600):
        a = adrc.feedback(G, x, z)
        z = adrc.observe(G, z, truth[0], a)
        x = adrc.differentiate(G, x, 0.5)
        truth = np.array([truth[0] + 0.01 * truth[1] + 0.5e-4 * (a + d), truth[1] + 0.01 * (a + d)])
    assert abs(truth[0] - 0.5) < 0.01
    assert z[2] == pytest.approx(d, abs=0.3)  # the nonlinear observer ripples around the truth


@pytest.mark.parametrize(("name", "value"), [("h_s", 0.0), ("r_rad_s2", -1.0), ("delta_observer", float("nan"))])
def test_impossible_settings_are_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=f"adrc.{name}"):
        adrc.HanParams(**{"h_s": 0.01, name: value})
