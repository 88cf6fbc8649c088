"""Self-contained pages: text, tables and plotly figures in one HTML file that asks nothing of the network.

The plotting library is imported here alone. Numbers travel as float32, lines are thinned to what a screen shows with their
extremes kept. Colours are the page's own (`var(--c0)` ... `var(--c6)`), so that light, dark and print each get theirs.
"""

import html
import itertools
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

FOLDER = Path(__file__).resolve().parent
POINTS = 3000  # of a line: more than a screen is wide
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
COLOURS = tuple(f"var(--c{i})" for i in range(7))
_numbers = itertools.count()


def page(title: str, sections: Iterable[tuple[str, Sequence[str]]], lead: str = "") -> str:
    """A whole HTML page. `sections` are (heading, pieces of HTML), e.g. from `figure`, `table`, `text`; `lead` is the first screen."""
    body = "".join(f"<section><h2>{html.escape(head)}</h2>{''.join(pieces)}</section>" for head, pieces in sections)
    style, script = ((FOLDER / f"page.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{style}</style></head>'
        f"<body><h1>{html.escape(title)}</h1>{lead}{body}<script>{get_plotlyjs()}</script><script>{script}</script></body></html>\n"
    )


# ---- pieces -----------------------------------------------------------------------------------------------------------
def text(words: str, kind: str = "") -> str:
    """A paragraph; `kind` is "", "quiet", "good", "bad" or "verdict"."""
    return f'<p class="{kind}">{html.escape(words)}</p>'


def code(words: str) -> str:
    """Something to type, as it is."""
    return f"<pre>{html.escape(words)}</pre>"


def cards(entries: Iterable[tuple[str, str, str]]) -> str:
    """(label, value with its unit, note) as a row of boxes."""
    boxes = [
        f'<div class="card"><span>{html.escape(label)}</span><b>{html.escape(value)}</b><span>{html.escape(note)}</span></div>'
        for label, value, note in entries
    ]
    return f'<div class="cards">{"".join(boxes)}</div>'


class Markup(str):
    """HTML that stands in a table as it is."""


def link(words: str, target: str) -> Markup:
    """A link to another page of ours by its relative path; nothing is loaded until somebody follows it."""
    return Markup(f'<a href="{html.escape(target)}">{html.escape(words)}</a>')


def table(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table; numbers to the right, floats with four digits, everything escaped."""
    lines = [list(row) for row in rows]
    numeric = [bool(lines) and all(isinstance(line[i], int | float) for line in lines) for i in range(len(heads))]
    right = [' class="n"' if n else "" for n in numeric]
    top = "".join(f"<th{c}>{html.escape(h)}</th>" for c, h in zip(right, heads, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td{c}>{_cell(x)}</td>" for c, x in zip(right, line, strict=True)) + "</tr>" for line in lines
    )
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def figure(
    title: str, traces: Iterable[Any], *, x: str = "", y: str = "", height: int = 300, linked: str = "", **layout: Any
) -> str:
    """One figure of plotly traces; x and y are axis titles with units; figures with the same `linked` zoom together."""
    traces = list(traces)
    drawn = go.Figure(
        data=traces,
        layout={
            "template": None,
            "title": {
                "text": title,
                "x": 0,
                "xanchor": "left",
                "y": 1,
                "yanchor": "top",
                "pad": {"t": 6},
                "font": {"size": 14},
            },
            "height": height,
            "margin": {"l": 60, "r": 16, "t": 56, "b": 44},
            "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"},
            "showlegend": len(traces) > 1,
            "hovermode": "x unified",
            "xaxis": {"title": {"text": x}},
            "yaxis": {"title": {"text": y}},
            **layout,
        },
    )
    content = json.loads(drawn.to_json())
    content["layout"].pop("template", None)
    data = json.dumps(content, separators=(",", ":")).replace("</", "<\\/")
    return (
        f'<div class="plot" id="plot{next(_numbers)}" data-linked="{html.escape(linked)}" style="min-height:{height}px">'
        f'<script type="application/json">{data}</script></div>'
    )


# ---- traces -----------------------------------------------------------------------------------------------------------
def line(
    name: str, x: Any, y: Any, colour: int = 0, *, dash: str | None = None, width: float = 1.5, points: int = POINTS
) -> Any:
    """A line through (x, y), thinned to about `points` with each stretch's extremes kept."""
    x, y = thin(np.asarray(x, float), np.asarray(y, float), points)
    return go.Scatter(
        x=_f4(x), y=_f4(y), name=name, mode="lines", line={"color": COLOURS[colour], "width": width, "dash": dash}
    )


def band(name: str, x: Any, low: Any, high: Any, colour: int = 5) -> list[Any]:
    """The area between two lines over x (bounds of an estimate)."""
    x, low, high = (np.asarray(v, float) for v in (x, low, high))
    step = max(1, len(x) // POINTS)
    keep = slice(None, None, step)
    edge = {"mode": "lines", "line": {"width": 0, "color": COLOURS[colour]}, "hoverinfo": "skip"}
    return [
        go.Scatter(x=_f4(x[keep]), y=_f4(low[keep]), name=f"{name}, low", showlegend=False, **edge),
        go.Scatter(x=_f4(x[keep]), y=_f4(high[keep]), name=name, fill="tonexty", fillcolor="rgba(128,136,148,0.28)", **edge),
    ]


def dots(name: str, x: Any, y: Any, colour: int = 0, labels: Sequence[str] | None = None) -> Any:
    """Single points, with a text each where labels are given."""
    mark = {"color": COLOURS[colour], "size": 7}
    return go.Scatter(x=_f4(x), y=_f4(y), name=name, mode="markers", marker=mark, text=labels, hoverinfo="all")


def histogram(name: str, values: Any, colour: int = 0, bins: int = 60) -> Any:
    """How often: counted here, so that the page carries the bins and not the values."""
    counts, edges = np.histogram(np.asarray(values, float), bins=bins)
    return go.Bar(
        x=_f4(0.5 * (edges[1:] + edges[:-1])), y=counts, width=_f4(np.diff(edges)), name=name, marker={"color": COLOURS[colour]}
    )


def bars(name: str, labels: Sequence[str], values: Sequence[float], colour: int = 0) -> Any:
    """One bar per label."""
    return go.Bar(x=list(labels), y=_f4(values), name=name, marker={"color": COLOURS[colour]})


def boxes(name: str, categories: Sequence[str], values: Any, colour: int = 0, labels: Sequence[str] | None = None) -> Any:
    """The distribution of values in each category as a box, every value beside it; `labels` are shown under the pointer."""
    mark = {"color": COLOURS[colour], "size": 4}
    return go.Box(
        x=list(categories), y=_f4(values), name=name, marker=mark, line={"width": 1.5}, boxpoints="all", jitter=0.4,
        pointpos=0.0, text=labels, hoverinfo="all",
    )  # fmt: skip


def spans(entries: Iterable[tuple[str, float, float, str, int]]) -> list[Any]:
    """(row, from, to, what, colour) as bars on a time line."""
    return [
        go.Bar(
            y=[row],
            x=[to - start],
            base=[start],
            orientation="h",
            name=what,
            hovertext=f"{what}: {start:.2f} to {to:.2f} s",
            hoverinfo="text",
            text=what,
            textposition="inside",
            insidetextanchor="start",
            marker={"color": COLOURS[colour]},
            showlegend=False,
        )
        for row, start, to, what, colour in entries
    ]


def path3d(
    title: str,
    paths: Iterable[tuple[str, Any, int]],
    arrows: tuple[Any, Any] | None = None,
    height: int = 460,
) -> str:
    """Paths in space from NED positions (n, 3), drawn as east, north, up [m]; `arrows` are (positions, vectors) NED, e.g. wind."""
    traces = []
    for name, p_ned_m, colour in paths:
        p = np.asarray(p_ned_m, float)
        p = p[:: max(1, len(p) // POINTS)]
        traces.append(
            go.Scatter3d(
                x=_f4(p[:, 1]),
                y=_f4(p[:, 0]),
                z=_f4(-p[:, 2]),
                name=name,
                mode="lines",
                line={"color": COLOURS[colour], "width": 4},
            )
        )
    if arrows is not None:
        at, along = (np.asarray(a, float) for a in arrows)
        scale = 0.25 * max(float(np.ptp(at, axis=0).max()), 1.0) / max(float(np.linalg.norm(along, axis=1).max()), 1e-9)
        gap = np.full_like(at, np.nan)
        segments = np.stack([at - scale * along, at, gap], axis=1).reshape(-1, 3)  # blowing onto the path, the head on it
        e, n, u = _f4(segments[:, 1]), _f4(segments[:, 0]), _f4(-segments[:, 2])
        sizes = np.tile([0, 4, 0], len(at)).tolist()
        look = {"line": {"color": COLOURS[5], "width": 2}, "marker": {"color": COLOURS[5], "size": sizes, "line": {"width": 0}}}
        traces.append(go.Scatter3d(x=e, y=n, z=u, name="wind", mode="lines+markers", **look))
    axes = {
        f"{axis}axis": {"title": {"text": name}} for axis, name in zip("xyz", ("east, m", "north, m", "up, m"), strict=True)
    }
    scene = {**axes, "aspectmode": "data", "domain": {"y": [0.0, 0.94]}}
    return figure(title, traces, height=height, hovermode="closest", scene=scene, margin={"l": 0, "r": 0, "t": 56, "b": 0})


def thin(x: np.ndarray, y: np.ndarray, points: int) -> tuple[np.ndarray, np.ndarray]:
    """At most about `points` of (x, y): the lowest and the highest of each stretch, in order. NaNs are gaps and stay."""
    if len(x) <= points:
        return x, y
    size = -(-len(x) // (points // 2))
    padded = np.full(-(-len(y) // size) * size, np.nan)
    padded[: len(y)] = y
    blocks = padded.reshape(-1, size)
    at = np.arange(0, len(padded), size)
    lowest = np.where(np.isnan(blocks), np.inf, blocks).argmin(1)
    highest = np.where(np.isnan(blocks), -np.inf, blocks).argmax(1)
    keep = np.unique(np.concatenate([[0, len(x) - 1], at + lowest, at + highest]))
    return x[keep], y[keep]


def _f4(values: Any) -> np.ndarray:
    return np.asarray(values, np.float32)


def _cell(value: Any) -> str:
    return value if isinstance(value, Markup) else html.escape(_shown(value))


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "-" if np.isnan(value) else f"{value:.4g}"
    return "-" if value is None else str(value)
