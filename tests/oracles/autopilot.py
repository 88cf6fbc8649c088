"""A scripted autopilot for loops on a virtual clock: kinematics without dynamics, just enough to be led through a flight.

It answers commands, follows the attitude setpoint as a point mass, and speaks PX4's modes. It shares no code with `sitl`.
"""

import math

import numpy as np

from mavquad import wire
from mavquad.signals import Vec3

EPOCH_US = 1_700_000_000_000_000
OFFBOARD, HOLD, TAKEOFF, LAND = 6 << 16, 4 << 16 | 3 << 24, 4 << 16 | 2 << 24, 4 << 16 | 6 << 24


class Autopilot:
    """Advance by `step()`: frames out, then give it what was sent by `hear()`."""

    kind = 12

    def __init__(self, hz: float = 100.0, system: int = 1) -> None:
        self.dt_us = round(1e6 / hz)
        self.t_us = 0
        self.boot_us = 0
        self.system = system
        self.armed = False
        self.mode = HOLD
        self.p = np.array([0.0, 0.0, 0.0])
        self.v = np.zeros(3)
        self.q = (1.0, 0.0, 0.0, 0.0)
        self.thrust = 0.5735
        self.setpoints: list[tuple[int, object]] = []
        self.heard: list[str] = []
        self.muted: set[str] = set()
        self.denied_above_hz = 250.0
        self.rates: dict[int, float] = {}
        self.params = {"MPC_THR_HOVER": 0.5735}
        self.jump: Vec3 = (0.0, 0.0, 0.0)
        self.seq = 0
        self.answers: list[bytes] = []

    def send(self, name: str, *fields: object) -> None:
        if name in self.muted:
            return
        self.answers.append(wire.encode(name, fields, seq=self.seq, system=self.system, component=1))
        self.seq = (self.seq + 1) % 256

    def hear(self, raw: bytes) -> None:
        for _, m in wire.parse(raw):
            name = type(m).__name__
            self.heard.append(name)
            if name == "COMMAND_LONG":
                self._command(m)
            elif name == "SET_ATTITUDE_TARGET":
                self.setpoints.append((self.t_us, m))
            elif name == "PARAM_REQUEST_READ" and m.param_id in self.params:
                self.send("PARAM_VALUE", m.param_id, self.params[m.param_id], 9, 1, 0)

    def _command(self, m: object) -> None:
        result = 0
        if m.command == 511:
            hz = 1e6 / m.param2
            result = 2 if hz > self.denied_above_hz else 0
            if not result:
                self.rates[int(m.param1)] = hz
        elif m.command == 400:
            self.armed = m.param1 == 1.0
        elif m.command == 22:
            self.mode = TAKEOFF
            self.goal = m.param7 - 488.0
        elif m.command == 176:
            self.mode = int(m.param2) << 16
        elif m.command == 21:
            self.mode = LAND
        elif m.command == 512:
            self.send("HOME_POSITION", 473977420, 85455940, 488000, 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0)
        self.send("COMMAND_ACK", m.command, result, 0, 0, 1, 191)

    def step(self) -> list[bytes]:
        """One period: move, then everything that is due."""
        dt = 1e-6 * self.dt_us
        self.t_us += self.dt_us
        t = self.t_us - self.boot_us
        if self.armed:
            self._move(dt)
        q = self.q
        if self.t_us % 1_000_000 < self.dt_us or self.t_us == self.dt_us:
            self.send("HEARTBEAT", 2, self.kind, 128 if self.armed else 0, self.mode, 4, 3)
        if t % 20_000 == 0:
            x, y, z = self.p + self.jump
            self.send("LOCAL_POSITION_NED", t // 1000, x, y, z, *self.v)
            self.send("ATTITUDE_TARGET", t // 1000, 7, q, 0.0, 0.0, 0.0, self.thrust)
        if t % 200_000 == 0:
            self.send("EXTENDED_SYS_STATE", 0, 2 if self.p[2] < -0.1 else 1)
        self.send("ATTITUDE_QUATERNION", t // 1000, *q, 0.0, 0.0, 0.0, (0.0,) * 4)
        self.send("TIMESYNC", 0, self.t_us * 1000, 0, 0)
        out, self.answers = self.answers, []
        return out

    def _task(self) -> str:
        """What it flies now."""
        if self.mode == OFFBOARD and self.t_us - self.setpoints[-1][0] > 500_000:
            self.mode = HOLD  # its own failsafe: setpoints have stopped
        return {OFFBOARD: "setpoints", TAKEOFF: "takeoff", LAND: "land"}.get(self.mode, "hold")

    def _move(self, dt: float) -> None:
        task = self._task()
        if task == "setpoints":
            m = self.setpoints[-1][1]
            w, x, y, z = m.q
            self.q, self.thrust = (w, x, y, z), m.thrust
            push = 9.80665 * m.thrust / 0.5735
            up = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
            a = np.array([0, 0, 9.80665]) - push * up
        elif task == "takeoff":
            a = np.array([0, 0, 4.0 * (-self.goal - self.p[2])]) - 4.0 * self.v
        elif task == "land":
            a = 4.0 * (np.array([0, 0, 0.8]) - self.v)
        else:
            a = -4.0 * self.v
        self.v = self.v + dt * a
        self.p = self.p + dt * self.v
        if self.p[2] > 0.0 and task == "land":
            self.p[2], self.v, self.armed = 0.0, np.zeros(3), False


def level(q: tuple[float, ...]) -> float:
    """Tilt [rad]."""
    return math.acos(max(-1.0, min(1.0, 1 - 2 * (q[1] ** 2 + q[2] ** 2))))
