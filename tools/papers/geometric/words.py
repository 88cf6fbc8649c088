"""The rows for people: tables as text, and which of the paper's claims hold."""

import math
from collections.abc import Sequence

from tools.papers.common import Row

TITLES = {
    "8.1": "8.1  noise-free, torque known, exact start, t in [1, 20] s",
    "8.2": "8.2  general start, convergence, robustness",
    "8.3": "8.3  noise [deg per axis], torque known (k), unknown (u), 20 % too large",
    "8.4": "8.4  order of the integrators, attitude error [rad] after 5 s by step",
    "8.5": "8.5  bias [rad/s] in a constant spin, by step and spin",
    "tumble": "tumble  start at (15, -10, 12) rad/s",
    "gap": "gap  largest rate error [rad/s] where samples are missing",
    "recording": "recording  of a real autopilot, against the zero-phase rate",
    "mocap": "mocap  a flight of ours, torque unknown, against the truth",
}


def column(r: Row) -> str:
    """What tells this figure from the others of its configuration."""
    parts = [str(r["metric"])]
    if "torque" in r:
        parts.append({"known": "k", "unknown": "u"}.get(r["torque"], str(r["torque"])))
    parts += [f"{r[key]:g}" for key in ("noise_deg", "tau_s", "h_s", "spin_rad_s") if key in r]
    return " ".join(parts)


def figure(value: float) -> str:
    """Four digits, or what it is."""
    if math.isinf(value):
        return "never"
    return f"{value:.4f}" if 1e-3 <= abs(value) < 1e3 else f"{value:.2g}"


def pivot(rows: Sequence[Row], scenario: str) -> tuple[list[str], list[list[str]]]:
    """(heads, lines): one line per configuration, one column per figure, of the rows that stand for all seeds."""
    found = [r for r in rows if r["scenario"] == scenario and r["seed"] is None]
    columns = list(dict.fromkeys(column(r) for r in found))
    cells = {(r["config"], column(r)): figure(r["value"]) + _setting(r) for r in found}
    configs = list(dict.fromkeys(r["config"] for r in found))
    return ["config", *columns], [[c, *(cells.get((c, k), "") for k in columns)] for c in configs]


def _setting(r: Row) -> str:
    return f" ({r['setting']})" if r.get("setting") else ""


def tables(rows: Sequence[Row]) -> str:
    """All tables as text."""
    out = []
    for scenario, title in TITLES.items():
        heads, lines = pivot(rows, scenario)
        if not lines:
            continue
        out.append(f"\n{title}")
        per = 7  # columns side by side on a screen
        for first in range(1, len(heads), per):
            shown = [0, *range(first, min(first + per, len(heads)))]
            kept = [line for line in lines if any(line[i] for i in shown[1:])]
            widths = [max(len(heads[i]), *(len(line[i]) for line in kept)) for i in shown]
            for line in ([heads], kept):
                out += ["  ".join(one[i].ljust(w) for i, w in zip(shown, widths, strict=True)).rstrip() for one in line]
            out.append("")
    return "\n".join(out)


def value(rows: Sequence[Row], scenario: str, config: str, metric: str, **more: object) -> float:
    """One figure that stands for all seeds; NaN where it was not computed."""
    for r in rows:
        same = r["scenario"] == scenario and r["config"] == config and r["metric"] == metric and r["seed"] is None
        if same and all(r.get(k) == v for k, v in more.items()):
            return float(r["value"])
    return math.nan


def claims(rows: Sequence[Row]) -> list[str]:
    """The paper's claims and ours, each with the figures that decide it; those whose figures are missing are left out."""

    def get(scenario: str, config: str, metric: str, **more: object) -> float:
        return value(rows, scenario, config, metric, **more)

    def verdict(holds: bool) -> str:
        return "holds" if holds else "does not hold"

    out: list[tuple[float, str]] = []
    drift = get("8.1", "G1", "norm_drift")
    out.append((drift, f"The norm is kept without renormalisation: {verdict(drift < 1e-12)} ({drift:.0e} over 20 s)."))
    ours, theirs = get("8.2", "G2", "raw_rms"), get("8.2", "B1c", "raw_rms")
    text = f"(general start, raw: Lie group {ours:.4f}, Runge-Kutta with renormalisation {theirs:.4f} rad/s)"
    out.append((ours + theirs, f"Forced rescaling reduces tracking accuracy: {verdict(theirs > 1.1 * ours)} {text}."))
    known = get("8.1", "G2", "raw_rms")
    low_pass = get("8.3", "B3", "raw_rms", noise_deg=0.1, torque="unknown")
    unknown = get("8.3", "G2", "raw_rms", noise_deg=0.1, torque="unknown")
    text = f"{known:.4f} rad/s raw with the torque known, all of it chatter"
    out.append((known, f"The observer tracks the rates well with the torque known: {verdict(known < 0.1)} ({text})."))
    text = f"({unknown:.3f} against {low_pass:.3f} rad/s of a difference and a 5 Hz low-pass, 0.1 deg noise)"
    out.append((unknown + low_pass, f"... with the torque unknown: {verdict(unknown < low_pass)} {text}."))
    bias, forced = (get("8.5", c, "bias", h_s=0.01, spin_rad_s=35.0) for c in ("Cayley", "Euler + renorm"))
    text = f"{bias:.4f} against {forced:.4f} rad/s of bias at 35 rad/s and 10 ms: {forced / bias:.1f} times less"
    out.append((bias + forced, f"What the Cayley map does buy: {text}; the exponential map has none."))
    third = get("8.3", "tuned implicit third order", "raw_rms", noise_deg=0.5, torque="unknown")
    kalman = get("8.3", "tuned MEKF 9 states", "raw_rms", noise_deg=0.5, torque="unknown")
    bank = get("8.3", "online", "raw_rms", noise_deg=0.5, torque="unknown")
    text = f"bank {bank:.4f}, third order tuned {third:.4f}, Kalman filter tuned {kalman:.4f} rad/s"
    out.append((third + kalman + bank, f"Torque unknown, 0.5 deg: {text}; the bank was told nothing."))
    real, line = (get("recording", c, "raw_rms") for c in ("online", "extrapolated difference"))
    text = f"{real:.4f} against {line:.4f} rad/s of the extrapolated difference"
    out.append((real + line, f"On the recording the bank beats differences: {verdict(real <= line)} ({text})."))
    return [text for number, text in out if not math.isnan(number)]
