"""How long the method's parts take, in CPU time: `mavquad paper eskf-mpc --scenario speed`."""

import time
from collections.abc import Callable

import numpy as np

from mavquad.control import mpc
from mavquad.estimate import extended_state_kf as eskf
from mavquad.jit import kernel
from tools.papers.quad_in_wind import configs, constrained_flight, loop

_AGAIN = 4


@kernel
def _axes(g: mpc.MpcGains, steps: int) -> float:
    """The closed form of one axis, `steps` times, inputs changing."""
    total = 0.0
    targets, inputs = mpc.no_targets(g.horizon)
    for i in range(steps):
        e = 1e-3 * (i % 997)
        total += mpc.feedback(g, 0, (e, 1.0 - e, 0.1), 9.81 + e, targets, inputs)
    return total


def _cpu(function: Callable[[], object], repeats: int) -> float:
    """Median CPU seconds of a call."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return float(np.median(times))


def measure(seed: int) -> dict[str, tuple[str, float]]:
    """metric -> (unit, value)."""
    scenario = configs.SCENARIOS["S1-A"]
    default, paper = (configs.flight(configs.CONFIGS[c], scenario) for c in ("default", "PB"))
    found = {}
    for name, flight in (("closed_form_axis", default), ("closed_form_axis_paper", paper)):
        _axes(flight.mpc, 1)
        found[name] = ("us", 1e6 * _cpu(lambda g=flight.mpc: _axes(g, 100_000), 5) / 100_000)  # type: ignore[misc]
    rng = np.random.default_rng(seed)
    k, x, y, a = rng.normal(size=(6, 6)), rng.normal(size=(6, 3)), rng.normal(size=(6, 2)), rng.normal(size=6)

    def six() -> None:
        for _ in range(2000):
            eskf.step_bank(k, x, y, a, 0.01)

    six()
    found["eskf_six_axes_from_python"] = ("us", 1e6 * _cpu(six, 9) / 2000)
    noise, wind = configs.disturbances(scenario, seed)

    def flight_40s() -> None:
        log = np.empty((scenario.steps, loop.COLUMNS))
        loop.fly(default, loop.loop(default, scenario.start_ned_m, configs.YAW_START), noise, wind, log)

    flight_40s()
    found["s1_flight"] = ("s", _cpu(flight_40s, 5))
    hard = configs.SCENARIOS["S3"]
    flight = configs.flight(configs.CONFIGS["default"], hard)
    noise, wind = configs.disturbances(hard, seed)
    for name, always in (("qp_z_xy", True), ("qp_z_xy_where_needed", False)):
        flown = []
        for _ in range(_AGAIN):  # the same work step by step: its shortest time is the program's, the rest is the machine's
            log = np.empty((hard.steps, loop.COLUMNS))
            start = loop.loop(flight, hard.start_ned_m, configs.YAW_START)
            _, counts = constrained_flight.fly(flight, start, noise, wind, log, constrained_flight.design(), always)
            flown.append(counts.cpu_s)
        cpu_s = np.min(flown, axis=0)
        for p in (50, 99):
            found[f"{name}_p{p}"] = ("us", 1e6 * float(np.percentile(cpu_s, p)))
        found[f"{name}_iterations_p99"] = ("1", float(np.percentile(counts.iterations, 99)))
    return found
