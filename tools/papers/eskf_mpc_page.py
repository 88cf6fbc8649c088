"""The page of `mavquad paper eskf-mpc`: the tables, figures 4-10 of the paper, and what reproduces."""

import math
from collections.abc import Sequence

from tools import page
from tools.papers import eskf_mpc
from tools.papers.common import Row

_METRICS = ("rmse_n", "rmse_e", "rmse_d", "ss_3d", "full_3d", "f_rmse", "overshoot")
_AXES, _ANGLES = ("north", "east", "down"), ("roll", "pitch", "yaw")


def page_of(rows: Sequence[Row], seed: int) -> str:
    """The whole page: `rows` as the command found them, figures from one seed."""
    lead = page.text(
        "Paper 003 in Dryden turbulence, with its baselines and ablations. Means over the seeds; a flight is lost beyond 80 deg of tilt"
        " or 60 m. ADRC's own gains are printed nowhere: Han's are flown, so its numbers are not the paper's."
    )
    return page.page("mavquad: eskf-mpc (paper 003)", [_claims(rows), *_tables(rows), *_figures(seed)], lead)


def _mean(rows: Sequence[Row], scenario: str, config: str, metric: str) -> float:
    for one in rows:
        if (one["scenario"], one["config"], one["metric"]) == (scenario, config, metric) and one.get("stat") in ("mean", "sum"):
            return float(one["value"])
    return math.nan


def _claims(rows: Sequence[Row]) -> tuple[str, list[str]]:
    """What the paper claims beside what these rows say; only claims whose rows were flown."""

    def ss(scenario: str, config: str) -> float:
        return _mean(rows, scenario, config, "ss_3d")

    def lost(scenario: str, config: str) -> float:
        return _mean(rows, scenario, config, "lost")

    claims = [
        ("ADRC is lost above a variance of 1e-4 ...", lost("S1-A", "ADRC") > 0, lost("S1-A", "ADRC")),
        ("... and the method is not", lost("S1-A", "PB") == 0, lost("S1-A", "PB")),
        (
            "feed-forward of the estimate is essential (ratio without)",
            True,
            ss("S1-B", "PB-no-position-compensation") / ss("S1-B", "PB"),
        ),
        ("at 1e-4 ADRC is 0.013 m worse in 3-D (difference here, full)", False, _full(rows, "S1-B")),
        ("beyond the paper: the default over the printed method at 1e-4", True, ss("S1-B", "PB") / ss("S1-B", "default")),
        (
            "beyond the paper: prediction over none at 60 ms",
            True,
            ss("S2-60ms", "default") / ss("S2-60ms-predicted", "default"),
        ),
        ("beyond the paper: overshoot with planned constraints over without", True, _overshoot(rows)),
    ]
    known = [(words, "yes" if holds else "no", value) for words, holds, value in claims if math.isfinite(value)]
    return "What reproduces", [page.table(["claim", "holds", "measured"], known)] if known else []


def _full(rows: Sequence[Row], scenario: str) -> float:
    return _mean(rows, scenario, "ADRC", "full_3d") - _mean(rows, scenario, "PB", "full_3d")


def _overshoot(rows: Sequence[Row]) -> float:
    return _mean(rows, "S3", "default", "overshoot") / _mean(rows, "S3", "closed", "overshoot")


def _tables(rows: Sequence[Row]) -> list[tuple[str, list[str]]]:
    sections = []
    for scenario in dict.fromkeys(one["scenario"] for one in rows if one["seed"] is None):
        configs = dict.fromkeys(one["config"] for one in rows if one["scenario"] == scenario)
        shown = [m for m in _METRICS if any(math.isfinite(_mean(rows, scenario, c, m)) for c in configs)]
        lines = [
            [c, *(_cell(_mean(rows, scenario, c, m)) for m in shown), f"{_mean(rows, scenario, c, 'lost'):.0f}"]
            for c in configs
        ]
        sections.append((scenario, [page.table(["config", *shown, "lost"], lines)]))
    return sections


def _cell(value: float) -> str:
    return f"{value:.4f}" if math.isfinite(value) else "-"


def _figures(seed: int) -> list[tuple[str, list[str]]]:
    method_a = eskf_mpc.fly("S1-A", "PB", seed).log
    method_b, adrc_b = (eskf_mpc.fly("S1-B", config, seed).log for config in ("PB", "ADRC"))
    default_b = eskf_mpc.fly("S1-B", "default", seed).log
    t = method_a[:, 0]

    def position(title: str, flown: list[tuple[str, object]]) -> list[str]:
        return [
            page.figure(
                f"{title}: {axis}",
                [page.line("reference", t, method_a[:, 4 + i], 6, dash="dash")]
                + [page.line(name, t, log[:, 1 + i], j) for j, (name, log) in enumerate(flown)],  # type: ignore[index]
                x="s",
                y="m",
                linked=title,
            )
            for i, axis in enumerate(_AXES)
        ]

    def attitude(title: str, log: object) -> list[str]:
        return [
            page.figure(
                f"{title}: {angle}",
                [
                    page.line("measured", t, log[:, 16 + i], 5, width=0.7),  # type: ignore[index]
                    page.line("wanted", t, log[:, 10 + i], 6),  # type: ignore[index]
                    page.line("true", t, log[:, 7 + i], 0),  # type: ignore[index]
                ],
                x="s",
                y="rad",
                linked=title,
            )
            for i, angle in enumerate(_ANGLES)
        ]

    def wind(title: str, log: object) -> list[str]:
        return [
            page.figure(
                f"{title}: {axis}",
                [page.line("estimated", t, log[:, 19 + i], 0, width=0.7), page.line("true", t, log[:, 25 + i], 1)],  # type: ignore[index]
                x="s",
                y="m/s^2",
                linked=title,
            )
            for i, axis in enumerate(_AXES)
        ]

    both = [("printed ESKF-MPC (PB)", method_b), ("ADRC", adrc_b), ("default", default_b)]
    return [
        (f"Figure 4: position, noise 0.01 / 0.001, seed {seed}", position("PB", [("printed ESKF-MPC (PB)", method_a)])),
        ("Figure 5: attitude, noise 0.01 / 0.001", attitude("PB", method_a)),
        ("Figure 6: position, noise 1e-4", position("noise 1e-4", both)),
        ("Figure 7: attitude of the method, noise 1e-4", attitude("PB, noise 1e-4", method_b)),
        ("Figure 8: attitude of ADRC, noise 1e-4", attitude("ADRC, noise 1e-4", adrc_b)),
        ("Figure 9: disturbance estimated by the method", wind("PB, disturbance", method_b)),
        ("Figure 10: disturbance estimated by ADRC", wind("ADRC, disturbance", adrc_b)),
    ]
