"""Every observer over a recorded flight, by name or `name:key=value,...`, several at once; and how far each is from a reference.

Of the disturbance: joint, leso, eskf, asmf. Of the body rates: gsmo. Each runs as one compiled loop.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mavquad import active_record
from mavquad.errors import ConfigError, LogError
from mavquad.estimate import extended_state_record, joint_record, record
from mavquad.link.columns import Log
from mavquad.plan import COMPENSATORS, ESTIMATORS, OBSERVERS, stage
from tools.recorded import Flown

Array = NDArray[Any]
RUNS: dict[str, Callable[[Any, record.Events], record.Observed]] = {
    "joint": joint_record.run,
    "leso": joint_record.run,
    "eskf": extended_state_record.run,
    "asmf": active_record.run,
}
OF_RATES = tuple(OBSERVERS)
ALL = (*OF_RATES, *RUNS)
_TABLE = {**OBSERVERS, **COMPENSATORS, **{name: ESTIMATORS[name] for name in ("joint", "leso", "eskf")}}


class Run(NamedTuple):
    """One observer's estimates over the flight."""

    label: str
    observed: record.Observed
    wall_s: float


class Reference(NamedTuple):
    """What estimates are compared with, at the times of the steps; NaN where it is not known."""

    name: str
    is_truth: bool
    t_us: Array  # (m,)
    p_ned_m: Array
    v_ned_m_s: Array
    f_ned_m_s2: Array


def split(specs: Sequence[str]) -> tuple[list[str], list[str]]:
    """(of body rates, of the disturbance). Raises ConfigError for a name that is no observer."""
    for spec in specs:
        if spec.partition(":")[0] not in _TABLE:
            raise ConfigError(f"no observer is called {spec.partition(':')[0]!r}; known: {', '.join(ALL)}")
    of_rates = [spec for spec in specs if spec.partition(":")[0] in OF_RATES]
    return of_rates, [spec for spec in specs if spec not in of_rates]


def run(flight: Flown, specs: Sequence[str]) -> list[Run]:
    """Each of these observers of the disturbance over the whole flight; none where it holds no position."""
    if flight.position is None:
        return []
    runs = []
    for spec in specs:
        name = spec.partition(":")[0]
        chosen = stage("observer", spec, _TABLE, {}, flight.vehicle)
        begun = time.perf_counter()
        runs.append(Run(spec, RUNS[name](chosen.gains, flight.events), time.perf_counter() - begun))
    return runs


def direct(flight: Flown) -> record.Observed:
    """No observer: the newest position and velocity at each step, carried forward; no disturbance."""
    out = record.outputs(flight.events)
    if flight.position is None:
        return out
    t_us, p, v = flight.position.columns
    order = np.argsort(t_us, kind="stable")
    t_us, p, v = t_us[order], p[order], v[order]
    at = np.searchsorted(t_us, out.t_us, side="right") - 1
    age_s = 1e-6 * (out.t_us - t_us[np.maximum(at, 0)])
    known = (at >= 0) & (age_s < 0.5)
    out.v_ned_m_s[known] = v[at[known]]
    out.p_ned_m[known] = p[at[known]] + age_s[known, None] * v[at[known]]
    return out


def against(flight: Flown, runs: Sequence[Run], reference: Reference) -> list[dict[str, Any]]:
    """rms of each observer's difference from the reference in the span that counts, per axis n e d; and how its bounds did."""
    rows = []
    for one in runs:
        o = one.observed
        use = flight.inside(o.t_us) & np.isfinite(o.f_ned_m_s2).all(axis=1) & np.isfinite(reference.f_ned_m_s2).all(axis=1)
        row: dict[str, Any] = {
            "observer": one.label,
            "steps": int(use.sum()),
            "disturbance_rms_m_s2": _rms((o.f_ned_m_s2 - reference.f_ned_m_s2)[use]),
            "velocity_rms_m_s": _rms((o.v_ned_m_s - reference.v_ned_m_s)[use]),
            "position_rms_m": _rms((o.p_ned_m - reference.p_ned_m)[use]),
        }
        bounded = use & np.isfinite(o.low_m_s2).all(axis=1)
        if bounded.any():
            f, low, high = reference.f_ned_m_s2[bounded], o.low_m_s2[bounded], o.high_m_s2[bounded]
            row["inside_bounds_pct"] = 100.0 * float(np.mean(np.all((f >= low) & (f <= high), axis=1)))
            row["half_width_m_s2"] = 0.5 * float(np.mean(high - low))
        rows.append(row)
    return rows


def truth(flight: Flown, steps_us: Array) -> Reference | None:
    """What really happened, of a simulated flight: from the log itself or from sitl.tlog beside it; None where neither says."""
    from tools import score

    path = flight.recording.path
    for candidate in (path, path.with_name("sitl.tlog")):
        if flight.recording.format != "tlog" or not candidate.exists():
            continue
        try:
            true = score.truth(Log(candidate))
        except LogError:
            continue
        p = true.p_ned_m
        v = np.gradient(p, 1e-6 * true.t_us, axis=0)  # the truth frames' own velocity is in body axes
        f = np.column_stack([true.extra[f"f_{axis}"] for axis in "ned"])
        known = (steps_us >= true.t_us[0]) & (steps_us <= true.t_us[-1])
        columns = [np.where(known[:, None], score.at(true.t_us, c, steps_us), np.nan) for c in (p, v, f)]
        return Reference(f"the simulated vehicle's truth ({candidate.name})", True, steps_us, *columns)
    return None


def _rms(error: Array) -> list[float]:
    if not len(error):
        return [float("nan")] * 3
    return [float(x) for x in np.sqrt(np.mean(error**2, axis=0))]
