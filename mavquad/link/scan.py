"""Compiled passes over the bytes of a tlog: find records with their CRC, sort them into streams, copy a stream into rows.

The rule of what counts as a message is that of `tlog.Reader`; the two are tested against each other.

Source: MAVLink serialisation, https://mavlink.io/en/guide/serialization.html; CRC-16/MCRF4XX, eight bytes a step with eight
tables (Kounavis and Berry 2005, "slicing by 8").
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mavquad.jit import kernel

STAMP = 8
STX_V1 = 0xFE
STX_V2 = 0xFD
SIGNATURE_LENGTH = 13
_LAST = np.uint64(2**63 - 1)  # a stamp past it is read as this one: stamps are signed
_HASH = 40503  # 2^16 over the golden ratio: keys of 40 bits stay within int64


def _crc_tables() -> NDArray[np.uint16]:
    table = np.zeros((8, 256), np.uint16)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
        table[0, byte] = crc
    for k in range(1, 8):
        before = table[k - 1]
        table[k] = before >> 8 ^ table[0, before & 0xFF]
    return table


_T = _crc_tables()
T0, T1, T2, T3, T4, T5, T6, T7 = (np.ascontiguousarray(row) for row in _T)


def _before() -> NDArray[np.uint64]:
    """The register from which k zero bytes lead to 0xFFFF, k = 0..7: the step of one byte, backwards."""
    high = {int(entry) >> 8: byte for byte, entry in enumerate(T0)}  # every high byte stands once in the table
    found = [0xFFFF]
    for _ in range(7):
        byte = high[found[-1] >> 8]
        found.append((found[-1] ^ int(T0[byte])) << 8 & 0xFF00 | byte)
    return np.array(found, np.uint64)


BEFORE = _before()


class Index(NamedTuple):
    """Where each message of a log is, in the order of the file."""

    t_us: NDArray[np.int64]
    at: NDArray[np.int64]  # byte of the frame's STX
    stream: NDArray[np.uint16]  # which (system, component, message)


class Place(NamedTuple):
    """How far a pass has come: `find` goes on from here."""

    at: int  # byte of the next record to try
    sync_at: int  # byte after the last whole record
    junk_bytes: int
    signed: int


@kernel
def word(data, at):
    """The eight bytes at data[at] as a little-endian integer (one load, once compiled)."""
    k = np.uint64(at)  # unsigned: no index from behind, so that eight loads become one
    return (
        np.uint64(data[k])
        | np.uint64(data[k + np.uint64(1)]) << np.uint64(8)
        | np.uint64(data[k + np.uint64(2)]) << np.uint64(16)
        | np.uint64(data[k + np.uint64(3)]) << np.uint64(24)
        | np.uint64(data[k + np.uint64(4)]) << np.uint64(32)
        | np.uint64(data[k + np.uint64(5)]) << np.uint64(40)
        | np.uint64(data[k + np.uint64(6)]) << np.uint64(48)
        | np.uint64(data[k + np.uint64(7)]) << np.uint64(56)
    )


@kernel
def crc_mcrf4xx(data, start, end, extra):
    """CRC-16/MCRF4XX of data[start:end] followed by the byte `extra`; start >= 7, end > start.

    Whole words only: zero bytes are put before the first, and the register begins where they lead to its usual 0xFFFF.
    """
    low = np.uint64(0xFF)
    pad = start - end & 7
    at = start - pad
    gap = np.uint64(8 * pad)
    w = word(data, at) >> gap << gap ^ BEFORE[pad]
    crc = np.uint64(0)
    while at < end:
        crc = np.uint64(
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
        if at < end:
            w = word(data, at) ^ crc
    return crc >> np.uint64(8) ^ np.uint64(T0[(crc ^ np.uint64(extra)) & low])


@kernel
def frame_length(data, start):
    """Bytes of the frame at data[start], or 0 where no frame that may be taken begins or fits."""
    size = data.size
    length = 0
    if data[start] == STX_V2:
        if start + 12 <= size and data[start + 2] & 0xFE == 0:
            length = 12 + np.int64(data[start + 1]) + (SIGNATURE_LENGTH if data[start + 2] & 1 else 0)
    elif data[start] == STX_V1 and start + 8 <= size:
        length = 8 + np.int64(data[start + 1])
    return length if start + length <= size else 0


@kernel
def find(data, place, crc_extra, keys, slots, key_of, count, t_us, where, stream):
    """Fill (t_us, where, stream) with the next messages of `data` until they are full or the bytes end.

    data (n,) uint8; crc_extra (largest known id + 1,) int16, -1 where unknown. keys, slots (2^k,): an open hash of the streams met,
    key_of their keys in order of appearance, `count` of them. Returns (messages, streams, place, done); comes back early
    when the hash is half full.
    """
    at, sync_at, junk, signed = place
    size, capacity, mask = data.size, t_us.size, keys.size - 1
    n = 0
    while n < capacity and 2 * count < keys.size:
        start = at + STAMP
        while start < size and data[start] != STX_V2 and data[start] != STX_V1:
            start += 1
        if start >= size:
            return n, count, Place(at, sync_at, junk, signed), True
        at = start - STAMP
        stx = data[start]
        length = frame_length(data, start)
        if length == 0:
            at += 1
            continue
        end = start + length
        if stx == STX_V2:
            msgid = np.int64(data[start + 7]) | np.int64(data[start + 8]) << 8 | np.int64(data[start + 9]) << 16
            crc_at = start + 10 + np.int64(data[start + 1])
            source = np.int64(data[start + 5]) << 8 | np.int64(data[start + 6])
        else:
            msgid = np.int64(data[start + 5])
            crc_at = end - 2
            source = np.int64(data[start + 3]) << 8 | np.int64(data[start + 4])
        if msgid < crc_extra.size and crc_extra[msgid] >= 0:
            crc = crc_mcrf4xx(data, start + 1, crc_at, crc_extra[msgid])
            good = crc == np.uint64(data[crc_at]) | np.uint64(data[crc_at + 1]) << np.uint64(8)
        else:  # nobody can check it: taken only in its place
            good = at == sync_at and (end + STAMP >= size or data[end + STAMP] == STX_V2 or data[end + STAMP] == STX_V1)
        if not good:
            at += 1
            continue

        key = msgid << 16 | source
        slot = (key * _HASH >> 16) & mask
        while keys[slot] != key:
            if keys[slot] < 0:
                keys[slot], slots[slot], key_of[count] = key, count, key
                count += 1
                break
            slot = slot + 1 & mask
        stamp = np.uint64(0)
        for k in range(STAMP):
            stamp = stamp << np.uint64(8) | np.uint64(data[at + k])
        t_us[n], where[n], stream[n] = np.int64(min(stamp, _LAST)), start, slots[slot]
        n += 1
        if stx == STX_V2 and data[start + 2] & 1:
            signed += 1
        junk += at - sync_at
        at = end
        sync_at = end
    return n, count, Place(at, sync_at, junk, signed), False


@kernel
def rehash(key_of, count, keys, slots):
    """Enter the streams met so far into an empty hash (keys -1)."""
    mask = keys.size - 1
    for i in range(count):
        slot = (key_of[i] * _HASH >> 16) & mask
        while keys[slot] >= 0:
            slot = slot + 1 & mask
        keys[slot], slots[slot] = key_of[i], i


@kernel
def order_by_stream(stream, streams):
    """(order, border): numbers of the messages sorted by stream, each in the order of the file; stream s is border[s]:border[s + 1]."""
    border = np.zeros(streams + 1, np.int64)
    for s in stream:
        border[s + 1] += 1
    for s in range(streams):
        border[s + 1] += border[s]
    fill = border[:-1].copy()
    order = np.empty(stream.size, np.int64)
    for i in range(stream.size):
        s = stream[i]
        order[fill[s]] = i
        fill[s] += 1
    return order, border


@kernel
def copy_rows(data, where, t_us, numbers, length, row_words, words):
    """One message a row: stamp (8 bytes), payload zero-extended to `length`, sequence number.

    `numbers` (n,) which messages; words (n * row_words,) uint64, zeroed: the rows, eight bytes at a time, little-endian.
    """
    for row in range(numbers.size):
        i = numbers[row]
        _copy_row(data, where[i], t_us[i], length, words, row * row_words)


@kernel
def copy_all(data, where, t_us, stream, length, row_words, next_word, words):
    """`copy_rows` of all streams in one pass over the bytes, which is faster than a pass for each of them.

    length, row_words (streams,): of a row; next_word (streams,): where the first row of a stream begins in `words`; -1: leave it.
    """
    for i in range(where.size):
        s = stream[i]
        k = next_word[s]
        if k >= 0:
            _copy_row(data, where[i], t_us[i], length[s], words, k)
            next_word[s] = k + row_words[s]


@kernel
def _copy_row(data, start, t_us, length, words, k):
    words[k] = np.uint64(t_us)
    k += 1
    v2 = data[start] == STX_V2
    seq = data[start + 4] if v2 else data[start + 2]
    first = start + 10 if v2 else start + 6
    have = min(np.int64(data[start + 1]), length)
    whole, left = have >> 3, have & 7
    for j in range(whole):
        words[k + j] = word(data, first + 8 * j)
    first += 8 * whole
    beyond = max(0, first + 8 - data.size)  # at the end of the file the last word is read from where it fits
    rest = word(data, first - beyond) >> np.uint64(8 * beyond)
    words[k + whole] = rest & (np.uint64(1) << np.uint64(8 * left)) - np.uint64(1)
    words[k + (length >> 3)] |= np.uint64(seq) << np.uint64(8 * (length & 7))
