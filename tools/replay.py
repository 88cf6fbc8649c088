"""mavquad replay: a recorded flight of any autopilot as one page: observers, disturbance, wind, link, what would have been commanded.

Without options: every observer over the log, one self-contained page (its path is printed last), and the body rates compared.
--compare judges the observers: against the truth of a simulated flight, else against an offline smoother of the same measurements.
--what-if CONTROLLER says what another companion would have commanded.
--verify feeds a flight of ours again: every frame that was sent, and every value of the trace, must come out bit for bit.

Example:
  mavquad replay flight.tlog
  mavquad replay flight.tlog --observer gsmo:variant=relay --observer joint:lead_s=0.1 --observer joint --compare
  mavquad replay flight.ulg --what-if controller=iadrc --what-if controller=pid,compensator=asmf
  mavquad replay runs/20250101-120000-circle-7/flight.tlog --verify
"""

import argparse
import csv
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from mavquad.errors import ConfigError, FlightError, LogError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of a replay."""
    parser.add_argument("log", type=Path, help="a .tlog file; or a PX4 .ulg, an ArduPilot .bin")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="where to write the page (default: LOG.replay.html beside the log)"
    )
    parser.add_argument(
        "--observer", action="append", metavar="NAME[:KEY=VALUE,...]", help="what to run; again for more (default: every one)"
    )
    parser.add_argument("--compare", action="store_true", help="judge the observers against truth, or an offline smoother")
    parser.add_argument(
        "--what-if",
        action="append",
        metavar="KEY=VALUE,...",
        help="e.g. controller=iadrc,compensator=asmf: what it would have commanded",
    )
    parser.add_argument(
        "--airframe", metavar="NAME", help="the vehicle (default: the flight's own, else the numbers of the x500)"
    )
    parser.add_argument("--system", type=int, metavar="ID", help="the vehicle's system id, where the log holds several")
    parser.add_argument("--component", type=int, metavar="ID", help="its component id")
    parser.add_argument(
        "--from", dest="from_s", type=float, metavar="S", help="seconds after the log's start (default: airborne)"
    )
    parser.add_argument("--to", dest="to_s", type=float, metavar="S", help="until then")
    parser.add_argument("--verify", action="store_true", help="compare with what was sent then; exit 1 where the two part")
    parser.add_argument("--plan", type=Path, help="the flight's plan.toml (default: beside the log, where there is one)")
    parser.add_argument("--config", type=Path, help="a companion.toml to run instead of the flight's own")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="the pipeline's trace, a row per control step (.parquet too)")
    parser.add_argument("--json", action="store_true", help="print everything as JSON; a page only where --out says so")


def run(args: argparse.Namespace) -> int:
    """Replay one log. 0 done, 1 where --verify fails."""
    if args.verify:
        return _verify(args)
    from mavquad.link import recording
    from mavquad.link.columns import Log
    from tools import replayed, survey

    begun = time.perf_counter()
    log = None if recording.kept_aboard(args.log) else Log(args.log)
    if args.csv and log is None:
        raise ConfigError(f"{args.log}: --csv runs the pipeline over MAVLink frames; a log kept aboard holds none")
    chosen = replayed.Chosen(
        args.observer, args.compare, args.what_if or [], args.airframe, args.system, args.component, args.from_s, args.to_s
    )
    wanted = args.out or (None if args.json or args.csv else _page(args.log))
    companion = _settings(args) if args.config else None
    result = replayed.replay(args.log, log, chosen, companion, wanted, _command(args))
    if args.csv:
        result["trace"] = _write_trace(args, log)
    result["wall_s"] = time.perf_counter() - begun
    if args.json:
        print(json.dumps(survey.finite(result), allow_nan=False))
    else:
        survey.show(result)
        replayed.show(result)
    if result["problem"]:
        print(f"note: {result['problem']}", file=sys.stderr)
    return 0


def _page(log: Path) -> Path:
    """Where the page goes when nobody says: beside the log, or here where that folder takes no files."""
    name = f"{log.name}.replay.html"
    return log.with_name(name) if os.access(log.parent, os.W_OK) else Path(name)


def _command(args: argparse.Namespace) -> list[str]:
    """The command line again."""
    words = [str(args.log)]
    for name in ("observer", "what_if"):
        for value in getattr(args, name) or ():
            words += [f"--{name.replace('_', '-')}", value]
    words += ["--compare"] if args.compare else []
    for name, option in (
        ("airframe", "--airframe"),
        ("system", "--system"),
        ("component", "--component"),
        ("from_s", "--from"),
        ("to_s", "--to"),
        ("config", "--config"),
    ):
        if getattr(args, name) is not None:
            words += [option, str(getattr(args, name))]
    return words


# ---- the pipeline over the log ------------------------------------------------------------------------------------------
def _plan(args: argparse.Namespace) -> tuple[Any, tuple[str, ...]]:
    """The plan to run, and what differs between the flight's machine and this one."""
    from mavquad import plan, plan_file
    from mavquad.settings import Companion

    if args.config:
        if args.verify:
            raise ConfigError("--verify compares with the flight's own plan; leave out --config")
        settings = _settings(args)
    else:
        beside = args.plan or plan_file.beside(args.log)
        if args.plan or args.verify or beside.exists():
            recorded = plan_file.read(beside)
            return plan.build(recorded.companion, recorded.airframe), recorded.here
        settings = Companion()
    return plan.build(settings), ()


def _settings(args: argparse.Namespace) -> Any:
    from mavquad import config
    from mavquad.settings import Companion

    return config.load(args.config, Companion)


def _write_trace(args: argparse.Namespace, log: Any) -> dict[str, Any]:
    from tools import playback

    plan, _ = _plan(args)
    own = (plan.settings.link.system, plan.settings.link.component)
    begun = time.perf_counter()
    played = playback.play(plan, log.frames(), own=own)
    wall_s = time.perf_counter() - begun
    write_table(args.csv, played.trace.names, played.trace.rows)
    span_s = 1e-6 * float(log.t_us[-1] - log.t_us[0])
    return {
        "file": str(args.csv),
        "rows": len(played.trace.rows),
        "received": played.received,
        "refused": played.refused,
        "times_realtime": span_s / wall_s if wall_s > 0.0 else None,
    }


def write_table(path: Path, names: tuple[str, ...], rows: Any) -> None:
    """Rows of floats as CSV (every digit) or, by its suffix, as Parquet. Raises LogError where it cannot be written."""
    try:
        if path.suffix == ".parquet":
            try:
                import pyarrow as pa
                import pyarrow.parquet as pq
            except ImportError:
                raise ConfigError(f"{path}: Parquet needs pyarrow; install mavquad[export] or choose a .csv file") from None
            pq.write_table(pa.table({name: rows[:, i] for i, name in enumerate(names)}), path)
            return
        with path.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(names)
            writer.writerows(rows.tolist())
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror}") from None


# ---- verify ---------------------------------------------------------------------------------------------------------------
def _verify(args: argparse.Namespace) -> int:
    from mavquad.link import tlog
    from tools import playback, trace

    plan, here = _plan(args)
    own = (plan.settings.link.system, plan.settings.link.component)
    path = args.log.with_suffix(".trace")
    then = trace.read_trace(path) if path.exists() else None
    begun = time.perf_counter()
    cut = ""

    def records() -> Any:
        nonlocal cut
        try:
            yield from tlog.read(stream)
        except LogError as error:  # cut by a SIGKILL: what is whole is verified
            cut = str(error)

    try:
        with args.log.open("rb") as stream:
            verdict = playback.verify(plan, records(), own=own, then=then, exact=not here)
    except OSError as error:
        raise LogError(f"{args.log}: cannot be read: {error.strerror}") from None
    if cut and not verdict.received:
        raise LogError(cut)
    result = {
        "log": str(args.log),
        "ok": verdict.parting is None,
        "received": verdict.received,
        "sent_compared": verdict.sent,
        "answers_cut_off": verdict.unsent,
        "trace_rows": verdict.rows,
        "trace_rows_compared": 0 if then is None else min(verdict.rows, len(then.rows)),
        "compared": "bit for bit" if not here else "to the last bit of a float32, traces to 1e-9",
        "machine_differs": list(here),
        "largest_difference": verdict.largest if verdict.largest < float("inf") else None,
        "parting": None,
        "cut": cut or None,
        "wall_s": time.perf_counter() - begun,
    }
    if verdict.parting is not None:
        t_us, name, why = verdict.parting
        result["parting"] = {"t_us": t_us, "message": name, "why": why}
    if args.json:
        print(json.dumps(result, allow_nan=False))
    elif result["ok"]:
        span = f"{verdict.received} frames in, {verdict.sent} out, {result['trace_rows_compared']} rows of the trace"
        print(f"{args.log}: replays {result['compared']}: {span}, {result['wall_s']:.1f} s")
    for line in here:
        print(f"note: another machine or version than in flight: {line[:160]}", file=sys.stderr)
    if verdict.parting is not None:
        t_us, name, why = verdict.parting
        raise FlightError(f"{args.log}: the replay parts from the flight at {t_us} us, {name}: {why}")
    return 0
