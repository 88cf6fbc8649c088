"""ArduCopter as it was seen on the wire, scripted: says nothing unasked, denies, refuses with a text, takes its own modes."""

from mavquad import wire
from tests.oracles.autopilot import Autopilot

STABILIZE, GUIDED, LOITER, RTL, LAND = 0, 4, 5, 6, 9
ACCEPTED, TEMPORARY, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = range(6)
UNASKED = ("HEARTBEAT", "STATUSTEXT", "COMMAND_ACK", "PARAM_VALUE", "TIMESYNC", "HOME_POSITION")
ARM, TAKEOFF, SET_MODE, SET_INTERVAL, REQUEST_MESSAGE = 400, 22, 176, 511, 512


class ArduCopter(Autopilot):
    """`answers_to[command]` is a list of (result, text, text first) given before it obeys; `said` is what it said."""

    kind = 3

    def __init__(self, origin_s=0.0, **params):
        super().__init__()
        self.mode, self.goal, self.denied_above_hz = STABILIZE, 0.0, 200.0
        self.origin_us = 1e6 * origin_s
        self.params = {"GUID_OPTIONS": 8.0, "MOT_THST_HOVER": 0.5735, **params}
        self.deaf_to = set()  # parameters whose requests get lost
        self.answers_to = {}
        self.commands = []

    def hear(self, raw):
        for _, m in wire.parse(raw):
            if type(m).__name__ == "PARAM_REQUEST_READ" and m.param_id in self.deaf_to:
                return
        super().hear(raw)

    def send(self, name, *fields):
        if name not in UNASKED and wire.ID[name] not in self.rates:
            return
        if name == "LOCAL_POSITION_NED" and self.t_us < self.origin_us:
            return
        super().send(name, *fields)

    def say(self, text, severity=2):
        """A STATUSTEXT, in parts where it is long."""
        if len(text) <= 50:
            self.send("STATUSTEXT", severity, text, 0, 0)
            return
        for i in range(0, len(text) + 1, 50):
            self.send("STATUSTEXT", severity, text[i : i + 50], 77, i // 50)

    def _command(self, m):
        number = int(m.command)
        self.commands.append((self.t_us, number))
        script = self.answers_to.get(number)
        if script:
            result, text, first = script.pop(0)
            if text and first:
                self.say(text)
            self.send("COMMAND_ACK", number, result, 0, 0, 1, 191)
            if text and not first:
                self.say(text)
            return
        if number == SET_MODE:
            self.mode = int(m.param2)
            self.send("COMMAND_ACK", number, ACCEPTED, 0, 0, 1, 191)
        elif number == TAKEOFF:
            self.goal = m.param7
            self.send("COMMAND_ACK", number, ACCEPTED, 0, 0, 1, 191)
        else:
            super()._command(m)

    def _task(self):
        if self.mode in (RTL, LAND):
            return "land"
        if self.mode == GUIDED and self.setpoints and self.t_us - self.setpoints[-1][0] < 3_000_000:
            return "setpoints"
        return "takeoff" if self.mode == GUIDED and self.goal else "hold"
