"""What a link says, kept for looking at: streams, vehicles, estimates, setpoints, delays, texts. No clock, no socket, no screen.

`Watch.take` is given every frame with its arrival stamp; most are only counted, and decoded when a page asks for the latest. It
sees what passes by: requests and answers of others, too, where the link carries both directions.
"""

import math
from collections import deque
from collections.abc import Iterable
from itertools import pairwise
from typing import Any, NamedTuple

from mavquad import lifecycle, wire
from mavquad.link import health
from mavquad.wire import Frame

AUTOPILOT, COMPANION = 1, 191
SAMPLE_US = 250_000  # of the histories
HISTORY = 240  # samples: one minute
STRANGERS = 16  # that are named
LOST_US = 2_000_000  # without a HEARTBEAT for so long a vehicle is lost
_FRESH_MS = 2000  # what a companion said longer ago is no news
_CLOCK_BACK_MS = 2_000  # a boot clock that goes back further has started again
_SAME = 1e-5  # of quaternion components: this echo is that setpoint

HEARTBEAT, STATUSTEXT = wire.ID["HEARTBEAT"], wire.ID["STATUSTEXT"]
COMMAND_LONG, COMMAND_ACK = wire.ID["COMMAND_LONG"], wire.ID["COMMAND_ACK"]
TIMESYNC = wire.ID["TIMESYNC"]
SET_ATTITUDE, ATTITUDE_TARGET = wire.ID["SET_ATTITUDE_TARGET"], wire.ID["ATTITUDE_TARGET"]
ARRAY, QUATERNION, ANGLES = wire.ID["DEBUG_FLOAT_ARRAY"], wire.ID["ATTITUDE_QUATERNION"], wire.ID["ATTITUDE"]

PX4_MODES = {1: "MANUAL", 2: "ALTCTL", 3: "POSCTL", 4: "AUTO", 5: "ACRO", 6: "OFFBOARD", 7: "STABILIZED", 8: "RATTITUDE"}
PX4_AUTO = {1: "READY", 2: "TAKEOFF", 3: "LOITER", 4: "MISSION", 5: "RTL", 6: "LAND", 8: "FOLLOW", 9: "PRECLAND"}
RESULTS = {0: "granted", 1: "not now", 2: "refused", 3: "unknown", 4: "failed", 5: "in progress"}


class Text(NamedTuple):
    """A line of the message page."""

    t_us: int
    severity: int  # MAV_SEVERITY: 0 emergency ... 7 debug
    sender: str
    words: str


class Request(NamedTuple):
    """A message rate that somebody asked for, and the answer."""

    hz: float
    result: str  # "asked", "granted", "refused", ...


class Vehicle:
    """One system: its autopilot and whatever else speaks for it."""

    def __init__(self, system: int) -> None:
        self.system = system
        self.kind = 0  # MAV_AUTOPILOT
        self.mode = "?"
        self.armed = False
        self.heard_us = 0  # arrival of the autopilot's last HEARTBEAT
        self.lost = False
        self.boot_ms = 0
        self.restarts = 0
        self.companion = ""  # the companion's own state, from its texts
        self.latest: dict[int, tuple[int, Frame]] = {}  # of the autopilot
        self.arrays: dict[str, tuple[int, tuple[float, ...]]] = {}  # DEBUG_FLOAT_ARRAY by name
        self.named: dict[str, tuple[int, float]] = {}
        self.setpoint: tuple[int, Any] | None = None  # the last SET_ATTITUDE_TARGET to it
        self.requests: dict[int, Request] = {}
        self.pending: deque[tuple[int, float]] = deque(maxlen=64)  # rates asked for, not answered yet
        self.round_trip_ms: deque[float] = deque(maxlen=200)
        self.echo_ms: deque[float] = deque(maxlen=200)
        self.history: dict[str, deque[tuple[float, ...]]] = {}
        self._asked: dict[int, int] = {}  # TIMESYNC ts1 -> arrival
        self._sent: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=64)

    def message(self, name: str) -> Any:
        """The latest message of the autopilot by name, decoded; None where there is none."""
        found = self.latest.get(wire.ID[name])
        return wire.decode(found[1]) if found else None

    def on_setpoint(self, t_us: int, message: Any) -> None:
        self.setpoint = (t_us, message)
        self._sent.append((t_us, message.q))

    def on_echo(self, t_us: int, q_wxyz: tuple[float, ...]) -> None:
        """An echo counts where it is one setpoint and not the one before: then its age is the delay."""
        for (_, before), (sent_us, q) in reversed(list(pairwise(self._sent))):
            if _near(q, q_wxyz):
                if not _near(before, q_wxyz):
                    self.echo_ms.append(1e-3 * (t_us - sent_us))
                return

    def on_timesync(self, t_us: int, message: Any) -> None:
        if message.tc1 == 0:
            self._asked[message.ts1] = t_us
            if len(self._asked) > 32:
                self._asked.pop(next(iter(self._asked)))
        elif message.ts1 in self._asked:
            self.round_trip_ms.append(1e-3 * (t_us - self._asked.pop(message.ts1)))

    def remember(self, name: str, values: tuple[float, ...]) -> None:
        self.history.setdefault(name, deque(maxlen=HISTORY)).append(values)


class Watch:
    """All that was seen. `now_us` is the time of the newest frame, or of the last `pass_time`."""

    def __init__(self) -> None:
        self.start_us = self.now_us = 0
        self.frames = self.bytes = self.junk_bytes = 0
        self.streams: dict[tuple[int, int, int], health.Stream] = {}
        self.sources: dict[tuple[int, int], health.Source] = {}
        self.vehicles: dict[int, Vehicle] = {}
        self.texts: deque[Text] = deque(maxlen=500)
        self.said = 0  # texts ever
        self.strangers: dict[str, int] = {}  # ids from a second address, in words: frames that were not shown
        self._sample_us = 0

    def take(self, t_us: int, frame: Frame) -> None:
        """One frame that arrived at t_us."""
        if not self.start_us:
            self.start_us = self._sample_us = t_us
        self.pass_time(t_us)
        self.frames += 1
        self.bytes += len(frame.raw)
        source, key = (frame.system, frame.component), (frame.system, frame.component, frame.msgid)
        self.sources[source] = health.on_frame(self.sources.get(source), frame.seq)
        self.streams[key] = health.on_message(self.streams.get(key), t_us)
        vehicle = self.vehicles.get(frame.system)
        if vehicle is not None and frame.component == AUTOPILOT:
            vehicle.latest[frame.msgid] = (t_us, frame)
        handler = _HANDLERS.get(frame.msgid)
        if handler is not None:
            handler(self, t_us, frame, wire.decode(frame))

    def pass_time(self, now_us: int) -> None:
        """Time goes on without a frame: ages grow, silence is noticed, histories are sampled."""
        self.now_us = max(self.now_us, now_us)
        for vehicle in self.vehicles.values():
            if not vehicle.lost and self.now_us - vehicle.heard_us > LOST_US:
                vehicle.lost = True
                self.say(2, f"{vehicle.system}/{AUTOPILOT}", "link: no HEARTBEAT for 2 s")
        if self.frames and self.now_us - self._sample_us >= SAMPLE_US:
            self._sample_us = self.now_us
            for vehicle in self.vehicles.values():
                self._sample(vehicle)

    def say(self, severity: int, sender: str, words: str) -> None:
        self.texts.append(Text(self.now_us, severity, sender, words))
        self.said += 1

    def stranger(self, sender: tuple[int, int], address: tuple[str, int]) -> None:
        """A frame by the name of a sender that is at another address."""
        words = f"{sender[0]}/{sender[1]} from {address[0]}:{address[1]} too"
        if words not in self.strangers:
            if len(self.strangers) == STRANGERS:
                return
            self.say(3, "monitor", f"{words}: two have one id, or somebody poses; not shown")
        self.strangers[words] = self.strangers.get(words, 0) + 1

    def recall(self, texts: Iterable[Text]) -> None:
        """What the companions' own texts say of their states."""
        for text in texts:
            system, _, component = text.sender.partition("/")
            state = text.words.removeprefix("mavquad ").partition(":")[0]
            if component == str(COMPANION) and state in lifecycle.STATES and int(system) in self.vehicles:
                self.vehicles[int(system)].companion = state

    def begin_again(self, start_us: int, frames: int, size: int) -> None:
        """Count on from `frames` of `size` bytes since start_us that were not taken here; loss and rates are counted anew."""
        self.start_us, self.frames, self.bytes = start_us, frames, size
        self.sources.clear()
        self.streams.clear()

    def age_s(self, t_us: int) -> float:
        return 1e-6 * (self.now_us - t_us)

    def loss(self, system: int | None = None) -> float:
        """The share of frames lost, of one system or all."""
        chosen = [s for (number, _), s in self.sources.items() if system in (None, number)]
        lost, received = sum(s.lost for s in chosen), sum(s.received for s in chosen)
        return lost / (lost + received) if received else 0.0

    def rate_hz(self, system: int, *names: str) -> float:
        """The best rate of the autopilot's messages of these names; 0 where silent for longer than five periods and 1 s."""
        best = 0.0
        for name in names:
            stream = self.streams.get((system, AUTOPILOT, wire.ID[name]))
            if stream is not None and self.now_us - stream.last_us < max(1e6, 5.0 * stream.period_us):
                best = max(best, health.rate_hz(stream))
        return best

    def newest_age_s(self, system: int, *names: str) -> float:
        """Age of the newest of the autopilot's messages of these names; infinite where none came."""
        found = (self.streams.get((system, AUTOPILOT, wire.ID[name])) for name in names)
        return min((health.age_s(stream, self.now_us) for stream in found if stream), default=math.inf)

    def _sample(self, vehicle: Vehicle) -> None:
        attitude = newest_attitude(vehicle)
        if attitude is not None:
            vehicle.remember("rates", (attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed))
            self._boot_clock(vehicle, attitude.time_boot_ms)
        for name in ("rates", "disturb", "asmf"):
            if name in vehicle.arrays:
                vehicle.remember(f"{name} estimate", vehicle.arrays[name][1])

    def _boot_clock(self, vehicle: Vehicle, boot_ms: int) -> None:
        if boot_ms < vehicle.boot_ms - _CLOCK_BACK_MS:
            vehicle.restarts += 1
            words = f"boot clock from {1e-3 * vehicle.boot_ms:.1f} s to {1e-3 * boot_ms:.1f} s: restarted"
            self.say(1, f"{vehicle.system}/{AUTOPILOT}", words)
            vehicle.boot_ms = boot_ms
        vehicle.boot_ms = max(vehicle.boot_ms, boot_ms)


# ---- one function per message that is more than counted ---------------------------------------------------------------------
def _heartbeat(watch: Watch, t_us: int, frame: Frame, message: Any) -> None:
    if frame.component != AUTOPILOT or message.autopilot == lifecycle.INVALID:
        return
    vehicle = watch.vehicles.get(frame.system)
    if vehicle is None:
        vehicle = watch.vehicles[frame.system] = Vehicle(frame.system)
        vehicle.latest[HEARTBEAT] = (t_us, frame)
    sender = f"{frame.system}/{frame.component}"
    mode, armed = mode_name(message.autopilot, message.custom_mode), bool(message.base_mode & lifecycle.ARMED)
    if vehicle.lost:
        watch.say(5, sender, f"link: HEARTBEAT again after {1e-6 * (t_us - vehicle.heard_us):.1f} s")
    if vehicle.heard_us and mode != vehicle.mode:
        watch.say(5, sender, f"mode {vehicle.mode} -> {mode}")
    if vehicle.heard_us and armed != vehicle.armed:
        watch.say(5, sender, "armed" if armed else "disarmed")
    vehicle.kind, vehicle.mode, vehicle.armed, vehicle.heard_us, vehicle.lost = message.autopilot, mode, armed, t_us, False


def _text(watch: Watch, t_us: int, frame: Frame, message: Any) -> None:
    watch.say(message.severity, f"{frame.system}/{frame.component}", message.text)
    watch.recall([watch.texts[-1]])


def _command(watch: Watch, t_us: int, frame: Frame, message: Any) -> None:
    vehicle = watch.vehicles.get(message.target_system)
    if vehicle is None:
        return
    if message.command == lifecycle.CMD_SET_INTERVAL:
        interval_us = message.param2
        hz = 1e6 / interval_us if interval_us > 0 else math.nan if interval_us == 0 else 0.0
        vehicle.requests[int(message.param1)] = Request(hz, "asked")
        vehicle.pending.append((int(message.param1), hz))
    else:
        watch.say(6, f"{frame.system}/{frame.component}", f"{command_name(message.command)} to {vehicle.system}")


def _ack(watch: Watch, t_us: int, frame: Frame, message: Any) -> None:
    vehicle = watch.vehicles.get(frame.system)
    if vehicle is None:
        return
    result = RESULTS.get(message.result, f"result {message.result}")
    if message.command == lifecycle.CMD_SET_INTERVAL:
        if vehicle.pending:  # the ACK does not say which message: answers come in the order of the questions
            msgid, hz = vehicle.pending.popleft()
            vehicle.requests[msgid] = Request(hz, result)
    else:
        name = command_name(message.command)
        watch.say(6 if message.result in (0, 5) else 4, f"{frame.system}/{frame.component}", f"{name}: {result}")


def _timesync(watch: Watch, t_us: int, frame: Frame, message: Any) -> None:
    vehicle = watch.vehicles.get(frame.system)
    if vehicle is not None:
        vehicle.on_timesync(t_us, message)


def _set_attitude(watch: Watch, t_us: int, frame: Frame, message: Any) -> None:
    vehicle = watch.vehicles.get(message.target_system)
    if vehicle is not None:
        vehicle.on_setpoint(t_us, message)


def _attitude_target(watch: Watch, t_us: int, frame: Frame, message: Any) -> None:
    vehicle = watch.vehicles.get(frame.system)
    if vehicle is not None and frame.component == AUTOPILOT:
        vehicle.on_echo(t_us, message.q)


def _array(watch: Watch, t_us: int, frame: Frame, message: Any) -> None:
    vehicle = watch.vehicles.get(frame.system)
    if vehicle is not None:
        vehicle.arrays[message.name] = (t_us, message.data)


def _named(watch: Watch, t_us: int, frame: Frame, message: Any) -> None:
    vehicle = watch.vehicles.get(frame.system)
    if vehicle is not None:
        vehicle.named[message.name] = (message.time_boot_ms, message.value)


_HANDLERS = {
    HEARTBEAT: _heartbeat,
    STATUSTEXT: _text,
    COMMAND_LONG: _command,
    COMMAND_ACK: _ack,
    TIMESYNC: _timesync,
    SET_ATTITUDE: _set_attitude,
    ATTITUDE_TARGET: _attitude_target,
    ARRAY: _array,
    wire.ID["NAMED_VALUE_FLOAT"]: _named,
}


# ---- words and numbers --------------------------------------------------------------------------------------------------
def mode_name(autopilot: int, custom_mode: int) -> str:
    """OFFBOARD, GUIDED, ...; the number where nobody names it."""
    if autopilot == lifecycle.PX4:
        main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
        name = PX4_MODES.get(main, f"mode {main}")
        return f"{name}.{PX4_AUTO.get(sub, sub)}" if main == 4 and sub else name
    entry = wire.dialect.enums["COPTER_MODE"].get(custom_mode) if autopilot == lifecycle.ARDUPILOT else None
    return entry.name.removeprefix("COPTER_MODE_") if entry else f"mode {custom_mode}"


def command_name(number: int) -> str:
    """NAV_LAND, DO_SET_MODE, ...; the number where nobody names it."""
    entry = wire.dialect.enums["MAV_CMD"].get(number)
    return entry.name.removeprefix("MAV_CMD_") if entry else f"command {number}"


def newest_attitude(vehicle: Vehicle) -> Any:
    """The newer of ATTITUDE_QUATERNION and ATTITUDE, decoded; None where neither came."""
    found = [vehicle.latest[msgid] for msgid in (QUATERNION, ANGLES) if msgid in vehicle.latest]
    return wire.decode(max(found, key=lambda item: item[0])[1]) if found else None


def body_rates(vehicle: Vehicle) -> tuple[float, float, float] | None:
    """The autopilot's own body rates [rad/s], of the newer attitude message."""
    message = newest_attitude(vehicle)
    return (message.rollspeed, message.pitchspeed, message.yawspeed) if message is not None else None


def angles_deg(vehicle: Vehicle) -> tuple[float, float, float] | None:
    """Roll, pitch and yaw [deg] of the newer attitude message."""
    message = newest_attitude(vehicle)
    if message is None:
        return None
    if hasattr(message, "q1"):
        return euler_deg((message.q1, message.q2, message.q3, message.q4))
    return math.degrees(message.roll), math.degrees(message.pitch), math.degrees(message.yaw)


def euler_deg(q_wxyz: tuple[float, ...]) -> tuple[float, float, float]:
    """Roll, pitch, yaw in degrees: for looking at only."""
    w, x, y, z = q_wxyz
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return math.degrees(roll), math.degrees(pitch), math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def path_error_m(vehicle: Vehicle) -> float:
    """Distance to where the vehicle should be: the companion's own figure, else to the autopilot's position target; NaN: unknown."""
    said_ms, error_m = vehicle.named.get("path_err", (0, math.nan))
    if said_ms and abs(vehicle.boot_ms - said_ms) < _FRESH_MS:
        return error_m
    here, there = vehicle.message("LOCAL_POSITION_NED"), vehicle.message("POSITION_TARGET_LOCAL_NED")
    if here is None or there is None or there.type_mask & 7:
        return math.nan
    return math.dist((here.x, here.y, here.z), (there.x, there.y, there.z))


def _near(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return all(abs(x - y) < _SAME for x, y in zip(a, b, strict=True))
