"""The columnar reader against the streaming one and against pymavlink, to the last bit."""

import io
import itertools
import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v10 import ardupilotmega as v1
from pymavlink.dialects.v20 import ardupilotmega as v2

from mavquad import wire
from mavquad.errors import LogError
from mavquad.link import columns, scan, tlog

DATA = Path(__file__).parent.parent / "data"
HEARTBEAT = (2, 12, 81, 0, 4, 3)
KEY = bytes(range(32))


def record(t_us: int, raw: bytes) -> bytes:
    return t_us.to_bytes(8, "big") + raw


def attitude(i: int, system: int = 1, seq: int = 0) -> bytes:
    return wire.encode("ATTITUDE", (1000 * i, 0.1 * i, -0.2, 0.3, 0.0, 1.5, -2.5), seq=seq, system=system, component=1)


SMALL = b"".join(record(10**15 + i, attitude(i, seq=i)) for i in range(6)) + record(
    10**15 + 6, wire.encode("STATUSTEXT", (6, "end", 0, 0), seq=6, system=1, component=1)
)


@pytest.fixture(scope="module")
def of_everything(tmp_path_factory) -> Path:
    """Every message of the dialect with random payloads: MAVLink 2, MAVLink 1 where it may be, some signed."""
    rng = random.Random(7)
    old = v1.MAVLink(None, srcSystem=3, srcComponent=1)
    data = b""
    for t, (msgid, cls) in enumerate(itertools.chain(*[sorted(v2.mavlink_map.items())] * 3)):
        spec = wire.SPECS[msgid]
        payload = rng.randbytes(spec.length)
        if "char" in cls.fieldtypes:  # pymavlink drops a message whose text is no UTF-8
            payload = bytes(byte & 0x7F for byte in payload)
        if t % 4 == 0:  # trimmed by the sender
            payload = payload[: rng.randrange(1, spec.length + 1)]
        raw = new_frame(payload, msgid, cls.crc_extra, seq=t)
        if t % 5 == 0:
            raw = wire.sign(raw, KEY, 1, t)
        data += record(1_700_000_000_000_000 + 1000 * t, raw)
        if msgid < 256 and t % 3 == 0 and (twin := v1.mavlink_map.get(msgid)) is not None:
            message = twin(*blank(twin))
            if twin.unpacker.size < 4:  # pymavlink's file reader takes 12 bytes at least: it would eat the next stamp
                continue
            data += record(1_700_000_000_000_000 + 1000 * t + 500, message.pack(old))
    path = tmp_path_factory.mktemp("log") / "everything.tlog"
    path.write_bytes(data)
    return path


def new_frame(payload: bytes, msgid: int, crc_extra: int, seq: int) -> bytes:
    head = bytes([len(payload), 0, 0, seq & 0xFF, 1, 1]) + msgid.to_bytes(3, "little") + payload
    return b"\xfd" + head + wire.mcrf4xx(head + bytes([crc_extra])).to_bytes(2, "little")


def blank(cls) -> list:
    """Fields of a MAVLink 1 message, told apart by their place."""
    fields = []
    for i, name in enumerate(cls.fieldnames):
        n = cls.array_lengths[cls.ordered_fieldnames.index(name)]
        kind = cls.fieldtypes[i]
        if kind == "char":
            fields.append(b"abc"[: max(1, n)] if n != 1 else b"a")
        elif n:
            fields.append([i + k for k in range(n)])
        else:
            fields.append(i + 1)
    return fields


def bits(column: np.ndarray, theirs: list) -> None:
    """Our column is what pymavlink gave, to the last bit; two NaN are one, because Python's own unpacking quietens them."""
    if column.dtype.kind == "S":
        assert [bytes(text).split(b"\0")[0] for text in column] == [text.split(b"\0")[0] for text in theirs]
        return
    expected = np.array(theirs, column.dtype)
    if column.dtype.kind == "f":
        assert np.array_equal(np.isnan(column), np.isnan(expected))
        column, expected = np.nan_to_num(column, nan=0.0), np.nan_to_num(expected, nan=0.0)
    assert column.tobytes() == expected.tobytes()


def compare_with_pymavlink(path: Path) -> int:
    """How many messages were equal in every field, in sequence number and in stamp."""
    log, theirs, compared = columns.Log(path), {}, 0
    other = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    try:
        while (message := other.recv_msg()) is not None:
            theirs.setdefault((message.get_srcSystem(), message.get_srcComponent(), message.get_msgId()), []).append(message)
    finally:
        other.close()
    for stream, rows in log.everything().items():
        messages = theirs.pop((stream.system, stream.component, stream.msgid))
        assert len(messages) == stream.messages
        for name in messages[0].get_fieldnames():
            raw = f"_{name}_raw" if hasattr(messages[0], f"_{name}_raw") else name
            bits(rows[name], [getattr(message, raw) for message in messages])
        bits(rows["frame_seq"], [message.get_seq() for message in messages])
        np.testing.assert_allclose(rows["t_us"] / 1e6, [message._timestamp for message in messages], rtol=1e-15)
        compared += len(messages)
    assert all(msgid not in wire.ID_SET for _, _, msgid in theirs)
    return compared


@pytest.mark.parametrize(("name", "messages"), [("sweep-roll-20s.tlog", 13040), ("flight1-20s.tlog", 13269)])
def test_every_message_of_a_real_recording_equals_that_of_pymavlink(name, messages):
    assert compare_with_pymavlink(DATA / name) == messages


def test_every_message_of_the_dialect_equals_that_of_pymavlink(of_everything):
    assert compare_with_pymavlink(of_everything) > 3 * len(v2.mavlink_map)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arducopter-sitl-sweep-calm.tlog", "arducopter-sitl-flight1.tlog"])
def test_every_message_of_a_whole_recording_equals_that_of_pymavlink(name, recordings):
    assert compare_with_pymavlink(recordings / name) > 100_000


def both(data: bytes, path: Path) -> tuple[list, str, int, list, str, int]:
    """Messages, error and junk as the streaming reader and as the columnar one see them."""
    path.write_bytes(data)
    reader, streamed, error = tlog.read(io.BytesIO(data)), [], ""
    try:
        for item in reader:
            streamed.append(item)
    except LogError as said:
        error = str(said)
    try:
        log = columns.Log(path)
    except LogError as said:
        return streamed, error, reader.junk_bytes, [], str(said), reader.junk_bytes
    return streamed, error, reader.junk_bytes, list(log.frames()), log.problem, log.junk_bytes


@settings(max_examples=150)
@given(data=st.data())
def test_both_readers_take_the_same_messages_of_damaged_bytes(data, tmp_path_factory):
    damaged = bytearray(SMALL)
    for _ in range(data.draw(st.integers(0, 4))):
        at = data.draw(st.integers(0, len(damaged) - 1))
        kind = data.draw(st.sampled_from(["flip", "cut", "insert"]))
        if kind == "flip":
            damaged[at] ^= 1 << data.draw(st.integers(0, 7))
        elif kind == "cut":
            del damaged[at : at + data.draw(st.integers(1, 30))]
        else:
            damaged[at:at] = data.draw(st.binary(max_size=30))
        if not damaged:
            break
    path = tmp_path_factory.mktemp("damaged") / "flight.tlog"
    streamed, error, junk, mapped, problem, skipped = both(bytes(damaged), path)
    assert mapped == [(t - (t >> 63 << 64), frame) for t, frame in streamed]  # stamps as int64
    assert problem.replace(str(path), "tlog") == error
    assert skipped == junk


def test_cut_at_every_byte_both_readers_agree(tmp_path):
    for cut in range(1, len(SMALL)):
        streamed, error, _, mapped, problem, _ = both(SMALL[:cut], tmp_path / "flight.tlog")
        assert mapped == streamed
        assert problem.replace(str(tmp_path / "flight.tlog"), "tlog") == error


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "empty: 0 bytes"),
        (b"x" * 4000, "not a tlog"),
        (b"ULog\x01\x12\x35" + bytes(99), "a PX4 ULog"),
        (SMALL[:7], "byte 7"),
    ],
)
def test_what_is_no_log_is_refused(data, text, tmp_path):
    (tmp_path / "log").write_bytes(data)
    with pytest.raises(LogError, match=text):
        columns.Log(tmp_path / "log")


def test_a_missing_file_and_a_folder_are_said(tmp_path):
    with pytest.raises(LogError, match="no such file"):
        columns.Log(tmp_path / "none.tlog")
    with pytest.raises(LogError, match="cannot be read"):
        columns.Log(tmp_path)


def test_a_long_run_of_zeros_is_skipped_and_counted(tmp_path):
    path = tmp_path / "sparse.tlog"
    with path.open("wb") as stream:
        stream.write(SMALL)
        stream.truncate(100_000_000)  # the kernel's speed is the same for 3 GB: see the slow twin
    log = columns.Log(path)
    assert len(log) == 7
    assert log.junk_bytes == 100_000_000 - len(SMALL)


@pytest.mark.slow
def test_a_sparse_file_of_3_gb(tmp_path):
    path = tmp_path / "sparse.tlog"
    with path.open("wb") as stream:
        stream.truncate(3_000_000_000)
    with pytest.raises(LogError, match="no MAVLink frame behind an 8-byte stamp in its 3000000000 bytes"):
        columns.Log(path)


def test_streams_are_told_apart_by_sender(tmp_path):
    path = tmp_path / "two.tlog"
    path.write_bytes(b"".join(record(i, attitude(i, system=1 + i % 2, seq=i)) for i in range(10)))
    log = columns.Log(path)
    assert [(s.system, s.component, s.name, s.messages) for s in log.streams] == [(1, 1, "ATTITUDE", 5), (2, 1, "ATTITUDE", 5)]
    assert log.columns("ATTITUDE", system=2)["t_us"].tolist() == [1, 3, 5, 7, 9]
    with pytest.raises(LogError, match="ATTITUDE comes from 1/1, 2/1: say which"):
        log.columns("ATTITUDE")
    with pytest.raises(LogError, match="no ATTITUDE from that sender; it comes from 1/1, 2/1"):
        log.columns("ATTITUDE", system=3)
    with pytest.raises(LogError, match="no WIND in it; it holds ATTITUDE"):
        log.columns("WIND")


def test_a_time_slice_holds_what_lies_in_it_even_when_the_clock_runs_back(tmp_path):
    stamps = [0, 10, 20, 5, 15, 25, 10]
    path = tmp_path / "back.tlog"
    path.write_bytes(b"".join(record(t, attitude(i, seq=i)) for i, t in enumerate(stamps)))
    log = columns.Log(path)
    assert log.columns("ATTITUDE", start_us=10, end_us=20)["frame_seq"].tolist() == [1, 4, 6]
    assert [t for t, _ in log.frames(start_us=15)] == [20, 15, 25]
    assert log.frame(3) == (5, wire.Frame(attitude(3, seq=3), 30, 1, 1, 3))


def test_more_streams_than_the_first_table_holds(tmp_path):
    path = tmp_path / "many.tlog"
    senders = [(s, c) for s in range(1, 41) for c in range(1, 6)]
    frames = [wire.encode("HEARTBEAT", HEARTBEAT, seq=0, system=s, component=c) for s, c in senders]
    path.write_bytes(b"".join(record(i, raw) for i, raw in enumerate(frames * 2)))
    log = columns.Log(path)
    assert [(s.system, s.component, s.messages) for s in log.streams] == [(s, c, 2) for s, c in senders]
    assert all(log.rows(s)["t_us"].tolist() == [i, i + 200] for i, s in enumerate(log.streams))


def test_blocks_smaller_than_the_log_change_nothing(monkeypatch):
    whole = columns.Log(DATA / "flight1-20s.tlog")
    monkeypatch.setattr(columns, "_RECORD", 10**9)
    pieces = columns.Log(DATA / "flight1-20s.tlog")
    assert pieces.streams == whole.streams
    assert np.array_equal(pieces.t_us, whole.t_us)


def test_rows_one_stream_at_a_time_equal_those_of_one_pass(of_everything):
    log = columns.Log(of_everything)
    for stream, rows in log.everything().items():
        assert rows.tobytes() == log.rows(stream).tobytes()


def test_signatures_are_verified(of_everything):
    log = columns.Log(of_everything)
    good, other = log.signatures(KEY), log.signatures(bytes(32))
    assert log.signed == np.count_nonzero(good == 1) == np.count_nonzero(other == -1) > 100
    assert np.count_nonzero(good == 0) == len(log) - log.signed


def test_an_unknown_message_is_counted_and_another_dialect_reads_it():
    log = columns.Log(DATA / "flight1-20s.tlog")
    (unknown,) = [s for s in log.streams if s.name == "UNKNOWN_437"]
    assert unknown.messages == 4
    with pytest.raises(LogError, match="message id 437 is in no table"):
        log.rows(unknown)
    assert len(columns.Log(DATA / "flight1-20s.tlog", "all").columns("AVAILABLE_MODES_MONITOR")) == 4
    with pytest.raises(LogError, match=r"no dialect 'klingon'; known: .*common"):
        columns.dialect("klingon")


@given(data=st.binary(min_size=1, max_size=80), extra=st.integers(0, 255))
def test_the_checksum_of_the_kernel_is_that_of_fastcrc(data, extra):
    got = scan.crc_mcrf4xx(np.frombuffer(b"1234567" + data, np.uint8), 7, 7 + len(data), np.int16(extra))
    assert got == wire.mcrf4xx(data + bytes([extra]))
