"""Rates from quaternions: against spins whose rate is known, and a torque model against the one that made the data."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mavquad.errors import LogError
from tools import rates


def _record(omega, step_s=0.01):
    """Attitudes (n + 1, 4) of a body that turns with omega (n, 3) [rad/s], constant within each step, by scipy's rotations."""
    r = Rotation.from_euler("zyx", [0.4, -0.3, 0.2])
    quats = [r.as_quat(scalar_first=True)]
    for w in omega:
        r = r * Rotation.from_rotvec(w * step_s)
        quats.append(r.as_quat(scalar_first=True))
    return (np.arange(len(quats)) * round(step_s * 1e6)).astype(np.int64), np.array(quats)


def _swing(n=2000, step_s=0.01):
    t = step_s * np.arange(n)
    return np.column_stack([np.sin(2 * t), 0.7 * np.cos(3 * t), 0.3 * np.sin(t)])


def test_a_steady_spin_is_found_exactly_by_every_difference():
    w = np.array([0.5, -1.5, 2.0])
    a = rates.attitudes(*_record(np.tile(w, (50, 1))))
    np.testing.assert_allclose(rates.reference(a)[1:-1], np.tile(w, (49, 1)), atol=1e-12)
    np.testing.assert_allclose(rates.difference(a)[1:], np.tile(w, (50, 1)), atol=1e-12)
    np.testing.assert_allclose(rates.extrapolated(rates.difference(a))[1:], np.tile(w, (50, 1)), atol=1e-12)


def test_signs_that_flip_samples_that_repeat_and_broken_ones_change_nothing():
    t, q = _record(_swing(200))
    clean = rates.reference(rates.attitudes(t, q))
    flips = np.where(np.random.default_rng(1).random(len(q)) < 0.5, -1.0, 1.0)
    np.testing.assert_allclose(rates.reference(rates.attitudes(t, q * flips[:, None])), clean, atol=1e-12)
    order = np.sort(np.concatenate([np.arange(len(t)), [5, 17, 17]]))
    repeated = rates.attitudes(t[order], q[order])
    assert repeated.dropped == 3
    np.testing.assert_allclose(rates.reference(repeated), clean, atol=1e-12)
    broken = np.insert(q, 50, [np.nan, 0, 0, 0], axis=0)
    broken = np.insert(broken, 20, [0.0, 0, 0, 0], axis=0)
    stamps = np.insert(np.insert(t, 50, t[49] + 1), 20, t[19] + 1)
    np.testing.assert_allclose(rates.reference(rates.attitudes(stamps, broken)), clean, atol=1e-12)


def test_a_gap_has_no_reference_beside_it():
    t, q = _record(_swing(200))
    keep = np.ones(len(t), bool)
    keep[80:90] = False
    w = rates.reference(rates.attitudes(t[keep], q[keep]))
    assert np.isnan(w[79:81]).all()
    assert np.isfinite(w[1:78]).all()


def test_the_plain_difference_is_half_a_sample_late_and_extrapolation_mends_it():
    t, q = _record(_swing())
    a = rates.attitudes(t, q)
    plain = rates.difference(a)
    late = rates.rms(plain - rates.reference(a), np.ones(len(a.t_us), bool))
    mended = rates.rms(rates.extrapolated(plain) - rates.reference(a), np.ones(len(a.t_us), bool))
    # half a sample of 10 ms at a peak acceleration A w of 2, 2.1, 0.3 rad/s^2
    np.testing.assert_allclose(late, 0.005 * np.array([2.0, 2.1, 0.3]) / np.sqrt(2), rtol=0.05)
    assert max(mended) < 0.1 * max(late)


def test_a_butterworth_has_its_delay_and_passes_what_is_constant():
    t, q = _record(np.tile([1.0, 0.0, -2.0], (300, 1)))
    a = rates.attitudes(t, q)
    steady = rates.butterworth(a, rates.difference(a)[1:], 5.0)
    np.testing.assert_allclose(steady[-1], [1.0, 0.0, -2.0], atol=1e-9)
    t, q = _record(np.column_stack([0.01 * np.arange(400)] * 3) * [1, 0, 0])
    a = rates.attitudes(t, q)
    ramp = rates.difference(a)[1:]
    lag_s = (ramp - rates.butterworth(a, ramp, 5.0))[-1, 0] / 1.0
    assert lag_s == pytest.approx(np.sqrt(2) / (2 * np.pi * 5.0), rel=0.02)  # DC group delay of the note


def test_the_torque_model_that_made_the_data_is_found_again():
    n, step_s = 4000, 0.01
    u = 0.5 + 0.2 * np.sin(np.arange(n)[:, None] * step_s * np.array([3.0, 4.1, 5.3, 2.2]))
    A = np.array([[-30.0, 30.0, 30.0, -30.0], [30.0, -30.0, 30.0, -30.0], [4.0, 4.0, -4.0, -4.0]])
    accel = (u - 0.5) @ A.T
    t, q = _record(np.cumsum(accel, axis=0) * step_s)
    a = rates.attitudes(t, q)
    everything = np.ones(len(a.t_us), bool)
    model, torque = rates.fit_torque(a, t[:-1], u, everything)
    np.testing.assert_allclose(
        model.A, A, atol=0.5
    )  # the reference averages over two samples: a few per mille at these frequencies
    assert min(model.explained) > 0.99
    assert model.lag_s == 0.0
    np.testing.assert_allclose(torque[100:-100], accel[100:-99], atol=0.5)


def test_too_little_to_work_on_is_said():
    t, q = _record(_swing(300))
    with pytest.raises(LogError, match="at least 4"):
        rates.attitudes(t[:3], q[:3])
    a = rates.attitudes(t, q)
    with pytest.raises(LogError, match="do not move"):
        rates.fit_torque(a, t, np.full((len(t), 4), 0.5), np.ones(len(t), bool))
    with pytest.raises(LogError, match="at least 200"):
        rates.fit_torque(a, t, np.full((len(t), 4), 0.5), np.zeros(len(t), bool))
