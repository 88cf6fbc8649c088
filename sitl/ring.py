"""What is under way to one peer over a wire that only delays: payloads in slots, made, numbered and framed by kernels.

Jitter, losses and signatures need a look at each frame: `links.Queue` is for those.
"""

from itertools import pairwise
from typing import Any

import numpy as np

from mavquad import wire
from sitl import config, frames
from sitl.frames import BODY, NEVER, SLOT, STAMP, WIRE
from sitl.state import Record

_SLOTS = 128  # at first


class Ring:
    """The slots of one peer and its streams (`frames.MESSAGE`). `wire` is the record that kernels keep."""

    def __init__(self, sitl: config.Sitl, tables: frames.Tables) -> None:
        self.streams, self.moves = tables.messages.copy(), tables.moves
        delay_us = round(1000.0 * sitl.link.delay_ms)
        self.wire = Record(WIRE, next_us=NEVER, delay_us=delay_us, system=sitl.system, component=sitl.component)
        self._delay_us = delay_us
        self._make(_SLOTS)

    def put(self, t_us: int, item: Any) -> None:
        """A message (name, fields), or another's frame as bytes, to send at t_us. Raises WireError where fields do not fit."""
        self.room(1)
        if isinstance(item, bytes):
            self._enter(t_us, frames.FORWARDED, 0, item)
        else:
            spec = wire.spec(item[0])
            self._enter(t_us, spec.msgid, spec.crc_extra, spec.pack(item[1]))

    def every(self, rank: int, interval_us: int, due_us: int) -> None:
        """A stream's interval and when it is due first (NEVER: it is off)."""
        self.streams[rank]["interval_us"], self.streams[rank]["due_us"] = interval_us, due_us
        self.wire["next_us"] = int(self.streams["due_us"].min())

    def leave(self, t_us: int, stamp_us: int, barrier_ns: int) -> tuple[int, list[bytes], bytes]:
        """What arrives by t_us and, from 0 on, a TIMESYNC of barrier_ns: (frames of ours, datagrams, the log's records of them)."""
        out = self._out
        ours, end, logged, parts = frames.leave(
            self.wire.array, self.slots, t_us, stamp_us, barrier_ns, out, self._log, self._cuts
        )
        if not end:
            return 0, [], b""
        if not parts:
            return ours, [out[:end].tobytes()], self._log[:logged].tobytes()
        cuts = [0, *self._cuts[:parts].tolist(), end]
        datagrams = [out[a:b].tobytes() for a, b in pairwise(cuts)]
        return ours, datagrams, self._log[:logged].tobytes()

    def restart(self) -> None:
        """The sequence starts anew."""
        self.wire["seq"] = 0

    def room(self, many: int) -> None:
        """Make sure that `many` more frames find a slot."""
        count, size = self.wire["count"], len(self.slots)
        if count + many <= size:
            return
        order = (self.wire["head"] + np.arange(count)) % size
        waiting = self.slots[order]
        self._make(2 * max(size, count + many))
        self.slots[:count] = waiting
        self.wire["head"] = 0

    def _make(self, size: int) -> None:
        self.slots = frames.as_kernels_take(np.zeros(size, SLOT))
        self._out = np.zeros((size + 1) * BODY, np.uint8)
        self._log = np.zeros((size + 1) * (BODY + STAMP), np.uint8)
        self._cuts = np.zeros(size + 1, np.int64)
        self.arrays = self.wire.array, self.streams, self.moves, self.slots  # what kernels that speak work on

    def _enter(self, t_us: int, msgid: int, extra: int, data: bytes) -> None:
        body = np.frombuffer(data, np.uint8)
        frames.enter(self.wire.array, self.slots, t_us + self._delay_us, msgid, len(data), extra, body)
