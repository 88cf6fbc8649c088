"""mavquad paper eskf-mpc: Yang, Lyu, Chai 2022 in turbulent wind, with its baselines and ablations.

Scenarios: S1 is the paper's spiral in Dryden turbulence with measurement noise A or B (and its noise and wind sweeps), S2 adds
the mean wind, a real rotor's inflow, motor lag and a delayed command, S3 starts 3 m off and meets its constraints; `--scenario speed` takes CPU times.
"""

import argparse
import math
import statistics
import sys
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tools.papers import common
from tools.papers.common import Row

if TYPE_CHECKING:
    from mavquad.control.constrained import Design
    from tools.papers.quad_in_wind.constrained_flight import Counts

S1_CONFIGS = [
    "default",
    "PB",
    "PA",
    "PB-printed-targets",
    "PB-table-R",
    "PB-per-step-delta",
    "PB-no-position-compensation",
    "PB-no-compensation",
    "PB-position-only",
    "KF",
    "KF-tuned-q",
    "ADRC",
    "LADRC",
    "tuned",
    "tuned-ESKF",
    "tuned-no-position-compensation",
    "tuned-no-compensation",
    "default-position-only",
]
SWEEP_CONFIGS = ["default", "PB", "ADRC", "LADRC"]
PLAN: dict[str, list[str]] = {
    "S1-A": S1_CONFIGS,
    "S1-B": S1_CONFIGS,
    **{f"S1-var1e-{n}": SWEEP_CONFIGS for n in (6, 5, 4, 3, 2, 1)},
    "S1-W5-A": SWEEP_CONFIGS,
    "S1-W5": SWEEP_CONFIGS,
    "S1-W15-A": SWEEP_CONFIGS,
    "S1-W15": SWEEP_CONFIGS,
    "S1-calm": ["default", "PB"],
    "S2": ["default", "default-no-compensation", "default-integral-only"],
    "S2-W15": ["default"],
    "S2-60ms": ["default"],
    "S2-60ms-predicted": ["default", "default-first-order-prediction"],
    "S2-60ms-predicted-W15": ["default"],
    "S2-100ms": ["default"],
    "S2-100ms-predicted": ["default", "default-first-order-prediction"],
    "S3": ["default", "closed", "default-integral", "closed-integral"],
}
SPEED = "speed"  # CPU times; flown by no default, since other work on the machine shows in it
SETTLED = 1000  # steps before "ss" starts: 10 s
Job = tuple[str, str, int]


class Flown(NamedTuple):
    log: np.ndarray  # (steps, COLUMNS)
    steps: int  # flown before it was lost
    counts: "Counts | None"  # of the quadratic programs, where there are any


def fly(scenario_name: str, config_name: str, seed: int, *, steps: int | None = None) -> Flown:
    """One flight by the names of its rows; `steps`: only so many of its control periods."""
    from tools.papers.quad_in_wind import configs, constrained_flight, loop

    configs.pick(configs.SCENARIOS, scenario_name, "scenario")
    configs.pick(configs.CONFIGS, config_name, "config")
    scenario, config = configs.SCENARIOS[scenario_name], configs.CONFIGS[config_name]
    if steps is not None:
        scenario = scenario._replace(steps=steps)
    flight = configs.flight(config, scenario)
    noise, wind = configs.disturbances(scenario, seed)
    log = np.full((scenario.steps, loop.COLUMNS), np.nan)
    start = loop.loop(flight, scenario.start_ned_m, configs.YAW_START)
    if config.constrained and scenario.slew_m_s3 > 0.0:
        return Flown(log, *constrained_flight.fly(flight, start, noise, wind, log, _design()))
    return Flown(log, loop.fly(flight, start, noise, wind, log), None)


@lru_cache(maxsize=1)
def _design() -> "Design":
    from tools.papers.quad_in_wind import constrained_flight

    return constrained_flight.design()


def metrics(scenario: str, flown: Flown) -> dict[str, tuple[str, float]]:
    """Metric -> (unit, value); the errors of a lost flight are NaN."""
    log = flown.log
    if flown.steps < len(log):
        nan = ("m", math.nan)
        return {"lost": ("1", 1.0), **dict.fromkeys(("rmse_n", "rmse_e", "rmse_d", "ss_3d", "full_3d"), nan)}
    extra: dict[str, tuple[str, float]] = {}
    if scenario == "S3":
        from tools.papers.quad_in_wind.constrained_flight import overshoot

        extra["overshoot"] = ("m", overshoot(log))
    if flown.counts is not None:
        extra["qp_iterations_p99"] = ("1", float(np.percentile(flown.counts.iterations, 99)))
        extra["qp_fallbacks"] = ("1", float(flown.counts.fallbacks))
    e2 = (log[:, 1:4] - log[:, 4:7]) ** 2
    ss = e2[SETTLED:].mean(axis=0)
    found = {name: ("m", float(math.sqrt(value))) for name, value in zip(("rmse_n", "rmse_e", "rmse_d"), ss, strict=True)}
    f_error = np.sqrt(((log[SETTLED:, 19:25] - log[SETTLED:, 25:31]) ** 2).mean(axis=0))
    return {
        "lost": ("1", 0.0),
        **found,
        "ss_3d": ("m", float(math.sqrt(ss.sum()))),
        "full_3d": ("m", float(math.sqrt(e2.sum(axis=1).mean()))),
        "f_rmse": ("m/s^2", float(np.linalg.norm(f_error[:3]))),
        "f_rmse_d": ("m/s^2", float(f_error[2])),
        **extra,
    }


def job_rows(job: Job) -> list[Row]:
    """The rows of one flight."""
    scenario, config, seed = job
    if scenario == SPEED:
        from tools.papers.quad_in_wind import speed

        return [common.row(SPEED, config, seed, name, unit, value) for name, (unit, value) in speed.measure(seed).items()]
    found = metrics(scenario, fly(scenario, config, seed))
    return [common.row(scenario, config, seed, name, unit, value) for name, (unit, value) in found.items()]


def summary(rows: list[Row]) -> list[Row]:
    """Over the seeds of each (scenario, config, metric): median, mean of the flights not lost, and how many were lost."""
    groups: dict[tuple[str, str, str, str], list[float]] = {}
    for one in rows:
        groups.setdefault((one["scenario"], one["config"], one["metric"], one["unit"]), []).append(one["value"])
    out = []
    for (scenario, config, metric, unit), values in groups.items():
        if metric == "lost":
            out.append(common.row(scenario, config, None, metric, unit, sum(values), "sum"))
            continue
        flown = [v for v in values if math.isfinite(v)]
        for stat, function in (("median", statistics.median), ("mean", statistics.fmean)):
            value = function(flown) if flown else math.nan
            out.append(common.row(scenario, config, None, metric, unit, value, stat))
    return out


def table(rows: list[Row]) -> str:
    """One line per scenario and config: means over the seeds that were not lost. Other scenarios' figures below."""
    cells: dict[tuple[str, str], dict[str, float]] = {}
    for one in rows:
        if one["seed"] is None and one.get("stat") in ("mean", "sum"):
            cells.setdefault((one["scenario"], one["config"]), {})[one["metric"]] = one["value"]
    heads = ("n", "e", "d", "ss 3-D", "full", "f rmse", "over", "lost")
    names = ("rmse_n", "rmse_e", "rmse_d", "ss_3d", "full_3d", "f_rmse", "overshoot")
    lines = [f"{'scenario':22}{'config':32}" + "".join(f"{h:>8}" for h in heads) + "   (m, m/s^2; means over the seeds)"]
    for (scenario, config), c in cells.items():
        if scenario == SPEED:
            lines += [f"{scenario:22}{name:40}{value:12.4g}" for name, value in c.items()]
            continue
        values = [c.get(name, math.nan) for name in names]
        shown = "".join(f"{v:>8.4f}" if math.isfinite(v) else f"{'-':>8}" for v in values)
        lines.append(f"{scenario:22}{config:32}{shown}{c['lost']:>8.0f}")
    return "\n".join(lines)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "example: mavquad paper eskf-mpc --scenario S1-A,S1-B --config default,PB,ADRC --seeds 101-105"
    common.add_arguments(parser, seeds="101-105")
    parser.add_argument("--scenario", default="", help="only these, comma-separated")
    parser.add_argument("--config", default="", help="only these, comma-separated")


def plan(scenarios: str, configs_text: str, seeds: list[int]) -> list[Job]:
    """The flights asked for; a config named on purpose is flown in every chosen scenario."""
    from tools.papers.quad_in_wind import configs

    chosen = [s.strip() for s in scenarios.split(",") if s.strip()] or list(PLAN)
    named = [c.strip() for c in configs_text.split(",") if c.strip()]
    for name in chosen:
        configs.pick({**configs.SCENARIOS, SPEED: None}, name, "scenario")
    for name in named:
        configs.pick(configs.CONFIGS, name, "config")
    jobs = [(s, c, seed) for s in chosen if s != SPEED for c in (named or PLAN.get(s, ["default"])) for seed in seeds]
    return jobs + [(SPEED, "default", seeds[0])] * (SPEED in chosen)


def warm() -> None:
    """Compile what the experiments need: one second of each kind of flight is the whole of it."""
    for scenario, config in (("S1-A", "default"), ("S1-A", "ADRC"), ("S3", "default")):
        fly(scenario, config, 1, steps=100)


def run(args: argparse.Namespace) -> int:
    jobs = plan(args.scenario, args.config, common.parse_seeds(args.seeds))
    rows: list[Row] = []
    job_rows(jobs[0])  # compiles once, before the workers start
    for i, found in enumerate(common.process_map(job_rows, jobs, processes=args.processes)):
        rows += found
        if (i + 1) % 50 == 0 or i + 1 == len(jobs):
            common.progress(f"{i + 1} of {len(jobs)} flights")
    rows += summary(rows)
    if args.json:
        common.print_json("eskf-mpc", rows)
    else:
        sys.stdout.write(table(rows) + "\n")
    if args.report:
        from tools.papers import eskf_mpc_page

        args.report.write_text(eskf_mpc_page.page_of(rows, common.parse_seeds(args.seeds)[0]), encoding="utf-8")
        common.progress(f"report: {args.report}")
    return 0
