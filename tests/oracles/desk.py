"""A whole companion (logs and all) on a table: no socket, no clock; frames are handed to it from any address at any time."""

from mavquad import pipeline, wire
from mavquad.companion import Companion
from mavquad.link import tlog

EPOCH_US = 1_700_000_000_000_000
HERE, THERE = ("192.0.2.1", 14550), ("192.0.2.66", 6666)


class Endpoint:
    """Keeps what is sent."""

    peers = ()

    def __init__(self):
        self.sent = []

    def send(self, data, to=None):
        self.sent.append(data)

    def close(self):
        self.sent.append(b"")


class Desk:
    """`serve(autopilot, seconds)` lets both talk; `give` hands over one frame of anybody."""

    def __init__(self, run, settings, autopilot, signer=None, autopilot_signer=None):
        self.companion = Companion(pipeline.build(settings), Endpoint(), run, signer=signer)
        self.autopilot, self.autopilot_signer = autopilot, autopilot_signer
        self.address = HERE
        self.texts = []

    @property
    def life(self):
        return self.companion.flight.life

    @property
    def now_us(self):
        return EPOCH_US + self.autopilot.t_us

    def give(self, raw, address=None, at_us=None):
        self.companion.take(wire.split(raw)[0], address or self.address, at_us or self.now_us)
        if self.companion.flight.heartbeat_us:  # time passes whoever speaks
            self.companion._emit(pipeline.advance(self.companion.plan, self.companion.flight, at_us or self.now_us))
        self.companion._flush()
        sent, self.companion.endpoint.sent = b"".join(self.companion.endpoint.sent), []
        for frame, message in wire.parse(sent):
            self.autopilot.hear(wire.unsigned(frame.raw))
            if type(message).__name__ == "STATUSTEXT":
                self.texts.append(message.text)
        return sent

    def serve(self, seconds):
        """Both talk; returns what the autopilot has sent."""
        said = []
        for _ in range(round(1e6 * seconds / self.autopilot.dt_us)):
            for raw in self.autopilot.step():
                signed = self.autopilot_signer.sign(raw, self.now_us) if self.autopilot_signer else raw
                said.append(signed)
                self.give(signed)
        return said

    def logged(self, name="flight"):
        """Frames of a log of the run folder."""
        path = next(iter(self.companion.log.path.parent.glob(f"{name}.tlog")), None)
        if path is None:
            return []
        with path.open("rb") as stream:
            return [frame for _, frame in tlog.read(stream)]
