"""Keys in files, timestamps that never repeat, and what a signed link refuses."""

import signal
import subprocess
import sys

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavquad import wire
from mavquad.errors import ConfigError
from mavquad.link.signing import Memory, Signer, open_signer, read_key

KEY = bytes(range(7, 39))
NOW_US = 1_790_000_000_000_000  # unix
MINUTE_US = 60_000_000


def beat(seq=0, system=1, component=1):
    return wire.encode("HEARTBEAT", (2, 12, 81, 0, 3, 3), seq=seq, system=system, component=component)


def frame(raw):
    return wire.split(raw)[0][0]


def stamp(raw):
    return int.from_bytes(raw[-12:-6], "little")


@pytest.fixture
def key_file(tmp_path):
    path = tmp_path / "key"
    path.write_bytes(KEY)
    path.chmod(0o600)
    return path


def test_a_key_is_read_as_bytes_or_as_hex_digits(tmp_path, key_file):
    assert read_key(key_file) == KEY
    key_file.write_text(KEY.hex() + "\n")
    assert read_key(key_file) == KEY


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o660, 0o644, 0o610])
def test_a_key_that_others_can_touch_is_refused_with_the_command_that_helps(key_file, mode):
    key_file.chmod(mode)
    with pytest.raises(ConfigError, match=rf"mode {mode:04o}.*chmod 600"):
        read_key(key_file)


@pytest.mark.parametrize("content", [b"", KEY[:31], KEY + b"\n", KEY.hex()[:63].encode(), b"password"])
def test_a_key_of_another_size_is_refused_and_never_shown(key_file, content):
    key_file.write_bytes(content)
    with pytest.raises(ConfigError, match="expected 32") as caught:
        read_key(key_file)
    shown = str(caught.value)
    assert "password" not in shown
    assert KEY.hex()[:8] not in shown


def test_a_key_given_in_place_of_a_file_is_refused_and_not_repeated(tmp_path):
    with pytest.raises(ConfigError, match="never the key") as caught:
        read_key(KEY.hex())
    assert KEY.hex() not in str(caught.value)
    with pytest.raises(ConfigError, match="No such file"):
        read_key(tmp_path / "none")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_key(tmp_path)
    assert KEY.hex() not in repr(Signer(KEY, Memory()))
    assert repr(KEY) not in repr(vars(Signer(KEY, Memory()))["memory"])


def test_timestamps_rise_by_one_at_least_and_follow_the_clock():
    signer = Signer(KEY, Memory())
    stamps = [stamp(signer.sign(beat(), NOW_US)) for _ in range(3)]
    assert stamps == [stamps[0], stamps[0] + 1, stamps[0] + 2]
    assert stamps[0] == (NOW_US - 1_420_070_400_000_000) // 10
    assert stamp(signer.sign(beat(), NOW_US + 1000)) == stamps[0] + 100
    assert stamp(signer.sign(beat(), NOW_US - 10**9)) == stamps[0] + 101  # the clock went back


def test_pymavlink_takes_what_we_sign_and_we_take_what_it_signs():
    signer = Signer(KEY, Memory())
    theirs = dialect.MAVLink(None, srcSystem=9, srcComponent=190)
    theirs.signing.secret_key, theirs.signing.timestamp = KEY, stamp(signer.sign(beat(), NOW_US))
    theirs.signing.sign_outgoing = True
    for k in range(5):
        message = theirs.parse_buffer(signer.sign(beat(k), NOW_US + 10 * k, link_id=3))[0]
        assert message.get_type() == "HEARTBEAT"
    packed = bytes(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 3, 3).pack(theirs))
    assert signer.refuses(frame(packed), NOW_US) == ""
    assert wire.unsigned(signer.sign(beat(4), NOW_US)) == beat(4)


def test_what_is_unsigned_forged_or_repeated_is_refused():
    ours, theirs = Signer(KEY, Memory()), Signer(KEY, Memory())
    good = theirs.sign(beat(), NOW_US)
    assert ours.refuses(frame(beat()), NOW_US) == "unsigned"
    assert ours.refuses(frame(Signer(bytes(32), Memory()).sign(beat(), NOW_US)), NOW_US) == "badly signed"
    for at in (-1, -6, -7, -12, -13):  # signature, timestamp and link id
        forged = bytearray(good)
        forged[at] ^= 1
        assert ours.refuses(frame(bytes(forged)), NOW_US) == "badly signed"
    assert ours.refuses(frame(good), NOW_US) == ""
    assert ours.refuses(frame(good), NOW_US) == "signed before, sent again"
    later = theirs.sign(beat(1), NOW_US)
    assert ours.refuses(frame(theirs.sign(beat(2), NOW_US)), NOW_US) == ""
    assert ours.refuses(frame(later), NOW_US) == "signed before, sent again"  # overtaken
    assert ours.refuses(frame(theirs.sign(beat(3), NOW_US, link_id=1)), NOW_US) == ""  # a stream of its own
    version_1 = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    packed = bytes(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 3, 3).pack(version_1, force_mavlink1=True))
    assert ours.refuses(frame(packed), NOW_US) == "unsigned"


def test_the_exceptions_are_a_modems_words_and_never_a_key():
    ours = Signer(KEY, Memory())
    radio = wire.encode("RADIO_STATUS", (0, 0, 0, 0, 0, 0, 0), seq=0, system=51, component=68)
    assert ours.refuses(frame(radio), NOW_US) == ""
    setup = wire.encode("SETUP_SIGNING", (1, 1, tuple(KEY), 5), seq=0, system=255, component=190)
    assert ours.refuses(frame(setup), NOW_US) == "a key sent over the link"
    assert ours.refuses(frame(Signer(KEY, Memory()).sign(setup, NOW_US)), NOW_US) == "a key sent over the link"


def test_a_new_stream_may_be_a_minute_behind_and_no_more():
    ours, theirs = Signer(KEY, Memory()), Signer(KEY, Memory())
    old = theirs.sign(beat(), NOW_US - MINUTE_US - 100)
    assert ours.refuses(frame(old), NOW_US) == "signed long ago"
    assert ours.refuses(frame(theirs.sign(beat(), NOW_US - MINUTE_US + 100)), NOW_US) == ""


def test_an_autopilot_without_a_clock_takes_ours():
    """It hears us, goes on behind our timestamp, and is heard."""
    ours, theirs = Signer(KEY, Memory()), Signer(KEY, Memory())
    boot_us = 1_420_070_400_000_000
    assert ours.refuses(frame(theirs.sign(beat(), boot_us)), NOW_US) == "signed long ago"
    assert theirs.refuses(frame(ours.sign(beat(component=191), NOW_US)), boot_us) == ""
    assert ours.refuses(frame(theirs.sign(beat(), boot_us)), NOW_US) == ""


def test_a_timestamp_from_the_end_of_time_is_not_followed():
    ours = Signer(KEY, Memory())
    assert ours.refuses(frame(wire.sign(beat(), KEY, 0, (1 << 48) - 1)), NOW_US) == "signed in a far future"
    assert len(ours.sign(beat(), 1 << 62)) == len(beat()) + 13


def test_streams_are_bounded():
    ours, theirs = Signer(KEY, Memory()), Signer(KEY, Memory())
    verdicts = [ours.refuses(frame(theirs.sign(beat(), NOW_US, link_id=k)), NOW_US) for k in range(80)]
    assert verdicts == [""] * 64 + ["more signed streams than there is room for"] * 16


KILLED = """
import os, signal, sys
from mavquad import wire
from mavquad.link.signing import open_signer
from pathlib import Path
signer = open_signer(sys.argv[1], Path(sys.argv[2]))
assert signer.refuses(wire.split(bytes.fromhex(sys.argv[3]))[0][0], int(sys.argv[4])) == ""
raw = wire.encode("HEARTBEAT", (2, 12, 81, 0, 3, 3), seq=0, system=1, component=191)
for k in range(5000):
    signed = signer.sign(raw, int(sys.argv[4]) + 30_000 * k)
print(int.from_bytes(signed[-12:-6], "little"), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_killed_it_goes_on_behind_every_timestamp_it_used_and_takes_nothing_again(tmp_path, key_file):
    state = tmp_path / "state"
    recorded = Signer(KEY, Memory()).sign(beat(), NOW_US)
    words = [sys.executable, "-c", KILLED, str(key_file), str(state), recorded.hex(), str(NOW_US)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert state.stat().st_mode & 0o777 == 0o600
    assert KEY not in state.read_bytes()
    again = open_signer(key_file, state)
    assert again.refuses(frame(recorded), NOW_US) == "signed before, sent again"
    assert stamp(again.sign(beat(component=191), NOW_US)) > int(done.stdout)  # even with the clock back where it was
    assert stamp(again.sign(beat(component=191), NOW_US)) < int(done.stdout) + 6_000_002
    again.close()


def test_a_state_file_has_one_owner_and_must_be_one(tmp_path, key_file):
    state = tmp_path / "state"
    first = open_signer(key_file, state)
    with pytest.raises(ConfigError, match="another program"):
        open_signer(key_file, state)
    first.close()
    open_signer(key_file, state).close()
    (tmp_path / "text").write_text("not a state")
    with pytest.raises(ConfigError, match="no signing state"):
        open_signer(key_file, tmp_path / "text")
    with pytest.raises(ConfigError, match="cannot be kept"):
        open_signer(key_file, tmp_path / "none" / "state")


@pytest.mark.parametrize("mode", [0o620, 0o602, 0o666])
def test_a_state_file_that_others_can_turn_back_is_refused_with_the_command_that_helps(tmp_path, key_file, mode):
    state = tmp_path / "state"
    open_signer(key_file, state).close()
    state.chmod(mode)
    with pytest.raises(ConfigError, match=f"mode {mode:04o}, owner .*chmod 600 {state}"):
        open_signer(key_file, state)
    state.chmod(0o600)
    open_signer(key_file, state).close()


def test_a_spoiled_state_file_is_said_and_never_signed_with(tmp_path, key_file):
    state = tmp_path / "state"
    open_signer(key_file, state).close()
    whole = state.read_bytes()
    for reserved in (1 << 48, (1 << 64) - 1):
        state.write_bytes(whole[:8] + reserved.to_bytes(8, "little") + whole[16:])
        with pytest.raises(ConfigError, match="no signing state; move it away"):
            open_signer(key_file, state)
    end = (1 << 48) - (1 << 40)  # the last that is taken from others
    state.write_bytes(whole[:8] + (end + 12_000_000).to_bytes(8, "little") + whole[16:])
    late = open_signer(key_file, state)
    assert stamp(late.sign(beat(component=191), NOW_US)) > end
    late.close()
