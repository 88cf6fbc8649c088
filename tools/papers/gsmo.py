"""mavquad paper gsmo: body rates without a gyro: the observer of An et al. 2013, its family and its baselines, in every table.

Scenarios: 8.1 exact start, 8.2 general start and robustness, 8.3 noise and torque (and each method at its best gains), 8.4 order
of the integrators, 8.5 constant spin, tumble, gap, recording (of a real autopilot: --recording, or the folder MAVQUAD_DATA),
mocap (a flight of ours with motion capture: --flight, the run folder of `mavquad fly circle --attitude mocap`).
Configurations: G1 ... G9 the family, B1a ... B3 the baselines, online the bank that needs no gains.

Example: mavquad paper gsmo --seeds 1-8 --report gsmo.html
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from mavquad.errors import ConfigError
from tools.papers import common
from tools.papers.common import Row
from tools.papers.geometric import mocap, orders, recording, setup, tables, tuned, words

SCENARIOS = ("8.1", "8.2", "8.3", "8.4", "8.5", "tumble", "gap", "recording", "mocap")
Job = tuple[str, str, tuple[int, ...], str]  # what, configuration, seeds, recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_arguments(parser, seeds="1-8")
    parser.add_argument("--scenario", action="append", choices=SCENARIOS, help="only this one (may be repeated)")
    parser.add_argument("--config", action="append", metavar="NAME", help="only this configuration (may be repeated)")
    parser.add_argument(
        "--recording", type=Path, metavar="TLOG", help="a log with ATTITUDE_QUATERNION to judge the observers by"
    )
    parser.add_argument("--flight", type=Path, metavar="DIR", help="a run folder with motion capture, for the scenario mocap")


def plan(scenarios: Sequence[str], configs: Sequence[str] | None, seeds: Sequence[int], log: Path | None) -> list[Job]:
    """Every piece of work, the long ones first. Raises ConfigError for an unknown configuration."""
    named = list(setup.configurations())
    fast = [c.name for c in tables.tumble_configurations()]
    known = [*named, *fast, *(f"tuned {m}" for m in tuned.METHODS)]
    for name in configs or ():
        if name not in known:
            raise ConfigError(f"--config {name!r}: known are {', '.join(dict.fromkeys(known))}")
    wanted = set(configs or known)
    seeds = tuple(seeds)
    jobs: list[Job] = []
    if "8.3" in scenarios:
        jobs += [("tuned", m, seeds[:4], "") for m in tuned.METHODS if f"tuned {m}" in wanted]
        jobs += [("8.3", name, seeds, "") for name in named if name in wanted]
        jobs += [("coloured", name, seeds[:4], "") for name in ("G9", "B2b", "online") if name in wanted]
    if "tumble" in scenarios:
        jobs += [("tumble", name, seeds[:4], "") for name in fast if name in wanted]
    for scenario in ("8.1", "8.2", "gap"):
        if scenario in scenarios:
            jobs += [(scenario, name, seeds, "") for name in named if name in wanted]
    if configs is None:
        whole = {"8.2": ("maps",), "8.3": ("bias law",), "8.4": ("8.4",), "8.5": ("8.5",)}
        jobs += [(what, "", seeds, "") for scenario in scenarios for what in whole.get(scenario, ())]
        if "recording" in scenarios and log is not None:
            jobs.append(("recording", "", (), str(log)))
    return jobs


def work(job: Job) -> list[Row]:
    """The rows of one piece of work."""
    what, name, seeds, log = job
    one: dict[str, Callable[[], list[Row]]] = {
        "8.1": lambda: tables.exact_start(setup.configurations()[name]),
        "8.2": lambda: (
            tables.general_start(setup.configurations()[name]) + tables.robustness(setup.configurations()[name], seeds)
        ),
        "8.3": lambda: tables.noise(setup.configurations()[name], seeds),
        "gap": lambda: tables.gaps(setup.configurations()[name]),
        "tumble": lambda: tables.tumble({c.name: c for c in tables.tumble_configurations()}[name], seeds),
        "tuned": lambda: tuned.best(name, seeds),
        "maps": lambda: tables.maps(seeds),
        "bias law": tables.bias_law,
        "coloured": lambda: tables.coloured_noise(setup.configurations()[name], seeds),
        "8.4": lambda: orders.integrator_order() + orders.norm_drift(),
        "8.5": orders.constant_spin,
        "recording": lambda: recording.judged(recording.read(Path(log))),
        "mocap": lambda: mocap.judged(Path(log)),
    }
    return one[what]()


def run(args: argparse.Namespace) -> int:
    scenarios = args.scenario or list(SCENARIOS)
    log = args.recording or recording.find()
    if log is None and "recording" in scenarios:
        common.progress("no recording: give one with --recording, or set MAVQUAD_DATA to the folder of the recordings")
    jobs = plan(scenarios, args.config, common.parse_seeds(args.seeds), log)
    if args.flight is not None and "mocap" in scenarios:
        jobs.append(("mocap", "", (), str(args.flight)))
    if not jobs:
        raise ConfigError("nothing to do: the scenario mocap needs --flight, recording needs --recording or MAVQUAD_DATA")
    rows: list[Row] = []
    for i, found in enumerate(common.process_map(work, jobs, processes=args.processes)):
        rows += found
        if (i + 1) % 10 == 0 or i + 1 == len(jobs):
            common.progress(f"{i + 1} of {len(jobs)} pieces of work")
    rows.sort(key=lambda r: SCENARIOS.index(r["scenario"]))
    if args.json:
        common.print_json("gsmo", rows)
    else:
        sys.stdout.write(words.tables(rows) + "\n" + "\n".join(words.claims(rows)) + "\n")
    if args.report is not None:
        from tools.papers.geometric import report

        args.report.write_text(report.page(rows), encoding="utf-8")
        common.progress(f"report: {args.report}")
    return 0
