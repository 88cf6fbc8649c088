"""What the companion says of its estimates: DEBUG_FLOAT_ARRAY and NAMED_VALUE_FLOAT on the wire, and the rows of its trace. Pure."""

import math
from typing import TYPE_CHECKING, Any

from mavquad import paths
from mavquad.lifecycle import ENGAGED
from mavquad.signals import Command, Demand, Estimate

if TYPE_CHECKING:
    from mavquad.lifecycle import Send
    from mavquad.pipeline import Flight, Plan

EPOCH_US = 1_700_000_000_000_000  # log time of simulation time zero, in lockstep
_STATES = ("searching", "configuring", "observing", "streaming", "engaged", "released")
_BASE = [
    "t_us",
    "arrival_us",
    "state",
    "p_n",
    "p_e",
    "p_d",
    "v_n",
    "v_e",
    "v_d",
    "q_w",
    "q_x",
    "q_y",
    "q_z",
    "w_x",
    "w_y",
    "w_z",
    "f_n",
    "f_e",
    "f_d",
    "tau_x",
    "tau_y",
    "tau_z",
    "ref_p_n",
    "ref_p_e",
    "ref_p_d",
    "ref_v_n",
    "ref_v_e",
    "ref_v_d",
    "ref_a_n",
    "ref_a_e",
    "ref_a_d",
    "nominal_a_n",
    "nominal_a_e",
    "nominal_a_d",
    "command_a_n",
    "command_a_e",
    "command_a_d",
    "sent_q_w",
    "sent_q_x",
    "sent_q_y",
    "sent_q_z",
    "sent_thrust",
    "limited",
    "hover_thrust",
    "delay_s",
    "heard_crc",
]


def nanoseconds(arrival_us: int) -> int:
    """An arrival stamp as the nanoseconds that TIMESYNC carries: in lockstep simulation time."""
    return (arrival_us - EPOCH_US) * 1000


def arrival_us(nanoseconds: int) -> int:
    """The arrival stamp that `nanoseconds` was made of."""
    return EPOCH_US + nanoseconds // 1000


def trace_names(observers: tuple[str, ...], compensator: Any) -> tuple[str, ...]:
    """The columns of a trace row."""
    names = list(_BASE)
    for label in observers:
        names += [f"{label} w_x", f"{label} w_y", f"{label} w_z"]
    if compensator is not None:
        names += [f"asmf {name}" for name in compensator.PUBLISHED]
    return tuple(names)


def trace_row(
    plan: "Plan", f: "Flight", t_us: int, estimate: Estimate, demand: Demand, nominal: Command, command: Command, bits: int
) -> tuple[float, ...]:
    """One row at one control step."""
    sent = f.sent
    row: tuple[float, ...] = (
        float(t_us), float(f.arrival_us), float(_STATES.index(f.life.state)),
        *estimate.p_ned_m, *estimate.v_ned_m_s, *estimate.q_wxyz, *estimate.omega_rad_s, *estimate.f_ned_m_s2, *estimate.tau_rad_s2,
        *demand.p_ned_m, *demand.v_ned_m_s, *demand.a_ned_m_s2, *nominal.a_ned_m_s2, *command.a_ned_m_s2,
        *(sent.q_wxyz if sent else (math.nan,) * 4), sent.thrust if sent else math.nan, float(bits), f.hover_thrust, f.delay_s, float(f.heard_crc),
    )  # fmt: skip
    for stage, state in zip(plan.observers, f.observers, strict=True):
        row += stage.module.predict(stage.gains, state, t_us)[1]
    if plan.compensator is not None:
        row += tuple(plan.compensator.module.published(f.compensator))
    return row


def estimates(plan: "Plan", f: "Flight") -> tuple["Send", ...]:
    """Disturbance, bounds, observed rates with their health, distance from the path: at publish_hz, within about a hundred bytes each."""
    e = f.estimate
    if e is None or not f.now_us:
        return ()
    sends: list[Send] = []
    if f.life.state == ENGAGED and all(map(math.isfinite, e.p_ned_m)):
        wanted = paths.demand(plan.path, f.path_t0_us, f.anchor_p_m, f.anchor_yaw_rad, e.t_us).p_ned_m
        ms = (f.now_us // 1000) & 0xFFFFFFFF
        sends.append(("NAMED_VALUE_FLOAT", (ms, "path_err", math.dist(e.p_ned_m, wanted))))
    values = [*e.f_ned_m_s2, *e.tau_rad_s2, f.delay_s, f.hover_thrust]
    if all(math.isfinite(x) for x in e.f_ned_m_s2):
        sends.append(("DEBUG_FLOAT_ARRAY", (f.now_us, "disturb", 2, _padded(values))))
    if plan.observers:
        stage, state = plan.observers[0], f.observers[0]
        q, w, health = stage.module.read(stage.gains, state, f.now_us)
        sends.append(("DEBUG_FLOAT_ARRAY", (f.now_us, "rates", 3, _padded([*w, *q, *stage.module.published(health)]))))
    if plan.compensator is not None:
        sends.append(
            ("DEBUG_FLOAT_ARRAY", (f.now_us, "asmf", 4, _padded(list(plan.compensator.module.published(f.compensator)))))
        )
    return tuple(sends)


def _padded(values: list[float]) -> tuple[float, ...]:
    return tuple(float(x) if math.isfinite(x) else math.nan for x in values[:58]) + (0.0,) * (58 - min(58, len(values)))
