"""Those on the network who are not believed: why, and the words for it.

A refused frame enters no flight. That somebody poses as our autopilot or as us must be seen on every monitor all the same: the shell
hands the pipeline a note of its own (as from a ground station), which is logged like all that is received and makes the companion
say it. Nobody else can: a STATUSTEXT that does not come from the autopilot is refused at the door (`pipeline.accepts`).
"""

from mavquad import wire
from mavquad.wire import Frame

Address = tuple[str, int]  # ("", 0) where there is none: a serial line
ELSEWHERE, OURSELVES = "our autopilot's id from another address", "our own address"
POSING = (ELSEWHERE, OURSELVES)
MOVED_S = 3.0  # who was silent for so long may come back from another address
_LOCAL = (255, 190)  # as a local request comes
_ADVICE = {
    ELSEWHERE: "somebody poses as it, or two vehicles have one id",
    OURSELVES: "another companion has our id, or a router sends our words back: give one of them another [link] component",
    "unsigned": "a key is set here; give the sender the same one",
    "badly signed": "its key is not ours",
    "signed long ago": "its clock is more than a minute behind ours",
}


def words(frame: Frame, address: Address, reason: str) -> str:
    """What a person is shown, once for each reason."""
    name = wire.NAME.get(frame.msgid, f"message {frame.msgid}")
    advice = f" ({_ADVICE[reason]})" if reason in _ADVICE else ""
    return f"refused {name} of {_who(frame, address)}: {reason}{advice}; counted from now on"


def notice(frame: Frame, address: Address) -> Frame:
    """The note to the pipeline that these ids came from where they do not belong."""
    text = f"refused {_who(frame, address)}"[:41]  # behind "mavquad: "
    raw = wire.encode("STATUSTEXT", (4, text, 0, 0), seq=0, system=_LOCAL[0], component=_LOCAL[1])
    return wire.split(raw)[0][0]


def is_notice(frame: Frame) -> bool:
    """Whether a STATUSTEXT is such a note."""
    return (frame.system, frame.component) == _LOCAL


def _who(frame: Frame, address: Address) -> str:
    where = f" from {address[0]}:{address[1]}" if address[0] else ""
    return f"{frame.system}/{frame.component}{where}"
