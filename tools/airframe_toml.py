"""An identified vehicle as an airframe file: what the log told with its spread, what it could not with where it comes from instead."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mavquad import airframe, config
from mavquad.airframe import Airframe
from mavquad.errors import LogError
from mavquad.identify.bounds import TICK_S
from mavquad.identify.vehicle import G_M_S2, Figure
from tools.identified import Identified, Response

if TYPE_CHECKING:
    from tools.calibrate import Calibration


def combined(responses: list[Response]) -> tuple[float, float, float, float]:
    """(gain, wn, zeta, delay) of roll and pitch together: the mean, which is all that an airframe file holds."""
    models = [r.found.model for r in responses if r.axis in ("roll", "pitch")]
    if not models:
        raise LogError(
            "no airframe file: the response from commands as sent (SET_ATTITUDE_TARGET) to attitude was not found on roll or pitch;"
            " record a sweep with the companion's own log (mavquad fly sweep)"
        )
    gain, wn, zeta, delay = (float(np.mean([m[k] for m in models])) for k in range(4))
    return gain, wn, zeta, delay


def written(found: Identified, base: Airframe, base_name: str, name: str, calibration: "Calibration | None" = None) -> str:
    """The file's text. `base` gives mass, inertia and rotors, which no log tells; `calibration` gives the bounds.

    Raises LogError where the log has no attitude response.
    """
    log = found.flight.path.name
    sent = found.of("SET_ATTITUDE_TARGET")
    gain, wn, zeta, delay = combined(sent)
    spread = {r.axis: r.found.model.sd for r in sent}

    def pm(k: int) -> str:
        return ", ".join(f"{axis} +-{2.0 * sd[k]:.2g}" for axis, sd in spread.items() if axis != "yaw")

    thrust = found.thrust.hover if found.thrust else None
    hover = thrust.value if thrust else base.hover_thrust
    lines = [
        f"# Identified from {log} (2 sigma beside each number); mass, inertia and rotors are those of {base_name}: no log tells them.",
        f"name = {_text(name)}",
        f"hover_thrust = {hover:.5g}  # "
        + (f"+-{2.0 * thrust.sd:.2g}, {thrust.seconds:.0f} s of hover" if thrust else f"from {base_name}"),
        "",
        "[body]",
        f"mass_kg = {base.body.mass_kg:g}  # from {base_name}",
        f"inertia_kg_m2 = {_numbers(base.body.inertia_kg_m2)}  # from {base_name}",
    ]
    if base.rotors is not None:
        r = base.rotors
        full = base.body.mass_kg * G_M_S2 / (4.0 * hover) if thrust else r.thrust_max_n
        lines += [
            "",
            f"[rotors]  # from {base_name}",
            f"layout = {_text(r.layout)}",
            f"arm_m = {r.arm_m:g}",
            f"thrust_max_n = {full:.5g}" + ("  # weight over hover thrust, by rotor" if thrust else ""),
            f"thrust_min_n = {r.thrust_min_n:g}",
            f"torque_per_thrust_m = {r.torque_per_thrust_m:g}",
            f"lag_s = {found.lift.lag_s:.4g}  # +-{2.0 * found.lift.sd[1]:.2g}" if found.lift else f"lag_s = {r.lag_s:g}",
        ]
    lines += ["", "[drag]"]
    if found.drag is not None:
        mass = base.body.mass_kg
        linear, quadratic = (
            [max(0.0, mass * f.value) for f in pair] for pair in (found.drag.linear_1_s, found.drag.quadratic_1_m)
        )
        d = base.drag
        lines += [
            f"linear_n_s_m = {_numbers((*linear, d.linear_n_s_m[2]))}  # mass times {_both(found.drag.linear_1_s)} 1/s; down from {base_name}",
            f"quadratic_n_s2_m2 = {_numbers((*quadratic, d.quadratic_n_s2_m2[2]))}"
            f"  # mass times {_both(found.drag.quadratic_1_m)} 1/m, up to {found.drag.fastest_m_s:.1f} m/s",
        ]
    else:
        lines += [
            f"linear_n_s_m = {_numbers(base.drag.linear_n_s_m)}  # from {base_name}",
            f"quadratic_n_s2_m2 = {_numbers(base.drag.quadratic_n_s2_m2)}  # from {base_name}",
        ]
    lines += [
        "",
        "[attitude]  # from SET_ATTITUDE_TARGET as sent to ATTITUDE, mean of roll and pitch",
        f"natural_frequency_rad_s = {wn:.5g}  # {pm(1)}",
        f"damping = {zeta:.4g}  # {pm(2)}",
        f"delay_s = {delay:.4f}  # {pm(3)}",
        f"gain = {gain:.4g}  # {pm(0)}",
    ]
    if calibration is not None:
        c = calibration
        lines += [
            "",
            f"[bounds]  # of the set-membership filter, from {c.span_s[0]:.0f}-{c.span_s[1]:.0f} s; each with what set it",
        ]
        lines += [
            f"{key} = {b.value:.4g}  # largest seen {b.largest_seen:.3g} at {b.at_s:.1f} s" for key, b in c.bounds.items()
        ]
        lines.append(f"tick_s = {TICK_S:g}")
    return "\n".join(lines) + "\n"


def write(path: Path, text: str) -> Airframe:
    """Write the file and load it as `fly` and `companion` will. Raises ConfigError where it would be refused."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror}") from None
    return config.convert(config.read(path), airframe.Airframe, str(path))


def _text(value: str) -> str:
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _numbers(values: tuple[float, ...]) -> str:
    return "[" + ", ".join(f"{v:.4g}" for v in values) + "]"


def _both(pair: tuple[Figure, Figure]) -> str:
    return ", ".join(f"{f.value:.3g} +-{2.0 * f.sd:.1g}" for f in pair)
