"""A recording of any kind as the signals that estimators take: MAVLink tlog, PX4 ULog, ArduPilot DataFlash.

Each signal is one table of columns in the order of arrival; `samples` plays them back one by one, as a live link would have brought
them. What a recording is too slow for is said, by rate.
"""

import heapq
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import NDArray

from mavquad.errors import LogError
from mavquad.link import bulk, signals
from mavquad.link.columns import Log
from mavquad.signals import Attitude, Imu, Mocap, Motors, Position, Target

_AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1: of several senders of one vehicle (a camera, a companion) the one that is meant

Array = NDArray[Any]
Kind = type[Attitude] | type[Imu] | type[Mocap] | type[Motors] | type[Position] | type[Target]


class Signal(NamedTuple):
    """All samples of one kind: `columns` are the kind's own fields, each (n,) or (n, k), the first t_us."""

    kind: Kind
    source: str  # the message, topic or record it comes from
    arrival_us: NDArray[np.int64]  # (n,) the log's stamp; the vehicle's own where the log was kept aboard
    columns: tuple[Array, ...]

    def column(self, name: str) -> Array:
        """One field of the kind by name."""
        return self.columns[self.kind._fields.index(name)]

    def rate_hz(self) -> float:
        """The median rate; 0 for fewer than two samples."""
        gaps = np.diff(self.columns[0])
        gaps = gaps[gaps > 0]
        return 1e6 / float(np.median(gaps)) if gaps.size else 0.0


class Recording(NamedTuple):
    """A whole recording: its signals, every table of the file by name, how many samples were refused, what is wrong with it."""

    path: Path
    format: str  # "tlog", "ULog", "DataFlash"
    signals: dict[Kind, Signal]
    tables: dict[str, Array]  # structured, the first column t_us
    refused: int
    problem: str


class Need(NamedTuple):
    """What a method needs of a recording, and why."""

    method: str
    rates_hz: tuple[tuple[Kind, float], ...]
    why: str


NEEDS = (
    Need("body rates (gsmo)", ((Attitude, 50.0),), "a rate of 5 Hz must be seen ten times a period"),
    Need("disturbance and wind (joint, eskf)", ((Attitude, 20.0), (Position, 10.0)), "tilt changes within 0.1 s"),
    Need("set-membership bounds (asmf)", ((Attitude, 50.0), (Position, 20.0)), "its rate bound is per sample"),
    Need("identification up to 5 Hz", ((Attitude, 50.0), (Target, 25.0)), "five samples a period of what excites it"),
)


def open_recording(path: Path | str, *, system: int | None = None, component: int | None = None) -> Recording:
    """A recording by what its first bytes say it is; `system`, `component` choose a vehicle of a tlog that holds several.

    Raises LogError for a file that is missing, empty or of no known kind.
    """
    path = Path(path)
    head = _first_bytes(path)
    if head.startswith(b"ULog"):
        from mavquad.link import ulog  # pyulog: only where such a log is read

        return ulog.read(path)
    if head.startswith(b"\xa3\x95"):
        from mavquad.link import dataflash

        return dataflash.read(path)
    return from_tlog(Log(path), system=system, component=component)


def kept_aboard(path: Path) -> bool:
    """Whether a file is an autopilot's own log (ULog, DataFlash) by its first bytes. Raises LogError where there is none."""
    return _first_bytes(path).startswith((b"ULog", b"\xa3\x95"))


def _first_bytes(path: Path) -> bytes:
    """Up to eight bytes. Raises LogError where there is no such file."""
    try:
        with path.open("rb") as stream:
            return stream.read(8)
    except FileNotFoundError:
        raise LogError(f"{path}: no such file") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None


def from_tlog(log: Log, *, system: int | None = None, component: int | None = None) -> Recording:
    """The signals of one sender, as the live link would decode them. Raises LogError where several could be meant."""
    sender = _sender(log, system, component)
    tables = {f"{s.system}/{s.component}/{s.name}": rows for s, rows in log.everything().items()}
    found: dict[Kind, Signal] = {}
    refused = 0
    for name, decode in bulk.DECODERS.items():
        for stream in log.find(name, *sender):
            rows = log.rows(stream)
            kind, good, columns = decode(rows)
            refused += int(good.size - good.sum())
            got = Signal(kind, name, rows["t_us"][good], tuple(column[good] for column in columns))
            if good.any() and (kind not in found or got.arrival_us.size > 1.2 * found[kind].arrival_us.size):
                found[kind] = got
    if Motors in found and Attitude in found:
        found[Motors] = _unwrapped(found[Motors], found[Attitude])
    return Recording(log.path, "tlog", found, tables, refused, log.problem)


def _sender(log: Log, system: int | None, component: int | None) -> tuple[int, int]:
    senders = sorted({(s.system, s.component) for s in log.streams if s.name in ("ATTITUDE", "ATTITUDE_QUATERNION")})
    chosen = [s for s in senders if system in (None, s[0]) and component in (None, s[1])]
    autopilots = [s for s in chosen if s[1] == _AUTOPILOT]
    if len(chosen) == 1 or len(autopilots) == 1:
        return (autopilots or chosen)[0]
    names = ", ".join(f"{s}/{c}" for s, c in senders) or "nobody"
    raise LogError(f"{log.path}: attitude comes from {names}; expected one vehicle: choose it with --system and --component")


def _unwrapped(motors: Signal, attitude: Signal) -> Signal:
    """Stamps of SERVO_OUTPUT_RAW in full, by those of the attitude that arrived next to them."""
    t_us = bulk.unwrapped_us(motors.columns[0], motors.arrival_us, attitude.columns[0], attitude.arrival_us)
    return motors._replace(columns=(t_us, *motors.columns[1:]))


def samples(recording: Recording) -> Iterator[tuple[int, Any]]:
    """(arrival_us, sample) of all signals in the order of arrival."""
    return heapq.merge(*(_samples(signal) for signal in recording.signals.values()), key=lambda item: item[0])


def _samples(signal: Signal) -> Iterator[tuple[int, Any]]:
    fields = [map(tuple, c.tolist()) if c.ndim == 2 else c.tolist() for c in signal.columns]
    return zip(signal.arrival_us.tolist(), map(signal.kind._make, zip(*fields, strict=True)), strict=True)


def rates_hz(source: Recording | Log) -> dict[Kind, float]:
    """The median rate of each kind of sample; of a tlog the best of its messages, without decoding them."""
    if isinstance(source, Recording):
        return {kind: signal.rate_hz() for kind, signal in source.signals.items()}
    best: dict[Kind, float] = {}
    for name, decode in signals.DECODERS.items():
        kind = get_type_hints(decode)["return"]
        for stream in source.find(name):
            gaps = np.diff(source.t_us[source.numbers(stream)])
            gaps = gaps[gaps > 0]
            best[kind] = max(best.get(kind, 0.0), 1e6 / float(np.median(gaps)) if gaps.size else 0.0)
    return best


def not_enough_for(source: Recording | Log) -> list[str]:
    """One line for each method that this recording cannot feed: what it has, what it takes, and why."""
    have_hz, lines = rates_hz(source), []
    for need in NEEDS:
        lacks = []
        for kind, needed in need.rates_hz:
            have = have_hz.get(kind, 0.0)
            if have < 0.9 * needed:
                state = f"at {have:.1f} Hz is too slow" if have else "is missing"
                lacks.append(f"{kind.__name__.lower()} {state}, needs {needed:g} Hz")
        if lacks:
            lines.append(f"not enough for {need.method}: {'; '.join(lacks)} ({need.why})")
    return lines


def at_times(t_us: Array, source_t_us: Array, values: Array) -> Array:
    """Columns (m, k) of another stream at the times t_us (n,): linear between, NaN outside. Needs increasing source stamps."""
    keep = np.concatenate([[True], np.diff(source_t_us) > 0]) if source_t_us.size else np.zeros(0, bool)
    if keep.sum() < 2:
        return np.full((t_us.size, values.shape[1]), np.nan)
    x, origin = source_t_us[keep], source_t_us[0]
    grid = (x - origin).astype(float)
    return np.column_stack(
        [np.interp((t_us - origin).astype(float), grid, column, np.nan, np.nan) for column in values[keep].T]
    )


def onboard(kind: Kind, source: str, t_us: Array, *columns: Array) -> Signal:
    """A signal of a log kept aboard, without its samples that are not finite (rates may be unknown: NaN)."""
    good = np.isfinite(columns[0]).all(axis=tuple(range(1, columns[0].ndim)))
    t_us = t_us[good].astype(np.int64)
    return Signal(kind, source, t_us, (t_us, *(column[good] for column in columns)))


def unit(q_wxyz: Array) -> Array:
    """Quaternions (n, 4) of length one; NaN where the norm is off by more than 5 %."""
    norm = np.linalg.norm(q_wxyz, axis=1, keepdims=True)
    return np.where(np.abs(norm - 1.0) < 0.05, q_wxyz / np.where(norm > 0.0, norm, 1.0), np.nan)
