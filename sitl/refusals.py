"""What clients ask for and this autopilot does not have: the answer that says so, in the words of each protocol.

Missions, geofences, rally points, files, logs and unknown parameters. Commands that are not known get their ACK in `services`.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mavquad.wire import Frame
from sitl.autopilot import NOTICE, geodetic
from sitl.links import Link

if TYPE_CHECKING:
    from sitl.simulation import Simulation

Answer = tuple[str, tuple[Any, ...]]  # message and fields
_MISSION_ACCEPTED, _MISSION_UNSUPPORTED, _MISSION_NO_SUCH_ITEM = 0, 3, 13  # MAV_MISSION_RESULT
_FTP_ACK, _FTP_NAK, _FTP_UNKNOWN_COMMAND = 128, 129, 7
_FTP_NO_OPERATION, _FTP_TERMINATE, _FTP_RESET = 0, 1, 2  # opcodes with nothing to refuse
PARAM_DOES_NOT_EXIST = 1  # MAV_PARAM_ERROR
_FTP_BYTES, _LOG_BYTES = 251, 90


def handlers(sim: "Simulation") -> dict[str, Callable[[Link, Frame, Any], None]]:
    """Message name -> a handler that sends the answer back."""

    def reply(make: Callable[[Frame, Any], Answer]) -> Callable[[Link, Frame, Any], None]:
        return lambda link, frame, m: sim.send(link, *make(frame, m))

    told: set[tuple[int, str]] = set()

    def tell_once(name: str) -> Callable[[Link, Frame, Any], None]:
        def handler(link: Link, frame: Frame, m: Any) -> None:
            if (link.index, name) not in told:  # a setpoint comes many times a second and has no answer of its own
                told.add((link.index, name))
                sim.autopilot.say(NOTICE, f"{name} is not flown here")

        return handler

    table = {name: reply(make) for name, make in _ANSWERS.items()}
    table["SET_POSITION_TARGET_GLOBAL_INT"] = tell_once("SET_POSITION_TARGET_GLOBAL_INT")
    table["SET_GPS_GLOBAL_ORIGIN"] = reply(
        lambda frame, m: ("GPS_GLOBAL_ORIGIN", (*_millimetres(geodetic((0.0, 0.0, 0.0))), sim.t_us - sim.autopilot.boot_us))
    )
    return table


def unknown_parameter(frame: Frame, m: Any) -> Answer:
    """To a PARAM_SET or PARAM_REQUEST_READ of what is not there."""
    index = getattr(m, "param_index", -1)
    return "PARAM_ERROR", (frame.system, frame.component, m.param_id, index, PARAM_DOES_NOT_EXIST)


def _mission_ack(result: int) -> Callable[[Frame, Any], Answer]:
    return lambda frame, m: ("MISSION_ACK", (frame.system, frame.component, result, getattr(m, "mission_type", 0)))


def _mission_count(frame: Frame, m: Any) -> Answer:
    return "MISSION_COUNT", (frame.system, frame.component, 0, m.mission_type)


def _mission_upload(frame: Frame, m: Any) -> Answer:
    return _mission_ack(_MISSION_ACCEPTED if m.count == 0 else _MISSION_UNSUPPORTED)(frame, m)


def _file(frame: Frame, m: Any) -> Answer:
    sequence = (m.payload[0] | m.payload[1] << 8) + 1 & 0xFFFF
    opcode = m.payload[3]
    result, why = _FTP_NAK, [_FTP_UNKNOWN_COMMAND]
    if opcode in (_FTP_NO_OPERATION, _FTP_TERMINATE, _FTP_RESET):
        result, why = _FTP_ACK, []
    # sequence, session, opcode, bytes of data, the opcode that came, burst, padding, offset, data
    answer = (sequence & 0xFF, sequence >> 8, m.payload[2], result, len(why), opcode, 0, 0, 0, 0, 0, 0, *why)
    return "FILE_TRANSFER_PROTOCOL", (0, frame.system, frame.component, answer + (0,) * (_FTP_BYTES - len(answer)))


def _millimetres(place: tuple[int, int, float]) -> tuple[int, int, int]:
    return place[0], place[1], round(1000.0 * place[2])


_ANSWERS: dict[str, Callable[[Frame, Any], Answer]] = {
    "MISSION_REQUEST_LIST": _mission_count,
    "MISSION_COUNT": _mission_upload,
    "MISSION_CLEAR_ALL": _mission_ack(_MISSION_ACCEPTED),
    "MISSION_REQUEST": _mission_ack(_MISSION_NO_SUCH_ITEM),
    "MISSION_REQUEST_INT": _mission_ack(_MISSION_NO_SUCH_ITEM),
    "MISSION_SET_CURRENT": _mission_ack(_MISSION_NO_SUCH_ITEM),
    "MISSION_ITEM": _mission_ack(_MISSION_UNSUPPORTED),
    "MISSION_ITEM_INT": _mission_ack(_MISSION_UNSUPPORTED),
    "MISSION_WRITE_PARTIAL_LIST": _mission_ack(_MISSION_UNSUPPORTED),
    "FILE_TRANSFER_PROTOCOL": _file,
    "LOG_REQUEST_LIST": lambda frame, m: ("LOG_ENTRY", (0, 0, 0, 0, 0)),  # none kept aboard
    "LOG_REQUEST_DATA": lambda frame, m: ("LOG_DATA", (m.id, m.ofs, 0, (0,) * _LOG_BYTES)),
}
