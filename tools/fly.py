"""mavquad fly: one flight of the companion with the simulated autopilot, two processes over UDP; a run folder with its report.

Scenarios: circle (default), ellipse, gusty, hover, line, rectangle, spiral, sweep (excites one axis, for identify), gauntlet (a table of
faults, one flight each), or a TOML file of your own.
Changes: --set vehicle.mass=+20%  --set wind.mean_m_s=5  --set path.radius_m=2  --set pid.ki=0.4  --set limits.tilt_deg=30

Example:
  mavquad fly circle --seed 7 --controller pid
  mavquad fly gusty --personality ardupilot --set wind.mean_m_s=7 --json
  mavquad fly gauntlet --controller eskf-mpc
"""

import argparse
import json
import math
import shlex
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mavquad.errors import FlightError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of a flight."""
    parser.add_argument(
        "scenario", nargs="?", default="circle", help="a scenario's name, or a TOML file (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of wind, noise and faults (default: %(default)s)")
    parser.add_argument(
        "--personality", choices=("px4", "ardupilot"), default="px4", help="whose autopilot (default: %(default)s)"
    )
    parser.add_argument(
        "--airframe", "--vehicle", default="x500", help="a vehicle's name, or a TOML file (default: %(default)s)"
    )
    parser.add_argument("--controller", help="pd, pid, adrc, iadrc, eskf-mpc, or autopilot (its own position loop)")
    parser.add_argument(
        "--axis",
        action="append",
        choices=("roll", "pitch", "yaw", "thrust"),
        help="of the scenario `sweep` (a helicopter's stick); again for more",
    )
    parser.add_argument("--estimator", help="what feeds the controller (default: the controller's own)")
    parser.add_argument("--compensator", help="none or asmf")
    parser.add_argument(
        "--observer", action="append", metavar="NAME[:KEY=VALUE,...]", help="one to watch; again for more; none: without"
    )
    parser.add_argument(
        "--attitude", choices=("ahrs", "mocap", "both"), default="ahrs", help="attitude source (default: %(default)s)"
    )
    parser.add_argument("--loop", choices=("attitude", "rates"), help="what setpoints carry")
    parser.add_argument("--signing-key", default="", metavar="FILE", help="sign the whole flight with the key in FILE (0600)")
    parser.add_argument(
        "--speed",
        type=float,
        metavar="F",
        help="F times real time, on a machine that keeps up: late by F times its own delays, the companion lets go (default: lockstep, as fast as it goes)",
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change anything; again for more")
    parser.add_argument("--run", type=Path, metavar="DIR", help="run folder (default: runs/<time>-<scenario>-<seed>)")
    parser.add_argument("--no-report", action="store_true", help="write no report.html")
    parser.add_argument(
        "--rows", action="append", metavar="PART", help="of the gauntlet: only rows whose names hold this; again for more"
    )
    parser.add_argument("--json", action="store_true", help="print summary.json instead of the table")


def run(args: argparse.Namespace) -> int:
    """One flight. 0 where it went well, 1 where not."""
    from tools import summary

    if args.scenario == "gauntlet":
        from tools import gauntlet

        return gauntlet.run(args)
    if args.speed is not None and not 0.01 <= args.speed <= 1000.0:
        raise FlightError(f"--speed {args.speed}: expected 0.01 to 1000 times real time, or no --speed for lockstep")
    name = Path(args.scenario).stem
    folder = args.run or Path("runs") / f"{time.strftime('%Y%m%d-%H%M%S')}-{name}-{args.seed}"
    result = one(args, folder)
    if args.json:
        print(json.dumps(result, allow_nan=False))
    else:
        summary.show(result, folder)
    if not result["ok"]:
        raise FlightError(f"the flight was not as it should be: {'; '.join(result['failures'])}; its logs are in {folder}")
    return 0


def one(args: argparse.Namespace, folder: Path, forward: str = "") -> dict[str, Any]:
    """Fly, score and draw into an empty folder; its summary. `forward`: who hears every datagram. Raises ConfigError, FlightError."""
    from tools import flight, warm

    def path_s() -> float:
        from tools import summary  # what takes long to load comes when both programs run

        return summary.path_duration_s(resolved.companion)

    resolved = resolve(args)
    max_time_s = resolved.scenario.flight.max_time_s
    signal.signal(signal.SIGTERM, _terminated)
    with Progress(path_s, quiet=args.json) as progress:
        warm.ensure(f"flight {stages(resolved.companion)}", lambda: warm.flight(resolved), progress.say)
        flight.prepare(folder, resolved)
        flown = flight.fly(folder, flight.Pace(args.speed), max_time_s, progress.watch, forward)
        progress.say("scoring")
        from tools import summary

        result = summary.summarise(folder, Path(args.scenario).stem, resolved, flown, command(args), args.speed is None)
        if not args.no_report and not flown.problems:
            from tools import report

            progress.say("drawing the report")
            report.flight(folder)
    return result


def _changes(args: argparse.Namespace) -> list[str]:
    """What is changed of the scenario. A sweep's path lasts as long as its program of these axes on this vehicle."""
    if args.scenario != "sweep":
        if args.axis:
            raise FlightError(f"--axis is for the scenario sweep; {args.scenario} is flown as its path says")
        return list(args.set)
    from mavquad import airframe, plan, sweep_flight
    from tools import scenarios

    axes = [f"sweep.axes={json.dumps(tuple(dict.fromkeys(args.axis)))}"] if args.axis else []
    tune = scenarios.load(args.scenario, [*args.set, *axes]).companion.get("tune", {}).get("sweep", {})
    kind = airframe.load(args.airframe).kind
    seconds = sweep_flight.duration_s(plan.params("sweep", sweep_flight, tune), kind)
    changes = [*axes, f"path.duration_s={seconds + 3.0:.0f}", f"flight.max_time_s={seconds + 210.0:.0f}"]
    if kind == "helicopter":  # what it made of the sticks, its inner loop's share included
        changes += ["companion.link.rates_hz.ACTUATOR_CONTROL_TARGET=250.0", "flight.takeoff_m=20"]
    return [*changes, *args.set]


def resolve(args: argparse.Namespace) -> Any:
    """The configurations of both programs, from the options. Raises ConfigError."""
    from tools import scenarios

    options = scenarios.Options(
        seed=args.seed,
        airframe=args.airframe,
        personality=args.personality,
        attitude=args.attitude,
        controller=args.controller,
        estimator=args.estimator,
        compensator=args.compensator,
        observers=[] if args.observer == ["none"] else args.observer,
        loop=args.loop,
        signing_key=args.signing_key,
    )
    return scenarios.resolve(scenarios.load(args.scenario, _changes(args)), options)


def stages(companion: Any) -> str:
    """The names of what flies: which kernels must be compiled."""
    names = (companion.controller, companion.estimator, companion.compensator, *companion.observers)
    return " ".join(name.replace(":", " ").replace(",", " ") for name in names)


def command(args: argparse.Namespace) -> str:
    """The command that repeats this flight."""
    words = ["mavquad", "fly", args.scenario, "--seed", str(args.seed)]
    for name in (
        "personality",
        "airframe",
        "controller",
        "estimator",
        "compensator",
        "attitude",
        "loop",
        "signing_key",
        "speed",
    ):
        value = getattr(args, name)
        if value not in (None, "", {"personality": "px4", "airframe": "x500", "attitude": "ahrs"}.get(name)):
            words += [f"--{name.replace('_', '-')}", str(value)]
    for name in ("axis", "observer", "set"):
        for value in getattr(args, name) or []:
            words += [f"--{name}", value]
    return shlex.join(words)


def _terminated(*_: Any) -> None:
    raise KeyboardInterrupt


class Progress:
    """Progress in vehicle time on stderr: a bar on a terminal, else a line for each change of state."""

    def __init__(self, path_s: Callable[[], float], quiet: bool = False) -> None:
        self._path_s = path_s
        self._engaged_s = math.nan
        self._live: Any = None
        self._task: Any = None
        self._lines = not sys.stderr.isatty() and not quiet
        self._bar = sys.stderr.isatty()

    def __enter__(self) -> "Progress":
        if self._bar:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            columns = (TextColumn("{task.fields[t]:>8}"), BarColumn(), TextColumn("{task.description}"))
            self._live = Progress(*columns, console=Console(stderr=True), transient=True)
            self._task = self._live.add_task("starting", total=None, t="")
            self._live.start()
        return self

    def __exit__(self, *_: Any) -> None:
        if self._live is not None:
            self._live.stop()

    def watch(self, t_s: float, said: list[str]) -> None:
        """The companion's vehicle time and what it has said since the last call."""
        for line in said:
            if "engaged:" in line and math.isnan(self._engaged_s):
                self._engaged_s = t_s
                if self._live is not None:
                    self._live.update(self._task, total=self._path_s())
            self.say(line.strip())
        if self._live is not None and not math.isnan(t_s):
            done = 0.0 if math.isnan(self._engaged_s) else max(0.0, t_s - self._engaged_s)
            self._live.update(self._task, completed=done, t=f"{t_s:.1f} s")

    def say(self, words: str) -> None:
        """What is being done now."""
        if self._live is not None:
            self._live.update(self._task, description=words)
        elif self._lines:
            print(words, file=sys.stderr, flush=True)
