"""MAVLink fields into signals: units, signs, refusals; the wrap of 32-bit stamps; integers inside floats."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mavquad import wire
from mavquad.errors import LinkError
from mavquad.link import health, signals
from mavquad.signals import Setpoint

angles = st.floats(-3.0, 3.0)


def message(name, *fields):
    return next(wire.parse(wire.encode(name, fields, seq=0, system=1, component=1)))[1]


@given(roll=angles, pitch=st.floats(-1.5, 1.5), yaw=angles)
def test_euler_angles_of_attitude_are_zyx(roll, pitch, yaw):
    sample = signals.attitude(message("ATTITUDE", 1234, roll, pitch, yaw, 0.1, 0.2, 0.3))
    x, y, z, w = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
    sign = math.copysign(1.0, w * sample.q_wxyz[0] + x * sample.q_wxyz[1] + y * sample.q_wxyz[2] + z * sample.q_wxyz[3])
    assert sample.q_wxyz == pytest.approx((sign * w, sign * x, sign * y, sign * z), abs=1e-6)
    assert sample.t_us == 1_234_000
    assert sample.omega_rad_s == pytest.approx((0.1, 0.2, 0.3))


def test_a_quaternion_is_made_unit_and_a_wrong_one_refused_with_its_norm():
    sample = signals.attitude_quaternion(message("ATTITUDE_QUATERNION", 10, 1.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (0.0,) * 4))
    assert sample.q_wxyz == (1.0, 0.0, 0.0, 0.0)
    for q in ((0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 0.0), (math.inf, 0.0, 0.0, 0.0)):
        with pytest.raises(LinkError, match=r"ATTITUDE_QUATERNION at 10 ms has \|q\| = .*expected 1"):
            signals.attitude_quaternion(message("ATTITUDE_QUATERNION", 10, *q, 0.0, 0.0, 0.0, (0.0,) * 4))


def test_anything_not_finite_is_refused_whole():
    with pytest.raises(LinkError, match="LOCAL_POSITION_NED at 20 ms holds nan"):
        signals.position(message("LOCAL_POSITION_NED", 20, 0.0, 0.0, math.nan, 0.0, 0.0, 0.0))
    with pytest.raises(LinkError, match="HIGHRES_IMU at 20 us holds inf"):
        signals.imu(message("HIGHRES_IMU", 20, 0.0, 0.0, -9.8, 0.0, math.inf, 0.0, *(0.0,) * 7, 0, 0))


@pytest.mark.parametrize(
    ("decode", "name", "fields"),
    [
        (signals.imu, "HIGHRES_IMU", (0.0, 0.0, -9.8, *(0.0,) * 10, 0, 0)),
        (signals.mocap, "ATT_POS_MOCAP", ((1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, (0.0,) * 21)),
        (signals.controls, "ACTUATOR_CONTROL_TARGET", (0, (0.0,) * 8)),
    ],
)
def test_a_stamp_of_64_bits_that_no_clock_shows_is_refused(decode, name, fields):
    assert decode(message(name, (1 << 62) - 1, *fields)).t_us == (1 << 62) - 1
    for us in (1 << 62, (1 << 63) + 5, (1 << 64) - 1):  # kernels count in signed 64 bits
        with pytest.raises(LinkError, match=rf"{name} is stamped {us} us, expected below 2\^62; sample refused"):
            decode(message(name, us, *fields))


def test_pwm_becomes_zero_to_one():
    sample = signals.motors(message("SERVO_OUTPUT_RAW", 7, 0, 1000, 1500, 2000, 900, *(0,) * 12))
    assert sample.command == (0.0, 0.5, 1.0, 0.0)


@given(full=st.integers(0, 10 * 2**32), off=st.integers(-(10**9), 10**9))
def test_a_wrapped_stamp_is_found_again(full, off):
    assert signals.unwrap_us(full % 2**32, full + off) == full


@given(value=st.integers(-(2**31), 2**31 - 1))
def test_integers_travel_inside_floats_bit_for_bit(value):
    packed = signals.float_of_int(value, 6)
    if not math.isnan(packed):  # a NaN's payload is not promised by every float conversion
        assert signals.int_of_float(packed, 6) == value


def test_a_setpoint_with_attitude_only_carries_no_rates():
    wanted = Setpoint((1.0, 0.0, 0.0, 0.0), (0.5, 0.5, 0.5), 0.4, 7)
    assert signals.attitude_setpoint(99, 1, 1, wanted)[5:9] == (0.0, 0.0, 0.0, 0.4)
    assert signals.attitude_setpoint(99, 1, 1, wanted._replace(type_mask=128))[5:8] == (0.5, 0.5, 0.5)


@given(lost=st.integers(0, 100), n=st.integers(2, 40))
def test_sequence_gaps_are_counted_as_loss(lost, n):
    source, seq = None, 250
    for k in range(n):
        if k == n // 2:
            seq += lost
        source = health.on_frame(source, seq & 0xFF)
        seq += 1
    assert source.lost == (lost if n // 2 > 0 else 0)
    assert source.received == n


def test_a_late_frame_is_no_loss():
    source = None
    for seq in (0, 1, 3, 2, 4):
        source = health.on_frame(source, seq)
    assert (source.received, source.lost) == (5, 0)


def test_rate_age_and_jitter_of_a_stream():
    stream = None
    for k in range(100):
        stream = health.on_message(stream, 10_000 * k)
    assert health.rate_hz(stream) == pytest.approx(100.0)
    assert stream.jitter_us == pytest.approx(0.0)
    assert health.age_s(stream, 10_000 * 99 + 500_000) == pytest.approx(0.5)
