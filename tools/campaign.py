"""mavquad campaign: scenarios x variants x seeds, one row per flight in a SQLite file; killed at any moment, it goes on where it was.

FILE is a campaign's name (asmf, eskf-mpc, iadrc, reference) or a TOML file of your own; tools/campaigns/grid.py says what is in it.
Each row holds the command that repeats its flight alone. Examples:

  mavquad campaign reference --over-udp --out reference.sqlite
  mavquad campaign own.toml --over-udp --seeds 101-105 --json
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from mavquad.errors import ConfigError
from tools.campaigns.grid import Campaign, Flight

_LINE_EVERY_S = 10.0  # without a terminal


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of a campaign."""
    parser.add_argument("file", help="a campaign's name, or a TOML file")
    parser.add_argument("--over-udp", action="store_true", help="fly the two real processes, as `mavquad fly` does")
    parser.add_argument("--seeds", help="other seeds than the file's, as 1-5 or 1,2,7")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the SQLite file of results (default: <name>.sqlite here)")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="worker processes (default: %(default)s)"
    )
    parser.add_argument("--dask", metavar="ADDRESS", help="fly on the workers of this dask.distributed scheduler")
    parser.add_argument(
        "--keep",
        choices=("none", "failed", "all"),
        default="none",
        help="which run folders to keep, in <out>.runs (default: none)",
    )
    parser.add_argument("--list", action="store_true", help="print the command of every flight and fly none")
    parser.add_argument("--json", action="store_true", help="cells and rows as JSON on stdout")


def run(args: argparse.Namespace) -> int:
    """Fly what is not flown yet, then show the table."""
    from tools.campaigns import grid
    from tools.campaigns.store import Store

    if args.jobs < 1:
        raise ConfigError(f"--jobs {args.jobs}: expected at least 1")
    campaign = grid.load(args.file, args.seeds)
    flights = list(grid.flights(campaign))
    _check_metrics(campaign)
    if args.list:
        print("\n".join(flight.command for flight in flights))
        return 0
    engine = _engine(args)
    out = args.out or Path(f"{Path(args.file).stem}.sqlite")
    with Store(out) as store:
        done = store.finished(engine.NAME)
        todo = [flight for flight in flights if flight.id not in done]
        progress = Progress(len(flights), len(flights) - len(todo))
        if todo:
            _fly(engine, todo, store, progress, args, out)
        _show(campaign, store.rows(engine.NAME, flights), progress, args.json, out)
    return 0


def _engine(args: argparse.Namespace) -> Any:
    from tools.campaigns import compiled, over_udp

    return over_udp if args.over_udp else compiled


def _fly(engine: Any, todo: list[Flight], store: Any, progress: "Progress", args: argparse.Namespace, out: Path) -> None:
    from tools.campaigns import dask_cluster, workers

    engine.prepare(todo, progress.say)
    runs = str(out.with_name(out.name + ".runs"))

    def arguments(chunk: list[Flight]) -> tuple[Any, ...]:
        return [flight.words for flight in chunk], [flight.id for flight in chunk], runs, args.keep

    chunks = engine.chunks(todo)
    if args.dask:
        flown = dask_cluster.run(engine.fly_chunk, chunks, arguments, args.dask)
    else:
        flown = workers.run(engine.fly_chunk, chunks, arguments, args.jobs, engine.PROCESSES)
    progress.begin()
    try:
        for chunk, results in flown:
            store.add(engine.NAME, zip(chunk, results, strict=True))
            progress.flown(chunk, results)
    except KeyboardInterrupt:
        progress.say(f"stopped after {progress.done} of {progress.total} flights; the same command goes on from there")
        raise
    finally:
        if args.keep == "none" and Path(runs).is_dir() and not any(Path(runs).iterdir()):
            Path(runs).rmdir()


def _check_metrics(campaign: Campaign) -> None:
    from tools.campaigns.store import SCORES

    for metric in campaign.metrics:
        if metric not in SCORES:
            raise ConfigError(f"metrics: {metric!r} is no column of the results; known: {', '.join(SCORES)}")


def _show(campaign: Campaign, rows: list[dict[str, Any]], progress: "Progress", as_json: bool, out: Path) -> None:
    from tools.campaigns import table

    found = table.cells(campaign, rows)
    if as_json:
        print(
            json.dumps({"campaign": campaign.about, "out": str(out), "speed": progress.speed(), "cells": found, "rows": rows})
        )
        return
    print(f"{campaign.about}\n\n{table.text(campaign, found)}\n")
    bad = [row for row in rows if not row["ok"]]
    versus = f"; x: median over seeds of the ratio to {campaign.baseline}, same scenario and seed" if campaign.baseline else ""
    print(f"medians over seeds (smallest - largest){versus}")
    print(f"{len(rows)} flights in {out}, {len(bad)} of them not ok{', for example:' if bad else ''}")
    for row in bad[:3]:
        print(f"  {row['command']}\n    {row['problem']}")


class Progress:
    """How far a campaign is, on stderr: a bar on a terminal, else a line every ten seconds."""

    def __init__(self, total: int, before: int) -> None:
        self.total, self.before, self.done = total, before, before
        self._begun = self._said = time.monotonic()
        self._cpu = 0.0

    def begin(self) -> None:
        """The flights begin now."""
        self._begun = self._said = time.monotonic()
        if self.before:
            self.say(f"{self.before} of {self.total} flights are there already")

    def flown(self, chunk: list[Flight], results: list[Any]) -> None:
        """These have ended."""
        self.done += len(results)
        now = time.monotonic()
        terminal = sys.stderr.isatty()
        if not terminal and now - self._said < _LINE_EVERY_S and self.done < self.total:
            return
        self._said = now
        rate = (self.done - self.before) / max(1e-9, now - self._begun)
        rmse = (results[-1].summary.get("rmse_m") or {}).get("position")
        last = f"{chunk[-1].label}: {results[-1].problem or (f'rmse {rmse:.3f} m' if rmse is not None else 'no rmse')}"
        words = f"{self.done} of {self.total} flights, {_rate(rate)}, {_time((self.total - self.done) / rate)} left; {last}"
        print(
            f"\r{words[:150]:150}" if terminal else words,
            end="" if terminal and self.done < self.total else "\n",
            file=sys.stderr,
            flush=True,
        )

    def say(self, words: str) -> None:
        print(words, file=sys.stderr, flush=True)

    def speed(self) -> dict[str, float]:
        """Flights of this run and how fast they were."""
        seconds = time.monotonic() - self._begun
        return {"flights": self.done - self.before, "wall_s": seconds}


def _rate(per_s: float) -> str:
    return f"{per_s:.3g} a second" if per_s >= 1.0 else f"{60.0 * per_s:.3g} a minute"


def _time(seconds: float) -> str:
    return (
        f"{seconds:.0f} s"
        if seconds < 120.0
        else f"{seconds / 60.0:.0f} min"
        if seconds < 7200.0
        else f"{seconds / 3600.0:.1f} h"
    )
