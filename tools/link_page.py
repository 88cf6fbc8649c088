"""How the link of a recorded flight was, from its tlog: each stream's rate, jitter, longest silence and loss, and all of it over time."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mavquad.link.columns import Log, Stream
from tools import page as html

Array = NDArray[Any]
SILENCE_S = 1.0  # a stream of more than 5 Hz that is silent for longer is said


class Health(NamedTuple):
    """One stream over the whole log."""

    stream: Stream
    rate_hz: float
    jitter_ms: float  # standard deviation of the gaps, silences left out
    longest_s: float
    silences: int


def health(log: Log) -> list[Health]:
    """Every stream, the busiest first."""
    found = []
    for stream in log.streams:
        t_us = log.t_us[log.numbers(stream)]
        gaps_s = 1e-6 * np.diff(t_us)
        if not gaps_s.size:
            continue
        usual = float(np.median(gaps_s))
        near = gaps_s[gaps_s < max(5.0 * usual, 0.02)]
        silences = int((gaps_s > max(SILENCE_S, 5.0 * usual)).sum()) if usual < 0.2 else 0
        found.append(
            Health(stream, 1.0 / usual if usual > 0.0 else float("nan"), 1e3 * float(near.std()), float(gaps_s.max()), silences)
        )
    return sorted(found, key=lambda h: -h.stream.messages)


def losses(log: Log) -> dict[tuple[int, int], tuple[int, int, Array]]:
    """By sender: messages received, messages missing by its sequence numbers, and the log stamps at which they were missed."""
    senders: dict[tuple[int, int], list[tuple[Array, Array]]] = {}
    for stream in log.streams:
        if stream.msgid in log.dialect.classes:
            key = (stream.system, stream.component)
            senders.setdefault(key, []).append((log.numbers(stream), log.rows(stream)["frame_seq"]))
    found = {}
    for key, parts in senders.items():
        numbers = np.concatenate([n for n, _ in parts])
        order = np.argsort(numbers)
        seq = np.concatenate([s for _, s in parts])[order].astype(np.int64)
        gaps = np.mod(np.diff(seq), 256)
        at = np.flatnonzero(gaps > 1)
        lost = np.repeat(log.t_us[numbers[order][at + 1]], gaps[at] - 1)
        found[key] = (int(numbers.size), int(lost.size), lost)
    return found


def section(log: Log, seconds: Any) -> list[str]:
    """The link in figures and tables; `seconds` (m,) of log stamps gives the page's time axis."""
    lost = losses(log)
    start, end = int(log.t_us.min()), int(log.t_us.max())
    edges = np.linspace(start, end + 1, min(600, max(2, (end - start) // 1_000_000 + 1)) + 1)
    width_s = 1e-6 * float(edges[1] - edges[0])
    middle = seconds(0.5 * (edges[1:] + edges[:-1]))
    traces = [html.line("messages received", middle, np.histogram(log.t_us, edges)[0] / width_s, 0)]
    for k, ((system, component), (_, _, at)) in enumerate(sorted(lost.items())):
        if at.size:
            traces.append(
                html.line(f"lost of {system}/{component}", middle, np.histogram(at, edges)[0] / width_s, (3, 1, 4, 6)[k % 4])
            )
    senders = [
        [f"{system}/{component}", received, missing, 100.0 * missing / max(1, received + missing)]
        for (system, component), (received, missing, _) in sorted(lost.items())
    ]
    streams = [
        [
            f"{h.stream.system}/{h.stream.component}",
            h.stream.name,
            h.stream.messages,
            h.rate_hz,
            h.jitter_ms,
            h.longest_s,
            h.silences,
        ]
        for h in health(log)[:40]
    ]
    return [
        html.figure("Messages a second", traces, x="time, s", y="1/s", height=230, linked="time"),
        html.table(["sender", "received", "lost by sequence number", "lost, %"], senders),
        html.table(["sender", "message", "count", "rate, Hz", "jitter, ms", "longest gap, s", "silences > 1 s"], streams),
    ]
