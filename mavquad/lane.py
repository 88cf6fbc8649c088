"""The fast lane: a datagram of plain telemetry through one compiled function, for `pid` and `pd` on the autopilot's own estimate.

`pipeline` is what a companion does; this gives the same bytes, in a tenth of the time, for the datagrams that hold nothing out of the
ordinary. A text, a fault, a timer, a person's request: the shell takes the flight back (`leave`) and goes through the pipeline, which
is also what a replay does. So every `replay --verify` of such a flight compares the two.
"""

import itertools
import struct
from typing import Any

import numpy as np

from mavquad import flat, lane_record, lane_tick, lifecycle, messages, wire
from mavquad.flight import Flight
from mavquad.jit import COMPILED
from mavquad.lane_tick import DONE, OTHER, TIMERS
from mavquad.link.health import Source
from mavquad.link.signing import SETUP_SIGNING
from mavquad.plan import Plan, Stage
from mavquad.signals import Attitude

__all__ = ["DONE", "OTHER", "TIMERS", "Lane", "serves"]

_KINDS = {
    "LOCAL_POSITION_NED": lane_tick.POSITION,
    "HIGHRES_IMU": lane_tick.IMU,
    "ATTITUDE_TARGET": lane_tick.TARGET,
    "ATTITUDE_QUATERNION": lane_tick.ATTITUDE,
    "ATTITUDE": lane_tick.EULER,
    "TIMESYNC": lane_tick.TIMESYNC,
    "EXTENDED_SYS_STATE": lane_tick.LANDED,
    "SYS_STATUS": lane_tick.BATTERY,
}


def serves(plan: Plan) -> bool:
    """Whether the lane knows the stages of a plan."""
    settings = plan.settings
    return (
        settings.controller in ("pid", "pd")
        and plan.estimator.label == "direct"
        and plan.compensator is None
        and settings.body_rates != "observer"
        and all(_by_attitude(stage) for stage in plan.observers)
        and plan.imu_spared
        and settings.loop == "attitude"
        and COMPILED
    )


def _by_attitude(observer: Stage) -> bool:
    """Whether it takes attitudes and nothing else."""
    uses = getattr(observer.module, "uses", None)
    return uses is not None and tuple(uses(observer.gains)) == ("Attitude",)


def _table(plan: Plan) -> np.ndarray:
    """(65536,) int16: kind << 8 | CRC extra of each message, -1 unknown."""
    table = np.full(1 << 16, -1, np.int16)
    others = {*messages.HANDLERS, *plan.samples, SETUP_SIGNING}
    for msgid, name in wire.NAME.items():
        if msgid < table.size:
            kind = _KINDS.get(name, lane_tick.OTHERS if msgid in others else lane_tick.NOTHING)
            table[msgid] = kind << 8 | wire.SPECS[msgid].crc_extra
    return table


class Lane:
    """The fast lane of one companion, whose flight it holds between `enter` and `leave`."""

    def __init__(self, plan: Plan, lockstep: bool) -> None:
        self.inside = False
        self._plan, self._lockstep = plan, lockstep
        self._tuned: Plan | None = None
        self._target, self._autopilot = (0, 0), 0
        self._memory = lane_record.room()
        self._state = self._memory[lane_record.STATE_AT :]
        self._memory[lane_record.TABLE_AT : lane_record.LOG_AT].view(np.int16)[:] = _table(plan)
        self._rows = self._memory[lane_record.ROWS_AT : lane_record.HEARD_AT].view(np.float64)
        self._heard = self._memory[lane_record.HEARD_AT : lane_record.PLACES_AT].view(np.float64)
        self._observers: tuple[Any, ...] = ()
        self._rates = struct.Struct(f"<{3 * len(plan.observers)}d")
        self._tell(plan)
        self.log = self.sent = self.trace = b""
        self.stamp_us = self.setpoints = self.frames = 0
        self.feed(b"\xfd", 0, 0)  # loaded from the cache before anything flies

    def _tell(self, plan: Plan) -> None:
        """Write all that does not change."""
        own, response, safety = plan.settings.link, plan.airframe.attitude, plan.settings.safety
        fixed = self._memory[: lane_record.FIXED.itemsize].view(lane_record.FIXED)[0]
        flat.fill(fixed.pid, plan.controller.gains)
        flat.fill(fixed.gate, plan.limits)
        flat.fill(fixed.path, plan.path)
        told = {
            "carry_s": plan.estimator.gains.carry_s, "reset_m": safety.reset_m, "late_us": round(1e6 * safety.late_s),
            "natural_frequency_rad_s": response.natural_frequency_rad_s, "damping": response.damping,
            "response_delay_s": response.delay_s, "duration_us": round(1e6 * plan.path.duration_s), "control_us": plan.control_us,
            "ardupilot": self._autopilot == lifecycle.ARDUPILOT, "system": own.system, "component": own.component,
            "target_system": self._target[0], "target_component": self._target[1],
            "setpoint_extra": wire.spec("SET_ATTITUDE_TARGET").crc_extra, "timesync_extra": wire.spec("TIMESYNC").crc_extra,
            "timesync_bytes": wire.spec("TIMESYNC").length,
        }  # fmt: skip
        for name, value in told.items():
            fixed[name] = value

    def enter(self, flight: Flight, source: Source | None) -> bool:
        """Take a flight over, where it can be flown here; the counter of its autopilot's frames with it."""
        if source is None or not lane_record.plain(flight):
            return False
        life = flight.life
        if flight.tuned is not self._tuned or (life.target, life.autopilot) != (self._target, self._autopilot):
            self._tuned, self._target, self._autopilot = flight.tuned, life.target, life.autopilot
            self._tell(flight.tuned or self._plan)
        lane_record.load(self._state, flight, source)
        self._observers = flight.observers
        self.inside = True
        return True

    def leave(self, flight: Flight) -> tuple[Flight, Source]:
        """The flight as it is now, from the one that was taken over, and the counter of frames."""
        self.inside = False
        left, source = lane_record.unload(self._state, flight)
        left.observers = self._observers
        return left, source

    def feed(self, data: bytes, arrival_us: int, due_us: int) -> int:
        """One datagram of the autopilot. DONE: `log`, `sent`, `trace`, `stamp_us`, `setpoints` and `frames` are what came of it.

        TIMERS: something of the flight's falls due by `stamp_us`, before it. OTHER: nothing was done; it is the pipeline's.
        """
        if len(data) > lane_record.MOST_BYTES:
            return OTHER
        verdict, self.stamp_us, logged, sent, rows, self.setpoints, self.frames, heard = lane_tick.feed(
            self._memory, np.frombuffer(data, np.uint8), arrival_us, due_us, self._lockstep
        )
        if verdict == DONE:
            memory, log_at, sent_at = self._memory, lane_record.LOG_AT, lane_record.SENT_AT
            self.log = memory[log_at : log_at + logged].tobytes()
            self.sent = memory[sent_at : sent_at + sent].tobytes()
            self.trace = self._rows[: lane_record.COLUMNS * rows].tobytes()
            if self._observers:
                self._observe(heard)
        return int(verdict)

    def _observe(self, heard: int) -> None:
        """Tell the observers the attitudes of this datagram; a row of the trace ends with what they make of them."""
        stages, n, width = self._plan.observers, lane_record.ATTITUDES, 8 * lane_record.COLUMNS
        rows, at = [], 0
        for k in range(heard):
            stamp, w, x, y, z, *omega = self._heard[n * k : n * (k + 1)].tolist()
            sample = Attitude(int(stamp) if stamp >= 0.0 else -1 - int(stamp), (w, x, y, z), (omega[0], omega[1], omega[2]))
            self._observers = tuple(
                [s.module.observe(s.gains, state, sample) for s, state in zip(stages, self._observers, strict=True)]
            )
            if stamp < 0.0:
                rates = [
                    s.module.predict(s.gains, state, sample.t_us)[1] for s, state in zip(stages, self._observers, strict=True)
                ]
                rows += [self.trace[at : at + width], self._rates.pack(*itertools.chain(*rates))]
                at += width
        self.trace = b"".join(rows)
