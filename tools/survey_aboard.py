"""What a log kept aboard (PX4 ULog, ArduPilot DataFlash) holds and says of the body rates: the survey of a tlog, for these formats."""

from typing import Any

import numpy as np

from mavquad.errors import LogError
from mavquad.link.recording import Recording, at_times, not_enough_for
from mavquad.signals import Attitude, Motors
from tools import rates
from tools import survey as tlog_survey


def survey(
    recording: Recording, observers: list[str], from_s: float | None, to_s: float | None, keep: tlog_survey.Kept | None = None
) -> dict[str, Any]:
    """Everything `replay` prints, in the form it has for a tlog. The span counts from the first attitude."""
    t_us = [table["t_us"] for table in recording.tables.values()]
    result: dict[str, Any] = {
        "log": str(recording.path),
        "bytes": recording.path.stat().st_size,
        "messages": sum(map(len, t_us)),
        "span_s": 1e-6 * float(max(t.max() for t in t_us) - min(t.min() for t in t_us)),
        "junk_bytes": 0,
        "problem": recording.problem or None,
        "streams": _tables(recording),
        "notes": not_enough_for(recording),
    }
    try:
        result["rates"] = _rates(recording, observers, from_s, to_s, keep)
    except LogError as error:
        result["rates"] = {"problem": str(error)}
    return result


def _rates(
    recording: Recording, observers: list[str], from_s: float | None, to_s: float | None, keep: tlog_survey.Kept | None
) -> dict[str, Any]:
    """rms of each way to the body rates against the zero-phase rate of the same quaternions; the span counts from the first sample."""
    if Attitude not in recording.signals:
        raise LogError(f"{recording.path}: no attitude in it: no body rates")
    signal = recording.signals[Attitude]
    a = rates.attitudes(signal.column("t_us"), signal.column("q_wxyz"))
    reference, t_s = rates.reference(a), 1e-6 * (a.t_us - a.t_us[0])
    span = (0.0 if from_s is None else from_s, float(t_s[-1]) + 1e-6 if to_s is None else to_s)
    use = (t_s >= span[0]) & (t_s < span[1])
    if use.sum() < 100:
        raise LogError(f"{int(use.sum())} attitude samples between {span[0]:.1f} and {span[1]:.1f} s, at least 100 are needed")
    torque, model, outputs = None, {"problem": "no outputs of four motors"}, recording.signals.get(Motors)
    if outputs is not None and outputs.column("command").shape[1] >= 4:
        torque, model = tlog_survey.fitted(a, outputs.column("t_us"), outputs.column("command")[:, :4], use)
    told = at_times(a.t_us, signal.column("t_us"), signal.column("omega_rad_s"))
    hz = 1e6 / float(np.median(np.diff(a.t_us)))
    return {
        "source": f"{recording.format} {signal.source}",
        "sample_hz": hz,
        "samples": int(use.sum()),
        "dropped": a.dropped,
        "from_s": span[0],
        "to_s": span[1],
        "span": "the whole log" if from_s is None and to_s is None else "as asked for",
        "reference": "zero-phase rate of the same quaternions (central difference)",
        "signal_rms_rad_s": rates.rms(reference, use),
        "ways": tlog_survey.compare(a, reference, use, observers, torque, told, outputs.source if outputs else "-", keep),
        "torque_model": model,
        "note": tlog_survey.slow_note(hz),
    }


def _tables(recording: Recording) -> list[dict[str, Any]]:
    """Count and mean rate of every table."""
    rows = []
    for name, table in sorted(recording.tables.items()):
        span_s = 1e-6 * float(table["t_us"].max() - table["t_us"].min())
        rate = (len(table) - 1) / span_s if span_s > 0.0 else None
        rows.append({"system": None, "component": None, "name": name, "count": len(table), "rate_hz": rate})
    return rows
