"""A seeded mutator: the same seed gives the same junk. Bytes of frames and files, texts of TOML files, frames with a right CRC."""

import math
import random
import struct
from collections.abc import Callable

from fastcrc.crc16 import mcrf4xx

from mavquad import wire

_EDGES = (0x00, 0x01, 0x7F, 0x80, 0xFD, 0xFE, 0xFF)
FLOATS = tuple(
    struct.pack("<f", x) for x in (math.nan, math.inf, -math.inf, 0.0, -0.0, 1e38, -1e38, 1e-38, 1.0, -1.0, 4.2e9, 1e6, 3e-45)
)
_WORDS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e308",
    "-1e-9",
    '""',
    "[]",
    "{}",
    "true",
    "[[",
    "]]",
    "=",
    "#",
    '"',
    "\n",
    "é",
    "99999999999",
)


def data(rng: random.Random, raw: bytes, times: int = 0) -> bytes:
    """Some bytes changed, lost, doubled, moved."""
    out = bytearray(raw)
    for _ in range(times or 1 + int(rng.expovariate(0.7))):
        if not out:
            return bytes(rng.getrandbits(8) for _ in range(8))
        at, kind = rng.randrange(len(out)), rng.randrange(8)
        if kind == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            out[at] = rng.choice(_EDGES)
        elif kind == 2:
            out[at : at + 4] = rng.choice(FLOATS)
        elif kind == 3:
            del out[at : at + 1 + rng.randrange(12)]
        elif kind == 4:
            out[at:at] = out[at : at + 1 + rng.randrange(40)]
        elif kind == 5:
            out[at:at] = rng.randbytes(1 + rng.randrange(20))
        elif kind == 6:
            del out[at:]
        else:
            out[at] = rng.getrandbits(8)
    return bytes(out)


def sealed(rng: random.Random, raw: bytes) -> bytes:
    """A MAVLink 2 frame with the same id and a mutated payload, whose length and CRC are right: it reaches the handlers."""
    payload = bytearray(raw[10 : 10 + raw[1]])
    for _ in range(1 + rng.randrange(4)):
        at = rng.randrange(len(payload))
        if rng.random() < 0.6:
            at = at // 4 * 4
            payload[at : at + 4] = rng.choice(FLOATS)
        else:
            payload[at] = rng.getrandbits(8)
    if rng.random() < 0.1:
        del payload[1 + rng.randrange(len(payload)) :]
    if rng.random() < 0.1:
        payload += rng.randbytes(rng.randrange(30))
    return seal(raw, bytes(payload[:255]))


def seal(raw: bytes, payload: bytes) -> bytes:
    """A frame of the kind of `raw` around another payload."""
    body = raw[:1] + bytes([len(payload)]) + b"\0\0" + raw[4:10] + payload
    extra = bytes([wire.SPECS[int.from_bytes(raw[7:10], "little")].crc_extra])
    return body + mcrf4xx(body[1:] + extra).to_bytes(2, "little")


def text(rng: random.Random, words: str) -> str:
    """A text with numbers, names and lines changed."""
    out = words
    for _ in range(1 + rng.randrange(3)):
        lines = out.split("\n")
        at = rng.randrange(len(lines))
        change: Callable[[random.Random, str], str] = rng.choice((_value, _letter, _drop, _twice, _swap))
        lines[at] = change(rng, lines[at])
        out = "\n".join(lines)
    return out


def _value(rng: random.Random, line: str) -> str:
    name, found, _ = line.partition("=")
    return f"{name}= {rng.choice(_WORDS)}" if found else line + rng.choice(_WORDS)


def _letter(rng: random.Random, line: str) -> str:
    at = rng.randrange(len(line) + 1)
    return line[:at] + rng.choice((*_WORDS, "a", ".", "_", " ", "\t")) + line[at + rng.randrange(2) :]


def _drop(rng: random.Random, line: str) -> str:
    return ""


def _twice(rng: random.Random, line: str) -> str:
    return f"{line}\n{line}"


def _swap(rng: random.Random, line: str) -> str:
    return line.replace(".", "-", 1) if rng.random() < 0.5 else line.swapcase()
