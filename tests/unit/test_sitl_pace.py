"""Vehicle time at a speed, by a clock of the test: sockets are read behind the wall clock too, and a halt of the machine makes no burst."""

import socket

import pytest

from mavquad import wire
from sitl import config, shell

SPEED = 10.0


class Clock:
    """What `time` is to the shell; each look at it costs `look_s`."""

    def __init__(self, look_s):
        self.now_s, self.look_s = 100.0, look_s

    def monotonic(self):
        self.now_s += self.look_s
        return self.now_s


def running(monkeypatch, clock, max_time_s):
    monkeypatch.setattr(shell, "time", clock)
    return shell.Run(config.load(None, []), lockstep=False, log=None, landed_s=None, max_time_s=max_time_s)


def test_sockets_are_read_while_the_simulation_is_behind(monkeypatch):
    run = running(
        monkeypatch, Clock(look_s=0.02), max_time_s=0.4
    )  # 0.2 s of vehicle time pass between two looks: always behind
    run.ports.open("udpin:127.0.0.1:0")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        heartbeat = wire.encode("HEARTBEAT", (18, 8, 0, 0, 4, 3), seq=0, system=1, component=191)
        peer.sendto(heartbeat, run.ports._ports[0].socket.getsockname())
        run.realtime(SPEED)
    assert run.sim.t_us == 400_000
    assert [link.received for link in run.sim.links] == [1]
    assert run.sim.autopilot.heard_us == {1: 6_000}  # read at 0, then 5 ms on its wire and a turn of the loop
    run.close()


@pytest.mark.parametrize(("halt_s", "burst_us", "late_s"), [(0.01, 100_000, 0.0), (0.2, 0, 0.2), (3.0, 0, 3.0)])
def test_a_halt_of_the_machine_costs_lateness_and_no_burst(monkeypatch, halt_s, burst_us, late_s):
    clock = Clock(look_s=0.0)
    run = running(monkeypatch, clock, max_time_s=1.2)
    ran_us = {}  # wall time -> vehicle time spent there

    class Ports:
        def receive(self, timeout_s):
            clock.now_s += timeout_s

        def send(self, t_us):
            if t_us == 600_000 and clock.now_s < 101.0:
                clock.now_s += halt_s
                run.halted_s = clock.now_s
            ran_us.setdefault(clock.now_s, []).append(t_us)

        def close(self):
            clock.now_s = 0.0

    run.ports.close()
    run.ports = Ports()
    run.realtime(SPEED)
    bursts = {at_s: times[-1] - times[0] for at_s, times in ran_us.items()}
    assert max(bursts.values()) == pytest.approx(burst_us, abs=8000.0)  # two slices
    assert max(bursts, key=bursts.get) == pytest.approx(run.halted_s, abs=1e-6)
    assert run.report()["late_s"] == pytest.approx(late_s, abs=1e-3)
    assert clock.now_s - 100.0 == pytest.approx(0.12 + late_s, abs=1e-3)
    run.close()
