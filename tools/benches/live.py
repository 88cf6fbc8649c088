"""the live path: codec beside pymavlink, a message in to a setpoint out beside pymavlink.mavutil, a composed tick, lockstep, start and memory.

Contestants take turns in every round and the figure is the median over rounds; the spread of ours stands in the note. The two loops run the same
controller on the same telemetry over a loopback UDP socket, in one thread: what is timed begins when the datagram has been sent and ends when
the answer has. The composed tick is CPU time.
"""

import contextlib
import math
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mavquad import config, control_step, lane, lifecycle, paths, pipeline, realtime, wire
from mavquad import flight as flights
from mavquad import plan as plans
from mavquad.errors import ConfigError, FlightError
from mavquad.link import health, signals, tlog
from mavquad.plan import Plan
from mavquad.run_files import TraceWriter
from mavquad.setpoint import attitude, limits
from mavquad.settings import Companion
from mavquad.signals import NAN3, ZERO3, Applied, Attitude, Demand, Position, Setpoint
from tools import fused_tick
from tools.benches import Row

_ROUNDS = 15
_DT_US = 8000
_HASTY = "ours, --realtime"
_NEVER_US = 1 << 62


def measure(seconds: float) -> list[Row]:
    """All of it; `seconds` sets how many messages and how long a flight."""
    return [*codec(seconds), *loops(seconds), *composed(seconds), *programs(seconds)]


# ---- codec --------------------------------------------------------------------------------------------------------------
def codec(seconds: float) -> list[Row]:
    """Decode one message and encode another."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    many = max(200, round(200 * seconds))
    raw = wire.encode(
        "ATTITUDE_QUATERNION", (1000, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3, (0.0,) * 4), seq=0, system=1, component=1
    )
    fields = (1000, 1, 1, 7, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.5, (0.0, 0.0, 0.0))
    link = dialect.MAVLink(None, srcSystem=1, srcComponent=191)

    def ours() -> None:
        for frame in wire.split(raw)[0]:
            wire.decode(frame)
        wire.encode("SET_ATTITUDE_TARGET", fields, seq=1, system=1, component=191)

    def theirs() -> None:
        link.parse_buffer(raw)
        link.set_attitude_target_encode(*fields[:-1]).pack(link)

    spent = _rounds({"ours": _repeated(ours, many), "pymavlink": _repeated(theirs, many)})
    us = {who: [1e6 * s / many for s in times] for who, times in spent.items()}
    rows = [_row("decode + encode of one message", who, times, "us") for who, times in us.items()]
    return [*rows, _times("decode + encode of one message", us, "pymavlink")]


# ---- a message in, a setpoint out -----------------------------------------------------------------------------------------
def hovering(**chosen: Any) -> tuple[Plan, pipeline.Flight]:
    """A companion that has been engaged in a hover."""
    plan = plans.build(config.convert({"observers": [], **chosen}, Companion, "bench"))
    f = flights.start(plan)
    for k in range(1, 30):
        for raw in telemetry(k, first=k == 1):
            f = pipeline.feed(plan, f, k * _DT_US, wire.split(raw)[0][0])
    f = f.clone()
    f.life = f.life._replace(state=lifecycle.ENGAGED, phase="path", armed=True, mode=6 << 16, autopilot=lifecycle.PX4)
    control_step.anchor(plan, f)
    f.path_t0_us = f.now_us
    return plan, f


def telemetry(k: int, first: bool = False) -> list[bytes]:
    """The frames of control period k of a vehicle in a hover, the attitude last."""
    t_us = k * _DT_US
    ms, half = t_us // 1000, 0.005 * math.sin(1e-6 * t_us)
    q = (math.cos(half), math.sin(half), 0.0, 0.0)
    found: list[tuple[str, tuple[Any, ...]]] = [("HEARTBEAT", (2, 12, 0, 0, 4, 3))] if first else []
    if k % 3 == 0 or first:
        found.append(("LOCAL_POSITION_NED", (ms, 0.0, 0.0, -5.0, 0.0, 0.0, 0.0)))
    found += [
        ("HIGHRES_IMU", (t_us, 0.0, 0.0, -9.8, *(0.0,) * 10, 0, 0)),
        ("ATTITUDE_QUATERNION", (ms, *q, 0.0, 0.0, 0.0, (0.0,) * 4)),
    ]
    return [wire.encode(name, fields, seq=k & 0xFF, system=1, component=1) for name, fields in found]


class _OurLoop:
    """Datagram in, log and trace, datagram out: what the companion does between its socket calls."""

    def __init__(self, port: int, folder: Path) -> None:
        plan, flight = hovering(controller="pid")
        self.lane = lane.Lane(plan, False)
        if not self.lane.enter(flight, health.Source(0, 1, 0)):
            raise FlightError("the fast lane does not take a hover: a bug of the bench")
        self.log, self.trace = tlog.Writer(folder / "flight.tlog"), TraceWriter(folder / "flight.trace", plan.trace_names)
        self.sock = _bound()
        self.to = ("127.0.0.1", port)

    def turn(self, k: int) -> None:
        fast, stamp_us = self.lane, k * _DT_US + 5000
        if fast.feed(self.sock.recv(2048), stamp_us, _NEVER_US) != lane.DONE:
            raise FlightError("plain telemetry was not taken by the fast lane: a bug of the bench")
        self.log.write_bytes(stamp_us, fast.log)
        self.trace.write_bytes(fast.trace)
        self.sock.sendto(fast.sent, self.to)

    def close(self) -> None:
        self.sock.close()
        self.log.close()
        self.trace.close()


class _MavutilLoop:
    """The same stages called from a loop as people write it with pymavlink.mavutil."""

    def __init__(self, port: int, folder: Path) -> None:
        from pymavlink import mavutil

        self.plan, _ = hovering(controller="pid")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            mine = probe.getsockname()[1]
        self.link = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{mine}", dialect="ardupilotmega", source_system=1, source_component=191
        )
        self.sock = self.link.port
        self.estimator = self.plan.estimator.module.init(self.plan.estimator.gains)
        self.controller = self.plan.controller.module.init(self.plan.controller.gains)
        self.sent = Setpoint((1.0, 0.0, 0.0, 0.0), ZERO3, self.plan.airframe.hover_thrust, 7)

    def turn(self, k: int) -> None:
        plan = self.plan
        while True:
            m = self.link.recv_match(blocking=True)
            kind = m.get_type()
            if kind == "LOCAL_POSITION_NED":
                self._observe(Position(1000 * m.time_boot_ms, (m.x, m.y, m.z), (m.vx, m.vy, m.vz)))
            elif kind == "ATTITUDE_QUATERNION":
                break
        t_us = 1000 * m.time_boot_ms
        self._observe(Attitude(t_us, (m.q1, m.q2, m.q3, m.q4), (m.rollspeed, m.pitchspeed, m.yawspeed)))
        self.estimator, estimate = plan.estimator.module.step(plan.estimator.gains, self.estimator, None, t_us)
        demand: Demand = paths.demand(plan.path, 0, (0.0, 0.0, -5.0), 0.0, t_us)
        self.controller, command = plan.controller.module.step(
            plan.controller.gains, self.controller, estimate, demand, None, 1e-6 * _DT_US
        )
        thrust = attitude.thrust_vector(command.a_ned_m_s2, plan.limits.tilt_rad, 0.2 * attitude.G_M_S2, 1.8 * attitude.G_M_S2)
        q, size = attitude.attitude(thrust, command.yaw_rad)
        wanted = Setpoint(q, ZERO3, plan.airframe.hover_thrust * size / attitude.G_M_S2, 7)
        self.sent, _ = limits.apply(plan.limits, self.sent, wanted, 1e-6 * _DT_US)
        self.link.mav.set_attitude_target_send(m.time_boot_ms, 1, 1, 7, self.sent.q_wxyz, 0, 0, 0, self.sent.thrust)

    def close(self) -> None:
        self.link.close()

    def _observe(self, sample: Any) -> None:
        self.estimator = self.plan.estimator.module.observe(self.plan.estimator.gains, self.estimator, sample)


class _PipelineLoop:
    """The same through the pipeline, as a companion flies every other controller; without log and trace."""

    def __init__(self, port: int, folder: Path) -> None:
        self.plan, self.flight = hovering(controller="pid")
        self.sock = _bound()
        self.to = ("127.0.0.1", port)

    def turn(self, k: int) -> None:
        data = self.sock.recv(2048)
        self.flight = pipeline.feed_all(self.plan, self.flight, k * _DT_US + 5000, wire.split(data)[0])
        for _, raw in self.flight.outbox:
            if raw[7] == 82:  # SET_ATTITUDE_TARGET
                self.sock.sendto(raw, self.to)

    def close(self) -> None:
        self.sock.close()


_LOOPS = {"ours": _OurLoop, _HASTY: _OurLoop, "ours, stage by stage": _PipelineLoop, "pymavlink.mavutil": _MavutilLoop}


def loops(seconds: float) -> list[Row]:
    """IMU and attitude in, setpoint out, over a socket."""
    many = max(50, round(30 * seconds))
    rows: list[Row] = []
    refused = ""
    spent: dict[str, list[list[float]]] = {who: [] for who in _LOOPS}
    with _bound() as vehicle, tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as ending:
        there: dict[str, Any] = {}
        for i, (who, kind) in enumerate(_LOOPS.items()):
            (Path(folder) / str(i)).mkdir()
            there[who] = kind(vehicle.getsockname()[1], Path(folder) / str(i))
            ending.callback(there[who].close)
        for round_ in range(_ROUNDS + 1):
            for who, loop in there.items():
                if who == _HASTY:
                    try:
                        realtime.ask()
                    except ConfigError as error:
                        refused = str(error)
                        continue
                times = _turns(vehicle, loop, 30 + many * round_, many)
                if who == _HASTY:
                    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
                if round_:  # the first warms up
                    spent[who].append(times)
    if refused:
        rows.append(Row("IMU in to setpoint out, p99", _HASTY, math.nan, "us", refused))
    us = {who: [statistics.median(times) for times in all_] for who, all_ in spent.items() if all_}
    for who in us:
        rows.append(_row("IMU in to setpoint out, p50", who, us[who], "us"))
        rows.append(_row("IMU in to setpoint out, p99", who, [float(np.percentile(times, 99)) for times in spent[who]], "us"))
    return [*rows, _times("IMU in to setpoint out, p50", us, "pymavlink.mavutil")]


def _turns(vehicle: socket.socket, loop: Any, first: int, many: int) -> list[float]:
    """How long [us] each of many turns took, from control period `first` on."""
    where, times = loop.sock.getsockname(), []
    for k in range(first, first + many):
        vehicle.sendto(b"".join(telemetry(k)), where)
        begun = time.perf_counter_ns()
        loop.turn(k)
        times.append(1e-3 * (time.perf_counter_ns() - begun))
        vehicle.recv(2048)
    return times


# ---- a composed tick --------------------------------------------------------------------------------------------------------
_MPC = "EKF + closed-form MPC"
_TUNED = {"controller": "eskf-mpc", "estimator": "joint", "tune": {"eskf-mpc": {"constrained": "off"}}}
_TUNED_ASMF = {**_TUNED, "compensator": "asmf"}


def composed(seconds: float) -> list[Row]:
    """Decode, EKF, closed-form MPC, ASMF, encode: CPU time of one control period; the stages alone, in the pipeline, and as one function."""
    what, rows = "decode, estimate, control, encode: one tick", []
    note = "2.3 messages in"
    for who, chosen in (("pid", {"controller": "pid"}), (_MPC, _TUNED), (f"{_MPC} + ASMF", _TUNED_ASMF)):
        tick = _Composed(*hovering(**chosen))
        rows.append(_row(what, who, _cpu_per_tick(tick.turn, seconds), "us CPU", f"stages called from Python, {note}"))
    plan, flight = hovering(**_TUNED_ASMF)

    def piped(k: int, data: bytes) -> None:
        nonlocal flight
        flight = pipeline.feed_all(plan, flight, k * _DT_US + 5000, wire.split(data)[0])

    rows.append(
        _row(
            what,
            f"{_MPC} + ASMF, pipeline",
            _cpu_per_tick(piped, seconds),
            "us CPU",
            f"and the companion's book-keeping, {note}",
        )
    )
    fused = fused_tick.Tick(*hovering(**_TUNED_ASMF))
    spent = _cpu_per_tick(lambda k, data: fused.feed(wire.split(data)[0]), seconds)
    rows.append(_row(what, f"{_MPC} + ASMF, fused", spent, "us CPU", f"one compiled function, {note}"))
    return rows


class _Composed:
    """The stages of a plan one after the other, between decoding and encoding."""

    def __init__(self, plan: Plan, flight: pipeline.Flight) -> None:
        self.plan, self.f = plan, flight.clone()
        assert flight.sent is not None
        self.sent, self.control_us = flight.sent, flight.control_us

    def turn(self, k: int, data: bytes) -> None:
        plan, f = self.plan, self.f
        for frame in wire.split(data)[0]:
            name = plan.samples.get(frame.msgid)
            if name is None or (name == "HIGHRES_IMU" and plan.imu_spared):
                continue
            sample = signals.DECODERS[name](wire.decode(frame))
            f.estimator = plan.estimator.module.observe(plan.estimator.gains, f.estimator, sample)
            if plan.compensator is not None:
                f.compensator = plan.compensator.module.observe(plan.compensator.gains, f.compensator, sample)
            if type(sample) is Attitude:
                self._step(sample.t_us)

    def _step(self, t_us: int) -> None:
        plan, f, last = self.plan, self.f, self.sent
        dt_s, self.control_us = 1e-6 * (t_us - self.control_us), t_us
        thrust_m_s2 = attitude.G_M_S2 * last.thrust / f.hover_thrust
        applied = Applied(t_us, last.q_wxyz, thrust_m_s2, NAN3, f.delay_s, 0.0, last.thrust)
        f.estimator, estimate = plan.estimator.module.step(plan.estimator.gains, f.estimator, applied, t_us)

        def ahead(t_us: int) -> Demand:
            return control_step.demand_at(plan, f, t_us)

        f.controller, command = plan.controller.module.step(
            plan.controller.gains, f.controller, estimate, ahead(t_us), ahead, dt_s
        )
        if plan.compensator is not None:
            f.compensator, command = plan.compensator.module.step(
                plan.compensator.gains, f.compensator, estimate, command, applied, t_us, ahead
            )
        q, size, _ = attitude.pointing(command.a_ned_m_s2, command.yaw_rad, plan.limits.tilt_rad)
        wanted = Setpoint(q, ZERO3, f.hover_thrust * size / attitude.G_M_S2, 7)
        self.sent, _ = limits.apply(plan.limits, last, wanted, dt_s)
        fields = signals.attitude_setpoint(t_us // 1000, 1, 1, self.sent)
        wire.encode("SET_ATTITUDE_TARGET", fields, seq=0, system=1, component=191)


def _cpu_per_tick(turn: Callable[[int, bytes], object], seconds: float) -> list[float]:
    """CPU time [us] of a tick, by rounds; one round before that warms up. Of this thread: a process's comes in steps of a timer tick."""
    many, k, per_tick = max(25, round(10 * seconds)), 30, []
    for round_ in range(_ROUNDS + 1):
        frames = [b"".join(telemetry(k + i)) for i in range(many)]
        begun = time.thread_time_ns()
        for i, data in enumerate(frames):
            turn(k + i, data)
        if round_:
            per_tick.append(1e-3 * (time.thread_time_ns() - begun) / many)
        k += many
    return per_tick


# ---- the programs -------------------------------------------------------------------------------------------------------------
_LEAN_HZ = {"ATTITUDE_QUATERNION": 125.0, "LOCAL_POSITION_NED": 25.0, "EXTENDED_SYS_STATE": 2.0}  # the rest: 0.2 Hz
_FLIGHTS = 3


def programs(seconds: float) -> list[Row]:
    """Flights in lockstep as two processes, the companion's memory in one, and how soon a companion speaks."""
    lockstep = "lockstep over UDP, two processes"
    with tempfile.TemporaryDirectory() as folder:
        flights_of: dict[str, list[dict[str, Any]]] = {"pid": [], "pid, one message each way": []}
        for k in range(_FLIGHTS):  # in turns
            for who, flown in flights_of.items():
                flown.append(_flown(Path(folder) / f"{who}-{k}", seconds, None if who == "pid" else _LEAN_HZ))
        run = Path(folder) / "watched"
        peak = [math.nan]
        _flown(run, 1.0, None, lambda t_s, said: peak.append(_memory_mb(str(run / "companion.toml"))))
        first_s = statistics.median(_first_frame_s(run, Path(folder) / f"again-{i}") for i in range(3))
    rows = []
    for who, flown in flights_of.items():
        rates = [s["periods"] / s["wall_s"] if s.get("wall_s") else math.nan for s in flown]
        rows.append(_row(lockstep, who, rates, "control steps/s", _traffic(flown[0], None if who == "pid" else _LEAN_HZ)))
    known = not np.isnan(peak).all()
    return [
        *rows,
        Row(
            "memory of the companion, peak",
            "pid",
            float(np.nanmax(peak)) if known else math.nan,
            "MB",
            "of the process, Linux only",
        ),
        Row("start of the companion to its first frame", "pid", first_s, "s", "kernels in the cache"),
    ]


def _flown(
    run: Path,
    seconds: float,
    lean_hz: dict[str, float] | None,
    watch: Callable[[float, list[str]], None] = lambda t_s, said: None,
) -> dict[str, Any]:
    """A hover of six times `seconds` with take-off and landing: the simulator's report. lean_hz: the rates asked for."""
    from tools import flight, scenarios

    changes = [f"path.duration_s={max(5.0, 6.0 * seconds):g}"]
    resolved = scenarios.resolve(scenarios.load("hover", changes), scenarios.Options(controller="pid", observers=[]))
    companion = resolved.companion
    if lean_hz is not None:
        link = msgspec.structs.replace(companion.link, rates_hz=dict.fromkeys(companion.link.rates_hz, 0.2) | lean_hz)
        companion = msgspec.structs.replace(companion, link=link)
    flight.prepare(run, resolved._replace(companion=companion))
    return flight.fly(run, flight.Pace(None), resolved.scenario.flight.max_time_s, watch).sitl


def _traffic(sitl: dict[str, Any], lean_hz: dict[str, float] | None) -> str:
    """Messages of the flight per control step, as the companion counts them, and how much of it was flown by setpoints."""
    periods = sitl.get("periods") or math.nan
    into, out = sitl.get("messages_sent", 0) / periods - 1.0, sitl.get("messages_received", 0) / periods
    of = "" if lean_hz is None else " (one ATTITUDE_QUATERNION, position each fifth step, the rest slow)"
    engaged = sitl.get("engaged_periods", 0) / periods
    return (
        f"a step: {into:.1f} messages in{of} and {out:.1f} out, and a barrier each way; {engaged:.0%} of the steps by setpoints"
    )


def _memory_mb(mark: str) -> float:
    """Peak resident memory of the process whose command line holds `mark`; NaN where there is none or no /proc."""
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (path / "cmdline").read_bytes():
                lines = (path / "status").read_text().splitlines()
                return next(1e-3 * float(line.split()[1]) for line in lines if line.startswith("VmHWM"))
        except (OSError, StopIteration):
            continue
    return math.nan


def _first_frame_s(run: Path, folder: Path) -> float:
    with _bound() as sock:
        sock.settimeout(60.0)
        endpoint = f"udpout:127.0.0.1:{sock.getsockname()[1]}"
        folder.mkdir()
        command = [sys.executable, "-P", "-m", "mavquad", "--config", str(run / "companion.toml"), "--endpoint", endpoint]
        begun = time.monotonic()
        child = subprocess.Popen(
            [*command, "--run", str(folder), "--lockstep"], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )
        try:
            sock.recv(2048)
            return time.monotonic() - begun
        except TimeoutError:
            return math.nan
        finally:
            os.kill(child.pid, signal.SIGKILL)
            child.wait()


# ---- helpers ----------------------------------------------------------------------------------------------------------------
def _bound() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    return sock


def _repeated(task: Callable[[], None], many: int) -> Callable[[], float]:
    def run() -> float:
        begun = time.perf_counter()
        for _ in range(many):
            task()
        return time.perf_counter() - begun

    return run


def _rounds(contestants: dict[str, Callable[[], float]]) -> dict[str, list[float]]:
    """Seconds of each contestant, round by round in turn; one round before that warms up."""
    spent: dict[str, list[float]] = {who: [] for who in contestants}
    for round_ in range(_ROUNDS + 1):
        for who, run in contestants.items():
            seconds = run()
            if round_:
                spent[who].append(seconds)
    return spent


def _row(what: str, who: str, values: list[float], unit: str, note: str = "") -> Row:
    spread = f"rounds {min(values):.3g} to {max(values):.3g}"
    return Row(what, who, statistics.median(values), unit, f"{spread}; {note}" if note else spread)


def _times(what: str, values: dict[str, list[float]], peer: str) -> Row:
    ratios = [theirs / ours for ours, theirs in zip(values["ours"], values[peer], strict=True)]
    return _row(f"{what}: {peer} over", "ours", ratios, "times")
