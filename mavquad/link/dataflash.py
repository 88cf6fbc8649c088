"""ArduPilot DataFlash (.bin) -> signals: pymavlink's reader finds the records and their formats, NumPy takes the columns.

Source: https://ardupilot.org/copter/docs/logmessages.html. Times are TimeUS, of the vehicle's boot clock.
"""

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavquad.errors import LogError
from mavquad.link.bulk import quaternions
from mavquad.link.recording import Recording, Signal, at_times, onboard, unit
from mavquad.signals import Attitude, Imu, Mocap, Motors, Position, Target

Array = NDArray[Any]
_HEAD = 3  # two magic bytes and the type
_TYPE = {
    "a": ("<i2", (32,)), "b": "i1", "B": "u1", "M": "u1", "g": "<f2", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4",
    "f": "<f4", "d": "<f8", "n": "S4", "N": "S16", "Z": "S64", "c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4",
    "L": "<i4", "q": "<i8", "Q": "<u8",
}  # fmt: skip


def read(path: Path) -> Recording:
    """The whole log. Raises LogError where it is no DataFlash log."""
    from pymavlink.DFReader import DFReader_binary  # slow to import: only where such a log is read

    said = io.StringIO()
    log = DFReader_binary.__new__(DFReader_binary)  # made before it reads, so that a file it gives up on can be closed
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            log.__init__(str(path))
    except Exception as error:  # pymavlink raises whatever the broken bytes led it to
        log.close()
        raise LogError(f"{path}: not a readable DataFlash log: {error or type(error).__name__}") from None
    try:
        data = np.frombuffer(bytes(log.data_map), np.uint8)
        cut = max((int(at[-1]) + log.formats[kind].len for kind, at in _found(log)), default=0) - data.size
        tables: dict[str, Array] = {}
        for kind, at in _found(log):
            tables |= _tables(log.formats[kind], data, np.asarray(at, np.int64))
    finally:
        log.close()
    if not tables:
        raise LogError(f"{path}: a DataFlash log without any timed record; was logging started?")
    made = [_attitude(tables), _imu(tables), _mocap(tables), _motors(tables), _position(tables), _target(tables)]
    found = [signal for signal in made if signal is not None and signal.arrival_us.size]
    bad = said.getvalue().count("bad header")
    problem = f"{path}: {bad} bytes of junk between its records were skipped" if bad else ""
    if cut > 0:
        whole = sum(len(at) for _, at in _found(log)) - 1
        problem = f"{path}: truncated at byte {data.size}; {whole} whole records read before it"
    return Recording(path, "DataFlash", {signal.kind: signal for signal in found}, tables, 0, problem)


def _found(log: Any) -> list[tuple[int, Any]]:
    return [(kind, at) for kind, at in enumerate(log.offsets) if len(at) and kind in log.formats]


def _tables(form: Any, data: Array, at: Array) -> dict[str, Array]:
    """One record type as structured arrays, one for each instance (`IMU/0`, `IMU/1`) where it has several. None without TimeUS."""
    if "TimeUS" not in form.columns:
        return {}
    raw = np.dtype([(name, _TYPE[code]) for name, code in zip(form.columns, form.format, strict=False)])
    at = at[at + _HEAD + raw.itemsize <= data.size]
    rows = data[at[:, None] + np.arange(_HEAD, _HEAD + raw.itemsize)].reshape(-1).view(raw)
    scale = {name: factor for name, factor in zip(form.columns, form.msg_mults, strict=False) if factor is not None}
    kinds: list[Any] = [("t_us", "<i8")]
    kinds += [(n, "<f8") if n in scale else (n, *_split(raw[n])) for n in form.columns if n != "TimeUS"]
    table = np.empty(rows.size, kinds)
    table["t_us"] = rows["TimeUS"]
    for name in form.columns:
        if name != "TimeUS":
            table[name] = rows[name] * scale[name] if name in scale else rows[name]
    if form.instance_field is None:
        return {form.name: table} if table.size else {}
    which = table[form.instance_field]
    return {f"{form.name}/{number}": table[which == number] for number in np.unique(which)}


def _split(kind: Any) -> tuple[Any, ...]:
    return kind.subdtype if kind.subdtype is not None else (kind,)


def _first(tables: dict[str, Array], *names: str) -> tuple[str, Array] | None:
    for name in names:
        if name in tables:
            return name, tables[name]
    return None


def _vector(table: Array, *names: str) -> Array:
    return np.column_stack([table[name] for name in names]).astype(float)


def _attitude(tables: dict[str, Array]) -> Signal | None:
    """The filter's quaternion where it is logged, else ATT's Euler angles (in steps of 0.01 deg in older logs)."""
    found = _first(tables, "XKQ/0", "NKQ1", "NKQ/0", "AHR2")
    angles = tables.get("ATT")
    if angles is not None and (found is None or found[1].size < 0.9 * angles.size):
        name, t_us = "ATT", angles["t_us"]
        q = quaternions(np.radians(_vector(angles, "Roll", "Pitch", "Yaw")))
    elif found is not None:
        name, t_us = found[0], found[1]["t_us"]
        q = unit(_vector(found[1], "Q1", "Q2", "Q3", "Q4"))
    else:
        return None
    gyro = _first(tables, "IMU/0", "IMU")
    omega = np.full((t_us.size, 3), np.nan)
    if "RATE" in tables:
        rates = tables["RATE"]
        omega = at_times(t_us, rates["t_us"], np.radians(_vector(rates, "R", "P", "Y")))
    elif gyro is not None:
        omega = at_times(t_us, gyro[1]["t_us"], _vector(gyro[1], "GyrX", "GyrY", "GyrZ"))
    return onboard(Attitude, name, t_us, q, omega)


def _imu(tables: dict[str, Array]) -> Signal | None:
    found = _first(tables, "IMU/0", "IMU")
    if found is None:
        return None
    name, table = found
    return onboard(Imu, name, table["t_us"], _vector(table, "AccX", "AccY", "AccZ"), _vector(table, "GyrX", "GyrY", "GyrZ"))


def _mocap(tables: dict[str, Array]) -> Signal | None:
    if "VISP" not in tables:
        return None
    table = tables["VISP"]
    q = quaternions(np.radians(_vector(table, "Roll", "Pitch", "Yaw")))
    return onboard(Mocap, "VISP", table["t_us"], q, _vector(table, "PX", "PY", "PZ"))


def _motors(tables: dict[str, Array]) -> Signal | None:
    if "RCOU" not in tables:
        return None
    table = tables["RCOU"]
    return onboard(Motors, "RCOU", table["t_us"], (1e-3 * (_vector(table, "C1", "C2", "C3", "C4") - 1000.0)).clip(0.0, 1.0))


def _position(tables: dict[str, Array]) -> Signal | None:
    found = _first(tables, "XKF1/0", "NKF1/0", "NKF1", "XKF1")
    if found is None:
        return None
    name, table = found
    return onboard(Position, name, table["t_us"], _vector(table, "PN", "PE", "PD"), _vector(table, "VN", "VE", "VD"))


def _target(tables: dict[str, Array]) -> Signal | None:
    """The attitude asked of the inner loop (ATT) and the throttle it gave (CTUN.ThO), 0..1."""
    if "ATT" not in tables or "CTUN" not in tables or "ThO" not in (tables["CTUN"].dtype.names or ()):
        return None
    table, throttle = tables["ATT"], tables["CTUN"]
    q = quaternions(np.radians(_vector(table, "DesRoll", "DesPitch", "DesYaw")))
    thrust = at_times(table["t_us"], throttle["t_us"], _vector(throttle, "ThO"))[:, 0]
    known = np.isfinite(thrust)
    rates, mask = np.full((known.sum(), 3), np.nan), np.full(known.sum(), 7)
    return onboard(Target, "ATT, CTUN", table["t_us"][known], q[known], rates, thrust[known], mask)
