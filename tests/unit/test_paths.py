"""Paths: derivatives against differences, rest at both ends, and the sizes the scenarios promise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad import paths
from mavquad.errors import ConfigError

PATHS = {
    "hover": paths.Path(name="hover", duration_s=30.0),
    "circle": paths.Path(name="circle", radius_m=3.0, speed_m_s=2.0, turns=2.0),
    "spiral": paths.Path(name="spiral", turns=1.0),
    "rectangle": paths.Path(name="rectangle", speed_m_s=1.0),
    "line": paths.Path(name="line", speed_m_s=12.0, accel_m_s2=2.5),
    "ellipse": paths.Path(name="ellipse", speed_m_s=8.0, accel_m_s2=2.0, course_deg=30.0),
    "short line": paths.Path(name="line", length_m=2.0, speed_m_s=12.0, accel_m_s2=2.5),
}


@pytest.mark.parametrize("name", PATHS)
@given(at=st.floats(-0.1, 1.1))
def test_each_derivative_is_the_slope_of_the_one_before(name, at):
    plan = paths.plan(PATHS[name])
    t, h = at * plan.duration_s, 1e-4
    before, here, after = (np.array(paths.evaluate(plan, x)) for x in (t - h, t, t + h))
    for order in range(3):
        slope = (after[order] - before[order]) / (2 * h)
        bound = 3e-3 if order == 2 else 1e-4  # the jerk has corners at the joints of the ramp
        assert np.allclose(slope, here[order + 1], atol=bound), order


@pytest.mark.parametrize("name", PATHS)
def test_a_path_starts_and_ends_at_rest_and_closed(name):
    plan = paths.plan(PATHS[name])
    for t in (0.0, plan.duration_s, plan.duration_s + 5.0):
        p, v, a, _ = paths.evaluate(plan, t)
        np.testing.assert_allclose((p, v, a), 0.0, atol=1e-9)


@pytest.mark.parametrize(("name", "speed", "accel"), [("line", 12.0, 2.5), ("rectangle", 1.0, 1.0), ("short line", None, 2.5)])
def test_speed_and_acceleration_reach_their_limits_and_no_more(name, speed, accel):
    plan = paths.plan(PATHS[name])
    samples = np.array([paths.evaluate(plan, t) for t in np.linspace(0, plan.duration_s, 4001)])
    if speed is not None:
        assert np.linalg.norm(samples[:, 1], axis=1).max() == pytest.approx(speed, rel=1e-6)
    assert np.linalg.norm(samples[:, 2], axis=1).max() == pytest.approx(accel, rel=1e-3)


def test_the_circle_is_a_circle_and_the_spiral_climbs_four_metres():
    plan = paths.plan(PATHS["circle"])
    points = np.array([paths.evaluate(plan, t)[0] for t in np.linspace(0, plan.duration_s, 500)])
    np.testing.assert_allclose(np.linalg.norm(points - [0, 3, 0], axis=1), 3.0, atol=1e-12)
    plan = paths.plan(PATHS["spiral"])
    points = np.array([paths.evaluate(plan, t)[0] for t in np.linspace(0, plan.duration_s, 500)])
    assert points[:, 2].min() == pytest.approx(-4.0, abs=1e-3)
    assert np.ptp(points[:, 0]) == pytest.approx(1.0, abs=1e-3)


def test_impossible_values_are_refused():
    with pytest.raises(ConfigError, match="path.radius_m = -1"):
        paths.Path(name="circle", radius_m=-1)
    with pytest.raises(ConfigError, match="at most 30 m/s"):
        paths.Path(name="line", speed_m_s=100.0)
