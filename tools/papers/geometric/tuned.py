"""Below 8.3: each method at its best gains for each noise, by grid search, torque known and unknown; and the bank, untuned."""

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from tools.papers.common import Row
from tools.papers.geometric import setup
from tools.papers.geometric.runs import Config, run
from tools.papers.geometric.setup import IDENTITY, ZERO, after, rms
from tools.papers.geometric.tables import row

NOISES_DEG = (0.1, 0.5, 1.0)
JERKS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


def _relay() -> Iterator[Config]:
    for k1, k2 in itertools.product((0.25, 0.5, 1.0, 2.0, 4.0), (0.25, 0.5, 1.0, 2.5, 5.0, 10.0)):
        yield setup.explicit(f"k1={k1:g} k2={k2:g}", "relay", 2, k1, k2)


def _sat() -> Iterator[Config]:
    for wn, layer in itertools.product((0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0), (0.05, 0.2)):
        yield setup.explicit(f"wn={wn:g} phi={layer:g}", "sat", 2, 2.0 * wn * layer, wn * wn * layer, layer=layer)


def _implicit_relay() -> Iterator[Config]:
    for slope in (0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0):
        yield setup.implicit(f"lambda={slope:g}", "implicit-relay", 6.0, 6.0 * slope)


def _super_twisting() -> Iterator[Config]:
    for jerk in JERKS:
        yield setup.implicit(f"L={jerk:g}", "implicit-super-twisting", L=jerk)


def _third_order() -> Iterator[Config]:
    for jerk in JERKS:
        yield setup.implicit(f"L={jerk:g}", "implicit-third-order", L=jerk)


def _kalman_6(noise_deg: float) -> Iterator[Config]:
    for accel in (1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 0.5, 0.7, 1.0):
        yield setup.kalman(f"q_a={accel:g}", accel, 0.0, noise_deg)


def _kalman_9(noise_deg: float) -> Iterator[Config]:
    for accel, walk in itertools.product((0.0, 0.03), (1e-3, 3e-3, 0.01, 0.1, 0.3, 0.6, 1.0, 1.5)):
        yield setup.kalman(f"q_a={accel:g} q_d={walk:g}", accel, walk, noise_deg)


def _difference() -> Iterator[Config]:
    for cutoff_hz in (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0):
        yield Config(f"{cutoff_hz:g} Hz", "difference", cutoff_hz)


def candidates(method: str, noise_deg: float) -> list[Config]:
    """The grid of one method. The Kalman filters are told the true noise."""
    made = {
        "relay": _relay,
        "sat": _sat,
        "implicit relay": _implicit_relay,
        "implicit super-twisting": _super_twisting,
        "implicit third order": _third_order,
        "MEKF 6 states": lambda: _kalman_6(noise_deg),
        "MEKF 9 states": lambda: _kalman_9(noise_deg),
        "difference + Butterworth": _difference,
        "online": lambda: iter([setup.configurations()["online"]]),
        "online-J": lambda: iter([setup.configurations()["online-J"]]),
    }
    return list(made[method]())


METHODS = (
    "relay",
    "sat",
    "implicit relay",
    "implicit super-twisting",
    "implicit third order",
    "MEKF 6 states",
    "MEKF 9 states",
    "difference + Butterworth",
    "online",
    "online-J",
)


def best(method: str, seeds: Sequence[int]) -> list[Row]:
    """The best mean over the seeds for each noise and torque, t >= 1 s, unfiltered, all axes."""
    source = setup.truth()
    keep = after(source, 1.0)
    rows = []
    for (torque, scale), noise_deg in itertools.product((("known", 1.0), ("unknown", 0.0)), NOISES_DEG):
        stimuli = [setup.stimulus(source, noise_deg=noise_deg, seed=seed, torque_scale=scale) for seed in seeds]
        value, setting = math.inf, ""
        for config in candidates(method, noise_deg):
            found = float(np.mean([rms((run(config, s, IDENTITY, ZERO)[0] - source.w)[keep]) for s in stimuli]))
            if found < value:
                value, setting = found, config.name
        more = {"noise_deg": noise_deg, "torque": torque, "setting": setting}
        rows.append(row("8.3", f"tuned {method}", "raw_rms", "rad/s", value, **more))
    return rows
