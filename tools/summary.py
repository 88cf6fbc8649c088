"""`summary.json` of a flight: what was flown, how well, and what failed; and the same as a table for people."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from mavquad import paths
from mavquad.errors import LogError
from mavquad.lifecycle import ENGAGED, STATES
from mavquad.link.columns import Log
from mavquad.settings import Companion
from tools import score
from tools.flight import Flown
from tools.scenarios import Resolved
from tools.trace import Trace, read_trace

ENGAGED_STATE = float(STATES.index(ENGAGED))


def path_duration_s(companion: Companion) -> float:
    """From the engagement to the end of the path."""
    return companion.settle_s + paths.plan(companion.path).duration_s


def summarise(run: Path, name: str, resolved: Resolved, flown: Flown, command: str, lockstep: bool) -> dict[str, Any]:
    """Score a flown flight and write its summary.json. Nothing in it is NaN: what is not known is null."""
    companion = resolved.companion
    failures = list(flown.problems)
    scores: dict[str, Any] = {}
    try:
        scores = _scores(run, resolved)
    except LogError as error:
        if not failures:  # else they say why
            failures.append(str(error))
    said, sitl = flown.companion, flown.sitl
    result: dict[str, Any] = {
        "scenario": name,
        "seed": resolved.sitl.seed,
        "vehicle": companion.airframe,
        "personality": resolved.sitl.personality,
        "attitude": resolved.sitl.attitude_source,
        "controller": companion.controller,
        "estimator": companion.estimator,
        "compensator": companion.compensator,
        "loop": companion.loop,
        "command": command,
        "duration_s": sitl.get("sim_time_s"),
        "wall_s": flown.wall_s,
        "realtime_factor": sitl.get("realtime_factor"),
        **scores,
        "setpoints_sent": said.get("setpoints_sent"),
        "messages_received": said.get("messages_received"),
        "messages_lost": said.get("messages_lost"),
        "messages_per_period": _per_period(sitl),
        "setpoint_misses": sitl.get("setpoint_misses"),
        "latency_us": said.get("latency_us"),
        "states": said.get("states", []),
        "refused": {"companion": said.get("refused") or {}, "sitl": sitl.get("frames_refused") or {}},
        "granted_hz": said.get("rates_hz"),
        "delay_s": said.get("delay_s"),
        "position_age_s": said.get("position_age_s"),
        "pacing_ms": sitl.get("pacing_ms"),
        "solver": said.get("controller") or {},
        "counts": said.get("counts") or {},
        "landed": bool(sitl.get("landed", False)),
        "crashed": bool(sitl.get("crashed", False)),
    }
    failures = failures or _failures(result, resolved, lockstep)
    result.update(ok=not failures, failures=failures)
    result = finite(result)
    (run / "summary.json").write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return result


def _scores(run: Path, resolved: Resolved) -> dict[str, Any]:
    trace = read_trace(run / "flight.trace")
    true = score.truth(Log(run / "sitl.tlog"))
    use = score.scored(trace, ENGAGED_STATE, resolved.scenario.flight.score_from_s, path_duration_s(resolved.companion))
    part = Trace(trace.names, trace.rows[use])
    log = Log(run / "flight.tlog")
    gyro = log.rows(log.find("HIGHRES_IMU")[0]) if log.find("HIGHRES_IMU") else None
    start = score.engaged_us(trace, ENGAGED_STATE)
    return {
        **score.position_scores(score.position_error(part, true)),
        "rate_rmse_rad_s": score.rate_scores(trace, true, use, gyro),
        **score.disturbance_scores(part, true),
        **score.bounds_scores(part, true),
        "scored_s": float(np.ptp(part.column("t_us")) * 1e-6) if use.any() else 0.0,
        "engaged_s": None if start is None else 1e-6 * start,
        "control_steps": len(trace.rows),
    }


def _failures(result: dict[str, Any], resolved: Resolved, lockstep: bool) -> list[str]:
    """Against what the scenario requires, each with what was reached."""
    require, failures = resolved.scenario.require, []
    if result.get("engaged_s") is None:
        last = result["states"][-1] if result["states"] else {"state": "nothing heard", "reason": ""}
        failures.append(f"never engaged (last: {last['state']} {last['reason']})".strip())
    else:
        rmse, largest = result["rmse_m"]["position"], result["max_error_m"]
        if require.rmse_m is not None and not rmse <= require.rmse_m:
            failures.append(f"position rmse {rmse:.3f} m, at most {require.rmse_m:g} m")
        if require.max_error_m is not None and not largest <= require.max_error_m:
            failures.append(f"largest position error {largest:.3f} m, at most {require.max_error_m:g} m")
    if not result["landed"]:
        failures.append("not landed at the end")
    misses = result["setpoint_misses"]
    if (
        lockstep
        and not _unsteady(resolved.sitl.link)
        and misses is not None
        and require.misses is not None
        and misses > require.misses
    ):
        failures.append(f"{misses} control periods without a fresh setpoint, at most {require.misses}")
    return failures


def _unsteady(link: Any) -> bool:
    """Whether the link itself leaves control periods without a setpoint: jitter bunches them, faults take them."""
    return bool(link.jitter_ms or link.loss or link.reorder or link.corrupt or link.silences)


def _per_period(sitl: dict[str, Any]) -> dict[str, float] | None:
    periods = sitl.get("periods")
    if not periods:
        return None
    return {"sent": sitl["messages_received"] / periods, "received": sitl["messages_sent"] / periods}


def finite(value: Any) -> Any:
    """The same with None for every number that is none."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table(result: dict[str, Any]) -> list[tuple[str, str]]:
    """(what, value with its unit) for people."""
    rmse = result.get("rmse_m") or {}
    latency = result.get("latency_us") or {}
    per_period = result.get("messages_per_period") or {}
    rows = [
        ("flight", f"{result['scenario']}, seed {result['seed']}, {result['vehicle']} with {result['personality']}"),
        ("flown by", _flown_by(result)),
        (
            "position rmse",
            f"{_n(rmse.get('position'))} m  (n {_n(rmse.get('n'))}, e {_n(rmse.get('e'))}, d {_n(rmse.get('d'))})",
        ),
        ("largest error", f"{_n(result.get('max_error_m'))} m"),
    ]
    for label, axes in (result.get("rate_rmse_rad_s") or {}).items():
        rows.append((f"body rates, {label}", f"rmse {' '.join(_n(x, 4) for x in axes)} rad/s (x y z)"))
    rows += [
        (
            "setpoints",
            f"{result['setpoints_sent']} sent, {result['setpoint_misses']} misses, {result['messages_lost']} messages lost",
        ),
        ("latency", f"p50 {_n(latency.get('p50'), 0)}, p99 {_n(latency.get('p99'), 0)}, max {_n(latency.get('max'), 0)} us"),
        (
            "speed",
            f"{_n(result['duration_s'], 1)} s of vehicle time in {_n(result['wall_s'], 1)} s: {_n(result['realtime_factor'], 1)} x real"
            f" time, {_n(per_period.get('received'), 1)} messages in and {_n(per_period.get('sent'), 1)} out a step",
        ),
        ("landed", "yes" if result["landed"] else "no"),
    ]
    pacing = result.get("pacing_ms")
    if pacing:
        rows.append(("pacing", f"p50 {_n(pacing['p50'])}, p99 {_n(pacing['p99'])}, max {_n(pacing['max'])} ms late"))
    force = result.get("disturbance")
    if force:
        follows = f"follows the true one with correlation {_n(force['correlation'])}, {_n(1e3 * force['lag_s'], 0)} ms behind"
        rows.append(
            ("disturbance estimate", f"{follows} (then {_n(force['best'])}), rms error {_n(force['error_m_s2'], 2)} m/s^2")
        )
    bounds = result.get("bounds")
    if bounds:
        held = f"hold the truth in {_n(bounds['inside_pct'], 2)} % of the steps, +-{_n(bounds['half_width_m_s2'], 2)} m/s^2"
        said = f"contradicted {bounds['empty']} times, widened {bounds['inflations']} times"
        rows.append(("bounds of the model error", f"{held}; {said}"))
    return rows


def show(result: dict[str, Any], run: Path) -> None:
    """The table on stdout, and where the report lies."""
    rows = table(result)
    width = max(len(what) for what, _ in rows)
    for what, value in rows:
        print(f"{what:{width}}  {value}")
    for name, label in (("report.html", "report"), ("flight.tlog", "log")):
        if (run / name).exists():
            print(f"{label:{width}}  {run / name}")


def _flown_by(result: dict[str, Any]) -> str:
    parts = [result["controller"]]
    if result["compensator"] != "none":
        parts.append(f"corrected by {result['compensator']}")
    return ", ".join([*parts, f"estimator {result['estimator']}", f"{result['attitude']} attitude"])


def _n(value: Any, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
