"""Statistics of a campaign: medians over seeds with their range, and ratios paired by scenario, personality and seed."""

import math
import statistics
from typing import Any

from tools.campaigns.grid import Campaign

Row = dict[str, Any]


def cells(campaign: Campaign, rows: list[Row]) -> list[Row]:
    """One row per metric, scenario, personality and variant: median, min, max over seeds; the paired ratio to the baseline.

    ratio is the median over seeds of variant / baseline, better how many of `pairs` are below 1. None: not known.
    """
    found = []
    for metric in campaign.metrics:
        values = {_key(row): row[metric] for row in rows if row[metric] is not None}
        for case in campaign.scenario:
            for personality in campaign.personalities or ("",):
                for variant in campaign.variant:
                    where = (case.name, personality, variant.name)
                    mine = {key[3]: value for key, value in values.items() if key[:3] == where}
                    flown = [row for row in rows if _key(row)[:3] == where]
                    base = {k[3]: v for k, v in values.items() if k[:3] == (case.name, personality, campaign.baseline)}
                    ratios = [mine[s] / base[s] for s in mine if base.get(s)]
                    found.append(
                        {
                            "metric": metric,
                            "scenario": case.name,
                            "personality": personality,
                            "variant": variant.name,
                            "flown": len(flown),
                            "ok": sum(row["ok"] for row in flown),
                            "known": len(mine),
                            "median": statistics.median(mine.values()) if mine else None,
                            "min": min(mine.values(), default=None),
                            "max": max(mine.values(), default=None),
                            "ratio": statistics.median(ratios) if ratios else None,
                            "better": sum(ratio < 1.0 for ratio in ratios),
                            "pairs": len(ratios),
                        }
                    )
    return found


def text(campaign: Campaign, found: list[Row]) -> str:
    """A table for each metric, variants down and scenarios across: median (min - max), x the ratio to the baseline."""
    tables = []
    for metric in campaign.metrics:
        columns = [(case.name, p) for case in campaign.scenario for p in campaign.personalities or ("",)]
        lines = [[metric, *(" ".join(filter(None, column)) for column in columns)]]
        for variant in campaign.variant:
            mine = {
                (c["scenario"], c["personality"]): c for c in found if (c["metric"], c["variant"]) == (metric, variant.name)
            }
            lines.append([variant.name, *(_cell(mine[column], variant.name == campaign.baseline) for column in columns)])
        widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
        tables.append(
            "\n".join("  ".join(f"{word:<{w}}" for word, w in zip(line, widths, strict=True)).rstrip() for line in lines)
        )
    return "\n\n".join(tables)


def _cell(cell: Row, is_baseline: bool) -> str:
    if not cell["known"]:
        return "-" if not cell["flown"] else f"- of {cell['flown']}"
    words = f"{_n(cell['median'])} ({_n(cell['min'])} - {_n(cell['max'])})"
    if cell["ratio"] is not None and not is_baseline:
        words += f" x{cell['ratio']:.2f}"
    bad = cell["flown"] - cell["ok"]
    return f"{words} {bad} not ok" if bad else words


def _key(row: Row) -> tuple[str, str, str, int]:
    return row["scenario"], row["personality"], row["variant"], row["seed"]


def _n(value: float) -> str:
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{digits}f}"
