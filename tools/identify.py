"""mavquad identify: frequency responses, a fitted model with confidence, an airframe file the companion can fly with.

Works from recordings alone, of any autopilot: the attitude response from the commands as sent (SET_ATTITUDE_TARGET) and from what the
autopilot made of them (ATTITUDE_TARGET; on ArduCopter after its own input shaping: the inner loop only), hover thrust, drag, the gyro's
own filter, torque per command, noise of every stream, link jitter; of a helicopter whose sticks were swept the hover model. What this log cannot tell is said, with what to record.

Example: mavquad identify flight.tlog --out mine.toml --report mine.html
"""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavquad import airframe
from mavquad.errors import ConfigError, LogError
from tools import airframe_toml, identified, identify_log
from tools.identified import Identified, Span

if TYPE_CHECKING:
    from tools.calibrate import Calibration
    from tools.identify_hover import Hover

THRUST_LAG_S = 0.05  # of an airframe that says nothing of its rotors


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, nargs="+", help="tlog, ULog or DataFlash log")
    parser.add_argument("--out", type=Path, metavar="FILE.toml", help="write an airframe file for `fly` and `companion`")
    parser.add_argument(
        "--airframe", default="x500", help="gives what no log tells: mass, inertia, rotors (default: %(default)s)"
    )
    parser.add_argument("--name", help="of the airframe written (default: that of its file)")
    parser.add_argument("--bounds", action="store_true", help="also noise and rate bounds for the set-membership filter")
    parser.add_argument("--fit", metavar="A-B", help="seconds of the log to fit (default: where one axis is swept)")
    parser.add_argument(
        "--check", metavar="A-B", help="seconds of the log to predict (default: moving parts that are not fitted)"
    )
    parser.add_argument("--report", type=Path, metavar="FILE", help="write a self-contained HTML page")
    parser.add_argument("--json", action="store_true", help="everything, for machines, on stdout")


def run(args: argparse.Namespace) -> int:
    if args.out and len(args.log) > 1:
        raise ConfigError(f"--out takes one log, got {len(args.log)}; an airframe file comes from one flight")
    fit_s, check_s = span(args.fit, "--fit"), span(args.check, "--check")
    base = airframe.load(args.airframe)
    everything: list[Identified] = []
    calibrations: list[Calibration] = []
    problems: list[str] = []
    for path in args.log:
        print(f"reading {path}", file=sys.stderr, flush=True)
        found = identified.identify(identify_log.read(path), fit_s, check_s)
        everything.append(found)
        if args.bounds:
            from tools import calibrate  # the filter's kernels: only where it is tried

            calibrations.append(calibrate.calibrate(found, base.rotors.lag_s if base.rotors else THRUST_LAG_S))
        if not found.of("SET_ATTITUDE_TARGET") and not (found.hover and not args.out) and (args.out or not args.bounds):
            reasons = [m for m in found.missing if "SET_ATTITUDE_TARGET" in m]
            problems.append(f"{path}: no response from commands as sent: {reasons[0] if reasons else 'nothing was commanded'}")
    if args.json:
        logs = [identified.summary(found) for found in everything]
        for one, calibration in zip(logs, calibrations, strict=False):
            one["bounds"] = _bounds_summary(calibration)
        json.dump({"logs": _plain(logs)}, sys.stdout, allow_nan=False)
        print()
    else:
        shown = [text(found) for found in everything]
        for i, calibration in enumerate(calibrations):
            shown[i] += "\n\n" + bounds_text(calibration)
        print("\n\n".join(shown))
    if args.report:
        from tools import identify_page

        args.report.write_text(identify_page.page_of(everything, calibrations), encoding="utf-8")
        print(f"report: {args.report}", file=sys.stderr)
    if problems:
        raise LogError(problems[0])
    if args.out:
        name = args.name or args.out.stem
        own = calibrations[0] if calibrations else None
        airframe_toml.write(args.out, airframe_toml.written(everything[0], base, args.airframe, name, own))
        print(f"airframe: {args.out} (mass, inertia and rotors from {args.airframe})", file=sys.stderr)
    return 0


def span(text: str | None, option: str) -> Span | None:
    """`200-230` -> (200.0, 230.0). Raises ConfigError."""
    if text is None:
        return None
    first, _, last = text.partition("-")
    try:
        found = float(first), float(last)
    except ValueError:
        raise ConfigError(f"{option} {text!r}: expected two times in seconds of the log, like 200-230") from None
    if not found[1] > found[0] >= 0.0:
        raise ConfigError(f"{option} {text!r}: the second time must be after the first")
    return found


def text(found: Identified) -> str:
    """One log's findings for a terminal."""
    flight = found.flight
    air = ", ".join(f"{a:.0f}-{b:.0f} s" for a, b in flight.flying) or "never"
    lines = [f"{flight.path}: {flight.messages} messages, {flight.length_s:.0f} s, in the air {air}", ""]
    if found.responses:
        lines.append(
            "attitude response          gain         wn rad/s      zeta         delay ms    63 %   coherence  chi2  predicts"
        )
    for r in found.responses:
        m = r.found.model
        checks = " ".join(f"{c.fit_pct:.0f} % at {c.span_s[0]:.0f}-{c.span_s[1]:.0f} s" for c in r.checks) or "nothing left"
        lines.append(
            f"{r.axis:5} {r.source:20} {_pm(m.gain, m.sd[0], 3):12} {_pm(m.omega_n_rad_s, m.sd[1], 1):13} {_pm(m.zeta, m.sd[2], 2):12}"
            f" {_pm(1e3 * m.delay_s, 1e3 * m.sd[3], 0):9} {1e3 * r.t63_s:5.0f} ms {r.coherence_min:8.3f} {m.chi2:6.1f}  {checks}"
        )
    if found.responses:
        lines += ["  (+- is 2 sigma; coherence: the least from 0.2 to 4 Hz; ATTITUDE_TARGET shows the inner loop only)", ""]
    lines += [line for h in found.hover for line in hover_text(h)]
    if found.thrust:
        t = found.thrust
        divides = "; it divides thrust by cos(tilt) itself" if t.over_cosine else ""
        lines.append(
            f"hover thrust      {_pm(t.hover.value, t.hover.sd, 4)}; thrust gain {_pm(t.gain_m_s2.value, t.gain_m_s2.sd, 2)} m/s^2{divides}"
        )
    if found.lift:
        up = found.lift
        lines.append(
            f"thrust response   lag {_pm(1e3 * up.lag_s, 1e3 * up.sd[1], 1)} ms, delay {_pm(1e3 * up.delay_s, 1e3 * up.sd[2], 1)} ms,"
            f" gain {_pm(up.gain_m_s2, up.sd[0], 2)} m/s^2, chi2 {up.chi2:.1f}"
        )
    if found.drag:
        d = found.drag
        for i, axis in enumerate(("forward", "right")):
            a, b = d.linear_1_s[i], d.quadratic_1_m[i]
            lines.append(
                f"drag, {axis:8}    ({_pm(a.value, a.sd, 3)} 1/s + {_pm(b.value, b.sd, 4)} |v| 1/m) v, up to {d.fastest_m_s:.1f} m/s"
            )
    for axis, g in found.gyro.items():
        seen = math.isfinite(g.cutoff_hz.value)
        filtered = f"{_pm(g.cutoff_hz.value, g.cutoff_hz.sd, 1)} Hz, two poles" if seen else "none seen"
        lines.append(f"gyro filter {axis:5} {filtered}: rates are {1e3 * g.lag_s:.1f} ms late")
    for axis, q in found.torque.items():
        signs = "".join("+" if p > 0 else "-" if p < 0 else "0" for p in q.pattern)
        lines.append(
            f"torque/inertia {axis:5} {_pm(q.gain_rad_s2.value, q.gain_rad_s2.sd, 0)} rad/s^2 per full command, motors {signs}"
        )
    if flight.clock.jitter_s.size:
        late = sorted(flight.clock.jitter_s)
        lines.append(
            f"link              clock drift {flight.clock.drift_ppm:.0f} ppm, messages late by {1e3 * late[len(late) // 2]:.1f} ms"
            f" (median), {1e3 * late[int(0.99 * len(late))]:.1f} ms (99 %)"
        )
    if flight.round_trip_s.size:
        trip = sorted(flight.round_trip_s)
        lines.append(
            f"                  TIMESYNC answered after {1e3 * trip[len(trip) // 2]:.1f} ms (median), {1e3 * trip[int(0.99 * len(trip))]:.1f} ms"
            f" (99 %), {len(trip)} of them"
        )
    if found.noise:
        lines += ["", "noise (1 sigma): white, with the slow part"]
        lines += [f"  {name:28} {n.white:.2g}  {n.slow:.2g}" for name, n in found.noise.items()]
    lines += ["", "not from this log:"] + [f"  {m}" for m in found.missing]
    if found.notes:
        lines += ["", "notes:"] + [f"  {n}" for n in found.notes]
    return "\n".join(lines)


def hover_text(h: "Hover") -> list[str]:
    """One part of a helicopter's hover model: every parameter with its bar, how it predicts, what is doubtful."""
    f = h.found
    lines = [f"hover model, {h.name}: chi2 {f.chi2:.2f}, J {f.j:.0f}, {f.agreeing} of {f.starts} starts agree"]
    for name, value, sd in zip(f.structure.free, f.theta, f.sd, strict=True):
        lines.append(f"  {name:10} {value:10.4g} +- {2.0 * sd:.2g}")
    held = ", ".join(f"{name} = {value:.4g}" for name, value in f.structure.fixed.items())
    lines.append(f"  held: {held}")
    if h.late_s:
        lines.append(
            f"  the sticks are stamped {-1e3 * h.late_s:.1f} ms late; taken out before the fit, the delays are what is left"
        )
    if h.check is not None:
        fits = " ".join(
            f"{o} {p:.0f} % (TIC {t:.2f})" for o, p, t in zip(h.structure.outputs, h.check.fit_pct, h.check.tic, strict=True)
        )
        lines.append(f"  doublets, 3 s ahead: {fits}")
    return [*lines, *(f"  {note}" for note in h.notes), ""]


def bounds_text(c: "Calibration") -> str:
    """The bounds of the set-membership filter for a terminal, each with the part of the log that set it."""
    lines = [
        f"bounds for the set-membership filter, from {c.span_s[0]:.0f}-{c.span_s[1]:.0f} s, commands {c.source}, per tick of 20 ms:",
        *(
            f"  {key:20} {b.value:.4g} {b.unit:15} largest seen {b.largest_seen:.3g} at {b.at_s:.1f} s"
            for key, b in c.bounds.items()
        ),
        f"  the filter over this flight: {c.own.contradictions} contradictions, half-width of f {c.own.half_width_m_s2:.2f} m/s^2;"
        f" with the default bounds {c.default.contradictions} and {c.default.half_width_m_s2:.2f} m/s^2",
        "  guaranteed while a flight's noise and changes stay within these; what did not happen in this log is covered by the margin only",
    ]
    if c.rounds:
        lines.append(f"  widened {c.rounds} times by 15 % until nothing contradicted")
    if c.own.contradictions:
        lines.append(
            f"  STILL contradicted, first at {c.own.first_s:.1f} s: the model does not fit this flight; do not fly with these"
        )
    return "\n".join(lines)


def _bounds_summary(c: "Calibration") -> dict[str, Any]:
    return {
        "span_s": c.span_s,
        "input": c.source,
        "rounds": c.rounds,
        **{key: b._asdict() for key, b in c.bounds.items()},
        "own": c.own._asdict(),
        "default": c.default._asdict(),
    }


def _pm(value: float, sd: float, digits: int) -> str:
    return f"{value:.{digits}f}+-{2.0 * sd:.{digits}f}" if math.isfinite(sd) else f"{value:.{digits}f}+-?"


def _plain(value: Any) -> Any:
    """JSON knows no infinity: what is not told is null."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
