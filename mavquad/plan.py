"""What is decided before a flight: the stages by name, each with its gains."""

import difflib
import importlib
from dataclasses import fields as dataclass_fields
from types import ModuleType
from typing import Any, NamedTuple

from mavquad import adrc_checks, paths, publish, slowing, wire
from mavquad import airframe as airframes
from mavquad.airframe import Airframe
from mavquad.config import value as toml_value
from mavquad.errors import ConfigError
from mavquad.setpoint import limits
from mavquad.settings import Companion

ESTIMATORS = {
    "direct": "mavquad.estimate.direct",
    "joint": "mavquad.estimate.joint_flight",
    "leso": "mavquad.estimate.leso_flight",
    "eskf": "mavquad.estimate.extended_state_flight",
}
CONTROLLERS = {
    "pd": ("mavquad.control.pd", "direct"),
    "pid": ("mavquad.control.pid", "direct"),
    "autopilot": ("mavquad.control.pid", "direct"),  # flown by the autopilot's own loop; ours only stands by
    "adrc": ("mavquad.control.adrc_flight", "leso"),
    "iadrc": ("mavquad.control.iadrc_flight", "joint"),
    "eskf-mpc": ("mavquad.control.mpc_flight", "eskf"),
    "sweep": ("mavquad.sweep_flight", "direct"),  # excites for identification
}
COMPENSATORS = {"asmf": "mavquad.active_flight"}
HELICOPTER_COMPENSATORS = {"asmf": "mavquad.active_helicopter"}
OBSERVERS = {"gsmo": "mavquad.estimate.gsmo"}


class Stage(NamedTuple):
    """One chosen module with its gains."""

    label: str
    module: Any
    params: Any
    gains: Any


class Plan(NamedTuple):
    """What does not change in flight."""

    settings: Companion
    airframe: Airframe
    path: paths.Plan
    limits: limits.Gains
    estimator: Stage
    controller: Stage
    compensator: Stage | None
    observers: tuple[Stage, ...]
    control_us: int
    samples: dict[int, str]  # messages whose samples are used, by id
    imu_spared: bool  # no stage takes accelerometers: some are enough to tell how old positions are
    trace_names: tuple[str, ...]
    warnings: tuple[str, ...]  # of the checks at design time: what will fly, but not well
    slowed: tuple[Any, ...]  # the controller's gains for a late companion, by how late it is


def stage(kind: str, spec: str, table: dict[str, str], tune: dict[str, dict[str, Any]], airframe: Airframe) -> Stage:
    """A module by `name` or `name:key=value,key=value`, with its Params checked. Raises ConfigError."""
    name, _, rest = spec.partition(":")
    if name not in table:
        raise ConfigError(f"no {kind} is called {name!r}; known: {', '.join(table)}")
    try:
        module: ModuleType = importlib.import_module(table[name])
    except ModuleNotFoundError as error:
        raise ConfigError(f"{kind} {name!r} needs {error.name}, which is not installed") from None
    values = dict(tune.get(name, {}))
    for part in filter(None, rest.split(",")):
        key, equals, text = part.partition("=")
        if not equals:
            raise ConfigError(f"{kind} {spec!r}: expected {name}:key=value,key=value")
        values[key.strip()] = toml_value(text)
    chosen = params(name, module, values)
    return Stage(spec, module, chosen, module.gains(chosen, airframe))


def params(name: str, module: Any, values: dict[str, Any]) -> Any:
    """The module's Params from plain values. Raises ConfigError that names an unknown key."""
    known = [f.name for f in dataclass_fields(module.Params)]
    for key in values:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
            hint = f'; did you mean "{near[0]}"?' if near else f"; known: {', '.join(known)}"
            raise ConfigError(f'unknown key "{key}" in [tune.{name}]{hint}')
    fixed = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    try:
        return module.Params(**fixed)
    except TypeError as error:
        raise ConfigError(f"[tune.{name}] = {values}: {error}") from None


def build(settings: Companion, airframe: Airframe | None = None) -> Plan:
    """Everything that is decided before the flight; the airframe by its name unless given. Raises ConfigError."""
    if airframe is None:
        airframe = airframes.load(settings.airframe, tuple(settings.airframe_set))
    module, own = CONTROLLERS[settings.controller]
    estimator = own if settings.estimator == "auto" else settings.estimator
    tune = settings.tune
    for name in tune:
        if name not in (*ESTIMATORS, *CONTROLLERS, *COMPENSATORS, *OBSERVERS):
            raise ConfigError(
                f"[tune.{name}]: no stage has this name; known: {', '.join((*ESTIMATORS, *CONTROLLERS, *OBSERVERS))}"
            )
    if settings.controller == "autopilot" and settings.compensator != "none":
        raise ConfigError(
            "compensator: the autopilot's own position loop takes positions, nothing that can be corrected; use pid"
        )
    observers = tuple(stage("observer", spec, OBSERVERS, tune, airframe) for spec in settings.observers)
    correcting = HELICOPTER_COMPENSATORS if airframe.kind == "helicopter" else COMPENSATORS
    compensator = (
        stage("compensator", settings.compensator, correcting, tune, airframe) if settings.compensator != "none" else None
    )
    estimator_stage = stage("estimator", estimator, ESTIMATORS, tune, airframe)
    controller_stage = stage(
        "controller", settings.controller, {settings.controller: module}, _with_loop(settings, module), airframe
    )
    samples = _samples((estimator_stage, controller_stage, compensator, *observers))
    return Plan(
        settings,
        airframe,
        paths.plan(settings.path),
        limits.gains(settings.limits),
        estimator_stage,
        controller_stage,
        compensator,
        observers,
        round(1e6 / settings.control_hz),
        {wire.ID["HIGHRES_IMU"]: "HIGHRES_IMU", **samples},
        wire.ID["HIGHRES_IMU"] not in samples,
        publish.trace_names(tuple(s.label for s in observers), compensator.module if compensator else None),
        tuple(adrc_checks.enforce(_checks(estimator_stage, controller_stage))),
        slowing.designs(controller_stage.module, controller_stage.params, airframe),
    )


def _checks(estimator: Stage, controller: Stage) -> list[adrc_checks.Finding]:
    """What can be said before the flight of an extended state observer, and of it beside the law that it serves."""
    found = list(estimator.module.checks(estimator.params)) if hasattr(estimator.module, "checks") else []
    wc = getattr(controller.gains, "wc", None)
    if wc is not None:
        for label, i in (("xy", 0), ("z", 2)):
            w0 = getattr(estimator.params, f"w0_{label}_rad_s", None)
            if w0 is not None:
                found.append(adrc_checks.separation(f"{controller.label}: w0/wc {label}", wc[i], w0))
    return found


def _with_loop(settings: Companion, module: str) -> dict[str, dict[str, Any]]:
    """The tuning, told which loop is to be closed here where the controller can close it. Raises ConfigError where it cannot."""
    known = [f.name for f in dataclass_fields(importlib.import_module(module).Params)]
    if settings.loop == "attitude":
        return settings.tune
    if "loop" not in known:
        raise ConfigError(f"loop = rates: {settings.controller} closes no attitude loop; use iadrc or adrc, or loop = attitude")
    return {**settings.tune, settings.controller: {"loop": settings.loop, **settings.tune.get(settings.controller, {})}}


_ALWAYS = ("ATTITUDE_QUATERNION", "ATTITUDE", "LOCAL_POSITION_NED", "ATTITUDE_TARGET")
_ONLY_WHERE_USED = {
    "Imu": "HIGHRES_IMU",
    "Mocap": "ATT_POS_MOCAP",
    "Motors": "SERVO_OUTPUT_RAW",
    "Controls": "ACTUATOR_CONTROL_TARGET",
}


def _samples(stages: tuple[Stage | None, ...]) -> dict[int, str]:
    """Messages to decode. A stage may say which kinds it uses (`uses(gains)`: names of signals); without it: all."""
    names = list(_ALWAYS)
    for kind, name in _ONLY_WHERE_USED.items():
        for chosen in stages:
            if chosen is None or not hasattr(chosen.module, "observe"):
                continue
            uses = getattr(chosen.module, "uses", None)
            if uses is None or kind in uses(chosen.gains):
                names.append(name)
                break
    return {wire.ID[name]: name for name in names}
