"""What the autopilot says about itself: one function per message, giving the fields in MAVLink's declared order.

Sampling instants fall on whole milliseconds, because most stamps are in milliseconds.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mavquad import wire
from sitl import frames
from sitl.autopilot import geodetic
from sitl.config import ORIGIN
from sitl.helicopter import Helicopter
from sitl.plant import GRAVITY_M_S2

if TYPE_CHECKING:
    from sitl.simulation import Simulation

Fields = tuple[Any, ...]
NAN = math.nan
_ZEROS_12 = (0,) * 12
# gyro, accelerometer, magnetometer, pressure, GPS, rate, attitude, yaw, z, xy control, motors, AHRS, battery, pre-arm check
_GEOFENCE, _PRE_ARM = 1 << 20, 1 << 28
_SENSORS = 1 | 2 | 4 | 8 | 32 | 1024 | 2048 | 4096 | 8192 | 16384 | 32768 | 1 << 21 | 1 << 25 | _PRE_ARM
_HEALTH = {"gyro": 1, "accel": 2, "attitude": 1 << 21, "position": 32}
_FULL_MV, _EMPTY_MV = 16_800, 13_200

# the order in which messages of one instant leave: the attitude last, since a companion is paced by it
ORDER = (
    "HEARTBEAT",
    "HIGHRES_IMU",
    "RAW_IMU",
    "SCALED_IMU",
    "ATT_POS_MOCAP",
    "LOCAL_POSITION_NED",
    "SERVO_OUTPUT_RAW",
    "ACTUATOR_CONTROL_TARGET",
    "ATTITUDE_TARGET",
    "POSITION_TARGET_LOCAL_NED",
    "SYS_STATUS",
    "EXTENDED_SYS_STATE",
    "GLOBAL_POSITION_INT",
    "GPS_RAW_INT",
    "HOME_POSITION",
    "ESTIMATOR_STATUS",
    "EKF_STATUS_REPORT",
    "SYSTEM_TIME",
    "VFR_HUD",
    "BATTERY_STATUS",
    "SIM_STATE",
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
)
SENSOR_OF = {  # whose dropout silences a message
    "HIGHRES_IMU": ("gyro", "accel"),
    "RAW_IMU": ("gyro", "accel"),
    "SCALED_IMU": ("gyro", "accel"),
    "ATT_POS_MOCAP": ("mocap",),
    "LOCAL_POSITION_NED": ("position",),
    "GLOBAL_POSITION_INT": ("position",),
    "ATTITUDE": ("attitude",),
    "ATTITUDE_QUATERNION": ("attitude",),
}

GYRO = "gyro"  # whichever gyro the personality sends
_COVARIANCE = (NAN,) + (0.0,) * 20
# Messages that are fields of the vehicle's record (`state.VEHICLE`) and of `told.TOLD`, and constants: kernels make them (`frames`).
# What a faulty sensor would change has its name before it.
LAYOUTS: dict[str, frames.Layout] = {
    "HIGHRES_IMU": ("clock_us", "accel:accel_m_s2", "gyro:gyro", "magnetometer_gauss", "barometer", 25.0, 0x1FFF, 0),
    "ATT_POS_MOCAP": ("mocap_us", "mocap:mocap_q_wxyz", "mocap:mocap_p_ned_m", _COVARIANCE),
    "LOCAL_POSITION_NED": ("clock_ms", "position:nav_p_ned_m", "position:nav_v_ned_m_s"),
    "SERVO_OUTPUT_RAW": ("wrapped_us", 0, "pwm_us", _ZEROS_12),
    "ATTITUDE_TARGET": ("clock_ms", "type_mask", "echo_q_wxyz", "echo_rates_rad_s", "thrust"),
    "ATTITUDE": ("clock_ms", "attitude:ahrs_euler_rad", "attitude:rates_rad_s"),
    "ATTITUDE_QUATERNION": ("clock_ms", "attitude:ahrs_q_wxyz", "attitude:rates_rad_s", (0.0,) * 4),
}
TRUTH: dict[str, frames.Layout] = {
    "ODOMETRY": (
        *("t_us", 1, 12, "p_ned_m", "true_q_wxyz", "v_frd_m_s", "omega_rad_s"),
        *(_COVARIANCE, _COVARIANCE, 0, 0, 100),
    ),
    "DEBUG_FLOAT_ARRAY": (
        *("t_us", b"truth", 1, "force_m_s2", "torque_rad_s2", "wind_ned_m_s", "thrust_m_s2", "misses", "engaged"),
        (0.0,) * 46,
    ),
}


def without_sensors(layout: frames.Layout) -> frames.Layout:
    """A layout with nothing before the names of fields."""
    return [entry.rpartition(":")[2] if isinstance(entry, str) else entry for entry in layout]


def laid_out(sim: "Simulation", name: str) -> Callable[[], Fields]:
    """The fields of a message of `LAYOUTS` read one by one, as faults of the sensors let them."""
    v, msgid, read = sim.vehicle, wire.ID[name], sim.faults.read
    clocks: dict[str, Callable[[], int]] = {
        "clock_us": lambda: v.t_us - sim.autopilot.boot_us,
        "wrapped_us": lambda: (v.t_us - sim.autopilot.boot_us) & 0xFFFFFFFF,
        "clock_ms": lambda: (v.t_us - sim.autopilot.boot_us) // 1000,
        "mocap_us": lambda: max(0, v.t_us - sim.autopilot.boot_us - sim.mocap_age_us),
    }
    parts: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
    for entry in LAYOUTS[name]:
        if not isinstance(entry, str):
            parts.append((tuple, (entry if isinstance(entry, tuple) else (entry,),)))
        elif entry in clocks:
            parts.append((lambda clock: (clock(),), (clocks[entry],)))
        else:
            sensor, _, view = entry.rpartition(":")
            parts.append((read, (sensor, sim.gyro_name if view == GYRO else view)))
    return lambda: frames.fields(msgid, [item for part, given in parts for item in part(*given)])


def builders(sim: "Simulation") -> dict[str, Callable[[], Fields | None]]:
    """Every message that this autopilot can stream: name -> a function that gives its fields, or None for nothing to say."""
    v, read = sim.vehicle, sim.faults.read

    def boot_us() -> int:
        return v.t_us - sim.autopilot.boot_us

    def boot_ms() -> int:
        return boot_us() // 1000

    def coarse_imu() -> tuple[int, ...]:
        a = [_int16(1000.0 / GRAVITY_M_S2 * x) for x in read("accel", "accel_m_s2")]
        g = [_int16(1000.0 * x) for x in read("gyro", sim.gyro_name)]
        m = [_int16(1000.0 * x) for x in v.state.view["magnetometer_gauss"].tolist()]
        return (*a, *g, *m)

    def actuator_control_target() -> Fields | None:
        if not isinstance(v, Helicopter):
            return None
        return boot_us(), 0, (*v.sticks(), 0.0, 0.0, 0.0, 0.0)

    position = laid_out(sim, "LOCAL_POSITION_NED")

    def local_position_ned() -> Fields | None:
        return position() if sim.autopilot.has_origin else None

    def global_position_int() -> Fields | None:
        if not sim.autopilot.has_origin:
            return None
        p, u = read("position", "nav_p_ned_m"), read("position", "nav_v_ned_m_s")
        if not all(map(math.isfinite, (*p, *u))):
            return None  # integers have no NaN
        lat, lon, alt = geodetic(p)
        heading = round(100.0 * math.degrees(sim.autopilot.yaw())) % 36000
        centi = [_int16(100.0 * x) for x in u]
        return boot_ms(), lat, lon, round(1000.0 * alt), round(-1000.0 * p[2]), *centi, heading

    def gps_raw_int() -> Fields:
        p, u = v.state.view["nav_p_ned_m"].tolist(), v.state.view["nav_v_ned_m_s"].tolist()
        lat, lon, alt = geodetic(p)
        course = round(100.0 * math.degrees(math.atan2(u[1], u[0]))) % 36000
        speed = min(65534, round(100.0 * math.hypot(u[0], u[1])))
        height = round(1000.0 * alt)
        return boot_us(), 3, lat, lon, height, 80, 120, speed, course, 14, height, 300, 400, 50, 0, 0

    def sys_status() -> Fields:
        sick = sum({_HEALTH[s] for s in sim.faults.sick if s in _HEALTH})
        health = _SENSORS & ~sick | _GEOFENCE  # there is no fence, so none is broken
        if not sim.autopilot.armed and sim.autopilot.can_arm():
            health &= ~_PRE_ARM
        left = sim.battery()
        volts = round(_EMPTY_MV + (_FULL_MV - _EMPTY_MV) * left)
        return _SENSORS, _SENSORS, health, 250, volts, 1500, round(100 * left), 0, 0, 0, 0, 0, 0, 0, 0, 0

    def battery_status() -> Fields:
        left = sim.battery()
        cell = round((_EMPTY_MV + (_FULL_MV - _EMPTY_MV) * left) / 4)
        cells = (cell,) * 4 + (65535,) * 6
        return 0, 1, 1, 2500, cells, 1500, -1, -1, round(100 * left), 0, 1, (0,) * 4, 0, 0

    def home_position() -> Fields | None:
        home = sim.autopilot.home
        if home is None:
            return None
        lat, lon, alt = geodetic(home.p_ned_m)
        return lat, lon, round(1000.0 * alt), *home.p_ned_m, home.q_wxyz, NAN, NAN, NAN, boot_us()

    def attitude_target() -> Fields:
        return boot_ms(), *sim.autopilot.attitude_echo()

    def position_target() -> Fields:
        sp = v.setpoint.view
        values = [*sp["p_ned_m"].tolist(), *sp["v_ned_m_s"].tolist(), *sp["a_ned_m_s2"].tolist()]
        mask = sum(1 << i for i, x in enumerate(values) if math.isnan(x)) | 2048
        return boot_ms(), 1, mask, *values, v.setpoint["yaw_rad"], 0.0

    def sim_state() -> Fields:
        q = v.state.view["mocap_q_wxyz"].tolist()
        lat, lon, alt = geodetic(v.state.view["p_ned_m"].tolist())
        degrees = (1e-7 * lat, 1e-7 * lon, alt)
        euler, accel, gyro = (v.state.view[name].tolist() for name in ("ahrs_euler_rad", "accel_m_s2", "gyro_rad_s"))
        return *q, *euler, *accel, *gyro, *degrees, 0.0, 0.0, *v.state.view["v_ned_m_s"].tolist(), lat, lon

    def vfr_hud() -> Fields:
        p, u = v.state.view["nav_p_ned_m"].tolist(), v.state.view["nav_v_ned_m_s"].tolist()
        speed = math.hypot(u[0], u[1])
        heading = round(math.degrees(sim.autopilot.yaw())) % 360
        return speed, speed, heading, round(100.0 * v.state["thrust"]), ORIGIN[2] - p[2], -u[2]

    return {
        **{name: laid_out(sim, name) for name in LAYOUTS},
        "HEARTBEAT": lambda: sim.autopilot.heartbeat(),
        "RAW_IMU": lambda: (boot_us(), *coarse_imu(), 0, 2500),
        "SCALED_IMU": lambda: (boot_ms(), *coarse_imu(), 2500),
        "LOCAL_POSITION_NED": local_position_ned,
        "ACTUATOR_CONTROL_TARGET": actuator_control_target,
        "ATTITUDE_TARGET": attitude_target,
        "POSITION_TARGET_LOCAL_NED": position_target,
        "SYS_STATUS": sys_status,
        "EXTENDED_SYS_STATE": lambda: (0, sim.autopilot.landed_state),
        "GLOBAL_POSITION_INT": global_position_int,
        "GPS_RAW_INT": gps_raw_int,
        "HOME_POSITION": home_position,
        "ESTIMATOR_STATUS": lambda: (boot_us(), 0x33F, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0, 0.2, 0.3),
        "EKF_STATUS_REPORT": lambda: (0x33F if sim.autopilot.has_origin else 0x407, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0),
        "SYSTEM_TIME": lambda: (sim.epoch_us + v.t_us, boot_ms()),
        "VFR_HUD": vfr_hud,
        "BATTERY_STATUS": battery_status,
        "SIM_STATE": sim_state,
    }


def autopilot_version(kind: int, capabilities: int, version: int) -> Fields:
    """AUTOPILOT_VERSION."""
    empty = (0,) * 8
    return capabilities, version, 0, 0, 0, empty, empty, empty, 0, 0, 0x6D61767175616400 + kind, (0,) * 18


def _int16(x: float) -> int:
    return max(-32768, min(32767, round(x))) if math.isfinite(x) else 0
