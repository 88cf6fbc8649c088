"""The pipeline over recorded frames: what the companion did with them, or would do; and whether both are the same."""

import math
import struct
from array import array
from collections import deque
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from mavquad import pipeline, wire
from mavquad.errors import WireError
from mavquad.wire import Frame
from tools.trace import Trace

Record = tuple[int, Frame]
CLOSE = 1e-9  # what another processor or library version may differ by, relative and absolute
WIRE_CLOSE = 2.0**-23  # the same in a float32 field: the last bit, where a rounding fell the other way


class Played(NamedTuple):
    """What came of it."""

    trace: Trace
    flight: Any  # pipeline.Flight at the end
    received: int
    sent: int
    refused: dict[str, int]


class Parting(NamedTuple):
    """Where a replay and its log part."""

    t_us: int
    message: str
    why: str


class Verdict(NamedTuple):
    """`parting` is None where all came again; `largest` is the largest difference met in a frame (0 where all bits agree)."""

    received: int
    sent: int
    unsent: int  # the log ends before these answers
    rows: int  # of the trace, compared where the flight left one
    largest: float
    parting: Parting | None


class _Feeder:
    """The pipeline with its state, as the companion's shell runs it."""

    def __init__(self, plan: Any) -> None:
        self.plan, self.flight = plan, pipeline.start(plan)

    def feed(self, t_us: int, frame: Frame) -> tuple[list[tuple[int, bytes]], list[tuple[float, ...]]]:
        """What is sent and the new rows of the trace, after one received frame."""
        return self._take(pipeline.feed(self.plan, self.flight, t_us, frame))

    def advance(self, t_us: int) -> tuple[list[tuple[int, bytes]], list[tuple[float, ...]]]:
        """The same when only time passes."""
        return self._take(pipeline.advance(self.plan, self.flight, t_us))

    def _take(self, after: Any) -> tuple[list[tuple[int, bytes]], list[tuple[float, ...]]]:
        if after is self.flight:
            return [], []
        self.flight = after
        sent, rows = after.outbox, after.trace
        after.outbox, after.trace = [], []
        return sent, rows


def play(plan: Any, records: Iterable[Record], *, own: tuple[int, int]) -> Played:
    """Feed every frame that is not our own. Refused ones are counted by reason."""
    feeder, values, names = _Feeder(plan), array("d"), plan.trace_names
    refused: dict[str, int] = {}
    received = sent = 0
    for t_us, frame in records:
        if (frame.system, frame.component) == own:
            continue
        why = pipeline.accepts(plan, feeder.flight, frame)
        if why:
            refused[why] = refused.get(why, 0) + 1
            continue
        out, rows = feeder.feed(t_us, frame)
        received += 1
        sent += len(out)
        for row in rows:
            values.extend(row)
    trace = Trace(names, np.frombuffer(values, np.float64).reshape(-1, len(names)) if values else np.empty((0, len(names))))
    return Played(trace, feeder.flight, received, sent, refused)


def verify(
    plan: Any, records: Iterable[Record], *, own: tuple[int, int], then: Trace | None = None, exact: bool = True
) -> Verdict:
    """Feed the received frames; compare every frame that was sent, and every row of the trace `then`, with what comes now.

    A log that ends between a frame and its answers is whole, and so is a trace that ends before its log (a killed companion).
    Not `exact` (another processor, other versions): a field may differ in the last bit of a float32, a trace value by CLOSE.
    """
    if then is not None and then.names != plan.trace_names:
        different = sorted(set(then.names) ^ set(plan.trace_names))
        return Verdict(0, 0, 0, 0, math.inf, Parting(0, "trace", f"other columns than this version's: {', '.join(different)}"))
    feeder = _Feeder(plan)
    again: deque[tuple[int, bytes]] = deque()
    received = sent = number = 0
    largest = 0.0

    def verdict(parting: Parting | None) -> Verdict:
        return Verdict(received, sent, len(again), number, largest, parting)

    for t_us, frame in records:
        ours = (frame.system, frame.component) == own
        if not ours and again and again[0][0] < t_us:
            return verdict(_surplus(again))
        out, rows = feeder.feed(t_us, frame) if not ours else ([], []) if again else feeder.advance(t_us)
        again.extend(out)
        for row in rows:
            why = _row_differs(then, number, row, exact) if then is not None and number < len(then.rows) else ""
            if why:
                return verdict(Parting(t_us, f"trace, at {_name(frame.raw)}", why))
            number += 1
        if not ours:
            received += 1
            if again and again[0][0] < t_us:  # of a timer due before this frame, which the log lacks
                return verdict(_surplus(again))
            continue
        if not again:
            return verdict(Parting(t_us, _name(frame.raw), "in the log, not sent by the replay"))
        t_again, raw = again.popleft()
        sent += 1
        then_raw = wire.unsigned(frame.raw)  # a signature was put on by the shell
        if t_again != t_us or raw != then_raw:
            difference, why = _compare(then_raw, raw, t_us, t_again)
            largest = max(largest, difference)
            if exact or not difference <= WIRE_CLOSE:
                return verdict(Parting(t_us, _name(frame.raw), why))
    if then is not None and number < len(then.rows):
        why = f"{len(then.rows)} rows in flight, {number} in the replay of the whole log"
        return verdict(Parting(int(then.rows[number, 0]), "trace", why))
    return verdict(None)


def _surplus(again: "deque[tuple[int, bytes]]") -> Parting:
    t_us, raw = again[0]
    return Parting(t_us, _name(raw), "sent by the replay, not in the log")


def _row_differs(then: Trace, number: int, row: tuple[float, ...], exact: bool) -> str:
    """ "" where a row of the trace has come again, else which value has not."""
    if struct.pack(f"<{len(row)}d", *row) == then.rows[number].tobytes():
        return ""
    for name, a, b in zip(then.names, then.rows[number].tolist(), row, strict=True):
        same = struct.pack("<d", a) == struct.pack("<d", b)
        close = abs(a - b) <= CLOSE * max(1.0, abs(a), abs(b)) or (math.isnan(a) and math.isnan(b))
        if not same and (exact or not close):
            return f"{name} is {a!r} in flight, {b!r} in the replay (row {number}, vehicle time {int(then.rows[number, 0])} us)"
    return ""


def _message(raw: bytes) -> Any:
    return wire.decode(wire.split(raw)[0][0])


def _name(raw: bytes) -> str:
    try:
        return type(_message(raw)).__name__
    except (WireError, IndexError):
        return "a frame that cannot be read"


def _compare(logged: bytes, again: bytes, t_logged: int, t_again: int) -> tuple[float, str]:
    """How far two frames are apart (inf: not comparable), and that in words."""
    if t_logged != t_again:
        return math.inf, f"sent at {t_logged} us in the log, at {t_again} us in the replay"
    a, b = _message(logged), _message(again)
    if type(a).__name__ != type(b).__name__:
        return math.inf, f"the replay sends {type(b).__name__} instead"
    worst, words = 0.0, "the headers differ (sequence number or flags)"
    for field, x, y in zip(a._fields, a, b, strict=True):
        for i, (u, v) in enumerate(zip(x, y, strict=True) if isinstance(x, tuple) else [(x, y)]):
            apart = _apart(u, v)
            if apart > worst:
                place = f"{field}[{i}]" if isinstance(x, tuple) else field
                worst, words = apart, f"{place} is {u!r} in the log, {v!r} in the replay"
    return (worst if worst else math.inf), words


def _apart(u: Any, v: Any) -> float:
    if u == v or (isinstance(u, float) and isinstance(v, float) and math.isnan(u) and math.isnan(v)):
        return 0.0
    if isinstance(u, float) and isinstance(v, float) and math.isfinite(u - v):
        return abs(u - v) / max(1.0, abs(u), abs(v))
    return math.inf
