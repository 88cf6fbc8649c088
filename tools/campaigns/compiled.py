"""A campaign's flights without sockets: one compiled function where that can fly them, else stage by stage; see `tools.bulk`.

A flight begins in a hover, so it has no take-off and no landing; its scores are those of `mavquad fly` over the same part of the path.
"""

import functools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mavquad.errors import ConfigError, MavquadError
from mavquad.lifecycle import ENGAGED, STATES
from tools import fly, score, summary, warm
from tools.bulk import setup, stepwise
from tools.bulk.state import LOST, TOUCHED
from tools.campaigns import over_udp
from tools.campaigns.grid import Flight
from tools.campaigns.store import Result
from tools.scenarios import Resolved
from tools.trace import Trace

NAME = "compiled"
PROCESSES = False  # a worker that is killed leaves nothing behind
_CHUNK, _STEPWISE = 40, 20  # compiled flights handed over at once; one flown stage by stage costs as much as so many
_ENGAGED = float(STATES.index(ENGAGED))


def prepare(flights: list[Flight], say: Callable[[str], None]) -> None:
    """Check every kind of flight and compile what it needs, once, before any worker starts. Raises ConfigError."""
    kinds = {(one.scenario, one.personality, one.variant): one for one in reversed(flights)}
    found = [_resolve(one.words) for one in kinds.values()]
    for resolved in found:
        reason = setup.why_not(resolved)
        if reason:
            raise ConfigError(f"not without --over-udp: {reason}")
        setup.plan_of(resolved)
    for resolved in found:
        fused = not setup.why_not_fused(resolved)
        warm.ensure(f"bulk {fused} {fly.stages(resolved.companion)}", functools.partial(_warm, resolved, fused), say)


def chunks(flights: list[Flight]) -> list[list[Flight]]:
    """Flights in parts of about the same work."""
    weights: dict[tuple[str, str, str], int] = {}
    parts: list[list[Flight]] = [[]]
    load = 0
    for one in flights:
        kind = (one.scenario, one.personality, one.variant)
        if kind not in weights:
            weights[kind] = _STEPWISE if setup.why_not_fused(_resolve(one.words)) else 1
        if load + weights[kind] > _CHUNK and parts[-1]:
            parts.append([])
            load = 0
        parts[-1].append(one)
        load += weights[kind]
    return parts


def fly_chunk(words: list[tuple[str, ...]], ids: list[str], runs: str, keep: str) -> list[Result]:
    """Fly each; there are no run folders to keep."""
    return [_one(one, id_) for one, id_ in zip(words, ids, strict=True)]


def _one(words: tuple[str, ...], id_: str) -> Result:
    try:
        resolved = _resolve(words)
        begun = time.perf_counter()
        fused = not setup.why_not_fused(resolved)
        scores, failures, duration_s = _fused(resolved) if fused else _stepwise(resolved)
        wall_s = time.perf_counter() - begun
    except MavquadError as error:
        return Result(id_, {}, str(error))
    companion = resolved.companion
    failures += _short_of(scores, resolved)
    return Result(
        id_,
        summary.finite(
            {
                "scenario": Path(words[0]).stem,
                "seed": resolved.sitl.seed,
                "vehicle": companion.airframe,
                "personality": resolved.sitl.personality,
                "controller": companion.controller,
                "estimator": companion.estimator,
                "compensator": companion.compensator,
                "flown": "compiled" if fused else "stage by stage",
                "duration_s": duration_s,
                "wall_s": wall_s,
                "realtime_factor": duration_s / wall_s,
                **scores,
                "ok": not failures,
                "failures": failures,
            }
        ),
    )


def _fused(resolved: Resolved) -> tuple[dict[str, Any], list[str], float]:
    p = setup.prepare(resolved)
    setup.fly(p)
    f = p.flight
    n, ended = f["scored"], f["ended"]
    whole = n > 0 and ended not in (TOUCHED, LOST)
    axes = [math.sqrt(x / n) if whole else math.nan for x in f["sum_e2"].tolist()]
    scores = {
        "rmse_m": {**dict(zip("ned", axes, strict=True)), "position": math.sqrt(sum(x * x for x in axes))},
        "max_error_m": math.sqrt(f["max_e2"]) if whole else math.nan,
        "control_steps": f["control_steps"],
        "setpoint_misses": 0,
    }
    failures = {TOUCHED: ["touched the ground"], LOST: ["flew away"]}.get(ended, [])
    return scores, list(failures), 1e-6 * (f["t_us"] - setup.START_US)


def _stepwise(resolved: Resolved) -> tuple[dict[str, Any], list[str], float]:
    loop = stepwise.Loop(resolved)
    flown = loop.fly()
    duration_s = 1e-6 * (loop.sim.t_us - setup.start_us(resolved.sitl))
    failures = ["touched the ground"] if flown.grounded else []
    scores: dict[str, Any] = {"setpoint_misses": flown.misses, "solver": flown.solver, "delay_s": loop.flight.delay_s}
    use = score.scored(
        flown.trace, _ENGAGED, resolved.scenario.flight.score_from_s, summary.path_duration_s(resolved.companion)
    )
    part = Trace(flown.trace.names, flown.trace.rows[use])
    if failures or not use.any():
        return {**scores, **score.position_scores(np.empty((0, 3)))}, failures, duration_s
    scores |= score.position_scores(score.position_error(part, flown.truth))
    scores |= score.disturbance_scores(part, flown.truth)
    scores |= score.bounds_scores(part, flown.truth)
    return scores, failures, duration_s


def _short_of(scores: dict[str, Any], resolved: Resolved) -> list[str]:
    """What the scenario requires and the flight has not reached."""
    require, failures = resolved.scenario.require, []
    rmse, largest = scores["rmse_m"]["position"], scores["max_error_m"]
    if require.rmse_m is not None and not rmse <= require.rmse_m:
        failures.append(f"position rmse {rmse:.3f} m, at most {require.rmse_m:g} m")
    if require.max_error_m is not None and not largest <= require.max_error_m:
        failures.append(f"largest position error {largest:.3f} m, at most {require.max_error_m:g} m")
    return failures


def _resolve(words: tuple[str, ...]) -> Resolved:
    """As `mavquad fly` resolves them; for flights that differ in their seed alone it is done once."""
    at = words.index("--seed")
    scenario, sitl, companion = _unseeded(words[:at] + words[at + 2 :])
    seed = int(words[at + 1])
    return Resolved(scenario, msgspec.structs.replace(sitl, seed=seed), msgspec.structs.replace(companion, seed=seed))


@functools.lru_cache(maxsize=256)
def _unseeded(words: tuple[str, ...]) -> Resolved:
    resolved: Resolved = over_udp.resolve(words)[1]
    return resolved


def _warm(resolved: Resolved, fused: bool) -> None:
    if fused:
        setup.fly(setup.prepare(resolved), setup.START_US + 50_000)
    else:
        loop = stepwise.Loop(resolved)
        loop.fly(loop.engage_us + 200_000)
