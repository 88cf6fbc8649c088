"""MAVLink frames made inside kernels: messages laid out over the words of records, queued as payloads, numbered when they leave.

A layout names, for each field of a message in MAVLink's declared order, a field of a record (its values follow one another) or a
constant. It becomes a template of the payload and moves: word of a record -> place in the payload. Every record counts as 8-byte
words, one record behind the other.

Source: MAVLink serialisation, https://mavlink.io/en/guide/serialization.html
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavquad import wire
from mavquad.jit import COMPILED, kernel

NEVER = 1 << 62
BODY = 296  # bytes of the longest frame, signed, in whole words
DATAGRAM = 1400  # bytes at most
STAMP = 8  # bytes before each frame of a log
FORWARDED = -1  # in place of a message id: the body is another's whole frame, which leaves as it came
_FLOAT = 0  # kind of a move; else the bytes of an integer
_SIZES = {"float": 4, "double": 8, "char": 1}
MOVE = np.dtype([("word", "i8"), ("kind", "i8"), ("at", "i8")])
MESSAGE = np.dtype(
    [
        ("due_us", "i8"),  # of a stream, and its interval
        ("interval_us", "i8"),
        ("laid_out", "i8"),  # a kernel can make it
        ("first", "i8"),  # its moves: first and behind the last
        ("last", "i8"),
        ("msgid", "i8"),
        ("length", "i8"),  # of the payload, untrimmed
        ("extra", "i8"),  # CRC_EXTRA
        ("template", "u1", 256),
    ]
)
SLOT = np.dtype([("due_us", "i8"), ("msgid", "i8"), ("length", "i8"), ("extra", "i8"), ("body", "u1", BODY)])
WIRE = np.dtype(
    [
        ("head", "i8"),  # slot of the oldest frame under way, and how many there are
        ("count", "i8"),
        ("next_us", "i8"),  # when the next stream is due
        ("delay_us", "i8"),
        ("seq", "i8"),
        ("system", "i8"),
        ("component", "i8"),
    ]
)


def _table() -> np.ndarray:
    """CRC-16/MCRF4XX of each byte."""
    crc = np.arange(256)
    for _ in range(8):
        crc = np.where(crc & 1, crc >> 1 ^ 0x8408, crc >> 1)
    return crc.astype(np.int64)


_CRC = _table()
_TIMESYNC = wire.spec("TIMESYNC")
_TIMESYNC_ID, _TIMESYNC_EXTRA = _TIMESYNC.msgid, _TIMESYNC.crc_extra


# ---- layouts --------------------------------------------------------------------------------------------------------------
Layout = Sequence[str | float | bytes | tuple[float, ...]]


class Tables(NamedTuple):
    """Messages (MESSAGE) by number, and the moves (MOVE) of all."""

    messages: np.ndarray
    moves: np.ndarray


def records(*dtypes: np.dtype) -> dict[str, tuple[int, int]]:
    """Field -> (its first word, how many) in records that lie one behind the other; all their fields are of 8 bytes."""
    found, base = {}, 0
    for dtype in dtypes:
        for name, (kind, offset, *_) in (dtype.fields or {}).items():
            found[name] = ((base + offset) // 8, kind.itemsize // 8)
        base += dtype.itemsize
    return found


def tables(layouts: Mapping[str, Layout | None], words: Mapping[str, tuple[int, int]]) -> Tables:
    """The tables of messages; those without a layout are left to Python."""
    messages = np.zeros(len(layouts), MESSAGE)
    moves: list[tuple[int, int, int]] = []
    for message, (name, layout) in zip(messages, layouts.items(), strict=True):
        spec = wire.spec(name)
        message["due_us"] = NEVER
        message["msgid"], message["length"], message["extra"] = spec.msgid, spec.length, spec.crc_extra
        message["first"] = len(moves)
        if layout is not None:
            items = _items(layout, words)
            template = spec.pack(fields(spec.msgid, [0 if isinstance(item, _Word) else item for item in items]))
            message["template"][: spec.length] = np.frombuffer(template, np.uint8)
            places = zip(items, _places(spec.msgid), strict=True)
            moves += [(item.word, kind, at) for item, (kind, at) in places if isinstance(item, _Word)]
            message["laid_out"] = 1
        message["last"] = len(moves)
    return Tables(as_kernels_take(messages), as_kernels_take(np.array(moves, MOVE)))


def as_kernels_take(array: np.ndarray) -> np.ndarray:
    """A structured array whose fields a kernel reads as attributes, compiled or not (see `state.Record`)."""
    return array if COMPILED else array.view(np.recarray)


class _Word(NamedTuple):
    """A word of the records, in place of a constant."""

    word: int


def _items(layout: Layout, words: Mapping[str, tuple[int, int]]) -> list[Any]:
    items: list[Any] = []
    for entry in layout:
        if isinstance(entry, str):
            first, many = words[entry]
            items += [_Word(first + i) for i in range(many)]
        else:
            items += entry if isinstance(entry, tuple) else [entry]
    return items


def fields(msgid: int, items: Sequence[Any]) -> tuple[Any, ...]:
    """Items as the fields of a message: an array is one field."""
    grouped, at = [], 0
    for many in _counts(msgid):
        grouped.append(tuple(items[at : at + many]) if many > 1 else items[at])
        at += many
    return tuple(grouped)


@functools.cache
def _counts(msgid: int) -> list[int]:
    """Items of each field in declared order; a text is one."""
    cls = dialect.mavlink_map[msgid]
    on_wire = dict(zip(cls.ordered_fieldnames, cls.lengths, strict=True))
    return [on_wire[name] for name in cls.fieldnames]


def _places(msgid: int) -> list[tuple[int, int]]:
    """(kind, offset in the payload) of each item in declared order."""
    cls = dialect.mavlink_map[msgid]
    types, at, found = dict(zip(cls.fieldnames, cls.fieldtypes, strict=True)), 0, {}
    for name, many, letters in zip(cls.ordered_fieldnames, cls.lengths, cls.array_lengths, strict=True):
        size = _SIZES.get(types[name]) or np.dtype(types[name].removesuffix("_t")).itemsize
        found[name] = [(_FLOAT if types[name] == "float" else size, at + i * size) for i in range(many)]
        at += size * max(many, letters)
    return [place for name in cls.fieldnames for place in found[name]]


# ---- kernels --------------------------------------------------------------------------------------------------------------
@kernel
def bits(value, kind):
    """What is sent of a word: a float of 4 bytes, or an integer."""
    return np.int64(np.float32(value).view(np.int32)) if kind == _FLOAT else np.int64(np.float64(value).view(np.int64))


@kernel
def payload(message, moves, words, more, body):
    """A message's payload, untrimmed: its template, and what its moves take from the words of two blocks of records."""
    for i in range(message.length):
        body[i] = message.template[i]
    for i in range(message.first, message.last):
        move = moves[i]
        value = words[move.word] if move.word < words.shape[0] else more[move.word - words.shape[0]]
        sent = bits(value, move.kind)
        for k in range(4 if move.kind == _FLOAT else move.kind):
            body[move.at + k] = sent >> (8 * k) & 0xFF


@kernel
def frame(body, length, msgid, extra, seq, system, component, out, at):
    """A MAVLink 2 frame of a payload at out[at:]: where it ends."""
    while length > 1 and body[length - 1] == 0:  # zeros at the end are not sent
        length -= 1
    out[at], out[at + 1], out[at + 2], out[at + 3] = 0xFD, length, 0, 0
    out[at + 4], out[at + 5], out[at + 6] = seq & 0xFF, system, component
    out[at + 7], out[at + 8], out[at + 9] = msgid & 0xFF, msgid >> 8 & 0xFF, msgid >> 16 & 0xFF
    end = at + 10 + length
    for i in range(length):
        out[at + 10 + i] = body[i]
    crc = 0xFFFF
    for i in range(at + 1, end):
        crc = _CRC[(crc ^ np.int64(out[i])) & 0xFF] ^ crc >> 8
    crc = _CRC[(crc ^ extra) & 0xFF] ^ crc >> 8
    out[end], out[end + 1] = crc & 0xFF, crc >> 8
    return end + 2


@kernel
def stamp(t_us, out, at):
    """The stamp of a log's record: where it ends."""
    for k in range(STAMP):
        out[at + k] = t_us >> (56 - 8 * k) & 0xFF
    return at + STAMP


@kernel
def slot(w, slots, due_us, msgid, length, extra):
    """The next free slot, filled but for its body."""
    new = slots[(w.head + w.count) % slots.shape[0]]
    w.count += 1
    new.due_us, new.msgid, new.length, new.extra = due_us, msgid, length, extra
    return new


@kernel
def enter(wire, slots, due_us, msgid, length, extra, data):
    """Queue a payload, or another's whole frame."""
    new = slot(wire[0], slots, due_us, msgid, length, extra)
    for i in range(length):
        new.body[i] = data[i]


@kernel
def emit(t_us, rank, w, streams, moves, slots, words, more, all_laid_out):
    """Queue the streams due, from number `rank` on: -1 when all are, else the number of one that Python has to make.

    w.next_us is left as the next instant of any stream.
    """
    for k in range(rank, streams.shape[0]):
        m = streams[k]
        if m.due_us <= t_us:
            m.due_us += m.interval_us
            if not m.laid_out or not all_laid_out:
                return k
            new = slot(w, slots, t_us + w.delay_us, m.msgid, m.length, m.extra)
            payload(m, moves, words, more, new.body)
    w.next_us = NEVER
    for k in range(streams.shape[0]):
        w.next_us = min(w.next_us, streams[k].due_us)
    return -1


@kernel
def leave(wire, slots, t_us, stamp_us, barrier_ns, out, log, cuts):
    """Frames due by t_us, then TIMESYNC with barrier_ns (none below 0), into `out` and, with stamps, into `log`.

    Returns (frames of ours, bytes in `out`, bytes in `log`, cuts): the datagrams of `out` end at cuts[:cuts] and at its end.
    """
    w = wire[0]
    ours = end = logged = parts = begun = 0
    while True:
        old = slots[w.head % slots.shape[0]]
        barrier = w.count == 0 or old.due_us > t_us
        if barrier and barrier_ns < 0:
            break
        at = end
        if not barrier and old.msgid == FORWARDED:
            for i in range(old.length):
                out[end + i] = old.body[i]
            end += old.length
        elif barrier:
            body = log[logged + STAMP + 10 : logged + STAMP + 28]  # a moment before it is written
            for k in range(8):
                body[k], body[8 + k] = 0, barrier_ns >> (8 * k) & 0xFF
            body[16], body[17] = 0, 0
            end = frame(body, 18, _TIMESYNC_ID, _TIMESYNC_EXTRA, w.seq, w.system, w.component, out, end)
        else:
            end = frame(old.body, old.length, old.msgid, old.extra, w.seq, w.system, w.component, out, end)
        if barrier or old.msgid != FORWARDED:
            w.seq = w.seq + 1 & 0xFF
            ours += 1
        logged = stamp(stamp_us, log, logged)
        for i in range(at, end):
            log[logged + i - at] = out[i]
        logged += end - at
        if end - begun > DATAGRAM and at > begun:
            cuts[parts] = begun = at
            parts += 1
        if barrier:
            break
        w.head = (w.head + 1) % slots.shape[0]
        w.count -= 1
    return ours, end, logged, parts
