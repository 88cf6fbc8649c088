"""The live shell: endpoint + clock + pipeline + log. It owns everything that ages; nothing below it asks whether it is live.

Every accepted frame is logged before it is acted on, every sent frame before it is sent (frames of a datagram in one write). In
lockstep the clock is the barrier: all frames of a period carry its stamp (architecture, section 3).
"""

import bisect
import gc
import itertools
import math
import os
import signal
import sys
from collections import deque
from pathlib import Path
from types import FrameType
from typing import Any

from mavquad import lane, lifecycle, pipeline, position_age, relay, strangers, wire
from mavquad.errors import FlightError
from mavquad.lane import Lane
from mavquad.lifecycle import Life
from mavquad.link import clock, health
from mavquad.link.endpoint import Address, Endpoint, UdpEndpoint
from mavquad.link.flood import Guard
from mavquad.link.signing import SETUP_SIGNING, Signer
from mavquad.link.tlog import Writer
from mavquad.pipeline import Flight, Plan
from mavquad.relay import Relay
from mavquad.run_files import TraceWriter, next_log
from mavquad.wire import Frame

_MAX_DATAGRAM = 1400
_LOCKSTEP_WAIT_S, _LOCKSTEP_POLL_S = 10.0, 0.2
_SILENCE_S = 5.0
_LATENCIES = 1 << 16  # the last ones, for the summary: memory stays flat however long the flight
_RELAY_S = 0.02  # a further link waits no longer for us, however silent the autopilot is
_TIMESYNC = wire.ID["TIMESYNC"]
_SETPOINTS = frozenset((wire.ID["SET_ATTITUDE_TARGET"], wire.ID["SET_POSITION_TARGET_LOCAL_NED"]))
_STICKS = wire.ID["SET_ACTUATOR_CONTROL_TARGET"]


def request(number: int, plan: Plan, seq: int) -> Frame:
    """A local request (engage, land) as the frame it enters by, as if from a ground station."""
    own = plan.settings.link
    fields = (own.system, own.component, number, 0, *(0.0,) * 7)
    raw = wire.encode("COMMAND_LONG", fields, seq=seq, system=255, component=190)
    return wire.split(raw)[0][0]


class Companion:
    """One companion on the autopilot's endpoint, with further links (`relay`) beside it.

    speed: of a simulated vehicle's time over ours, where it does not wait for us; all that ages here ages in its time.
    """

    def __init__(
        self,
        plan: Plan,
        endpoint: Endpoint,
        run: Path,
        lockstep: bool = False,
        engage: bool = False,
        relays: tuple[Relay, ...] = (),
        signer: Signer | None = None,
        speed: float = 1.0,
    ) -> None:
        run.mkdir(parents=True, exist_ok=True)
        self.plan = plan
        self.endpoint = endpoint
        self.relays = relays
        self.lockstep = lockstep
        self.signer = signer
        self._clock = clock.Clock(speed)
        self.flight: Flight = pipeline.start(plan)
        plain = isinstance(endpoint, UdpEndpoint) and not relays and signer is None
        self.lane = Lane(plan, lockstep) if plain and lane.serves(plan) else None
        path = next_log(run, "flight")
        self.log = Writer(path)
        self.trace = TraceWriter(path.with_suffix(".trace"), plan.trace_names)
        self._refused_path = run / path.name.replace("flight", "refused")
        self._refused: Writer | None = None
        self.refused: dict[str, int] = {}
        self._engage = engage
        self._stop = False
        self._stamp_us = 0
        self._address: Address | None = None
        self._address_us = 0
        self._rest: dict[Address, bytes] = {}
        self._to_send: list[bytes] = []
        self._waiting: list[Frame] = []  # lockstep: frames of a period whose barrier is still to come
        self.sources: dict[tuple[int, int], health.Source] = {}
        self.latency_us: deque[float] = deque(maxlen=_LATENCIES)
        self.states: list[tuple[float, str, str]] = []
        self.setpoints = 0
        self.received = 0
        self._said_silent = False
        self._said_broken: set[str] = set()

    # ---- one frame ----------------------------------------------------------------------------------------------
    def _refuse(self, frame: Frame, address: Address, stamp_us: int, reason: str) -> None:
        if frame.msgid != SETUP_SIGNING:  # a key belongs in no log
            if self._refused is None:
                self._refused = Writer(self._refused_path)
            self._refused.write(stamp_us, frame.raw)
        self.refused[reason] = self.refused.get(reason, 0) + 1
        if self.refused[reason] > 1:  # said once
            return
        print(strangers.words(frame, address, reason), file=sys.stderr, flush=True)
        if reason in strangers.POSING and self.flight.life.target != (0, 0):
            self._act([strangers.notice(frame, address)], stamp_us)

    def _accepts(self, frame: Frame, address: Address, stamp_us: int) -> bool:
        reason = self.signer.refuses(frame, stamp_us) if self.signer else ""
        reason = reason or pipeline.accepts(self.plan, self.flight, frame)
        if not reason and (frame.system, frame.component) == self.flight.life.target and address != self._address:
            if self._address is not None and stamp_us - self._address_us < strangers.MOVED_S * 1e6:
                reason = strangers.ELSEWHERE
            else:
                self._found(address, stamp_us)
        if reason:
            self._refuse(frame, address, stamp_us, reason)
        return not reason

    def _found(self, address: Address, stamp_us: int) -> None:
        """Our autopilot is at this address from now on."""
        self._address, self._address_us = address, stamp_us
        if isinstance(self.endpoint, UdpEndpoint):
            self.endpoint.answer(address)

    def take(self, frames: list[Frame], address: Address, stamp_us: int) -> None:
        """Log frames that arrived together, act on them, log what they make us say.

        Until our autopilot is known one at a time: which frames are accepted depends on it.
        """
        self._settle()
        target, sources = self.flight.life.target, self.sources
        if target == (0, 0) and len(frames) > 1:
            for frame in frames:
                self.take([frame], address, stamp_us)
            return
        accepted = []
        for frame in frames:
            key = (frame.system, frame.component)
            known = key == target and address == self._address and self.signer is None and frame.msgid != SETUP_SIGNING
            if known or self._accepts(frame, address, stamp_us):
                accepted.append(frame)
                sources[key] = health.on_frame(sources.get(key), frame.seq)
        if not accepted:
            return
        if address == self._address:
            self._address_us = stamp_us
        self.received += len(accepted)
        self._act(accepted, stamp_us)
        if self._address is None and self.flight.life.target in sources:
            self._found(address, stamp_us)

    def _quick(self, data: bytes, address: Address) -> bool:
        """A datagram of plain telemetry, all at once (`lane`): logged and answered as frame by frame. False: nothing was done with it."""
        fast = self.lane
        if fast is None or address != self._address or self._waiting:
            return False
        while True:
            if not fast.inside and not fast.enter(self.flight, self.sources.get(self.flight.life.target)):
                return False
            verdict = fast.feed(data, self._stamp_us, self.flight.due_us)
            if verdict == lane.DONE:
                break
            self._settle()
            if verdict == lane.OTHER:
                return False
            self._emit(pipeline.advance(self.plan, self.flight, fast.stamp_us))  # timers first
        self._stamp_us = self._address_us = fast.stamp_us
        self.received += fast.frames
        self.setpoints += fast.setpoints
        self.log.write_bytes(fast.stamp_us, fast.log)
        if fast.trace:
            self.trace.write_bytes(fast.trace)
        if fast.sent:
            self._to_send.append(fast.sent)
        return True

    def _settle(self) -> None:
        """Whatever comes next is not for the fast lane: the flight as it is."""
        if self.lane is not None and self.lane.inside:
            target = self.flight.life.target
            self.flight, self.sources[target] = self.lane.leave(self.flight)

    def _act(self, frames: list[Frame], stamp_us: int) -> None:
        if stamp_us >= self.flight.due_us:  # timers first: they are logged at their own due time
            self._emit(pipeline.advance(self.plan, self.flight, stamp_us))
        self.log.write_all([(stamp_us, frame.raw) for frame in frames])
        self._emit(pipeline.feed_all(self.plan, self.flight, stamp_us, frames))

    def _emit(self, flight: Flight) -> None:
        before, self.flight = self.flight, flight
        if flight is before:
            return
        out = flight.outbox
        if self.signer is not None:
            out = [(stamp_us, self.signer.sign(raw, stamp_us)) for stamp_us, raw in out]
        self.log.write_all(out)
        for _, raw in out:
            self._to_send.append(raw)
            msgid = int.from_bytes(raw[7:10], "little")
            self.setpoints += msgid in _SETPOINTS or (msgid == _STICKS and flight.sticks is not None)
        for row in flight.trace:
            self.trace.write(row)
        flight.outbox, flight.trace = [], []
        if flight.life is not before.life:
            self._tell(before.life, flight.life, 1e-6 * flight.now_us)

    def _tell(self, was: Life, life: Life, t_s: float) -> None:
        """What a person is shown: changes of state, complaints, and what the autopilot says."""
        new = life.heard.whole - was.heard.whole
        for words in life.heard.recent[-new:] if new > 0 else ():
            print(f"{t_s:9.3f} s  autopilot: {words}", file=sys.stderr, flush=True)
        if life.said != was.said and life.said:
            print(f"{t_s:9.3f} s  {life.said}", file=sys.stderr, flush=True)
        if life.state != was.state:
            self.states.append((t_s, life.state, life.reason))
            print(f"{t_s:9.3f} s  {life.state}: {life.reason}", file=sys.stderr, flush=True)

    def _flush(self) -> None:
        """Send what has gathered, several frames to a datagram."""
        parts, self._to_send = self._to_send, []
        chunk: list[bytes] = []
        size = 0
        for raw in parts:
            if size + len(raw) > _MAX_DATAGRAM:
                self._out(b"".join(chunk))
                chunk, size = [], 0
            chunk.append(raw)
            size += len(raw)
        if chunk:
            self._out(b"".join(chunk))

    def _out(self, data: bytes) -> None:
        self.endpoint.send(data)
        for link in self.relays:
            link.copy(data)

    def _listen_to_relays(self) -> None:
        """What ground stations and monitors say: on to the autopilot, and to us like everything that arrives."""
        own = (self.plan.settings.link.system, self.plan.settings.link.component)
        for link in self.relays:
            for frames, address in link.heard():
                target = self.flight.life.target
                on = [frame.raw for frame in frames if relay.passes(frame, own, target, wire.addressee(frame))]
                if on:
                    self.endpoint.send(b"".join(on))
                self.take(frames, address, self._stamp_us)
            if link.broken and link.name not in self._said_broken:
                self._said_broken.add(link.name)
                print(f"--forward {link.name}: {link.broken}; flying on without it", file=sys.stderr, flush=True)

    def _want_engage(self, stamp_us: int) -> None:
        if self._engage and self.flight.life.state == lifecycle.OBSERVING:
            self._engage = False
            self._settle()
            self._act([request(lifecycle.CMD_ENGAGE, self.plan, 0)], stamp_us)

    # ---- the two loops --------------------------------------------------------------------------------------------
    def stop(self, *_: int | FrameType | None) -> None:
        """End after what has arrived already."""
        self._stop = True

    def run(self) -> None:
        """Until stopped by a signal or `stop()`. The log is whole at every moment."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self.stop)
        for words in self.plan.warnings:
            print(f"warning: {words}", file=sys.stderr, flush=True)
        gc.freeze()  # what is loaded by now stays: a collection need not walk through it, which takes a tenth of a second
        try:
            if self.lockstep:
                self._run_lockstep()
            else:
                self._run_live()
        finally:
            self.close()

    def close(self) -> None:
        """Send what is left; close logs, endpoint and signing state."""
        self._flush()
        self.log.close()
        self.trace.close()
        if self._refused is not None:
            self._refused.close()
        self.endpoint.close()
        for link in self.relays:
            link.close()
        if self.signer is not None:
            self.signer.close()

    def _frames(self, data: bytes, address: Address) -> list[Frame]:
        """Frames of a datagram, or of a piece of a byte stream."""
        if self._address in (None, address):  # what others send here is not the autopilot's
            for link in self.relays:
                link.copy(data)
        if isinstance(self.endpoint, UdpEndpoint):
            frames, junk = wire.datagram(data)
        else:
            frames, junk, self._rest[address] = wire.split(self._rest.get(address, b"") + data)
        if junk:
            self.refused["junk bytes"] = self.refused.get("junk bytes", 0) + junk
        return frames

    def _run_live(self) -> None:
        started = last_heard = clock.monotonic_s()
        greeted = -1.0
        guard = Guard(self.endpoint.sock) if isinstance(self.endpoint, UdpEndpoint) else None
        while True:
            now_us = max(self._stamp_us, self._clock.us())
            if not self.flight.heartbeat_us and clock.monotonic_s() - greeted > 1.0:  # nobody yet: say that we are here
                greeted = clock.monotonic_s()
                self.endpoint.send(self._hello(now_us))
            arrived = self.endpoint.receive(0.0 if self._stop else self._wait_s(now_us))
            begun = clock.monotonic_s()
            self._stamp_us = max(self._stamp_us, self._clock.us())
            if guard and guard.saw(sum(address != self._address for _, address in arrived), self._address, begun):
                self._say_flooded(guard)
            for data, address in arrived:
                before = self.setpoints
                self._stamp_us = max(self._stamp_us, self._clock.us())  # of what waited behind others, too: it is that late
                if not self._quick(data, address):
                    frames = self._frames(data, address)
                    if not frames:
                        continue
                    self.take(frames, address, self._stamp_us)
                self._send_off(before, begun)
                last_heard = begun
            if self.flight.heartbeat_us:
                if self._stamp_us >= self.flight.due_us:
                    self._settle()
                    self._emit(pipeline.advance(self.plan, self.flight, self._stamp_us))
                self._want_engage(self._stamp_us)
                self._listen_to_relays()
                self._flush()
            if self._stop and not arrived:
                return
            self._complain(begun - max(started, last_heard))

    def _say_flooded(self, guard: Guard) -> None:
        self.refused["floods"] = guard.raised
        if guard.raised == 1:
            print(
                "a flood of datagrams from strangers: only the autopilot is listened to until it ends",
                file=sys.stderr,
                flush=True,
            )

    def _hello(self, now_us: int) -> bytes:
        """A HEARTBEAT to whoever may be there, before anybody was heard."""
        own = self.plan.settings.link
        fields = (18, lifecycle.INVALID, 0, 0, 4, 3)
        raw = wire.encode("HEARTBEAT", fields, seq=0, system=own.system, component=own.component)
        return self.signer.sign(raw, now_us) if self.signer else raw

    def _wait_s(self, now_us: int) -> float:
        if not self.flight.heartbeat_us:
            return 0.2
        return min(_RELAY_S if self.relays else 0.2, max(0.0, 1e-6 * (self.flight.due_us - now_us) / self._clock.speed))

    def _complain(self, silent_s: float) -> None:
        if silent_s > _SILENCE_S and not self._said_silent:
            self._said_silent = True
            name = getattr(self.endpoint, "name", "the endpoint")
            print(
                f"no MAVLink from {name} for {_SILENCE_S:.0f} s; still trying (is the autopilot running, and does it send there?)",
                file=sys.stderr,
                flush=True,
            )
        elif silent_s < 1.0:
            self._said_silent = False

    def _run_lockstep(self) -> None:
        hello = self._hello(clock.EPOCH_US - 1_000_000)  # one for all: how often it is sent must not show
        waited_s = 0.0
        greeted = -1.0
        while True:
            if not self.flight.heartbeat_us and clock.monotonic_s() - greeted > 0.2:
                greeted = clock.monotonic_s()
                self.endpoint.send(hello)
            asked = clock.monotonic_s()
            arrived = self.endpoint.receive(0.0 if self._stop else _LOCKSTEP_POLL_S)
            begun = clock.monotonic_s()
            if not arrived:
                if self._stop:
                    return
                waited_s += min(2.0 * _LOCKSTEP_POLL_S, begun - asked)  # a machine put to sleep as a whole has not waited
                if waited_s > _LOCKSTEP_WAIT_S and self.flight.heartbeat_us:
                    raise FlightError(
                        f"lockstep: no barrier from the autopilot for {_LOCKSTEP_WAIT_S:.0f} s; the flight is over"
                    )
                self._complain(waited_s)
                continue
            waited_s = 0.0
            for data, address in arrived:
                before = self.setpoints
                if not self._engage and self._quick(data, address):  # a whole period and its barrier
                    self._send_off(before, begun)
                    continue
                frames = self._frames(data, address)
                if self._address not in (None, address):  # somebody else: outside of the periods
                    self.take(frames, address, self._stamp_us)
                    continue
                for frame in frames:
                    self._waiting.append(frame)
                    if frame.msgid == _TIMESYNC and self._is_barrier(frame):
                        self._period(address, begun)

    def _is_barrier(self, frame: Frame) -> bool:
        """Only our autopilot moves time on, and never back."""
        message = wire.decode(frame)
        stamp_us = clock.EPOCH_US + message.ts1 // 1000
        if message.tc1 != 0 or stamp_us < self._stamp_us:
            return False
        if self.flight.life.target not in ((0, 0), (frame.system, frame.component)):
            return False
        if self.signer and self.signer.refuses(frame, stamp_us, new=False):
            return False
        self._stamp_us = stamp_us
        return True

    def _period(self, address: Address, begun: float) -> None:
        before = self.setpoints
        frames, self._waiting = self._waiting, []
        self.take(frames[:-1], address, self._stamp_us)
        self._listen_to_relays()
        self._want_engage(self._stamp_us)
        self.take(frames[-1:], address, self._stamp_us)  # its answer ends the period
        self._send_off(before, begun)

    def _send_off(self, before: int, begun: float) -> None:
        """Send what has gathered; how long it took where a setpoint is among it, `before` the setpoints before."""
        self._flush()
        if self.setpoints > before:
            self.latency_us.append(1e6 * (clock.monotonic_s() - begun))

    # ---- at the end --------------------------------------------------------------------------------------------------
    def summary(self) -> dict[str, Any]:
        """What happened, for `fly` and for people."""
        self._settle()
        life = self.flight.life
        latency = sorted(self.latency_us) or [math.nan]
        edges = [10.0 ** (1.0 + k / 8.0) for k in range(33)]  # 10 us to 0.1 s
        target = self.sources.get(life.target)
        diagnose = getattr(self.plan.controller.module, "diagnostics", None)
        return {
            "state": life.state,
            "reason": life.reason,
            "warnings": list(self.plan.warnings),
            "states": [{"t_s": round(t, 3), "state": s, "reason": r} for t, s, r in self.states],
            "setpoints_sent": self.setpoints,
            "messages_received": self.received,
            "messages_lost": target.lost if target else 0,
            "refused": self.refused,
            "counts": self.flight.counts,
            "interventions": self.flight.interventions,
            "hover_thrust": self.flight.hover_thrust,
            "delay_s": self.flight.delay_s,
            "position_age_s": position_age.age_s(self.flight.position_age),
            "controller": diagnose(self.flight.controller) if diagnose else {},
            "rates_hz": {r.name: r.granted_hz for r in life.rates},
            "observer_samples": {
                stage.label: stage.module.health(state, self.flight.now_us).counts._asdict()
                for stage, state in zip(self.plan.observers, self.flight.observers, strict=True)
            },
            "latency_us": {
                "p50": latency[len(latency) // 2],
                "p99": latency[min(len(latency) - 1, int(0.99 * len(latency)))],
                "max": latency[-1],
            },
            "latency_histogram": {
                "edges_us": edges,
                "counts": [bisect.bisect(latency, b) - bisect.bisect(latency, a) for a, b in itertools.pairwise(edges)],
            },
            "pid": os.getpid(),
        }
