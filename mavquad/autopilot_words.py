"""What an autopilot says in words, and the names of what it says in numbers: modes, results, texts that come in parts."""

from typing import Any, NamedTuple

ARDUPILOT = 3
_FULL, _RECENT = 50, 8
WARNING = 4  # MAV_SEVERITY: the lower, the graver
_RESULTS = ("accepted", "temporarily rejected", "denied", "not supported", "failed", "in progress", "cancelled")
_COPTER = {
    **{0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL", 7: "CIRCLE", 9: "LAND"},
    **{11: "DRIFT", 13: "SPORT", 14: "FLIP", 15: "AUTOTUNE", 16: "POSHOLD", 17: "BRAKE", 18: "THROW", 19: "AVOID_ADSB"},
    **{20: "GUIDED_NOGPS", 21: "SMART_RTL", 22: "FLOWHOLD", 23: "FOLLOW", 24: "ZIGZAG", 26: "AUTOROTATE", 27: "AUTO_RTL"},
}
_PX4 = {1: "MANUAL", 2: "ALTCTL", 3: "POSCTL", 4: "AUTO", 5: "ACRO", 6: "OFFBOARD", 7: "STABILIZED"}
_PX4_AUTO = {2: "TAKEOFF", 3: "HOLD", 4: "MISSION", 5: "RTL", 6: "LAND", 8: "FOLLOW_ME", 9: "PRECLAND"}
_PREFIXES = ("Arm: ", "PreArm: ", "Arming denied: ", "Arming denied! ", "Preflight Fail: ")


class Heard(NamedTuple):
    """The autopilot's texts: the last whole one, and the parts of one that is still coming."""

    text: str = ""
    severity: int = 7
    t_us: int = 0  # arrival
    number: int = 0  # of the text that comes in parts; 0: none
    parts: str = ""
    whole: int = 0  # texts so far
    recent: tuple[str, ...] = ()  # the last of them, for those who look now and then


def hear(heard: Heard, message: Any, now_us: int) -> tuple[Heard, bool]:
    """A STATUSTEXT; True when a text is whole now. A part that got lost leaves the rest to be read without it."""
    words = message.text
    if message.id:
        before = heard.parts if message.id == heard.number else "... " * (message.chunk_seq > 0)
        words = before + words
        if len(message.text) >= _FULL:  # another part follows
            return heard._replace(number=message.id, parts=words), False
    recent = (*heard.recent[1 - _RECENT :], words)
    return Heard(words, message.severity, now_us, 0, "", heard.whole + 1, recent), True


def reason(text: str) -> str:
    """Why, without the words that say that it is about arming."""
    for prefix in _PREFIXES:
        if text.startswith(prefix):
            return text[len(prefix) :]
    return text


def result(number: int) -> str:
    """A MAV_RESULT in words."""
    return _RESULTS[number] if 0 <= number < len(_RESULTS) else f"result {number}"


def mode(autopilot: int, custom_mode: int) -> str:
    """The name of HEARTBEAT's custom_mode, or its number."""
    if autopilot == ARDUPILOT:
        return _COPTER.get(custom_mode, str(custom_mode))
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    return _PX4_AUTO.get(sub, f"AUTO {sub}") if main == 4 else _PX4.get(main, str(custom_mode))
