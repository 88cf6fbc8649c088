"""The simulated autopilot as a whole, without a socket or a clock: bytes in, vehicle time on, bytes out.

A shell (`sitl.shell`) opens links, hands over what arrives, moves vehicle time on and sends what `collect` gives. All that happens
is a function of the configuration and of which bytes came at which vehicle time.
"""

from collections import deque
from collections.abc import Iterator
from typing import Any

from mavquad import wire
from mavquad.link.signing import SETUP_SIGNING, Signer
from mavquad.wire import Frame
from sitl import ardupilot, config, links, px4, telemetry
from sitl.arrivals import Arrivals
from sitl.autopilot import TICK_US, Autopilot, check_airframe
from sitl.faults import Faults
from sitl.helicopter import Helicopter
from sitl.journal import Journal, Record, stamped
from sitl.links import NEVER, Link, Stream
from sitl.params import Table
from sitl.ring import Ring
from sitl.services import Services
from sitl.vehicle import Vehicle
from sitl.voice import NOTHING, Voice, Wanted

COMPANION = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
_HEARTBEAT, _TIMESYNC = wire.ID["HEARTBEAT"], wire.ID["TIMESYNC"]
_BOOT_SILENCE_US = 1_500_000
_TEXT = 50  # characters of a STATUSTEXT


class Simulation:
    """One vehicle, its autopilot and its links. `record(t_us, data)` is given, once a control period, the records of
    a tlog up to t_us: every frame and the truth, stamped in vehicle time (from `config.EPOCH_US` on).

    With `lockstep` time waits (in the shell) for a companion: its first HEARTBEAT, then an answer to each period's barrier.
    """

    def __init__(
        self, sitl: config.Sitl, record: Record | None = None, lockstep: bool = False, signer: Signer | None = None
    ) -> None:
        self.config, self.lockstep, self.signer = sitl, lockstep, signer
        self.refused: dict[str, int] = {}  # whole frames, by reason
        self.epoch_us = config.EPOCH_US
        self.vehicle = Helicopter(sitl) if config.vehicles(sitl)[1].kind == "helicopter" else Vehicle(sitl)
        check_airframe(self.vehicle)
        self.links: list[Link] = []
        self.partner: Link | None = None  # of the lockstep
        self.periods = self.engaged_periods = self.misses = 0
        # ArduPilot sends its gyro behind its low-pass
        self.gyro_name = "gyro_rad_s" if sitl.personality == "px4" else "rates_rad_s"
        self.mocap_age_us = 1000 * sitl.noise.mocap_delay_ms
        self._journal = Journal(record)
        self._period_us = 1000 * sitl.period_ms
        self._services = Services(self)
        self._arrivals = Arrivals(self, self._services)
        self.faults = Faults(sitl.faults, self)
        self._reboot_us = NEVER
        self._silent_until_us = 0
        self._voice = Voice(sitl, self.vehicle, self.gyro_name)
        self.autopilot = self._boot()
        self._tick_us = TICK_US
        self._stream_us = NEVER
        self._was_engaged = False
        self._barriers: deque[int] = deque()  # those not answered yet, us of vehicle time
        self._answered = 0  # barriers
        self._first_heartbeat: bytes | None = None
        self._texts = 0

    @property
    def t_us(self) -> int:
        """Vehicle time."""
        return self.vehicle.t_us

    # ---- links --------------------------------------------------------------------------------------------------------
    def open_link(self) -> Link:
        """A new peer; its default streams begin at once."""
        builds, offered = telemetry.builders(self), self._offered()
        streams = [Stream(name, rank, builds[name]) for rank, name in enumerate(offered)]
        plain = self.signer is None and not self.config.link.jitter_ms and not links.faulty(self.config.link)
        link = Link(len(self.links), self.config, streams, self._voice.tables(offered) if plain else None)
        self.links.append(link)
        for name in link.streams:
            self.set_interval(link, name, 0)
        return link

    def set_interval(self, link: Link, name: str, wanted_us: int) -> None:
        """A stream's interval: rounded up to whole loop periods; 0 is the default, below 0 off."""
        if wanted_us == 0:
            hz = self._default_hz(name)
            wanted_us = round(1e6 / hz) if hz else -1
        dt_us = self.vehicle.dt_us
        link.set_interval(name, max(dt_us, -(-wanted_us // dt_us) * dt_us) if wanted_us > 0 else 0, self.t_us)
        self._stream_us = min(peer.due_us for peer in self.links)

    def receive(self, link: Link, data: bytes) -> bool:
        """Bytes of one datagram, sent at the oldest barrier that has no answer yet. True when its answer was in it; before time 0
        nothing is kept."""
        answered = False
        frames, refused = wire.datagram(data)
        link.refused += refused
        for frame in frames:
            if frame.msgid == SETUP_SIGNING:  # it carries a key: kept nowhere
                self.refuse("a key sent over the link")
                continue
            if self.lockstep and not self._answered and self._is_start(link, frame):
                continue
            t_us = self._hear(frame.raw)
            if frame.msgid == _TIMESYNC and link is self.partner and self._answers(frame) and not self._forged(frame):
                answered = True
                self._answered += 1
                self._barriers.popleft()
            else:
                link.up.put(t_us, frame.raw if link.up.faulty else frame)
        return answered

    def barrier(self, t_us: int) -> None:
        """A barrier of the lockstep goes out with what is collected for t_us."""
        self._barriers.append(t_us)

    def collect(self, link: Link, t_us: int | None = None) -> list[bytes]:
        """Datagrams for this peer: what has come through its wire by t_us (by now; later by its delay at most), and the barrier
        for the lockstep's partner."""
        t_us = self.t_us if t_us is None else t_us
        barrier_ns = 1000 * t_us if link is self.partner and self._barriers and self._barriers[-1] == t_us else -1
        if isinstance(link.down, Ring):
            ours, datagrams, records = link.down.leave(t_us, self.epoch_us + t_us, barrier_ns)
            link.sent += ours
            if records:
                self._journal.sent(self.epoch_us + t_us, records)
            return datagrams
        frames = link.down.take(t_us, lambda item: self._frame(link, item, t_us))
        if barrier_ns >= 0:
            frames.append(self._frame(link, ("TIMESYNC", (0, barrier_ns)), t_us))
        return links.datagrams(frames)

    @property
    def silent(self) -> bool:
        """The autopilot boots: it neither hears nor says anything."""
        return self.t_us < self._silent_until_us

    def send(self, link: Link, name: str, fields: tuple[Any, ...]) -> None:
        """One message to one peer; none while the autopilot boots."""
        if not self.silent:
            link.down.put(self.t_us, (name, fields))

    def say(self, severity: int, text: str) -> None:
        """STATUSTEXT to every peer, in numbered parts where it is longer than MAVLink's 50 characters."""
        parts, number = [text], 0
        if len(text) > _TEXT:
            parts = [text[i : i + _TEXT] for i in range(0, len(text) + 1, _TEXT)]  # a part that is not full ends it
            self._texts = number = self._texts % 0xFFFF + 1
        for link in self.links:
            for i, part in enumerate(parts):
                self.send(link, "STATUSTEXT", (severity, part, number, i))

    # ---- time ---------------------------------------------------------------------------------------------------------
    @property
    def period_end_us(self) -> int:
        """When the control period that runs now ends."""
        return (self.t_us // self._period_us + 1) * self._period_us

    def run_period(self) -> None:
        """What is left of a control period; `record_period` comes next, or when its frames were collected."""
        self.run_until(self.period_end_us)
        self.end_period()

    def end_period(self) -> None:
        """At the end of a control period: was a setpoint missed?"""
        self.periods += 1
        engaged = self.autopilot.engaged
        if engaged and self._was_engaged:
            self.engaged_periods += 1
            self.misses += self.autopilot.fresh == 0
        self._was_engaged, self.autopilot.fresh = engaged, 0

    def record_period(self) -> None:
        """The truth of this instant, and all that waits for the log: nobody waits for it, so it comes behind what is sent."""
        if self._journal.kept:
            stamp_us = self.epoch_us + self.t_us
            self._journal.sent(stamp_us, self._voice.truth(stamp_us, self.misses, self.autopilot.engaged))
            self.flush()

    def flush(self, last: bool = False) -> None:
        """Hand over what is not recorded yet, by stamp; what truth or answers may still come before waits for them."""
        now_us = self.vehicle.t_us
        until_us = min(now_us + 1, self._barriers[0]) if self._barriers else now_us + 1
        self._journal.flush(NEVER if last else self.epoch_us + until_us)

    def run_until(self, t_us: int, speak: bool = True) -> None:
        """Move on to t_us (a whole number of loop periods): plant, arrivals, modes and streams at their instants. What streams say
        at t_us itself may be left to the next call (`speak`)."""
        vehicle, links_, faults = self.vehicle, self.links, self.faults
        now_us = vehicle.t_us
        while now_us < t_us:
            due_us, ring = self._called_us(), self._ring()
            if ring is None:
                self._run(min(t_us, due_us, self._stream_us))
            else:
                self._leap(ring, t_us, due_us)
            now_us = vehicle.t_us
            if now_us >= faults.due_us:
                faults.apply(now_us)
            if now_us >= self._reboot_us:
                self.reboot()
            for link in links_:
                if link.up.due_us < now_us:  # what comes at this very instant is seen in the next turn of the loop
                    for arrived in link.up.take(now_us - 1, _as_it_is):
                        self._arrivals.deliver(link, arrived)
            if now_us >= self._tick_us:
                self._tick_us += TICK_US
                self._services.tick()
                self.autopilot.tick(now_us)
                self._ask_time(now_us)
            # a leap begins with what streams say
            if now_us >= self._stream_us and (ring is None or self._reboot_us != NEVER or (speak and now_us >= t_us)):
                self._emit(now_us)

    def run_to(self, t_us: int) -> None:
        """Move on to t_us; every control period that ends by then is counted and recorded."""
        while (end_us := self.period_end_us) <= t_us:
            due_us, ring = self._called_us(), self._ring()
            if ring is not None and (called_us := self._instant(due_us)) < end_us:
                self.run_until(called_us, speak=False)
            elif ring is not None and due_us > t_us > end_us and self._journal.kept:  # nobody is called before t_us
                self.end_period()
                wanted = end_us, self.epoch_us + end_us, self.misses, self.autopilot.engaged
                while self.vehicle.t_us < t_us:
                    self._leap(ring, t_us, due_us, wanted)
                self.flush()
            else:
                self.run_period()
                self.record_period()
        self.run_until(t_us)

    def truth(self) -> Any:
        """The truth of this instant as a record (`told.TOLD`); the disturbance is the mean since the last call."""
        return self._voice.find_truth(self.misses, self.autopilot.engaged)

    def battery(self) -> float:
        """What is left of the battery, 1 to 0."""
        life_s = self.config.battery_s
        return 1.0 if life_s <= 0.0 else max(0.0, 1.0 - 1e-6 * self.t_us / life_s)

    def reboot_at(self, t_us: int) -> None:
        """The autopilot starts again then."""
        self._reboot_us = t_us

    def reboot(self) -> None:
        """The autopilot starts again: rotors stop, its clock and sequences begin anew, and for a while it says nothing."""
        self._reboot_us = NEVER
        params = self.autopilot.params
        self.autopilot = self._boot()
        self.autopilot.params = params
        self.autopilot.apply_params()
        self._silent_until_us = self.t_us + _BOOT_SILENCE_US
        for link in self.links:
            link.restart()
            for name in link.streams:
                self.set_interval(link, name, 0)

    # ---- inside -------------------------------------------------------------------------------------------------------
    def _boot(self) -> Autopilot:
        tuned, _ = config.vehicles(self.config)
        if self.config.personality == "px4":
            table = Table(px4.defaults(tuned), self.config.params, bytewise=True)
            autopilot: Autopilot = px4.Px4(self.vehicle, table, self.say)
        else:
            table = Table(ardupilot.defaults(tuned), self.config.params, bytewise=False)
            autopilot = ardupilot.ArduPilot(self.vehicle, table, self.say)
        self._voice.booted(autopilot)
        return autopilot

    def _offered(self) -> list[str]:
        other = {"px4": "EKF_STATUS_REPORT", "ardupilot": "ESTIMATOR_STATUS"}[self.config.personality]
        without = "" if isinstance(self.vehicle, Helicopter) else "ACTUATOR_CONTROL_TARGET"
        return [name for name in telemetry.ORDER if name not in (other, without)]

    def _default_hz(self, name: str) -> float:
        source = self.config.attitude_source
        if name == "ATT_POS_MOCAP":
            return float(self.config.noise.mocap_rate_hz) if source != "ahrs" else 0.0
        if name in ("ATTITUDE", "ATTITUDE_QUATERNION") and source == "mocap":
            return 0.0
        return {"px4": px4, "ardupilot": ardupilot}[self.config.personality].STREAMS_HZ.get(name, 0.0)

    def _called_us(self) -> int:
        """When something other than a stream is due: a tick, a fault, an arrival."""
        due_us = min(self._tick_us, self.faults.due_us)
        for link in self.links:
            if link.up.due_us < due_us:
                due_us = link.up.due_us + 1
        return due_us

    def _ring(self) -> Ring | None:
        """Where kernels may put what streams say: of a single peer, while no restart is waited for."""
        return self.links[0].ring if len(self.links) == 1 and self._reboot_us == NEVER else None

    def _instant(self, t_us: int) -> int:
        """The first of the loop's instants from t_us on, but behind this one."""
        now_us, dt_us = self.vehicle.t_us, self.vehicle.dt_us
        return now_us + max(1, -((now_us - t_us) // dt_us)) * dt_us

    def _run(self, t_us: int) -> None:
        """Move the vehicle to `_instant` of t_us."""
        vehicle = self.vehicle
        vehicle.run((self._instant(t_us) - vehicle.t_us) // vehicle.dt_us)

    def _leap(self, ring: Ring, t_us: int, due_us: int, wanted: Wanted = NOTHING) -> None:
        """Move to t_us or, where anything but streams is due before, to that; what streams say on the way a kernel makes."""
        vehicle = self.vehicle
        now_us = vehicle.t_us
        until_us = self._instant(min(t_us, due_us))
        steps, last = (until_us - now_us) // vehicle.dt_us, due_us > until_us
        self._voice.heed(self.autopilot)
        rank, self._stream_us, truth = self._voice.leap(ring, steps, last, self._all_laid_out(now_us), wanted)
        if truth:
            self._journal.sent(wanted[1], truth)
        if rank >= 0:
            self._emit(vehicle.t_us, rank)

    def _all_laid_out(self, t_us: int) -> bool:
        """Whether kernels may make what has a layout: nobody is silent or sick, and nothing is unknown."""
        return t_us >= self._silent_until_us and self.faults.none and self.autopilot.has_origin

    def _emit(self, t_us: int, rank: int = -1) -> None:
        """What the streams say at this instant; from a `rank` on, which a kernel has left to us."""
        silent, dropping = t_us < self._silent_until_us, self.faults.dropping
        for link in self.links:
            for stream in self._due(link, t_us, rank):
                quiet = silent or (dropping and self.faults.drops(stream.name))
                fields = None if quiet else stream.build()
                if fields is not None:
                    link.down.put(t_us, (stream.name, fields))
        self._stream_us = min(link.due_us for link in self.links)

    def _due(self, link: Link, t_us: int, rank: int) -> Iterator[Stream]:
        """The streams of a peer that are due now and that no kernel makes, in the order in which they are sent."""
        if link.ring is None:
            for stream in link.ordered:
                if stream.due_us <= t_us:
                    stream.due_us += stream.interval_us
                    yield stream
            return
        self._voice.heed(self.autopilot)
        all_laid_out = self._all_laid_out(t_us)
        if rank < 0:
            rank = self._voice.speak(link.ring, 0, all_laid_out)
        while rank >= 0:
            yield link.offered[rank]
            rank = self._voice.speak(link.ring, rank + 1, all_laid_out)

    def _frame(self, link: Link, item: Any, t_us: int) -> bytes:
        if isinstance(item, bytes):  # another's, forwarded as it came
            raw = item
        elif self.signer is None:
            raw = link.encode(item)
        else:
            raw = self.signer.sign(link.encode(item), self.epoch_us + t_us, link.index & 0xFF)
        self._journal.sent(self.epoch_us + t_us, stamped(self.epoch_us + t_us, raw))
        return raw

    @property
    def _said_us(self) -> int:
        """When a peer says what arrives now: at the oldest barrier that has no answer yet."""
        return self._barriers[0] if self._barriers else self.t_us

    def _hear(self, raw: bytes) -> int:
        """Keep a frame for the log; when it was said."""
        t_us = self._said_us
        self._journal.heard(self.epoch_us + t_us, raw)
        return t_us

    def _answers(self, frame: Frame) -> bool:
        m = wire.decode(frame)
        return bool(self._barriers and m.ts1 == 1000 * self._barriers[0] and m.tc1 != 0)

    def _forged(self, frame: Frame) -> bool:
        """Whether a frame of the lockstep itself is not our partner's; its time is that of the barrier."""
        return self.signer is not None and self.signer.refuses(frame, self.epoch_us + self._said_us, new=False) != ""

    def refuse(self, reason: str) -> None:
        """Count a whole frame that was not taken."""
        self.refused[reason] = self.refused.get(reason, 0) + 1

    def _is_start(self, link: Link, frame: Frame) -> bool:
        """A companion repeats its first HEARTBEAT until time begins: one of them is kept, however often it came."""
        if self._forged(frame):
            self.refuse("badly signed")
            return True
        if self.partner is None:
            if frame.msgid == _HEARTBEAT and frame.component == COMPANION:
                self.partner = link
            return True
        if not self._barriers:
            return True
        if link is not self.partner:
            return False
        if frame.msgid == _HEARTBEAT and frame.component == COMPANION:
            self._first_heartbeat = frame.raw
            return True
        if self._first_heartbeat is not None:
            link.up.put(self._hear(self._first_heartbeat), self._first_heartbeat)
            self._first_heartbeat = None
        return False

    def _ask_time(self, t_us: int) -> None:
        every_us = self.autopilot.timesync_us
        if every_us and not self.lockstep and t_us % every_us < TICK_US:
            for link in self.links:
                self.send(link, "TIMESYNC", (0, 1000 * (t_us - self.autopilot.boot_us)))


def _as_it_is(item: Any) -> Any:
    return item
