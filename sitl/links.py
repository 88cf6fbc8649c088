"""One peer of the autopilot: its own sequence counter and stream rates, and what the wire does to frames on the way.

Delay and jitter hold frames back before they get their sequence number, so that the lockstep barrier, which waits for nothing,
keeps its place in the sequence. Then the wire may lose, double, corrupt or hold back what has a number. All of it in vehicle time
and seeded, so it works in lockstep.
"""

import heapq
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from mavquad import wire
from sitl import config, frames
from sitl.frames import DATAGRAM, NEVER
from sitl.ring import Ring

Message = tuple[str, tuple[Any, ...]]  # name and fields, not yet a frame


def faulty(link: config.Link) -> bool:
    """Whether the wire may do more to a frame than hold it back."""
    return bool(link.loss or link.duplicate or link.reorder or link.corrupt or link.silences)


class Queue:
    """What is on its way. `due_us` is when the next item arrives (NEVER when none does); `counts` what the wire did."""

    def __init__(self, link: config.Link, rng: np.random.Generator) -> None:
        self.due_us = NEVER
        self.counts = dict.fromkeys(("lost", "duplicated", "reordered", "corrupted"), 0)
        self._link = link
        self._rng, self._chance = rng, rng.spawn(1)[0]  # of what is put in and of what comes out: neither waits for the other
        self._delay_us, self._jitter_us = round(1000.0 * link.delay_ms), 1000.0 * link.jitter_ms
        self._silences = [(round(1e6 * a), round(1e6 * b)) for a, b in link.silences]
        self.faulty = faulty(link)
        self._waiting: deque[tuple[int, Any]] = deque()
        self._held: list[tuple[int, int, bytes]] = []
        self._latest_us = self._holds = 0

    def put(self, t_us: int, item: Any) -> None:
        """Something to send at t_us."""
        due_us = t_us + self._delay_us
        if self._jitter_us:  # never overtakes
            self._latest_us = due_us = max(self._latest_us, due_us + int(self._jitter_us * self._rng.random()))
        self._waiting.append((due_us, item))
        self.due_us = min(self.due_us, due_us)

    def take(self, t_us: int, frame: Callable[[Any], Any]) -> list[Any]:
        """Every frame that has arrived by t_us, in the order of arrival; `frame` makes one (bytes, if `faulty`) of what was put."""
        if self.due_us > t_us:
            return []
        waiting, out = self._waiting, []
        while waiting and waiting[0][0] <= t_us:
            due_us, item = waiting.popleft()
            raw = frame(item)
            if self.faulty:
                out += self._spoil(due_us, raw)
            else:
                out.append(raw)
        while self._held and self._held[0][0] <= t_us:
            out.append(heapq.heappop(self._held)[2])
        self.due_us = min(waiting[0][0] if waiting else NEVER, self._held[0][0] if self._held else NEVER)
        return out

    def _spoil(self, t_us: int, raw: bytes) -> list[bytes]:
        """What the wire makes of one frame: none, one or two."""
        link, rng = self._link, self._chance
        if any(a <= t_us < b for a, b in self._silences) or (link.loss and rng.random() < link.loss):
            self.counts["lost"] += 1
            return []
        if link.corrupt and rng.random() < link.corrupt:
            self.counts["corrupted"] += 1
            at = int(rng.integers(len(raw)))
            raw = raw[:at] + bytes([raw[at] ^ int(rng.integers(1, 256))]) + raw[at + 1 :]
        if link.reorder and rng.random() < link.reorder:
            self.counts["reordered"] += 1
            self._holds += 1
            heapq.heappush(self._held, (t_us + round(1000.0 * link.reorder_ms), self._holds, raw))
            return []
        if link.duplicate and rng.random() < link.duplicate:
            self.counts["duplicated"] += 1
            return [raw, raw]
        return [raw]


class Stream:
    """One message that is sent again and again: `build()` gives its fields, or None when there is nothing to say."""

    __slots__ = ("build", "due_us", "interval_us", "msgid", "name", "rank")  # due_us: unless a `Ring` keeps it

    def __init__(self, name: str, rank: int, build: Callable[[], tuple[Any, ...] | None]) -> None:
        self.name, self.rank, self.build = name, rank, build
        self.msgid = wire.ID[name]
        self.interval_us = 0  # off
        self.due_us = NEVER

    def every(self, interval_us: int, t_us: int) -> None:
        """Send at multiples of interval_us from now on; 0 is off."""
        self.interval_us = interval_us
        self.due_us = (t_us // interval_us + 1) * interval_us if interval_us else NEVER


class Link:
    """One peer: what it was promised, what is under way to and from it, who speaks there. `ring` is `down` where kernels fill it."""

    def __init__(self, index: int, sitl: config.Sitl, streams: list[Stream], tables: frames.Tables | None = None) -> None:
        self.index = index
        self.system, self.component = sitl.system, sitl.component
        self.offered, self.streams = streams, {s.name: s for s in streams}
        self.ordered: list[Stream] = []  # those that are on, in the order in which they are sent
        self.speakers: set[tuple[int, int]] = set()
        self.ring = None if tables is None else Ring(sitl, tables)
        self.down = self.ring or Queue(sitl.link, np.random.default_rng([sitl.seed, 1000 + index, 0]))
        self.up = Queue(sitl.link, np.random.default_rng([sitl.seed, 1000 + index, 1]))
        self.sent = self.received = self.refused = 0
        self._seq = 0

    def set_interval(self, name: str, interval_us: int, t_us: int) -> None:
        """Turn a stream on (interval > 0) or off (0)."""
        stream = self.streams[name]
        stream.every(interval_us, t_us)
        if self.ring is not None:
            self.ring.every(stream.rank, interval_us, stream.due_us)
        self.ordered = sorted((s for s in self.streams.values() if s.interval_us), key=lambda s: s.rank)

    @property
    def due_us(self) -> int:
        """When the next stream is due."""
        if self.ring is not None:
            return int(self.ring.wire["next_us"])
        return min((stream.due_us for stream in self.ordered), default=NEVER)

    def restart(self) -> None:
        """The autopilot has booted again: its sequence starts anew."""
        self._seq = 0
        if self.ring is not None:
            self.ring.restart()

    def encode(self, message: Message) -> bytes:
        """The next frame of ours on this link."""
        raw = wire.encode(*message, seq=self._seq, system=self.system, component=self.component)
        self._seq = (self._seq + 1) & 0xFF
        self.sent += 1
        return raw


def datagrams(frames: list[bytes]) -> list[bytes]:
    """Frames packed, in order, into as few datagrams as fit."""
    packed: list[bytes] = []
    part: list[bytes] = []
    size = 0
    for raw in frames:
        if size + len(raw) > DATAGRAM and part:
            packed.append(b"".join(part))
            part, size = [], 0
        part.append(raw)
        size += len(raw)
    if part:
        packed.append(b"".join(part))
    return packed
