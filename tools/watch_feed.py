"""Where a watch gets its frames from: a live endpoint, or a log that is played with pause, step, speed and seek."""

import threading
from collections import deque
from pathlib import Path

import numpy as np

from mavquad import lifecycle, wire
from mavquad.errors import LinkError
from mavquad.link import clock
from mavquad.link.columns import Log
from mavquad.link.endpoint import Address, Endpoint, open_endpoint
from mavquad.strangers import MOVED_S
from mavquad.wire import Frame
from tools.watch import AUTOPILOT, HEARTBEAT, LOST_US, Watch

REQUESTER = (254, 190)  # not 255: no autopilot must take us for its ground station and miss us when we go (GCS failsafe)
_ASK_S, _TRIES = 0.5, 3
_LISTEN_US = 2_000_000  # before the first request: what comes unasked?
_BEFORE_US = 60_000_000  # a seek rebuilds what was seen from so long before
_READ_S = 0.2
SILENCE_S = 5.0
RATES_HZ = {
    "ATTITUDE_QUATERNION": 50.0,
    "LOCAL_POSITION_NED": 20.0,
    "ATTITUDE_TARGET": 20.0,
    "HIGHRES_IMU": 50.0,
    "SERVO_OUTPUT_RAW": 20.0,
    "EXTENDED_SYS_STATE": 2.0,
    "SYS_STATUS": 2.0,
}


class Live:
    """An endpoint read by a thread, so that stamps are those of arrival. Sends nothing unless `request_rates`."""

    playing = False

    def __init__(self, name: str, request_rates: bool = False) -> None:
        self.name = name
        self.watch = Watch()
        self.error = ""
        self._endpoint: Endpoint = open_endpoint(name)
        self._waiting: deque[tuple[int, bytes, Address]] = deque()
        self._rest: dict[Address, bytes] = {}
        self._homes: dict[tuple[int, int], tuple[Address, int]] = {}  # where each sender is, and when it was heard there
        self._requester = Requester(self._endpoint) if request_rates else None
        self._opened_us = clock.wall_us()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, name="endpoint", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while not self._stop.is_set():
            try:
                for data, address in self._endpoint.receive(_READ_S):
                    self._waiting.append((clock.wall_us(), data, address))
            except LinkError as error:
                self.error = str(error)
                return

    def advance(self, _wall_s: float = 0.0) -> None:
        """Take what has arrived; let time pass."""
        while self._waiting:
            t_us, data, address = self._waiting.popleft()
            frames, junk, rest = wire.split(self._rest.get(address, b"") + data)
            self._rest[address] = rest
            self.watch.junk_bytes += junk
            for frame in frames:
                if self._believed(frame, address, t_us):
                    self.watch.take(t_us, frame)
        self.watch.pass_time(clock.wall_us())
        if self._requester is not None:
            self._requester.step(self.watch)

    def _believed(self, frame: Frame, address: Address, t_us: int) -> bool:
        """Whoever was heard first has its id until it is silent; another address with that id is said, and not shown."""
        sender = (frame.system, frame.component)
        home, heard_us = self._homes.get(sender, (address, t_us))
        if home != address and t_us - heard_us < MOVED_S * 1e6:
            self.watch.pass_time(t_us)
            self.watch.stranger(sender, address)
            return False
        self._homes[sender] = (address, t_us)
        return True

    @property
    def silent(self) -> bool:
        """Nothing at all was heard, for longer than one would expect."""
        return not self.watch.frames and clock.wall_us() - self._opened_us > SILENCE_S * 1e6

    def status(self) -> str:
        """What is to be said of the feed itself."""
        if self.error:
            return self.error
        if self.silent:
            silent_s = 1e-6 * (clock.wall_us() - self._opened_us)
            spoken = "" if self.name.startswith("udpin") or self._requester else "; a passive monitor does not speak first"
            return f"{self.name}: nothing heard for {silent_s:.0f} s{spoken}; still listening"
        return f"live {self.name}"

    def close(self) -> None:
        self._stop.set()
        self._thread.join(2.0 * _READ_S + 1.0)
        self._endpoint.close()


class Requester:
    """Asks the first autopilot heard for message rates, one by one, each up to three times.

    Only for what does not come as fast already: a companion on the same vehicle may live on a faster rate.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self._left = list(RATES_HZ.items())
        self._tries = self._seq = 0
        self._due_us = self._beat_us = self._from_us = 0

    def step(self, watch: Watch) -> None:
        now_us = watch.now_us
        if now_us >= self._beat_us:
            self._beat_us = now_us + 1_000_000
            self._send("HEARTBEAT", (18, lifecycle.INVALID, 0, 0, 4, 3))
        if not watch.vehicles or not self._left:
            return
        vehicle = next(iter(watch.vehicles.values()))
        self._from_us = self._from_us or now_us + _LISTEN_US
        if now_us < self._from_us:
            return
        name, hz = self._left[0]
        if not self._tries and watch.rate_hz(vehicle.system, name) >= 0.9 * hz:
            self._next()
            return
        answer = vehicle.requests.get(wire.ID[name])
        if self._tries and answer is not None and answer.result != "asked":
            self._next()
        elif now_us >= self._due_us and self._tries >= _TRIES:
            watch.say(4, "monitor", f"{name}: no answer to our request for {hz:g} Hz")
            self._next()
        elif now_us >= self._due_us:
            self._tries += 1
            self._due_us = now_us + round(_ASK_S * 1e6)
            params = (float(wire.ID[name]), 1e6 / hz, 0.0, 0.0, 0.0, 0.0, 0.0)
            fields = (vehicle.system, AUTOPILOT, lifecycle.CMD_SET_INTERVAL, self._tries - 1, *params)
            frame = self._send("COMMAND_LONG", fields)
            if self._tries == 1:
                watch.take(now_us, frame)

    def _next(self) -> None:
        self._left.pop(0)
        self._tries = self._due_us = 0

    def _send(self, name: str, fields: tuple[object, ...]) -> Frame:
        raw = wire.encode(name, fields, seq=self._seq, system=REQUESTER[0], component=REQUESTER[1])
        self._seq = (self._seq + 1) & 0xFF
        self._endpoint.send(raw)
        return wire.split(raw)[0][0]


class Playback:
    """A log played at any speed; `watch` is what had been seen by `now_us`."""

    playing = True

    def __init__(self, path: Path, speed: float = 1.0) -> None:
        self.log = Log(path)
        self.name = str(path)
        self.error = ""
        self.speed, self.paused = speed, False
        self._times_us = np.maximum.accumulate(self.log.t_us)  # a stamp that runs back is played with the one before
        self.start_us, self.end_us = int(self._times_us[0]), int(self._times_us[-1])
        self.now_us = self.start_us
        self.watch = Watch()
        self._next = 0

    @property
    def over(self) -> bool:
        return self._next >= len(self.log)

    def advance(self, wall_s: float) -> None:
        """Play on for so much wall time."""
        if not self.paused and not self.over:
            self._play_to(min(self.end_us, self.now_us + round(1e6 * wall_s * self.speed)))

    def step(self) -> None:
        """One more message."""
        self.paused = True
        if not self.over:
            self.now_us = int(self._times_us[self._next])
            self._take()

    def seek(self, t_us: int) -> None:
        """Go to any time: what a viewer of the minute before it would have seen."""
        t_us = min(max(t_us, self.start_us), self.end_us)
        if t_us < self.now_us:
            from_us = t_us - _BEFORE_US
            older = [text for text in self.watch.texts if text.t_us < from_us]
            self.watch = Watch()
            self._next = int(np.searchsorted(self._times_us, from_us))
            self._who_was_there(self._next)
            self.watch.texts.clear()  # what that made it say is among the older texts
            self.watch.texts.extend(older)
            self.watch.recall(older)
            self.watch.begin_again(self.start_us, self._next, self.log.position(self._next) - 8 * self._next)
        self._play_to(t_us)

    def _who_was_there(self, before: int) -> None:
        """The HEARTBEATs of the seconds before the rebuilt minute."""
        for number in range(int(np.searchsorted(self._times_us, self._times_us[before] - LOST_US)), before):
            t_us, frame = self.log.frame(number)
            if frame.msgid == HEARTBEAT:
                self.watch.take(t_us, frame)

    def _play_to(self, t_us: int) -> None:
        last = int(np.searchsorted(self._times_us, t_us, side="right"))
        while self._next < last:
            self._take()
        self.now_us = t_us
        self.watch.pass_time(t_us)

    def _take(self) -> None:
        frame = self.log.frame(self._next)[1]
        self.watch.take(int(self._times_us[self._next]), frame)
        self._next += 1

    def status(self) -> str:
        """Where the playback is."""
        at, whole = 1e-6 * (self.now_us - self.start_us), 1e-6 * (self.end_us - self.start_us)
        state = "end" if self.over else "paused" if self.paused else f"x{self.speed:g}"
        return f"{Path(self.name).name} {at:.1f}/{whole:.1f} s {state}"

    def close(self) -> None:
        """Nothing is held open."""


Feed = Live | Playback
