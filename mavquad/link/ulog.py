"""PX4 ULog -> signals, by pyulog (the extra `ulog`).

Topics changed their names and fields over the years: each signal is taken from the newest form that the log holds.
Source: https://docs.px4.io/main/en/dev_log/ulog_file_format.html and the uORB message definitions of v1.6 to v1.16.
"""

import contextlib
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavquad.errors import LogError
from mavquad.link.recording import Recording, Signal, at_times, onboard, unit
from mavquad.signals import Attitude, Imu, Mocap, Motors, Position, Target

Array = NDArray[Any]
_ITEM = re.compile(r"(.+)\[(\d+)\]")
_HEADER, _MESSAGE = 16, 3


def read(path: Path) -> Recording:
    """The whole log. Raises LogError where it is no ULog, or pyulog is not installed."""
    try:
        from pyulog import ULog
    except ImportError:
        raise LogError(f"{path}: reading a ULog needs pyulog: pip install 'mavquad[ulog]'") from None
    try:
        with path.open("rb") as stream, contextlib.redirect_stdout(io.StringIO()):  # pyulog prints; stdout is for data
            log = ULog(stream)
    except Exception as error:  # pyulog raises whatever the broken bytes led it to
        raise LogError(f"{path}: not a readable ULog: {error or type(error).__name__}") from None
    tables = {}
    for data in log.data_list:
        table = _table(data.data)
        if table.size:
            tables[f"{data.name}/{data.multi_id}"] = table
    if not tables:
        raise LogError(f"{path}: a ULog without any logged data; was logging started?")
    made = [_attitude(tables), _imu(tables), _mocap(tables), _motors(tables), _position(tables), _target(tables)]
    found = [signal for signal in made if signal is not None and signal.arrival_us.size]
    problem = _cut(path) or (f"{path}: pyulog met corrupt data in it and skipped it" if log.file_corruption else "")
    return Recording(path, "ULog", {signal.kind: signal for signal in found}, tables, 0, problem)


def _table(data: dict[str, Array]) -> Array:
    """pyulog's columns as one structured array: `t_us` first, `q[0]`, `q[1]`, ... as one column `q`."""
    groups: dict[str, list[str]] = {}
    for key in data:
        found = _ITEM.fullmatch(key)
        groups.setdefault(found[1] if found else key, []).append(key)
    columns = {}
    for name, keys in groups.items():
        columns["t_us" if name == "timestamp" else name] = (
            data[keys[0]] if keys == [name] else np.column_stack([data[key] for key in keys])
        )
    kinds = [(name, "<i8" if name == "t_us" else column.dtype, column.shape[1:]) for name, column in columns.items()]
    table = np.empty(len(data["timestamp"]), kinds)
    for name, column in columns.items():
        table[name] = column
    return table


def _first(tables: dict[str, Array], *names: str) -> tuple[str, Array] | None:
    for name in names:
        if f"{name}/0" in tables:
            return name, tables[f"{name}/0"]
    return None


def _time(table: Array) -> Array:
    """When the sensor was read where the topic says it, else when it was published [us]."""
    names = table.dtype.names or ()
    return table["timestamp_sample"].astype(np.int64) if "timestamp_sample" in names else table["t_us"]


def _attitude(tables: dict[str, Array]) -> Signal | None:
    found = _first(tables, "vehicle_attitude")
    if found is None:
        return None
    name, table = found
    t_us = _time(table)
    if "rollspeed" in (table.dtype.names or ()):  # before v1.10
        omega = np.column_stack([table["rollspeed"], table["pitchspeed"], table["yawspeed"]]).astype(float)
    elif "vehicle_angular_velocity/0" in tables:
        rates = tables["vehicle_angular_velocity/0"]
        omega = at_times(t_us, _time(rates), rates["xyz"].astype(float))
    else:
        omega = np.full((t_us.size, 3), np.nan)
    return onboard(Attitude, name, t_us, unit(table["q"].astype(float)), omega)


def _imu(tables: dict[str, Array]) -> Signal | None:
    found = _first(tables, "sensor_combined")
    if found is None:
        return None
    name, table = found
    return onboard(Imu, name, _time(table), table["accelerometer_m_s2"].astype(float), table["gyro_rad"].astype(float))


def _mocap(tables: dict[str, Array]) -> Signal | None:
    found = _first(tables, "vehicle_visual_odometry", "vehicle_mocap_odometry")
    if found is None:
        return None
    name, table = found
    names = table.dtype.names or ()
    p = table["position"] if "position" in names else np.column_stack([table["x"], table["y"], table["z"]])
    return onboard(Mocap, name, _time(table), unit(table["q"].astype(float)), p.astype(float))


def _motors(tables: dict[str, Array]) -> Signal | None:
    if "actuator_motors/0" in tables:  # v1.13: 0..1, NaN where there is no motor
        table = tables["actuator_motors/0"]
        control = table["control"].astype(float)
        return onboard(Motors, "actuator_motors", _time(table), control[:, ~np.isnan(control).all(axis=0)].clip(0.0, 1.0))
    for name in ("actuator_outputs/0", "actuator_outputs/1"):
        if name in tables and np.median(tables[name]["output"][:, 0]) >= 800.0:  # PWM in us, not an I/O board's own scale
            table = tables[name]
            return onboard(Motors, name, _time(table), (1e-3 * (table["output"][:, :4].astype(float) - 1000.0)).clip(0.0, 1.0))
    return None


def _position(tables: dict[str, Array]) -> Signal | None:
    found = _first(tables, "vehicle_local_position")
    if found is None:
        return None
    name, table = found
    good = table["xy_valid"].astype(bool) & table["z_valid"].astype(bool)
    p = np.column_stack([table["x"], table["y"], table["z"]]).astype(float)
    v = np.column_stack([table["vx"], table["vy"], table["vz"]]).astype(float)
    return onboard(Position, name, _time(table)[good], p[good], v[good])


def _target(tables: dict[str, Array]) -> Signal | None:
    found = _first(tables, "vehicle_attitude_setpoint")
    if found is None:
        return None
    name, table = found
    names = table.dtype.names or ()
    thrust = -table["thrust_body"][:, 2] if "thrust_body" in names else table["thrust"]
    rates = np.full((table.size, 3), np.nan)
    mask = np.full(table.size, 7)
    q = unit(table["q_d"].astype(float))
    return onboard(Target, name, table["t_us"], q, rates, thrust.astype(float), mask)


def _cut(path: Path) -> str:
    """What is said of a log that ends inside a message, else ''. Follows the messages' own lengths."""
    data = path.read_bytes()
    at, messages = _HEADER, 0
    while at + _MESSAGE <= len(data):
        end = at + _MESSAGE + (data[at] | data[at + 1] << 8)
        if end > len(data):
            break
        at, messages = end, messages + 1
    return "" if at == len(data) else f"{path}: truncated at byte {len(data)}; {messages} whole messages read before it"
