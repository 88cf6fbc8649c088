"""What both autopilots have in common: arming, knowing the ground, and the few tasks that their modes are made of.

A task is what is flown without setpoints from outside: hold, climb to a height, come down, go home. `external` leaves the setpoint
record to the messages that arrive. Times are vehicle time in microseconds; `tick` comes each 20 ms.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

from mavquad.errors import ConfigError
from sitl import rotation
from sitl.config import ORIGIN
from sitl.params import Table
from sitl.state import IDLE, OFF, POSITION, RATES
from sitl.vehicle import Vehicle

TICK_US = 20_000
EARTH_M = 6_371_000.0
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = 0, 1, 2, 3, 4, 5  # MAV_RESULT
EMERGENCY, CRITICAL, ERROR, WARNING, NOTICE, INFO = 0, 2, 3, 4, 5, 6  # MAV_SEVERITY
ON_GROUND, IN_AIR, TAKING_OFF, LANDING = 1, 2, 3, 4  # MAV_LANDED_STATE
CRASH_M_S = 3.0  # a touch-down faster than this
FORCE = 21196.0  # param2 of an arm command that means it


class Home(NamedTuple):
    """Where the vehicle was armed, or first knew where it is; local frame."""

    p_ned_m: tuple[float, float, float]
    q_wxyz: tuple[float, ...]


class Autopilot(ABC):
    """Base of the personalities. `say(severity, text)` sends a STATUSTEXT to everybody."""

    kind = 0  # MAV_AUTOPILOT
    capabilities = 0
    version = 0
    rate_limit_hz = 1000.0  # more is refused
    rate_denied = FAILED  # a rate for a message that is not there
    shapes = False  # ATTITUDE_TARGET tells the target after shaping, not what was sent
    refusal = TEMPORARILY_REJECTED  # of arming and disarming
    denied = "Arming denied"  # how a reason begins
    timesync_us = 0  # how often it asks for the time unless in lockstep; 0 never

    def __init__(self, vehicle: Vehicle, params: Table, say: Callable[[int, str], None]) -> None:
        self.vehicle, self.params, self.say = vehicle, params, say
        self.boot_us = self.t_us = vehicle.t_us
        self.heard_us: dict[int, int] = {}  # when each system was last heard
        self.armed = False
        self.landed = True
        self.flown = False  # has been in the air since it was armed
        self.ended_us = -1  # when the last flight ended
        self.crashed = False
        self.task = "none"
        self.setpoint_us = -1  # when the last usable setpoint from outside came
        self.fresh = 0  # usable setpoints since somebody counted
        self.echo_q: tuple[float, ...] | None = None  # the attitude that was asked for, as it came
        self.home: Home | None = None
        self._ground_us = self.t_us
        self._armed_us = 0
        self._target_d = self._climb_d = 0.0
        self._yaw_rate = 0.0
        self._stop()
        self.apply_params()

    # ---- what a personality adds --------------------------------------------------------------------------------------
    @abstractmethod
    def apply_params(self) -> None:
        """Parameters into the constants of the loops."""

    @abstractmethod
    def heartbeat(self) -> tuple[int, ...]:
        """Fields of HEARTBEAT."""

    @abstractmethod
    def can_arm(self) -> str:
        """Why arming is refused, or nothing."""

    @abstractmethod
    def set_mode(self, custom: int, sub: int) -> int:
        """DO_SET_MODE: a MAV_RESULT."""

    @abstractmethod
    def takeoff(self, altitude: float) -> int:
        """NAV_TAKEOFF with its param7: a MAV_RESULT."""

    @abstractmethod
    def land(self) -> int:
        """NAV_LAND: a MAV_RESULT."""

    @abstractmethod
    def go_home(self) -> int:
        """NAV_RETURN_TO_LAUNCH: a MAV_RESULT."""

    @abstractmethod
    def attitude_target(self, m: Any) -> None:
        """SET_ATTITUDE_TARGET."""

    @abstractmethod
    def position_target(self, m: Any) -> None:
        """SET_POSITION_TARGET_LOCAL_NED."""

    @abstractmethod
    def mode_tick(self) -> None:
        """Failsafes and mode changes of the personality, each 20 ms."""

    @abstractmethod
    def landed_or_arrived(self, task: str) -> None:
        """A task has come to its end (`takeoff` reached its height, `land` and `return` disarmed)."""

    @property
    @abstractmethod
    def engaged(self) -> bool:
        """Somebody outside is flying by setpoints."""

    @property
    def has_origin(self) -> bool:
        """The estimator knows where it is."""
        return True

    @abstractmethod
    def split_mode(self, custom_mode: int) -> tuple[int, int]:
        """HEARTBEAT's custom_mode as the two numbers of `set_mode`."""

    def actuator_target(self, m: Any) -> None:
        """SET_ACTUATOR_CONTROL_TARGET: left alone where nothing takes it."""
        return

    def data_stream(self, stream: int) -> tuple[str, ...]:
        """The messages of an old REQUEST_DATA_STREAM; none where it is not honoured."""
        return ()

    def heard(self, system: int, component: int) -> None:
        """A HEARTBEAT of somebody else."""
        self.heard_us[system] = self.vehicle.t_us

    def attitude_echo(self) -> tuple[Any, ...]:
        """Fields of ATTITUDE_TARGET behind the stamp: what the attitude loop is after, as it was asked for."""
        state, kind = self.vehicle.state, self.vehicle.setpoint["kind"]
        q = self.echo_q or rotation.to_quaternion(tuple(state.view["target_R"].tolist()))
        return 128 if kind == RATES else 0, q, *state.view["target_rates_rad_s"].tolist(), state["thrust"]

    # ---- arming -------------------------------------------------------------------------------------------------------
    def arm(self, force: bool) -> int:
        """A MAV_RESULT; the reason of a refusal is said."""
        if self.armed:
            return ACCEPTED
        reason = "" if force else self.can_arm()
        if reason:
            self.say(CRITICAL, f"{self.denied}: {reason}")
            return self.refusal
        self.armed, self.flown, self._armed_us = True, False, self.t_us
        self.set_home()
        self.vehicle.setpoint["kind"] = IDLE
        self.say(INFO, "Armed by external command")
        return ACCEPTED

    def disarm(self, force: bool, why: str = "external command") -> int:
        """A MAV_RESULT; in the air only by force."""
        if self.armed and not self.landed and not force:
            self.say(CRITICAL, "Disarming denied: not landed")
            return self.refusal
        if self.armed:
            self.say(INFO, f"Disarmed by {why}")
            self.ended_us = self.t_us if self.flown else self.ended_us
        self.armed = False
        self._stop()
        return ACCEPTED

    # ---- each 20 ms ---------------------------------------------------------------------------------------------------
    def tick(self, t_us: int) -> None:
        """Landing detection, the running task, then what the personality does by itself."""
        self.t_us = t_us
        self._feel_ground()
        self.mode_tick()
        if not self.armed:
            return
        if self._yaw_rate and self.vehicle.setpoint["kind"] == POSITION:
            self.vehicle.setpoint["yaw_rad"] = self.vehicle.setpoint["yaw_rad"] + self._yaw_rate * 1e-6 * TICK_US
        if self.task == "takeoff":
            self._climb()
        elif self.task in ("land", "return"):
            self._come_down()
        elif self.task == "hold" and self.landed:
            self.vehicle.setpoint["kind"] = IDLE

    @property
    def landed_state(self) -> int:
        """MAV_LANDED_STATE."""
        if self.landed:
            return ON_GROUND
        if self.task == "takeoff":
            return TAKING_OFF
        return LANDING if self.task == "land" else IN_AIR

    def position(self) -> list[float]:
        """Where the autopilot believes it is, local frame."""
        return self.vehicle.state["nav_p_ned_m"].tolist()

    def yaw(self) -> float:
        """Its heading."""
        return float(self.vehicle.state["ahrs_euler_rad"][2])

    def set_home(self) -> None:
        """Home is here."""
        p = self.position()
        self.home = Home((p[0], p[1], p[2]), tuple(self.vehicle.state["ahrs_q_wxyz"].tolist()))

    def boot_ms(self) -> int:
        """Milliseconds since boot."""
        return (self.vehicle.t_us - self.boot_us) // 1000

    # ---- tasks --------------------------------------------------------------------------------------------------------
    def start_hold(self) -> None:
        """Stay here; on the ground the rotors idle."""
        self.task = "hold"
        self._aim(self.position(), self.yaw())

    def start_takeoff(self, target_d_m: float) -> None:
        """Climb over this place to a height in the local frame."""
        self.task = "takeoff"
        here = self.position()
        self._target_d, self._climb_d = target_d_m, here[2]
        self._aim(here, self.yaw())

    def start_land(self) -> None:
        """Come down here."""
        self.task = "land"
        self._aim(self.position(), self.yaw())

    def start_return(self) -> None:
        """Fly to where it was armed, then come down."""
        self.task = "return"
        here = self.position()
        home = self.home.p_ned_m if self.home else (0.0, 0.0, 0.0)
        self._aim([home[0], home[1], here[2]], self.yaw())

    def start_external(self) -> None:
        """Setpoints come from outside."""
        self.task = "external"

    @abstractmethod
    def climb_speed(self) -> float:
        """Of a take-off, m/s."""

    @abstractmethod
    def sink_speed(self, height_m: float) -> float:
        """Of a landing at a height above home, m/s."""

    @abstractmethod
    def disarm_after_s(self) -> float:
        """How long it stands before it disarms by itself."""

    def estimator_jumped(self, jump_m: list[float]) -> None:
        """The estimator has moved its position: own targets move with it, those from outside do not."""
        state, sp = self.vehicle.state, self.vehicle.setpoint
        state["aim_p"] = state["aim_p"] + jump_m
        if self.task != "external":
            sp["p_ned_m"] = sp["p_ned_m"] + jump_m
            self._target_d += jump_m[2]
            self._climb_d += jump_m[2]

    # ---- inside -------------------------------------------------------------------------------------------------------
    def _stop(self) -> None:
        self.task = "none"
        self.vehicle.setpoint["kind"] = OFF
        self.echo_q = None

    def _aim(self, p: list[float], yaw: float) -> None:
        sp = self.vehicle.setpoint
        sp["p_ned_m"], sp["v_ned_m_s"], sp["a_ned_m_s2"], sp["yaw_rad"] = p, math.nan, math.nan, yaw
        self._yaw_rate = 0.0
        if sp["kind"] != POSITION:
            self.vehicle.state["velocity_integral"] = 0.0
        if self.armed:
            sp["kind"] = POSITION
        self.echo_q = None

    def _climb(self) -> None:
        sp, here = self.vehicle.setpoint, self.position()
        speed = self.climb_speed()
        self._climb_d = max(self._target_d, self._climb_d - speed * 1e-6 * TICK_US)
        sp["p_ned_m"][2] = self._climb_d
        sp["v_ned_m_s"][2] = -speed if self._climb_d > self._target_d else math.nan
        if self._climb_d <= self._target_d and here[2] < self._target_d + 0.3:
            sp["p_ned_m"][2] = self._target_d
            self.task = "hold"
            self.landed_or_arrived("takeoff")

    def _come_down(self) -> None:
        sp, here = self.vehicle.setpoint, self.position()
        if self.task == "return":
            if math.hypot(sp["p_ned_m"][0] - here[0], sp["p_ned_m"][1] - here[1]) > 0.5:
                return
            self.task = "land"
        sp["p_ned_m"][2] = math.nan
        sp["v_ned_m_s"][2] = self.sink_speed((self.home.p_ned_m[2] if self.home else 0.0) - here[2])
        if self.vehicle.state["grounded"] and self.t_us - self._ground_us > 200_000:
            sp["kind"] = IDLE

    def _feel_ground(self) -> None:
        if not self.vehicle.state["grounded"]:
            self._ground_us, self.landed, self.flown = self.t_us, False, True
            return
        impact = self.vehicle.state["impact_m_s"]
        if impact > CRASH_M_S:
            self.crashed, self.ended_us = True, self.t_us
            self.say(EMERGENCY, f"Crash: touched down at {impact:.1f} m/s")
            self.disarm(True, "crash")
        self.vehicle.state["impact_m_s"] = 0.0
        stood_us = self.t_us - self._ground_us
        if not self.landed and stood_us >= 1_000_000:
            self.landed = True
            self.say(INFO, "Landing detected")
        if self.armed and self.landed and self.flown and stood_us >= 1e6 * (1.0 + self.disarm_after_s()):
            ended = self.task
            self.disarm(True, "auto-disarm: landed")
            if ended in ("land", "return"):
                self.landed_or_arrived(ended)
        elif self.armed and self.landed and not self.flown and self.t_us - self._armed_us >= 10_000_000:
            self.disarm(True, "auto-disarm: no take-off for 10 s")


def quaternion_matrix(q: Any) -> tuple[float, ...] | None:
    """The rotation of a quaternion that came over the wire, or None where its length is not 1 within half a percent."""
    w, x, y, z = q
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.995 < norm < 1.005:  # NaN fails too
        return None
    return rotation.from_quaternion((w / norm, x / norm, y / norm, z / norm))


def geodetic(p_ned_m: Any) -> tuple[int, int, float]:
    """(latitude, longitude in 1e-7 degrees, altitude in m) of a point of the local frame."""
    lat = ORIGIN[0] + math.degrees(p_ned_m[0] / EARTH_M)
    lon = ORIGIN[1] + math.degrees(p_ned_m[1] / (EARTH_M * math.cos(math.radians(ORIGIN[0]))))
    return round(1e7 * lat), round(1e7 * lon), ORIGIN[2] - p_ned_m[2]


def check_airframe(vehicle: Vehicle) -> None:
    """Raises ConfigError where the true vehicle cannot carry itself."""
    c = vehicle.constants
    if 4.0 * c["thrust_max_n"] < 1.05 * c["mass_kg"] * 9.80665:
        raise ConfigError(f"the vehicle weighs {c['mass_kg']:.3g} kg and lifts {4 * c['thrust_max_n']:.3g} N: it cannot fly")


def finite(values: Any) -> bool:
    """No NaN, no infinity."""
    return all(map(math.isfinite, values))
