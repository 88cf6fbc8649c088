"""tlog bytes <-> (t_us, frame): each record is an 8-byte big-endian stamp in microseconds and one raw MAVLink frame.

Writing is unbuffered, so that a killed program leaves a log that is whole to its last frame. Reading streams
over any binary stream: junk between records is skipped and counted, and whatever is wrong with a file is said after every whole
message in it was handed out. Whole logs as columns: `mavquad.link.columns`.
"""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mavquad import wire
from mavquad.errors import LogError
from mavquad.wire import Frame

STAMP = 8
LAST_US = (1 << 63) - 1  # a stamp past it is read as this one, here and by columns, where stamps are signed
_CHUNK = 1 << 20
_RECORD = STAMP + wire.MAX_FRAME
_STX = re.compile(rb"[\xfd\xfe]")
OTHERS = (
    (b"ULog\x01\x12\x35", "a PX4 ULog"),
    (b"\xa3\x95\x80", "an ArduPilot DataFlash log"),
    (b"\x89MCAP", "an MCAP file"),
    (b"\x1f\x8b", "gzip: unpack it first"),
    (b"\x0a\x0d\x0d\x0a", "a packet capture"),
    (b"\xd4\xc3\xb2\xa1", "a packet capture"),
)


class Writer:
    """A new log at `path`. Raises LogError where it cannot be made or exists already (a recording is never overwritten)."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | getattr(os, "O_BINARY", 0)
        try:
            self._fd = os.open(self.path, flags, 0o644)
        except FileExistsError:
            raise LogError(f"{path}: exists already and is not overwritten; give another name or move it away") from None
        except OSError as error:
            raise LogError(f"{path}: cannot be written: {error.strerror}") from None

    def write(self, t_us: int, raw: bytes) -> None:
        """One frame with its stamp, in one unbuffered write. Raises LogError where the disk takes no more."""
        self.write_bytes(t_us, t_us.to_bytes(STAMP, "big") + raw)

    def write_all(self, records: list[tuple[int, bytes]]) -> None:
        """Many frames in one write: those of a datagram, or of a moment. Raises LogError as `write`."""
        parts: list[bytes] = []
        last_us, stamp = -1, b""
        for t_us, raw in records:
            if t_us != last_us:
                last_us, stamp = t_us, t_us.to_bytes(STAMP, "big")
            parts += (stamp, raw)
        if parts:
            self.write_bytes(last_us, b"".join(parts))

    def write_bytes(self, t_us: int, record: bytes) -> None:
        """Records as they are to lie in the log, of which the last is stamped t_us. Raises LogError as `write`."""
        try:
            written = os.write(self._fd, record)
            while written < len(record):  # a signal or a nearly full disk: the rest, or the reason
                written += os.write(self._fd, record[written:])
        except OSError as error:
            raise LogError(f"{self.path}: cannot write the frame at {t_us} us: {error.strerror}") from None

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __enter__(self) -> "Writer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Reader:
    """An iterator over (t_us, Frame), and what it has met so far: `messages`, `junk_bytes` (those between two records).

    Raises LogError where the stream is empty, is no tlog or ends inside a record: always after all whole messages were given.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self.name = str(getattr(stream, "name", "tlog"))
        self.messages = 0
        self.junk_bytes = 0
        self._stream = stream
        self._records = self._run()

    def __iter__(self) -> "Reader":
        return self

    def __next__(self) -> tuple[int, Frame]:
        return next(self._records)

    def _run(self) -> Iterator[tuple[int, Frame]]:
        data, at, base = b"", 0, 0  # `base` is the place in the stream of data[0]
        more_to_read = True
        synced = True  # the record before ended exactly here
        sync_at = 0  # place in the stream after the last whole record
        head = b""
        while True:
            if more_to_read and len(data) - at < 2 * _RECORD:
                more = self._stream.read(_CHUNK)
                more_to_read = bool(more)
                base, data, at = base + at, data[at:] + more, 0
                if not head:
                    head = data[:_RECORD]
                    refuse_others(self.name, head)
                continue
            if len(data) - at <= STAMP:
                break
            frame = self._frame(data, at, synced)
            if frame is not None:
                self.junk_bytes += base + at - sync_at
                self.messages += 1
                yield min(int.from_bytes(data[at : at + STAMP], "big"), LAST_US), frame
                at += STAMP + len(frame.raw)
                sync_at, synced = base + at, True
                continue
            found = _STX.search(data, at + STAMP + 1)
            at, synced = (found.start() if found else len(data)) - STAMP, False
        size = base + len(data)
        tail = data[sync_at - base :] if sync_at >= base else b"\xff"
        self.junk_bytes += judge_end(self.name, self.messages, size, size - sync_at, tail)

    def _frame(self, data: bytes, at: int, synced: bool) -> Frame | None:
        """The frame of a whole record at data[at:], else None. One of an unknown id (no CRC to check) counts only in its place."""
        start = at + STAMP
        end = start + _length(data, start)
        if end > len(data):
            return None
        frames, _, _ = wire.split(data[start:end])
        if len(frames) != 1 or len(frames[0].raw) != end - start:
            return None
        if frames[0].msgid not in wire.ID_SET:
            follows = data[end + STAMP : end + STAMP + 1]
            if not synced or (follows and not _STX.match(follows)):
                return None
        return frames[0]


def refuse_others(name: str, head: bytes) -> None:
    """Raises LogError for an empty file and for the formats that are told by their first bytes."""
    if not head:
        raise LogError(f"{name}: empty: 0 bytes, expected a tlog (8-byte stamp and MAVLink frame, again and again)")
    for magic, what in OTHERS:
        if head.startswith(magic):
            raise LogError(f"{name}: not a tlog but {what}")
    if _STX.match(head):
        length = _length(head, 0)
        if len(head) > length and _STX.match(head, length) and len(wire.split(head[:length])[0]) == 1:
            raise LogError(f"{name}: not a tlog but MAVLink frames without stamps; record it with 8-byte stamps")


def judge_end(name: str, messages: int, size: int, left: int, tail: bytes) -> int:
    """What the bytes after the last whole record are: `left` of `size`, `tail` the first of them. Returns how many are junk.

    Raises LogError where they are a cut record, or where there was no message at all.
    """
    cut = 0 < left < _RECORD and (left <= STAMP or _STX.match(tail, STAMP) is not None)
    if messages == 0 and cut:
        cut = tail[0] == 0  # no stamp before the year 4253 begins otherwise; a text file does
    if cut:
        raise LogError(f"{name}: truncated at byte {size}; {messages} whole messages read before it")
    if messages == 0:
        raise LogError(f"{name}: not a tlog: no MAVLink frame behind an 8-byte stamp in its {size} bytes")
    return left


def _length(data: bytes, start: int) -> int:
    """Bytes of the frame that begins at data[start], as its header says; too many where there is no header."""
    if start + 3 > len(data):
        return wire.MAX_FRAME
    if data[start] == wire.STX_V1:
        return 8 + data[start + 1]
    return 12 + data[start + 1] + (wire.SIGNATURE_LENGTH if data[start + 2] & wire.SIGNED else 0)


def read(stream: BinaryIO) -> Reader:
    """The records of a binary stream, one by one: `for t_us, frame in read(stream)`. See Reader for counts and errors."""
    return Reader(stream)
