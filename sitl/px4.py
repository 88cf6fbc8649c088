"""Personality `px4`: custom modes, OFFBOARD by setpoints that keep coming, parameters under PX4's names with PX4's defaults.

Source: PX4's user guide and its parameter reference. Not PX4's: COM_OBL_ACT defaults to hold, and the inner loops are our own.
"""

import math
from typing import Any

from mavquad.airframe import Airframe
from sitl import autopilot
from sitl.autopilot import ACCEPTED, CRITICAL, DENIED, NOTICE, TEMPORARILY_REJECTED, WARNING, Autopilot
from sitl.config import ORIGIN
from sitl.helicopter import Helicopter
from sitl.state import ATTITUDE, POSITION, RATES, STICKS

MANUAL, ALTCTL, POSCTL, AUTO, ACRO, OFFBOARD, STABILIZED = 1, 2, 3, 4, 5, 6, 7
TAKEOFF, LOITER, MISSION, RTL, LAND = 2, 3, 4, 5, 6  # sub-modes of AUTO
_TASKS = {"hold": LOITER, "takeoff": TAKEOFF, "land": LAND, "return": RTL}
_OFFBOARD_GAP_US, _OFFBOARD_PROOF_US = 500_000, 1_000_000  # setpoints above 2 Hz for a second
_BOOT_US = 1_000_000  # until the estimator has settled

STREAMS_HZ = {
    "HEARTBEAT": 1.0,
    "HIGHRES_IMU": 250.0,
    "LOCAL_POSITION_NED": 50.0,
    "SERVO_OUTPUT_RAW": 250.0,
    "ACTUATOR_CONTROL_TARGET": 50.0,
    "ATTITUDE_TARGET": 50.0,
    "SYS_STATUS": 1.0,
    "EXTENDED_SYS_STATE": 2.0,
    "GLOBAL_POSITION_INT": 5.0,
    "GPS_RAW_INT": 2.0,
    "HOME_POSITION": 0.5,
    "ESTIMATOR_STATUS": 1.0,
    "SYSTEM_TIME": 1.0,
    "VFR_HUD": 4.0,
    "BATTERY_STATUS": 0.5,
    "SIM_STATE": 1.0,
    "ATTITUDE": 100.0,
    "ATTITUDE_QUATERNION": 250.0,
}


def defaults(tuned: Airframe) -> dict[str, int | float]:
    """PX4's parameters as far as this autopilot has them; a helicopter's rotor is slower than four motors, and so are its loops."""
    return {**_ALL, "MPC_THR_HOVER": tuned.hover_thrust, **(_HELICOPTER if tuned.kind == "helicopter" else {})}


_HELICOPTER = {
    "MAV_TYPE": 4,
    "MPC_TILTMAX_AIR": 22.0,
    "MPC_XY_P": 0.5,
    "MPC_XY_VEL_I_ACC": 0.2,
    "MPC_XY_VEL_P_ACC": 0.9,
    "MPC_Z_P": 0.8,
    "MPC_Z_VEL_I_ACC": 0.5,
    "MPC_Z_VEL_P_ACC": 2.0,
}
_ALL: dict[str, int | float] = {
    "COM_ARM_WO_GPS": 1,
    "COM_DISARM_LAND": 2.0,
    "COM_OBL_ACT": 1,  # what follows lost setpoints: 0 land, 1 hold, 2 return
    "COM_OF_LOSS_T": 1.0,
    "MAV_COMP_ID": 1,
    "MAV_SYS_ID": 1,
    "MAV_TYPE": 2,
    "MC_PITCHRATE_MAX": 220.0,
    "MC_PITCH_P": 9.0,
    "MC_ROLLRATE_MAX": 220.0,
    "MC_ROLL_P": 9.0,
    "MC_YAWRATE_MAX": 200.0,
    "MC_YAW_P": 2.8,
    "MIS_TAKEOFF_ALT": 2.5,
    "MPC_LAND_ALT1": 10.0,
    "MPC_LAND_SPEED": 0.7,
    "MPC_THR_HOVER": 0.5,
    "MPC_TILTMAX_AIR": 45.0,
    "MPC_TKO_SPEED": 1.5,
    "MPC_XY_P": 0.95,
    "MPC_XY_VEL_I_ACC": 0.4,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_XY_VEL_P_ACC": 1.8,
    "MPC_Z_P": 1.0,
    "MPC_Z_VEL_I_ACC": 2.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_P_ACC": 4.0,
    "SYS_AUTOSTART": 4001,
}


class Px4(Autopilot):
    """PX4 as a companion meets it."""

    kind = 12
    # mission float + int, command int, param float, bytewise, attitude and local position setpoints, MAVLink 2
    capabilities = 1 | 2 | 4 | 8 | 16 | 64 | 128 | 8192
    version = 0x010E03FF  # 1.14.3

    def __init__(self, *args: Any) -> None:
        self.mode = (AUTO, LOITER)
        self._since_us = -1  # setpoints have come without a gap since
        self._wanted: dict[str, Any] | None = None
        super().__init__(*args)

    def apply_params(self) -> None:
        p, c = self.params, self.vehicle.constants
        c["position_p"] = p["MPC_XY_P"], p["MPC_XY_P"], p["MPC_Z_P"]
        c["velocity_p"] = p["MPC_XY_VEL_P_ACC"], p["MPC_XY_VEL_P_ACC"], p["MPC_Z_VEL_P_ACC"]
        c["velocity_i"] = p["MPC_XY_VEL_I_ACC"], p["MPC_XY_VEL_I_ACC"], p["MPC_Z_VEL_I_ACC"]
        c["speed_max"] = p["MPC_XY_VEL_MAX"], p["MPC_Z_VEL_MAX_UP"], p["MPC_Z_VEL_MAX_DN"]
        c["tilt_max_rad"] = math.radians(p["MPC_TILTMAX_AIR"])
        c["hover_thrust"] = p["MPC_THR_HOVER"]
        c["attitude_p"] = p["MC_ROLL_P"], p["MC_PITCH_P"], p["MC_YAW_P"]
        c["rate_limit"] = [math.radians(p[f"MC_{axis}RATE_MAX"]) for axis in ("ROLL", "PITCH", "YAW")]

    def heartbeat(self) -> tuple[int, ...]:
        main, sub = self.mode
        base = 1 | (128 if self.armed else 0) | (16 | 8 | 4 if main in (AUTO, OFFBOARD) else 64)
        return self.vehicle.mav_type, self.kind, base, main << 16 | sub << 24, 4 if self.armed else 3, 3

    def can_arm(self) -> str:
        if self.t_us - self.boot_us < _BOOT_US:
            return "estimator not ready"
        return ""

    @property
    def engaged(self) -> bool:
        return self.armed and self.mode[0] == OFFBOARD

    # ---- modes --------------------------------------------------------------------------------------------------------
    def set_mode(self, custom: int, sub: int) -> int:
        if custom == OFFBOARD:
            return self._enter_offboard()
        if custom == AUTO and sub == LOITER:
            self.start_hold()
        elif custom == AUTO and sub == TAKEOFF:
            return self.takeoff(math.nan)
        elif custom == AUTO and sub == LAND:
            return self.land()
        elif custom == AUTO and sub == RTL:
            return self.go_home()
        else:
            named = {MANUAL: "manual", ALTCTL: "altitude", POSCTL: "position", ACRO: "acro", STABILIZED: "stabilized"}
            self.say(
                CRITICAL, f"Switching to {named.get(custom, f'mode {custom}/{sub}')} refused: no manual control, no mission"
            )
            return TEMPORARILY_REJECTED if custom in named or custom == AUTO else DENIED
        self.mode = (AUTO, sub)
        return ACCEPTED

    def split_mode(self, custom_mode: int) -> tuple[int, int]:
        return custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF

    def climb_speed(self) -> float:
        return self.params["MPC_TKO_SPEED"]

    def sink_speed(self, height_m: float) -> float:
        return self.params["MPC_LAND_SPEED" if height_m < self.params["MPC_LAND_ALT1"] else "MPC_Z_VEL_MAX_DN"]

    def disarm_after_s(self) -> float:
        return self.params["COM_DISARM_LAND"]

    def takeoff(self, altitude: float) -> int:
        if not self.landed:
            self.say(CRITICAL, "Take-off denied: already in the air")
            return TEMPORARILY_REJECTED
        ground_d = self.position()[2]
        target_d = ground_d - self.params["MIS_TAKEOFF_ALT"] if math.isnan(altitude) else ORIGIN[2] - altitude
        if target_d > ground_d - 0.5:
            self.say(
                WARNING,
                f"Take-off altitude {altitude:.1f} m AMSL is too low; climbing to {self.params['MIS_TAKEOFF_ALT']:.1f} m",
            )
            target_d = ground_d - self.params["MIS_TAKEOFF_ALT"]
        self.mode = (AUTO, TAKEOFF)
        self.start_takeoff(target_d)
        return ACCEPTED

    def land(self) -> int:
        self.mode = (AUTO, LAND)
        self.start_land()
        return ACCEPTED

    def go_home(self) -> int:
        self.mode = (AUTO, RTL)
        self.start_return()
        return ACCEPTED

    def landed_or_arrived(self, task: str) -> None:
        self.mode = (AUTO, LOITER)

    def arm(self, force: bool) -> int:
        was = self.armed
        result = super().arm(force)
        if result == ACCEPTED and not was:
            if self.mode == (AUTO, TAKEOFF):
                self.start_takeoff(self._target_d)
            elif self.mode[0] == AUTO:
                self.mode = (AUTO, LOITER)
                self.start_hold()
            else:
                self._enter_offboard()
        return result

    def mode_tick(self) -> None:
        if self.home is None and self.t_us - self.boot_us >= _BOOT_US:
            self.set_home()
        lost_after_us = max(1e6 * self.params["COM_OF_LOSS_T"], 2.0 * autopilot.TICK_US)
        if self.mode[0] != OFFBOARD or self.t_us - self.setpoint_us <= lost_after_us:
            return
        action = {0: self.land, 2: self.go_home}.get(int(self.params["COM_OBL_ACT"]))
        said = {0: "landing", 2: "returning"}.get(int(self.params["COM_OBL_ACT"]), "holding")
        if self.armed:
            self.say(CRITICAL, f"Offboard setpoints lost for {self.params['COM_OF_LOSS_T']:.1f} s: {said}")
        if action and self.armed and not self.landed:
            action()
        else:
            self.set_mode(AUTO, LOITER)

    def _enter_offboard(self) -> int:
        fresh = self.t_us - self.setpoint_us <= _OFFBOARD_GAP_US
        if not fresh or self._wanted is None or self.t_us - self._since_us < _OFFBOARD_PROOF_US:
            self.say(CRITICAL, "Offboard refused: setpoints must come at more than 2 Hz for 1 s first")
            if self.mode[0] == OFFBOARD:
                self.set_mode(AUTO, LOITER)
            return TEMPORARILY_REJECTED
        self.mode = (OFFBOARD, 0)
        self.start_external()
        self._apply()
        return ACCEPTED

    # ---- setpoints ----------------------------------------------------------------------------------------------------
    def attitude_target(self, m: Any) -> None:
        attitude, rates = not m.type_mask & 128, not m.type_mask & 7
        if m.type_mask & 64 or not (attitude or rates) or not autopilot.finite((m.thrust,)):
            return
        wanted: dict[str, Any] = {"thrust": min(1.0, max(0.0, m.thrust)), "kind": ATTITUDE if attitude else RATES, "q": None}
        body = (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate)
        if attitude:
            R = autopilot.quaternion_matrix(m.q)
            if R is None:
                return
            yaw_rate = 0.0 if m.type_mask & 4 or not math.isfinite(m.body_yaw_rate) else m.body_yaw_rate
            # beside an attitude PX4 uses the yaw rate alone
            wanted.update(R=R, q=m.q, rates_rad_s=(0.0, 0.0, yaw_rate))
        elif autopilot.finite(body):
            wanted["rates_rad_s"] = body
        else:
            return
        self._accept(wanted)

    def position_target(self, m: Any) -> None:
        if m.coordinate_frame != 1 or m.type_mask & 512:
            self.say(NOTICE, f"Setpoint refused: frame {m.coordinate_frame}, expected 1 (local NED), no force")
            return
        keep = [
            math.nan if m.type_mask & 1 << i else float(x)
            for i, x in enumerate((m.x, m.y, m.z, m.vx, m.vy, m.vz, m.afx, m.afy, m.afz))
        ]
        if all(math.isnan(x) for x in keep) or any(math.isinf(x) for x in keep):
            return
        yaw = math.nan if m.type_mask & 1024 else m.yaw
        yaw_rate = 0.0 if m.type_mask & 2048 or not math.isfinite(m.yaw_rate) else m.yaw_rate
        self._accept(
            {
                "kind": POSITION,
                "p_ned_m": keep[:3],
                "v_ned_m_s": keep[3:6],
                "a_ned_m_s2": keep[6:],
                "yaw": yaw,
                "yaw_rate": yaw_rate,
            }
        )

    def actuator_target(self, m: Any) -> None:
        """A helicopter's sticks (roll, pitch, yaw, throttle): group 0 in place of the inner loop, group 3 (passthrough) on top of it."""
        sticks = tuple(float(x) for x in m.controls[:4])
        if not isinstance(self.vehicle, Helicopter) or not autopilot.finite(sticks) or max(map(abs, sticks)) > 1.0:
            return
        if m.group_mlx == 0:
            self._accept({"kind": STICKS, "sticks": sticks, "q": None})
        elif m.group_mlx == 3 and self.engaged:
            self.vehicle.add_sticks(*sticks)

    def _accept(self, wanted: dict[str, Any]) -> None:
        now = self.vehicle.t_us
        if self.setpoint_us < 0 or now - self.setpoint_us > _OFFBOARD_GAP_US:
            self._since_us = now
        self.setpoint_us, self._wanted = now, wanted
        self.fresh += 1
        if self.mode[0] == OFFBOARD:
            self._apply()

    def _apply(self) -> None:
        """The last setpoint into the record that the loops read."""
        sp, wanted = self.vehicle.setpoint, self._wanted
        if wanted is None or not self.armed:
            return
        if wanted["kind"] == POSITION:
            if sp["kind"] != POSITION:
                self.vehicle.state["velocity_integral"] = 0.0
                sp["yaw_rad"] = self.yaw()
            if not math.isnan(wanted["yaw"]):
                sp["yaw_rad"] = wanted["yaw"]
            self._yaw_rate = wanted["yaw_rate"] if math.isnan(wanted["yaw"]) else 0.0
            for name in ("p_ned_m", "v_ned_m_s", "a_ned_m_s2"):
                sp[name] = wanted[name]
            self.echo_q = None
        elif wanted["kind"] == STICKS:
            assert isinstance(self.vehicle, Helicopter)
            self.vehicle.give_sticks(*wanted["sticks"])
            self.echo_q = None
        else:
            sp["thrust"], sp["rates_rad_s"] = wanted["thrust"], wanted["rates_rad_s"]
            if wanted["kind"] == ATTITUDE:
                sp["R"] = wanted["R"]
            self.echo_q = wanted["q"]
        sp["kind"] = wanted["kind"]
