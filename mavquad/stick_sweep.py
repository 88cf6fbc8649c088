"""The excitation of a helicopter's sticks, on top of its inner loop: every swept stick twice, small known noise on the others.

Source: Song et al. 2011 (paper 004), section 4.2; identification note, section 7. The sticks go on the wire as
SET_ACTUATOR_CONTROL_TARGET of group 3 (passthrough) in the order roll, pitch, yaw, throttle; what the vehicle applied, its inner
loop's share included, comes back as ACTUATOR_CONTROL_TARGET. Joint input-output identification needs both.
"""

import functools

import numpy as np
import numpy.typing as npt

from mavquad.identify import excitation
from mavquad.identify.excitation import Sweep

AXES = ("roll", "pitch", "yaw", "thrust")  # sticks lat, lon, ped, col
PERIOD_S = 0.02  # the sticks change at this period
PASSTHROUGH = 3  # group of SET_ACTUATOR_CONTROL_TARGET
OFF_AXIS = 0.15  # noise on the other sticks, of their own amplitude
DOUBLET_S = 2.0  # each way
SEED = 4  # of the noise: the program is known before the flight

Program = npt.NDArray[np.float64]


@functools.lru_cache(maxsize=4)
def program(
    axes: tuple[str, ...], amplitude: tuple[float, float, float, float], sweep: Sweep, records: int, check_s: float
) -> Program:
    """(n, 4) sticks every PERIOD_S: `records` sweeps of each axis in turn, then doublets of 0.75 of the amplitude on the swept ones."""
    rng = np.random.default_rng(SEED)
    size = np.array(amplitude)
    parts = []
    for axis in axes:
        for _ in range(records):
            part = excitation.record(sweep, PERIOD_S, AXES.index(axis), 4, rng) / sweep.amplitude
            parts.append(part * size)
    t = PERIOD_S * np.arange(round(check_s / PERIOD_S))
    doublets = np.zeros((t.size, 4))
    for k, axis in enumerate(axes):
        mine = (t // (4.0 * DOUBLET_S)).astype(int) % len(axes) == k  # one stick after the other
        doublets[mine, AXES.index(axis)] = (
            0.75 * size[AXES.index(axis)] * np.where(t[mine] % (2.0 * DOUBLET_S) < DOUBLET_S, 1.0, -1.0)
        )
    return np.concatenate([*parts, doublets])


def at(sticks: Program, t_s: float) -> tuple[float, float, float, float]:
    """(lat, lon, ped, col) of the program at `t_s` after its start; zero outside."""
    k = int(t_s / PERIOD_S + 1e-6)
    if t_s < 0.0 or k >= len(sticks):
        return (0.0, 0.0, 0.0, 0.0)
    lat, lon, ped, col = sticks[k].tolist()
    return (lat, lon, ped, col)
