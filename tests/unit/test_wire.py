"""wire.py against pymavlink: every message it knows, both ways."""

import math
import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavquad import wire
from mavquad.errors import WireError

_RANGES = {
    "uint8_t": (0, 255), "int8_t": (-128, 127), "uint16_t": (0, 65535), "int16_t": (-32768, 32767), "uint32_t": (0, 2**32 - 1),
    "int32_t": (-(2**31), 2**31 - 1), "uint64_t": (0, 2**64 - 1), "int64_t": (-(2**63), 2**63 - 1),
}  # fmt: skip


def _random_fields(cls, rng):
    fields = []
    for name, kind in zip(cls.fieldnames, cls.fieldtypes, strict=True):
        n = cls.array_lengths[cls.ordered_fieldnames.index(name)]
        if kind == "char":
            fields.append("".join(rng.choice("abcXYZ09_") for _ in range(rng.randint(1, n))) if n else b"q")
            continue

        def one(kind=kind):
            if kind == "float":
                return struct.unpack("<f", struct.pack("<f", rng.uniform(-1e6, 1e6)))[0]
            return rng.uniform(-1e6, 1e6) if kind == "double" else rng.randint(*_RANGES[kind])

        fields.append(tuple(one() for _ in range(n)) if n else one())
    return tuple(fields)


@pytest.mark.parametrize("msgid", sorted(dialect.mavlink_map))
def test_every_message_agrees_with_pymavlink_both_ways(msgid):
    rng = random.Random(msgid)
    cls = dialect.mavlink_map[msgid]
    fields = _random_fields(cls, rng)
    ours = wire.encode(cls.msgname, fields, seq=7, system=3, component=191)
    link = dialect.MAVLink(None, srcSystem=3, srcComponent=191)
    link.seq = 7
    theirs = link.decode(bytearray(ours))
    (frame,), refused, rest = wire.split(ours)
    assert (refused, rest) == (0, b"")
    message = wire.decode(frame)
    assert type(message).__name__ == cls.msgname
    for name, mine, sent in zip(cls.fieldnames, message, fields, strict=True):
        seen = getattr(theirs, name)
        assert mine == (tuple(seen) if isinstance(seen, list) else seen), name
        assert mine == sent, name
    assert (frame.system, frame.component, frame.seq, frame.msgid) == (3, 191, 7, msgid)


def test_version_1_frames_are_read():
    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    raw = dialect.MAVLink_attitude_message(1234, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6).pack(link, force_mavlink1=True)
    (frame,), _, _ = wire.split(bytes(raw))
    assert raw[0] == wire.STX_V1
    assert wire.decode(frame).time_boot_ms == 1234


_HEARTBEAT = wire.encode("HEARTBEAT", (6, 8, 0, 0, 3, 3), seq=1, system=1, component=1)


@given(junk=st.binary(max_size=60), tail=st.binary(max_size=20))
def test_a_frame_behind_junk_is_found_or_waited_for(junk, tail):
    frames, refused, rest = wire.split(junk + _HEARTBEAT + tail)
    assert sum(len(f.raw) for f in frames) + refused + len(rest) == len(junk) + len(_HEARTBEAT) + len(tail)
    known_starts = {wire.STX_V1, wire.STX_V2}
    if not known_starts & set(junk):
        assert frames[0].raw == _HEARTBEAT


@given(at=st.integers(0, 8 * len(_HEARTBEAT) - 1))
def test_no_single_bit_error_passes(at):
    damaged = bytearray(_HEARTBEAT)
    damaged[at // 8] ^= 1 << at % 8
    frames, _, _ = wire.split(bytes(damaged))
    assert all(f.raw == _HEARTBEAT or f.msgid not in wire.ID_SET for f in frames)


@given(data=st.binary(max_size=400))
def test_any_bytes_are_split_without_an_exception(data):
    frames, refused, rest = wire.split(data)
    assert sum(len(f.raw) for f in frames) + refused + len(rest) == len(data)


def test_unknown_ids_are_passed_on_and_named():
    body = bytes([wire.STX_V2, 1, 0, 0, 0, 9, 9, 0xFF, 0xFF, 0x7F, 5])
    (frame,), _, _ = wire.split(body + b"\0\0")
    with pytest.raises(WireError, match="8388607 from 9/9"):
        wire.decode(frame)


def test_a_field_that_does_not_fit_is_named():
    with pytest.raises(WireError, match="HEARTBEAT"):
        wire.encode("HEARTBEAT", (6, 8, 0, 0, 3, 300), seq=0, system=1, component=1)
    with pytest.raises(WireError, match="NO_SUCH"):
        wire.encode("NO_SUCH", (), seq=0, system=1, component=1)


def test_nan_and_infinity_travel():
    fields = (1, math.nan, math.inf, -math.inf, 0.0, -0.0, 0.0, 0.0, (math.nan,) * 4)
    message = next(wire.parse(wire.encode("ATTITUDE_QUATERNION", fields, seq=0, system=1, component=1)))[1]
    assert math.isnan(message.q1)
    assert math.isinf(message.q2)
    assert math.isnan(message.repr_offset_q[3])


def test_signatures_agree_with_pymavlink():
    key = bytes(range(32))
    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    link.signing.secret_key, link.signing.link_id, link.signing.timestamp, link.signing.sign_outgoing = key, 4, 123456789, True
    theirs = bytes(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 3, 3).pack(link))
    ours = wire.sign(wire.encode("HEARTBEAT", (6, 8, 0, 0, 3, 3), seq=0, system=1, component=1), key, 4, 123456789)
    assert ours == theirs
    (frame,), _, _ = wire.split(ours)
    assert wire.verify(frame, key) == (4, 123456789)
    assert wire.verify(frame, bytes(32)) is None
    assert wire.verify(wire.split(_HEARTBEAT)[0][0], key) is None


def test_a_spoiled_length_hides_no_frame_behind_it():
    """A datagram ends where it ends: whatever one byte of the first frame becomes, the second one is found."""
    first = wire.encode("HEARTBEAT", (2, 12, 81, 0, 3, 3), seq=1, system=1, component=1)
    second = wire.encode("TIMESYNC", (0, 123_000, 0, 0), seq=2, system=1, component=1)
    for at in range(len(first)):
        for value in (0, 1, 0x7F, 0xFD, 0xFE, 0xFF):
            frames, _ = wire.datagram(first[:at] + bytes([value]) + first[at + 1 :] + second)
            assert frames[-1].raw == second
    assert wire.datagram(first + second[:-3]) == (wire.split(first)[0], len(second) - 3)
    assert wire.datagram(b"\xfd" * 40 + second)[0][-1].raw == second


def test_what_looks_like_an_unknown_message_inside_a_spoiled_frame_swallows_nothing():
    """Payload bytes that read as the head of a frame of an unknown id, which would end exactly where the datagram does."""
    barrier = wire.encode("TIMESYNC", (0, 123_000, 0, 0), seq=2, system=1, component=1)
    for behind in range(256):
        data = (0xFD, behind, 0, 0, 0, 9, 9, 0xFF, 0xFF, 0x7F)
        first = wire.encode("DATA16", (1, 16, (*data, *(7,) * 6)), seq=1, system=1, component=1)
        spoiled = first[:7] + bytes([first[7] ^ 1]) + first[8:]  # another id of ours: its CRC is wrong
        frames, _ = wire.datagram(spoiled + barrier)
        assert [f.raw for f in frames][-1:] == [barrier], behind


_FRAMES = [
    wire.encode("ATTITUDE_QUATERNION", (1000, 0.7, 0.1, -0.7, 0.1, 0.1, 0.2, 0.3, (0.0,) * 4), seq=3, system=1, component=1),
    wire.encode("HIGHRES_IMU", (2000, 0.1, 0.2, -9.8, *(0.3,) * 10, 63, 0), seq=4, system=1, component=1),
    wire.encode("STATUSTEXT", (6, "waiting for local position", 0, 0), seq=5, system=1, component=1),
    wire.encode("TIMESYNC", (0, 8_000_000, 0, 0), seq=6, system=1, component=1),
]


@given(which=st.integers(0, 2), share=st.floats(0.0, 1.0, exclude_max=True), change=st.integers(1, 255))
def test_one_spoiled_byte_costs_one_frame(which, share, change):
    raw = bytearray(_FRAMES[which])
    raw[int(share * len(raw))] ^= change
    frames, _ = wire.datagram(b"".join([*_FRAMES[:which], bytes(raw), *_FRAMES[which + 1 :]]))
    found = [f.raw for f in frames]
    assert [raw for raw in found if raw in _FRAMES] == [raw for i, raw in enumerate(_FRAMES) if i != which]


@pytest.mark.parametrize(
    "name", ["ATTITUDE_QUATERNION", "SET_ATTITUDE_TARGET", "STATUSTEXT", "PARAM_VALUE", "SERVO_OUTPUT_RAW"]
)
def test_a_payload_of_any_length_is_read_as_if_zeros_followed(name):
    spec, random_ = wire.spec(name), random.Random(name)
    for length in range(1, 256):
        payload = bytes(random_.choices(range(1, 127), k=length))  # no float of these is a NaN
        whole = spec.unpack(payload.ljust(spec.length, b"\0"))
        assert spec.read[length](b"0123456789" + payload + b"crc", 10) == whole
        assert spec.unpack(payload) == whole
        sent = dialect.mavlink_map[spec.msgid].unpacker.unpack(payload[: spec.length].ljust(spec.length, b"\0"))
        fields = [x for x in whole if not isinstance(x, str | tuple)]
        assert set(fields) <= set(sent)
