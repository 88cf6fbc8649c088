"""MAVLink fields <-> signals: units and frames change here and nowhere else.

One function per message, one table. A message is taken whole or refused whole (LinkError).
"""

import math
import struct
from collections.abc import Callable
from typing import Any

from mavquad.errors import LinkError
from mavquad.signals import Attitude, Controls, Imu, Mocap, Motors, Position, Quat, Setpoint, Target

Sample = Attitude | Controls | Imu | Mocap | Motors | Position | Target
_SERVO_WRAP_US = 1 << 32
_END_US = 1 << 62  # stamps are added to and subtracted in 64 bits


def _unit(name: str, stamp: int, unit: str, q: Quat) -> Quat:
    w, x, y, z = q
    n2 = w * w + x * x + y * y + z * z
    if not 0.9 < n2 < 1.1:  # also NaN
        size = math.sqrt(n2) if n2 >= 0 else n2
        raise LinkError(f"{name} at {stamp} {unit} has |q| = {size:.4f}, expected 1 +/- 0.05; sample refused")
    k = 1.0 / math.sqrt(n2)
    return (k * w, k * x, k * y, k * z)


def _finite(name: str, stamp: int, unit: str, *values: float) -> None:
    if math.isfinite(sum(values)):
        return
    for value in values:
        if not math.isfinite(value):
            raise LinkError(f"{name} at {stamp} {unit} holds {value}, expected finite numbers; sample refused")


def _stamp(name: str, us: int) -> int:
    """A stamp of 64 bits. Raises LinkError for one that no clock shows."""
    if us >= _END_US:
        raise LinkError(f"{name} is stamped {us} us, expected below 2^62; sample refused")
    return us


def attitude_quaternion(m: Any) -> Attitude:
    """ATTITUDE_QUATERNION (#31): ms -> us; rates already rad/s in FRD, all NaN where the sender has no gyro."""
    ms, w, x, y, z, p, q, r = m[:8]
    if not (p != p and q != q and r != r):
        _finite("ATTITUDE_QUATERNION", ms, "ms", p, q, r)
    return Attitude(1000 * ms, _unit("ATTITUDE_QUATERNION", ms, "ms", (w, x, y, z)), (p, q, r))


def attitude(m: Any) -> Attitude:
    """ATTITUDE (#30): ZYX Euler angles; rates all NaN where the sender has no gyro."""
    rates = (m.rollspeed, m.pitchspeed, m.yawspeed)
    _finite("ATTITUDE", m.time_boot_ms, "ms", m.roll, m.pitch, m.yaw, *(() if all(w != w for w in rates) else rates))
    cr, sr = math.cos(0.5 * m.roll), math.sin(0.5 * m.roll)
    cp, sp = math.cos(0.5 * m.pitch), math.sin(0.5 * m.pitch)
    cy, sy = math.cos(0.5 * m.yaw), math.sin(0.5 * m.yaw)
    q = (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
    return Attitude(1000 * m.time_boot_ms, q, rates)


def mocap(m: Any) -> Mocap:
    """ATT_POS_MOCAP (#138): already us, NED, FRD."""
    _finite("ATT_POS_MOCAP", m.time_usec, "us", m.x, m.y, m.z)
    return Mocap(_stamp("ATT_POS_MOCAP", m.time_usec), _unit("ATT_POS_MOCAP", m.time_usec, "us", m.q), (m.x, m.y, m.z))


def imu(m: Any) -> Imu:
    """HIGHRES_IMU (#105): us, m/s^2, rad/s, FRD. Its magnetometer is not used."""
    us, ax, ay, az, p, q, r = m[:7]
    _finite("HIGHRES_IMU", us, "us", ax, ay, az, p, q, r)
    return Imu(_stamp("HIGHRES_IMU", us), (ax, ay, az), (p, q, r))


def position(m: Any) -> Position:
    """LOCAL_POSITION_NED (#32): ms -> us; metres, m/s."""
    ms, n, e, d, vn, ve, vd = m
    _finite("LOCAL_POSITION_NED", ms, "ms", n, e, d, vn, ve, vd)
    return Position(1000 * ms, (n, e, d), (vn, ve, vd))


def motors(m: Any) -> Motors:
    """SERVO_OUTPUT_RAW (#36): PWM 1000..2000 us of the first four outputs -> 0..1. Its stamp is 32 bits of us: it wraps."""
    pwm = (m.servo1_raw, m.servo2_raw, m.servo3_raw, m.servo4_raw)
    return Motors(m.time_usec, tuple(min(1.0, max(0.0, 1e-3 * (x - 1000))) for x in pwm))


def target(m: Any) -> Target:
    """ATTITUDE_TARGET (#83): the attitude setpoint the autopilot acts on."""
    _finite("ATTITUDE_TARGET", m.time_boot_ms, "ms", m.thrust)
    q = _unit("ATTITUDE_TARGET", m.time_boot_ms, "ms", m.q)
    return Target(1000 * m.time_boot_ms, q, (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate), m.thrust, m.type_mask)


def controls(m: Any) -> Controls:
    """ACTUATOR_CONTROL_TARGET (#140): us; the first four of its controls are a helicopter's sticks."""
    lat, lon, ped, col = (float(x) for x in m.controls[:4])
    _finite("ACTUATOR_CONTROL_TARGET", m.time_usec, "us", lat, lon, ped, col)
    return Controls(_stamp("ACTUATOR_CONTROL_TARGET", m.time_usec), (lat, lon, ped, col))


DECODERS: dict[str, Callable[[Any], Sample]] = {
    "ATTITUDE_QUATERNION": attitude_quaternion,
    "ATTITUDE": attitude,
    "ATT_POS_MOCAP": mocap,
    "HIGHRES_IMU": imu,
    "LOCAL_POSITION_NED": position,
    "SERVO_OUTPUT_RAW": motors,
    "ATTITUDE_TARGET": target,
    "ACTUATOR_CONTROL_TARGET": controls,
}


def unwrap_us(stamp_us: int, reference_us: int) -> int:
    """A 32-bit microsecond stamp (it wraps after 71.6 minutes) as the full stamp nearest to a reference."""
    turns = (reference_us - stamp_us + _SERVO_WRAP_US // 2) // _SERVO_WRAP_US
    return stamp_us + turns * _SERVO_WRAP_US


def attitude_setpoint(time_boot_ms: int, system: int, component: int, setpoint: Setpoint) -> tuple[Any, ...]:
    """Fields of SET_ATTITUDE_TARGET (#82)."""
    w = setpoint.omega_rad_s
    rates = (0.0, 0.0, 0.0) if setpoint.type_mask & 7 == 7 else w
    return (time_boot_ms, system, component, setpoint.type_mask, setpoint.q_wxyz, *rates, setpoint.thrust, (0.0, 0.0, 0.0))


def stick_setpoint(t_us: int, system: int, component: int, sticks: tuple[float, ...]) -> tuple[Any, ...]:
    """Fields of SET_ACTUATOR_CONTROL_TARGET (#139), group 0: a helicopter's sticks in place of its inner loop."""
    return (t_us, 0, system, component, (*sticks, 0.0, 0.0, 0.0, 0.0))


def float_of_int(value: int, kind: int) -> float:
    """An integer parameter byte-wise in the float, as PX4 sends it (MAV_PARAM_TYPE 1..6)."""
    code = {1: "<B3x", 2: "<b3x", 3: "<H2x", 4: "<h2x", 5: "<I", 6: "<i"}.get(kind, "<i")
    return struct.unpack("<f", struct.pack(code, value))[0]


def int_of_float(value: float, kind: int) -> int:
    """The integer that PX4 put byte-wise into a float parameter (MAV_PARAM_TYPE 1..6)."""
    code = {1: "<B3x", 2: "<b3x", 3: "<H2x", 4: "<h2x", 5: "<I", 6: "<i"}.get(kind, "<i")
    return struct.unpack(code, struct.pack("<f", value))[0]
