"""The page of a campaign, from its SQLite file alone: distributions per variant, paired comparisons on the same seeds, worst flights.

Intervals are 95 % bootstrap intervals of the median over seeds (percentile, 2000 draws, seeded); pairs share scenario, personality
and seed, and so every draw; p is Wilcoxon's signed-rank test, two-sided, exact for few pairs, uncorrected for the number of comparisons.
"""

import math
import os
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wilcoxon

from mavquad.errors import LogError
from tools import page as html
from tools.campaigns.store import SCORES

Array = NDArray[Any]
UNITS = (("_m_s2", "m/s^2"), ("_us", "us"), ("_pct", "%"), ("_m", "m"), ("_s", "s"))
_HIGHER_IS_BETTER = ("disturbance_correlation", "inside_pct")
_NOT_OF_THE_FLIGHT = ("duration_s", "wall_s")
_WORST = 10
_DRAWS = 2000

Row = dict[str, Any]


class Pairing(NamedTuple):
    """One variant against the baseline in one case: per-seed differences and what they say."""

    case: str
    variant: str
    differences: Array  # variant - baseline, one per seed
    median: float
    low: float
    high: float
    better: int
    p: float  # NaN for fewer than six pairs


def read(path: Path) -> list[Row]:
    """The rows of a campaign's file. Raises LogError where it is none."""
    if not path.exists():
        raise LogError(f"{path}: no such file")
    try:
        db = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
        try:
            db.row_factory = sqlite3.Row
            rows = [dict(row) for row in db.execute("SELECT * FROM flights ORDER BY scenario, personality, variant, seed")]
        finally:
            db.close()
    except sqlite3.Error as error:
        raise LogError(f"{path}: no campaign's results: {error}; expected a file that mavquad campaign wrote") from None
    if not rows:
        raise LogError(f"{path}: holds no flight yet")
    return rows


def write(path: Path, out: Path | None = None, baseline: str | None = None) -> Path:
    """The page of a campaign's file, written beside it. Raises LogError."""
    rows = read(path)
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    base = baseline or next((name for name in ("pid", "pd", "adrc") if name in variants), variants[0])
    if base not in variants:
        raise LogError(f"{path}: no variant is called {base!r}; it holds {', '.join(variants)}")
    where = out or path.with_suffix(".html")
    metrics = _metrics(rows)
    sections = [
        ("Distributions", [piece for metric in metrics for piece in _distribution(rows, variants, metric)]),
        (
            f"Paired with {base}: same scenario, same seed",
            [piece for metric in metrics for piece in _paired(rows, variants, base, metric)],
        ),
        ("The worst flights", [_worst(rows, path, where)]),
        ("Every flight that was not ok", [_failed(rows)]),
        (
            "To repeat this",
            [
                html.code(f"mavquad report {path}"),
                html.text("Each flight alone: the command in its row of the tables above.", "quiet"),
            ],
        ),
    ]
    try:
        where.write_text(html.page(f"Campaign {path.stem}", sections, _lead(rows, variants, base)), encoding="utf-8")
    except OSError as error:
        raise LogError(f"{where}: cannot be written: {error.strerror}; choose another with --out") from None
    return where


def _metrics(rows: list[Row]) -> list[str]:
    """What differs between flights, in the order of the store."""
    found = []
    for name in SCORES:
        values = {row[name] for row in rows if row.get(name) is not None}
        if name not in _NOT_OF_THE_FLIGHT and len(values) > 1:
            found.append(name)
    return found


def unit(metric: str) -> str:
    """The unit of a column, by its name."""
    return next((unit for suffix, unit in UNITS if metric.endswith(suffix)), "")


def _case(row: Row) -> str:
    return " ".join(filter(None, (row["scenario"], row["personality"])))


def interval(values: Array) -> tuple[float, float, float]:
    """(median, low, high): the median over seeds with its 95 % bootstrap interval; one value has no interval."""
    x = np.asarray(values, float)
    if not x.size:
        return math.nan, math.nan, math.nan
    if x.size == 1:
        return float(x[0]), math.nan, math.nan
    rng = np.random.default_rng(1)
    medians = np.median(x[rng.integers(0, x.size, (_DRAWS, x.size))], axis=1)
    low, high = np.percentile(medians, [2.5, 97.5])
    return float(np.median(x)), float(low), float(high)


def pairings(rows: list[Row], variants: Sequence[str], base: str, metric: str) -> list[Pairing]:
    """Every variant against the baseline, case by case, over the seeds that both have flown."""
    values = {(_case(row), row["variant"], row["seed"]): row[metric] for row in rows if row[metric] is not None}
    found = []
    for case in dict.fromkeys(_case(row) for row in rows):
        for variant in variants:
            seeds = sorted({seed for c, v, seed in values if (c, v) == (case, variant)})
            pairs = [(values[case, variant, s], values[case, base, s]) for s in seeds if (case, base, s) in values]
            if variant == base or not pairs:
                continue
            d = np.array([a - b for a, b in pairs], float)
            better = int(np.sum(d > 0.0 if metric in _HIGHER_IS_BETTER else d < 0.0))
            p = float(wilcoxon(d).pvalue) if d.size >= 6 and np.any(d != 0.0) else math.nan
            found.append(Pairing(case, variant, d, *interval(d), better, p))
    return found


# ---- pieces ---------------------------------------------------------------------------------------------------------------
def _lead(rows: list[Row], variants: Sequence[str], base: str) -> str:
    good = sum(bool(row["ok"]) for row in rows)
    seeds = sorted({row["seed"] for row in rows})
    verdict = f"{good} of {len(rows)} flights went as they should."
    boxes = [
        ("flights", str(len(rows)), f"{len(rows) - good} not ok"),
        ("seeds", str(len(seeds)), f"{seeds[0]} to {seeds[-1]}"),
    ]
    for variant in variants:
        mine = np.array([row["rmse_m"] for row in rows if row["variant"] == variant and row["rmse_m"] is not None], float)
        median, low, high = interval(mine)
        span = f"95 %: {low:.3f} to {high:.3f} m" if math.isfinite(low) else "one flight"
        boxes.append(
            (f"position rmse, {variant}", f"{median:.3f} m" if math.isfinite(median) else "-", f"median of {mine.size}; {span}")
        )
    words = [_sentence(one, base) for one in pairings(rows, variants, base, "rmse_m")]
    how = (
        "How we know: every error is the simulated vehicle's true state against its path. Compared are flights of the same scenario and"
        " the same seed, which meet the same wind, noise and draws."
    )
    parts = [
        html.text(verdict, f"verdict {'good' if good == len(rows) else 'bad'}"),
        html.cards(boxes),
        html.text(how, "quiet"),
    ]
    return "".join([*parts, *(html.text(line) for line in words)])


def _sentence(one: Pairing, base: str) -> str:
    n = one.differences.size
    if math.isfinite(one.low):
        told = f"{one.median:+.3f} m position rmse (95 %: {one.low:+.3f} to {one.high:+.3f})"
    else:
        told = f"{one.median:+.3f} m position rmse"
    verdict = (
        "no clear difference"
        if not math.isfinite(one.low) or one.low <= 0.0 <= one.high
        else ("better" if one.median < 0.0 else "worse")
    )
    return f"{one.case}: {one.variant} against {base} {told}, better in {one.better} of {n} seeds: {verdict}."


def _distribution(rows: list[Row], variants: Sequence[str], metric: str) -> list[str]:
    cases = list(dict.fromkeys(_case(row) for row in rows))
    traces, lines = [], []
    for k, variant in enumerate(variants):
        mine = [row for row in rows if row["variant"] == variant and row[metric] is not None]
        if mine:
            seeds = [f"seed {row['seed']}" for row in mine]
            traces.append(html.boxes(variant, [_case(row) for row in mine], [row[metric] for row in mine], k % 7, seeds))
        for case in cases:
            x = np.array([row[metric] for row in mine if _case(row) == case], float)
            if x.size:
                median, low, high = interval(x)
                lines.append([case, variant, int(x.size), median, low, high, float(x.min()), float(x.max())])
    heads = ["case", "variant", "flights", f"median, {unit(metric)}".rstrip(", "), "95 % from", "to", "least", "most"]
    figure = html.figure(
        metric, traces, y=unit(metric), height=320, boxmode="group", hovermode="closest", xaxis={"type": "category"}, showlegend=True
    )  # fmt: skip
    return [figure, html.table(heads, lines)]


def _paired(rows: list[Row], variants: Sequence[str], base: str, metric: str) -> list[str]:
    found = pairings(rows, variants, base, metric)
    if not found:
        return []
    traces = []
    for k, variant in enumerate(variants):
        mine = [one for one in found if one.variant == variant]
        if mine:
            x = [one.case for one in mine for _ in one.differences]
            traces.append(html.boxes(variant, x, np.concatenate([one.differences for one in mine]), k % 7))
    figure = html.figure(
        f"{metric}: less that of {base} in the same flight", traces, y=unit(metric), height=300, boxmode="group", hovermode="closest",
        xaxis={"type": "category"}, showlegend=True,
    )  # fmt: skip
    heads = [
        "case",
        "variant",
        f"{metric}, median difference, {unit(metric)}".rstrip(", "),
        "95 % from",
        "to",
        "better in",
        "of seeds",
        "Wilcoxon p",
    ]
    lines = [[o.case, o.variant, o.median, o.low, o.high, o.better, int(o.differences.size), o.p] for o in found]
    return [figure, html.table(heads, lines)]


def _worst(rows: list[Row], path: Path, page: Path) -> str:
    """The largest errors, each linked to its own report where its run folder was kept, and with the command that repeats it."""
    known = [row for row in rows if row.get("max_error_m") is not None]
    known.sort(key=lambda row: (bool(row["ok"]), -row["max_error_m"]))
    lines = []
    for row in known[:_WORST]:
        report = _report(path.with_name(f"{path.name}.runs") / row["id"])
        name = f"{_case(row)} {row['variant']} seed {row['seed']}"
        target = Path(os.path.relpath(report, page.parent)).as_posix() if report else ""
        label: Any = html.link(name, target) if report else name
        lines.append([label, bool(row["ok"]), row["rmse_m"], row["max_error_m"], row["command"]])
    note = "" if any(isinstance(line[0], html.Markup) for line in lines) else html.text(
        "No run folder was kept: fly the campaign with --keep failed or --keep all, or repeat a flight by its command.", "quiet"
    )  # fmt: skip
    return note + html.table(["flight", "ok", "rmse, m", "largest error, m", "repeats it"], lines)


def _report(run: Path) -> Path | None:
    """The page of a kept run folder, drawn now where it is not there yet."""
    from tools import report

    page = run / "report.html"
    if page.exists():
        return page
    try:
        return report.flight(run)
    except LogError:
        return None


def _failed(rows: list[Row]) -> str:
    bad = [
        [f"{_case(row)} {row['variant']} seed {row['seed']}", row["problem"], row["command"]] for row in rows if not row["ok"]
    ]
    if not bad:
        return html.text("None.", "quiet")
    return html.table(["flight", "why", "repeats it"], bad[:200])
