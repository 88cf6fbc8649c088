"""How long the observers take: compiled in a loop, called from Python, and one whole run, in CPU time."""

import statistics
import time
from collections.abc import Callable

import numpy as np

from mavquad.estimate import ekf, joint, leso
from mavquad.jit import kernel
from tools.papers.common import Row, row
from tools.papers.joint_observer import cases, runs

_REPEATS = 7


@kernel
def _filter_steps(gains: ekf.EkfGains, state: ekf.EkfState, u: ekf.Input, z: ekf.Row12, dt_s: float, n: int) -> ekf.EkfState:
    for _ in range(n):
        state = ekf.step(gains, state, u, z, dt_s)
    return state


@kernel
def _observer_steps(gains: leso.LesoGains, state: leso.LesoState, y: np.ndarray, a: np.ndarray, n: int) -> leso.LesoState:
    for _ in range(n):
        state = leso.step(gains, state, y, a)
    return state


def _median_us(work: Callable[[], object], n: int) -> float:
    """Median CPU time of one of n steps [us]."""
    work()  # compiles
    took = []
    for _ in range(_REPEATS):
        began = time.process_time()
        work()
        took.append(1e6 * (time.process_time() - began) / n)
    return statistics.median(took)


def measure() -> list[Row]:
    """Rows of scenario "speed": filter, six observers, S1 of one configuration."""
    _, gains, _ = cases.design(cases.SCENARIOS["S1"], cases.IADRC_R)
    z = (0.0,) * 12
    u = (9.8, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3)
    state = joint.init(gains, z)
    y, a, dt = np.zeros(6), np.zeros(6), cases.DT_S

    def python_loop() -> None:
        s = state.ekf
        for _ in range(2000):
            s = ekf.step(gains.ekf, s, u, z, dt)

    scenario = cases.SCENARIOS["S1"]
    found = (
        ("ekf_compiled", "us", _median_us(lambda: _filter_steps(gains.ekf, state.ekf, u, z, dt, 5000), 5000)),
        ("ekf_python", "us", _median_us(python_loop, 2000)),
        ("leso_six", "us", _median_us(lambda: _observer_steps(gains.leso, state.leso, y, a, 20000), 20000)),
        ("s1_run", "s", 1e-6 * _median_us(lambda: runs.flown(scenario, cases.IADRC_R, 1), 1)),
    )
    return [row("speed", "IADRC-R", None, metric, unit, value, "median") for metric, unit, value in found]
