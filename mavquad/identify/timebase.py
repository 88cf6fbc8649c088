"""One clock for a log: arrival stamps onto the vehicle's boot clock, and irregular samples onto even ones.

Commands as sent carry the recorder's stamp, telemetry the vehicle's. The lower edge of (arrival - boot) over the log is the
offset of the two clocks plus the shortest way of a message; what lies above it is jitter.
"""

from typing import NamedTuple

import numpy as np

from mavquad.errors import LogError

REBOOT_S = 1.0  # a boot clock that steps back by more has restarted


class Clock(NamedTuple):
    """Vehicle time from arrival time: a line, or a broken line where the two clocks do not keep step."""

    arrival_s: np.ndarray  # (k,) knots, at least two
    boot_s: np.ndarray  # (k,)
    drift_ppm: float  # arrival against vehicle time, over the whole log
    unsteady_s: float  # largest distance of the knots from one line
    jitter_s: np.ndarray  # (n,) how much later than the shortest way each message arrived


SAME = Clock(np.array([0.0, 1.0]), np.array([0.0, 1.0]), 0.0, 0.0, np.zeros(0))  # a log kept aboard
UNSTEADY_S = 0.01


class Held(NamedTuple):
    """A value that stays until the next one: commands."""

    t_s: np.ndarray  # (n,)
    value: np.ndarray  # (n,)


class Sampled(NamedTuple):
    """Samples of something smooth: telemetry."""

    t_s: np.ndarray  # (n,)
    value: np.ndarray  # (n,)


class Rhythm(NamedTuple):
    """How regularly a stream comes."""

    period_s: float
    jitter: float  # 1 sigma of the spacing over the period, gaps excluded
    gaps: tuple[tuple[float, float], ...]  # (from, to), longer than three samples


def clock(arrival_s: np.ndarray, boot_s: np.ndarray) -> Clock:
    """The line under (arrival - boot), from the least delayed message of every second; broken into pieces of 5 s where one line does
    not hold to 10 ms (a simulator that stalls, a recorder that was paused). Raises LogError below 10 messages.
    """
    if len(arrival_s) < 10:
        raise LogError(
            f"{len(arrival_s)} stamped messages are too few to relate the clocks; record at least a minute of ATTITUDE"
        )
    offset = arrival_s - boot_s
    least = _least(boot_s, offset, 1.0)
    if len(least) < 3:
        knots, level = boot_s[[0, -1]], np.full(2, offset.min())
        drift = unsteady = 0.0
    else:
        drift, zero = np.polyfit(boot_s[least] - boot_s[0], offset[least], 1)
        unsteady = float(np.max(np.abs(offset[least] - zero - drift * (boot_s[least] - boot_s[0]))))
        if unsteady <= UNSTEADY_S:
            knots = boot_s[[0, -1]]
            level = zero + drift * (knots - boot_s[0])
        else:
            few = _least(boot_s, offset, 5.0)
            knots, level = boot_s[few], offset[few]
    late = offset - np.interp(boot_s, knots, level)
    ahead = np.concatenate([[True], np.diff(knots + level) > 0.0])
    return Clock((knots + level)[ahead], knots[ahead], 1e6 * float(drift), unsteady, late - np.percentile(late, 1.0))


def to_vehicle_s(one: Clock, arrival_s: np.ndarray) -> np.ndarray:
    """Vehicle time of arrival stamps; beyond the knots at the rate of the outermost two."""
    inside = np.interp(arrival_s, one.arrival_s, one.boot_s)
    first = (one.boot_s[1] - one.boot_s[0]) / (one.arrival_s[1] - one.arrival_s[0])
    last = (one.boot_s[-1] - one.boot_s[-2]) / (one.arrival_s[-1] - one.arrival_s[-2])
    return (
        inside + first * np.minimum(arrival_s - one.arrival_s[0], 0.0) + last * np.maximum(arrival_s - one.arrival_s[-1], 0.0)
    )


def _least(boot_s: np.ndarray, offset: np.ndarray, block_s: float) -> np.ndarray:
    """Index of the least offset in every block of time, in order of time."""
    block = np.floor((boot_s - boot_s[0]) / block_s).astype(int)
    order = np.lexsort((offset, block))
    return order[np.unique(block[order], return_index=True)[1]]


def longest_epoch(boot_s: np.ndarray) -> slice:
    """The longest run of samples between restarts of the boot clock."""
    cuts = np.flatnonzero(np.diff(boot_s) < -REBOOT_S) + 1
    edges = np.concatenate([[0], cuts, [len(boot_s)]])
    k = int(np.argmax(np.diff(edges)))
    return slice(int(edges[k]), int(edges[k + 1]))


def rhythm(t_s: np.ndarray) -> Rhythm:
    """Median spacing, jitter and gaps of a stream's stamps. Raises LogError below 3 samples."""
    if len(t_s) < 3:
        raise LogError(f"{len(t_s)} samples are no stream")
    spacing = np.diff(t_s)
    period = float(np.median(spacing[spacing > 0.0])) if np.any(spacing > 0.0) else 0.0
    wide = np.flatnonzero(spacing > 3.5 * period)
    inside = spacing[spacing <= 3.5 * period]
    return Rhythm(period, float(np.std(inside)) / period, tuple((float(t_s[i]), float(t_s[i + 1])) for i in wide))


def held_mean(signal: Held, edges_s: np.ndarray) -> np.ndarray:
    """(n,) the mean of a held signal between successive `edges_s` (n + 1,): exact, whatever the spacing of the commands."""
    area = np.concatenate([[0.0], np.cumsum(signal.value[:-1] * np.diff(signal.t_s))])
    inside = np.clip(edges_s, signal.t_s[0], None)
    integral = np.interp(inside, signal.t_s, area)
    integral += np.maximum(inside - signal.t_s[-1], 0.0) * signal.value[-1]
    integral += np.minimum(edges_s - signal.t_s[0], 0.0) * signal.value[0]
    return np.diff(integral) / np.diff(edges_s)


def held_at(signal: Held, t_s: np.ndarray) -> np.ndarray:
    """(n,) the held value at each time; before the first command its value."""
    at = np.clip(np.searchsorted(signal.t_s, t_s, side="right") - 1, 0, len(signal.t_s) - 1)
    return signal.value[at]


def monotone(t_s: np.ndarray, value: np.ndarray) -> Sampled:
    """Sorted, repeated stamps dropped, values that are not finite left out."""
    order = np.argsort(t_s, kind="stable")
    t, v = t_s[order], value[order]
    keep = np.concatenate([[True], np.diff(t) > 0.0]) & np.isfinite(v)
    return Sampled(t[keep], v[keep])
