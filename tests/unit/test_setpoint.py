"""From acceleration to attitude, and the gate that trusts nobody."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad import quat
from mavquad.errors import ConfigError
from mavquad.setpoint import attitude, limits
from mavquad.signals import Setpoint

GAINS = limits.gains(limits.Limits())
LEVEL = Setpoint((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, 7)
anything = st.floats(allow_nan=True, allow_infinity=True)
accels = st.tuples(st.floats(-8, 8), st.floats(-8, 8), st.floats(-6, 6))


@given(a=accels, yaw=st.floats(-math.pi, math.pi))
def test_the_attitude_pushes_where_the_acceleration_was_wanted(a, yaw):
    thrust = attitude.thrust_vector(a, math.radians(60), 0.5, 20.0)
    q, size = attitude.attitude(thrust, yaw)
    z = quat.rotate(q, (0.0, 0.0, 1.0))
    np.testing.assert_allclose(np.multiply(size, z), thrust, atol=1e-12)
    assert math.remainder(quat.yaw(q) - yaw, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    assert quat.norm(q) == pytest.approx(1.0, abs=1e-14)


def test_signs_of_the_field():
    q, _ = attitude.attitude(attitude.thrust_vector((0.0, 2.0, 0.0), 0.7, 1.0, 20.0), 0.0)
    roll, pitch, _ = quat.to_euler(q)
    assert roll > 0.1, "roll + goes east at yaw 0"
    assert abs(pitch) < 1e-12
    q, _ = attitude.attitude(attitude.thrust_vector((-2.0, 0.0, 0.0), 0.7, 1.0, 20.0), 0.0)
    roll, pitch, _ = quat.to_euler(q)
    assert pitch > 0.1, "pitch + is nose up and goes backwards"
    assert abs(roll) < 1e-12


@given(a=accels)
def test_the_cone_keeps_the_vertical_part(a):
    n, e, d = attitude.thrust_vector(a, math.radians(30), 2.0, 16.0)
    assert 2.0 <= d <= 16.0
    assert math.hypot(n, e) <= d * math.tan(math.radians(30)) + 1e-12
    if 2.0 < 9.80665 - a[2] < 16.0:
        assert d == pytest.approx(9.80665 - a[2])


def _tilt(q):
    return math.acos(min(1.0, max(-1.0, 1 - 2 * (q[1] ** 2 + q[2] ** 2))))


@given(q=st.tuples(anything, anything, anything, anything), w=st.tuples(anything, anything, anything), t=anything, dt=anything)
def test_whatever_comes_in_what_goes_out_can_be_flown(q, w, t, dt):
    out, _ = limits.apply(GAINS, LEVEL, Setpoint(q, w, t, 7), dt)
    assert quat.norm(out.q_wxyz) == pytest.approx(1.0, abs=1e-9)
    assert _tilt(out.q_wxyz) <= math.radians(40.0) + 1e-9
    assert np.linalg.norm(out.omega_rad_s) <= math.radians(200.0) + 1e-9
    assert 0.08 <= out.thrust <= 0.95
    assert all(math.isfinite(x) for x in (*out.q_wxyz, *out.omega_rad_s, out.thrust))


@given(rolls=st.lists(st.floats(-3, 3), min_size=2, max_size=30), pitches=st.floats(-1.5, 1.5))
def test_a_chain_of_any_demands_stays_inside_tilt_and_turn(rolls, pitches):
    last = LEVEL
    for roll in rolls:
        out, _ = limits.apply(GAINS, last, Setpoint(quat.from_euler(roll, pitches, roll), (0.0, 0.0, 0.0), 0.5, 7), 0.02)
        turned = np.linalg.norm(quat.log(quat.mul(quat.conj(last.q_wxyz), out.q_wxyz)))
        assert turned <= math.radians(400.0) * 0.02 * 1.05  # the tilt limit, applied last, may add a little
        assert _tilt(out.q_wxyz) <= math.radians(40.0) + 1e-9
        last = out


@pytest.mark.parametrize(
    ("wanted", "bit", "check"),
    [
        ((quat.from_euler(0.3, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5), 0, lambda s: abs(quat.to_euler(s.q_wxyz)[0] - 0.3) < 1e-12),
        ((LEVEL.q_wxyz, (0.0, 9.0, 0.0), 0.5), limits.RATE, lambda s: abs(s.omega_rad_s[1] - math.radians(200)) < 1e-9),
        ((LEVEL.q_wxyz, (0.0, 0.0, 0.0), 1.0), limits.THRUST, lambda s: s.thrust == 0.95),
        ((LEVEL.q_wxyz, (0.0, 0.0, 0.0), 0.0), limits.THRUST, lambda s: s.thrust == 0.08),
        ((LEVEL.q_wxyz, (math.nan, 0.0, 0.0), 0.5), limits.NOT_FINITE, lambda s: s.omega_rad_s == (0.0, 0.0, 0.0)),
        (
            ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.6),
            limits.NOT_FINITE,
            lambda s: s.q_wxyz == LEVEL.q_wxyz and s.thrust == 0.6,
        ),
        ((LEVEL.q_wxyz, (0.0, 0.0, 0.0), math.nan), limits.NOT_FINITE, lambda s: s.thrust == 0.5),
    ],
)
def test_each_limit_acts_alone(wanted, bit, check):
    out, bits = limits.apply(GAINS, LEVEL, Setpoint(*wanted, 7), 0.1)
    assert bits == bit
    assert check(out)


def test_a_lean_beyond_the_limit_keeps_its_direction():
    last = LEVEL._replace(q_wxyz=quat.from_euler(0.4, 0.3, 1.0))
    wanted = quat.from_euler(0.7, 0.6, 1.0)
    out, bits = limits.apply(GAINS, last, Setpoint(wanted, (0.0, 0.0, 0.0), 0.5, 7), 0.1)
    assert bits == limits.TILT
    assert _tilt(out.q_wxyz) == pytest.approx(math.radians(40.0))
    assert out.q_wxyz[1] / out.q_wxyz[2] == pytest.approx(wanted[1] / wanted[2])
    assert out.q_wxyz[3] / out.q_wxyz[0] == pytest.approx(wanted[3] / wanted[0])


def test_thrust_and_attitude_are_slew_limited():
    out, bits = limits.apply(GAINS, LEVEL, LEVEL._replace(thrust=0.9), 0.01)
    assert (out.thrust, bits) == (pytest.approx(0.58), limits.THRUST_SLEW)
    out, bits = limits.apply(GAINS, LEVEL, LEVEL._replace(thrust=0.1), 0.01)
    assert (out.thrust, bits) == (pytest.approx(0.42), limits.THRUST_SLEW)
    out, bits = limits.apply(GAINS, LEVEL, LEVEL._replace(q_wxyz=quat.from_euler(0.5, 0.0, 0.0)), 0.01)
    assert (quat.to_euler(out.q_wxyz)[0], bits) == (pytest.approx(math.radians(4.0)), limits.TURN)


def test_impossible_limits_are_refused():
    with pytest.raises(ConfigError, match="tilt_deg = 90"):
        limits.Limits(tilt_deg=90.0)
    with pytest.raises(ConfigError, match="thrust_min = 0.9"):
        limits.Limits(thrust_min=0.9, thrust_max=0.5)
