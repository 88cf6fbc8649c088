"""MAVLink columns -> signals: the same units, frames and refusals as `link/signals.py`, for whole streams at once.

The two are tested against each other on every sample; what a live link would refuse is left out here too.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavquad.signals import Attitude, Imu, Mocap, Motors, Position, Target

Array = NDArray[Any]
Decoded = tuple[Any, NDArray[np.bool_], tuple[Array, ...]]  # the kind, which rows are taken, its columns of all rows


def _vector(rows: Array, *names: str) -> Array:
    return np.column_stack([rows[name] for name in names]).astype(float)


def _finite(*columns: Array) -> NDArray[np.bool_]:
    good = np.ones(len(columns[0]), bool)
    for column in columns:
        good &= np.isfinite(column).all(axis=1) if column.ndim == 2 else np.isfinite(column)
    return good


def _unit(q: Array) -> tuple[Array, NDArray[np.bool_]]:
    w, x, y, z = q.T
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        n2 = w * w + x * x + y * y + z * z
        good = (n2 > 0.9) & (n2 < 1.1)
        k = 1.0 / np.sqrt(np.where(good, n2, 1.0))
        return q * k[:, None], good


def _ms(rows: Array) -> Array:
    return 1000 * rows["time_boot_ms"].astype(np.int64)


def _attitude_quaternion(rows: Array) -> Decoded:
    omega = _vector(rows, "rollspeed", "pitchspeed", "yawspeed")
    q, good = _unit(_vector(rows, "q1", "q2", "q3", "q4"))
    return Attitude, good & _finite(omega), (_ms(rows), q, omega)


def _attitude(rows: Array) -> Decoded:
    angles, omega = _vector(rows, "roll", "pitch", "yaw"), _vector(rows, "rollspeed", "pitchspeed", "yawspeed")
    return Attitude, _finite(angles, omega), (_ms(rows), quaternions(angles), omega)


def _mocap(rows: Array) -> Decoded:
    p = _vector(rows, "x", "y", "z")
    q, good = _unit(rows["q"].astype(float))
    return Mocap, good & _finite(p), (rows["time_usec"].astype(np.int64), q, p)


def _imu(rows: Array) -> Decoded:
    accel, gyro = _vector(rows, "xacc", "yacc", "zacc"), _vector(rows, "xgyro", "ygyro", "zgyro")
    return Imu, _finite(accel, gyro), (rows["time_usec"].astype(np.int64), accel, gyro)


def _position(rows: Array) -> Decoded:
    p, v = _vector(rows, "x", "y", "z"), _vector(rows, "vx", "vy", "vz")
    return Position, _finite(p, v), (_ms(rows), p, v)


def _motors(rows: Array) -> Decoded:
    pwm = _vector(rows, *(f"servo{i}_raw" for i in (1, 2, 3, 4)))
    return Motors, np.ones(len(rows), bool), (rows["time_usec"].astype(np.int64), (1e-3 * (pwm - 1000.0)).clip(0.0, 1.0))


def _target(rows: Array) -> Decoded:
    q, good = _unit(rows["q"].astype(float))
    omega = _vector(rows, "body_roll_rate", "body_pitch_rate", "body_yaw_rate")
    thrust = rows["thrust"].astype(float)
    return Target, good & _finite(thrust), (_ms(rows), q, omega, thrust, rows["type_mask"].astype(np.int64))


DECODERS: dict[str, Callable[[Array], Decoded]] = {
    "ATTITUDE_QUATERNION": _attitude_quaternion,
    "ATTITUDE": _attitude,
    "ATT_POS_MOCAP": _mocap,
    "HIGHRES_IMU": _imu,
    "LOCAL_POSITION_NED": _position,
    "SERVO_OUTPUT_RAW": _motors,
    "ATTITUDE_TARGET": _target,
}


def quaternions(angles_rad: Array) -> Array:
    """(n, 4) from roll, pitch, yaw (n, 3): ZYX, scalar first, body to world."""
    with np.errstate(invalid="ignore"):
        c, s = np.cos(0.5 * angles_rad).T, np.sin(0.5 * angles_rad).T
    return np.column_stack(
        [
            c[0] * c[1] * c[2] + s[0] * s[1] * s[2],
            s[0] * c[1] * c[2] - c[0] * s[1] * s[2],
            c[0] * s[1] * c[2] + s[0] * c[1] * s[2],
            c[0] * c[1] * s[2] - s[0] * s[1] * c[2],
        ]
    )


def unwrapped_us(stamps_us: Array, arrival_us: Array, near_us: Array, near_arrival_us: Array) -> Array:
    """32-bit microsecond stamps in full, by the stamps (m,) of another stream that arrived next to them."""
    order = np.argsort(near_arrival_us, kind="stable")
    near = np.searchsorted(near_arrival_us[order], arrival_us).clip(0, order.size - 1)
    reference = near_us[order][near]
    return stamps_us + ((reference - stamps_us + (1 << 31)) >> 32 << 32)
