"""A scripted companion in the same process as the simulated autopilot: it says what a test tells it to and keeps what it hears."""

import math
from collections import Counter

from mavquad import wire
from sitl import config, simulation

HOVER = 0.5735  # collective of the x500


class Client:
    """Every message of the autopilot is kept by name; texts and results of commands apart."""

    def __init__(self, *changes, record=None, signer=None):
        self.sim = simulation.Simulation(config.load(None, list(changes)), record, signer=signer)
        self.link = self.sim.open_link()
        self.counts, self.last, self.texts, self.acks = Counter(), {}, [], {}
        self.history = []
        self._seq, self._keep = 0, None
        self.on = lambda m: None

    def send(self, name, *fields):
        self.sim.receive(self.link, wire.encode(name, fields, seq=self._seq, system=1, component=191))
        self._seq += 1

    def command(self, number, *params):
        """Send it, wait for its ACK and return the result."""
        self.acks.pop(number, None)
        self.send("COMMAND_LONG", 1, 1, number, 0, *(tuple(params) + (math.nan,) * (7 - len(params))))
        for _ in range(25):
            if self._keep:
                self._keep()
            self.period()
            if number in self.acks:
                return self.acks[number]
        raise AssertionError(f"no ACK to command {number}")

    def period(self):
        self.sim.run_period()
        for data in self.sim.collect(self.link):
            for _, m in wire.parse(data):
                self._take(m)
        self.sim.record_period()

    def _take(self, m):
        name = type(m).__name__
        self.counts[name] += 1
        self.on(m)
        self.last[name] = m
        if name == "STATUSTEXT":
            if m.id and m.chunk_seq:
                self.texts[-1] += m.text
            else:
                self.texts.append(m.text)
        elif name == "COMMAND_ACK":
            self.acks[m.command] = m.result
        elif name == "LOCAL_POSITION_NED":
            self.history.append((m.x, m.y, m.z))

    def run(self, seconds, setpoint=None):
        until_us, self._keep = self.sim.t_us + round(1e6 * seconds), setpoint
        while self.sim.t_us < until_us:
            if setpoint:
                setpoint()
            self.period()

    def attitude(self, roll=0.0, pitch=0.0, yaw=0.0, thrust=HOVER, mask=7, rates=(0.0, 0.0, 0.0)):
        cr, sr, cp, sp, cy, sy = (f(0.5 * a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
        q = (cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy)
        self.send("SET_ATTITUDE_TARGET", 0, 1, 1, mask, q, *rates, thrust)

    def position(self, p, v=(0.0, 0.0, 0.0), a=(0.0, 0.0, 0.0), mask=0, yaw=0.0):
        self.send("SET_POSITION_TARGET_LOCAL_NED", 0, 1, 1, 1, mask | 2048, *p, *v, *a, yaw, 0.0)

    def take_off(self, height=5.0):
        """PX4: armed and hovering at a height above the origin."""
        self.run(1.5)
        assert self.command(400, 1) == 0
        assert self.command(22, 0, 0, 0, math.nan, math.nan, math.nan, 488.0 + height) == 0
        self.run(3.0 + height)

    def take_off_guided(self, height=10.0):
        """ArduPilot: its streams asked for, armed in GUIDED and hovering at a height above home."""
        for message, hz in ((30, 100), (31, 100), (32, 50), (83, 50), (245, 5)):
            assert self.command(511, message, 1e6 / hz) == 0
        self.run(20.5 - 1e-6 * self.sim.t_us)
        assert self.command(176, 1, 4) == 0
        assert self.command(400, 1) == 0
        assert self.command(22, 0, 0, 0, math.nan, math.nan, math.nan, height) == 0
        self.run(5.0 + height / 2.0)

    @property
    def where(self):
        m = self.last["LOCAL_POSITION_NED"]
        return m.x, m.y, m.z
