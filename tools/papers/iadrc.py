"""mavquad paper iadrc: the IADRC paper's experiments S1, S3, S4 with ADRC and every variant, by seed and as medians.

S1 hovers in noise and square-wave disturbances, S3 flies a rectangle with a wrong model in wind, S4 is a bench that is blown
and struck, S4-latency the same with late measurements. Example: mavquad paper iadrc --scenario S1 --seeds 101-105
"""

import argparse
import math
from typing import Any, NamedTuple

from mavquad.errors import ConfigError
from tools.papers import common
from tools.papers.joint_observer import cases

SCENARIOS = ("S1", "S1-papergain", "S3", "S4", "S4-latency")
EXTRA = ("step15",)


class Job(NamedTuple):
    scenario: str
    config: str
    seeds: tuple[int, ...]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """--scenario, --config, and what every paper takes."""
    common.add_arguments(parser, seeds="1-5")
    parser.add_argument("--scenario", help=f"some of {', '.join(SCENARIOS + EXTRA)} (default: all but step15)")
    parser.add_argument("--config", help="some configurations, by name, with commas (default: all)")
    parser.add_argument("--speed", action="store_true", help="only the time that filter, observers and a run take")
    parser.add_argument("--bandwidths", action="store_true", help="also ADRC and IADRC-R without feed-forward at other w0")


def jobs(scenarios: str | None, names: str | None, seeds: list[int], bandwidths: bool) -> list[Job]:
    """What is to be run. Raises ConfigError for a scenario or a configuration that does not exist."""
    chosen = [s.strip() for s in scenarios.split(",")] if scenarios else list(SCENARIOS)
    for name in chosen:
        if name not in cases.SCENARIOS:
            raise ConfigError(f"--scenario {name!r}: no such scenario; known: {', '.join(SCENARIOS + EXTRA)}")
    every = {s: [c.name for c in cases.configs(s)] for s in chosen}
    if bandwidths:
        for s in chosen:
            every[s] += [c.name for c in cases.BANDWIDTHS] if s in ("S1", "S4") else []
    wanted = [n.strip() for n in names.split(",")] if names else None
    for name in wanted or ():
        if not any(name in row for row in every.values()):
            raise ConfigError(
                f"--config {name!r}: no such configuration in {', '.join(chosen)}; known: "
                f"{', '.join(dict.fromkeys(n for row in every.values() for n in row))}"
            )
    return [Job(s, n, tuple(seeds)) for s in chosen for n in every[s] if wanted is None or n in wanted]


def fly(job: Job) -> list[common.Row]:
    """All seeds of one configuration: one row per seed and metric."""
    from tools.papers.joint_observer import metrics, runs

    scenario = cases.SCENARIOS[job.scenario]
    config = cases.find(job.scenario, job.config)
    rows = []
    for seed in job.seeds:
        for metric, value in runs.measured(scenario, config, seed).items():
            rows.append(common.row(job.scenario, job.config, seed, metric, metrics.UNITS[metric], value))
    return rows


def run(args: argparse.Namespace) -> int:
    if args.speed:
        return _speed(args.json)
    seeds = common.parse_seeds(args.seeds)
    todo = jobs(args.scenario, args.config, seeds, args.bandwidths)
    rows: list[common.Row] = []
    common.progress(f"{len(todo)} configurations, seeds {args.seeds} (kernels compile once, about a minute)")
    fly(todo[0]._replace(seeds=(seeds[0],)))  # compiled here once, found in the cache by the other processes
    for done, found in enumerate(common.process_map(fly, todo, processes=args.processes), 1):
        rows += found
        common.progress(f"{done}/{len(todo)} {todo[done - 1].scenario} {todo[done - 1].config}")
    middle = common.medians(r for r in rows if not math.isnan(r["value"]))
    if args.report:
        from tools.papers.joint_observer import report

        report.write(args.report, middle, seeds)
        common.progress(f"report: {args.report}")
    if args.json:
        common.print_json("iadrc", [_plain(r) for r in rows + middle])
    else:
        print(table(middle))
    return 0


def _speed(as_json: bool) -> int:
    from tools.papers.joint_observer import speed

    rows = speed.measure()
    if as_json:
        common.print_json("iadrc", rows)
    else:
        print("\n".join(f"{r['metric']:12} {r['value']:8.3f} {r['unit']}" for r in rows))
    return 0


def _plain(row: common.Row) -> common.Row:
    """JSON knows no infinity: what was never reached, or is undefined (the lag of no estimate), is null."""
    return row if math.isfinite(row["value"]) else {**row, "value": None}


def table(middle: list[common.Row]) -> str:
    """Medians as text: one block per scenario, one line per configuration."""
    blocks = []
    for scenario in dict.fromkeys(r["scenario"] for r in middle):
        here = [r for r in middle if r["scenario"] == scenario]
        metrics = list(dict.fromkeys(r["metric"] for r in here))
        found: dict[str, dict[str, Any]] = {}
        for r in here:
            found.setdefault(r["config"], {})[r["metric"]] = r["value"]
        width = max(len(name) for name in found)
        head = f"{scenario:{width}} " + " ".join(f"{m:>11}" for m in metrics)
        lines = [f"{name:{width}} " + " ".join(f"{v.get(m, float('nan')):11.3f}" for m in metrics) for name, v in found.items()]
        blocks.append("\n".join([head, *lines]))
    return "\n\n".join(blocks)
