"""The gate's numbers one by one, so that no sign, comparison or constant in it can change unseen (`make mutate-limits`)."""

import math

import pytest

from mavquad import quat
from mavquad.errors import ConfigError
from mavquad.setpoint import limits
from mavquad.signals import Setpoint

GAINS = limits.gains(limits.Limits())
ZERO = (0.0, 0.0, 0.0)
LEVEL = Setpoint((1.0, 0.0, 0.0, 0.0), ZERO, 0.5, 7)


def out(q=LEVEL.q_wxyz, w=ZERO, thrust=0.5, dt_s=0.1, last=LEVEL, gains=GAINS):
    return limits.apply(gains, last, Setpoint(q, w, thrust, 7), dt_s)


def test_bits_and_defaults():
    bits = (limits.NOT_FINITE, limits.TILT, limits.RATE, limits.THRUST, limits.TURN, limits.THRUST_SLEW, limits.STICK)
    assert bits == (1, 2, 4, 8, 16, 32, 64)
    d = limits.Limits()
    assert (d.tilt_deg, d.rate_deg_s, d.turn_deg_s) == (40.0, 200.0, 400.0)
    assert (d.thrust_min, d.thrust_max, d.thrust_slew_per_s) == (0.08, 0.95, 8.0)
    assert pytest.approx(math.cos(math.radians(40.0))) == GAINS.cos_tilt


@pytest.mark.parametrize(
    ("key", "most"), [("tilt_deg", 60.0), ("rate_deg_s", 720.0), ("turn_deg_s", 2000.0), ("thrust_slew_per_s", 100.0)]
)
def test_the_bounds_of_the_bounds(key, most):
    assert getattr(limits.Limits(**{key: most}), key) == most
    assert getattr(limits.Limits(**{key: 0.02}), key) == 0.02
    for bad in (0.0, -1.0, most + 0.01, math.nan):
        with pytest.raises(ConfigError, match=key):
            limits.Limits(**{key: bad})


def test_the_bounds_of_thrust():
    assert limits.Limits(thrust_min=0.0, thrust_max=1.0).thrust_max == 1.0
    for low, high in ((-0.01, 0.9), (0.1, 1.01), (0.5, 0.5), (0.6, 0.5), (math.nan, 0.5)):
        with pytest.raises(ConfigError, match="thrust_min"):
            limits.Limits(thrust_min=low, thrust_max=high)


@pytest.mark.parametrize(("size", "taken"), [(0.49, False), (0.51, True), (1.99, True), (2.01, False)])
def test_a_quaternion_of_about_unit_size_is_made_one(size, taken):
    wanted = quat.from_euler(0.2, 0.1, 0.3)
    found, bits = out(tuple(size * x for x in wanted))
    assert bits == (0 if taken else limits.NOT_FINITE)
    assert found.q_wxyz == pytest.approx(wanted if taken else LEVEL.q_wxyz)


@pytest.mark.parametrize(
    ("dt_s", "counted_s"), [(0.05, 0.05), (0.095, 0.095), (0.1, 0.1), (0.5, 0.1), (0.0, 0.0), (-1.0, 0.0), (math.nan, 0.0)]
)
def test_slew_over_the_time_that_counts(dt_s, counted_s):
    found, _ = out(thrust=0.95, dt_s=dt_s, last=LEVEL._replace(thrust=0.1))
    assert found.thrust == pytest.approx(min(0.95, 0.1 + 8.0 * counted_s))
    found, _ = out(thrust=0.08, dt_s=dt_s, last=LEVEL._replace(thrust=0.95))
    assert found.thrust == pytest.approx(max(0.08, 0.95 - 8.0 * counted_s))
    found, _ = out(quat.from_euler(0.6, 0.0, 0.0), dt_s=0.2 * counted_s)
    assert quat.to_euler(found.q_wxyz)[0] == pytest.approx(min(0.6, 400.0 * 0.2 * counted_s * math.pi / 180.0))


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_turn_about_each_axis_goes_the_way_it_was_wanted(axis, sign):
    step = tuple(0.3 * sign if i == axis else 0.0 for i in range(3))
    last = LEVEL._replace(q_wxyz=quat.from_euler(0.1, -0.05, 0.4))
    found, bits = out(quat.mul(last.q_wxyz, quat.exp(step)), dt_s=0.01, last=last)
    assert bits == limits.TURN
    turned = quat.log(quat.mul(quat.conj(last.q_wxyz), found.q_wxyz))
    assert turned == pytest.approx([math.radians(4.0) * sign if i == axis else 0.0 for i in range(3)], abs=1e-12)


@pytest.mark.parametrize("rates", [(5.0, 0.0, 0.0), (0.0, -5.0, 0.0), (0.0, 0.0, 5.0), (3.0, -2.5, 2.0), (1.9, 1.9, 1.9)])
def test_rates_are_shortened_along_themselves(rates):
    found, bits = out(w=rates)
    size = math.hypot(*rates)
    assert bits == (limits.RATE if size > math.radians(200.0) else 0)
    assert found.omega_rad_s == pytest.approx([x * min(1.0, math.radians(200.0) / size) for x in rates])


@pytest.mark.parametrize("at", [0, 1, 2])
def test_one_rate_that_is_not_finite_stops_all(at):
    found, bits = out(w=tuple(math.inf if i == at else 1.0 for i in range(3)))
    assert (found.omega_rad_s, bits) == (ZERO, limits.NOT_FINITE)


@pytest.mark.parametrize(("deg", "bit"), [(39.9, 0), (40.1, limits.TILT), (-39.9, 0), (-40.1, limits.TILT)])
@pytest.mark.parametrize("pitch", [False, True])
def test_tilt_about_both_axes(deg, bit, pitch):
    a = math.radians(deg)
    wanted = quat.from_euler(0.0, a, 0.0) if pitch else quat.from_euler(a, 0.0, 0.0)
    near = quat.from_euler(0.0, 0.9 * a, 0.0) if pitch else quat.from_euler(0.9 * a, 0.0, 0.0)
    found, bits = out(wanted, last=LEVEL._replace(q_wxyz=near))
    assert bits == bit
    most = math.copysign(min(abs(a), math.radians(40.0)), a)
    assert quat.to_euler(found.q_wxyz)[1 if pitch else 0] == pytest.approx(most)


def test_exactly_upside_down_keeps_what_was_sent():
    last = LEVEL._replace(q_wxyz=(0.0, 1.0, 0.0, 0.0))
    found, bits = out((0.0, 1.0, 0.0, 0.0), last=last)
    assert bits == limits.TILT
    assert found.q_wxyz == last.q_wxyz
    last = LEVEL._replace(q_wxyz=(0.0, 0.6, 0.8, 0.0))
    assert out((1e-4, 0.6, 0.8, 0.0), last=last)[0].q_wxyz == pytest.approx(
        (math.cos(math.radians(20.0)), 0.6 * math.sin(math.radians(20.0)), 0.8 * math.sin(math.radians(20.0)), 0.0)
    )


def test_bits_add_up_and_the_mask_is_kept():
    found, bits = limits.apply(GAINS, LEVEL, Setpoint((math.nan,) * 4, (9.0, 0.0, 0.0), math.nan, 128), 0.1)
    assert bits == limits.NOT_FINITE | limits.RATE
    assert (found.type_mask, found.thrust) == (128, 0.5)
    low = LEVEL._replace(thrust=0.9)
    assert out(thrust=2.0, dt_s=0.05, last=low)[1] == limits.THRUST_SLEW | limits.THRUST


@pytest.mark.parametrize(
    ("dt_s", "most"), [(0.01, 0.2), (0.04, 0.8), (0.1, 2.0), (0.5, 2.0), (0.0, 0.0), (-1.0, 0.0), (math.nan, 0.0)]
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_stick_moves_no_faster_than_it_may(dt_s, most, sign):
    last = (-sign, -0.5 * sign, 0.0, 0.25 * sign)
    found, bits = limits.sticks(last, (sign, sign, sign, sign), dt_s)
    assert found == pytest.approx([sign * min(1.0, sign * x + most) for x in last])
    assert bits == (0 if most == 2.0 else limits.STICK)


@pytest.mark.parametrize("i", range(4))
def test_a_stick_stays_inside_its_travel(i):
    for last in (None, (0.9, 0.9, 0.9, 0.9)):
        wanted = tuple(1.2 if j == i else 0.9 for j in range(4))
        assert limits.sticks(last, wanted, 0.1) == (tuple(1.0 if j == i else 0.9 for j in range(4)), limits.STICK)
    wanted = tuple(-1.2 if j == i else 0.0 for j in range(4))
    assert limits.sticks(None, wanted, 0.0) == (tuple(-1.0 if j == i else 0.0 for j in range(4)), limits.STICK)
    inside = tuple(0.4 if j == i else -0.3 for j in range(4))
    assert limits.sticks(None, inside, 0.0) == (inside, 0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_stick_that_is_no_number_stays_where_it_was(bad):
    assert limits.sticks((0.1, 0.2, 0.3, 0.4), (bad, 0.2, 0.3, 0.4), 0.1) == ((0.1, 0.2, 0.3, 0.4), limits.NOT_FINITE)
    assert limits.sticks(None, (0.1, bad, 0.3, 0.4), 0.1) == ((0.1, 0.0, 0.3, 0.4), limits.NOT_FINITE)
    assert limits.sticks((0.0,) * 4, (bad, 1.0, 0.0, 0.0), 0.01)[1] == limits.NOT_FINITE | limits.STICK


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.0, 3.0])
def test_a_lean_too_far_keeps_its_heading_and_its_direction(yaw):
    wanted = quat.from_euler(0.9, 0.0, yaw)
    last = LEVEL._replace(q_wxyz=quat.from_euler(0.6, 0.0, yaw))
    found, bits = out(wanted, last=last)
    assert bits == limits.TILT
    assert found.q_wxyz == pytest.approx(quat.from_euler(math.radians(40.0), 0.0, yaw), abs=1e-12)


def test_upside_down_to_a_billionth_has_no_heading_to_keep():
    last = LEVEL._replace(q_wxyz=(0.0, 1.0, 0.0, 0.0))
    nearly, bits = out((9.5e-10, 1.0, 0.0, 0.0), last=last)
    assert (nearly.q_wxyz, bits) == (last.q_wxyz, limits.TILT)
    found, _ = out((1.1e-9, 1.0, 0.0, 0.0), last=last)
    assert found.q_wxyz == pytest.approx((math.cos(math.radians(20.0)), math.sin(math.radians(20.0)), 0.0, 0.0))
