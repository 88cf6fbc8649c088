"""mavquad paper asmf: Song et al. 2011, model error with bounds and its correction, on a quadrotor and a helicopter.

Scenarios: guarantee is the 19-state filter under noise at its bounds (design note, section 6), quad-* the quadrotor of section 8
behind PD, PI, INDI-like, Kalman and ASMF corrections, heli-* the helicopter of section 7 (the line is flown into the wind).
"""

import argparse
import math
import sys
from functools import lru_cache
from typing import TYPE_CHECKING

from mavquad.errors import ConfigError
from tools.papers import common
from tools.papers.common import Row

if TYPE_CHECKING:
    from tools.papers.active import helicopter, quadrotor, surroundings

Job = tuple[str, str, int]
Metrics = dict[str, tuple[float, str]]

VARIANTS = ("strips", "printed", "corrected", "scaled", "R=diag(e2)", "Bf=I", "strips b=1e-4", "interval", "decoupled")
QUAD = ("PD", "PI", "INDI", "KF", "ASMF")
HELI = ("PI", "active-7.1", "active")
PLAN: dict[str, tuple[str, ...]] = {
    "guarantee": VARIANTS,
    "guarantee-square": VARIANTS[:6],
    "quad-hover": QUAD,
    "quad-line10": (*QUAD, "ASMF minmax", "ASMF vertex"),
    "quad-line12": QUAD,
    "quad-line12-north": QUAD,
    "quad-ellipse": QUAD,
    "quad-ellipse-lead": QUAD,
    "quad-ellipse-spikes": ("KF", "ASMF"),
    "quad-ellipse-dropout": ("KF", "ASMF"),
    "quad-ellipse-noimu": ("KF", "ASMF"),
    "quad-ellipse-b0.05": ("ASMF",),
    "quad-ellipse-b0.02": ("ASMF",),
    "quad-ellipse-gust3": ("PD", "PI", "ASMF"),
    "quad-hover-light": ("PD", "PI", "ASMF"),
    "heli-hover": HELI,
    "heli-leg1": HELI,
    "heli-leg2": HELI,
    "heli-ellipse": (
        *HELI,
        "target without f",
        "target without integral",
        "target without acceleration",
        "target with Kalman f",
    ),
    "heli-ellipse-delay": ("active",),  # 100 ms, known to filter and controller
    "heli-ellipse-delay-unknown": ("active",),
}
COURSE_RAD = math.pi


def job_rows(job: Job) -> list[Row]:
    """The rows of one flight; the three phases of the helicopter's line come from one."""
    scenario, config, seed = job
    found = _line_phases(config, seed) if scenario == "heli-line" else {scenario: _metrics(scenario, config, seed)}
    return [
        common.row(name, config, seed, metric, unit, value)
        for name, values in found.items()
        for metric, (value, unit) in values.items()
    ]


def _metrics(scenario: str, config: str, seed: int) -> Metrics:
    from tools.papers.active import helicopter, quadrotor

    if scenario.startswith("guarantee"):
        return _guarantee(config, "square" if scenario.endswith("square") else "uniform", seed)
    if scenario.startswith("quad"):
        name, _, mode = config.partition(" ")
        found = quadrotor.metrics(quadrotor.fly(name, quad_case(scenario, mode or "centre"), seed))
        return found if name == "ASMF" else {metric: found[metric] for metric in ("rms_m", "max_m", "vert_rms")}
    case = heli_case(scenario)
    return helicopter.metrics_ellipse(helicopter.fly(config, case, seed), case.path)


def _guarantee(variant: str, noise: str, seed: int) -> Metrics:
    from tools.papers.active import guarantee

    if variant in ("interval", "decoupled"):
        out: Metrics = {}
        for b_f in (0.12, 0.05):
            inside, width = guarantee.decoupled(b_f, seed)[variant]
            out |= {f"inside_pct b={b_f}": (inside, "%"), f"half_width b={b_f}": (width, "m/s^2")}
        return out
    name, _, b_model = variant.partition(" b=")
    run = guarantee.contain(name, noise, seed, b_model=float(b_model or 0.0))
    each = {f"half_width {row}": (float(w), "1/s^2 or m/s^2") for row, w in zip(guarantee.ROWS, run.half_width, strict=True)}
    error = {f"error {row}": (float(e), "1/s^2 or m/s^2") for row, e in zip(guarantee.ROWS, run.error, strict=True)}
    return {
        "inside_pct": (run.inside_pct, "%"),
        "half_width": (float(run.half_width.mean()), "mixed"),
        **each,
        **error,
        "empty": (float(run.empty), "1"),
        "inflations": (float(run.inflations), "1"),
    }


def _line_phases(config: str, seed: int) -> dict[str, Metrics]:
    from tools.papers.active import helicopter

    path = _path("heli-line")
    flown = helicopter.fly(config, helicopter.Case(path=path), seed)
    return {phase: helicopter.metrics_line(flown, path, COURSE_RAD, phase) for phase in helicopter.PHASES}


def quad_case(scenario: str, mode: str = "centre") -> "quadrotor.Case":
    """What a quad-* scenario flies."""
    from mavquad.airframe import ModelBounds
    from tools.papers.active import quadrotor

    changes: dict[str, dict[str, object]] = {
        "quad-ellipse-lead": {"lead_s": 0.15},
        "quad-ellipse-spikes": {"spikes": 0.02},
        "quad-ellipse-dropout": {"dropout_s": (20.0, 21.0)},
        "quad-ellipse-noimu": {"imu": False},
        "quad-ellipse-b0.05": {"bounds": ModelBounds(b_f_m_s2=0.05)},
        "quad-ellipse-b0.02": {"bounds": ModelBounds(b_f_m_s2=0.02)},
        "quad-ellipse-gust3": {"gust_m_s": 3.0},
        "quad-hover-light": {"mass_factor": 0.8},
    }
    return quadrotor.Case(path=_path(scenario), mode=mode, **changes.get(scenario, {}))


def heli_case(scenario: str) -> "helicopter.Case":
    """What a heli-ellipse* scenario flies."""
    from tools.papers.active import helicopter

    delay_s = 0.1 if "delay" in scenario else 0.0
    return helicopter.Case(
        path=_path(scenario), delay_s=delay_s, model_delay_s=0.0 if scenario.endswith("unknown") else delay_s
    )


@lru_cache(maxsize=32)
def _path(scenario: str) -> "surroundings.Path":
    from tools.papers.active import surroundings

    dt_s = 0.02
    if scenario == "heli-line":
        return surroundings.there_and_back(COURSE_RAD, dt_s)
    if scenario.startswith("heli"):
        return surroundings.ellipse(8.0, 60.0, dt_s, accel_m_s2=1.0)
    if "ellipse" in scenario:
        return surroundings.ellipse(8.0, 60.0, dt_s)
    if "line" in scenario:
        course = 0.0 if scenario.endswith("north") else math.radians(135.0)
        return surroundings.line(10.0 if "line10" in scenario else 12.0, course, dt_s)
    return surroundings.hover(60.0, dt_s)


def plan(scenarios: str, configs: str, seeds: list[int]) -> list[Job]:
    """The flights asked for. Raises ConfigError for a name that is not known."""
    chosen = _chosen(scenarios, list(PLAN), "scenario")
    named = _chosen(configs, sorted({c for names in PLAN.values() for c in names}), "config") if configs else []
    jobs: dict[Job, None] = {}
    for scenario in chosen:
        for config in PLAN[scenario]:
            if named and config not in named:
                continue
            flight = "heli-line" if scenario in ("heli-hover", "heli-leg1", "heli-leg2") else scenario
            jobs |= {(flight, config, seed): None for seed in seeds}
    if not jobs:
        raise ConfigError(f"--config {configs}: none of these is flown in {', '.join(chosen)}")
    return list(jobs)


def _chosen(text: str, known: list[str], what: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()] or known
    for name in names:
        if name not in known:
            raise ConfigError(f"--{what} {name!r} is not known; expected some of: {', '.join(known)}")
    return names


def table(rows: list[Row]) -> str:
    """Medians over the seeds, one line per scenario and config."""
    shown = ("rms_m", "max_m", "lat_rms", "vert_rms", "along_rms", "vel_rms", "inside_pct", "half_width", "empty", "inflations")
    cells: dict[tuple[str, str], dict[str, float]] = {}
    for one in rows:
        if one["seed"] is None:
            cells.setdefault((one["scenario"], one["config"]), {})[one["metric"]] = one["value"]
    lines = [f"{'scenario':27}{'config':29}" + "".join(f"{name:>11}" for name in shown) + "   (medians over the seeds)"]
    for (scenario, config), found in cells.items():
        values = "".join(f"{found[name]:11.3f}" if name in found else f"{'-':>11}" for name in shown)
        lines.append(f"{scenario:27}{config:29}{values}")
    return "\n".join(lines)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "example: mavquad paper asmf --scenario quad-ellipse,heli-ellipse --seeds 101-105 --report asmf.html"
    common.add_arguments(parser, seeds="101-105")
    parser.add_argument("--scenario", default="", help=f"only these, comma-separated: {', '.join(PLAN)}")
    parser.add_argument("--config", default="", help="only these, comma-separated, e.g. PI,ASMF,active")


def run(args: argparse.Namespace) -> int:
    seeds = common.parse_seeds(args.seeds)
    jobs = plan(args.scenario, args.config, seeds)
    wanted = set(_chosen(args.scenario, list(PLAN), "scenario"))
    for first in {job[0].partition("-")[0]: job for job in jobs}.values():
        job_rows(first)  # compiles once, before the workers start
    rows: list[Row] = []
    for i, found in enumerate(common.process_map(job_rows, jobs, processes=args.processes)):
        rows += [row for row in found if row["scenario"] in wanted]
        if (i + 1) % 50 == 0 or i + 1 == len(jobs):
            common.progress(f"{i + 1} of {len(jobs)} flights")
    rows += common.medians(rows)
    if args.report:
        from tools.papers.active import report

        args.report.write_text(report.page(rows, seeds[0]), encoding="utf-8")
        common.progress(f"report: {args.report}")
    if args.json:
        common.print_json("asmf", rows)
    else:
        sys.stdout.write(table(rows) + "\n")
    return 0
