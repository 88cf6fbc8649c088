"""The bank beside its hand-tuned relatives on a flight of ours with motion capture: truth is in the autopilot's own log.

Torque unknown, ATT_POS_MOCAP alone, from 3 s after the first sample in the air until the landing. Each relative is given the best gain
of its grid, chosen with the truth in hand; the bank is told nothing.
"""

import math
from pathlib import Path

import numpy as np

from mavquad.errors import LogError
from mavquad.estimate import gsmo
from mavquad.link.columns import Log
from tools.papers.common import Row
from tools.papers.geometric.setup import Array, rms
from tools.papers.geometric.tables import row

GRIDS = {
    "implicit-third-order": [{"L": x} for x in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0)],
    "implicit-super-twisting": [{"L": x} for x in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)],
    "implicit-relay": [{"k1_rad_s": 6.0, "k2_rad_s2": 6.0 * x} for x in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)],
    "sat": [{"k1_rad_s": 2 * w * 0.2, "k2_rad_s2": w * w * 0.2} for w in (2.0, 5.0, 10.0, 15.0, 20.0, 30.0)],
}


def judged(run: Path) -> list[Row]:
    """Rows of one run folder of `fly --attitude mocap`. Raises LogError where it holds no motion capture or no truth."""
    t_us, q, truth, keep = read(run)
    rows = [row("mocap", "signal", "raw_rms", "rad/s", rms(truth[keep]))]
    ours = _error(gsmo.Params(), t_us, q, truth, keep)
    best = math.inf
    for variant, grid in GRIDS.items():
        found = [(_error(gsmo.Params(variant=variant, **one), t_us, q, truth, keep), one) for one in grid]
        value, one = min(found, key=lambda pair: pair[0])
        setting = " ".join(f"{key}={x:g}" for key, x in one.items())
        rows.append(row("mocap", f"tuned {variant}", "raw_rms", "rad/s", value, setting=setting))
        best = min(best, value)
    rows.append(row("mocap", "online", "raw_rms", "rad/s", ours))
    rows.append(row("mocap", "online", "ratio_to_best_tuned", "1", ours / best))
    return rows


def read(run: Path) -> tuple[np.ndarray, Array, Array, np.ndarray]:
    """(t_us (n,), q (n,4), true rates (n,3), judged (n,)) of the captured attitudes."""
    flight, sitl = Log(run / "flight.tlog"), Log(run / "sitl.tlog")
    for log, name in ((flight, "ATT_POS_MOCAP"), (sitl, "ODOMETRY")):
        if not log.find(name):
            raise LogError(f"{log.path}: no {name} in it; fly with --attitude mocap and give the run folder")
    rows, true = flight.rows(flight.find("ATT_POS_MOCAP")[0]), sitl.rows(sitl.find("ODOMETRY")[0])
    t_us = rows["time_usec"].astype(np.int64)
    at = true["time_usec"].astype(float)
    truth = np.column_stack([np.interp(t_us, at, true[name]) for name in ("rollspeed", "pitchspeed", "yawspeed")])
    height = np.interp(t_us, at, -true["z"])
    air = np.flatnonzero(height > 1.0)
    if len(air) == 0:
        raise LogError(f"{run}: never above 1 m")
    keep = (t_us > t_us[air[0]] + 3_000_000) & (t_us < t_us[air[-1]])
    return t_us, np.asarray(rows["q"], dtype=float), truth, keep


def _error(params: gsmo.Params, t_us: np.ndarray, q: Array, truth: Array, keep: np.ndarray) -> float:
    omega, _, _ = gsmo.run_record(gsmo.gains(params), t_us, q)
    error = rms((omega - truth)[keep])
    return error if math.isfinite(error) else math.inf
