"""Whole logs at memory speed: a tlog as structured NumPy columns by (system, component, message).

The file is mapped, one compiled pass finds the frames whose CRC is right, and a stream becomes columns when it is asked for. The
layout of every message comes from pymavlink's own classes of any dialect; nothing is typed by hand.
"""

import hashlib
import importlib
import mmap
import os
import re
from collections.abc import Iterator
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mavquad import wire
from mavquad.errors import LogError
from mavquad.link import scan, tlog
from mavquad.wire import Frame

_RECORD = 40  # bytes that a record has at least, as a rule: so the first block of the index usually holds the whole log
_ITEM = re.compile(r"(\d*)([a-zA-Z])")
_TYPE = {"b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8", "f": "<f4", "d": "<f8"}


class Stream(NamedTuple):
    """One kind of message from one sender."""

    system: int
    component: int
    msgid: int
    name: str  # "UNKNOWN_437" where the dialect has none
    messages: int


class Layout(NamedTuple):
    """Of one message: the payload's length in full, and its columns with `t_us` before and `frame_seq` behind."""

    length: int
    dtype: np.dtype[Any]


class Dialect:
    """The tables of one of pymavlink's dialects."""

    def __init__(self, name: str) -> None:
        try:
            module = importlib.import_module(f"pymavlink.dialects.v20.{name}")
        except ImportError:
            known = sorted(p.stem for p in Path(wire.dialect.__file__).parent.glob("*.py") if p.stem != "__init__")
            raise LogError(f"pymavlink has no dialect {name!r}; known: {', '.join(known)}") from None
        self.classes: dict[int, Any] = module.mavlink_map
        self.ids = {cls.msgname: msgid for msgid, cls in self.classes.items()}
        self.crc_extra = np.full(max(self.classes) + 1, -1, np.int16)
        for msgid, cls in self.classes.items():
            self.crc_extra[msgid] = cls.crc_extra
        self._layouts: dict[int, Layout] = {}

    def name(self, msgid: int) -> str:
        cls = self.classes.get(msgid)
        return cls.msgname if cls else f"UNKNOWN_{msgid}"

    def layout(self, msgid: int) -> Layout:
        """Fields in MAVLink's declared order at their places on the wire; texts as bytes ('S'), arrays as sub-arrays."""
        if msgid not in self._layouts:
            self._layouts[msgid] = _layout(self.classes[msgid])
        return self._layouts[msgid]


def _layout(cls: Any) -> Layout:
    items: dict[str, tuple[Any, int]] = {}
    at = scan.STAMP
    for name, (count, code) in zip(cls.ordered_fieldnames, _ITEM.findall(cls.unpacker.format), strict=True):
        n = int(count or 1)
        if code in "sc":
            items[name] = (f"S{n}", at)
            at += n
        else:
            items[name] = (_TYPE[code] if n == 1 else (_TYPE[code], (n,)), at)
            at += n * int(_TYPE[code][-1])
    names = ["t_us", *cls.fieldnames, "frame_seq"]
    formats = ["<i8", *[items[name][0] for name in cls.fieldnames], "u1"]
    offsets = [0, *[items[name][1] for name in cls.fieldnames], at]
    size = -(-(at + 1) // 8) * 8
    return Layout(at - scan.STAMP, np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size}))


@lru_cache(maxsize=8)
def dialect(name: str = "ardupilotmega") -> Dialect:
    """The tables of a dialect by pymavlink's name of it. Raises LogError for one it does not have."""
    return Dialect(name)


class Log:
    """A whole tlog, open for reading.

    `streams` are its kinds of messages in order of appearance, `t_us` (n,) the stamps of all messages in the order of the file,
    `junk_bytes` what was skipped, `signed` how many messages carry a signature, `problem` what is wrong with the file ('' nothing:
    a log that was cut is read to its last whole message). Raises LogError for a file that is missing, empty or no tlog.
    """

    def __init__(self, path: Path | str, dialect_name: str = "ardupilotmega") -> None:
        self.path = Path(path)
        self.dialect = dialect(dialect_name)
        self._data = _map(self.path)
        self.size = self._data.size
        self.problem = ""
        self._scan()

    def _scan(self) -> None:
        key_of, count, place, done = np.zeros(64, np.int64), 0, scan.Place(0, 0, 0, 0), False
        keys, slots = np.full(128, -1, np.int64), np.zeros(128, np.uint16)
        parts = []
        while not done:
            if 2 * count >= keys.size:
                keys, slots = np.full(4 * keys.size, -1, np.int64), np.zeros(4 * keys.size, np.uint16)
                key_of = np.concatenate([key_of, np.zeros(keys.size // 2 - key_of.size, np.int64)])
                scan.rehash(key_of, count, keys, slots)
            room = (self.size - int(place.at)) // _RECORD + 1000
            block = (np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.uint16))
            n, count, place, done = scan.find(self._data, place, self.dialect.crc_extra, keys, slots, key_of, count, *block)
            parts.append(tuple(array[:n] for array in block))
        index = parts[0] if len(parts) == 1 else [np.concatenate(column) for column in zip(*parts, strict=True)]
        self.t_us, self._at, self._stream = scan.Index(*index)
        counts = np.bincount(self._stream, minlength=count)
        self.streams = [
            Stream(int(key >> 8 & 0xFF), int(key & 0xFF), int(key >> 16), self.dialect.name(int(key >> 16)), int(n))
            for key, n in zip(key_of[:count], counts, strict=True)
        ]
        self.signed = int(place.signed)
        self.junk_bytes = int(place.junk_bytes)
        left = self.size - int(place.sync_at)
        try:
            tail = self._data[self.size - left :][:512].tobytes()
            self.junk_bytes += tlog.judge_end(str(self.path), len(self), self.size, left, tail)
        except LogError as error:
            if not len(self):
                raise
            self.problem = str(error)

    def __len__(self) -> int:
        return int(self.t_us.size)

    def find(self, name: str, system: int | None = None, component: int | None = None) -> list[Stream]:
        """The streams of a message, from every sender or from those given."""
        return [s for s in self.streams if s.name == name and system in (None, s.system) and component in (None, s.component)]

    def columns(
        self,
        name: str,
        system: int | None = None,
        component: int | None = None,
        *,
        start_us: int | None = None,
        end_us: int | None = None,
    ) -> NDArray[Any]:
        """The messages called `name` as one structured array (n,): `t_us`, the message's own fields, `frame_seq`.

        Only stamps in [start_us, end_us) where given. Raises LogError where the log has none, or from several senders and none
        was chosen.
        """
        found = self.find(name, system, component)
        if len(found) != 1:
            raise LogError(f"{self.path}: {self._why_not_one(name, found)}")
        return self.rows(found[0], start_us=start_us, end_us=end_us)

    def rows(self, stream: Stream, *, start_us: int | None = None, end_us: int | None = None) -> NDArray[Any]:
        """The messages of one stream as one structured array; see `columns`."""
        if stream.msgid not in self.dialect.classes:
            raise LogError(f"{self.path}: message id {stream.msgid} is in no table of this dialect; try another, e.g. 'all'")
        numbers = self.numbers(stream)
        if start_us is not None or end_us is not None:
            numbers = numbers[_within(self.t_us[numbers], start_us, end_us)]
        length, kind = self.dialect.layout(stream.msgid)
        words = np.zeros(numbers.size * (kind.itemsize // 8), "<u8")
        scan.copy_rows(self._data, self._at, self.t_us, numbers, length, kind.itemsize // 8, words)
        return words.view(kind)

    def everything(self) -> dict[Stream, NDArray[Any]]:
        """The rows of every stream whose message is known, made in one pass."""
        layouts = [self.dialect.layout(s.msgid) if s.msgid in self.dialect.classes else None for s in self.streams]
        length = np.array([layout.length if layout else 0 for layout in layouts], np.int64)
        row_words = np.array([layout.dtype.itemsize // 8 if layout else 0 for layout in layouts], np.int64)
        border = np.cumsum([0, *(row_words * [s.messages for s in self.streams])])
        words = np.zeros(int(border[-1]), "<u8")
        first = np.where(row_words > 0, border[:-1], -1)
        scan.copy_all(self._data, self._at, self.t_us, self._stream, length, row_words, first, words)
        return {
            stream: words[a:b].view(layout.dtype)
            for stream, layout, a, b in zip(self.streams, layouts, border[:-1], border[1:], strict=True)
            if layout
        }

    def numbers(self, stream: Stream) -> NDArray[np.int64]:
        """Which messages of the log belong to a stream, in the order of the file."""
        order, border = self._by_stream
        s = self.streams.index(stream)
        return order[border[s] : border[s + 1]]

    @cached_property
    def _by_stream(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        order, border = scan.order_by_stream(self._stream, len(self.streams))
        return order, border

    def between(self, start_us: int | None = None, end_us: int | None = None) -> NDArray[np.int64]:
        """Numbers of all messages with a stamp in [start_us, end_us), in the order of the file."""
        return np.flatnonzero(_within(self.t_us, start_us, end_us))

    def position(self, number: int) -> int:
        """The byte of the file where the record of a message begins."""
        return int(self._at[number]) - scan.STAMP

    def frame(self, number: int) -> tuple[int, Frame]:
        """(t_us, frame) of any message by its number in the file."""
        start = int(self._at[number])
        raw = self._data[start : start + int(scan.frame_length(self._data, start))].tobytes()
        stream = self.streams[int(self._stream[number])]
        seq = raw[4] if raw[0] == wire.STX_V2 else raw[2]
        return int(self.t_us[number]), Frame(raw, stream.msgid, stream.system, stream.component, seq)

    def frames(self, start_us: int | None = None, end_us: int | None = None) -> Iterator[tuple[int, Frame]]:
        """(t_us, frame) of all messages of a time span, as `tlog.read` gives them."""
        return (self.frame(int(i)) for i in self.between(start_us, end_us))

    def signatures(self, key: bytes) -> NDArray[np.int8]:
        """Per message: 1 signed with this key (32 bytes), -1 signed otherwise, 0 not signed."""
        verdict = np.zeros(len(self), np.int8)
        if self.signed:
            v2 = self._data[self._at] == wire.STX_V2
            for i in map(int, np.flatnonzero(v2 & (self._data[np.minimum(self._at + 2, self.size - 1)] & wire.SIGNED != 0))):
                raw = self.frame(i)[1].raw
                verdict[i] = 1 if hashlib.sha256(key + raw[:-6]).digest()[:6] == raw[-6:] else -1
        return verdict

    def _why_not_one(self, name: str, found: list[Stream]) -> str:
        if found:
            senders = ", ".join(f"{s.system}/{s.component}" for s in found)
            return f"{name} comes from {senders}: say which system and component"
        senders = ", ".join(f"{s.system}/{s.component}" for s in self.streams if s.name == name)
        if senders:
            return f"no {name} from that sender; it comes from {senders}"
        names = sorted({s.name for s in self.streams})
        return f"no {name} in it; it holds {', '.join(names[:12])}{' ...' if len(names) > 12 else ''}"


def _within(t_us: NDArray[np.int64], start_us: int | None, end_us: int | None) -> NDArray[np.bool_]:
    inside = np.ones(t_us.size, np.bool_)
    if start_us is not None:
        inside &= t_us >= start_us
    if end_us is not None:
        inside &= t_us < end_us
    return inside


def _map(path: Path) -> NDArray[np.uint8]:
    """The bytes of a file without reading them. Raises LogError where there is none, or of another kind."""
    try:
        with path.open("rb") as stream:
            tlog.refuse_others(str(path), stream.read(512))
            size = os.fstat(stream.fileno()).st_size
            return np.frombuffer(mmap.mmap(stream.fileno(), size, access=mmap.ACCESS_READ), np.uint8)
    except FileNotFoundError:
        raise LogError(f"{path}: no such file") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
