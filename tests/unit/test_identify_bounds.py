"""Bounds from a made-up calibration flight whose errors are known, and the filter itself as the judge."""

import numpy as np
import pytest

from mavquad.errors import LogError
from mavquad.identify import bounds
from mavquad.identify.bounds import Calm
from mavquad.identify.timebase import Held

G = 9.80665
TAU_S = 0.15


def flight(seconds=60.0, e_v=0.05, e_f=0.2, e_att=0.004, seed=1, dips=False):
    """Roll and pitch follow their commands through a first-order lag; f turns slowly; errors are uniform and bounded.

    dips: each 5 s the thrust falls short for 0.1 s by up to 1.2 m/s^2, at 0.6 m/s^2 a tick."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, bounds.TICK_S)
    command = np.column_stack([0.15 * np.sin(0.6 * t), 0.15 * np.sin(0.45 * t + 1.0)])
    euler = np.zeros((t.size, 3))
    decay = np.exp(-bounds.TICK_S / TAU_S)
    for k in range(1, t.size):
        euler[k, :2] = decay * euler[k - 1, :2] + (1.0 - decay) * command[k - 1]
    f = np.column_stack([np.sin(0.3 * t), np.cos(0.25 * t), 0.3 * np.sin(0.2 * t)])
    if dips:
        into = np.mod(t, 5.0)
        f[:, 2] += np.clip(np.minimum(into, 0.1 - into) / bounds.TICK_S * 0.6, 0.0, 1.2)
    rotation = bounds._rotations(euler)
    thrust = np.full(t.size, G)
    a = -rotation[:, :, 2] * thrust[:, None] + np.array([0.0, 0.0, G]) + f
    v = np.cumsum(a, axis=0) * bounds.TICK_S
    body = np.einsum("nji,nj->ni", rotation, a - np.array([0.0, 0.0, G]))
    euler[:, :2] += rng.uniform(-e_att, e_att, (t.size, 2))
    return Calm(
        t,
        euler,
        body + rng.uniform(-e_f, e_f, body.shape),
        v + rng.uniform(-e_v, e_v, v.shape),
        Held(t, command[:, 0]),
        Held(t, command[:, 1]),
        Held(np.array([0.0]), np.array([G])),
        TAU_S,
        0.0,
        0.0,
    )


def test_the_bounds_hold_what_was_there_and_not_much_more():
    found = bounds.bounds(flight())
    for key, truth in (("e_velocity_m_s", 0.05), ("e_acceleration_m_s2", 0.2), ("e_attitude_rad", 0.004)):
        assert truth <= found[key].value < 2.2 * truth, key
        assert 0.0 < found[key].at_s < 60.0
    # f turns at 0.3 m/s^3; a change of the noise within a tick (at most 0.2 * 2 along an axis, and its box is turned) could be the force
    assert 0.3 * bounds.TICK_S <= found["b_f_m_s2"].value < bounds.MARGIN * (0.3 * bounds.TICK_S + 2.2 * 0.2)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_force_faster_than_the_smoothing_stays_within_the_bound_of_its_change(seed):
    assert bounds.bounds(flight(dips=True, seed=seed))["b_f_m_s2"].value >= 0.6
    assert bounds.bounds(flight(dips=True, seed=seed, e_f=0.01))["b_f_m_s2"].value >= 0.6


def test_more_noise_gives_wider_bounds():
    quiet, loud = bounds.bounds(flight()), bounds.bounds(flight(e_v=0.1, e_f=0.4, e_att=0.008))
    assert all(loud[key].value > quiet[key].value for key in ("e_velocity_m_s", "e_acceleration_m_s2", "e_attitude_rad"))


def test_widening_touches_only_what_is_named():
    found = bounds.bounds(flight())
    wider = bounds.widened(found, ("e_velocity_m_s",), 1.5)
    assert wider["e_velocity_m_s"].value == pytest.approx(1.5 * found["e_velocity_m_s"].value)
    assert wider["b_f_m_s2"] == found["b_f_m_s2"]


def test_a_short_flight_is_refused():
    with pytest.raises(LogError, match="needs 30 s with manoeuvres"):
        bounds.bounds(flight(seconds=20.0))
