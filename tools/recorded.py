"""A recorded flight made ready for observers: one vehicle, one run of its boot clock, what it was commanded, when it was in the air.

The unit of thrust is learnt from the log: the collective that the accelerometer says carries the vehicle. Without an airframe of its
own a log is read with the numbers of the x500, and that is said wherever they matter.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mavquad import airframe as airframes
from mavquad import plan_file
from mavquad.airframe import Airframe
from mavquad.errors import LogError
from mavquad.estimate import record
from mavquad.link import recording as recordings
from mavquad.link.columns import Log
from mavquad.link.recording import Recording, Signal
from mavquad.signals import Attitude, Imu, Motors, Position, Target

Array = NDArray[Any]
G_M_S2 = 9.80665
PERIOD_US = 20_000  # of the steps at which observers are asked
_RESTART_US = 2_000_000  # a stamp further back than this is a restarted clock
_IN_AIR = 2  # MAV_LANDED_STATE


class Command(NamedTuple):
    """What the vehicle acted on, held from each stamp until the next."""

    source: str
    t_us: Array  # (n,)
    attitude_rad: Array  # (n, 3) roll, pitch, yaw; NaN where only the thrust is known
    thrust_m_s2: Array  # (n,) specific


class Flown(NamedTuple):
    """One vehicle's flight as observers take it."""

    recording: Recording
    vehicle: Airframe
    vehicle_source: str  # where its numbers come from; "" where nobody said and the x500 stands in
    hover_thrust: float
    attitude: Signal
    position: Signal | None
    imu: Signal | None
    command: Command | None
    events: record.Events
    span_us: tuple[int, int]  # vehicle time [from, to) that counts
    span: str  # how it was chosen
    notes: tuple[str, ...]

    def inside(self, t_us: Array) -> NDArray[np.bool_]:
        """Which stamps lie in the span that counts."""
        return (t_us >= self.span_us[0]) & (t_us < self.span_us[1])

    def seconds(self, t_us: Any) -> Array:
        """Seconds after the flight's first attitude."""
        return 1e-6 * (np.asarray(t_us, float) - float(self.attitude.columns[0][0]))


def flown(
    source: Recording, log: Log | None, airframe: str | None, from_s: float | None = None, to_s: float | None = None
) -> Flown:
    """The flight in a recording; `log` is its tlog where it is one. Raises LogError where there is no attitude in it."""
    if Attitude not in source.signals:
        raise LogError(f"{source.path}: no attitude in it, which every observer needs")
    source, notes = _one_run(source)
    attitude = source.signals[Attitude]
    vehicle, vehicle_source = _vehicle(source.path, airframe)
    hover, command = _command(source, vehicle)
    span_us, span = _span(source, log, command, hover, from_s, to_s)
    position, imu = source.signals.get(Position), source.signals.get(Imu)
    parts = {record.ATTITUDE: (attitude.arrival_us, attitude.columns[0], np.column_stack(attitude.columns[1:3]))}
    if position is not None:
        parts[record.POSITION] = (position.arrival_us, position.columns[0], np.column_stack(position.columns[1:3]))
    if imu is not None:
        parts[record.IMU] = (imu.arrival_us, imu.columns[0], np.column_stack(imu.columns[1:3]))
    if command is not None:
        values = np.column_stack([np.nan_to_num(command.attitude_rad[:, :2]), command.thrust_m_s2])
        parts[record.COMMAND] = (_arrivals(command.t_us, attitude), command.t_us, values)
    events = record.events(parts, PERIOD_US)
    return Flown(
        source, vehicle, vehicle_source, hover, attitude, position, imu, command, events, span_us, span, (*source_notes(source), *notes)
    )  # fmt: skip


def source_notes(source: Recording) -> list[str]:
    """What this recording is too slow for, and what was refused of it."""
    refused = [f"{source.refused} samples of it hold no usable numbers and were left out"] if source.refused else []
    return [*recordings.not_enough_for(source), *refused]


def _arrivals(t_us: Array, attitude: Signal) -> Array:
    """When a sample of this vehicle time arrived, by the attitudes around it."""
    order = np.argsort(attitude.columns[0], kind="stable")
    return np.interp(t_us, attitude.columns[0][order], attitude.arrival_us[order]).astype(np.int64)


def _one_run(source: Recording) -> tuple[Recording, tuple[str, ...]]:
    """The longest run of the boot clock: between restarts nothing is comparable."""
    t_us, arrival = source.signals[Attitude].columns[0], source.signals[Attitude].arrival_us
    back = np.flatnonzero(np.diff(t_us) < -_RESTART_US) + 1
    if not back.size:
        return source, ()
    edges = np.concatenate([[0], back, [t_us.size]])
    longest = int(np.argmax(np.diff(edges)))
    first, last = int(edges[longest]), int(edges[longest + 1]) - 1
    from_us = int(arrival[first]) if longest else -(1 << 62)
    to_us = int(arrival[last]) if last + 1 < t_us.size else 1 << 62
    kept = {}
    for kind, signal in source.signals.items():
        good = (signal.arrival_us >= from_us) & (signal.arrival_us <= to_us)
        if good.any():
            kept[kind] = signal._replace(arrival_us=signal.arrival_us[good], columns=tuple(c[good] for c in signal.columns))
    span_s = 1e-6 * float(t_us[last] - t_us[first])
    note = f"the vehicle's boot clock restarts {back.size} times: its longest run, {span_s:.1f} s, is replayed"
    return source._replace(signals=kept), (note,)


def _vehicle(path: Path, airframe: str | None) -> tuple[Airframe, str]:
    if airframe is not None:
        return airframes.load(airframe), airframe
    beside = plan_file.beside(path)
    if beside.exists():
        return plan_file.read(beside).airframe, beside.name
    return airframes.load("x500"), ""


# ---- what it acted on ---------------------------------------------------------------------------------------------------
def _command(source: Recording, vehicle: Airframe) -> tuple[float, Command | None]:
    """The hover thrust as the log has it, and the commands: the autopilot's own echo, else its motors, else what was felt."""
    imu = source.signals.get(Imu)
    target, motors = source.signals.get(Target), source.signals.get(Motors)
    if target is not None:
        t_us, collective, name = target.columns[0], target.column("thrust"), target.source
        angles = euler(target.column("q_wxyz"))
    elif motors is not None:
        t_us, collective, name = motors.columns[0], motors.column("command").mean(axis=1), motors.source
        angles = np.full((t_us.size, 3), np.nan)
    elif imu is not None:
        felt = np.maximum(-imu.column("accel_m_s2")[:, 2], 0.0)
        return vehicle.hover_thrust, Command(f"{imu.source}, felt", imu.columns[0], np.full((felt.size, 3), np.nan), felt)
    else:
        return vehicle.hover_thrust, None
    hover = _hover(t_us, collective, imu) or vehicle.hover_thrust
    return hover, Command(name, t_us, angles, G_M_S2 * collective / hover)


def _hover(t_us: Array, collective: Array, imu: Signal | None) -> float:
    """The collective that carries the vehicle, by what the accelerometer felt under it; 0 where it cannot be told."""
    flying = collective > 0.15
    if imu is None or flying.sum() < 50:
        return float(np.median(collective[flying])) if flying.sum() >= 50 else 0.0
    order = np.argsort(imu.columns[0], kind="stable")
    felt = -np.interp(t_us, imu.columns[0][order], imu.column("accel_m_s2")[order, 2])
    flying &= (felt > 0.6 * G_M_S2) & (felt < 1.6 * G_M_S2)
    hover = G_M_S2 * float(np.median(collective[flying] / felt[flying])) if flying.sum() >= 50 else 0.0
    return hover if 0.05 < hover < 0.95 else 0.0


def _span(
    source: Recording, log: Log | None, command: Command | None, hover: float, from_s: float | None, to_s: float | None
) -> tuple[tuple[int, int], str]:
    """Vehicle time that counts, in us, and how it was chosen."""
    t_us, arrival = source.signals[Attitude].columns[0], source.signals[Attitude].arrival_us
    whole = (int(t_us.min()), int(t_us.max()) + 1)
    if from_s is not None or to_s is not None:
        start = int(log.t_us.min()) if log is not None else int(arrival[0])
        order = np.argsort(arrival, kind="stable")
        ends = [start + 1e6 * (0.0 if from_s is None else from_s), start + 1e6 * (math.inf if to_s is None else to_s)]
        chosen = np.interp(ends, arrival[order], t_us[order])
        return (int(chosen[0]), int(chosen[1]) + 1), "as asked for"
    if log is not None:
        for stream in log.find("EXTENDED_SYS_STATE"):
            rows = log.rows(stream)
            heard = rows["t_us"][rows["landed_state"] == _IN_AIR]
            heard = heard[(heard >= arrival.min()) & (heard <= arrival.max())]
            if heard.size > 1 and heard[-1] - heard[0] > 5_000_000:
                order = np.argsort(arrival, kind="stable")
                air = np.interp([heard[0], heard[-1]], arrival[order], t_us[order])
                return (int(air[0]), int(air[1]) + 1), "in the air, by EXTENDED_SYS_STATE"
    if command is not None:
        carried = command.t_us[command.thrust_m_s2 > 0.6 * G_M_S2]
        if carried.size > 1 and carried[-1] - carried[0] > 5_000_000:
            return (int(carried[0]), int(carried[-1]) + 1), f"carried by its rotors, by {command.source}"
    return whole, "the whole log"


# ---- angles, wind -----------------------------------------------------------------------------------------------------------
def euler(q_wxyz: Array) -> Array:
    """Roll, pitch, yaw (n, 3) [rad] of unit quaternions; NaN stays NaN."""
    w, x, y, z = np.asarray(q_wxyz, float).T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack([roll, pitch, yaw])


def wind(vehicle: Airframe, v_ned_m_s: Array, f_ned_m_s2: Array) -> Array:
    """Horizontal wind (n, 2) NED [m/s] that gives this vehicle this disturbance by its drag: m f = -(l + q s)(v - wind), s = |v - wind|.

    Drag is taken as that of the body's x axis whatever the heading and tilt. NaN for an airframe without drag.
    """
    linear, quadratic = vehicle.drag.linear_n_s_m[0], vehicle.drag.quadratic_n_s2_m2[0]
    force = vehicle.body.mass_kg * f_ned_m_s2[:, :2]
    size = np.linalg.norm(force, axis=1)
    if linear <= 0.0 and quadratic <= 0.0:
        return np.full_like(force, np.nan)
    speed = size / linear if quadratic <= 0.0 else (np.sqrt(linear**2 + 4.0 * quadratic * size) - linear) / (2.0 * quadratic)
    through: Array = v_ned_m_s[:, :2] + force / (linear + quadratic * speed)[:, None]
    return through
