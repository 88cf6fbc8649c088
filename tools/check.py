"""mavquad check: what an autopilot sends, grants and refuses, and so which methods can run on it.

Nothing flies: it listens, asks for the message rates the companion needs, reads a few parameters, and says what came of it.

Example:
  mavquad check udpin:0.0.0.0:14550
  mavquad check serial:/dev/ttyACM0:921600 --seconds 15 --json
"""

import argparse
import json
import math
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from mavquad.errors import ConfigError, LinkError

ENOUGH_HZ = {"Attitude": 40.0, "Position": 4.0, "Imu": 40.0, "Mocap": 20.0, "Motors": 20.0, "Target": 10.0}
MESSAGES = {  # what carries each kind of sample, the better one first
    "Attitude": ("ATTITUDE_QUATERNION", "ATTITUDE"),
    "Position": ("LOCAL_POSITION_NED",),
    "Imu": ("HIGHRES_IMU",),
    "Mocap": ("ATT_POS_MOCAP",),
    "Motors": ("SERVO_OUTPUT_RAW",),
    "Target": ("ATTITUDE_TARGET",),
}
OBSERVERS = ("gsmo", "gsmo:torque=motors", "gsmo:source=mocap", "gsmo:source=mocap,torque=motors")
_THRUST_AS_THRUST = 8  # bit 3 of ArduPilot's GUID_OPTIONS
_AUTOPILOTS = {3: "ArduPilot", 12: "PX4"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of a check."""
    parser.add_argument("endpoint", help="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long to listen and ask (default: %(default)s)")
    parser.add_argument("--run", type=Path, metavar="DIR", help="keep the log there")
    parser.add_argument("--json", action="store_true", help="print everything as JSON")


def run(args: argparse.Namespace) -> int:
    """0 where the companion could fly it, 1 where not."""
    if not 2.0 <= args.seconds <= 3600.0:
        raise ConfigError(f"--seconds {args.seconds}: expected 2 to 3600")
    with tempfile.TemporaryDirectory() as scratch:
        found = check(args.endpoint, args.seconds, args.run or Path(scratch))
    if args.json:
        print(json.dumps(found, allow_nan=False))
    else:
        show(found)
    if not found["can_fly"]:
        raise LinkError(f"{args.endpoint}: this companion cannot fly it: {'; '.join(found['missing'])}")
    return 0


def check(endpoint_name: str, seconds: float, folder: Path) -> dict[str, Any]:
    """Listen and ask for some seconds. Raises LinkError where nobody speaks MAVLink there."""
    from mavquad import pipeline
    from mavquad.companion import Companion
    from mavquad.link.columns import Log
    from mavquad.link.endpoint import open_endpoint
    from mavquad.run_files import next_log
    from mavquad.settings import Companion as Settings

    endpoint = open_endpoint(endpoint_name)
    plan = pipeline.build(Settings(observers=()))
    path = next_log(folder, "flight")
    companion = Companion(plan, endpoint, folder)
    timer = threading.Timer(seconds, companion.stop)
    timer.start()
    begun_s = time.monotonic()
    try:
        companion.run()
    finally:
        timer.cancel()
    seconds = max(0.1, min(seconds, round(time.monotonic() - begun_s, 1)))  # less where Ctrl-C ended it
    life = companion.flight.life
    if life.target == (0, 0):
        raise LinkError(
            f"{endpoint_name}: no HEARTBEAT of an autopilot in {seconds:g} s; is it running, and does it send there?"
            f" ({companion.received} other messages heard)"
        )
    log = Log(path)
    return _judge(companion.summary(), life, _measured(log, life.target, seconds), _texts(log, life.target))


def _measured(log: Any, target: tuple[int, int], seconds: float) -> dict[str, float]:
    """Rate of every message of the autopilot, over the second half of the time, when all had been asked for."""
    half_us = int(log.t_us[-1]) - round(0.5e6 * seconds)
    counts = {}
    for stream in log.streams:
        if (stream.system, stream.component) == target:
            n = int((log.t_us[log.numbers(stream)] > half_us).sum())
            if n:
                counts[stream.name] = n / (0.5 * seconds)
    return dict(sorted(counts.items()))


def _texts(log: Any, target: tuple[int, int]) -> list[str]:
    found = log.find("STATUSTEXT", *target)
    return [row["text"].decode("utf-8", "replace") for row in log.rows(found[0])] if found else []


def _judge(summary: dict[str, Any], life: Any, measured: dict[str, float], texts: list[str]) -> dict[str, Any]:
    """What can run, and what is in the way."""
    methods = [_method(kind, label, needs, measured) for kind, label, needs in needs_of_all()]
    missing = []
    pid = next(m for m in methods if m["name"] == "pid")
    if not pid["runs"]:
        granted = summary["rates_hz"].get("LOCAL_POSITION_NED", math.nan)
        silent = granted > 0.0 and not measured.get("LOCAL_POSITION_NED")  # as an estimator that has no origin yet
        missing.append(
            pid["why"] + (" (granted, nothing came: is there a position? try again when it can arm)" if silent else "")
        )
    options = dict(life.params).get("GUID_OPTIONS", math.nan)
    if life.autopilot == 3 and not (math.isfinite(options) and int(options) & _THRUST_AS_THRUST):
        value = f"set it to {int(options) | _THRUST_AS_THRUST}" if math.isfinite(options) else "set bit 3 (add 8)"
        missing.append(f"GUID_OPTIONS is {options:g}: {value}, so that thrust is thrust and not a climb rate")
    if life.autopilot not in _AUTOPILOTS:
        missing.append(f"autopilot {life.autopilot}: neither ArduPilot nor PX4; its modes are not known")
    rates = [
        {"message": name, "granted_hz": None if not math.isfinite(hz) else hz, "measured_hz": measured.get(name, 0.0)}
        for name, hz in summary["rates_hz"].items()
    ]
    return {
        "autopilot": _AUTOPILOTS.get(life.autopilot, str(life.autopilot)),
        "system": life.target[0],
        "component": life.target[1],
        "armed": life.armed,
        "state": summary["state"],
        "asked_for": rates,
        "also_sends": {name: hz for name, hz in measured.items() if name not in summary["rates_hz"]},
        "parameters": {name: value for name, value in life.params if math.isfinite(value)},
        "hover_thrust": summary["hover_thrust"],
        "round_trip_s": summary["delay_s"],
        "messages_lost": summary["messages_lost"],
        "methods": methods,
        "can_fly": not missing,
        "missing": missing,
        "texts": texts[-20:],
    }


def needs_of_all() -> list[tuple[str, str, tuple[str, ...]]]:
    """(kind, name, the kinds of samples it needs) of every method there is."""
    from mavquad import airframe, plan
    from mavquad.settings import Companion as Settings

    def uses(stage: Any) -> tuple[str, ...]:
        return tuple(stage.module.uses(stage.gains)) if hasattr(stage.module, "uses") else ("Attitude", "Position")

    found = []
    for name in plan.CONTROLLERS:
        built = plan.build(Settings(controller=name, observers=()))  # type: ignore[arg-type]
        found.append(("controller", name, uses(built.estimator)))
    x500 = airframe.load("x500")
    for kind, table, labels in (
        ("compensator", plan.COMPENSATORS, tuple(plan.COMPENSATORS)),
        ("observer", plan.OBSERVERS, OBSERVERS),
    ):
        found += [(kind, label, uses(plan.stage(kind, label, table, {}, x500))) for label in labels]
    return found


def _method(kind: str, label: str, needs: tuple[str, ...], measured: dict[str, float]) -> dict[str, Any]:
    lacking = []
    for sample in needs:
        best = max((measured.get(name, 0.0), name) for name in MESSAGES[sample])
        if best[0] < ENOUGH_HZ[sample]:
            lacking.append(f"{' or '.join(MESSAGES[sample])} at {best[0]:.1f} Hz, at least {ENOUGH_HZ[sample]:g} needed")
    return {"kind": kind, "name": label, "runs": not lacking, "why": "; ".join(lacking)}


def show(found: dict[str, Any]) -> None:
    """The same for people."""
    lost = found["messages_lost"]
    print(f"{found['autopilot']} {found['system']}/{found['component']}, {'armed' if found['armed'] else 'disarmed'};", end=" ")
    print(f"round trip {1e3 * found['round_trip_s']:.1f} ms, {lost} messages lost, hover thrust {found['hover_thrust']:.3f}")
    for name, value in found["parameters"].items():
        print(f"  {name} = {value:g}")
    print(f"\n  {'asked for':24} {'granted, Hz':>12} {'measured, Hz':>13}")
    for rate in found["asked_for"]:
        granted = "no answer" if rate["granted_hz"] is None else f"{rate['granted_hz']:g}" if rate["granted_hz"] else "refused"
        print(f"  {rate['message']:24} {granted:>12} {rate['measured_hz']:>13.1f}")
    others = ", ".join(f"{name} {hz:.1f}" for name, hz in found["also_sends"].items())
    print(f"  sent unasked (Hz): {others or 'nothing'}\n")
    for m in found["methods"]:
        print(f"  {m['kind']:12} {m['name']:34} {'runs' if m['runs'] else 'cannot run: ' + m['why']}")
    for text in found["texts"]:
        print(f"it said: {text}")
    for text in found["missing"]:
        print(f"in the way: {text}")
