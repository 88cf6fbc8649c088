"""Many vehicles in one call: plant, attitude and rate loops of each, on all cores; each moves exactly as it would alone.

Eight at a time go side by side in registers (`abreast.py`). Of the others a few take their steps in turn: a step is one long chain
of operations that wait for each other, and what one vehicle waits for another one fills.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from mavquad.jit import COMPILED, kernel_for_threads
from tools.bulk import abreast, rates
from tools.bulk.lanes import WIDTH
from tools.bulk.setup import Prepared

_TURNS = 4  # vehicles that take turns: more of them leave the first-level cache
_PART = 32  # vehicles handed to a thread at once


class Fleet(NamedTuple):
    """Records of n vehicles, (n,) each: VEHICLE, SETPOINT and CONSTANTS of `sitl.state`."""

    vehicles: np.ndarray
    setpoints: np.ndarray
    constants: np.ndarray


def gather(flights: Sequence[Prepared]) -> Fleet:
    """Copies of the vehicles of these flights, as they are now."""
    vehicles = [p.vehicle for p in flights]
    return Fleet(
        _together([v.state.array for v in vehicles]),
        _together([v.setpoint.array for v in vehicles]),
        _together([v.constants.array for v in vehicles]),
    )


def advance(fleet: Fleet, steps: int, threads: int | None = None) -> None:
    """Move every vehicle on by `steps` steps of its loop under the setpoint that it has, its wind held; on all cores unless told."""
    n = len(fleet.vehicles)
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        for _ in pool.map(lambda first: _part(*fleet, first, min(n, first + _PART), steps), range(0, n, _PART)):
            continue


@kernel_for_threads
def _part(vehicles, setpoints, constants, first, last, steps):
    left = first
    while left < last and steps > 0:
        together = COMPILED and left + WIDTH <= last
        for k in range(left, min(last, left + WIDTH)):
            together = together and abreast.fit(vehicles[k], setpoints[k], constants[k])
        if together:
            abreast.advance(vehicles, setpoints, constants, left, steps)
            left += WIDTH
            continue
        right = min(last, left + _TURNS)
        for _ in range(steps):
            for k in range(left, right):
                rates.step_on_truth(vehicles[k], setpoints[k], constants[k])
        left = right


def _together(records: list[np.ndarray]) -> np.ndarray:
    return np.concatenate(records).view(type(records[0]))
