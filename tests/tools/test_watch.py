"""What a monitor keeps of a link, live over UDP and from a log."""

import json
import math
import socket
import time
from pathlib import Path

import pytest

from mavquad import wire
from mavquad.errors import LinkError
from tests.oracles import flown
from tools import watch_text
from tools.watch import Request, Watch, angles_deg, body_rates, command_name, mode_name, path_error_m
from tools.watch_feed import RATES_HZ, REQUESTER, SILENCE_S, Live, Playback, Requester

DATA = Path(__file__).parent.parent / "data"


def watched(seconds: float = 12.0, drop=lambda k, raw: False) -> Watch:
    watch = Watch()
    for k, (t_us, raw) in enumerate(flown.frames(seconds)):
        if not drop(k, raw):
            watch.take(t_us, wire.split(raw)[0][0])
    return watch


@pytest.fixture(scope="module")
def whole() -> Watch:
    return watched()


def test_rates_ages_and_delays_are_those_of_the_flight(whole):
    vehicle = whole.vehicles[1]
    assert whole.rate_hz(1, "ATTITUDE_QUATERNION") == pytest.approx(100.0)
    assert whole.rate_hz(1, "ATTITUDE_TARGET") == 0.0  # stopped three seconds ago
    assert whole.newest_age_s(1, "ATTITUDE_TARGET") == pytest.approx(2.992)
    assert whole.newest_age_s(1, "WIND") == math.inf
    assert whole.loss() == 0.0
    assert set(vehicle.round_trip_ms) == {4.0}
    assert set(vehicle.echo_ms) == {3.0}
    assert vehicle.requests == {31: Request(100.0, "granted"), 105: Request(1000.0, "refused")}


def test_the_flight_is_shown_as_it_was(whole):
    vehicle = whole.vehicles[1]
    roll_deg = math.degrees(0.1 * math.sin(11.99))
    assert angles_deg(vehicle) == pytest.approx((roll_deg, 0.0, 0.0), abs=1e-4)
    assert body_rates(vehicle)[0] == pytest.approx(0.1 * math.cos(11.99))
    assert path_error_m(vehicle) == pytest.approx(0.25)
    assert (vehicle.mode, vehicle.armed, vehicle.companion, vehicle.restarts) == ("AUTO.LOITER", True, "released", 0)
    assert len(vehicle.history["rates"]) == pytest.approx(12 * 4, abs=2)
    said = [text.words for text in whole.texts]
    assert "mode AUTO.LOITER -> OFFBOARD" in said
    assert "COMPONENT_ARM_DISARM: granted" in said
    assert "armed" in said


def test_the_companions_own_path_error_counts_while_it_is_fresh():
    watch = watched(6.0)
    vehicle = watch.vehicles[1]

    def say(ms, value):
        raw = wire.encode("NAMED_VALUE_FLOAT", (ms, "path_err", value), seq=0, system=1, component=191)
        watch.take(flown.EPOCH_US + 6_000_000, wire.split(raw)[0][0])
        return path_error_m(vehicle)

    assert say(int(vehicle.boot_ms), 0.0625) == 0.0625
    assert say(int(vehicle.boot_ms) - 5000, 0.125) == pytest.approx(0.25)  # the autopilot's own target again


def test_lost_frames_are_counted_by_sender():
    watch = watched(drop=lambda k, raw: k % 10 == 3)
    lost = 1.0 - watch.frames / sum(1 for _ in flown.frames())
    assert watch.loss() == pytest.approx(lost, rel=0.02)


def test_silence_a_return_and_a_restarted_clock_are_said():
    watch = Watch()
    for start_s, boot_ms in ((0.0, 60_000), (10.0, 500)):
        for t_us, raw in flown.frames(2.0, boot_ms):
            watch.take(t_us + round(1e6 * start_s), wire.split(raw)[0][0])
        watch.pass_time(watch.now_us + 2_500_000)
        assert watch.vehicles[1].lost
    said = [text.words for text in watch.texts]
    assert said.count("link: no HEARTBEAT for 2 s") == 2
    assert any(words.startswith("link: HEARTBEAT again after 9.") for words in said)
    assert watch.vehicles[1].restarts == 1
    assert any(words.startswith("boot clock from 62.0 s to 0.") and words.endswith("restarted") for words in said)
    assert "the autopilot restarted 1 times" in watch_text.verdict(watch)


def test_a_companion_alone_and_unknown_messages_make_no_vehicle():
    watch = Watch()
    watch.take(5, wire.split(wire.encode("HEARTBEAT", (18, 8, 0, 0, 4, 3), seq=0, system=1, component=191))[0][0])
    unknown = bytearray(wire.encode("ATTITUDE", (1, 0, 0, 0, 0, 0, 0), seq=0, system=1, component=1))
    unknown[7:10] = (0x00FFF0).to_bytes(3, "little")
    watch.take(6, wire.split(bytes(unknown))[0][0])
    assert watch.vehicles == {}
    assert watch_text.faults(watch) == ["no HEARTBEAT of an autopilot; heard: 1/191, 1/1"]
    assert "no autopilot heard; 2 frames" in watch_text.line(watch)


def test_the_line_the_json_and_the_verdict_agree(whole):
    status = watch_text.status(whole)
    assert json.loads(json.dumps(status)) == status
    assert status["disturbance_m_s2"] == [0.75, 0.0, -0.1]
    assert status["bounds_m_s2"][0][1:] == [-0.3, -0.4]
    line = watch_text.line(whole)
    for words in ("released", "AUTO.LOITER armed", "att 100 Hz", "loss 0.0 %", "err 0.25 m", "f +0.75 +0.00 -0.10 m/s2"):
        assert words in line
    assert watch_text.verdict(whole) == "1/1: good"


def test_the_verdict_names_what_is_wrong():
    slow = watched(drop=lambda k, raw: raw[7] in (30, 31) and k % 40 > 0)
    assert "attitude at" in watch_text.verdict(slow)
    lossy = watched(drop=lambda k, raw: k % 20 == 3 and raw[7] != 0)
    assert "% of the frames lost, expected <= 1 %" in watch_text.verdict(lossy)
    critical = watched()
    raw = wire.encode("STATUSTEXT", (2, "EKF failure", 0, 0), seq=0, system=1, component=1)
    critical.take(critical.now_us, wire.split(raw)[0][0])
    assert "1 critical texts, the last: EKF failure" in watch_text.verdict(critical)


def test_modes_and_commands_have_names():
    assert mode_name(12, 6 << 16) == "OFFBOARD"
    assert mode_name(12, 4 << 16 | 6 << 24) == "AUTO.LAND"
    assert mode_name(3, 4) == "GUIDED"
    assert mode_name(3, 99) == "mode 99"
    assert command_name(21) == "NAV_LAND"
    assert command_name(54321) == "command 54321"


# ---- a log, played ------------------------------------------------------------------------------------------------------
@pytest.fixture
def played(tmp_path, request) -> Playback:
    (tmp_path / "flight.tlog").write_bytes(flown.log_bytes(getattr(request, "param", 12.0)))
    return Playback(tmp_path / "flight.tlog")


def test_playing_in_steps_is_playing_at_once(played, tmp_path):
    other = Playback(tmp_path / "flight.tlog", speed=5.0)
    while not other.over:
        other.advance(0.37)
    played.seek(played.end_us)
    assert played.over
    assert watch_text.status(played.watch) == watch_text.status(other.watch)
    assert list(played.watch.texts) == list(other.watch.texts)


@pytest.mark.parametrize("played", [66.0], indirect=True)
def test_a_seek_back_shows_what_was_to_be_seen_then(played, tmp_path):
    first = Playback(tmp_path / "flight.tlog")
    first.seek(first.start_us + 65_000_000)
    played.seek(played.end_us)
    played.seek(played.start_us + 65_000_000)
    assert watch_text.status(played.watch) == watch_text.status(first.watch)
    assert played.watch.bytes == first.watch.bytes
    assert [text.words for text in played.watch.texts] == [text.words for text in first.watch.texts]


def test_pause_and_step(played):
    played.advance(1.0)
    frames = played.watch.frames
    assert played.now_us == played.start_us + 1_000_000
    played.step()
    assert played.paused
    assert played.watch.frames == frames + 1
    played.advance(10.0)
    assert played.watch.frames == frames + 1
    assert played.status() == "flight.tlog 1.0/12.0 s paused"
    played.seek(10**18)
    assert played.over
    played.step()
    assert played.status() == "flight.tlog 12.0/12.0 s end"


def test_a_recording_of_a_real_autopilot_is_played_through():
    feed = Playback(DATA / "sweep-roll-20s.tlog")
    feed.seek(feed.end_us)
    assert feed.watch.frames == 13040
    assert watch_text.verdict(feed.watch) == "1/1: good"
    assert feed.watch.rate_hz(1, "HIGHRES_IMU") == pytest.approx(100.0, rel=0.02)


# ---- live ---------------------------------------------------------------------------------------------------------------
class Peer:
    """A vehicle on loopback that answers requests for rates, some of them."""

    def __init__(self, to: tuple[str, int]) -> None:
        self.socket, self.to = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), to
        self.socket.settimeout(0.0)
        self.heard: list = []

    def send(self, *raws: bytes) -> None:
        self.socket.sendto(b"".join(raws), self.to)

    def listen(self) -> list:
        try:
            while True:
                self.heard += list(wire.parse(self.socket.recv(65535)))
        except BlockingIOError:
            return self.heard


@pytest.fixture
def live(request):
    feed = Live("udpin:127.0.0.1:0", *getattr(request, "param", ()))
    peer = Peer(feed._endpoint.sock.getsockname())
    yield feed, peer
    peer.socket.close()
    feed.close()


def wait(feed: Live, until, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < end
        time.sleep(0.01)
        feed.advance()


def test_a_live_link_is_watched_and_nothing_is_sent(live):
    feed, peer = live
    raws = [raw for _, raw in flown.frames(1.0)]
    for i in range(0, len(raws), 5):
        peer.send(*raws[i : i + 5])
    wait(feed, lambda: feed.watch.frames == len(raws))
    assert feed.watch.vehicles[1].mode == "AUTO.LOITER"
    peer.send(b"\x01\x02junk", raws[0])
    wait(feed, lambda: feed.watch.frames == len(raws) + 1)
    assert feed.watch.junk_bytes == 6
    assert peer.listen() == []
    assert feed.status().startswith("live udpin")


def test_an_id_from_a_second_address_is_said_and_not_shown(live):
    """A spoofed HEARTBEAT: the vehicle stays as it was, and whoever looks is told."""
    feed, peer = live
    raws = [raw for _, raw in flown.frames(1.0)]
    peer.send(*raws[:5])
    wait(feed, lambda: feed.watch.frames == 5)
    mode = feed.watch.vehicles[1].mode
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        forged = wire.encode("HEARTBEAT", (2, 12, 0, 4 << 16 | 6 << 24, 4, 3), seq=9, system=1, component=1)
        aside = wire.encode("HEARTBEAT", (18, 8, 0, 0, 4, 3), seq=0, system=7, component=191)
        to = ("127.0.0.1", int(feed._endpoint.name.rpartition(":")[2]))
        other.sendto(forged + forged + aside, to)
        wait(feed, lambda: feed.watch.frames == 6)  # who has an id of its own is heard from wherever
        words = f"1/1 from 127.0.0.1:{other.getsockname()[1]} too"
        assert feed.watch.strangers == {words: 2}
        assert feed.watch.vehicles[1].mode == mode
        assert [text.words for text in feed.watch.texts if text.sender == "monitor"] == [
            f"{words}: two have one id, or somebody poses; not shown"
        ]
        assert f"{words} (2 frames)" in watch_text.verdict(feed.watch)
        feed._homes[1, 1] = (feed._homes[1, 1][0], 0)  # silent for long: it may have moved
        other.sendto(forged, to)
        wait(feed, lambda: feed.watch.frames == 7)
    assert feed.watch.vehicles[1].mode == "AUTO.LAND"


def test_strangers_by_the_thousand_are_not_all_named():
    watch = Watch()
    for port in range(2000):
        watch.stranger((1, 1), ("192.0.2.1", port))
    assert len(watch.strangers) == len(watch.texts) == 16


@pytest.mark.parametrize("live", [(True,)], indirect=True)
def test_rates_are_requested_only_when_asked_for_and_the_answers_shown(live):
    feed, peer = live
    heartbeat = next(raw for _, raw in flown.frames(0.1))
    peer.send(heartbeat)
    answered: list[int] = []

    def answer() -> bool:
        for frame, message in peer.listen()[len(answered) :]:
            answered.append(frame.msgid)
            if frame.msgid == wire.ID["COMMAND_LONG"] and message.param1 != wire.ID["SYS_STATUS"]:
                result = 2 if message.param1 == wire.ID["HIGHRES_IMU"] else 0
                peer.send(heartbeat, wire.encode("COMMAND_ACK", (511, result, 0, 0, 254, 190), seq=1, system=1, component=1))
        return any(text.words.startswith("SYS_STATUS: no answer") for text in feed.watch.texts)

    wait(feed, answer, 15.0)
    frames = [frame for frame, _ in peer.heard]
    assert {(frame.system, frame.component) for frame in frames} == {REQUESTER}
    results = {wire.NAME[msgid]: request.result for msgid, request in feed.watch.vehicles[1].requests.items()}
    assert results["HIGHRES_IMU"] == "refused"
    assert sum(result == "granted" for result in results.values()) == len(RATES_HZ) - 2


def test_a_rate_that_is_fast_enough_is_not_asked_for(live):
    """A companion may live on it: a monitor never lowers a rate."""
    feed, peer = live
    for t_us, raw in flown.frames(3.0):
        feed.watch.take(t_us, wire.split(raw)[0][0])
    peer.send(b"\x00")
    end = time.monotonic() + 60.0
    while not feed._endpoint.peers:  # without `advance`: the time of this watch is that of the recording
        assert time.monotonic() < end
        time.sleep(0.01)
    requester = Requester(feed._endpoint)
    for t_us, raw in flown.frames(12.0):
        feed.watch.take(t_us + 3_000_000, wire.split(raw)[0][0])
        requester.step(feed.watch)
    asked = {int(message.param1) for frame, message in peer.listen() if frame.msgid == wire.ID["COMMAND_LONG"]}
    assert wire.ID["HIGHRES_IMU"] in asked
    assert not asked & {wire.ID["ATTITUDE_QUATERNION"], wire.ID["LOCAL_POSITION_NED"]}


def test_silence_on_the_link_is_said_after_five_seconds(live, monkeypatch):
    feed, _ = live
    feed._opened_us -= round(1e6 * SILENCE_S) + 1_000_000
    assert "nothing heard for 6 s; still listening" in feed.status()
    feed.name = "udpout:127.0.0.1:9"
    assert "a passive monitor does not speak first" in feed.status()


def test_a_port_in_use_is_said():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        with pytest.raises(LinkError, match="is another program listening there"):
            Live(f"udpin:127.0.0.1:{other.getsockname()[1]}")
