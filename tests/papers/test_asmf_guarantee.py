"""Design note of the ASMF, sections 6 and 10: containment over 10 seeds x 3000 steps, and what it costs to state a bound wrong."""

import numpy as np
import pytest

from tools.papers.active import guarantee

TABLE_STRIPS = np.array([1.5, 1.9, 1.4, 2.1, 1.3, 1.0])  # half-widths of f (u, q, v, p, w, r), uniform noise


@pytest.mark.parametrize("noise", guarantee.NOISES)
def test_strips_hold_the_truth_in_every_step_of_ten_seeds(noise):
    runs = [guarantee.contain("strips", noise, seed) for seed in range(1, 11)]
    assert all(run.inside_pct == 100.0 for run in runs)
    assert sum(run.empty for run in runs) == 0
    assert np.all(np.median([run.half_width for run in runs], axis=0) <= 1.1 * TABLE_STRIPS)
    errors = np.median([run.error for run in runs], axis=0)
    assert np.all(errors <= (0.08 if noise == "uniform" else 0.5))  # the centre is far better than its bound


@pytest.mark.parametrize("variant", ["printed", "corrected", "scaled"])
def test_every_joint_form_holds_the_truth_and_is_looser_than_strips(variant):
    for noise in guarantee.NOISES:
        joint, strips = (guarantee.contain(name, noise, 311) for name in (variant, "strips"))
        assert joint.inside_pct == 100.0
        assert joint.empty == 0
        assert np.all(joint.half_width > 1.2 * strips.half_width)


def test_bounds_without_the_dimension_factor_lose_the_truth_and_it_shows():
    for noise in guarantee.NOISES:
        run = guarantee.contain("R=diag(e2)", noise, 7)
        assert run.inside_pct < 50.0
        assert run.empty > 500


def test_an_error_on_every_state_is_not_observable_and_its_bounds_grow_without_end():
    short, whole = (guarantee.contain("Bf=I", "uniform", 5, steps=steps) for steps in (1500, 3000))
    assert whole.inside_pct == 100.0
    assert whole.half_width.max() > 2.0 * short.half_width.max() > 1e5


def test_the_interval_observer_is_tighter_than_the_ellipsoid_and_as_safe():
    for b_f, limit in ((0.12, 0.30), (0.05, 0.30)):
        found = guarantee.decoupled(b_f, 17)
        assert found["decoupled"][0] == found["interval"][0] == 100.0
        assert found["interval"][1] <= limit
        assert found["interval"][1] < 0.7 * found["decoupled"][1]
