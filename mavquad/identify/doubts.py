"""What is wrong with a recording: gaps, jitter, limits that were met, axes that are not the ones expected. Each in one line.

Source: identification note, sections 4 (step 2) and 10. Gaps are cut, never filled; jitter and limits are told, because the joint
estimate survives them; a stream with foreign axes is refused by whoever needs it.
"""

from collections.abc import Sequence

import numpy as np

from mavquad.identify import timebase

JITTER = 0.1  # 1 sigma of the spacing, of the period
SATURATED = 0.01  # of the samples
MOVING = 0.02  # least standard deviation of what two signs are compared by (rad/s, m/s)
ENOUGH = 50  # samples, below which nothing is compared
OPPOSED = -0.5  # correlation below: the two run against each other
Span = tuple[float, float]


def rhythm(name: str, t_s: np.ndarray, advice: str, spans: Sequence[Span]) -> list[str]:
    """Gaps and jitter of a stream's stamps (n,) within the spans."""
    t = t_s[inside(t_s, spans)]
    if len(t) < 10:
        return []
    steady = timebase.rhythm(t)
    notes = []
    edges = {b for _, b in spans}
    gaps = [(a, b) for a, b in steady.gaps if not any(a <= edge <= b for edge in edges)]
    if gaps:
        longest = max(gaps, key=lambda gap: gap[1] - gap[0])
        notes.append(
            f"{name}: {len(gaps)} gaps, the longest {longest[1] - longest[0]:.2f} s at {longest[0]:.1f} s: cut there; {advice}"
        )
    if steady.jitter > JITTER:
        notes.append(
            f"{name}: stamps spread by {100 * steady.jitter:.0f} % of their period of {1e3 * steady.period_s:.0f} ms"
            f" (expected below {100 * JITTER:.0f} %): phases are less certain; {advice}"
        )
    return notes


def motors_at_limit(t_s: np.ndarray, motors: np.ndarray, spans: Sequence[Span]) -> list[str]:
    """Motor commands (n, k) 0..1 that stand at their own end, near the end of the scale."""
    flown = motors[inside(t_s, spans)]
    if len(flown) < 100:
        return []
    notes = []
    for end, far in ((flown.max(), flown.max() >= 0.9), (flown.min(), flown.min() <= 0.2)):
        share = float(np.mean(np.any(np.abs(flown - end) < 0.002, axis=1)))
        if far and np.ptp(flown) > 0.2 and share > SATURATED:
            notes.append(
                f"SERVO_OUTPUT_RAW: a motor stands at its limit ({1000 + 1000 * end:.0f} us) for {100 * share:.0f} % of the samples"
                f" (expected below {100 * SATURATED:.0f} %): the answer is not linear there; record a smaller sweep"
            )
    return notes


def command_cut(axis: str, sent: timebase.Held, taken: timebase.Held, spans: Sequence[Span]) -> list[str]:
    """An autopilot that stops at its own limit: the command it took is flat where more was asked."""
    t = taken.t_s[inside(taken.t_s, spans)]
    if len(t) < 100:
        return []
    asked, got = timebase.held_at(sent, t), timebase.held_at(taken, t)
    top = float(np.abs(got).max())
    flat = (np.abs(got) > 0.995 * top) & (np.abs(asked) > 1.02 * np.abs(got))
    if float(flat.mean()) <= SATURATED or top < 1e-3:
        return []
    return [
        f"{axis}: the autopilot stops at {np.degrees(top):.0f} deg (ATTITUDE_TARGET) where {np.degrees(np.abs(asked[flat]).max()):.0f} deg"
        f" were asked (SET_ATTITUDE_TARGET), {100 * flat.mean():.0f} % of the samples: not linear there; record a smaller sweep"
    ]


def against(rate: np.ndarray, value: np.ndarray, dt_s: float) -> bool:
    """Whether a rate (n,) runs against the change of what it is the rate of, both on even samples."""
    if len(value) < ENOUGH:
        return False
    change = np.gradient(value, dt_s)
    known = np.isfinite(rate) & np.isfinite(change)
    if known.sum() < ENOUGH or min(np.std(rate[known]), np.std(change[known])) < MOVING:
        return False
    return bool(np.corrcoef(rate[known], change[known])[0, 1] < OPPOSED)


def upside_down(accel_z_m_s2: np.ndarray) -> bool:
    """Whether an accelerometer's z shows +g in flight: FRD shows -g, whatever the vehicle does."""
    known = accel_z_m_s2[np.isfinite(accel_z_m_s2)]
    return bool(len(known) > 0 and np.median(known) > 3.0)


def inside(t_s: np.ndarray, spans: Sequence[Span]) -> np.ndarray:
    """(n,) bool: within any of the spans."""
    keep = np.zeros(len(t_s), bool)
    for start, end in spans:
        keep |= (t_s >= start) & (t_s <= end)
    return keep
