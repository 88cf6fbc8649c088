"""The observers on a recording of an autopilot: attitudes from ATTITUDE_QUATERNION, no gyro, nothing tuned on it.

Reference: the zero-phase rate of the same quaternions by central difference. The recorded gyro is a second opinion only: it is
low-pass filtered by the autopilot, so every candidate is also sent through that filter, identified here, and held against it.
(An attitude that an autopilot estimates already contains its gyro: this compares estimators, it does not replace a gyro.)
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mavquad import wire
from mavquad.errors import LinkError, LogError
from mavquad.estimate import gsmo, rate_baselines, rate_filters
from mavquad.link import signals, tlog
from tools.papers.common import Row
from tools.papers.geometric.setup import Array, rms
from tools.papers.geometric.tables import row

WHOLE = "arducopter-sitl-sweep-calm.tlog"
EXCERPT = Path("tests") / "data" / "sweep-roll-20s.tlog"
SPAN_S = (55.0, 250.0)  # of the whole recording, from its first record: airborne and manoeuvring
CUTOFFS_HZ = tuple(np.arange(5.0, 40.5, 0.5).tolist())


class Record(NamedTuple):
    """One attitude stream."""

    name: str
    t_us: npt.NDArray[np.int64]
    q_wxyz: Array  # (n,4)
    gyro_rad_s: Array  # (n,3), as the autopilot reports it
    keep: npt.NDArray[np.bool_]  # what is judged


def find() -> Path | None:
    """The whole recording where MAVQUAD_DATA says it is, else the excerpt of a checkout, else None."""
    folder = os.environ.get("MAVQUAD_DATA", "")
    if folder and (Path(folder) / WHOLE).is_file():
        return Path(folder) / WHOLE
    excerpt = Path(__file__).resolve().parents[3] / EXCERPT
    return excerpt if excerpt.is_file() else None


def read(path: Path) -> Record:
    """All ATTITUDE_QUATERNION of a tlog's first vehicle. Raises LogError for what is no such log."""
    wanted = wire.spec("ATTITUDE_QUATERNION").msgid
    t_us, q, gyro, arrived = [], [], [], []
    begin_us = 0
    source: tuple[int, int] | None = None
    try:
        stream = path.open("rb")
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    with stream:
        for stamp_us, frame in tlog.Reader(stream):
            begin_us = begin_us or stamp_us
            if frame.msgid != wanted or (source is not None and (frame.system, frame.component) != source):
                continue
            source = (frame.system, frame.component)
            try:
                sample = signals.attitude_quaternion(wire.decode(frame))
            except LinkError:
                continue
            arrived.append(1e-6 * (stamp_us - begin_us))
            t_us.append(sample.t_us)
            q.append(sample.q_wxyz)
            gyro.append(sample.omega_rad_s)
    if len(t_us) < 100:
        raise LogError(f"{path}: {len(t_us)} ATTITUDE_QUATERNION messages, expected at least 100 to judge an observer by")
    t = np.array(arrived)
    whole = t[-1] > SPAN_S[1]
    keep = (t >= SPAN_S[0]) & (t <= SPAN_S[1]) if whole else (t >= t[0] + 2.0) & (t <= t[-1] - 0.5)
    return Record(path.name, np.array(t_us, np.int64), np.array(q), np.array(gyro), keep)


def candidates(record: Record) -> dict[str, Array]:
    """Rates (n,3) by every method, from the attitudes alone."""
    t_us, q = record.t_us, record.q_wxyz
    dt_s = float(np.median(np.diff(t_us))) * 1e-6
    plain = rate_baselines.plain_difference(t_us, q)
    found = {"extrapolated difference": rate_baselines.extrapolated_difference(t_us, q), "plain difference": plain}
    for cutoff_hz in (5.0, 20.0):
        found[f"difference + {cutoff_hz:g} Hz Butterworth"] = rate_filters.low_pass(plain, cutoff_hz, dt_s)
    for variant in gsmo.VARIANTS:
        params = gsmo.Params(variant=variant, L=2.0) if variant == "implicit-third-order" else gsmo.Params(variant=variant)
        found[variant] = gsmo.run_record(gsmo.gains(params), t_us, q)[0]
    tuned = gsmo.gains(gsmo.Params(variant="implicit-third-order", L=1000.0))
    found["implicit-third-order, L = 1000"] = gsmo.run_record(tuned, t_us, q)[0]
    return found


def gyro_filter_hz(record: Record, reference: Array) -> float:
    """Cutoff of the second-order Butterworth that carries the reference closest to the recorded gyro."""
    dt_s = float(np.median(np.diff(record.t_us))) * 1e-6
    cutoffs = [f for f in CUTOFFS_HZ if f < 0.45 / dt_s]
    misses = [rms((rate_filters.low_pass(reference, f, dt_s) - record.gyro_rad_s)[record.keep]) for f in cutoffs]
    return float(cutoffs[int(np.argmin(misses))])


def judged(record: Record) -> list[Row]:
    """Error of every candidate against the reference, and through the gyro's filter against the gyro."""
    reference = rate_baselines.central_difference(record.t_us, record.q_wxyz)
    dt_s = float(np.median(np.diff(record.t_us))) * 1e-6
    cutoff_hz = gyro_filter_hz(record, reference)
    keep, more = record.keep, {"recording": record.name}
    rows = [
        row("recording", "gyro's filter", "cutoff", "Hz", cutoff_hz, **more),
        row("recording", "reference", "signal_rms", "rad/s", rms(reference[keep]), **more),
    ]
    for name, rates in {"reference": reference, **candidates(record)}.items():
        error = (rates - reference)[keep]
        through = (rate_filters.low_pass(rates, cutoff_hz, dt_s) - record.gyro_rad_s)[keep]
        rows.append(row("recording", name, "raw_rms", "rad/s", rms(error), **more))
        rows += [row("recording", name, f"raw_rms_{a}", "rad/s", rms(error[:, i]), **more) for i, a in enumerate("xyz")]
        rows.append(row("recording", name, "gyro_filter_rms", "rad/s", rms(through), **more))
    return rows
