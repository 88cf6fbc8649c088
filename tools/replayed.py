"""All that `mavquad replay` does with one log: survey, observers, reference, what-ifs, and the page of them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mavquad import plan_file
from mavquad.errors import LogError
from mavquad.link import recording
from mavquad.link.columns import Log
from mavquad.link.recording import Recording
from mavquad.settings import Companion
from tools import observers, recorded, survey, survey_aboard, what_if
from tools.observers import Reference, Run
from tools.recorded import Flown

DEFAULT = ("gsmo", "joint", "leso", "eskf", "asmf")


class Chosen(NamedTuple):
    """What was asked for."""

    observers: Sequence[str] | None  # None: every one
    compare: bool
    what_ifs: Sequence[str]
    airframe: str | None
    system: int | None
    component: int | None
    from_s: float | None
    to_s: float | None


def replay(
    path: Path, log: Log | None, chosen: Chosen, companion: Companion | None, page: Path | None, command: Sequence[str]
) -> dict[str, Any]:
    """Everything that is printed, as plain values; the page too where one is wanted. `log` is the tlog, None for a log kept aboard."""
    of_rates, of_force = observers.split(chosen.observers or DEFAULT)
    source = _recording(path, log, chosen)
    kept: survey.Kept = {}
    if log is not None:
        system = chosen.system if chosen.system is not None or source is None else _system(log, source)
        result = survey.survey(log, of_rates, chosen.from_s, chosen.to_s, kept, system)
    else:
        assert source is not None
        result = survey_aboard.survey(source, of_rates, chosen.from_s, chosen.to_s, kept)
    if source is None:
        result["replay"] = {"problem": "no attitude in it: nothing can be observed"}
        return result
    flight = recorded.flown(source, log, chosen.airframe, chosen.from_s, chosen.to_s)
    runs = observers.run(flight, of_force)
    reference = _reference(flight, runs) if chosen.compare or page is not None else None
    if reference is None and chosen.compare:
        from tools import smooth  # filterpy is slow to import

        reference = smooth.reference(flight, _steps(flight))
    compared = observers.against(flight, runs, reference) if reference is not None else []
    what_ifs = _what_ifs(flight, path, chosen, companion, page is not None)
    differences = [what_if.against(flight, what) for what in what_ifs]
    result["replay"] = {
        "vehicle": flight.vehicle.name,
        "vehicle_source": flight.vehicle_source or None,
        "hover_thrust": flight.hover_thrust,
        "span": flight.span,
        "notes": list(flight.notes),
        "observers": [_summary(flight, one) for one in runs],
        "reference": reference.name if reference is not None else None,
        "compared": compared,
        "what_if": differences,
    }
    if page is not None:
        from tools import replay_page  # plotly

        material = replay_page.Material(flight, log, result, kept, runs, reference, compared, what_ifs, differences, command)
        result["page"] = str(replay_page.write(material, page))
    return result


def _recording(path: Path, log: Log | None, chosen: Chosen) -> Recording | None:
    """The signals of the vehicle; None for a tlog in which nobody sends an attitude."""
    if log is None:
        return recording.open_recording(path)
    if not any(s.name in ("ATTITUDE", "ATTITUDE_QUATERNION") for s in log.streams):
        return None
    return recording.from_tlog(log, system=chosen.system, component=chosen.component)


def _system(log: Log, source: Recording) -> int | None:
    """The system whose attitude was taken."""
    systems = {s.system for s in log.streams if s.name in ("ATTITUDE", "ATTITUDE_QUATERNION") and s.component == 1}
    return systems.pop() if len(systems) == 1 else None


def _steps(flight: Flown) -> Any:
    return flight.events.t_us[flight.events.step]


def _reference(flight: Flown, runs: Sequence[Run]) -> Reference | None:
    """The truth of a simulated flight where it lies there."""
    return observers.truth(flight, _steps(flight)) if runs else None


def _what_ifs(flight: Flown, path: Path, chosen: Chosen, companion: Companion | None, default: bool) -> list[what_if.WhatIf]:
    """What was asked for; else, for a page, what this companion sent then, or would have sent with its observer of disturbances."""
    base, plan, specs, most = companion, plan_file.beside(path), list(chosen.what_ifs), 1 << 62
    if not specs and default:
        own = what_if.sent(flight, path.with_suffix(".trace")) if companion is None else None
        if own is not None:
            return [own]
        specs, most = [f"controller={companion.controller if companion else 'iadrc'}"], what_if.MOST
    if not specs:
        return []
    if base is None:
        base = plan_file.read(plan).companion if plan.exists() else Companion()
    wanted = what_if.wanted(flight, path.with_suffix(".trace"))
    if wanted is None:
        if chosen.what_ifs:
            raise LogError(f"{path}: no position in it: --what-if needs to know where the vehicle is")
        return []
    return [what_if.run(flight, what_if.settings(spec, base), spec, wanted, most) for spec in specs]


def _summary(flight: Flown, one: Run) -> dict[str, Any]:
    o = one.observed
    use = flight.inside(o.t_us) & np.isfinite(o.f_ned_m_s2).all(axis=1)
    span_s = 1e-6 * float(flight.events.t_us.max() - flight.events.t_us.min()) if flight.events.t_us.size else 0.0
    through = recorded.wind(flight.vehicle, o.v_ned_m_s, o.f_ned_m_s2)[use]
    row: dict[str, Any] = {
        "observer": one.label,
        "steps": int(use.sum()),
        "times_realtime": span_s / one.wall_s if one.wall_s > 0.0 else None,
        "disturbance_mean_m_s2": o.f_ned_m_s2[use].mean(axis=0).tolist() if use.any() else None,
        "wind_mean_m_s": through.mean(axis=0).tolist() if use.any() and np.isfinite(through).all() else None,
    }
    if use.any() and np.isfinite(o.guaranteed[use]).any():
        row["guarantee_pct"] = 100.0 * float(np.nanmean(o.guaranteed[use]))
        row["half_width_m_s2"] = 0.5 * float(np.mean((o.high_m_s2 - o.low_m_s2)[use]))
    return row


def show(result: dict[str, Any]) -> None:
    """The replay on stdout, for people; the page's path last."""
    r = result["replay"]
    if "problem" in r:
        print(f"nothing replayed: {r['problem']}")
        return
    whose = r["vehicle_source"] or "nobody said which vehicle this is"
    print(
        f"\nobservers, {r['span']}; vehicle {r['vehicle']} ({whose}), carried by {100.0 * r['hover_thrust']:.0f} % of its thrust"
    )
    for note in r["notes"]:
        print(f"  note: {note}")
    print(f"  {'disturbance':34} mean n e d, m/s^2        wind towards n e, m/s   times realtime")
    for o in r["observers"]:
        f, w = o["disturbance_mean_m_s2"], o["wind_mean_m_s"]
        told = " ".join(f"{x:7.3f}" for x in f) if f else "unknown"
        wind = " ".join(f"{x:7.2f}" for x in w) if w else "unknown"
        bounds = (
            f"  bounds +-{o['half_width_m_s2']:.2f} m/s^2, agree {o['guarantee_pct']:.1f} %" if "guarantee_pct" in o else ""
        )
        print(f"  {o['observer']:34} {told:24} {wind:23} {o['times_realtime'] or 0.0:8.0f}{bounds}")
    if r["compared"]:
        print(f"compared with: {r['reference']}")
        print(f"  {'rms':34} disturbance n e d, m/s^2  velocity n e d, m/s")
        for c in r["compared"]:
            f, v = (" ".join(f"{x:7.4f}" for x in c[key]) for key in ("disturbance_rms_m_s2", "velocity_rms_m_s"))
            inside = f"  {c['inside_bounds_pct']:.2f} % inside +-{c['half_width_m_s2']:.2f}" if "inside_bounds_pct" in c else ""
            print(f"  {c['observer']:34} {f:25} {v}{inside}")
    for d in r["what_if"]:
        parts = [("roll", "roll_rms_deg", "deg"), ("pitch", "pitch_rms_deg", "deg"), ("thrust", "thrust_rms_m_s2", "m/s^2")]
        words = ", ".join(f"{name} {d[key]:.2f} {unit}" for name, key, unit in parts if key in d)
        print(
            f"what if {d['what_if']}: rms off what was commanded {words or 'unknown'} over {d['steps']} steps ({d['wanted']})"
        )
    if "page" in result:
        print(result["page"])
