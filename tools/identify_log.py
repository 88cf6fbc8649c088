"""A recorded flight as what identification needs: columns on the vehicle's clock, counted from the start of the log."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mavquad.errors import LogError
from mavquad.identify import timebase
from mavquad.identify.timebase import Clock
from mavquad.identify.vehicle import Motion
from mavquad.link import recording
from mavquad.link.columns import Log, Stream
from mavquad.signals import Attitude, Imu, Motors, Position, Target

PASSTHROUGH = 3  # group of SET_ACTUATOR_CONTROL_TARGET: on top of the autopilot's own
IN_AIR = 2  # MAV_LANDED_STATE_IN_AIR
Span = tuple[float, float]


class Turn(NamedTuple):
    """Attitude over time; `rate` is body rates, NaN where the message has none."""

    t_s: np.ndarray  # (n,)
    euler_rad: np.ndarray  # (n, 3)
    rate_rad_s: np.ndarray  # (n, 3)
    source: str


class Setpoints(NamedTuple):
    t_s: np.ndarray  # (n,)
    euler_rad: np.ndarray  # (n, 3)
    thrust: np.ndarray  # (n,)
    source: str


class Vectors(NamedTuple):
    """Two vectors over time: accelerometer and gyro, or position and velocity."""

    t_s: np.ndarray  # (n,)
    first: np.ndarray  # (n, 3)
    second: np.ndarray  # (n, 3)
    source: str


class Sticks(NamedTuple):
    """A helicopter's sticks -1..1 (lat, lon, ped, col): as a companion added them, and as they were applied."""

    added_t_s: np.ndarray  # (n,)
    added: np.ndarray  # (n, 4) SET_ACTUATOR_CONTROL_TARGET, group 3
    applied_t_s: np.ndarray  # (m,)
    applied: np.ndarray  # (m, 4) ACTUATOR_CONTROL_TARGET


class Flight(NamedTuple):
    """One log. Times are vehicle seconds since its first message; what it does not hold is None."""

    path: Path
    messages: int
    length_s: float
    attitude: Turn
    sent: Setpoints | None  # SET_ATTITUDE_TARGET
    target: Setpoints | None  # ATTITUDE_TARGET
    imu: Vectors | None
    position: Vectors | None
    motors: tuple[np.ndarray, np.ndarray] | None  # times (n,), commands (n, k) 0..1
    flying: tuple[Span, ...]
    clock: Clock
    round_trip_s: np.ndarray  # (n,) TIMESYNC answers
    notes: tuple[str, ...]
    sticks: Sticks | None = None


def read(path: Path) -> Flight:
    """Any recording. Raises LogError where it is none, or holds no attitude."""
    if recording.kept_aboard(path):
        return _from_signals(recording.open_recording(path))
    return _from_tlog(Log(path))


def sampled(flight: Flight, dt_s: float = 0.02) -> Motion:
    """The whole flight on one even clock."""
    attitude = flight.attitude
    t = np.arange(attitude.t_s[0], attitude.t_s[-1], dt_s)
    flying = np.zeros(t.size, bool)
    for start, end in flight.flying:
        flying |= (t >= start) & (t < end)
    gone = np.full((t.size, 3), np.nan)

    def first(source: Vectors | None) -> np.ndarray:
        return gone if source is None else _columns(t, source.t_s, source.first)

    def second(source: Vectors | None) -> np.ndarray:
        return gone if source is None else _columns(t, source.t_s, source.second)

    thrust = flight.target or flight.sent
    held = gone[:, 0] if thrust is None else timebase.held_at(timebase.Held(thrust.t_s, thrust.thrust), t)
    for stream in (attitude.t_s, *(v.t_s for v in (flight.imu, flight.position) if v is not None)):
        for start, end in timebase.rhythm(stream).gaps:
            flying &= (t < start) | (t > end)
    return Motion(
        dt_s,
        t,
        _columns(t, attitude.t_s, attitude.euler_rad),
        first(flight.imu),
        second(flight.imu),
        second(flight.position),
        held,
        flying,
    )


def euler(q_wxyz: np.ndarray) -> np.ndarray:
    """(n, 3) roll, pitch, yaw (unwrapped) of quaternions (n, 4), body to world."""
    w, x, y, z = np.asarray(q_wxyz, dtype=float).T
    norm = np.maximum(w * w + x * x + y * y + z * z, 1e-12)
    roll = np.arctan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)
    pitch = np.arcsin(np.clip(2.0 * (w * y - x * z) / norm, -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return np.column_stack([roll, pitch, np.unwrap(yaw)])


# ---- tlog ------------------------------------------------------------------------------------------------------------
def _from_tlog(log: Log) -> Flight:
    system, component = _vehicle(log)
    notes = [log.problem] if log.problem else []

    def rows(name: str) -> Any:
        return log.columns(name, system, component) if log.find(name, system, component) else None

    start_us = int(log.t_us[0])

    def arrival(table: Any) -> np.ndarray:
        return 1e-6 * (table["t_us"] - start_us)

    counts = {name: _count(log, name, system, component) for name in ("ATTITUDE", "ATTITUDE_QUATERNION")}
    best = "ATTITUDE_QUATERNION" if counts["ATTITUDE_QUATERNION"] > 1.1 * counts["ATTITUDE"] else "ATTITUDE"
    table = rows(best)
    boot = 1e-3 * table["time_boot_ms"]
    epoch = timebase.longest_epoch(boot)
    if epoch != slice(0, len(boot)):
        notes.append(f"the vehicle restarted in this log: only its longest run ({np.ptp(boot[epoch]):.0f} s) is used")
    table, boot = table[epoch], boot[epoch]
    arrived = arrival(table)
    clock = timebase.clock(arrived, boot)
    zero = float(timebase.to_vehicle_s(clock, np.zeros(1))[0])
    clock = clock._replace(boot_s=clock.boot_s - zero)  # vehicle time from here on counts from the log's start
    if clock.unsteady_s > timebase.UNSTEADY_S:
        notes.append(
            f"the vehicle's clock does not keep step with the recorder's: off by up to {clock.unsteady_s:.2f} s from an even rate"
        )
    window = (arrived[0] - 1.0, arrived[-1] + 1.0)

    def own(name: str, field: str = "time_boot_ms", unit: float = 1e-3) -> tuple[Any, np.ndarray] | None:
        """Rows of the chosen epoch and their times by the vehicle's own stamps."""
        got = rows(name)
        if got is None or len(got) < 3:
            return None
        at = arrival(got)
        got = got[(at >= window[0]) & (at <= window[1])]
        t = unit * got[field].astype(float) - zero
        expected = timebase.to_vehicle_s(clock, arrival(got))
        if field == "time_usec":  # 32 bits of it wrap every 71.6 minutes
            t = t + np.round((expected - t) / 4294.967296) * 4294.967296
        if len(got) < 3 or np.median(np.abs(t - expected)) > 2.0:
            t = expected  # stamps of another clock: arrival must do
        order = np.argsort(t, kind="stable")
        keep = order[np.concatenate([[True], np.diff(t[order]) > 0.0])]
        return got[keep], t[keep]

    if best == "ATTITUDE":
        angles = np.column_stack([table["roll"], table["pitch"], np.unwrap(table["yaw"].astype(float))]).astype(float)
    else:
        angles = euler(np.column_stack([table[f"q{i}"] for i in (1, 2, 3, 4)]))
    rates = np.column_stack([table[f"{n}speed"] for n in ("roll", "pitch", "yaw")]).astype(float)
    order = np.argsort(boot, kind="stable")
    keep = order[np.concatenate([[True], np.diff(boot[order]) > 0.0])]
    attitude = Turn((boot - zero)[keep], angles[keep], rates[keep], best)

    target = None
    if (got := own("ATTITUDE_TARGET")) is not None:
        target = Setpoints(got[1], euler(got[0]["q"]), got[0]["thrust"].astype(float), "ATTITUDE_TARGET")
    imu = None
    if (got := own("HIGHRES_IMU", "time_usec", 1e-6)) is not None:
        imu = Vectors(got[1], _three(got[0], "acc"), _three(got[0], "gyro"), "HIGHRES_IMU")
    elif (got := own("SCALED_IMU")) is not None:
        imu = Vectors(got[1], 9.80665e-3 * _three(got[0], "acc"), 1e-3 * _three(got[0], "gyro"), "SCALED_IMU")
    position = None
    if (got := own("LOCAL_POSITION_NED")) is not None:
        p, v = (np.column_stack([got[0][n] for n in names]).astype(float) for names in (("x", "y", "z"), ("vx", "vy", "vz")))
        position = Vectors(got[1], p, v, "LOCAL_POSITION_NED")
    motors = None
    if (got := own("SERVO_OUTPUT_RAW", "time_usec", 1e-6)) is not None:
        every = np.column_stack([got[0][f"servo{i}_raw"] for i in range(1, 9)]).astype(float)
        moving = [i for i in range(8) if np.ptp(every[:, i]) > 20.0]
        if moving:
            motors = (got[1], np.clip((every[:, moving] - 1000.0) / 1000.0, 0.0, 1.0))
    sent, said = _sent(log, (system, component), clock, start_us, window)
    flying = _flying(rows("EXTENDED_SYS_STATE"), target, attitude, clock, arrival)
    return Flight(
        log.path, len(log), float(log.t_us[-1] - start_us) * 1e-6, attitude, sent, target, imu, position, motors, flying, clock,
        _round_trips(log), (*notes, *said), _sticks(log, (system, component), own("ACTUATOR_CONTROL_TARGET", "time_usec", 1e-6), zero),
    )  # fmt: skip


def _sticks(log: Log, vehicle: tuple[int, int], applied: tuple[Any, np.ndarray] | None, zero_s: float) -> Sticks | None:
    """By the vehicle's stamps on both sides; None where nobody added anything."""
    streams = [s for s in log.find("SET_ACTUATOR_CONTROL_TARGET") if (s.system, s.component) != vehicle]
    if not streams:
        return None
    table = log.rows(max(streams, key=lambda s: s.messages))
    table = table[table["group_mlx"] == PASSTHROUGH]
    t = 1e-6 * table["time_usec"].astype(float) - zero_s
    ahead = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]]) if len(t) else np.zeros(0, bool)
    if ahead.sum() < 3:
        return None
    rows, at = applied if applied is not None else ({"controls": np.zeros((0, 8))}, np.zeros(0))
    controls = table["controls"][:, :4].astype(float)
    return Sticks(t[ahead], controls[ahead], at, rows["controls"][:, :4].astype(float))


def _vehicle(log: Log) -> tuple[int, int]:
    streams = [s for s in log.streams if s.name in ("ATTITUDE", "ATTITUDE_QUATERNION")]
    if not streams:
        names = ", ".join(sorted({s.name for s in log.streams})[:8])
        raise LogError(f"{log.path}: no ATTITUDE in it (it holds {names}); record ATTITUDE at 50-100 Hz")
    best = max(streams, key=lambda s: s.messages)
    return best.system, best.component


def _count(log: Log, name: str, system: int, component: int) -> int:
    return sum(s.messages for s in log.find(name, system, component))


def _three(table: Any, kind: str) -> np.ndarray:
    return np.column_stack([table[f"{axis}{kind}"] for axis in "xyz"]).astype(float)


def _sent(
    log: Log, vehicle: tuple[int, int], clock: Clock, start_us: int, window: Span
) -> tuple[Setpoints | None, tuple[str, ...]]:
    streams = [s for s in log.find("SET_ATTITUDE_TARGET") if (s.system, s.component) != vehicle]
    if not streams:
        return None, ()
    best: Stream = max(streams, key=lambda s: s.messages)
    others = sum(s.messages for s in streams) - best.messages
    notes = (f"SET_ATTITUDE_TARGET from several senders: {best.system}/{best.component} is used, {others} others are not",)
    table = log.rows(best)
    at = 1e-6 * (table["t_us"] - start_us)
    mask = table["type_mask"] & 0x80 == 0  # the attitude in it counts
    inside = (at >= window[0]) & (at <= window[1]) & mask
    if inside.sum() < 3:
        return None, ()
    table, at = table[inside], at[inside]
    t = timebase.to_vehicle_s(clock, at)
    keep = np.concatenate([[True], np.diff(t) > 0.0])
    found = Setpoints(t[keep], euler(table["q"])[keep], table["thrust"].astype(float)[keep], "SET_ATTITUDE_TARGET")
    return found, notes if others else ()


def _flying(states: Any, target: Setpoints | None, attitude: Turn, clock: Clock, arrival: Any) -> tuple[Span, ...]:
    """Spans in the air: by EXTENDED_SYS_STATE, else by thrust, else the whole log."""
    last = float(attitude.t_s[-1])
    if states is not None and len(states):
        t = timebase.to_vehicle_s(clock, arrival(states))
        return _spans(t, states["landed_state"] == IN_AIR, last)
    if target is not None:
        return _spans(target.t_s, target.thrust > 0.5 * np.percentile(target.thrust, 90), last)
    return ((float(attitude.t_s[0]), last),)


def _spans(t_s: np.ndarray, on: np.ndarray, last: float) -> tuple[Span, ...]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int)))
    return tuple((float(t_s[a]), float(t_s[b]) if b < len(t_s) else last) for a, b in edges.reshape(-1, 2))


def _round_trips(log: Log) -> np.ndarray:
    """Seconds from a TIMESYNC request to its answer, either way round, from stamps in the log."""
    asked: dict[int, int] = {}
    trips = []
    for stream in log.find("TIMESYNC"):
        for row in log.rows(stream):
            ts1, tc1, at = int(row["ts1"]), int(row["tc1"]), int(row["t_us"])
            if tc1 == 0:
                asked[ts1] = at
            elif ts1 in asked:
                trips.append(1e-6 * abs(at - asked[ts1]))
    return np.array(trips)


# ---- logs kept aboard ------------------------------------------------------------------------------------------------
def _from_signals(found: recording.Recording) -> Flight:
    """ULog and DataFlash: everything carries the vehicle's own stamps, and no command as sent is in them."""
    if Attitude not in found.signals:
        raise LogError(f"{found.path}: no attitude in it; log it at 50-100 Hz")
    signal = found.signals[Attitude]
    zero = 1e-6 * float(signal.column("t_us")[0])

    def times(kind: recording.Kind) -> np.ndarray:
        return 1e-6 * found.signals[kind].column("t_us") - zero

    def vectors(kind: recording.Kind, first: str, second: str) -> Vectors | None:
        if kind not in found.signals:
            return None
        one = found.signals[kind]
        return Vectors(times(kind), one.column(first), one.column(second), one.source)

    attitude = Turn(times(Attitude), euler(signal.column("q_wxyz")), signal.column("omega_rad_s"), signal.source)
    target = None
    if Target in found.signals:
        one = found.signals[Target]
        target = Setpoints(times(Target), euler(one.column("q_wxyz")), one.column("thrust"), one.source)
    motors = (times(Motors), found.signals[Motors].column("command")) if Motors in found.signals else None
    last = float(attitude.t_s[-1])
    flying = _spans(target.t_s, target.thrust > 0.5 * np.percentile(target.thrust, 90), last) if target else ((0.0, last),)
    return Flight(
        found.path, sum(len(s.arrival_us) for s in found.signals.values()), last, attitude, None, target,
        vectors(Imu, "accel_m_s2", "gyro_rad_s"), vectors(Position, "p_ned_m", "v_ned_m_s"), motors, flying,
        timebase.SAME, np.zeros(0), (found.problem,) if found.problem else (),
    )  # fmt: skip


def _columns(t: np.ndarray, at: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(t, at, values[:, i]) for i in range(values.shape[1])])
