"""What every paper's command shares: seeds, rows, medians, and a map over processes."""

import argparse
import json
import multiprocessing
import os
import statistics
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from mavquad.errors import ConfigError

Row = dict[str, Any]
_A = TypeVar("_A")
_B = TypeVar("_B")


def parse_seeds(text: str) -> list[int]:
    """`1-5`, `101-105`, `1,2,7` and mixtures -> seeds in the order written, none twice. Raises ConfigError."""
    seeds: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        try:
            lo, hi = int(first), int(last) if dash else int(first)
        except ValueError:
            raise ConfigError(f"--seeds {text!r}: {part!r} is not a number or a range; write 1-5 or 1,2,7") from None
        if hi < lo:
            raise ConfigError(f"--seeds {text!r}: the range {part!r} runs backwards; write {hi}-{lo}")
        seeds += [seed for seed in range(lo, hi + 1) if seed not in seeds]
    return seeds


def row(scenario: str, config: str, seed: int | None, metric: str, unit: str, value: float, stat: str | None = None) -> Row:
    """One figure. A row for all seeds has seed None and says which `stat` it is."""
    found: Row = {"scenario": scenario, "config": config, "seed": seed, "metric": metric, "unit": unit, "value": value}
    return found if stat is None else {**found, "stat": stat}


def medians(rows: Iterable[Row]) -> list[Row]:
    """One median row for each (scenario, config, metric) among rows that carry a seed, in order of first appearance."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for one in rows:
        if one["seed"] is not None:
            groups.setdefault((one["scenario"], one["config"], one["metric"]), []).append(one)
    return [
        row(scenario, config, None, metric, group[0]["unit"], statistics.median(one["value"] for one in group), "median")
        for (scenario, config, metric), group in groups.items()
    ]


def process_map(function: Callable[[_A], _B], jobs: Sequence[_A], *, processes: int | None = None) -> Iterator[_B]:
    """`function` over `jobs` in order, on all cores. It must be importable by name: the processes are started afresh."""
    workers = min(len(jobs), processes or os.cpu_count() or 1)
    if workers <= 1:
        yield from map(function, jobs)
        return
    context = multiprocessing.get_context("forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        yield from pool.map(function, jobs)


def add_arguments(parser: argparse.ArgumentParser, *, seeds: str) -> None:
    """--seeds, --json, --report and --processes, the same for every paper."""
    parser.add_argument("--seeds", default=seeds, help="1-5 or 1,2,7 (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="rows for machines on stdout")
    parser.add_argument("--report", type=Path, metavar="FILE", help="write a self-contained HTML page")
    parser.add_argument("--processes", type=int, metavar="N", help="worker processes (default: all cores)")


def progress(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def print_json(paper: str, rows: Sequence[Row]) -> None:
    json.dump({"paper": paper, "rows": list(rows)}, sys.stdout)
    print()
