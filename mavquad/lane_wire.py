"""MAVLink 2 frames inside a kernel, for the few messages of the fast lane: what `mavquad.wire` does from Python.

Frames are checked and written where they will be logged: eight bytes for the stamp, then the frame.

Source: MAVLink serialisation, https://mavlink.io/en/guide/serialization.html; CRC-32 (zlib's), eight bytes a step with eight tables
(Kounavis and Berry 2005, "slicing by 8").
"""

import numpy as np
from numpy.typing import NDArray

from mavquad.jit import kernel
from mavquad.link.scan import STAMP, crc_mcrf4xx, word

STX = 0xFD
HEADER, CRC = 10, 2


def _crc32_tables() -> NDArray[np.uint32]:
    table = np.zeros((8, 256), np.uint32)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
        table[0, byte] = crc
    for k in range(1, 8):
        before = table[k - 1]
        table[k] = before >> np.uint32(8) ^ table[0, before & np.uint32(0xFF)]
    return table


_T = _crc32_tables()
T0, T1, T2, T3, T4, T5, T6, T7 = (np.ascontiguousarray(row) for row in _T)


@kernel
def crc32(data, start, end, crc):
    """zlib.crc32 of data[start:end] that goes on from `crc`, both as int64."""
    low = np.uint64(0xFF)
    value = np.uint64(crc) ^ np.uint64(0xFFFFFFFF)
    at = start
    while at + 8 <= end:
        w = word(data, at) ^ value
        value = np.uint64(
            T7[w & low]
            ^ T6[w >> np.uint64(8) & low]
            ^ T5[w >> np.uint64(16) & low]
            ^ T4[w >> np.uint64(24) & low]
            ^ T3[w >> np.uint64(32) & low]
            ^ T2[w >> np.uint64(40) & low]
            ^ T1[w >> np.uint64(48) & low]
            ^ T0[w >> np.uint64(56)]
        )
        at += 8
    while at < end:
        value = value >> np.uint64(8) ^ np.uint64(T0[(value ^ np.uint64(data[at])) & low])
        at += 1
    return np.int64(value ^ np.uint64(0xFFFFFFFF))


@kernel
def take(data, table, system, component, log, places):
    """(frames, end of the log) of a datagram of whole frames, right, unsigned, of known messages and one sender; frames -1: of others.

    data (n,) uint8. table (65536,) int16: kind << 8 | CRC extra of each message, -1 unknown. log uint8: filled with room for each
    stamp; places (m,) int64: where each frame begins in it.
    """
    size, at, n, end = data.size, 0, 0, 0
    while at < size:
        if size - at < HEADER + CRC or data[at] != STX or data[at + 2] != 0:
            return -1, 0
        length = np.int64(data[at + 1])
        whole = HEADER + length + CRC
        number = message_id(data, at)
        if size - at < whole or n == places.size or end + STAMP + whole > log.size:
            return -1, 0
        if data[at + 5] != system or data[at + 6] != component or number >= table.size or table[number] < 0:
            return -1, 0
        first = end + STAMP
        for i in range(whole):
            log[first + i] = data[at + i]
        sum_ = crc_mcrf4xx(log, first + 1, first + HEADER + length, table[number] & 0xFF)
        if sum_ != np.uint64(data[at + whole - 2]) | np.uint64(data[at + whole - 1]) << np.uint64(8):
            return -1, 0
        places[n] = first
        n += 1
        at += whole
        end = first + whole
    return n, end


@kernel
def message_id(data, at):
    """Of the frame at data[at]."""
    return np.int64(data[at + 7]) | np.int64(data[at + 8]) << 8 | np.int64(data[at + 9]) << 16


@kernel
def whole(data, at):
    """Bytes of the frame at data[at]."""
    return HEADER + np.int64(data[at + 1]) + CRC


@kernel
def payload(data, at, to):
    """The payload of the frame at data[at] in `to` (m,) uint8: cut to its size, or with the zeros that the sender left out."""
    have = min(np.int64(data[at + 1]), to.size)
    for i in range(have):
        to[i] = data[at + HEADER + i]
    for i in range(have, to.size):
        to[i] = 0


@kernel
def stamped(log, at, t_us):
    """The stamp of a record at log[at], big-endian."""
    for i in range(STAMP):
        log[at + i] = t_us >> 8 * (STAMP - 1 - i) & 0xFF


@kernel
def put(log, at, t_us, number, extra, seq, system, component, body, length):
    """One record, stamp and frame, at log[at] with the first `length` bytes of `body` as its payload; where it ends."""
    while length > 1 and body[length - 1] == 0:  # zeros at the end are not sent
        length -= 1
    stamped(log, at, t_us)
    first = at + STAMP
    log[first], log[first + 1], log[first + 2], log[first + 3] = STX, length, 0, 0
    log[first + 4], log[first + 5], log[first + 6] = seq, system, component
    log[first + 7], log[first + 8], log[first + 9] = number & 0xFF, number >> 8 & 0xFF, number >> 16
    for i in range(length):
        log[first + HEADER + i] = body[i]
    end = first + HEADER + length
    sum_ = np.int64(crc_mcrf4xx(log, first + 1, end, extra))
    log[end], log[end + 1] = sum_ & 0xFF, sum_ >> 8
    return end + CRC
