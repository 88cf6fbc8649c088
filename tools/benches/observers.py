"""The rate observers: one sample inside a compiled loop, and one from Python."""

import math
import time
from collections.abc import Callable

import numpy as np

from mavquad import signals
from mavquad.estimate import gsmo
from tools.benches import Row

PERIOD_US = 4_000
NOTES = {"online": "limit 12 us compiled"}


def measure(seconds: float) -> list[Row]:
    """Microseconds of CPU time per sample, the least of several passes, for every variant."""
    n = max(500, round(1000 * seconds))
    t = 1e-6 * PERIOD_US * np.arange(n)
    half = 0.15 * np.sin(t)
    q = np.column_stack([np.cos(half), np.sin(half), np.zeros(n), np.zeros(n)])
    t_us = (PERIOD_US * np.arange(n)).astype(np.int64)
    samples = [signals.Attitude(int(t_us[k]), tuple(q[k].tolist()), signals.ZERO3) for k in range(min(n, 2000))]
    rows = []
    for variant in gsmo.VARIANTS:
        gains = gsmo.gains(gsmo.Params(variant=variant))

        def bulk(gains: gsmo.Gains = gains) -> None:
            gsmo.run_record(gains, t_us, q)

        def live(gains: gsmo.Gains = gains) -> None:
            state = gsmo.init(gains)
            for sample in samples:
                state = gsmo.observe(gains, state, sample)

        note = NOTES.get(variant, "limits 1 us compiled, 10 us from Python")
        rows.append(Row(f"{variant}, compiled loop", "mavquad", _least_us(bulk, n), "us", note))
        rows.append(Row(f"{variant}, from Python", "mavquad", _least_us(live, len(samples)), "us", ""))
    return rows


def _least_us(work: Callable[[], None], count: int) -> float:
    work()  # compiled, and in the caches
    least = math.inf
    for _ in range(4):
        begun = time.thread_time()
        work()
        least = min(least, (time.thread_time() - begun) / count)
    return 1e6 * least
