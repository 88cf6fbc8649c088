"""Filters stepped many times in one compiled call, for `mavquad bench growth`."""

import numpy as np

from mavquad.estimate import asmf, ekf
from mavquad.jit import kernel


@kernel
def set_membership(
    gains: asmf.Gains, state: asmf.State, f: np.ndarray, drive: np.ndarray, y: np.ndarray, late: np.ndarray
) -> asmf.State:
    """The state after one predict and update for each row of y (k, m)."""
    for k in range(y.shape[0]):
        state = asmf.predict(gains, state, f, drive, 1.0, 20_000 * k)
        state = asmf.update(gains, state, y[k], late, 20_000 * k)
    return state


@kernel
def kalman(gains: ekf.EkfGains, state: ekf.EkfState, u: ekf.Input, z: ekf.Row12, dt_s: float, steps: int) -> ekf.EkfState:
    """The state after so many steps on one measurement."""
    for _ in range(steps):
        state = ekf.step(gains, state, u, z, dt_s)
    return state
