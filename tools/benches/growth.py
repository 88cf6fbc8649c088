"""cost against size: states of a filter, horizon of the MPC, length of a log, number of streams, number of flights; doubled and doubled again.

The note gives the exponent between the last two sizes (0: does not grow, 1: linear, 2: square; where much of the cost is there
without the first already, it is below 1) and what each more costs. Sizes take turns.
"""

import functools
import math
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mavquad import pipeline, wire
from mavquad.control import constrained, prediction
from mavquad.estimate import asmf, ekf
from mavquad.link.columns import Log
from tools import repeated
from tools.benches import Row, reading

_AT_ONCE = 100  # steps of a filter in one compiled call
_ROUNDS = 4
_HORIZON = "errors of metres, each solved from the one before; without limits in reach it is a gain matrix, the same work for any horizon"


def measure(seconds: float) -> list[Row]:
    """Every table."""
    return [*states(seconds), *horizon(seconds), *log_size(seconds), *streams(seconds), *flights(seconds)]


def states(seconds: float) -> list[Row]:
    """One predict and update with six outputs: our set-membership filter, compiled, beside filterpy's Kalman filter; our EKF."""
    from filterpy.kalman import KalmanFilter

    many, m = max(20, round(20 * seconds)), 6
    ours, theirs = {}, {}
    for n in (6, 12, 24, 48):
        params = asmf.Params(e=(1.0,) * m, b=(0.01,) * n, p0=(1.0,) * n, model_error=())
        gains = asmf.gains(params, np.eye(m, n))
        y = np.random.default_rng(n).uniform(-0.5, 0.5, (_AT_ONCE, m))
        begun = asmf.init(gains, np.zeros(n)), 0.99 * np.eye(n), np.zeros(n)
        ours[n] = functools.partial(repeated.set_membership, gains, *begun, y, np.zeros(m))
        kf = KalmanFilter(dim_x=n, dim_z=m)
        kf.F, kf.H, kf.Q = 0.99 * np.eye(n), np.eye(m, n), 1e-3 * np.eye(n)
        theirs[n] = functools.partial(_filterpy, kf, np.zeros(m))
    found, beside = _in_turn(ours, many), _in_turn(theirs, many)
    return [
        *_table("set-membership filter, 6 outputs", "ours, compiled", "states", _scaled(found, 1e6 / _AT_ONCE), "us"),
        *_table("Kalman filter, 6 outputs", "filterpy", "states", _scaled(beside, 1e6), "us"),
        Row("extended Kalman filter, 12 outputs, 12 states", "ours, compiled", 1e6 / _AT_ONCE * _ekf(many), "us"),
    ]


def _filterpy(kf: Any, z: np.ndarray) -> None:
    kf.predict()
    kf.update(z)


def _ekf(many: int) -> float:
    """Seconds of _AT_ONCE steps in a hover."""
    gains = ekf.gains(ekf.EkfParams(), ekf.EkfModel(9.81, 0.1, (0.005, 0.006, 0.0095), 0.0))
    z, rest = (0.0,) * 12, (0.0, 0.0, 0.0)
    work = functools.partial(repeated.kalman, gains, ekf.init(gains, z), (9.81, rest, rest, rest), z, 0.004, _AT_ONCE)
    return _in_turn({12: work}, many)[0][1]


def horizon(seconds: float) -> list[Row]:
    """The constrained position MPC in a turn at its limits, both programs, by OSQP from the last solution; and without limits."""
    model, weights, r, g = prediction.position_model(0.05), np.array([4.0, 0.5, 1.0]), 0.02, 9.81
    limits = constrained.Horizon(-9.65, 7.85, constrained.OCTAGON * math.sin(math.radians(35.0)), 200.0, 0.01)
    rng = np.random.default_rng(1)
    errors = [rng.normal(size=(3, 3)) * [2.5, 1.0, 0.0] for _ in range(8)]
    works = {}
    for n in (10, 20, 40, 80):
        works[n] = functools.partial(_turns, constrained.design(model, model, weights, r, 0.05, n), errors, limits, g)
    points = _scaled(_in_turn(works, max(5, round(4 * seconds))), 1e6 / len(errors))
    rows = _table("position MPC at its limits", "ours, by OSQP", "steps of horizon", points, "us")
    return [row._replace(note="; ".join(filter(None, (row.note, _HORIZON)))) if row.note else row for row in rows]


def _turns(design: constrained.Design, errors: list[np.ndarray], limits: constrained.Horizon, g: float) -> None:
    state, path = constrained.init(design), np.zeros((design.horizon, 3))
    for error in errors:
        state, _ = constrained.solve(design, state, error, path, (0.0, 0.0, 0.0), limits, g, always=True)


def log_size(seconds: float) -> list[Row]:
    """Columns of every message of a log."""
    most = 400_000 if seconds >= 5.0 else 20_000
    with tempfile.TemporaryDirectory() as folder:
        logs = {messages: Path(folder) / f"{messages}.tlog" for messages in (most // 8, most // 4, most // 2, most)}
        for messages, log in logs.items():
            reading.make_log(log, messages)
        found = _in_turn({n: lambda log=log: Log(log).everything() for n, log in logs.items()}, 5)  # type: ignore[misc]
    return _table("reading a log", "ours, columns", "messages", _scaled(found, 1e3), "ms")


def streams(seconds: float) -> list[Row]:
    """One tick of the companion with more and more messages that no stage uses."""
    from tools.benches import live

    many = max(20, round(10 * seconds))
    plan, flight = live.hovering(controller="pid")
    extra = wire.encode("VFR_HUD", (1.0, 1.0, 10, 50, 5.0, 0.0), seq=0, system=1, component=1)
    spent: dict[int, list[float]] = {n: [] for n in (1, 4, 16, 64)}
    k = 30
    for _ in range(_ROUNDS):
        for n, times in spent.items():
            frames = [b"".join([*live.telemetry(k + i), *[extra] * n]) for i in range(many)]
            for i, data in enumerate(frames):
                begun = time.perf_counter()
                flight = pipeline.feed_all(plan, flight, (k + i) * 8000 + 5000, wire.split(data)[0])
                times.append(time.perf_counter() - begun)
            k += many
    points = [(n, 1e6 * statistics.median(times)) for n, times in spent.items()]
    return _table("tick of the companion, pid", "ours", "further streams", points, "us")


def flights(seconds: float) -> list[Row]:
    """Whole compiled flights one after another on one core."""
    from tools.benches import bulk
    from tools.bulk import setup

    def fly(n: int) -> None:
        for seed in range(n):
            setup.fly(setup.prepare(bulk._resolved(min(seconds, 4.0), seed)))

    found = _in_turn({n: functools.partial(fly, n) for n in (5, 10, 20, 40)}, 3)
    return _table("compiled flights, one core", "ours", "flights", found, "s")


def _in_turn(works: Mapping[int, Callable[[], object]], rounds: int) -> list[tuple[int, float]]:
    """(size, median seconds of a call) for each size: all of them once to begin with, then round by round in turn."""
    spent: dict[int, list[float]] = {size: [] for size in works}
    for round_ in range(rounds + 1):
        for size, work in works.items():
            begun = time.perf_counter()
            work()
            if round_:
                spent[size].append(time.perf_counter() - begun)
    return [(size, statistics.median(times)) for size, times in spent.items()]


def _scaled(points: list[tuple[int, float]], factor: float) -> list[tuple[int, float]]:
    return [(n, factor * value) for n, value in points]


def _table(what: str, who: str, of: str, points: list[tuple[int, float]], unit: str) -> list[Row]:
    """A row for each size; the last one says how cost grows: between the last two sizes, and from the first to the last."""
    (first, t0), (n0, t1), (n1, t2) = points[0], *points[-2:]
    exponent, each = math.log(t2 / t1) / math.log(n1 / n0), (t2 - t0) / (n1 - first)
    rows = [Row(f"{what}, {n} {of}", who, value, unit) for n, value in points]
    note = f"exponent {exponent:.2f} between the last two; from the first to the last {each:.2g} {unit} for each more"
    return [*rows[:-1], rows[-1]._replace(note=note)]
