"""cost against size: states of a filter, horizon of the MPC, length of a log, number of streams, number of flights; doubled and doubled again.

The note gives the exponent: 1 is linear, 2 square; between the last two sizes.
"""

import math
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mavquad import pipeline, wire
from mavquad.link.columns import Log
from tools.benches import Row, reading


def measure(seconds: float) -> list[Row]:
    """Every table."""
    return [*states(seconds), *horizon(seconds), *log_size(seconds), *streams(seconds), *flights(seconds)]


def states(seconds: float) -> list[Row]:
    """One predict and update of a dense Kalman filter beside ours of twelve states."""
    from filterpy.kalman import KalmanFilter

    many = max(20, round(20 * seconds))
    points = []
    for n in (6, 12, 24, 48):
        kf = KalmanFilter(dim_x=n, dim_z=6)
        kf.F, kf.H, kf.Q = 0.99 * np.eye(n), np.eye(6, n), 1e-3 * np.eye(n)
        z = np.zeros(6)

        def work(kf: KalmanFilter = kf, z: np.ndarray = z) -> None:
            kf.predict()
            kf.update(z)

        points.append((n, 1e6 * _each(work, many)))
    rows = _table("Kalman filter, predict + update", "filterpy", "states", points, "us")
    return [*rows, Row("EKF, predict + update, 12 states, 6 rows", "ours, from Python", 1e6 * _ekf(many), "us")]


def _ekf(many: int) -> float:
    from tools.benches import live

    plan, flight = live.hovering(controller="iadrc")
    module, gains, state = plan.estimator.module, plan.estimator.gains, flight.estimator
    from mavquad.signals import Attitude

    at = [flight.now_us]

    def work() -> None:
        nonlocal state
        at[0] += 8000
        state = module.observe(gains, state, Attitude(at[0], (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))

    return _each(work, many)


def horizon(seconds: float) -> list[Row]:
    """One constrained problem of a double integrator with a limit on its input, set up once and solved again."""
    import osqp
    from scipy import sparse

    many = max(20, round(10 * seconds))
    points = []
    for n in (10, 20, 40, 80):
        A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([0.005, 0.1])
        powers = [np.eye(2)]
        for _ in range(n):
            powers.append(A @ powers[-1])
        G = np.zeros((2 * n, n))
        for i in range(n):
            for j in range(i + 1):
                G[2 * i : 2 * i + 2, j] = powers[i - j] @ B
        P = sparse.csc_matrix(G.T @ G + 0.1 * np.eye(n))
        free = np.concatenate([powers[i + 1] @ [1.0, 0.5] for i in range(n)])
        solver = osqp.OSQP()
        solver.setup(P, G.T @ free, sparse.eye(n, format="csc"), -np.ones(n), np.ones(n), verbose=False, adaptive_rho=False)
        scale = [1.0]

        def work(solver: object = solver, q: np.ndarray = G.T @ free, scale: list[float] = scale) -> None:
            scale[0] = 1.5 - scale[0]
            solver.update(q=scale[0] * q)  # type: ignore[attr-defined]
            solver.solve()  # type: ignore[attr-defined]

        points.append((n, 1e6 * _each(work, many)))
    return _table("MPC of one axis, dense, inputs limited", "osqp", "steps of horizon", points, "us")


def log_size(seconds: float) -> list[Row]:
    """Columns of every message of a log."""
    most = 400_000 if seconds >= 5.0 else 20_000
    points = []
    with tempfile.TemporaryDirectory() as folder:
        for messages in (most // 8, most // 4, most // 2, most):
            log = Path(folder) / f"{messages}.tlog"
            reading.make_log(log, messages)
            points.append((messages, 1e3 * _each(lambda log=log: Log(log).everything(), 3)))  # type: ignore[misc]
    return _table("reading a log", "ours, columns", "messages", points, "ms")


def streams(seconds: float) -> list[Row]:
    """One tick of the companion with more and more messages that no stage uses."""
    from tools.benches import live

    many = max(20, round(10 * seconds))
    plan, flight = live.hovering(controller="pid")
    extra = wire.encode("VFR_HUD", (1.0, 1.0, 10, 50, 5.0, 0.0), seq=0, system=1, component=1)
    points, k = [], 30
    for n in (1, 2, 4, 8, 16):
        frames = [b"".join([*live.telemetry(k + i), *[extra] * n]) for i in range(4 * many)]
        spent = []
        for i, data in enumerate(frames):
            begun = time.perf_counter()
            flight = pipeline.feed_all(plan, flight, (k + i) * 8000 + 5000, wire.split(data)[0])
            spent.append(time.perf_counter() - begun)
        k += len(frames)
        points.append((n, 1e6 * statistics.median(spent)))
    return _table("tick of the companion, pid", "ours", "further streams", points, "us")


def flights(seconds: float) -> list[Row]:
    """Whole compiled flights one after another on one core."""
    from tools.benches import bulk
    from tools.bulk import setup

    points = []
    for n in (5, 10, 20, 40):
        begun = time.perf_counter()
        for seed in range(n):
            setup.fly(setup.prepare(bulk._resolved(min(seconds, 4.0), seed)))
        points.append((n, time.perf_counter() - begun))
    return _table("compiled flights, one core", "ours", "flights", points, "s")


def _each(work: Callable[[], object], many: int) -> float:
    """Median seconds of a call, the first left out."""
    work()
    spent = []
    for _ in range(many):
        begun = time.perf_counter()
        work()
        spent.append(time.perf_counter() - begun)
    return statistics.median(spent)


def _table(what: str, who: str, of: str, points: list[tuple[int, float]], unit: str) -> list[Row]:
    (n0, t0), (n1, t1) = points[-2:]
    exponent = math.log(t1 / t0) / math.log(n1 / n0)
    rows = [Row(f"{what}, {n} {of}", who, value, unit) for n, value in points]
    return [*rows[:-1], rows[-1]._replace(note=f"exponent {exponent:.2f}")]
