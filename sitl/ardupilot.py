"""Personality `ardupilot`: ArduCopter as observed on the wire, with everything about it that surprises a companion.

Nothing is sent unasked; more than 200 Hz is refused and the old rate stays. Thrust is a climb rate unless GUID_OPTIONS has bit 3.
Setpoints that are not understood restart guided mode in silence. When setpoints stop, the last is held for GUID_TIMEOUT, then it
levels. The local position is absent until the origin is set, 20 s after boot. Shaping of attitude: `sitl.shaping`.

Source: recordings of ArduCopter 4.7.0-dev in its own simulator. Parameters have its names and defaults (angles in centidegrees,
speeds in cm/s), except MOT_THST_EXPO: the rotors are linear.
"""

import math
from typing import Any

from mavquad.airframe import Airframe
from sitl import autopilot, rotation
from sitl.autopilot import ACCEPTED, CRITICAL, DENIED, FAILED, INFO, WARNING, Autopilot
from sitl.state import ATTITUDE, CLIMB, POSITION, RATES

STABILIZE, ALT_HOLD, GUIDED, LOITER, RTL, LAND, POSHOLD, BRAKE, GUIDED_NOGPS = 0, 2, 4, 5, 6, 9, 16, 17, 20
_NAMES = {
    STABILIZE: "STABILIZE",
    ALT_HOLD: "ALT_HOLD",
    GUIDED: "GUIDED",
    LOITER: "LOITER",
    RTL: "RTL",
    LAND: "LAND",
    POSHOLD: "POSHOLD",
    BRAKE: "BRAKE",
    GUIDED_NOGPS: "GUIDED_NOGPS",
}
_HOLDS = (ALT_HOLD, LOITER, POSHOLD, BRAKE)
_ORIGIN_US = 20_000_000  # from boot until the estimator has its origin
_THRUST_IS_THRUST = 8  # bit 3 of GUID_OPTIONS
_STATION_GONE_US = 6_000_000

STREAMS_HZ = {"HEARTBEAT": 1.0}
_GROUPS = {  # of REQUEST_DATA_STREAM
    1: ("RAW_IMU", "SCALED_IMU"),
    2: ("SYS_STATUS", "GPS_RAW_INT", "POSITION_TARGET_LOCAL_NED"),
    3: ("SERVO_OUTPUT_RAW",),
    6: ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"),
    10: ("ATTITUDE", "SIM_STATE"),
    11: ("VFR_HUD",),
    12: ("SYSTEM_TIME", "BATTERY_STATUS", "EKF_STATUS_REPORT", "HOME_POSITION"),
}


def defaults(tuned: Airframe) -> dict[str, int | float]:
    """ArduCopter's parameters as far as this autopilot has them."""
    return {
        "ANGLE_MAX": 3000,
        "ARMING_CHECK": 1,
        "ATC_ACCEL_P_MAX": 110000.0,
        "ATC_ACCEL_R_MAX": 110000.0,
        "ATC_ACCEL_Y_MAX": 27000.0,
        "ATC_ANG_PIT_P": 4.5,
        "ATC_ANG_RLL_P": 4.5,
        "ATC_ANG_YAW_P": 4.5,
        "ATC_INPUT_TC": 0.165,  # 0.15 there; with these inner loops the step answer observed needs a little more
        "DISARM_DELAY": 10,
        "FRAME_CLASS": 1,
        "FRAME_TYPE": 1 if tuned.rotors is not None and tuned.rotors.layout == "x" else 0,
        "FS_GCS_ENABLE": 0,
        "GUID_OPTIONS": 0,
        "GUID_TIMEOUT": 3.0,
        "INS_GYRO_FILTER": 20,
        "LAND_ALT_LOW": 1000.0,
        "LAND_SPEED": 50,
        "MOT_THST_EXPO": 0.0,
        "MOT_THST_HOVER": tuned.hover_thrust,
        "PSC_JERK_XY": 5.0,
        "PSC_POSXY_P": 1.0,
        "PSC_POSZ_P": 1.0,
        "PSC_VELXY_I": 1.0,
        "PSC_VELXY_P": 2.0,
        "PSC_VELZ_I": 2.0,
        "PSC_VELZ_P": 5.0,
        "SYSID_MYGCS": 255,
        "SYSID_THISMAV": 1,
        "WPNAV_ACCEL": 250.0,
        "WPNAV_ACCEL_Z": 100.0,
        "WPNAV_SPEED": 1000.0,
        "WPNAV_SPEED_DN": 150.0,
        "WPNAV_SPEED_UP": 250.0,
    }


class ArduPilot(Autopilot):
    """ArduCopter as a companion meets it."""

    kind = 3
    # mission float + int, command int, param float, attitude and local position setpoints, MAVLink 2
    capabilities = 1 | 2 | 4 | 8 | 64 | 128 | 8192
    version = 0x04070000
    shapes = True
    rate_limit_hz = 200.0
    rate_denied = DENIED
    refusal = FAILED
    denied = "Arm"
    timesync_us = 5_000_000

    def __init__(self, *args: Any) -> None:
        self.mode = STABILIZE
        self._timed_out = False
        super().__init__(*args)

    def apply_params(self) -> None:
        p, c = self.params, self.vehicle.constants
        c["position_p"] = p["PSC_POSXY_P"], p["PSC_POSXY_P"], p["PSC_POSZ_P"]
        c["velocity_p"] = p["PSC_VELXY_P"], p["PSC_VELXY_P"], p["PSC_VELZ_P"]
        c["velocity_i"] = p["PSC_VELXY_I"], p["PSC_VELXY_I"], p["PSC_VELZ_I"]
        c["speed_max"] = [0.01 * p[f"WPNAV_SPEED{axis}"] for axis in ("", "_UP", "_DN")]
        c["tilt_max_rad"] = math.radians(0.01 * p["ANGLE_MAX"])
        c["hover_thrust"] = p["MOT_THST_HOVER"]
        c["attitude_p"] = [p[f"ATC_ANG_{axis}_P"] for axis in ("RLL", "PIT", "YAW")]
        c["shaping_accel"] = [math.radians(0.01 * p[f"ATC_ACCEL_{axis}_MAX"]) for axis in "RPY"]
        c["input_tc_s"] = max(0.01, p["ATC_INPUT_TC"])
        c["aim_accel"] = 0.01 * p["WPNAV_ACCEL"], 0.01 * p["WPNAV_ACCEL_Z"]
        c["aim_jerk"] = p["PSC_JERK_XY"]
        c["rate_limit"] = math.radians(360.0)

    def heartbeat(self) -> tuple[int, ...]:
        base = 1 | 16 | 64 | (128 if self.armed else 0) | (8 if self.mode in (GUIDED, GUIDED_NOGPS, RTL, LAND) else 0)
        return 2, self.kind, base, self.mode, 4 if self.armed and not self.landed else 3, 3

    def can_arm(self) -> str:
        return "" if self.has_origin else "Need Position Estimate"

    @property
    def has_origin(self) -> bool:
        return self.vehicle.t_us - self.boot_us >= _ORIGIN_US

    @property
    def engaged(self) -> bool:
        return self.armed and self.task == "external"

    def attitude_echo(self) -> tuple[Any, ...]:
        state = self.vehicle.state.view
        q = rotation.to_quaternion(tuple(state["shaped_R"].tolist()))
        return 0, q, *state["shaped_rates_rad_s"].tolist(), state["thrust"].item()

    def data_stream(self, stream: int) -> tuple[str, ...]:
        if stream == 0:
            return tuple(name for group in _GROUPS.values() for name in group)
        return _GROUPS.get(stream, ())

    # ---- modes --------------------------------------------------------------------------------------------------------
    def split_mode(self, custom_mode: int) -> tuple[int, int]:
        return custom_mode, 0

    def climb_speed(self) -> float:
        return 0.01 * self.params["WPNAV_SPEED_UP"]

    def sink_speed(self, height_m: float) -> float:
        return 0.01 * self.params["LAND_SPEED" if 100.0 * height_m < self.params["LAND_ALT_LOW"] else "WPNAV_SPEED_DN"]

    def disarm_after_s(self) -> float:
        return 0.0 if self.task in ("land", "return") else self.params["DISARM_DELAY"]

    def set_mode(self, custom: int, sub: int) -> int:
        if custom not in _NAMES:
            self.say(WARNING, f"No such mode {custom}")
            return FAILED
        if custom not in (STABILIZE, GUIDED_NOGPS) and not self.has_origin:
            self.say(WARNING, f"Mode change to {_NAMES[custom]} failed: requires position")
            return FAILED
        if custom == STABILIZE and not self.landed:
            self.say(WARNING, "Mode change to STABILIZE failed: throttle too low")
            return FAILED
        again, self.mode = custom == self.mode, custom
        if custom == LAND:
            self.start_land()
        elif custom == RTL:
            self.start_return()
        elif custom in _HOLDS or not again:
            self.start_hold()
        return ACCEPTED

    def takeoff(self, altitude: float) -> int:
        if self.mode != GUIDED or not self.armed or not self.landed or not altitude > 0.0:
            return FAILED
        home_d = self.home.p_ned_m[2] if self.home else 0.0
        self.start_takeoff(home_d - altitude)
        return ACCEPTED

    def land(self) -> int:
        return self.set_mode(LAND, 0)

    def go_home(self) -> int:
        return self.set_mode(RTL, 0)

    def landed_or_arrived(self, task: str) -> None:
        """Modes stay as they are."""

    def mode_tick(self) -> None:
        if self.home is None and self.has_origin:
            self.set_home()
            self.say(INFO, "EKF3 IMU0 origin set")
        station = int(self.params["SYSID_MYGCS"])
        gone = self.t_us - self.heard_us.get(station, self.t_us) > _STATION_GONE_US
        if gone and self.params["FS_GCS_ENABLE"] and self.armed and not self.landed and self.mode not in (RTL, LAND):
            self.heard_us.pop(station)
            self.say(CRITICAL, "GCS Failsafe")
            self.set_mode(RTL, 0)
        timeout_us = 1e6 * self.params["GUID_TIMEOUT"]
        if self.engaged and not self._timed_out and self.vehicle.t_us - self.setpoint_us > timeout_us:
            self._timed_out = True
            self._level()

    # ---- setpoints ----------------------------------------------------------------------------------------------------
    def attitude_target(self, m: Any) -> None:
        if self.mode not in (GUIDED, GUIDED_NOGPS) or not self.armed:
            return
        body = (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate)
        attitude, rates_ignored = not m.type_mask & 128, m.type_mask & 7
        R = autopilot.quaternion_matrix(m.q) if attitude else None
        bad_rates = rates_ignored not in (0, 7) or (rates_ignored == 0 and not autopilot.finite(body))
        bad_attitude = (R is None) if attitude else rates_ignored == 7
        if m.type_mask & 64 or bad_rates or bad_attitude or not math.isfinite(m.thrust):
            self._restart()
            return
        sp, state = self.vehicle.setpoint, self.vehicle.state
        was = sp["kind"] if self.task == "external" else -1
        rates = (0.0, 0.0, 0.0) if rates_ignored else body
        if int(self.params["GUID_OPTIONS"]) & _THRUST_IS_THRUST:
            sp["thrust"], kind = min(1.0, max(0.0, m.thrust)), ATTITUDE if attitude else RATES
        else:
            kind = CLIMB
            share = 2.0 * min(1.0, max(0.0, m.thrust)) - 1.0
            climb = 0.01 * share * self.params["WPNAV_SPEED_UP" if share > 0.0 else "WPNAV_SPEED_DN"]
            sp["p_ned_m"], sp["a_ned_m_s2"], sp["v_ned_m_s"] = math.nan, math.nan, (math.nan, math.nan, -climb)
        if kind == CLIMB and was != CLIMB:
            self._aim_here()
        if R is not None:
            sp["R"] = R
        elif kind == CLIMB:  # rates with a climb rate: the attitude goes on from where its target is
            sp["R"] = state["shaped_R"]
        sp["rates_rad_s"], sp["kind"] = rates, kind
        self._taken()

    def position_target(self, m: Any) -> None:
        if self.mode != GUIDED or not self.armed:
            return
        given = [not m.type_mask & bits for bits in (7, 56, 448)]
        whole = all(m.type_mask & bits in (0, bits) for bits in (7, 56, 448))
        values = ((m.x, m.y, m.z), (m.vx, m.vy, m.vz), (m.afx, m.afy, m.afz))
        usable = all(autopilot.finite(value) for value, there in zip(values, given, strict=True) if there)
        if m.coordinate_frame not in (1, 7) or not whole or not any(given) or not usable or m.type_mask & 512:
            self._restart()
            return
        sp = self.vehicle.setpoint
        if self.task != "external" or sp["kind"] != POSITION:
            self.vehicle.state["velocity_integral"] = 0.0
            self._aim_here()
            sp["yaw_rad"] = self.yaw()
        offset = self.position() if m.coordinate_frame == 7 else (0.0, 0.0, 0.0)
        for name, value, there in zip(("p_ned_m", "v_ned_m_s", "a_ned_m_s2"), values, given, strict=True):
            sp[name] = value if there else math.nan
        if given[0]:
            sp["p_ned_m"] = [a + b for a, b in zip(values[0], offset, strict=True)]
        if not m.type_mask & 1024 and math.isfinite(m.yaw):
            sp["yaw_rad"] = m.yaw
        turning = m.type_mask & 1024 and not m.type_mask & 2048 and math.isfinite(m.yaw_rate)
        self._yaw_rate = m.yaw_rate if turning else 0.0
        sp["kind"] = POSITION
        self._taken()

    def start_hold(self) -> None:
        super().start_hold()
        self._aim_here()

    def start_takeoff(self, target_d_m: float) -> None:
        super().start_takeoff(target_d_m)
        self._aim_here()

    def start_land(self) -> None:
        super().start_land()
        self._aim_here()

    def start_return(self) -> None:
        super().start_return()
        self._aim_here()

    def _taken(self) -> None:
        self.start_external()
        self.setpoint_us, self._timed_out = self.vehicle.t_us, False
        self.fresh += 1

    def _restart(self) -> None:
        """Guided mode begins anew: the vehicle brakes, levels and holds; nothing is said."""
        if self.task != "hold":
            self.start_hold()

    def _level(self) -> None:
        """Setpoints have stopped: level, no climb; with a position it stays, with an attitude it drifts."""
        sp = self.vehicle.setpoint
        if sp["kind"] == POSITION:
            if not math.isnan(sp["p_ned_m"][0]):
                sp["v_ned_m_s"] = sp["a_ned_m_s2"] = math.nan
            else:
                sp["v_ned_m_s"], sp["a_ned_m_s2"] = 0.0, math.nan
            return
        if sp["kind"] != CLIMB:
            self._aim_here()
        sp["R"], sp["rates_rad_s"] = rotation.from_euler(0.0, 0.0, self.yaw()), 0.0
        sp["p_ned_m"], sp["a_ned_m_s2"], sp["v_ned_m_s"] = math.nan, math.nan, (math.nan, math.nan, 0.0)
        sp["kind"] = CLIMB

    def _aim_here(self) -> None:
        """The shaped position starts from where the vehicle is and how it moves."""
        state = self.vehicle.state
        state["aim_p"], state["aim_v"], state["aim_a"] = state["nav_p_ned_m"], state["nav_v_ned_m_s"], 0.0
