"""The lockstep runs ahead within the wire's delay, and the flight is the same to the last byte as one that waits at each barrier."""

import numpy as np
import pytest

from mavquad import lifecycle, pipeline, wire
from mavquad.companion import request
from mavquad.link.tlog import read
from mavquad.settings import Companion
from sitl import config, shell


class InProcess:
    """The ports of a `shell.Run`, with a companion behind them that answers one barrier when it is asked to receive."""

    def __init__(self, sim):
        self.sim, self.link = sim, sim.open_link()
        self.plan = pipeline.build(Companion(observers=()))
        self.flight = pipeline.start(self.plan)
        self.waiting, self.most = [], 0
        self.engaged = False

    def send(self, t_us):
        self.waiting.append((t_us, self.sim.collect(self.link, t_us)))
        self.most = max(self.most, len(self.waiting))

    def receive(self, timeout_s):
        if self.sim.partner is None:
            own = self.plan.settings.link
            fields = (18, lifecycle.INVALID, 0, 0, 4, 3)
            hello = wire.encode("HEARTBEAT", fields, seq=0, system=own.system, component=own.component)
            return self.sim.receive(self.link, hello)
        t_us, datagrams = self.waiting.pop(0)
        frames = [frame for data in datagrams for frame in wire.split(data)[0]]
        if not self.engaged and self.flight.life.state == lifecycle.OBSERVING:
            self.engaged = True
            frames.insert(0, request(lifecycle.CMD_ENGAGE, self.plan, 0))
        stamp_us, out = self.sim.epoch_us + t_us, b""
        for step in (pipeline.advance, lambda *now: pipeline.feed_all(*now, frames)):
            self.flight = step(self.plan, self.flight, stamp_us)
            out += b"".join(raw for _, raw in self.flight.outbox)
            self.flight.outbox, self.flight.trace = [], []
        return self.sim.receive(self.link, out)

    def close(self):
        self.waiting.clear()


def flown(ahead, monkeypatch, log, *changes):
    monkeypatch.setattr(shell, "_AHEAD", ahead)
    run = shell.Run(
        config.load(None, list(changes)),
        lockstep=True,
        log=log,
        landed_s=None,
        max_time_s=33.0 if "personality=ardupilot" in changes else 12.0,
    )
    run.ports.close()
    run.ports = InProcess(run.sim)
    run.lockstep()
    most = run.ports.most
    run.close()
    assert run.sim.engaged_periods > 100
    return most, log.read_bytes()


WIRES = {
    "5 ms": (),
    "none": ("link.delay_ms=0",),
    "bad": ("link.delay_ms=12", "link.jitter_ms=7", "link.loss=0.03", "link.duplicate=0.02", "link.reorder=0.02"),
    "ardupilot": ("personality=ardupilot", "params={GUID_OPTIONS = 8}"),
}


@pytest.mark.parametrize("name", WIRES)
def test_running_ahead_changes_no_byte(name, monkeypatch, tmp_path):
    one, waited = flown(1, monkeypatch, tmp_path / "waited.tlog", "wind.w20_m_s=6", *WIRES[name])
    two, ahead = flown(2, monkeypatch, tmp_path / "ahead.tlog", "wind.w20_m_s=6", *WIRES[name])
    assert one == 1
    assert two == (1 if name == "none" else 2)  # nothing to gain where an answer is felt before the next barrier
    cut = min(len(waited), len(ahead))
    assert abs(len(waited) - len(ahead)) < 10_000  # the end, where the last barriers are answered
    assert waited[:cut] == ahead[:cut]
    with (tmp_path / "ahead.tlog").open("rb") as stream:
        stamps = [t_us for t_us, _ in read(stream)]
    assert np.all(np.diff(stamps) >= 0)
