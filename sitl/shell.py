"""The live half: UDP sockets, wall time and the log around a `Simulation`, in lockstep or at a speed."""

import gc
import json
import signal
import socket
import sys
import time
from collections import deque
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

from mavquad import wire
from mavquad.errors import ConfigError, FlightError, LinkError
from mavquad.link import tlog
from mavquad.link.signing import Signer
from sitl.config import Sitl
from sitl.links import Link
from sitl.simulation import Simulation

Address = tuple[str, int]
ANSWER_S = 10.0  # the partner's time for one barrier
PEERS = 64  # addresses that are answered on one port
_POLL_S = 0.2  # how soon a signal is noticed
_AHEAD = 2  # barriers under way at most
_SLICE_US = 4_000  # of vehicle time at a speed
_BEHIND_US = 250_000  # of vehicle time: further behind the wall clock than this, the simulation stops trying to catch up
_ROUND = 256  # datagrams read from one socket before vehicle time goes on


class Port:
    """One UDP socket; every address that speaks on it is a link of its own."""

    def __init__(self, sock: socket.socket, name: str) -> None:
        self.socket, self.name = sock, name
        self.links: dict[Address, Link] = {}
        self.timeout_s = -1.0  # what the socket was told last
        self.full = False  # said


class Ports:
    """All sockets of the simulator."""

    def __init__(self, sim: Simulation) -> None:
        self._sim = sim
        self._ports: list[Port] = []
        self._copies: list[tuple[socket.socket, Address]] = []

    def open(self, endpoint: str) -> None:
        """`udpin:HOST:PORT` listens, `udpout:HOST:PORT` speaks first. Raises ConfigError, LinkError."""
        kind, address = _parse(endpoint)
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            sock.bind(address if kind == "udpin" else ("", 0))
        except OSError as error:
            sock.close()
            raise LinkError(
                f"{endpoint}: cannot listen there: {error.strerror}; stop the program that uses it or give another port"
            ) from None
        self._add(sock, endpoint)
        if kind == "udpout":
            self._ports[-1].links[address] = self._sim.open_link()

    def adopt(self, fd: int) -> None:
        """A bound UDP socket that was handed down. Raises LinkError."""
        try:
            self._add(socket.socket(fileno=fd), f"socket {fd}")
        except OSError as error:
            raise LinkError(f"--socket-fd {fd}: not a socket that was handed down: {error.strerror}") from None

    def copy_to(self, endpoint: str) -> None:
        """Every datagram of either direction is sent there, too. Raises ConfigError."""
        _, address = _parse(endpoint)
        self._copies.append((socket.socket(socket.AF_INET, socket.SOCK_DGRAM), address))

    def receive(self, timeout_s: float) -> bool:
        """Take what is there, else what arrives within timeout_s (0: nothing is waited for). True when a barrier was answered."""
        if len(self._ports) == 1:
            return self._read(self._ports[0], timeout_s)
        answered = False
        share = timeout_s / len(self._ports)
        for port in self._ports:
            answered |= self._read(port, share)
        return answered

    def send(self, t_us: int) -> None:
        """What the simulation has for each link by t_us."""
        for port in self._ports:
            for address, link in port.links.items():
                for data in self._sim.collect(link, t_us):
                    self._out(port.socket, data, address)
                    for copy, to in self._copies:
                        self._out(copy, data, to)

    def close(self) -> None:
        """Close every socket."""
        for port in self._ports:
            port.socket.close()
        for sock, _ in self._copies:
            sock.close()

    def _add(self, sock: socket.socket, name: str) -> None:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 21)
        self._ports.append(Port(sock, name))

    def _read(self, port: Port, timeout_s: float) -> bool:
        """One datagram, waited for; then whatever else is there."""
        flags = 0
        if timeout_s != port.timeout_s:
            port.timeout_s = timeout_s
            port.socket.settimeout(timeout_s)
        for _ in range(_ROUND):
            try:
                data, address = port.socket.recvfrom(65536, flags)
            except (TimeoutError, BlockingIOError):
                break
            except ConnectionError:
                continue
            link = port.links.get(address) or self._meet(port, address, data)
            if link is None:
                continue
            for copy, to in self._copies:
                self._out(copy, data, to)
            if self._sim.receive(link, data):
                return True
            flags = socket.MSG_DONTWAIT
        return False

    def _meet(self, port: Port, address: Address, data: bytes) -> Link | None:
        """A link for an address that speaks MAVLink, while there is room: whoever sends junk is not answered with a stream."""
        if len(port.links) < PEERS and wire.datagram(data)[0]:
            port.links[address] = self._sim.open_link()
            return port.links[address]
        if len(port.links) == PEERS and not port.full:
            port.full = True
            who = f"{address[0]}:{address[1]}"
            print(f"sitl: {port.name}: {PEERS} addresses speak here, room for no more; {who} gets no answer", file=sys.stderr)
        refused = self._sim.refused
        refused["datagrams without an answer"] = refused.get("datagrams without an answer", 0) + 1
        return None

    def _out(self, sock: socket.socket, data: bytes, address: Address) -> None:
        try:
            sock.sendto(data, address)
        except OSError as error:  # nobody there, or no route for now: as on a radio link
            print(f"sitl: cannot send to {address[0]}:{address[1]}: {error.strerror}", file=sys.stderr)


class Run:
    """One run of the program: `lockstep()` or `realtime(speed)`, then `report()`."""

    def __init__(
        self,
        sitl: Sitl,
        lockstep: bool,
        log: Path | None,
        landed_s: float | None,
        max_time_s: float | None,
        signer: Signer | None = None,
    ) -> None:
        self._writer = tlog.Writer(log) if log else None
        self.sim = Simulation(sitl, self._writer.write_bytes if self._writer else None, lockstep, signer)
        if signer is not None and not lockstep:  # simulation time 0 is now
            signer.offset_us = time.time_ns() // 1000 - self.sim.epoch_us
        self.ports = Ports(self.sim)
        self._landed_us = None if landed_s is None else round(1e6 * landed_s)
        self._max_us = None if max_time_s is None else round(1e6 * max_time_s)
        self._stop = False
        self._began_s = time.monotonic()
        self._late_s = 0.0
        self._pacing_ms: deque[float] = deque(maxlen=1 << 16)  # how late each slice began

    def stop(self, signum: int = 0, frame: FrameType | None = None) -> None:
        """Ask it to end; the log stays whole. Made to be a signal handler."""
        self._stop = True

    def lockstep(self) -> None:
        """Vehicle time waits for the companion's answers. Raises FlightError when they do not come.

        It waits only where an answer could make a difference: within the wire's delay it runs ahead, and the flight is the same.
        """
        while self.sim.partner is None and not self._stop:
            self.ports.receive(_POLL_S)
        self._began_s = time.monotonic()
        sim = self.sim
        delay_us, period_us, dt_us = round(1e3 * sim.config.link.delay_ms), 1000 * sim.config.period_ms, sim.vehicle.dt_us
        sent_us = answered_us = sim.t_us  # the last barriers
        while answered_us < sent_us or not self._over():
            # What arrives by the next barrier was sent a delay before it; what is said at a barrier arrives a delay after it.
            ready_us = max(sim.t_us, (sent_us + period_us - delay_us) // dt_us * dt_us)
            free_us = answered_us + period_us + delay_us
            if ready_us <= free_us and sent_us - answered_us < _AHEAD * period_us and not self._over():
                sim.run_to(ready_us)
                sent_us += period_us
                sim.barrier(sent_us)
                self.ports.send(sent_us)
            else:
                answered_us += period_us
                self._await_answer(answered_us)
        sim.run_to(sent_us)  # the end of what was begun

    def _await_answer(self, barrier_us: int) -> None:
        waited_s, since_s = 0.0, time.monotonic()
        while not self.ports.receive(_POLL_S) and not self._stop:
            now_s = time.monotonic()
            waited_s += min(2.0 * _POLL_S, now_s - since_s)  # a machine put to sleep as a whole has not waited
            since_s = now_s
            if waited_s > ANSWER_S:
                raise FlightError(
                    f"lockstep: no answer to the barrier of {1e-6 * barrier_us:.3f} s within {ANSWER_S:.0f} s; the flight is aborted"
                )

    def realtime(self, speed: float) -> None:
        """Nobody waits; vehicle time runs at `speed` times wall time as far as the machine allows.

        What has arrived is read before each slice, the more so behind the clock: vehicle time must not run on while setpoints wait.
        """
        zero_s, behind_s = time.monotonic(), 1e-6 * _BEHIND_US / speed
        while not self._over():
            until_us = min(self.sim.t_us + _SLICE_US, self.sim.period_end_us)
            due_s = zero_s + 1e-6 * until_us / speed
            left_s = due_s - time.monotonic()
            if left_s < -behind_s:
                self._late_s -= left_s
                zero_s -= left_s
            while True:
                self.ports.receive(max(0.0, min(left_s, _POLL_S)))
                left_s = due_s - time.monotonic()
                if left_s <= 0.0 or self._stop:
                    break
            self._pacing_ms.append(1e3 * max(0.0, -left_s))
            ended = until_us == self.sim.period_end_us
            self.sim.run_until(until_us)
            if ended:
                self.sim.end_period()
            self.ports.send(self.sim.t_us)
            if ended:
                self.sim.record_period()

    def report(self) -> dict[str, Any]:
        """What the run came to."""
        sim, wall_s = self.sim, max(1e-9, time.monotonic() - self._began_s)
        sim_s = 1e-6 * sim.t_us
        return {
            "sim_time_s": sim_s,
            "wall_s": round(wall_s, 3),
            "realtime_factor": round(sim_s / wall_s, 2),
            "late_s": round(self._late_s, 3),
            "pacing_ms": _quantiles(self._pacing_ms),
            "periods": sim.periods,
            "engaged_periods": sim.engaged_periods,
            "setpoint_misses": sim.misses,
            "messages_sent": sum(link.sent for link in sim.links),
            "messages_received": sum(link.received for link in sim.links),
            "frames_refused": sim.refused,
            "bytes_refused": sum(link.refused for link in sim.links),
            "landed": sim.autopilot.ended_us >= 0 and sim.autopilot.landed,
            "crashed": sim.autopilot.crashed,
        }

    def close(self) -> None:
        """Close sockets and the log."""
        self.sim.flush(last=True)
        self.ports.close()
        if self._writer:
            self._writer.close()
        if self.sim.signer is not None:
            self.sim.signer.close()

    def _over(self) -> bool:
        sim = self.sim
        if self._stop or (self._max_us is not None and sim.t_us >= self._max_us):
            return True
        ended_us = sim.autopilot.ended_us
        return self._landed_us is not None and not sim.autopilot.armed and 0 <= ended_us <= sim.t_us - self._landed_us


def _quantiles(values: deque[float]) -> dict[str, float] | None:
    """p50, p99 and the largest; None where there are none (lockstep)."""
    if not values:
        return None
    ordered = sorted(values)
    return {"p50": ordered[len(ordered) // 2], "p99": ordered[int(0.99 * (len(ordered) - 1))], "max": ordered[-1]}


def fly(run: Run, speed: float, out: TextIO) -> None:
    """Run to the end, whatever ends it, and print its report as one line of JSON."""
    gc.freeze()  # what is loaded by now stays: a collection need not walk through it
    previous = {s: signal.signal(s, run.stop) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        if run.sim.lockstep:
            run.lockstep()
        else:
            run.realtime(speed)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        print(json.dumps(run.report()), file=out, flush=True)
        run.close()


def _parse(endpoint: str) -> tuple[str, Address]:
    kind, _, rest = endpoint.partition(":")
    host, _, port = rest.rpartition(":")
    if kind not in ("udpin", "udpout") or not host or not port.isdigit() or not 0 <= int(port) <= 65535:
        raise ConfigError(f"endpoint {endpoint!r}: expected udpin:HOST:PORT or udpout:HOST:PORT, e.g. udpin:127.0.0.1:14550")
    try:
        return kind, (socket.gethostbyname(host), int(port))
    except OSError as error:
        raise ConfigError(f"endpoint {endpoint!r}: host {host!r} is not known: {error}") from None
