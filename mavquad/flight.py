"""All that changes in a flight: one state, copied by every event."""

import difflib
import math
from typing import Any

import numpy as np

from mavquad import following, lifecycle, position_age, wire
from mavquad.errors import ConfigError
from mavquad.lifecycle import Life
from mavquad.plan import Plan
from mavquad.setpoint.attitude import G_M_S2
from mavquad.signals import ZERO3, Estimate, Position, Quat, Setpoint, Sticks, Target, Vec3


class Flight:
    """All that changes. `feed` and `advance` copy it, so a state that was handed in is never changed.

    Its parts are immutable, but for the dicts and the lists, which are copied or emptied with it.
    """

    life: Life
    estimator: Any
    controller: Any
    compensator: Any
    observers: tuple[Any, ...]
    seq: int
    arrival_us: int  # of the last event
    now_us: int  # vehicle time of the newest sample
    control_us: int  # vehicle time of the last control step
    control_gap_us: int  # period of the pacing stream
    behind: int  # samples in a row whose stamps are well behind the newest
    epoch: int  # how often the autopilot's clock has started
    stamps: dict[str, int]  # newest vehicle stamp of each message
    arrivals: dict[str, int]  # and when it arrived
    newest_arrival_us: int  # of the newest sample of all
    pace_us: int  # vehicle time of the last sample of the stream that paces the control
    due_us: int  # arrival time at which the next timer fires
    heartbeat_us: int  # next due, arrival time; 0: not started
    tick_us: int
    timesync_us: int
    publish_us: int
    q_wxyz: Quat  # newest attitude
    position: Position | None
    told: tuple[Vec3, Vec3] | None  # position and velocity as last sent
    position_age: np.ndarray  # record of `position_age`: how far behind its stamp it is
    offset_m: Vec3  # subtracted from every position: the sum of the autopilot's own resets
    origin_m: Vec3  # where the vehicle was armed
    estimate: Estimate | None
    anchor: int  # vehicle time when the anchor was set; 0: none
    anchor_p_m: Vec3
    anchor_yaw_rad: float
    path_t0_us: int
    sent: Setpoint | None
    sticks: Sticks | None  # as last sent; None: attitude and thrust are
    applied_thrust_m_s2: float
    echo: Target | None
    hover_thrust: float
    delay_s: float  # measured round trip
    lateness_us: int  # smallest arrival minus stamp seen: what counts as punctual
    usual_us: float  # mean arrival minus stamp over the last seconds, as the round trip is averaged; NaN: none yet
    age_s: float  # of this sample, beyond that mean
    late_s: float  # our own lateness, the largest of late
    catching_up: bool  # this sample is old and newer ones wait behind it: not worth a setpoint
    skipped_s: float  # vehicle time that such samples took
    put_us: int  # arrival time of the last control step
    following: following.State  # whether the vehicle does what is sent
    slow: int  # which of the slower designs we fly with; 0: none
    late_us: int  # since when we are late; 0: punctual
    interventions: int
    battery_percent: float
    counts: dict[str, int]
    heard_crc: int  # CRC-32 over every frame received: two flights that heard the same have the same
    tuned: Plan | None  # the plan with the gains as changed in flight
    delay_echo_s: float  # from a setpoint sent to its echo in ATTITUDE_TARGET; NaN: never recognised
    setpoints: tuple[tuple[int, float, float], ...]  # the last ones sent: vehicle time, first two vector parts
    own_attitude_loop: bool | None  # body rates are sent, not attitudes; None: not said yet
    outbox: list[tuple[int, bytes]]
    trace: list[tuple[float, ...]]

    def clone(self) -> "Flight":
        """A copy to be changed, with nothing to be sent yet."""
        other = Flight.__new__(Flight)
        values = other.__dict__
        values.update(self.__dict__)
        values["stamps"], values["arrivals"], values["counts"] = self.stamps.copy(), self.arrivals.copy(), self.counts.copy()
        values["outbox"], values["trace"] = [], []
        return other


def start(plan: Plan) -> Flight:
    """The state before the first event."""
    f = Flight()
    f.life = lifecycle.init(plan.settings)
    f.life = f.life._replace(rates=tuple(r._replace(msgid=_message_id(r.name)) for r in f.life.rates))
    f.seq, f.arrival_us, f.epoch = 0, 0, 0
    f.heartbeat_us = f.tick_us = f.timesync_us = f.publish_us = 0
    f.due_us = 1 << 62
    f.counts = {}
    f.hover_thrust, f.delay_s = plan.airframe.hover_thrust, 0.0
    f.battery_percent = math.nan
    f.interventions = f.heard_crc = 0
    f.tuned = None
    f.outbox, f.trace = [], []
    forget(plan, f)
    return f


def _message_id(name: str) -> int:
    if name not in wire.ID:
        near = difflib.get_close_matches(name, wire.ID, n=1)
        raise ConfigError(f"link.rates_hz: no message is called {name!r}" + (f'; did you mean "{near[0]}"?' if near else ""))
    return wire.ID[name]


def forget(plan: Plan, f: Flight) -> None:
    """Begin again with the autopilot's clock: nothing that was estimated before it is worth anything."""
    f.estimator = plan.estimator.module.init(plan.estimator.gains)
    f.controller = plan.controller.module.init(plan.controller.gains)
    f.compensator = plan.compensator.module.init(plan.compensator.gains) if plan.compensator else None
    f.observers = tuple(s.module.init(s.gains) for s in plan.observers)
    f.now_us = f.control_us = f.anchor = f.path_t0_us = 0
    f.control_gap_us = 0
    f.stamps, f.arrivals, f.behind = {}, {}, 0
    f.newest_arrival_us = f.pace_us = 0
    f.q_wxyz, f.position_age = (1.0, 0.0, 0.0, 0.0), position_age.START
    f.told = None
    f.position, f.offset_m, f.origin_m, f.estimate = None, ZERO3, ZERO3, None
    f.anchor_p_m, f.anchor_yaw_rad = ZERO3, 0.0
    f.delay_echo_s, f.setpoints = math.nan, ()
    f.own_attitude_loop = None
    f.sent, f.echo, f.applied_thrust_m_s2 = None, None, G_M_S2
    f.sticks = None
    f.lateness_us, f.late_us = 1 << 62, 0
    f.usual_us, f.age_s = math.nan, 0.0
    f.late_s, f.slow, f.catching_up, f.skipped_s, f.put_us = 0.0, 0, False, 0.0, 0
    f.following = following.START


def vehicle_now_us(f: Flight) -> int:
    """Vehicle time at the last event, carried on from the newest sample by the arrival clock."""
    return f.now_us + max(0, f.arrival_us - f.newest_arrival_us) if f.now_us else 0
