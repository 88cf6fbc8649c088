"""A short share of `make fuzz`: a batch or two of every target, and hypothesis on the readers of bytes and texts."""

import io
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavquad import config, wire
from mavquad.errors import ConfigError, LogError
from mavquad.link import tlog
from mavquad.settings import Companion
from tests.fuzz import mutate, targets
from tests.fuzz.__main__ import FILES, FRAMES, chance

ALL = {**targets.FRAME_TARGETS, **targets.FILE_TARGETS}


def test_the_campaign_is_ten_million_frames_and_a_hundred_thousand_files():
    assert sum(FRAMES.values()) == 10_000_000
    assert sum(FILES.values()) == 100_000
    assert {*FRAMES, *FILES} == set(ALL)


@pytest.mark.parametrize("name", ALL)
def test_a_batch_of_each_finds_nothing(name):
    assert ALL[name](chance(name, 11, 0)) > 0


def test_the_same_words_give_the_same_junk():
    raw = targets.BANK[30]
    one, two = (mutate.data(chance("wire", 1, 5), raw, 9) for _ in range(2))
    assert one == two != raw


def test_a_sealed_frame_reaches_the_handlers():
    source = random.Random(3)
    for raw in targets.BANK:
        (frame,), refused, rest = wire.split(mutate.sealed(source, raw))
        assert (refused, rest, frame.msgid) == (0, b"", int.from_bytes(raw[7:10], "little"))


def test_a_reader_that_disagrees_is_found(monkeypatch):
    """The target fails where the thing under it is wrong."""
    monkeypatch.setattr(targets, "_by_columns", lambda path: ([], ""))
    with pytest.raises(AssertionError, match="disagree"):
        targets.logs(chance("logs", 1, 0))


def test_a_setpoint_that_is_not_finite_is_found():
    raw = wire.encode(
        "SET_ATTITUDE_TARGET", (0, 1, 1, 7, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, float("nan")), seq=0, system=1, component=191
    )
    with pytest.raises(AssertionError):
        targets.judge_outbox(Companion(), [(0, raw)])


@settings(max_examples=30)
@given(
    st.booleans(),
    st.integers(0, 3),
    st.lists(st.builds(targets.piece, st.integers(0, 255), st.integers(0, 255), st.binary(max_size=60)), max_size=12),
)
def test_whatever_bytes_a_companion_in_flight_hears_it_says_nothing_that_is_not_whole(ardupilot, state, pieces):
    targets.heard(bytes([state]) + b"".join(pieces), ardupilot)


def test_a_piece_reaches_its_handler(monkeypatch):
    judged = []
    monkeypatch.setattr(targets, "judge_outbox", lambda settings, outbox: judged.extend(outbox))
    number = sorted(targets.pipeline_ids(targets.engaged(False).plan)).index(wire.ID["COMMAND_LONG"])
    raw = wire.encode("COMMAND_LONG", (1, 191, 31_000, 0, *(0.0,) * 7), seq=0, system=255, component=190)
    targets.heard(bytes([3]) + targets.piece(number, 200, raw[10:-2]), ardupilot=False)
    answers = [m for _, out in judged for _, m in wire.parse(out) if type(m).__name__ == "COMMAND_ACK"]
    assert [(m.command, m.result) for m in answers] == [(31_000, 3)]


@given(st.lists(st.one_of(st.binary(max_size=40), st.sampled_from(targets.BANK)), max_size=8), st.integers(0, 400))
def test_no_byte_is_lost_however_a_stream_is_cut(parts, cut):
    stream = b"".join(parts)
    total, rest = 0, b""
    for piece in (stream[:cut], stream[cut:]):
        frames, refused, rest = wire.split(rest + piece)
        total += refused + sum(len(frame.raw) for frame in frames)
    assert total + len(rest) == len(stream)


@given(st.binary(max_size=300))
def test_any_bytes_are_a_log_or_refused(data):
    stream = io.BytesIO(data)
    reader = tlog.read(stream)
    said = ""
    try:
        for _ in reader:
            continue
    except LogError as error:
        said = str(error)
    assert "\n" not in said
    assert reader.messages * 16 <= len(data)


@settings(max_examples=12)
@given(
    st.dictionaries(
        st.sampled_from(["path", "limits", "safety", "link", "controller", "takeoff_m", "observers", "x"]),
        st.recursive(
            st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5)),
            lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=8), inner, max_size=3)),
            max_leaves=6,
        ),
        max_size=4,
    )
)
def test_any_structure_is_settings_or_refused_in_one_line(data):
    said = ""
    try:
        config.convert(data, Companion, "x.toml")
    except ConfigError as error:
        said = str(error)
    assert "\n" not in said
