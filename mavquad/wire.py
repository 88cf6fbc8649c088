"""MAVLink frames <-> named tuples: framing, CRC, signing. No units, frames of reference or signs.

Every table comes from pymavlink's own message classes (dialect `ardupilotmega`, a superset of `common`): any message it
knows is coded, nothing is typed by hand. A message is a NamedTuple of fields in MAVLink's declared order; arrays are tuples, texts
are `str` cut at the first NUL.

Source: MAVLink serialisation and signing, https://mavlink.io/en/guide/serialization.html, .../message_signing.html
"""

import hashlib
import hmac
import itertools
import re
import struct
from collections import namedtuple
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavquad.errors import WireError

STX_V1 = 0xFE
_STX = re.compile(rb"[\xfd\xfe]")
_BEGINS = (b"", b"\xfd", b"\xfe")  # what may follow a frame
STX_V2 = 0xFD
SIGNED = 0x01  # incompatibility flag
SIGNATURE_LENGTH = 13
MAX_FRAME = 10 + 255 + 2 + SIGNATURE_LENGTH
_HEADER_V2 = "<BHBBB3s"  # (STX,) length, two flags, sequence, system, component, message id
_READ_V2 = struct.Struct("<xBBxBBBHB").unpack_from  # the same as it is read, without STX and the second flags
_HEADER_V1 = struct.Struct("<BBBBBB")  # STX, length, sequence, system, component, message id
_CRC = struct.Struct("<H")
_ITEM = re.compile(r"(\d*)([a-zA-Z])")  # of a struct's format

_MISFITS = (struct.error, IndexError, TypeError, OverflowError)
_new = tuple.__new__


class Frame(NamedTuple):
    """One frame whose CRC is right, still as bytes."""

    raw: bytes
    msgid: int
    system: int
    component: int
    seq: int


def _text(value: str | bytes) -> bytes:
    return value.encode() if isinstance(value, str) else value


def _cut(value: bytes) -> str:
    return value.split(b"\0", 1)[0].decode("utf-8", "replace")


def _joined(items: list[str], at: int, there: int, text: bool) -> str:
    """The expression of a field from those of its items, of which the first is number `at` and `there` of all arrived."""
    if text:
        return f"cut({items[0]})" if at < there else "''"
    if len(items) == 1:
        return items[0]
    return f"v[{at}:{at + len(items)}]" if at + len(items) <= there else f"({', '.join(items)})"


class Spec:
    """How one message is laid out; `make(*fields)` is its NamedTuple."""

    __slots__ = (
        "_body",
        "_extra",
        "_pack",
        "_slots",
        "addressed",
        "crc_extra",
        "length",
        "make",
        "msgid",
        "name",
        "read",
        "struct",
    )

    def __init__(self, cls: Any) -> None:
        self.msgid: int = cls.id
        self.name: str = cls.msgname
        self.crc_extra: int = cls.crc_extra
        self._extra = bytes([cls.crc_extra])  # ends what is checked
        self.struct = struct.Struct(cls.unpacker.format)
        self.length = self.struct.size
        make: Any = namedtuple(cls.msgname, cls.fieldnames)  # type: ignore[misc]
        self.make = make
        self.addressed = "target_system" in cls.fieldnames
        wire_names = list(cls.ordered_fieldnames)
        kinds = dict(zip(cls.fieldnames, cls.fieldtypes, strict=True))
        texts = {name for name, n in zip(wire_names, cls.array_lengths, strict=True) if n and kinds[name] == "char"}
        # generated expressions with every item in its place: several times faster than loops over tables
        packed, slots, at = [], {}, 0
        for name, n in zip(wire_names, cls.lengths, strict=True):  # a text is one item of its struct, a numeric array many
            i = cls.fieldnames.index(name)
            packed.append(f"text(f[{i}])" if name in texts else f"*f[{i}]" if n > 1 else f"f[{i}]")
            slots[i] = (at, n, name in texts)
            at += n
        self._slots = [slots[i] for i in range(len(slots))]  # of each field: first item, items, whether it is a text
        names = {"pack": self.struct.pack, "whole": struct.Struct(_HEADER_V2 + self.struct.format[1:]).pack, "text": _text}
        start = f"{self.length}, 0, seq & 0xFF, system, component, {cls.id.to_bytes(3, 'little')!r}"
        self._pack: Any = eval(f"lambda f: pack({', '.join(packed)})", names)
        self._body: Any = eval(f"lambda f, seq, system, component: whole({start}, {', '.join(packed)})", names)
        self.read = _Readers(self.reader)

    def reader(self, length: int) -> Callable[[bytes, int], Any]:
        """The reader (bytes, where the payload begins) -> message of payloads of one length; what was trimmed are constants."""
        codes = [
            c for n, code in _ITEM.findall(self.struct.format) for c in ([n + code] if code == "s" else [code] * int(n or 1))
        ]
        sizes = list(itertools.accumulate(struct.calcsize(f"<{code}") for code in codes))
        if length > self.length:
            return self.read[self.length]
        if length not in sizes:  # cut within an item
            return lambda raw, at: self.unpack(raw[at : at + length])
        there = sizes.index(length) + 1
        zeros = self.struct.unpack(bytes(self.length))
        items = [f"v[{i}]" if i < there else repr(zero) for i, zero in enumerate(zeros)]
        fields = [_joined(items[at : at + n], at, there, text) for at, n, text in self._slots]
        plain = fields == items and there == len(items)  # all as they lie
        names = {
            "unpack": struct.Struct("<" + "".join(codes[:there])).unpack_from,
            "new": tuple.__new__,
            "make": self.make,
            "cut": _cut,
        }
        made = "unpack(raw, at)" if plain else f"(v := unpack(raw, at)) and ({', '.join(fields)},)"
        return eval(f"lambda raw, at: new(make, {made})", names)

    def unpack(self, payload: bytes) -> Any:
        """The message from its payload, zero-extended where the sender trimmed it."""
        return self.read[self.length](payload.ljust(self.length, b"\0"), 0)

    def pack(self, fields: tuple[Any, ...]) -> bytes:
        """The payload, untrimmed. Raises WireError where a field does not fit its type."""
        try:
            return self._pack(fields)
        except _MISFITS as error:
            raise self.misfit(fields, error) from None

    def misfit(self, fields: tuple[Any, ...], error: Exception) -> WireError:
        """Fields that `pack` cannot take."""
        return WireError(f"{self.name}{tuple(fields)!r} does not fit its layout {self.struct.format}: {error}")


class _Readers(dict[int, Callable[[bytes, int], Any]]):
    """Length of a payload -> its reader, made when first needed."""

    def __init__(self, reader: Callable[[int], Callable[[bytes, int], Any]]) -> None:
        super().__init__()
        self._reader = reader

    def __missing__(self, length: int) -> Callable[[bytes, int], Any]:
        made = self[length] = self._reader(length)
        return made


class _Specs(dict[int, Spec]):
    """Message id -> Spec, made when first asked for."""

    def __missing__(self, msgid: int) -> Spec:
        cls = dialect.mavlink_map.get(msgid)
        if cls is None:
            raise KeyError(msgid)
        spec = Spec(cls)
        self[msgid] = spec
        return spec


SPECS = _Specs()
_BY_NAME: dict[str, Spec] = {}  # those asked for
ID: dict[str, int] = {cls.msgname: msgid for msgid, cls in dialect.mavlink_map.items()}
NAME: dict[int, str] = {msgid: name for name, msgid in ID.items()}


def spec(name: str) -> Spec:
    """The layout of a message by its name. Raises WireError for a name no dialect knows."""
    try:
        found = _BY_NAME[name] = SPECS[ID[name]]
        return found
    except KeyError:
        raise WireError(f"no MAVLink message is called {name!r}; names are as in common.xml, e.g. 'ATTITUDE'") from None


def encode(name: str, fields: tuple[Any, ...], *, seq: int, system: int, component: int) -> bytes:
    """One unsigned MAVLink 2 frame. Raises WireError where the fields do not fit."""
    s = _BY_NAME.get(name) or spec(name)
    try:
        body = s._body(fields, seq, system, component)
    except _MISFITS as error:
        raise s.misfit(fields, error) from None
    if not body[-1]:  # zeros at the end are not sent
        payload = body[9:].rstrip(b"\0") or b"\0"
        body = bytes((len(payload),)) + body[1:9] + payload
    return b"\xfd" + body + _CRC.pack(mcrf4xx(body + s._extra))


def split(data: bytes) -> tuple[list[Frame], int, bytes]:
    """Whole frames in `data`, the number of bytes refused, and the rest that may be the beginning of a frame.

    A known message with a wrong CRC is refused byte by byte, so that a frame behind junk is still found. One of an unknown
    id cannot be checked: it is passed on where it begins at once behind a frame and another or nothing follows it (`decode` will
    say that it is unknown); in the remains of a spoiled frame it would swallow what comes next.
    """
    frames: list[Frame] = []
    refused = at = clean = 0  # clean: where the last frame ended
    size = len(data)
    while at < size:
        stx = data[at]
        if stx == STX_V2:
            if size - at < 10:
                break
            length, flags, seq, system, component, low, high = _READ_V2(data, at)
            msgid, crc_at = low | high << 16, at + 10 + length
            end = crc_at + 2
            if flags:
                if flags & ~SIGNED:  # flags that nobody understands: the frame must not be taken
                    at, refused = at + 1, refused + 1
                    continue
                end += SIGNATURE_LENGTH
        elif stx == STX_V1:
            if size - at < 6:
                break
            _, length, seq, system, component, msgid = _HEADER_V1.unpack_from(data, at)
            crc_at = at + 6 + length
            end = crc_at + 2
        else:
            found = _STX.search(data, at)
            after = found.start() if found else size
            at, refused = after, refused + after - at
            continue
        if end > size:
            break
        extra = _EXTRA.get(msgid)
        if (
            at != clean or data[end : end + 1] not in _BEGINS
            if extra is None
            else data[crc_at] | data[crc_at + 1] << 8 != mcrf4xx(data[at + 1 : crc_at] + extra)
        ):
            at, refused = at + 1, refused + 1
            continue
        frames.append(_new(Frame, (data[at:end], msgid, system, component, seq)))
        at = clean = end
    return frames, refused, data[at:]


_EXTRA = {msgid: bytes([cls.crc_extra]) for msgid, cls in dialect.mavlink_map.items()}
ID_SET = frozenset(ID.values())


def datagram(data: bytes) -> tuple[list[Frame], int]:
    """Whole frames in a datagram, and the number of bytes refused. Nothing follows it: a beginning that goes nowhere is junk too,

    so that a spoiled length hides none of the frames behind it.
    """
    frames, refused, rest = split(data)
    while rest:
        more, junk, rest = split(b"\0" + rest[1:])
        frames, refused = frames + more, refused + junk
    return frames, refused


def decode(frame: Frame) -> Any:
    """The message of a frame as its NamedTuple (class name = message name). Raises WireError for an unknown id."""
    try:
        s = SPECS[frame.msgid]
    except KeyError:
        raise WireError(f"message id {frame.msgid} from {frame.system}/{frame.component} is in no known dialect") from None
    raw = frame.raw
    return s.read[raw[1]](raw, 10 if raw[0] == STX_V2 else 6)


def addressee(frame: Frame) -> tuple[int, int]:
    """(system, component) a frame is addressed to; 0 for all, and for a message that has no such fields or is not known."""
    if frame.msgid not in ID_SET or not SPECS[frame.msgid].addressed:
        return 0, 0
    message = decode(frame)
    return getattr(message, "target_system", 0), getattr(message, "target_component", 0)


def parse(data: bytes) -> Iterator[tuple[Frame, Any]]:
    """(frame, message) of every known whole frame in a datagram; the rest is left out."""
    for frame in split(data)[0]:
        if frame.msgid in ID_SET:
            yield frame, decode(frame)


# ---- signing ------------------------------------------------------------------------------------------------------------
def sign(raw: bytes, key: bytes, link_id: int, timestamp_10us: int) -> bytes:
    """A signed copy of an unsigned MAVLink 2 frame: key (32,) bytes, timestamp in 10 us since 2015-01-01."""
    head = raw[:2] + bytes([raw[2] | SIGNED]) + raw[3:-2]
    checked = head + mcrf4xx(head[1:] + SPECS[int.from_bytes(raw[7:10], "little")]._extra).to_bytes(2, "little")
    tail = bytes([link_id]) + timestamp_10us.to_bytes(6, "little")
    return checked + tail + hashlib.sha256(key + checked + tail).digest()[:6]


def unsigned(raw: bytes) -> bytes:
    """A MAVLink 2 frame without its signature: as it was before `sign`. An unsigned one is returned as it is."""
    if raw[0] != STX_V2 or not raw[2] & SIGNED:
        return raw
    head = raw[:2] + bytes([raw[2] & ~SIGNED]) + raw[3 : -2 - SIGNATURE_LENGTH]
    return head + mcrf4xx(head[1:] + SPECS[int.from_bytes(raw[7:10], "little")]._extra).to_bytes(2, "little")


def is_signed(frame: Frame) -> bool:
    """Whether it carries a signature, right or wrong."""
    return frame.raw[0] == STX_V2 and bool(frame.raw[2] & SIGNED)


def verify(frame: Frame, key: bytes) -> tuple[int, int] | None:
    """(link id, timestamp in 10 us) of a frame whose signature the key made, else None."""
    if not is_signed(frame):
        return None
    body, signature = frame.raw[:-6], frame.raw[-6:]
    if not hmac.compare_digest(hashlib.sha256(key + body).digest()[:6], signature):
        return None
    return body[-7], int.from_bytes(body[-6:], "little")
