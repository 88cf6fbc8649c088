"""The page of `mavquad identify`: Bode plots with coherence and error bands, model over data, the check, the tables."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mavquad.identify import attitude, fit, structures
from tools import bode, page
from tools.identified import Identified, Response

if TYPE_CHECKING:
    from tools.calibrate import Calibration
    from tools.identify_hover import Hover


def page_of(everything: Sequence[Identified], calibrations: "Sequence[Calibration]" = ()) -> str:
    """One page for one or several logs, with their bounds where they were asked for."""
    sections = [section for found in everything for section in _sections(found)]
    for c in calibrations:
        rows = [[key, b.value, b.unit, b.largest_seen, b.at_s] for key, b in c.bounds.items()]
        tried = (
            f"Tried by the filter over {c.span_s[0]:.0f}-{c.span_s[1]:.0f} s: {c.own.contradictions} contradictions"
            f" ({c.default.contradictions} with the default bounds). Guaranteed while noise and changes stay within these bounds."
        )
        table = page.table(["bound", "value", "unit", "largest seen", "at, s"], rows)
        sections.append(("Bounds for the set-membership filter", [table, page.text(tried)]))
    names = ", ".join(found.flight.path.name for found in everything)
    lead = page.text(
        "ATTITUDE_TARGET is what the autopilot made of the command: on ArduCopter after its own shaping, so it shows the inner loop."
    )
    return page.page(f"mavquad identify: {names}", sections, lead)


def _sections(found: Identified) -> list[tuple[str, list[str]]]:
    name = found.flight.path.name
    sections = [(f"{name}: what was found", [_models(found), _vehicle(found)])]
    for r in found.responses:
        sections.append((f"{r.axis} from {r.source}", _response(r)))
    for h in found.hover:
        sections.append((f"hover model, {h.name}", _hover(h)))
    noise = [[key, n.white, n.slow, n.step] for key, n in found.noise.items()]
    sections.append(("Noise of every stream (1 sigma)", [page.table(["field", "white", "with the slow part", "step"], noise)]))
    sections.append(("Not from this log", [page.text(text) for text in found.missing] or [page.text("nothing is missing")]))
    if found.notes:
        sections.append(("Notes", [page.text(text) for text in found.notes]))
    return sections


def _models(found: Identified) -> str:
    rows = []
    for r in found.responses:
        m = r.found.model
        for label, value, sd in zip(("gain", "wn, rad/s", "zeta", "delay, s"), m[:4], m.sd, strict=True):
            rows.append([r.axis, r.source, label, value, 2.0 * sd if np.isfinite(sd) else None])
        rows.append([r.axis, r.source, "63 % of a step, s", r.t63_s, None])
    return page.table(["axis", "from", "parameter", "value", "+-2 sigma"], rows)


def _vehicle(found: Identified) -> str:
    rows = []
    if found.thrust:
        rows += [["hover thrust", found.thrust.hover.value, 2.0 * found.thrust.hover.sd]]
        rows += [["thrust gain, m/s^2", found.thrust.gain_m_s2.value, 2.0 * found.thrust.gain_m_s2.sd]]
    if found.lift:
        for label, value, sd in zip(("gain, m/s^2", "lag, s", "delay, s"), found.lift[:3], found.lift.sd, strict=True):
            rows += [[f"thrust response {label}", value, 2.0 * sd]]
    if found.drag:
        for axis, a, b in zip(("forward", "right"), found.drag.linear_1_s, found.drag.quadratic_1_m, strict=True):
            rows += [[f"drag {axis}, 1/s", a.value, 2.0 * a.sd], [f"drag {axis}, 1/m", b.value, 2.0 * b.sd]]
    rows += [[f"gyro filter {axis}, Hz", g.cutoff_hz.value, 2.0 * g.cutoff_hz.sd] for axis, g in found.gyro.items()]
    rows += [
        [f"torque/inertia {axis}, rad/s^2", t.gain_rad_s2.value, 2.0 * t.gain_rad_s2.sd] for axis, t in found.torque.items()
    ]
    return page.table(["vehicle", "value", "+-2 sigma"], rows)


def _hover(h: "Hover") -> list[str]:
    """Parameters with their bars, every pair that was told from the sweeps, the doublets that were not fitted."""
    f, response = h.found, h.response
    rows: list[list[object]] = [
        [name, value, 2.0 * sd] for name, value, sd in zip(f.structure.free, f.theta.tolist(), f.sd.tolist(), strict=True)
    ]
    rows += [[f"{name} (held)", value, None] for name, value in f.structure.fixed.items()]
    pieces = [
        page.text(f"chi2 {f.chi2:.2f}, J {f.j:.0f}, {f.agreeing} of {f.starts} starts agree", "verdict"),
        page.table(["parameter", "value", "+-2 sigma"], rows),
        *(page.text(note) for note in h.notes),
    ]
    model = f.structure.build(f.parameters)
    late = np.exp(-1j * response.omega_rad_s[:, None] * structures.delays_s(f.structure, f.parameters))
    modelled = fit.sampled_response(model, response.omega_rad_s, response.dt_s) * late[:, None, :]
    for i, output in enumerate(f.structure.outputs):
        for j, stick in enumerate(f.structure.inputs):
            if np.count_nonzero(response.coherence[:, i, j] >= fit.COHERENCE_FLOOR) >= fit.FEWEST_POINTS:
                pieces += bode.bode(f"{output} from {stick}", response, (i, j), [("model", modelled[:, i, j])])
    if h.check is not None:
        t = response.dt_s * np.arange(len(h.check.measured))
        for i, output in enumerate(f.structure.outputs):
            lines = [page.line("measured", t, h.check.measured[:, i]), page.line("predicted", t, h.check.predicted[:, i], 1)]
            title = f"{output} of doublets, not fitted, 3 s ahead: fit {h.check.fit_pct[i]:.1f} %, TIC {h.check.tic[i]:.3f}"
            pieces.append(page.figure(title, lines, x="s", linked=h.name))
    return pieces


def _response(r: Response) -> list[str]:
    measured = r.found.response
    modelled = attitude.second_order(r.found.model[:4], measured.omega_rad_s)
    pieces = bode.bode(f"{r.source} to attitude, {r.axis}", measured, (0, 0), [("model", modelled)])
    inside = r.found.f_hz <= 10.0
    pieces.append(
        page.figure(
            "coherence, 10 s segments",
            [page.line("coherence", r.found.f_hz[inside], r.found.coherence[inside])],
            x="Hz",
            height=180,
        )
    )
    for c in r.checks:
        lines = [
            page.line("measured", c.t_s, np.degrees(c.measured)),
            page.line("predicted", c.t_s, np.degrees(c.predicted), 1),
        ]
        title = f"not fitted, {c.span_s[0]:.0f}-{c.span_s[1]:.0f} s: fit {c.fit_pct:.1f} %, TIC {c.tic:.3f}"
        pieces.append(page.figure(title, lines, x="s of the log", y=f"{r.axis}, deg"))
    return pieces
