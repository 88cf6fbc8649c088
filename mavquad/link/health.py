"""Rate, age and sequence loss of what arrives: a pure step per frame."""

from typing import NamedTuple


class Source(NamedTuple):
    """Sequence counter of one (system, component)."""

    seq: int
    received: int
    lost: int


def on_frame(source: Source | None, seq: int) -> Source:
    """Count a frame; a gap of up to 127 in the 8-bit counter is loss, a step back is a late frame or a restart."""
    if source is None:
        return Source(seq, 1, 0)
    gap = (seq - source.seq - 1) & 0xFF
    if gap < 128:
        return Source(seq, source.received + 1, source.lost + gap)
    return Source(source.seq, source.received + 1, max(0, source.lost - 1))


class Stream(NamedTuple):
    """Arrival of one message."""

    messages: int
    last_us: int
    period_us: float  # smoothed
    jitter_us: float  # smoothed absolute deviation from the period


def on_message(stream: Stream | None, arrival_us: int) -> Stream:
    """Count a message that arrived now."""
    if stream is None:
        return Stream(1, arrival_us, 0.0, 0.0)
    gap = float(arrival_us - stream.last_us)
    if stream.messages == 1:
        return Stream(2, arrival_us, gap, 0.0)
    k = 1.0 / min(stream.messages, 50)
    period = stream.period_us + k * (gap - stream.period_us)
    jitter = stream.jitter_us + k * (abs(gap - period) - stream.jitter_us)
    return Stream(stream.messages + 1, arrival_us, period, jitter)


def rate_hz(stream: Stream) -> float:
    """Smoothed rate; 0 before the second message."""
    return 1e6 / stream.period_us if stream.period_us > 0.0 else 0.0


def age_s(stream: Stream, now_us: int) -> float:
    return 1e-6 * (now_us - stream.last_us)
