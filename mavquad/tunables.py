"""The companion's gains as MAVLink parameters: every float of the chosen stages' Params, tunable in flight. Pure.

A name is STAGE_FIELD in capitals without the unit, 16 characters at most (MAVLink's limit), e.g. PID_WC.
"""

import dataclasses
import math
import re
from typing import Any, NamedTuple

from mavquad import slowing
from mavquad.errors import ConfigError
from mavquad.plan import Plan, Stage

_UNIT = re.compile(r"_(rad_s2|rad_s|m_s3|m_s2|m_s|rad|deg|s|m|hz)$")
_PLACES = ("estimator", "controller", "compensator")


class Tunable(NamedTuple):
    name: str
    place: str
    field: str
    value: float


def tunables(plan: Plan) -> tuple[Tunable, ...]:
    """All of them, in a fixed order; names are unique."""
    found: dict[str, Tunable] = {}
    for place in _PLACES:
        stage: Stage | None = getattr(plan, place)
        if stage is None:
            continue
        for field in dataclasses.fields(stage.params):
            value = getattr(stage.params, field.name)
            if isinstance(value, bool) or not isinstance(value, float):
                continue
            prefix = stage.label.partition(":")[0].replace("-", "").upper()[:6]
            name = f"{prefix}_{_UNIT.sub('', field.name).upper()}"[:16]
            n = 2
            while name in found:
                name, n = f"{name[:15]}{n}", n + 1
            found[name] = Tunable(name, place, field.name, value)
    return tuple(found.values())


def change(plan: Plan, name: str, value: float) -> Plan:
    """The plan with one parameter changed. Raises ConfigError for an unknown name, no number, or a value its stage refuses."""
    if not math.isfinite(value):
        raise ConfigError(f"{name} = {value}: expected a finite number")
    for tunable in tunables(plan):
        if tunable.name == name:
            stage: Stage = getattr(plan, tunable.place)
            params: Any = dataclasses.replace(stage.params, **{tunable.field: float(value)})
            changed = stage._replace(params=params, gains=stage.module.gains(params, plan.airframe))
            places: dict[str, Any] = {tunable.place: changed}
            if tunable.place == "controller":
                places["slowed"] = slowing.designs(stage.module, params, plan.airframe)
            return plan._replace(**places)
    known = ", ".join(t.name for t in tunables(plan))
    raise ConfigError(f"no parameter is called {name!r}; known: {known}")
