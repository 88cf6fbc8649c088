"""mavquad paper identification: the hover models of paper 004 recovered from simulated sweeps, beside the recipe as printed.

Scenarios: `noise-free` and `noisy` recover REF, `table1` the printed Table 1, `start-values` compares searches from good and bad
starts, `recipe` what each ingredient is worth, `verification` predicts records that were not used.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from mavquad.errors import ConfigError
from mavquad.identify import fit, spectrum, start, structures, verify
from mavquad.identify.fit import Cost, Fit
from mavquad.identify.spectrum import Record, Response
from tools.papers import common, hover_records
from tools.papers.common import Row
from tools.papers.hover_records import Case

PAPER = "identification"
GRID_RAD_S = spectrum.log_grid(0.4, 45.0)
CONFIGS = {
    "noise-free": ("REF-lon", "REF-lat", "REF-yaw"),
    "noisy": ("REF-lon", "REF-lat", "REF-yaw"),
    "table1": ("T1-lon", "T1-lat"),
    "start-values": ("REF-lon", "REF-lat", "T1-lon", "T1-lat"),
    "recipe": ("REF-lon",),
    "verification": ("REF-lon",),
}
RESPONSE_SEED = 100  # whose response the searches of start-values are tried on
DRAWS = 30


class Job(NamedTuple):
    scenario: str
    config: str
    seed: int


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_arguments(parser, seeds="100-109")
    parser.add_argument("--scenario", choices=list(CONFIGS), action="append", help="only this scenario (may be repeated)")
    parser.add_argument(
        "--config", choices=sorted({c for each in CONFIGS.values() for c in each}), action="append", help="only this"
    )
    parser.epilog = "example: mavquad paper identification --scenario noisy --seeds 1-3 --json"


def run(args: argparse.Namespace) -> int:
    seeds = common.parse_seeds(args.seeds)
    jobs = [
        Job(scenario, config, seed)
        for scenario, configs in CONFIGS.items()
        if args.scenario is None or scenario in args.scenario
        for config in configs
        if args.config is None or config in args.config
        for seed in _seeds(scenario, seeds)
    ]
    if not jobs:
        raise ConfigError(f"--scenario {args.scenario} has no --config {args.config}; see --help for what goes together")
    rows: list[Row] = []
    for done, (job, found) in enumerate(zip(jobs, common.process_map(rows_of, jobs, processes=args.processes), strict=True), 1):
        rows += found
        common.progress(f"[{done}/{len(jobs)}] {job.scenario} {job.config} seed {job.seed}")
    rows += common.medians(rows) + honesty(rows)
    if args.report:
        from tools.papers import identification_page

        args.report.write_text(identification_page.page_of(rows, seeds[0]), encoding="utf-8")
        common.progress(f"report: {args.report}")
    if args.json:
        common.print_json(PAPER, rows)
    else:
        print(table(rows))
    return 0


def rows_of(job: Job) -> list[Row]:
    """All figures of one scenario, model and seed."""
    case = hover_records.case(job.config)
    return _SCENARIOS[job.scenario](case, job)


def _seeds(scenario: str, seeds: list[int]) -> list[int]:
    return {"noise-free": seeds[:1], "start-values": [RESPONSE_SEED]}.get(scenario, seeds)


# ---- recovery --------------------------------------------------------------------------------------------------------
def response_of(case: Case, seed: int, *, noisy: bool = True) -> Response:
    return spectrum.lpm(hover_records.sweeps(case, seed, noisy=noisy), GRID_RAD_S)


def errors_pct(case: Case, found: Fit) -> dict[str, float]:
    return {n: 100.0 * abs(found.parameters[n] - case.parameters[n]) / abs(case.parameters[n]) for n in case.structure.free}


def _recovered(case: Case, job: Job) -> list[Row]:
    records = hover_records.sweeps(case, job.seed, noisy=job.scenario != "noise-free")
    begun = time.process_time()
    response = spectrum.lpm(records, GRID_RAD_S)
    found = fit.fit(case.structure, response)
    spent = time.process_time() - begun

    def row(metric: str, unit: str, value: float) -> Row:
        return common.row(job.scenario, job.config, job.seed, metric, unit, float(value))

    rows = [row(f"err_pct:{name}", "%", value) for name, value in errors_pct(case, found).items()]
    for kind, spreads in (("cr_pct", found.bound), ("sd_pct", found.sd)):
        named = zip(found.structure.free, spreads, strict=True)
        rows += [row(f"{kind}:{name}", "%", 100.0 * sd / abs(case.parameters[name])) for name, sd in named]
    rows += [
        row("chi2", "", found.chi2),
        row("J", "", found.j),
        row("agreeing_starts", "", found.agreeing),
        row("cpu_s", "s", spent),
    ]
    if job.config == "REF-lon":
        continuous = fit.fit(case.structure, response, starts=[found.theta], sampled=False)
        rows.append(
            row("tau_f_bias_pct:continuous", "%", 100.0 * (continuous.parameters["tau_f"] / case.parameters["tau_f"] - 1.0))
        )
    return rows


def honesty(rows: Sequence[Row]) -> list[Row]:
    """Root mean square error over the seeds against the median bar, for both kinds: 1 where the error bars are honest."""
    found = []
    for scenario, config in dict.fromkeys((r["scenario"], r["config"]) for r in rows if r["scenario"] != "noise-free"):
        by_metric: dict[str, list[float]] = {}
        for r in rows:
            if (r["scenario"], r["config"]) == (scenario, config) and r["seed"] is not None:
                by_metric.setdefault(r["metric"], []).append(r["value"])
        for bar in ("cr", "sd"):
            for metric, values in by_metric.items():
                kind, _, name = metric.partition(":")
                bars = by_metric.get(f"{bar}_pct:{name}", [])
                if kind == "err_pct" and len(values) > 1 and len(bars) == len(values):
                    ratio = float(np.sqrt(np.mean(np.square(values))) / np.median(bars))
                    found.append(common.row(scenario, config, None, f"rms_error_over_{bar}:{name}", "", ratio, "rms"))
    return found


# ---- searches --------------------------------------------------------------------------------------------------------
def secant(task: fit.Problem, theta: np.ndarray, *, alpha: float = 1.0, steps: int = 80) -> np.ndarray:
    """The paper's secant search (Broyden's update of the Jacobian, no trust region), kept inside the bounds.

    `alpha` relaxes each step, Eqs. (23)-(24).
    """
    lo, hi = structures.limits(task.structure)
    r, slope = fit.residuals(task, theta, "cifer"), fit.jacobian(task, theta, "cifer")
    for _ in range(steps):
        move = np.clip(theta - alpha * (np.linalg.pinv(slope) @ r), lo, hi) - theta
        if not np.all(np.isfinite(move)) or np.max(np.abs(theta + move)) > 1e6:
            return theta
        after = fit.residuals(task, theta + move, "cifer")
        slope = slope + np.outer(after - r - slope @ move, move) / max(float(move @ move), 1e-300)
        theta, r = theta + move, after
        if np.max(np.abs(move) / np.maximum(np.abs(theta), 0.05)) < 1e-6:
            break
    return theta


def trust_region(task: fit.Problem, theta: np.ndarray) -> np.ndarray:
    """Trust region on Eq. (17) from one start."""
    return fit.minimise(task, theta, "cifer")[0]


def _start_values(case: Case, job: Job) -> list[Row]:
    response = response_of(case, job.seed)
    task = fit.problem(case.structure, response)
    truth = structures.theta_of(case.structure, case.parameters)
    regression = fit.ranked_starts(task, start.families(case.structure, response))

    def least(cost: Cost) -> float:
        return min(fit.minimise(task, theta, cost)[1] for theta in [*regression, truth])

    limits: dict[Cost, float] = {"cifer": 1.2 * least("cifer") + 0.5, "ml": 1.2 * least("ml")}

    def succeeds(theta: np.ndarray, cost: Cost = "cifer") -> bool:
        return bool(np.all(np.isfinite(theta)) and fit.cost_of(task, theta, cost) < limits[cost])

    rng = np.random.default_rng(job.seed)
    bad = [
        truth * np.exp(rng.standard_normal(truth.size)) * np.where(rng.random(truth.size) < 0.3, -1.0, 1.0)
        for _ in range(DRAWS)
    ]
    near = [truth * rng.uniform(0.8, 1.2, truth.size) for _ in range(DRAWS)]
    lo, hi = structures.limits(case.structure)

    def share(search: Callable[[np.ndarray], np.ndarray], starts: Sequence[np.ndarray]) -> float:
        return 100.0 * float(np.mean([succeeds(search(np.clip(theta, lo, hi))) for theta in starts]))

    def row(metric: str, value: float) -> Row:
        return common.row(job.scenario, job.config, job.seed, metric, "%", value)

    with np.errstate(all="ignore"):
        ours = fit.fit(case.structure, response)
        return [
            row("success_pct", 100.0 * succeeds(ours.theta, "ml")),
            row("success_pct:secant-bad", share(lambda t: secant(task, t), bad)),
            row("success_pct:secant-bad-relaxed", share(lambda t: secant(task, t, alpha=0.3), bad)),
            row("success_pct:trf-bad", share(lambda t: trust_region(task, t), bad)),
            row("success_pct:secant-near", share(lambda t: secant(task, t), near)),
            row("success_pct:trf-near", share(lambda t: trust_region(task, t), near)),
            row("success_pct:secant-regression", 100.0 * any(succeeds(secant(task, t)) for t in regression[:5])),
            row("success_pct:trf-regression", 100.0 * any(succeeds(trust_region(task, t)) for t in regression[:5])),
        ]


# ---- what each ingredient is worth -----------------------------------------------------------------------------------
class Recipe(NamedTuple):
    """How a response is estimated and fitted; the first is the paper's own."""

    name: str
    paper_sweep: bool
    windows_s: tuple[float, ...]  # empty: local polynomial method
    joint: bool
    sampled: bool
    cost: Cost


RECIPES = (
    Recipe("paper", True, (1.0,), False, False, "cifer"),
    Recipe("paper-sweep-lpm", True, (), True, True, "cifer"),
    Recipe("welch-direct", False, (8.0, 16.0, 32.0), False, True, "cifer"),
    Recipe("welch-joint", False, (8.0, 16.0, 32.0), True, True, "cifer"),
    Recipe("lpm-continuous", False, (), True, False, "cifer"),
    Recipe("lpm-sampled", False, (), True, True, "cifer"),
    Recipe("lpm-sampled-ml", False, (), True, True, "ml"),
)


def _recipes(case: Case, job: Job) -> list[Row]:
    rows = []
    truth = structures.theta_of(case.structure, case.parameters)
    near = truth * np.random.default_rng(job.seed).uniform(0.8, 1.2, truth.size)
    ours, theirs = hover_records.sweeps(case, job.seed), hover_records.paper_sweeps(case, job.seed)
    for recipe in RECIPES:
        response = estimated(recipe, theirs if recipe.paper_sweep else ours)
        found = fit.fit(case.structure, response, starts=[near], cost=recipe.cost, sampled=recipe.sampled)
        config = f"{job.config}/{recipe.name}"
        rows += [common.row(job.scenario, config, job.seed, f"err_pct:{n}", "%", e) for n, e in errors_pct(case, found).items()]
        rows += [common.row(job.scenario, config, job.seed, "J", "", found.j)]
    return rows


def estimated(recipe: Recipe, records: Sequence[Record]) -> Response:
    """The response of one recipe, over the grid as far as its sweep and its windows reach."""
    lowest = 2.0 * np.pi if recipe.paper_sweep else 0.0
    grid = GRID_RAD_S[lowest <= GRID_RAD_S]
    if not recipe.windows_s:
        return spectrum.lpm(records, grid)
    grid = grid[grid >= 4.0 * np.pi / max(recipe.windows_s)]
    return spectrum.welch(records, grid, recipe.windows_s, overlap=0.8, joint=recipe.joint)


# ---- time domain -----------------------------------------------------------------------------------------------------
def doublets(case: Case, seed: int, size: float = 0.15, span_s: float = 20.0) -> tuple[Record, np.ndarray]:
    """A record of doublets on the first input (2 s each way), and its true states: not used for any fit."""
    rng = np.random.default_rng(10_000 + seed)
    t = np.arange(round(span_s / hover_records.DT_S)) * hover_records.DT_S
    r = np.zeros((t.size, 2))
    r[:, 0] = size * np.where(t % 4.0 < 2.0, 1.0, -1.0)
    y, u, states = hover_records.flown(case, r, rng)
    return Record(hover_records.DT_S, r, u, y), states


def candidates(case: Case, response: Response) -> dict[str, np.ndarray]:
    """The models that predict: the truth, both estimates, and the best regression start."""
    task = fit.problem(case.structure, response)
    starts = fit.ranked_starts(task, start.families(case.structure, response))
    return {
        "true": structures.theta_of(case.structure, case.parameters),
        "ml": fit.fit(case.structure, response, starts=starts).theta,
        "eq17": fit.fit(case.structure, response, starts=starts, cost="cifer").theta,
        "regression": starts[0],
    }


def _verified(case: Case, job: Job) -> list[Row]:
    record, states = doublets(case, job.seed)
    rows = []
    for name, theta in candidates(case, response_of(case, job.seed)).items():
        model = case.structure.build(structures.values(case.structure, theta))
        for how, given in (("", None), ("/true-start", states)):
            found = verify.check(model, record, states=given)
            for i, output in enumerate(model.outputs):
                config = f"{job.config}/{name}{how}"
                rows.append(common.row(job.scenario, config, job.seed, f"fit_pct:{output}", "%", float(found.fit_pct[i])))
                rows.append(common.row(job.scenario, config, job.seed, f"tic:{output}", "", float(found.tic[i])))
    return rows


_SCENARIOS = {
    "noise-free": _recovered,
    "noisy": _recovered,
    "table1": _recovered,
    "start-values": _start_values,
    "recipe": _recipes,
    "verification": _verified,
}


def table(rows: Sequence[Row]) -> str:
    """Medians, one line per scenario and config, for a terminal."""
    lines = []
    for scenario, config in dict.fromkeys((r["scenario"], r["config"]) for r in rows):
        own = [r for r in rows if (r["scenario"], r["config"], r["seed"]) == (scenario, config, None)]
        lines.append(f"{scenario} {config}")
        kinds: dict[str, list[str]] = {}
        for r in own:
            kind, _, name = r["metric"].partition(":")
            kinds.setdefault(kind, []).append(f"{name + ' ' if name else ''}{r['value']:.3g}")
        lines += [f"  {kind:18s} {'  '.join(entries)}" for kind, entries in kinds.items()]
    return "\n".join(lines)
