"""The simulated autopilot in real time beside a companion that is late: both in one process, on one virtual clock.

`wakes(t_us)` says when the companion's loop runs next after it ran at t_us: what arrived until then waits, as in a socket. So a
stalled process, a loop of 200 ms and a starved processor are functions of vehicle time, and every flight is the same each time.
"""

import math

from mavquad import lifecycle, pipeline, wire
from mavquad.companion import request
from sitl import config, simulation

EPOCH_US = 1_700_000_000_000_000
SLICE_US = 2_000
QUICK_US = 2_000  # a loop that is never late


def on_time(t_us):
    return t_us + QUICK_US


def stalled(at_s, for_s, every_s=1e9):
    """Stopped for `for_s` at `at_s`, and again `every_s` later."""

    def wakes(t_us):
        since_s = (1e-6 * t_us - at_s) % every_s if 1e-6 * t_us >= at_s else -1.0
        return t_us + (round(1e6 * (for_s - since_s)) if 0.0 <= since_s < for_s else QUICK_US)

    return wakes


def every(period_s, from_s=0.0):
    """A loop that runs each `period_s`, from a time on."""
    return lambda t_us: t_us + (round(1e6 * period_s) if 1e-6 * t_us >= from_s else QUICK_US)


class Late:
    """One flight. `error_m` is the distance to the path of every control step since the engagement, by the true position."""

    def __init__(self, settings, *changes, wakes=on_time, frame_us=0.0, buffer=1000):
        self.sim = simulation.Simulation(config.load(None, list(changes)))
        self.link = self.sim.open_link()
        self.plan = pipeline.build(settings)
        self.flight = pipeline.start(self.plan)
        self.wakes, self.frame_us, self.buffer = wakes, frame_us, buffer
        self.next_us = 0.0
        self.halted_us = lambda: 0  # for how long the vehicle's clock has stood still so far, by ours
        self.waiting = []
        self.texts, self.setpoints, self.errors, self.truth = [], [], [], []
        self.lost = 0
        self.asked = False

    @property
    def life(self):
        return self.flight.life

    def run(self, seconds, until=None):
        end_us = self.sim.t_us + round(1e6 * seconds)
        while self.sim.t_us < end_us and not (until and self.life.state == until):
            self.sim.run_until(self.sim.t_us + SLICE_US)
            self.waiting += self.sim.collect(self.link)
            self.lost += max(0, len(self.waiting) - self.buffer)
            self.waiting = self.waiting[: self.buffer]  # a full socket takes no more
            if self.sim.t_us >= self.next_us:
                self._wake()
            if self.life.state == lifecycle.ENGAGED:
                self.truth.append((1e-6 * self.sim.t_us, *self.sim.vehicle.state["p_ned_m"].tolist()))
        return self

    def engage(self, seconds=60.0):
        self.run(5.0, lifecycle.OBSERVING)
        self._emit(pipeline.feed(self.plan, self.flight, EPOCH_US + self.sim.t_us, request(lifecycle.CMD_ENGAGE, self.plan, 0)))
        return self.run(seconds, lifecycle.ENGAGED)

    def _wake(self):
        now_us = float(self.sim.t_us)
        begun_us = now_us
        arrived, self.waiting = self.waiting, []
        for data in arrived:
            frames = wire.split(data)[0]
            stamp = self._stamp(now_us)
            accepted = [f for f in frames if not pipeline.accepts(self.plan, self.flight, f)]
            self._emit(pipeline.advance(self.plan, self.flight, stamp))
            self._emit(pipeline.feed_all(self.plan, self.flight, stamp, accepted))
            now_us += self.frame_us * len(frames)
            if now_us - begun_us > 20_000.0:  # what comes meanwhile waits for the next turn
                rest = arrived[arrived.index(data) + 1 :]
                self.waiting = rest
                break
        self._emit(pipeline.advance(self.plan, self.flight, self._stamp(now_us)))
        self.next_us = max(now_us, float(self.wakes(self.sim.t_us)))

    def _stamp(self, now_us):
        return EPOCH_US + round(now_us) + self.halted_us()

    def _emit(self, flight):
        self.flight = flight
        for _, raw in flight.outbox:
            self.sim.receive(self.link, raw)
            for _, m in wire.parse(raw):
                name = type(m).__name__
                if name == "STATUSTEXT":
                    self.texts.append(m.text)
                elif name == "SET_ATTITUDE_TARGET":
                    self.setpoints.append((1e-6 * self.sim.t_us, m.q, m.thrust))
        flight.outbox, flight.trace = [], []

    def spread(self, last_s):
        """Standard deviation (north, east, down) of the true position over the last seconds of the flight."""
        rows = [row for row in self.truth if row[0] > self.truth[-1][0] - last_s]
        means = [sum(r[i] for r in rows) / len(rows) for i in (1, 2, 3)]
        return [math.sqrt(sum((r[i] - m) ** 2 for r in rows) / len(rows)) for i, m in zip((1, 2, 3), means, strict=True)]
