"""One flight as two processes over UDP: start them, watch them, end them, and read what they left in the run folder."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from mavquad import toml
from mavquad.errors import FlightError
from tools.scenarios import Resolved

_POLL_S = 0.1
_GRACE_S = 10.0  # for a program to end cleanly before it is killed
_ERROR = "mavquad: "  # begins the companion's own last words
_LANDED_S = 2.0  # vehicle time on the ground before the simulated autopilot ends

Watcher = Callable[[float, list[str]], None]  # vehicle time of the companion [s, NaN before], new lines it said


class Pace(NamedTuple):
    """Lockstep at full machine speed where `speed` is None, else that many times real time."""

    speed: float | None

    def words(self) -> list[str]:
        """On the command line of either program."""
        return ["--lockstep"] if self.speed is None else ["--speed", repr(self.speed)]


class Flown(NamedTuple):
    """What both programs say at their end (the JSON line of each), and how they ended."""

    sitl: dict[str, Any]
    companion: dict[str, Any]
    wall_s: float
    said: list[str]  # by the companion, in order
    problems: list[str]


def prepare(run: Path, resolved: Resolved) -> None:
    """The run folder with both configurations. Raises FlightError where it holds a flight already."""
    try:
        run.mkdir(parents=True, exist_ok=True)
        if any(log.exists() and log.stat().st_size for log in (run / "flight.tlog", run / "sitl.tlog")):
            raise FlightError(f"{run}: holds a flight already, which is never overwritten; choose another --run")
        (run / "sitl.toml").write_text(toml.dumps(msgspec.to_builtins(resolved.sitl)), encoding="utf-8")
        (run / "companion.toml").write_text(toml.dumps(msgspec.to_builtins(resolved.companion)), encoding="utf-8")
    except OSError as error:
        raise FlightError(f"{run}: cannot be written: {error.strerror}; choose another --run") from None


def fly(run: Path, pace: Pace, max_time_s: float, watch: Watcher, forward: str = "") -> Flown:
    """Both programs from a prepared folder until the vehicle has landed; `forward`: an endpoint for a copy of every datagram.

    Ctrl-C ends both cleanly and is passed on.
    """
    copies = ["--forward", forward] if forward else []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        endpoint = f"udpout:127.0.0.1:{sock.getsockname()[1]}"
        begun = time.monotonic()
        sitl = _start(
            run, "sitl", ["--config", str(run / "sitl.toml"), "--socket-fd", str(sock.fileno()), "--log", str(run / "sitl.tlog"),
                          "--exit-when-landed", repr(_LANDED_S), "--max-time", repr(max_time_s), *copies, *pace.words()], (sock.fileno(),))  # fmt: skip
        companion = _start(
            run, "mavquad", ["--config", str(run / "companion.toml"), "--endpoint", endpoint, "--run", str(run), "--engage",
                             "--signing-state", str(run / "companion.signing"),
                             *pace.words()])  # fmt: skip
    said = _Tail(run / "companion.txt")
    problems: list[str] = []
    try:
        while sitl.poll() is None and companion.poll() is None and not _given_up(said.all):
            time.sleep(_POLL_S)
            watch(vehicle_time_s(run / "flight.trace"), said.new())
        if companion.poll() is not None:
            problems.append(f"the companion ended in flight: {_last_words(run / 'companion.txt')}")
    finally:
        wall_s = time.monotonic() - begun
        _end(companion)
        _end(sitl)
        watch(vehicle_time_s(run / "flight.trace"), said.new())
    refusal = _last_words(run / "companion.txt")
    if refusal.startswith(_ERROR) and not (run / "flight.tlog").exists():  # nothing flew
        _forget(run)
        raise FlightError(refusal.removeprefix(_ERROR))
    if sitl.returncode:
        problems.append(f"the simulated autopilot ended with {sitl.returncode}: {_last_words(run / 'sitl.txt')}")
    elif companion.returncode and not problems:
        problems.append(f"the companion ended with {companion.returncode}: {_last_words(run / 'companion.txt')}")
    return Flown(_last_json(run / "sitl.json"), _last_json(run / "companion.json"), wall_s, said.all, problems)


def _forget(run: Path) -> None:
    """Take away what was laid out for a flight that never began; the folder stays where anything else is in it."""
    for name in ("sitl", "companion"):
        for kind in ("toml", "json", "txt", "tlog"):
            file = run / f"{name}.{kind}"
            if file.exists() and (kind != "tlog" or not file.stat().st_size):
                file.unlink()
    with contextlib.suppress(OSError):
        run.rmdir()


def _given_up(said: list[str]) -> bool:
    """Whether the companion has released the vehicle without ever flying it: nothing more will come."""
    return any(" released: " in line for line in said) and not any(" engaged: " in line for line in said)


def vehicle_time_s(trace: Path) -> float:
    """Vehicle time of the last whole row of a companion's trace, NaN where there is none yet."""
    try:
        with trace.open("rb") as stream:
            head = stream.readline()
            size = 8 * len(json.loads(head))
            rows = (os.fstat(stream.fileno()).st_size - len(head)) // size
            if rows < 1:
                return float("nan")
            stream.seek(len(head) + (rows - 1) * size)
            return 1e-6 * float(memoryview(stream.read(8)).cast("d")[0])
    except (OSError, ValueError):
        return float("nan")


def _start(run: Path, module: str, arguments: list[str], keep: tuple[int, ...] = ()) -> subprocess.Popen[bytes]:
    """A child in a session of its own, so that Ctrl-C reaches only us and we end it in order."""
    name = "companion" if module == "mavquad" else module
    with (run / f"{name}.json").open("wb") as out, (run / f"{name}.txt").open("wb") as err:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            pass_fds=keep,
            start_new_session=True,
        )


def _end(child: subprocess.Popen[bytes]) -> None:
    if child.poll() is not None:
        return
    child.send_signal(signal.SIGTERM)
    try:
        child.wait(_GRACE_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


class _Tail:
    """The lines of a growing file."""

    def __init__(self, path: Path) -> None:
        self._path, self._at = path, 0
        self.all: list[str] = []

    def new(self) -> list[str]:
        data = self._path.read_bytes()
        whole = data.rfind(b"\n") + 1
        lines = data[self._at : whole].decode("utf-8", "replace").splitlines()
        self._at = max(self._at, whole)
        self.all += lines
        return [line for line in lines if not line.startswith(_ERROR)]  # that one is the error of the flight


def _last_words(path: Path) -> str:
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n") if path.exists() else []
    return next((line for line in reversed(lines) if line.strip()), "it said nothing")


def _last_json(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(_last_words(path))
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
