"""Who speaks to the simulated autopilot's port: MAVLink is answered, junk is not, and strangers are bounded."""

import socket

import pytest

from mavquad import wire
from sitl import config, shell

HEARTBEAT = wire.encode("HEARTBEAT", (6, 8, 0, 0, 4, 3), seq=0, system=255, component=190)


@pytest.fixture
def run():
    running = shell.Run(config.load(None, []), lockstep=False, log=None, landed_s=None, max_time_s=None)
    running.ports.open("udpin:127.0.0.1:0")
    yield running
    running.close()


def say(run, *datagrams):
    """From one address of its own."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        for data in datagrams:
            peer.sendto(data, run.ports._ports[0].socket.getsockname())
        run.ports.receive(1.0)


def test_junk_opens_no_stream_to_who_sent_it(run):
    say(run, b"\x00", b"GET / HTTP/1.1\r\n\r\n", b"\xfd\x09" + bytes(30))
    assert run.sim.links == []
    assert run.report()["frames_refused"] == {"datagrams without an answer": 3}
    say(run, b"\x00" + HEARTBEAT, b"\x00")  # once it has spoken, its junk is its own
    assert len(run.sim.links) == 1
    assert run.sim.refused["datagrams without an answer"] == 3


def test_there_is_room_for_a_number_of_addresses_and_that_is_said_once(run, monkeypatch, capsys):
    monkeypatch.setattr(shell, "PEERS", 3)
    for _ in range(6):
        say(run, HEARTBEAT)
    assert len(run.sim.links) == 3
    assert run.sim.refused["datagrams without an answer"] == 3
    (said,) = capsys.readouterr().err.splitlines()
    assert "3 addresses speak here, room for no more; 127.0.0.1:" in said
