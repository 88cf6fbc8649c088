"""Signed flights, strangers on the network, and who may command: the whole companion and the whole simulated autopilot."""

import itertools
import json
import math

import pytest

from mavquad import lifecycle, pipeline, strangers, wire
from mavquad.companion import request
from mavquad.link import tlog
from mavquad.link.endpoint import open_endpoint
from mavquad.link.signing import Memory, Signer
from mavquad.paths import Path
from mavquad.relay import Relay
from mavquad.settings import Companion
from tests.oracles.autopilot import Autopilot
from tests.oracles.client import Client
from tests.oracles.desk import EPOCH_US, HERE, THERE, Desk, Endpoint
from tools import __main__ as tools_main
from tools import playback

KEY = bytes(range(100, 132))
QUICK = Companion(path=Path(name="hover", duration_s=3.0), observers=(), settle_s=0.5)


def attitude(t_us, roll=0.0, system=1):
    fields = (t_us // 1000, math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0, 0.0, 0.0, 0.0, (0.0,) * 4)
    return wire.encode("ATTITUDE_QUATERNION", fields, seq=0, system=system, component=1)


def heartbeat(mode=3 << 16, system=1, armed=True):
    return wire.encode("HEARTBEAT", (2, 12, 128 if armed else 0, mode, 4, 3), seq=0, system=system, component=1)


@pytest.fixture
def table(tmp_path):
    """Companions with their logs under tmp_path, closed in the end."""
    desks = []

    def lay(name, *more, **keys):
        desks.append(Desk(tmp_path / name, QUICK, *more, **keys))
        return desks[-1]

    yield lay
    for desk in desks:
        desk.companion.close()


def engaged(table, **more):
    desk = table("run", Autopilot(), **more)
    desk.serve(2.0)
    desk.companion._act([request(lifecycle.CMD_ENGAGE, desk.companion.plan, 0)], desk.now_us)
    for _ in range(200):
        if desk.life.state == lifecycle.ENGAGED:
            return desk
        desk.serve(0.1)
    raise AssertionError(f"not engaged: {desk.life} {desk.texts}")


def unmoved(desk):
    """What a stranger must not change."""
    f = desk.companion.flight
    return f.life, f.now_us, f.position, f.estimate, f.heard_crc, f.stamps, f.counts


# ---- one autopilot only -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("raw", "address", "reason"),
    [
        (attitude(9_000_000, 1.0, system=2), THERE, "not from our autopilot"),
        (attitude(9_000_000, 1.0, system=2), HERE, "not from our autopilot"),
        (attitude(9_000_000, 1.0), THERE, "our autopilot's id from another address"),
        (heartbeat(), THERE, "our autopilot's id from another address"),
        (heartbeat(armed=False), (HERE[0], HERE[1] + 1), "our autopilot's id from another address"),
        (
            wire.encode("COMMAND_ACK", (400, 4, 0, 0, 1, 191), seq=0, system=1, component=1),
            THERE,
            "our autopilot's id from another address",
        ),
        (wire.encode("HEARTBEAT", (18, 8, 0, 0, 4, 3), seq=77, system=1, component=191), THERE, "our own address"),
    ],
    ids=("vehicle 2", "vehicle 2 here", "attitude", "heartbeat", "port", "ack", "ourselves"),
)
def test_a_stranger_changes_nothing_is_said_once_counted_and_kept(table, raw, address, reason, capsys):
    desk = engaged(table)
    before, seen = unmoved(desk)[:4], len(desk.texts)
    capsys.readouterr()
    desk.give(raw, address)
    shown = [f"mavquad: refused 1/{raw[6]} from {address[0]}:{address[1]}"] if reason in strangers.POSING else []
    assert desk.texts[seen:] == shown  # every monitor and ground station sees it
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1
    assert f"of {raw[5]}/{raw[6]} from {address[0]}:{address[1]}: {reason}" in told[0]
    once = unmoved(desk)
    assert once[:4] == before
    assert desk.give(raw, address) == b""
    assert unmoved(desk) == once
    assert capsys.readouterr().err == ""
    assert desk.companion.refused == {reason: 2}
    assert [frame.raw for frame in desk.logged("refused")] == [raw, raw]
    assert raw not in [frame.raw for frame in desk.logged()]


def test_a_flight_in_which_somebody_posed_replays_bit_for_bit(table):
    desk = engaged(table)
    desk.give(heartbeat(armed=False), THERE)
    desk.serve(1.0)
    assert "mavquad: refused 1/1 from 192.0.2.66:6666" in desk.texts
    with desk.companion.log.path.open("rb") as stream:
        verdict = playback.verify(pipeline.build(QUICK), list(tlog.read(stream)), own=(1, 191))
    assert verdict.parting is None
    assert verdict.sent > 100


def test_a_ground_station_behind_us_is_not_sent_what_strangers_say(table):
    desk = engaged(table)
    station = Endpoint()
    desk.companion.relays = (Relay(station, "udpout:192.0.2.2:14550"),)
    desk.companion._frames(heartbeat(armed=False), THERE)
    assert station.sent == []
    desk.companion._frames(heartbeat(), HERE)
    assert station.sent == [heartbeat()]


def test_nobody_on_the_network_can_put_words_into_the_companions_mouth(table):
    desk = engaged(table)
    seen = len(desk.texts)
    note = strangers.notice(wire.split(heartbeat())[0][0], THERE).raw
    desk.give(note, THERE)
    desk.give(note, HERE)
    assert desk.texts[seen:] == []
    assert desk.companion.refused == {"not from our autopilot": 2}


def test_another_vehicles_heartbeat_is_heard_and_changes_nothing_of_the_flight(table):
    desk = engaged(table)
    before = desk.life
    desk.give(heartbeat(system=2, armed=False), THERE)
    assert desk.life == before
    assert desk.companion.refused == {}


def test_a_flight_goes_on_among_strangers(table):
    desk = engaged(table)
    for k in range(100):
        desk.give(attitude(desk.autopilot.t_us + 1_000_000 * k, 1.0), THERE)
        desk.give(heartbeat(), THERE)
        desk.serve(0.02)
    assert desk.life.state == lifecycle.ENGAGED
    assert desk.companion.refused == {"our autopilot's id from another address": 200}
    assert desk.companion.flight.epoch == 0


def test_an_autopilot_that_reboots_at_another_port_is_found_again_after_silence(table):
    desk = engaged(table)
    fresh = Autopilot()
    fresh.t_us = fresh.boot_us = desk.autopilot.t_us
    desk.autopilot, desk.address = fresh, (HERE[0], 50_000)
    desk.serve(2.5)
    assert desk.companion.refused["our autopilot's id from another address"] > 200  # it may be anybody
    assert desk.companion.flight.epoch == 0
    heard, setpoints = len(fresh.heard), len(fresh.setpoints)
    desk.serve(6.0)
    assert desk.companion.flight.epoch == 1
    assert desk.life.state == lifecycle.OBSERVING
    assert len(fresh.heard) > heard
    assert len(fresh.setpoints) == setpoints
    assert not fresh.armed
    refused = desk.companion.refused["our autopilot's id from another address"]
    desk.give(heartbeat(), HERE)  # the old address is a stranger's now
    assert desk.companion.refused["our autopilot's id from another address"] == refused + 1


def test_a_moved_autopilot_is_answered_where_it_is_and_strangers_are_bounded():
    endpoint = open_endpoint("udpout:127.0.0.1:9")
    endpoint.answer(("127.0.0.1", 50_000))
    assert endpoint.peers == [("127.0.0.1", 50_000), ("127.0.0.1", 9)]
    for port in range(100):
        endpoint.answer(("127.0.0.1", 40_000 + port))
    assert len(endpoint.peers) == 16
    assert endpoint.peers[0] == ("127.0.0.1", 40_099)
    endpoint.close()


# ---- signed ---------------------------------------------------------------------------------------------------------------
def signed(table):
    return engaged(table, signer=Signer(KEY, Memory()), autopilot_signer=Signer(KEY, Memory()))


def test_a_signed_flight_is_signed_both_ways_and_refuses_the_rest(table):
    desk = signed(table)
    assert desk.companion.refused == {}
    sent = [frame for frame in desk.logged() if frame.component == 191]
    assert len(sent) > 300
    verdicts = [wire.verify(frame, KEY) for frame in sent]
    assert None not in verdicts
    stamps = [stamp for _, stamp in verdicts]
    assert all(b > a for a, b in itertools.pairwise(stamps))
    before = unmoved(desk)
    recorded = desk.autopilot_signer.sign(heartbeat(), desk.now_us)
    desk.give(heartbeat())
    desk.give(Signer(bytes(32), Memory()).sign(heartbeat(), desk.now_us))
    assert unmoved(desk) == before
    desk.serve(0.05)
    before = unmoved(desk)
    desk.give(recorded)  # older than what was heard since
    assert unmoved(desk) == before
    assert desk.companion.refused == {"unsigned": 1, "badly signed": 1, "signed before, sent again": 1}
    assert len(desk.logged("refused")) == 3
    assert desk.life.state == lifecycle.ENGAGED


def test_a_key_sent_over_the_link_is_in_no_log(table, tmp_path):
    for name, signer in (("plain", None), ("signed", Signer(KEY, Memory()))):
        desk = table(name, Autopilot(), signer, Signer(KEY, Memory()) if signer else None)
        desk.serve(0.5)
        desk.give(wire.encode("SETUP_SIGNING", (1, 191, tuple(KEY), 5), seq=0, system=255, component=190))
        assert desk.companion.refused == {"a key sent over the link": 1}
        for path in (tmp_path / name).iterdir():
            assert KEY not in path.read_bytes()


def test_the_log_of_a_signed_flight_replays_bit_for_bit(table):
    desk = signed(table)
    desk.give(heartbeat())
    desk.serve(1.0)
    with desk.companion.log.path.open("rb") as stream:
        records = list(tlog.read(stream))
    verdict = playback.verify(pipeline.build(QUICK), iter(records), own=(1, 191))
    assert verdict.parting is None
    assert verdict.sent > 500


def test_a_recorded_flight_cannot_be_played_to_a_companion_that_was_started_again(table, tmp_path):
    desk = engaged(table, signer=Signer(KEY, Memory(tmp_path / "state")), autopilot_signer=Signer(KEY, Memory()))
    recorded = desk.serve(1.0)
    desk.companion.signer.close()
    again = table("again", desk.autopilot, Signer(KEY, Memory(tmp_path / "state")), desk.autopilot_signer)
    for raw in recorded:
        again.give(raw, THERE)
    assert again.companion.received == 0
    assert again.companion.refused == {"signed before, sent again": len(recorded)}
    again.serve(2.0)
    assert again.life.state == lifecycle.OBSERVING


# ---- the simulated autopilot ----------------------------------------------------------------------------------------------------
LEVEL = (0, 1, 1, 7, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.57)


def deliver(client, raw):
    client.sim.receive(client.link, raw)
    client.run(0.05)


def test_the_simulated_autopilot_signs_and_takes_only_what_is_signed():
    client = Client(signer=Signer(KEY, Memory()))
    heard = []
    original = client.sim.collect

    def keep(link):
        data = original(link)
        heard.extend(frame for datagram in data for frame in wire.split(datagram)[0])
        return data

    client.sim.collect = keep
    client.run(1.5)
    assert len(heard) > 500
    assert all(wire.verify(frame, KEY) for frame in heard)
    arm = wire.encode("COMMAND_LONG", (1, 1, 400, 0, 1.0, *(0.0,) * 6), seq=1, system=1, component=191)
    deliver(client, arm)
    assert client.sim.refused == {"unsigned": 1}
    deliver(client, Signer(bytes(32), Memory()).sign(arm, EPOCH_US + client.sim.t_us))
    assert not client.sim.autopilot.armed
    ours = Signer(KEY, Memory())
    good = ours.sign(arm, EPOCH_US + client.sim.t_us)
    deliver(client, good)
    assert client.sim.autopilot.armed
    assert client.acks[400] == 0
    disarm = wire.encode("COMMAND_LONG", (1, 1, 400, 0, *(0.0,) * 7), seq=2, system=1, component=191)
    deliver(client, ours.sign(disarm, EPOCH_US + client.sim.t_us))
    assert not client.sim.autopilot.armed
    deliver(client, good)  # recorded and sent again
    assert not client.sim.autopilot.armed
    assert client.sim.refused == {"unsigned": 1, "badly signed": 1, "signed before, sent again": 1}


@pytest.mark.parametrize(
    ("system", "component", "allowed"), [(1, 191, True), (255, 190, True), (255, 1, True), (1, 190, False), (66, 191, False)]
)
def test_only_listed_systems_command_the_simulated_autopilot(system, component, allowed):
    client = Client("accept_from=[[1, 191], [255, 0]]")
    client.run(1.5)

    def say(name, *fields):
        deliver(client, wire.encode(name, fields, seq=0, system=system, component=component))

    say("SET_ATTITUDE_TARGET", *LEVEL)
    assert (client.sim.autopilot.setpoint_us >= 0) is allowed
    say("PARAM_SET", 1, 1, "MPC_XY_P", 0.5, 9)
    assert (client.sim.autopilot.params["MPC_XY_P"] == 0.5) is allowed
    say("COMMAND_LONG", 1, 1, 400, 0, 1.0, *(0.0,) * 6)
    assert client.sim.autopilot.armed is allowed
    assert client.acks[400] == (0 if allowed else 2)
    say("PARAM_REQUEST_READ", 1, 1, "MPC_XY_P", -1)
    assert client.last["PARAM_VALUE"].param_id == "MPC_XY_P"  # asking is free
    assert client.sim.refused == ({} if allowed else {"not from a listed system": 3})


def test_without_a_list_everybody_commands():
    client = Client()
    client.run(1.5)
    deliver(client, wire.encode("COMMAND_LONG", (1, 1, 400, 0, 1.0, *(0.0,) * 6), seq=0, system=66, component=7))
    assert client.sim.autopilot.armed


# ---- as a person flies it ---------------------------------------------------------------------------------------------------------
@pytest.mark.xdist_group("flights")
def test_a_signed_flight_of_both_programs_lands_and_keeps_its_key(tmp_path, capsys):
    key = tmp_path / "key"
    key.write_bytes(KEY)
    key.chmod(0o600)
    run = tmp_path / "run"
    words = [
        "hover",
        "--set",
        "path.duration_s=1",
        "--set",
        "flight.takeoff_m=1",
        "--signing-key",
        str(key),
        "--run",
        str(run),
        "--no-report",
        "--json",
    ]
    assert tools_main.main(["fly", *words]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["ok"]
    assert summary["refused"] == {"companion": {}, "sitl": {}}
    assert f"--signing-key {key}" in summary["command"]
    for path in run.iterdir():
        assert KEY not in path.read_bytes()
        assert KEY.hex() not in path.read_text(errors="replace")
    with (run / "flight.tlog").open("rb") as stream:
        frames = [frame for _, frame in tlog.read(stream)]
    local = [frame for frame in frames if not wire.is_signed(frame)]
    assert [(frame.system, frame.component) for frame in local] == [(255, 190)]  # asked for inside, never on the wire
    assert all(wire.verify(frame, KEY) for frame in frames if wire.is_signed(frame))
