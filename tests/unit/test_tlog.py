"""The tlog writer and the streaming reader, beside pymavlink's own readers and tools."""

import io
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mavquad import wire
from mavquad.errors import LogError
from mavquad.link import tlog

EPOCH_US = 1_700_000_000_000_000
HEARTBEAT = (2, 12, 81, 0, 4, 3)


def frames(count: int) -> list[bytes]:
    raws = []
    for i in range(count):
        name, fields = (
            ("HEARTBEAT", HEARTBEAT),
            ("ATTITUDE", (1000 * i, 0.1, -0.2, 0.3, 0.0, 1.5, -2.5)),
            ("STATUSTEXT", (6, f"line {i}", 0, 0)),
        )[i % 3]
        raws.append(wire.encode(name, fields, seq=i, system=1, component=1))
    return raws


def log_bytes(count: int) -> bytes:
    return b"".join((EPOCH_US + 4000 * i).to_bytes(8, "big") + raw for i, raw in enumerate(frames(count)))


SMALL = log_bytes(9)
BORDERS = [0]
for _raw in frames(9):
    BORDERS.append(BORDERS[-1] + 8 + len(_raw))


def drain(data: bytes) -> tuple[list[tuple[int, wire.Frame]], tlog.Reader, str]:
    """All records, the reader with its counts, and the error at the end or ''."""
    reader, records = tlog.read(io.BytesIO(data)), []
    try:
        for record in reader:
            records.append(record)
    except LogError as error:
        return records, reader, str(error)
    return records, reader, ""


def test_what_was_written_is_read_back(tmp_path):
    path = tmp_path / "flight.tlog"
    with tlog.Writer(path) as log:
        for i, raw in enumerate(frames(50)):
            log.write(EPOCH_US + 4000 * i, raw)
    with path.open("rb") as stream:
        reader = tlog.read(stream)
        got = list(reader)
    assert [t for t, _ in got] == [EPOCH_US + 4000 * i for i in range(50)]
    assert [frame.raw for _, frame in got] == frames(50)
    assert (reader.messages, reader.junk_bytes) == (50, 0)


def test_each_frame_is_in_the_file_before_the_next_call(tmp_path):
    log, size = tlog.Writer(tmp_path / "flight.tlog"), 0
    for i, raw in enumerate(frames(5)):
        log.write(i, raw)
        size += 8 + len(raw)
        assert (tmp_path / "flight.tlog").stat().st_size == size
    log.close()
    log.close()


def test_a_recording_is_never_overwritten(tmp_path):
    tlog.Writer(tmp_path / "flight.tlog").close()
    with pytest.raises(LogError, match=r"flight\.tlog: exists already"):
        tlog.Writer(tmp_path / "flight.tlog")
    with pytest.raises(LogError, match="cannot be written"):
        tlog.Writer(tmp_path / "no" / "such" / "folder.tlog")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_said(tmp_path):
    log = tlog.Writer(tmp_path / "flight.tlog")
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full, log._fd)
    os.close(full)
    with pytest.raises(LogError, match="cannot write the frame at 7 us"):
        log.write(7, frames(1)[0])
    log.close()


def test_cut_at_every_byte_gives_every_whole_message_and_says_where():
    for cut in range(1, len(SMALL)):
        whole = sum(border <= cut for border in BORDERS[1:])
        records, reader, error = drain(SMALL[:cut])
        assert [r.raw for _, r in records] == frames(9)[:whole]
        assert reader.junk_bytes == 0
        if cut in BORDERS:
            assert error == ""
        else:
            assert f"truncated at byte {cut}; {whole} whole messages" in error


@given(
    junk=st.lists(st.binary(max_size=40).filter(lambda b: 0xFD not in b and 0xFE not in b), min_size=10, max_size=10),
)
def test_junk_between_records_is_skipped_and_counted(junk):
    assume(not junk[0].startswith(tuple(magic for magic, _ in tlog.OTHERS)))  # such a file is refused whole
    raws = frames(9)
    data = junk[0]
    for i, raw in enumerate(raws):
        data += (EPOCH_US + i).to_bytes(8, "big") + raw + junk[i + 1]
    records, reader, error = drain(data)
    last = junk[-1]
    if 0 < len(last) <= 8:  # too short to be told from the beginning of a stamp
        assert "truncated" in error
        assert reader.junk_bytes == sum(map(len, junk[:-1]))
    else:
        assert (error, reader.junk_bytes) == ("", sum(map(len, junk)))
    assert [(t, r.raw) for t, r in records] == [(EPOCH_US + i, raw) for i, raw in enumerate(raws)]


@given(junk=st.binary(max_size=300), at=st.integers(0, 9))
def test_no_junk_makes_a_later_message_disappear(junk, at):
    assume(at > 0 or not junk.startswith(tuple(magic for magic, _ in tlog.OTHERS)))
    border = BORDERS[at]
    records, _, _ = drain(SMALL[:border] + junk + SMALL[border:])
    raws = [r.raw for _, r in records]
    assert [raw for raw in raws if raw in frames(9)] == frames(9)


@settings(max_examples=300)
@given(bit=st.integers(0, 8 * len(SMALL) - 1))
def test_one_bit_turned_costs_at_most_the_message_it_is_in(bit):
    data = bytearray(SMALL)
    data[bit // 8] ^= 1 << bit % 8
    hit = next(i for i in range(9) if bit // 8 < BORDERS[i + 1])
    records, reader, error = drain(bytes(data))
    kept = [raw for i, raw in enumerate(frames(9)) if i != hit]
    got = [r.raw for _, r in records if r.msgid in wire.ID_SET]
    assert got in (kept, frames(9))  # the second: only a stamp was hit
    if len(records) == 8:  # else the bit made it a message of an unknown id, that nobody can check
        lost = BORDERS[hit + 1] - BORDERS[hit]
        assert reader.junk_bytes == lost or (hit == 8 and "truncated" in error)


def test_a_chunk_border_anywhere_changes_nothing(monkeypatch):
    expected = drain(SMALL)[0]
    for size in (1, 7, 64):
        monkeypatch.setattr(tlog, "_CHUNK", size)
        assert drain(SMALL)[0] == expected


def test_mavlink_1_unknown_ids_and_signed_frames_pass():
    unknown = bytearray(wire.encode("ATTITUDE", (1, 0, 0, 0, 0, 0, 0), seq=0, system=1, component=1))
    unknown[7:10] = (0x00FFF0).to_bytes(3, "little")
    from pymavlink.dialects.v10 import ardupilotmega as v1

    old = v1.MAVLink(None, srcSystem=1, srcComponent=1)
    raws = [
        v1.MAVLink_heartbeat_message(*HEARTBEAT).pack(old),
        bytes(unknown),
        wire.sign(frames(2)[1], bytes(32), 3, 12345),
        bytes(unknown),
    ]
    data = b"".join(bytes(8) + raw for raw in raws)
    records, reader, error = drain(data)
    assert [r.raw for _, r in records] == raws
    assert (reader.junk_bytes, error) == (0, "")


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "empty: 0 bytes"),
        (b"time,x,y\n0.1,2,3\n" * 50, "not a tlog: no MAVLink frame"),
        (b"hello", "not a tlog"),
        (bytes(5000), "not a tlog: no MAVLink frame"),
        (b"ULog\x01\x12\x35\x01" + bytes(100), "not a tlog but a PX4 ULog"),
        (b"\xa3\x95\x80" + bytes(100), "not a tlog but an ArduPilot DataFlash log"),
        (b"".join(frames(6)), "MAVLink frames without stamps"),
        (SMALL[:5], "truncated at byte 5; 0 whole messages"),
    ],
)
def test_what_is_no_log_is_refused_with_the_reason(data, text):
    _, _, error = drain(data)
    assert text in error
    assert "\n" not in error


def test_two_vehicles_and_a_clock_that_runs_backwards_are_kept_as_they_are():
    raws = [wire.encode("HEARTBEAT", HEARTBEAT, seq=i, system=1 + i % 2, component=1) for i in range(6)]
    stamps = [5, 4, 9, 2**63, 0, 1]
    data = b"".join(t.to_bytes(8, "big") + raw for t, raw in zip(stamps, raws, strict=True))
    records, _, _ = drain(data)
    read = [min(t, tlog.LAST_US) for t in stamps]  # as columns have it, whose stamps are signed
    assert [(t, r.system) for t, r in records] == list(zip(read, (1, 2, 1, 2, 1, 2), strict=True))


@pytest.mark.parametrize("tool", ["mavlogdump.py", "mavloss.py", "mavsummarize.py"])
def test_the_tools_of_pymavlink_read_our_logs(tool, tmp_path):
    path = tmp_path / "flight.tlog"
    with tlog.Writer(path) as log:
        for i, raw in enumerate(frames(60)):
            log.write(EPOCH_US + 100_000 * i, raw)
    script = Path(sysconfig.get_path("scripts")) / tool
    done = subprocess.run([sys.executable, script, path], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    if tool == "mavlogdump.py":
        assert sum(" HEARTBEAT {" in line for line in done.stdout.splitlines()) == 20
    if tool == "mavloss.py":
        assert "60 packets, 0 lost" in done.stdout
