"""What is fuzzed: each target takes a seeded source of chance, does one batch and returns how many frames or files that was.

A batch that finds something raises: an exception that is no MavquadError, a disagreement between two readers, or what may never
be on the wire (a setpoint that is not finite, not a rotation, outside the limits).
"""

import contextlib
import functools
import io
import math
import random
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mavquad import airframe, config, lifecycle, pipeline, tunables, wire
from mavquad.companion import request
from mavquad.errors import ConfigError, LogError, WireError
from mavquad.link import columns, tlog
from mavquad.paths import Path as Line
from mavquad.settings import Companion
from sitl import config as sitl_config
from sitl import simulation
from tests.fuzz import mutate
from tests.loop.test_companion_loop import Loop  # the scripted autopilot's loop
from tests.oracles.arducopter import ArduCopter
from tests.oracles.autopilot import Autopilot
from tools import __main__ as commands

ROOT = Path(__file__).parents[2]
LOG = (ROOT / "tests" / "data" / "flight1-20s.tlog").read_bytes()[:60_000]
BATCH = 256
Target = Callable[[random.Random], int]


def bank() -> list[bytes]:
    """One frame of every message of the dialect, its fields by chance."""
    chance = random.Random(7)
    frames = []
    for msgid in sorted(wire.ID_SET):
        spec = wire.SPECS[msgid]
        head = bytes([wire.STX_V2, 0, 0, 0, 0, 1, 1]) + msgid.to_bytes(3, "little")
        frames.append(mutate.seal(head, chance.randbytes(spec.length)))
    return frames


BANK = bank()


# ---- frames -----------------------------------------------------------------------------------------------------------
def frames(chance: random.Random) -> int:
    """`wire`: a stream of mutated frames, cut anywhere, is split without a byte lost, and what is found is decoded."""
    stream = b""
    for _ in range(BATCH):
        raw = chance.choice(BANK)
        stream += mutate.sealed(chance, raw) if chance.random() < 0.4 else mutate.data(chance, raw)
    rest, seen = b"", 0
    cuts = sorted(chance.randrange(len(stream)) for _ in range(3))
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found, refused, after = wire.split(rest + stream[start:end])
        taken = sum(len(frame.raw) for frame in found)
        assert taken + refused + len(after) == len(rest) + end - start, "bytes lost or made"
        rest = after
        for frame in found:
            try:
                message = wire.decode(frame)
            except WireError:
                assert frame.msgid not in wire.ID_SET
                continue
            seen += len(message)
    assert seen, "nothing got through: the mutator is too rough to test anything"
    return BATCH


class _Engaged:
    """A companion in the middle of a flight, made once; the pipeline never changes a state that it was given."""

    def __init__(self, controller: str, autopilot: Autopilot) -> None:
        settings = Companion(path=Line(name="hover", duration_s=600.0), observers=("gsmo",), controller=controller)
        loop = Loop(settings, autopilot)
        self.states = []
        loop.run(0.5)
        self.states.append(loop.flight.clone())
        loop.until(lifecycle.OBSERVING)
        self.states.append(loop.flight.clone())
        loop.take(request(lifecycle.CMD_ENGAGE, loop.plan, 0).raw)
        loop.until(lifecycle.STREAMING)
        self.states.append(loop.flight.clone())
        loop.until(lifecycle.ENGAGED)
        loop.run(1.0)
        self.states.append(loop.flight.clone())
        self.plan = loop.plan
        self.names = [t.name for t in tunables.tunables(loop.plan)]
        self.boot_ms = loop.autopilot.t_us // 1000


@functools.cache
def engaged(ardupilot: bool) -> _Engaged:
    return _Engaged("eskf-mpc", ArduCopter()) if ardupilot else _Engaged("pid", Autopilot())


_HEARD = [
    wire.ID[name] for name in ("ATTITUDE_QUATERNION", "ATTITUDE", "LOCAL_POSITION_NED", "HIGHRES_IMU", "SERVO_OUTPUT_RAW")
]
_SETPOINTS = (wire.ID["SET_ATTITUDE_TARGET"], wire.ID["SET_POSITION_TARGET_LOCAL_NED"])


def handlers(chance: random.Random) -> int:
    """The pipeline: frames whose CRC is right and whose fields are junk, among good ones, in every state of its life."""
    start = engaged(chance.random() < 0.5)
    plan, count = start.plan, 0
    raws = [raw for raw in BANK if int.from_bytes(raw[7:10], "little") in pipeline_ids(plan)]
    for before in start.states:
        flight, now_us, boot_ms = before, before.arrival_us, start.boot_ms
        for step in range(BATCH // len(start.states)):
            now_us += chance.randrange(20_000)
            boot_ms += 8
            if step % 4 == 0:
                raw = _sample(chance, boot_ms)
            else:
                raw = mutate.sealed(chance, chance.choice(raws)) if step % 4 < 3 else _words(chance, start.names)
            for frame in wire.split(raw)[0]:
                if pipeline.accepts(plan, flight, frame):
                    continue
                flight = pipeline.feed(plan, flight, now_us, frame)
                judge_outbox(plan.settings, flight.outbox)
                flight.outbox, flight.trace = [], []
            count += 1
        flight = pipeline.advance(plan, flight, now_us + 2_000_000)
        judge_outbox(plan.settings, flight.outbox)
        flight.outbox, flight.trace = [], []
    return count


def _words(chance: random.Random, names: list[str]) -> bytes:
    """What only works with the right names and numbers, so that bytes by chance never say it."""
    value = struct.unpack("<f", chance.choice(mutate.FLOATS))[0]
    if chance.random() < 0.03:  # a design takes a while
        return wire.encode("PARAM_SET", (1, 191, chance.choice(names), value, 9), seq=0, system=255, component=190)
    kind = chance.randrange(4)
    if kind == 0:
        name = chance.choice(("GUID_OPTIONS", "MOT_THST_HOVER", "MPC_THR_HOVER"))
        return wire.encode("PARAM_VALUE", (name, value, chance.choice((6, 9)), 1, 0), seq=0, system=1, component=1)
    if kind == 1:
        answer = (chance.choice((400, 22, 176, 21, 511, 512)), chance.randrange(9), 0, 0, 1, 191)
        return wire.encode("COMMAND_ACK", answer, seq=0, system=1, component=1)
    if kind == 2:
        mode = chance.choice((6 << 16, 4 << 16 | 3 << 24, 4, 6, 9, 0xFFFFFFFF))
        beat = (2, chance.choice((3, 12, 0, 255)), chance.choice((0, 128, 255)), mode, 4, 3)
        return wire.encode("HEARTBEAT", beat, seq=0, system=1, component=1)
    asked = (1, 191, chance.choice((lifecycle.CMD_ENGAGE, lifecycle.CMD_LAND, 1)), 0, *(value,) * 7)
    return wire.encode("COMMAND_LONG", asked, seq=0, system=255, component=190)


def heard(data: bytes, ardupilot: bool) -> None:
    """Bytes as payloads in frames whose CRC is right: state, then again and again which message, from whom, how long, the payload."""
    start = engaged(ardupilot)
    plan = start.plan
    flight = start.states[data[0] % len(start.states)] if data else start.states[0]
    now_us, at = flight.arrival_us, 1
    known = sorted(pipeline_ids(plan))
    while at + 3 <= len(data):
        msgid, who, size = known[data[at] % len(known)], data[at + 1], data[at + 2]
        payload, at = data[at + 3 : at + 3 + size], at + 3 + size
        source = (1, 1) if who < 192 else (255, 190)
        head = bytes([wire.STX_V2, 0, 0, 0, 0, *source]) + msgid.to_bytes(3, "little")
        now_us += 1000 * (who & 63)
        for frame in wire.split(mutate.seal(head, payload or b"\0"))[0]:
            if pipeline.accepts(plan, flight, frame):
                continue
            flight = pipeline.feed(plan, flight, now_us, frame)
            judge_outbox(plan.settings, flight.outbox)
            flight.outbox, flight.trace = [], []
    judge_outbox(plan.settings, pipeline.advance(plan, flight, now_us + 2_000_000).outbox)


def piece(number: int, who: int, payload: bytes) -> bytes:
    """One message for `heard`: which of `pipeline_ids`, from whom and how long after the last, what it holds."""
    return bytes([number, who, len(payload)]) + payload


def pipeline_ids(plan: pipeline.Plan) -> set[int]:
    """Messages that the companion does something with."""
    from mavquad import messages

    return set(messages.HANDLERS) | set(plan.samples)


def _sample(chance: random.Random, boot_ms: int) -> bytes:
    """A good sample of the vehicle, so that control goes on."""
    a = chance.gauss(0.0, 0.1)
    q = (math.cos(a), math.sin(a), 0.0, 0.0)
    if chance.random() < 0.5:
        return wire.encode("ATTITUDE_QUATERNION", (boot_ms, *q, 0.0, 0.0, 0.0, (0.0,) * 4), seq=0, system=1, component=1)
    return wire.encode("LOCAL_POSITION_NED", (boot_ms, 0.0, 0.0, -5.0, 0.0, 0.0, 0.0), seq=0, system=1, component=1)


def judge_outbox(settings: Companion, outbox: list[tuple[int, bytes]]) -> None:
    """Everything that would go out is whole, and a setpoint is finite and inside the limits."""
    limits = settings.limits
    for _, raw in outbox:
        found, refused, rest = wire.split(raw)
        assert (len(found), refused, rest) == (1, 0, b""), f"broken frame sent: {raw.hex()}"
        message = wire.decode(found[0])
        if found[0].msgid != _SETPOINTS[0]:
            continue
        w, x, y, z = message.q
        rates = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
        assert all(map(math.isfinite, (w, x, y, z, *rates, message.thrust))), message
        assert abs(math.sqrt(w * w + x * x + y * y + z * z) - 1.0) < 1e-3, message
        tilt = math.degrees(math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y)))))
        assert tilt <= limits.tilt_deg + 0.1, f"{tilt} deg of tilt sent"
        assert max(map(abs, rates)) <= math.radians(limits.rate_deg_s) + 1e-3, message
        assert limits.thrust_min - 1e-3 <= message.thrust <= limits.thrust_max + 1e-3, message


def autopilot(chance: random.Random) -> int:
    """The simulated autopilot in flight is sent junk; what it says of itself stays finite."""
    personality = chance.choice(("px4", "ardupilot"))
    sim = simulation.Simulation(sitl_config.load(None, [f"personality={personality}"]))
    link = sim.open_link()
    for _ in range(8):
        for _ in range(BATCH // 8):
            raw = chance.choice(BANK)
            sim.receive(link, mutate.sealed(chance, raw) if chance.random() < 0.8 else mutate.data(chance, raw))
        sim.run_period()
        for data in sim.collect(link):
            for frame, message in wire.parse(data):
                if frame.msgid in _HEARD:
                    flat = np.hstack([np.ravel(x) for x in message if not isinstance(x, str)])
                    assert np.isfinite(flat).all(), message
    return BATCH


# ---- files ------------------------------------------------------------------------------------------------------------
FILES = 16


def logs(chance: random.Random) -> int:
    """Mutated logs: the reader by streams and the compiled one by columns agree on every frame, or both refuse."""
    with tempfile.TemporaryDirectory() as folder:
        for number in range(FILES):
            start = chance.randrange(40_000)
            data = LOG[start : start + 200 + chance.randrange(12_000)]
            data = mutate.data(chance, data, 1 + chance.randrange(30))
            path = Path(folder) / f"{number}.tlog"
            path.write_bytes(data)
            one, one_refused = _by_stream(data, str(path))
            two, two_refused = _by_columns(path)
            assert one == two, f"the readers disagree: {len(one)} and {len(two)} frames ({one_refused!r}, {two_refused!r})"
    return FILES


def _by_stream(data: bytes, name: str) -> tuple[list[tuple[int, bytes]], str]:
    stream = io.BytesIO(data)
    stream.name = name
    found = []
    try:
        for t_us, frame in tlog.read(stream):
            found.append((t_us, frame.raw))
    except LogError as error:
        return found, str(error)
    return found, ""


def _by_columns(path: Path) -> tuple[list[tuple[int, bytes]], str]:
    try:
        log = columns.Log(path)
    except LogError as error:
        return [], str(error)
    log.everything()
    return [(t_us, frame.raw) for t_us, frame in log.frames()], ""


TOMLS = {
    "companion": (
        "observers = ['gsmo']\ncontroller = 'pid'\ntakeoff_m = 5.0\n[path]\nname = 'circle'\nduration_s = 20.0\n[limits]\n"
        "tilt_deg = 40.0\nthrust_max = 0.95\n[safety]\nfence_m = 100.0\n[link]\nsystem = 1\ntimesync_hz = 5.0\n",
        lambda path: pipeline.build(config.load(path, Companion)),
    ),
    "sitl": (
        "seed = 1\npersonality = 'px4'\nairframe = 'x500'\noverrides = ['body.mass_kg=+20%']\n[wind]\nmean_m_s = 5.0\n"
        "gusts = [{t_s = 3.0, duration_s = 2.0, speed_m_s = 6.0}]\n[noise]\nposition_m = 0.02\n[link]\ndelay_ms = 5.0\nloss = 0.1\n"
        "[params]\nMPC_THR_HOVER = 0.5\n",
        lambda path: simulation.Simulation(sitl_config.load(path, [])),
    ),
    "airframe": ((ROOT / "mavquad" / "airframes" / "x500.toml").read_text(), lambda path: airframe.load(str(path))),
}


def settings(chance: random.Random) -> int:
    """Mutated TOML files: a valid structure or one line of ConfigError."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.toml"
        for _ in range(FILES):
            words, load = TOMLS[chance.choice(tuple(TOMLS))]
            path.write_text(mutate.text(chance, words), encoding="utf-8")
            said = ""
            try:
                load(path)
            except ConfigError as error:
                said = str(error)
            assert "\n" not in said, said
    return FILES


# ---- command line -----------------------------------------------------------------------------------------------------
_WORDS = (
    *(
        "replay",
        "convert",
        "identify",
        "report",
        "check",
        "fly",
        "campaign",
        "bench",
        "paper",
        "monitor",
        "--help",
        "--version",
    ),
    *(
        "--json",
        "--from",
        "--to",
        "--seed",
        "--set",
        "--observer",
        "gsmo",
        "nan",
        "-1",
        "1e999",
        "",
        "x=y",
        "wind.mean_m_s=abc",
    ),
    *("LOG", "no/such/file", ".", "udpin:", "serial:none:1", "tcp:127.0.0.1:0", "--seconds", "--csv", "--parquet", "-", "é"),
)
_HARMLESS = ("replay", "convert", "identify", "report", "check")


def lines(chance: random.Random) -> int:
    """Command lines of junk words: 0, 1 with one line of what is wrong, or 2; never a traceback."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "junk.tlog"
        log.write_bytes(mutate.data(chance, LOG[:6_000], 20))
        for _ in range(4):
            words = [chance.choice(_HARMLESS), *(chance.choice(_WORDS) for _ in range(1 + chance.randrange(5)))]
            words = [str(log) if word == "LOG" else word for word in words]
            if words[0] == "check" and not any(word in ("", "--help", "nan") for word in words):
                words.append("--seconds=nan")  # nothing listens here, and nobody waits for it
            out, err = io.StringIO(), io.StringIO()
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), contextlib.chdir(folder):
                code = commands.main(words)
            assert code in (0, 1, 2), (words, code)
            assert code != 1 or err.getvalue().count("mavquad: ") >= 1, (words, err.getvalue())
            assert "Traceback" not in err.getvalue(), words
    return 4


FRAME_TARGETS: dict[str, Target] = {"wire": frames, "pipeline": handlers, "sitl": autopilot}
FILE_TARGETS: dict[str, Target] = {"logs": logs, "toml": settings, "command line": lines}
