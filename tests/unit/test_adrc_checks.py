"""adrc_checks: the numbers of the method's note, and what is refused."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad import adrc_checks as checks
from mavquad import airframe
from mavquad.errors import ConfigError
from mavquad.estimate import leso

B27 = leso.continuous_gains(27.0)


@given(wc=st.floats(0.5, 10.0), w0=st.floats(12.0, 60.0))
def test_the_paper_s_matrix_has_the_poles_of_law_and_observer(wc, w0):
    got = np.poly(checks.nominal(wc, leso.continuous_gains(w0)))
    np.testing.assert_allclose(got, np.poly([-wc, -wc, -w0, -w0, -w0]), rtol=1e-8)


@pytest.mark.parametrize(
    ("lag", "model", "g", "gain", "expected"),
    [
        (0.03, False, 0.0, 1.0, 0.16),
        (0.03, False, 0.6, 1.0, 0.11),
        (0.03, False, 1.0, 1.0, 0.05),
        (0.03, True, 0.0, 1.0, 0.71),
        (0.03, True, 1.0, 1.0, 0.71),
        (0.03, True, 1.0, 1.3, 0.26),
        (0.05, True, 1.0, 1.0, 0.47),
    ],
)
def test_least_damping_with_a_motor_is_the_note_s(lag, model, g, gain, expected):
    poles = checks.with_motor(8.0, B27, lag, g, 0.03, model, gain)
    assert checks.damping(poles) == pytest.approx(expected, abs=0.01)


def test_without_a_motor_model_the_loop_is_refused_and_with_one_it_is_not():
    bare = checks.motor_checks("roll", 8.0, 27.0, B27, 0.03, 1.0, 0.03, model=False)
    with pytest.raises(ConfigError, match=r"roll: motor, \+30 % input: .* give the observers a motor model"):
        checks.enforce(bare)
    assert checks.enforce(checks.motor_checks("roll", 8.0, 27.0, B27, 0.03, 1.0, 0.03, model=True)) == []
    assert not [f for f in bare if f.name.endswith("nominal") and f.verdict == "ok"]


def _steady(q_rate, sigma, sigma_rate, dt=0.005):
    return checks.steady_gains((1e-6, q_rate), (sigma**2, None if sigma_rate is None else sigma_rate**2), dt)


DEG = math.radians(1.0)


@pytest.mark.parametrize(
    ("w0", "kalman", "expected"),
    [
        (20.0, _steady(0.3, 0.01, None), 0.46),
        (27.0, _steady(1.0, 0.2 * DEG, None), 0.71),
        (20.0, _steady(0.003, 0.01, 0.03), 0.80),
        (27.0, _steady(0.003, 0.2 * DEG, 0.01), 0.82),
        (20.0, _steady(0.1, 0.1, None), 0.15),
        (27.0, _steady(1.0, 2.0 * DEG, None), 0.27),
    ],
)
def test_damping_of_the_joint_observer_is_the_note_s(w0, kalman, expected):
    assert checks.damping(checks.joint_poles(w0, kalman)) == pytest.approx(expected, abs=0.01)
    verdict = checks.joint_check("z", w0, kalman).verdict
    assert verdict == ("warn" if expected < 0.3 else "ok")


@pytest.mark.parametrize(("w0", "bandwidth", "real"), [(20.0, 10.0, 1.1), (27.0, 10.0, 2.3), (27.0, 20.0, None)])
def test_feeding_the_compensated_disturbance_needs_a_filter_twice_as_fast(w0, bandwidth, real):
    kalman = (math.sqrt(2.0) * bandwidth, bandwidth**2, 0.0, 0.0)
    found = checks.joint_check("z", w0, kalman, compensated=True)
    if real is None:
        assert found.verdict == "warn"
        assert found.value == pytest.approx(0.01, abs=0.005)
        return
    assert found.verdict == "refuse"
    assert found.value == pytest.approx(real, abs=0.05)
    with pytest.raises(ConfigError, match="too slow"):
        checks.enforce([found])


def test_an_observer_too_close_to_its_controller_warns_then_is_refused():
    assert checks.separation("z", 2.0, 7.0).verdict == "ok"
    assert "below 3 wc" in checks.enforce([checks.separation("z", 2.0, 5.0)])[0]
    with pytest.raises(ConfigError, match=r"below 1.5 wc \(2\); raise w0"):
        checks.enforce([checks.separation("z", 2.0, 2.9)])


def test_late_measurements_leave_the_attitude_loop_to_the_autopilot():
    assert checks.latency_advice(0.015) == ""
    assert checks.latency_advice(0.035) == "measured latency 35 ms is above 20 ms: the attitude loop is left to the autopilot"


def test_the_paper_s_literal_inertias_are_impossible_and_refused_with_the_bound():
    rotors = airframe.Rotors(layout="plus", arm_m=0.2575, thrust_max_n=2.2, torque_per_thrust_m=0.016, lag_s=0.03)
    response = airframe.AttitudeResponse(natural_frequency_rad_s=15.0, damping=0.8)
    with pytest.raises(ConfigError, match=r"0.4 kg.*0.01326|sum of the two others"):
        airframe.Airframe(
            name="paper", body=airframe.Body(0.4, (2.0, 0.0552, 0.1165)), attitude=response, hover_thrust=0.45, rotors=rotors
        )
