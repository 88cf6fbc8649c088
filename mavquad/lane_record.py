"""The fast lane's record of all that a plain tick reads and changes, and how a flight goes into it and comes out again. Pure."""

import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from mavquad import flat, following, lifecycle, paths, position_age
from mavquad.control import pid
from mavquad.estimate import direct
from mavquad.flight import Flight
from mavquad.lifecycle import ENGAGED, OBSERVING, RELEASED, STREAMING
from mavquad.link.health import Source
from mavquad.setpoint import limits
from mavquad.signals import NAN3, ZERO3, Estimate, Position, Setpoint, Target

POSITION, IMU, TARGET, ATTITUDE = "LOCAL_POSITION_NED", "HIGHRES_IMU", "ATTITUDE_TARGET", "ATTITUDE_QUATERNION"
STREAMS = (POSITION, IMU, TARGET, ATTITUDE)
SENT = 25  # setpoints whose echo is recognised, as `control_step` keeps


class Whole(NamedTuple):
    """Its whole numbers. Stamps and arrivals: -1 where none was heard."""

    state: int  # of the life cycle, its number
    leading: bool  # streaming or engaged
    flying: bool  # and the anchor is set
    engaged: bool
    released: bool
    learning: bool  # the thrust of the hover
    ended: bool
    landed: int
    now_us: int
    arrival_us: int
    newest_arrival_us: int
    control_us: int
    control_gap_us: int
    pace_us: int
    put_us: int
    lateness_us: int
    late_us: int
    path_t0_us: int
    position_stamp_us: int
    imu_stamp_us: int
    target_stamp_us: int
    attitude_stamp_us: int
    position_arrival_us: int
    imu_arrival_us: int
    target_arrival_us: int
    attitude_arrival_us: int
    position_us: int  # of the position that is flown by
    estimate_us: int  # of the newest control step here; 0: none yet
    echo_us: int  # of the newest target here; 0: none yet
    echo_mask: int
    has_sent: bool
    follows: bool
    interventions: int
    heard_crc: int
    seq: int
    source_seq: int
    received: int
    lost: int
    sent_count: int  # in the ring


_REALS = (
    ("q_wxyz", 4), ("omega_rad_s", 3), ("p_ned_m", 3), ("v_ned_m_s", 3), ("told_p_m", 3), ("told_v_m_s", 3), ("offset_m", 3),
    ("anchor_p_m", 3), ("anchor_yaw_rad", 1), ("usual_us", 1), ("age_s", 1), ("late_s", 1), ("skipped_s", 1), ("hover_thrust", 1),
    ("delay_s", 1), ("delay_echo_s", 1), ("applied_m_s2", 1), ("sent_q", 4), ("sent_thrust", 1), ("integral_m_s2", 3),
    ("battery_percent", 1), ("echo_q", 4), ("echo_omega_rad_s", 3), ("echo_thrust", 1),
    ("estimate_p_m", 3), ("estimate_v_m_s", 3), ("estimate_q", 4), ("estimate_omega_rad_s", 3),
)  # fmt: skip
RECORD = flat.record(
    [
        *[(name, "i8") for name in Whole._fields],
        *[(name, "f8", n) if n > 1 else (name, "f8") for name, n in _REALS],
        ("ring_us", "i8", SENT),
        ("ring_xy", "f8", (SENT, 2)),
        ("following", following.RECORD),
        ("age", position_age.RECORD),
    ]
)
FIXED = flat.record(  # what does not change between two entries
    [
        ("pid", flat.record([("kp", "f8"), ("kd", "f8"), ("ki", "f8"), ("drag_linear_1_s", "f8", 3), ("drag_quadratic_1_m", "f8", 3), ("accel_max_m_s2", "f8"), ("integral_max_m_s2", "f8")])),
        ("gate", flat.record([(name, "f8") for name in limits.Gains._fields])),
        ("path", flat.record([(name, "i8" if name == "kind" else "f8") for name in paths.Plan._fields])),
        *[(name, "f8") for name in ("carry_s", "reset_m", "natural_frequency_rad_s", "damping", "response_delay_s")],
        *[(name, "i8") for name in ("duration_us", "control_us", "late_us", "ardupilot", "system", "component")],
        *[(name, "i8") for name in ("target_system", "target_component", "setpoint_extra", "timesync_extra", "timesync_bytes")],
    ]
)  # fmt: skip
_WHOLES, _FLOATS = len(Whole._fields), sum(n for _, n in _REALS)
_AT = {name: RECORD.fields[name][1] for name in ("ring_us", "ring_xy", "following", "age")}  # type: ignore[index]
# words of the ring of what was sent: a step that is taken back has only written where the next one writes
RING_AT = _AT["following"] // 8
RING_END = RING_AT + (following.RECORD.fields["sent_count"][1]) // 8  # type: ignore[index]


# the kernel's memory in one piece, since each array costs a call from Python a third of a microsecond: bytes of each part
FIXED_BYTES, STATE_BYTES = FIXED.itemsize, RECORD.itemsize
MOST_BYTES, MOST_FRAMES, MOST_ROWS, COLUMNS = 1 << 12, 128, 8, 46
ATTITUDES = 8  # columns of what observers are told: stamp, quaternion, body rates
_PARTS = {
    "fixed": FIXED_BYTES, "state": STATE_BYTES, "backup": STATE_BYTES, "table": 2 << 16, "log": 1 << 14, "own": 1 << 12,
    "sent": 1 << 12, "rows": 8 * MOST_ROWS * COLUMNS, "heard": 8 * MOST_FRAMES * ATTITUDES, "places": 8 * MOST_FRAMES, "scratch": 128,
}  # fmt: skip
(FIXED_AT, STATE_AT, BACKUP_AT, TABLE_AT, LOG_AT, OWN_AT, SENT_AT, ROWS_AT, HEARD_AT, PLACES_AT, SCRATCH_AT, END) = (
    0,
    *itertools.accumulate(-(-size // 64) * 64 for size in _PARTS.values()),
)


def room() -> np.ndarray:
    """The kernel's memory, nothing in it."""
    return np.zeros(END, np.uint8)


def plain(f: Flight) -> bool:
    """Whether this flight is where a plain tick can be: everything has been heard once, nothing is out of the ordinary."""
    position = f.position
    return (
        f.life.target != (0, 0)
        and f.heartbeat_us > 0
        and position is not None
        and f.told is not None
        and f.slow == 0
        and not f.catching_up
        and f.sticks is None
        and type(f.estimator) is direct.State
        and f.estimator.position == position
        and f.estimator.q_wxyz == f.q_wxyz
        and (f.life.state not in (STREAMING, ENGAGED) or (f.anchor > 0 and f.sent is not None and f.sent.type_mask == 7))
    )


def load(to: np.ndarray, f: Flight, source: Source) -> None:
    """Write a plain flight and the counter of its autopilot's frames."""
    life, position, stamps, arrivals = f.life, f.position, f.stamps, f.arrivals
    assert position is not None
    assert f.told is not None
    leading = life.state in (STREAMING, ENGAGED)
    sent = f.sent or Setpoint((1.0, 0.0, 0.0, 0.0), ZERO3, math.nan, 7)
    to[: 8 * _WHOLES].view(np.int64)[:] = Whole(
        state=lifecycle.STATES.index(life.state), leading=leading, flying=leading and f.anchor > 0, engaged=life.state == ENGAGED,
        released=life.state == RELEASED, learning=life.state == OBSERVING and life.steady_us != 0, ended=life.ended, landed=life.landed,
        now_us=f.now_us, arrival_us=f.arrival_us, newest_arrival_us=f.newest_arrival_us, control_us=f.control_us,
        control_gap_us=f.control_gap_us, pace_us=f.pace_us, put_us=f.put_us, lateness_us=f.lateness_us, late_us=f.late_us,
        path_t0_us=f.path_t0_us,
        position_stamp_us=stamps.get(POSITION, -1), imu_stamp_us=stamps.get(IMU, -1),
        target_stamp_us=stamps.get(TARGET, -1), attitude_stamp_us=stamps.get(ATTITUDE, -1),
        position_arrival_us=arrivals.get(POSITION, -1), imu_arrival_us=arrivals.get(IMU, -1),
        target_arrival_us=arrivals.get(TARGET, -1), attitude_arrival_us=arrivals.get(ATTITUDE, -1),
        position_us=position.t_us, estimate_us=0, echo_us=0, echo_mask=0, has_sent=f.sent is not None, follows=f.following.follows,
        interventions=f.interventions, heard_crc=f.heard_crc, seq=f.seq, source_seq=source.seq, received=source.received,
        lost=source.lost, sent_count=len(f.setpoints),
    )  # fmt: skip
    to[8 * _WHOLES : 8 * (_WHOLES + _FLOATS)].view(np.float64)[:] = (
        *f.q_wxyz, *f.estimator.omega_rad_s, *position.p_ned_m, *position.v_ned_m_s, *f.told[0], *f.told[1], *f.offset_m,
        *f.anchor_p_m, f.anchor_yaw_rad, f.usual_us, f.age_s, f.late_s, f.skipped_s, f.hover_thrust,
        f.delay_s, f.delay_echo_s, f.applied_thrust_m_s2, *sent.q_wxyz, sent.thrust, *f.controller.integral_m_s2,
        f.battery_percent, *(0.0,) * 21,
    )  # fmt: skip
    if f.setpoints:
        n, (times, x, y) = len(f.setpoints), zip(*f.setpoints, strict=True)
        at = _AT["ring_us"]
        to[at : at + 8 * n].view(np.int64)[:] = times
        at = _AT["ring_xy"]
        pairs = to[at : at + 16 * n].view(np.float64)
        pairs[0::2], pairs[1::2] = x, y
    for name, part in (("following", f.following.record), ("age", f.position_age)):
        to[_AT[name] : _AT[name] + part.size] = part


def unload(at: np.ndarray, flight: Flight) -> tuple[Flight, Source]:
    """The flight after what happened in the record since `load` of it, and the counter of frames."""
    w = Whole(*at[: 8 * _WHOLES].view(np.int64).tolist())
    x = at[8 * _WHOLES : 8 * (_WHOLES + _FLOATS)].view(np.float64).tolist()
    values: dict[str, Any] = {}
    begin = 0
    for name, n in _REALS:
        values[name] = tuple(x[begin : begin + n]) if n > 1 else x[begin]
        begin += n
    f = flight.clone()
    for name in (
        "now_us",
        "arrival_us",
        "newest_arrival_us",
        "control_us",
        "control_gap_us",
        "pace_us",
        "put_us",
        "lateness_us",
    ):
        setattr(f, name, getattr(w, name))
    f.late_us, f.interventions, f.heard_crc, f.seq, f.behind = w.late_us, w.interventions, w.heard_crc, w.seq, 0
    stamps = (w.position_stamp_us, w.imu_stamp_us, w.target_stamp_us, w.attitude_stamp_us)
    arrivals = (w.position_arrival_us, w.imu_arrival_us, w.target_arrival_us, w.attitude_arrival_us)
    for name, stamp, arrival in zip(STREAMS, stamps, arrivals, strict=True):
        if stamp >= 0:
            f.stamps[name], f.arrivals[name] = stamp, arrival
    for name in ("q_wxyz", "usual_us", "age_s", "late_s", "skipped_s", "hover_thrust", "delay_s", "delay_echo_s"):
        setattr(f, name, values[name])
    f.position = Position(w.position_us, values["p_ned_m"], values["v_ned_m_s"])
    f.told = (values["told_p_m"], values["told_v_m_s"])
    f.estimator = direct.State(f.position, f.q_wxyz, values["omega_rad_s"])
    f.controller = pid.State(values["integral_m_s2"])
    f.following = following.State(bool(w.follows), _part(at, "following", f.following.record.size))
    f.position_age = _part(at, "age", f.position_age.size)
    if w.estimate_us:
        p, v, q, omega = (values[f"estimate_{name}"] for name in ("p_m", "v_m_s", "q", "omega_rad_s"))
        f.estimate = Estimate(w.estimate_us, p, v, q, omega, NAN3, NAN3)
    if w.estimate_us and w.flying:
        f.applied_thrust_m_s2 = values["applied_m_s2"]
        f.sent = Setpoint(values["sent_q"], ZERO3, values["sent_thrust"], 7)
        times = at[_AT["ring_us"] :].view(np.uint8)[: 8 * w.sent_count].view(np.int64).tolist()
        pairs = at[_AT["ring_xy"] :].view(np.uint8)[: 16 * w.sent_count].view(np.float64).tolist()
        f.setpoints = tuple(zip(times, pairs[0::2], pairs[1::2], strict=True))
    if w.echo_us:
        f.echo = Target(w.echo_us, values["echo_q"], values["echo_omega_rad_s"], values["echo_thrust"], w.echo_mask)
    return f, Source(w.source_seq, w.received, w.lost)


def _part(at: np.ndarray, name: str, size: int) -> np.ndarray:
    return at[_AT[name] : _AT[name] + size].copy()
