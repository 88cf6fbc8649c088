"""searching -> configuring -> observing -> streaming -> engaged -> released: a pure step over messages and time.

It decides which commands go to the autopilot and when setpoints may flow; it knows nothing of estimators and controllers.
Every function takes the state and returns it with the frames to send (name, fields): no clock, socket or file is touched.
"""

import math
from typing import Any, NamedTuple

from mavquad import autopilot_words
from mavquad.autopilot_words import WARNING, Heard
from mavquad.settings import Companion

SEARCHING, CONFIGURING, OBSERVING, STREAMING, ENGAGED, RELEASED = (
    "searching",
    "configuring",
    "observing",
    "streaming",
    "engaged",
    "released",
)
STATES = (SEARCHING, CONFIGURING, OBSERVING, STREAMING, ENGAGED, RELEASED)

# MAVLink numbers (common.xml)
ARDUPILOT, PX4, INVALID = 3, 12, 8
CMD_LAND, CMD_TAKEOFF, CMD_SET_MODE, CMD_ENGAGE, CMD_ARM = 21, 22, 176, 300, 400
CMD_SET_INTERVAL, CMD_REQUEST_MESSAGE = 511, 512
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = range(6)
ARMED = 128
GUIDED, LAND_MODE = 4, 9  # ArduCopter
OFFBOARD = 6 << 16  # PX4: main mode in byte 2
LAND_PX4 = 4 << 16 | 6 << 24
_PX4_ON_THE_WAY = (4 << 16 | 2 << 24, 4 << 16 | 3 << 24)  # take-off, hold: modes it takes by itself while we lead it up
STEPS_HZ = (250.0, 200.0, 100.0, 50.0, 25.0, 10.0, 4.0)
_RETRY_US, _TRIES = 500_000, 4
_IN_PROGRESS_US = 3_000_000  # more time for a command that is being carried out
_TEXT_US = 2_000_000  # a text and a refusal this close belong together: either may come first

Send = tuple[str, tuple[Any, ...]]
Sends = tuple[Send, ...]


class Pending(NamedTuple):
    """A command that waits for its ACK."""

    command: int
    params: tuple[float, ...]
    tries: int
    due_us: int
    purpose: str  # "rate", "message", "arm", "takeoff", "mode", "land"


class Rate(NamedTuple):
    """One message rate asked for."""

    name: str
    msgid: int
    wanted_hz: float
    granted_hz: float  # NaN: not answered yet; 0: refused


class Life(NamedTuple):
    state: str
    phase: str  # inside a state, what is waited for
    reason: str  # of the last change
    target: tuple[int, int]  # (0, 0): nobody yet
    autopilot: int
    armed: bool
    mode: int
    landed: int  # MAV_LANDED_STATE; 0 unknown, 1 on ground, 2 in air
    home_alt_m: float
    heard_us: int  # arrival of the last HEARTBEAT
    pending: Pending | None
    rates: tuple[Rate, ...]
    rate_at: int
    wants: tuple[str, ...]  # parameters still to be read
    wants_due_us: int
    wants_tries: int
    params: tuple[tuple[str, float], ...]  # of the autopilot, as far as read
    engage: bool  # asked for
    since_us: int  # arrival, of the last phase
    steady_us: int  # arrival since when the vehicle hovers at its height; 0: not yet
    ended: bool  # the path is over, or landing was asked for
    airborne: bool  # has been, since the last arming
    said: str  # last complaint, so that it is not repeated each time
    heard: Heard  # what the autopilot says in words
    refused: str  # the purpose it refused last
    refused_us: int


def init(settings: Companion) -> Life:
    rates = tuple(Rate(name, 0, hz, math.nan) for name, hz in settings.link.rates_hz.items())
    return Life(
        *(SEARCHING, "", "", (0, 0), 0, False, 0, 0, math.nan, 0, None, rates, 0, (), 0, 0, (), False, 0, 0, False, False),
        *("", Heard(), "", 0),
    )


def param(life: Life, name: str) -> float:
    """A parameter of the autopilot, NaN where it was not read."""
    return dict(life.params).get(name, math.nan)


def text(words: str, severity: int = 6) -> Send:
    """A STATUSTEXT of ours; 50 bytes at most."""
    return ("STATUSTEXT", (severity, words[:50], 0, 0))


def go(life: Life, state: str, phase: str, now_us: int, reason: str) -> tuple[Life, Sends]:
    """Change the state, say so."""
    severity = 4 if state == RELEASED else 6
    sends = () if state == life.state else (text(f"mavquad {state}: {reason}", severity),)
    return life._replace(state=state, phase=phase, since_us=now_us, reason=reason), sends


def command(life: Life, number: int, params: tuple[float, ...], purpose: str, now_us: int) -> tuple[Life, Sends]:
    """Send a COMMAND_LONG and wait for its ACK."""
    padded = (*params, *([0.0] * (7 - len(params))))
    life = life._replace(pending=Pending(number, padded, 1, now_us + _RETRY_US, purpose))
    return life, (_long(life, number, padded, 0),)


def _long(life: Life, number: int, params: tuple[float, ...], confirmation: int) -> Send:
    return ("COMMAND_LONG", (*life.target, number, confirmation, *params))


def due_us(life: Life) -> int:
    """When `on_time` has something to do at the latest; 0: nothing."""
    times = [
        t for t in (life.pending.due_us if life.pending else 0, life.wants_due_us if life.phase == "parameters" else 0) if t
    ]
    return min(times) if times else 0


# ---- messages ---------------------------------------------------------------------------------------------------------
def on_heartbeat(life: Life, source: tuple[int, int], message: Any, now_us: int, settings: Companion) -> tuple[Life, Sends]:
    """HEARTBEAT of an autopilot: who it is, armed, mode."""
    if message.autopilot == INVALID or source[1] != 1:
        return life, ()
    if life.target == (0, 0):
        wanted = settings.link.target_system
        if wanted and source[0] != wanted:
            return life, ()
        life = life._replace(target=source, autopilot=message.autopilot, mode=message.custom_mode)
        life = life._replace(armed=bool(message.base_mode & ARMED), heard_us=now_us)
        kind = {ARDUPILOT: "ArduPilot", PX4: "PX4"}.get(message.autopilot, f"autopilot {message.autopilot}")
        life, sends = go(life, CONFIGURING, "rates", now_us, f"{kind} {source[0]}/{source[1]}")
        life, more = _next_rate(life, now_us)
        return life, sends + more
    if source != life.target:
        return life, ()
    armed = bool(message.base_mode & ARMED)
    was, life = life, life._replace(armed=armed, mode=message.custom_mode, heard_us=now_us, airborne=life.airborne and armed)
    if life.state == ENGAGED and not guided(life):
        return release(life, now_us, "landing by the autopilot" if life.phase == "landing" else _taken(life, now_us))
    leading = life.state == STREAMING or (life.state == OBSERVING and life.engage)
    if leading and life.mode != was.mode and not guided(life) and not _on_the_way(life):
        return release(life, now_us, _taken(life, now_us))
    if (life.state == ENGAGED or leading) and was.armed and not armed:
        return release(life, now_us, "disarmed")
    return life, ()


def _on_the_way(life: Life) -> bool:
    return life.autopilot != ARDUPILOT and life.mode in _PX4_ON_THE_WAY


def _taken(life: Life, now_us: int) -> str:
    """Why we let go of a vehicle whose mode has changed, with what it said about it."""
    words = f"mode {autopilot_words.mode(life.autopilot, life.mode)} set by another"
    why = life.heard.text
    return f"{words}: {why}" if _just_heard(life, now_us) and autopilot_words.reason(why) == why else words


def _just_heard(life: Life, now_us: int) -> bool:
    return life.heard.severity <= WARNING and now_us - life.heard.t_us <= _TEXT_US and bool(life.heard.text)


def on_text(life: Life, message: Any, now_us: int) -> tuple[Life, Sends]:
    """STATUSTEXT of the autopilot: the reason of a refusal that came just before is passed on."""
    heard, whole = autopilot_words.hear(life.heard, message, now_us)
    life = life._replace(heard=heard)
    if not whole or not life.refused or now_us - life.refused_us > _TEXT_US or heard.severity > WARNING:
        return life, ()
    return _say_once(life, f"{life.refused} refused: {autopilot_words.reason(heard.text)}")


def guided(life: Life) -> bool:
    """Whether the autopilot's mode takes our setpoints."""
    if life.autopilot == ARDUPILOT:
        return life.mode in (GUIDED, 20)
    return life.mode & 0xFF0000 == OFFBOARD


def release(life: Life, now_us: int, reason: str) -> tuple[Life, Sends]:
    """Stop sending setpoints, for good until asked again."""
    life, sends = go(life._replace(engage=False, pending=None), RELEASED, "", now_us, reason)
    return life, sends


def on_request(life: Life, number: int, now_us: int) -> tuple[Life, Sends, int]:
    """A COMMAND_LONG addressed to us: engage or land. Returns the MAV_RESULT for its ACK too."""
    if number == CMD_ENGAGE:
        if life.state in (STREAMING, ENGAGED):
            return life, (), ACCEPTED
        life = life._replace(engage=True, ended=False, steady_us=0, said="")
        if life.state == RELEASED:
            life, sends = go(life, OBSERVING, "", now_us, "asked to engage again")
            return life, sends, ACCEPTED
        return life, (), ACCEPTED
    if number == CMD_LAND:
        return life._replace(ended=True), (), ACCEPTED
    return life, (), UNSUPPORTED


def on_ack(life: Life, message: Any, now_us: int, settings: Companion) -> tuple[Life, Sends]:
    """COMMAND_ACK: go on, step down, try again later, or give up where it would be refused again."""
    p = life.pending
    own = settings.link
    # an older autopilot's ACK names nobody
    ours = message.target_system in (0, own.system) and message.target_component in (0, own.component)
    if p is None or message.command != p.command or not ours:
        return life, ()
    if message.result == IN_PROGRESS:
        return life._replace(pending=p._replace(due_us=now_us + _IN_PROGRESS_US)), ()
    life = life._replace(pending=None)
    if p.purpose == "rate":
        return _rate_answered(life, message.result == ACCEPTED, now_us)
    if message.result != ACCEPTED:
        return _refused(life, p.purpose, message.result, now_us)
    life = life._replace(refused="")
    if p.purpose == "takeoff":
        return life._replace(phase="climb", since_us=now_us, steady_us=0), ()
    return life, ()


def _refused(life: Life, purpose: str, result: int, now_us: int) -> tuple[Life, Sends]:
    """Shown with the autopilot's reason. Tried again in a while, unless it says that the same would be refused again."""
    if purpose == "message":
        return (life._replace(phase="wait message", since_us=now_us) if life.engage else life), ()
    explained = _just_heard(life, now_us)
    words = f"{purpose} refused: {autopilot_words.reason(life.heard.text) if explained else autopilot_words.result(result)}"
    if result in (DENIED, UNSUPPORTED) and purpose != "land":
        return release(life, now_us, words)
    life = life._replace(phase=f"wait {purpose}", since_us=now_us, refused=purpose, refused_us=now_us)
    if not explained and life.said.startswith(f"{purpose} refused: "):
        return life, ()  # its reason was shown, and comes again behind this answer
    return _say_once(life, words)


def on_param(life: Life, name: str, value: float, now_us: int) -> Life:
    """PARAM_VALUE of the autopilot."""
    params = dict(life.params)
    params[name] = value
    life = life._replace(params=tuple(params.items()))
    if life.wants and name == life.wants[0]:
        life = life._replace(wants=life.wants[1:], wants_due_us=now_us, wants_tries=0)
    return life


# ---- rates ------------------------------------------------------------------------------------------------------------
def _rate_command(life: Life, rate: Rate, hz: float, now_us: int) -> tuple[Life, Sends]:
    return command(life, CMD_SET_INTERVAL, (float(rate.msgid), round(1e6 / hz)), "rate", now_us)


def _next_rate(life: Life, now_us: int) -> tuple[Life, Sends]:
    if life.rate_at < len(life.rates):
        rate = life.rates[life.rate_at]
        return _rate_command(life, rate, rate.wanted_hz, now_us)
    wants = ("GUID_OPTIONS", "MOT_THST_HOVER") if life.autopilot == ARDUPILOT else ("MPC_THR_HOVER",)
    life = life._replace(phase="parameters", wants=wants, wants_due_us=now_us, wants_tries=0)
    return on_time(life, now_us)


def _rate_answered(life: Life, granted: bool, now_us: int) -> tuple[Life, Sends]:
    rate = life.rates[life.rate_at]
    asked = rate.wanted_hz if math.isnan(rate.granted_hz) else -rate.granted_hz
    lower = [hz for hz in STEPS_HZ if hz < asked - 1e-9]
    if granted or not lower:
        rates = list(life.rates)
        rates[life.rate_at] = rate._replace(granted_hz=asked if granted else 0.0)
        return _next_rate(life._replace(rates=tuple(rates), rate_at=life.rate_at + 1), now_us)
    rates = list(life.rates)
    rates[life.rate_at] = rate._replace(granted_hz=-lower[0])  # negative: asked for, not granted yet
    return _rate_command(life._replace(rates=tuple(rates)), rate, lower[0], now_us)


# ---- time ---------------------------------------------------------------------------------------------------------------
def on_time(life: Life, now_us: int) -> tuple[Life, Sends]:
    """Repeat a command whose ACK is overdue, ask for the next parameter, give up in the end."""
    sends: Sends = ()
    p = life.pending
    if p is not None and now_us >= p.due_us:
        if p.tries >= _TRIES:
            life = life._replace(pending=None)
            if p.purpose == "rate":
                life, said = _say_once(life, "no answer to rate requests")
                life, more = _rate_answered(life, False, now_us)
                return life, sends + said + more
            life = life._replace(phase=f"wait {p.purpose}", since_us=now_us)
            return life, (text(f"mavquad: no answer to {p.purpose}", 4),)
        life = life._replace(pending=p._replace(tries=p.tries + 1, due_us=now_us + _RETRY_US))
        sends += (_long(life, p.command, p.params, p.tries),)
    if life.phase == "parameters":
        if not life.wants:
            if math.isnan(life.home_alt_m):
                life, more = command(life, CMD_REQUEST_MESSAGE, (242.0,), "message", now_us)
                sends += more
            life, more = go(life, OBSERVING, "", now_us, "configured")
            return life, sends + more
        if now_us >= life.wants_due_us:
            if life.wants_tries >= _TRIES:
                life = life._replace(wants=life.wants[1:], wants_tries=0)
                return on_time(life._replace(wants_due_us=now_us), now_us) if life.wants else on_time(life, now_us)
            sends += (("PARAM_REQUEST_READ", (*life.target, life.wants[0], -1)),)
            life = life._replace(wants_due_us=now_us + _RETRY_US, wants_tries=life.wants_tries + 1)
    return life, sends


class Sight(NamedTuple):
    """What the life cycle is told of the vehicle at each tick."""

    attitude_age_s: float
    position_age_s: float
    height_m: float  # above home
    speed_m_s: float


def on_tick(life: Life, sight: Sight, now_us: int, settings: Companion) -> tuple[Life, Sends]:
    """Lead the vehicle from the ground to `engaged`, and from the end of the path to the ground. Called at each heartbeat-like tick."""
    if life.state == OBSERVING and life.engage:
        return _before_flight(life, sight, now_us, settings)
    if life.state == STREAMING:
        waited_s = 1e-6 * (now_us - life.since_us)
        if guided(life) and waited_s >= 1.0:
            return go(life, ENGAGED, "path", now_us, "setpoints are flown")
        if not guided(life) and life.pending is None and waited_s >= 1.2:
            life, sends = command(life, CMD_SET_MODE, _mode(life), "mode", now_us)
            return life._replace(since_us=now_us - 1_000_000), sends
    again = life.phase != "wait land" or now_us - life.since_us > 2_000_000
    if life.state == ENGAGED and life.ended and life.pending is None and life.phase != "landing" and again:
        if life.autopilot == ARDUPILOT:
            life, sends = command(life, CMD_SET_MODE, (1.0, float(LAND_MODE)), "land", now_us)
        else:
            life, sends = command(life, CMD_LAND, (0.0, 0.0, 0.0, math.nan, math.nan, math.nan, math.nan), "land", now_us)
        said = () if life.phase == "wait land" else (text("mavquad: path over, landing"),)
        return life._replace(phase="landing"), (*sends, *said)
    return life, ()


def _mode(life: Life) -> tuple[float, ...]:
    return (1.0, float(GUIDED)) if life.autopilot == ARDUPILOT else (1.0, 6.0, 0.0)


def _say_once(life: Life, words: str) -> tuple[Life, Sends]:
    if words == life.said:
        return life, ()
    return life._replace(said=words), (text(f"mavquad: {words}", 4),)


def _before_flight(life: Life, sight: Sight, now_us: int, settings: Companion) -> tuple[Life, Sends]:
    if life.phase == "parameters":  # one is being asked for again
        return life, ()
    waited_s = 1e-6 * (now_us - life.since_us)
    if sight.attitude_age_s > 0.5 or sight.position_age_s > 0.5:
        missing = "attitude" if sight.attitude_age_s > 0.5 else "local position"
        return _say_once(life, f"waiting for {missing}") if waited_s > 3.0 else (life, ())
    if life.pending is not None:
        return life, ()
    if life.phase.startswith("wait ") and waited_s < 2.0:
        return life, ()
    if life.autopilot == ARDUPILOT and settings.controller != "autopilot":
        options = param(life, "GUID_OPTIONS")
        if math.isnan(options):
            words = "asking for GUID_OPTIONS again"
            if life.said == words:
                return release(life, now_us, "GUID_OPTIONS cannot be read")
            life = life._replace(phase="parameters", wants=("GUID_OPTIONS",), wants_due_us=now_us, wants_tries=0)
            return _say_once(life, words)
        if not int(options) & 8:  # thrust would be a climb rate
            return release(life, now_us, f"set GUID_OPTIONS to {int(options) | 8}")
    if life.phase in ("takeoff", "climb", "takeover") and not life.armed and waited_s > 3.0:
        life = life._replace(phase="", since_us=now_us)  # it has disarmed, or restarted so early that its clock did not show it
    aloft = life.armed and (life.landed == 2 or sight.height_m > 0.5 * settings.takeoff_m)
    if life.phase in ("climb", "takeover"):
        at_height = life.phase == "takeover" or abs(sight.height_m - settings.takeoff_m) < 0.35
        if not at_height or sight.speed_m_s > (1.0 if life.phase == "takeover" else 0.35):
            life = life._replace(steady_us=0)
            return _say_once(life, f"not at {settings.takeoff_m:g} m after 60 s") if waited_s > 60.0 else (life, ())
        if not life.steady_us:
            return life._replace(steady_us=now_us), ()
        if now_us - life.steady_us < 2_000_000:
            return life, ()
        if life.autopilot == ARDUPILOT and life.mode != GUIDED:
            return command(life, CMD_SET_MODE, _mode(life), "mode", now_us)
        return go(life._replace(airborne=True), STREAMING, "", now_us, "hovering, setpoints flow")
    if aloft and life.phase != "takeoff":
        return life._replace(phase="takeover", since_us=now_us, steady_us=0), ()
    if life.autopilot == ARDUPILOT and life.mode != GUIDED:
        return command(life._replace(phase="mode"), CMD_SET_MODE, _mode(life), "mode", now_us)
    if not life.armed:
        if life.phase == "arm" and waited_s < 2.0:
            return life, ()
        return command(life._replace(phase="arm", since_us=now_us), CMD_ARM, (1.0,), "arm", now_us)
    if life.phase == "takeoff":
        return life, ()
    if life.autopilot == ARDUPILOT:
        height = settings.takeoff_m
    elif math.isnan(life.home_alt_m):
        return command(life, CMD_REQUEST_MESSAGE, (242.0,), "message", now_us)
    else:
        height = life.home_alt_m + settings.takeoff_m
    params = (0.0, 0.0, 0.0, math.nan, math.nan, math.nan, height)
    return command(life._replace(phase="takeoff"), CMD_TAKEOFF, params, "takeoff", now_us)
