"""What the autopilot does with what it is sent: commands and their ACKs, setpoints, parameters, time.

Every command is acknowledged, unknown ones too; what else is asked for and not there is refused in `refusals`.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mavquad import wire
from mavquad.wire import Frame
from sitl import refusals, telemetry
from sitl.autopilot import ACCEPTED, DENIED, FORCE, NOTICE, UNSUPPORTED
from sitl.links import Link

if TYPE_CHECKING:
    from sitl.simulation import Simulation

_AUTOPILOT_VERSION = wire.ID["AUTOPILOT_VERSION"]
_REBOOT_WAIT_US = 100_000
_COMMANDS = (wire.ID["COMMAND_LONG"], wire.ID["COMMAND_INT"])
_QUESTIONS = frozenset(
    wire.ID[name] for name in ("TIMESYNC", "PING", "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "MISSION_REQUEST_LIST")
)


class Services:
    """Handlers of everything that is addressed to the autopilot."""

    def __init__(self, sim: "Simulation") -> None:
        self._sim = sim
        self._listing: list[tuple[Link, list[str]]] = []  # parameters still to be sent
        by_name: dict[str, Callable[[Link, Frame, Any], None]] = {
            "SET_ATTITUDE_TARGET": lambda link, frame, m: sim.autopilot.attitude_target(m),
            "SET_POSITION_TARGET_LOCAL_NED": lambda link, frame, m: sim.autopilot.position_target(m),
            "SET_ACTUATOR_CONTROL_TARGET": lambda link, frame, m: sim.autopilot.actuator_target(m),
            "COMMAND_LONG": self._command_long,
            "COMMAND_INT": self._command_int,
            "SET_MODE": self._set_mode,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
            "HEARTBEAT": self._heartbeat,
            "PARAM_REQUEST_LIST": self._param_list,
            "PARAM_REQUEST_READ": self._param_read,
            "PARAM_SET": self._param_set,
            "REQUEST_DATA_STREAM": self._data_stream,
            **refusals.handlers(sim),
        }
        self.handlers = {wire.ID[name]: handler for name, handler in by_name.items()}
        self._commands: dict[int, Callable[[Link, Frame, list[float]], int]] = {
            20: lambda link, frame, p: sim.autopilot.go_home(),
            21: lambda link, frame, p: sim.autopilot.land(),
            22: lambda link, frame, p: sim.autopilot.takeoff(p[6]),
            176: self._do_set_mode,
            246: self._reboot,
            400: self._arm,
            401: lambda link, frame, p: DENIED if sim.autopilot.can_arm() else ACCEPTED,
            410: lambda link, frame, p: self._request(link, wire.ID["HOME_POSITION"]),
            510: self._get_interval,
            511: self._set_interval,
            512: lambda link, frame, p: self._request(link, _number(p[0])),
            520: lambda link, frame, p: self._request(link, _AUTOPILOT_VERSION),
        }

    def allowed(self, frame: Frame) -> bool:
        """Whether its sender may have this: anybody may ask, only listed systems may change anything."""
        listed = self._sim.config.accept_from
        if not listed or frame.msgid in _QUESTIONS:
            return True
        return (frame.system, frame.component) in listed or (frame.system, 0) in listed

    def deny(self, link: Link, frame: Frame, m: Any) -> None:
        """A command of somebody who is not listed is answered; nothing else is."""
        if frame.msgid in _COMMANDS:
            self._sim.send(link, "COMMAND_ACK", (m.command, DENIED, 0, 0, frame.system, frame.component))

    def tick(self) -> None:
        """Each 20 ms: the next few parameters of a list."""
        for link, names in self._listing:
            for name in names[:5]:
                self._sim.send(link, "PARAM_VALUE", self._sim.autopilot.params.fields(name))
            del names[:5]
        self._listing = [entry for entry in self._listing if entry[1]]

    # ---- commands -----------------------------------------------------------------------------------------------------
    def _command_long(self, link: Link, frame: Frame, m: Any) -> None:
        self._command(link, frame, m.command, [m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7])

    def _command_int(self, link: Link, frame: Frame, m: Any) -> None:
        self._command(link, frame, m.command, [m.param1, m.param2, m.param3, m.param4, 1e-7 * m.x, 1e-7 * m.y, m.z])

    def _command(self, link: Link, frame: Frame, command: int, params: list[float]) -> None:
        action = self._commands.get(command)
        result = action(link, frame, params) if action else UNSUPPORTED
        self._sim.send(link, "COMMAND_ACK", (command, result, 0, 0, frame.system, frame.component))

    def _arm(self, link: Link, frame: Frame, p: list[float]) -> int:
        if p[0] == 1.0:
            return self._sim.autopilot.arm(p[1] == FORCE)
        return self._sim.autopilot.disarm(p[1] == FORCE) if p[0] == 0.0 else DENIED

    def _do_set_mode(self, link: Link, frame: Frame, p: list[float]) -> int:
        if not _number(p[0]) & 1:
            return UNSUPPORTED  # only custom modes
        return self._sim.autopilot.set_mode(_number(p[1]), _number(p[2]))

    def _set_mode(self, link: Link, frame: Frame, m: Any) -> None:
        if m.base_mode & 1:
            self._sim.autopilot.set_mode(*self._sim.autopilot.split_mode(m.custom_mode))

    def _reboot(self, link: Link, frame: Frame, p: list[float]) -> int:
        if p[0] != 1.0:
            return UNSUPPORTED
        if self._sim.autopilot.armed and p[5] != 20190226.0:
            return DENIED
        self._sim.reboot_at(self._sim.t_us + _REBOOT_WAIT_US)
        return ACCEPTED

    def _request(self, link: Link, msgid: int) -> int:
        autopilot = self._sim.autopilot
        if msgid == _AUTOPILOT_VERSION:
            self._sim.send(
                link,
                "AUTOPILOT_VERSION",
                telemetry.autopilot_version(autopilot.kind, autopilot.capabilities, autopilot.version),
            )
            return ACCEPTED
        stream = link.streams.get(wire.NAME.get(msgid, ""))
        if stream is None:
            return UNSUPPORTED
        fields = stream.build()
        if fields is None:
            return DENIED
        self._sim.send(link, stream.name, fields)
        return ACCEPTED

    def _get_interval(self, link: Link, frame: Frame, p: list[float]) -> int:
        stream = link.streams.get(wire.NAME.get(_number(p[0]), ""))
        if stream is None:
            return UNSUPPORTED
        self._sim.send(link, "MESSAGE_INTERVAL", (stream.msgid, stream.interval_us or -1))
        return ACCEPTED

    def _set_interval(self, link: Link, frame: Frame, p: list[float]) -> int:
        name = wire.NAME.get(_number(p[0]), "")
        if name not in link.streams or not math.isfinite(p[1]):
            return self._sim.autopilot.rate_denied
        wanted_us = -1 if p[1] < 0.0 else round(p[1])
        if wanted_us > 0 and 1e6 / wanted_us > self._sim.autopilot.rate_limit_hz:
            self._sim.autopilot.say(
                NOTICE, f"{name}: {1e6 / wanted_us:.0f} Hz is more than {self._sim.autopilot.rate_limit_hz:.0f} Hz"
            )
            return DENIED
        self._sim.set_interval(link, name, wanted_us)
        return ACCEPTED

    def _data_stream(self, link: Link, frame: Frame, m: Any) -> None:
        hz = m.req_message_rate if m.start_stop else 0
        for name in self._sim.autopilot.data_stream(m.req_stream_id):
            self._sim.set_interval(link, name, round(1e6 / hz) if hz else -1)

    # ---- time and life ------------------------------------------------------------------------------------------------
    def _timesync(self, link: Link, frame: Frame, m: Any) -> None:
        if m.tc1 == 0:
            self._sim.send(link, "TIMESYNC", (1000 * (self._sim.t_us - self._sim.autopilot.boot_us), m.ts1))

    def _ping(self, link: Link, frame: Frame, m: Any) -> None:
        if m.target_system == 0:
            self._sim.send(link, "PING", (m.time_usec, m.seq, frame.system, frame.component))

    def _heartbeat(self, link: Link, frame: Frame, m: Any) -> None:
        self._sim.autopilot.heard(frame.system, frame.component)

    # ---- parameters ---------------------------------------------------------------------------------------------------
    def _param_list(self, link: Link, frame: Frame, m: Any) -> None:
        self._listing = [entry for entry in self._listing if entry[0] is not link]
        self._listing.append((link, list(self._sim.autopilot.params.names())))

    def _param_read(self, link: Link, frame: Frame, m: Any) -> None:
        name = self._sim.autopilot.params.find(m.param_id, m.param_index)
        if name is None:
            self._sim.send(link, *refusals.unknown_parameter(frame, m))
        else:
            self._sim.send(link, "PARAM_VALUE", self._sim.autopilot.params.fields(name))

    def _param_set(self, link: Link, frame: Frame, m: Any) -> None:
        autopilot = self._sim.autopilot
        if m.param_id not in autopilot.params:
            self._sim.send(link, *refusals.unknown_parameter(frame, m))
            return
        if autopilot.params.put_wire(m.param_id, m.param_value, m.param_type):
            autopilot.apply_params()
        for peer in self._sim.links:  # everybody learns of a change
            self._sim.send(peer, "PARAM_VALUE", autopilot.params.fields(m.param_id))


def _number(x: float) -> int:
    """A command parameter that is a whole number; -1 for NaN (not used)."""
    return int(x) if math.isfinite(x) else -1
