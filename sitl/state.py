"""What the compiled half of the simulator works on: one record each for the vehicle, the setpoint and the constants.

Records are numpy structured arrays of length 1: kernels change them in place (one call costs under 1 us where nested tuples cost
10), Python reads them through views by name. NaN in a setpoint means "not given".
"""

from typing import Any

import numpy as np

from mavquad.jit import COMPILED

OFF, IDLE, RATES, ATTITUDE, POSITION = 0, 1, 2, 3, 4  # what the inner loops are asked to do (SETPOINT.kind)
CLIMB = 5  # ATTITUDE, with a climb rate (in v_ned_m_s) in place of thrust
STICKS = 6  # a helicopter's sticks from outside
PX4, ARDUPILOT = 0, 1  # CONSTANTS.personality

VEHICLE = np.dtype(
    [
        ("step", "i8"),  # steps of the loop since time 0
        # truth
        ("p_ned_m", "f8", 3),
        ("v_ned_m_s", "f8", 3),
        ("R", "f8", 9),
        ("omega_rad_s", "f8", 3),
        ("thrust_n", "f8", 4),  # of each rotor, as it would be in still air and in good health
        ("accel_ned_m_s2", "f8", 3),  # mean over the last step
        ("grounded", "i8"),
        ("impact_m_s", "f8"),  # sink rate at the last touch-down
        ("disturbance_m_s2", "f8", 3),  # sums over `summed` steps, see plant.py
        ("disturbance_rad_s2", "f8", 3),
        ("summed", "i8"),
        # air
        ("turbulence", "f8", 7),
        ("gust", "f8", 5),  # u, v, w, p_g, q_g
        ("wind_ned_m_s", "f8", 3),
        # sensors
        ("gyro_rad_s", "f8", 3),
        ("accel_m_s2", "f8", 3),
        ("rates_rad_s", "f8", 3),  # filtered, bias removed: what loops and ATTITUDE use
        ("rates_slope", "f8", 3),
        ("gyro_bias_rad_s", "f8", 3),  # the AHRS's own estimate
        ("drift_rad", "f8", 3),
        ("ahrs_R", "f8", 9),
        ("ahrs_q_wxyz", "f8", 4),
        ("ahrs_euler_rad", "f8", 3),
        ("nav_noise", "f8", 6),
        ("nav_p_ned_m", "f8", 3),
        ("nav_v_ned_m_s", "f8", 3),
        ("magnetometer_gauss", "f8", 3),
        ("barometer", "f8", 3),  # hPa, differential pressure (none), altitude in m
        ("past", "f8", (256, 6)),  # true position and velocity, for the delay of the position
        ("mocap_q_wxyz", "f8", 4),
        ("mocap_p_ned_m", "f8", 3),
        ("past_R", "f8", (256, 9)),
        # loops
        ("velocity_integral", "f8", 3),
        ("rate_integral", "f8", 3),
        ("aim_p", "f8", 3),  # what the position loop is after
        ("aim_v", "f8", 3),
        ("aim_a", "f8", 3),
        ("wanted_R", "f8", 9),  # the attitude asked for
        ("target_R", "f8", 9),  # the one that the loop is after
        ("target_rates_rad_s", "f8", 3),
        ("target_accel_rad_s2", "f8", 3),
        ("shaped_R", "f8", 9),  # ArduPilot's target after input shaping
        ("shaped_rates_rad_s", "f8", 3),
        ("thrust", "f8"),  # collective 0..1 as it was asked for
        ("lift", "f8"),  # collective 0..1 as it is given to the rotors
        ("outputs", "f8", 4),  # of each rotor, 0..1 of its full thrust
        ("pwm_us", "i8", 4),
    ]
)

SETPOINT = np.dtype(
    [
        ("kind", "i8"),
        ("R", "f8", 9),
        ("rates_rad_s", "f8", 3),
        ("thrust", "f8"),  # 0..1
        ("p_ned_m", "f8", 3),
        ("v_ned_m_s", "f8", 3),
        ("a_ned_m_s2", "f8", 3),
        ("yaw_rad", "f8"),
    ]
)

CONSTANTS = np.dtype(
    [
        ("dt_s", "f8"),
        ("ground_d_m", "f8"),
        # the true vehicle
        ("mass_kg", "f8"),
        ("inertia_kg_m2", "f8", 3),
        ("x_m", "f8", 4),
        ("y_m", "f8", 4),
        ("spin", "f8", 4),
        ("torque_per_thrust_m", "f8"),
        ("thrust_max_n", "f8"),
        ("lag_s", "f8"),
        ("drag_linear", "f8", 3),
        ("drag_quadratic", "f8", 3),
        ("effectiveness", "f8", 4),
        ("push_n", "f8", 3),
        ("push_nm", "f8", 3),
        # air
        ("mean_wind_m_s", "f8", 2),
        ("profile", "i8"),
        ("wind_to", "f8", 2),  # cosine and sine of where the mean wind goes
        ("turbulent", "i8"),
        ("F", "f8", (7, 7)),
        ("B", "f8", (7, 7)),
        ("C", "f8", (5, 7)),
        ("air_every", "i8"),
        ("rotor_model", "i8"),
        ("air_density", "f8"),
        ("rotor_disk_m2", "f8"),
        # sensors
        ("gyro_sigma", "f8"),
        ("accel_sigma", "f8"),
        ("gyro_bias", "f8", 3),
        ("accel_bias", "f8", 3),
        ("velocity_bias", "f8", 3),
        ("position_bias", "f8", 3),
        ("drift_keep", "f8"),
        ("drift_draw", "f8"),
        ("position_sigma", "f8"),
        ("velocity_sigma", "f8"),
        ("altitude_m", "f8"),  # of the local frame's origin
        ("nav_every", "i8"),
        ("nav_delay", "i8"),  # steps
        ("mocap_sigma", "f8"),
        ("mocap_every", "i8"),
        ("mocap_delay", "i8"),
        ("filter_b", "f8"),  # gyro low-pass: wn^2 dt
        ("filter_a", "f8"),  # 2 zeta wn dt
        # the autopilot: tuned for the airframe's file
        ("personality", "i8"),
        ("tuned_inertia", "f8", 3),
        ("tuned_thrust_max_n", "f8"),
        ("idle", "f8"),
        ("allocation", "f8", (4, 4)),
        ("hover_thrust", "f8"),
        ("rate_p", "f8", 3),
        ("rate_i", "f8", 3),
        ("rate_d", "f8", 3),
        ("attitude_p", "f8", 3),
        ("rate_limit", "f8", 3),
        ("position_every", "i8"),
        ("position_p", "f8", 3),
        ("velocity_p", "f8", 3),
        ("velocity_i", "f8", 3),
        ("speed_max", "f8", 3),  # horizontal, up, down
        ("accel_max", "f8"),
        ("tilt_max_rad", "f8"),
        ("input_tc_s", "f8"),
        ("shaping_accel", "f8", 3),
        ("aim_accel", "f8", 2),  # horizontal, vertical
        ("aim_jerk", "f8"),
    ]
)


class Record:
    """One structured array of length 1: `.array` for kernels, every field by name as a view (or through get/put for scalars)."""

    def __init__(self, dtype: np.dtype, **values: Any) -> None:
        array = np.zeros(1, dtype)
        # attribute access inside a kernel that runs uncompiled needs a recarray; numba takes four times longer to recognise one
        self.array = array if COMPILED else array.view(np.recarray)
        self.view: dict[str, np.ndarray] = {}
        for name in dtype.names or ():
            field = array[name]
            self.view[name] = field[0] if field.ndim > 1 else field
        for name, value in values.items():
            self[name] = value

    def __getitem__(self, name: str) -> Any:
        """A scalar as Python's own number, an array as its view."""
        view = self.view[name]
        return view.item() if view.shape == (1,) else view

    def __setitem__(self, name: str, value: Any) -> None:
        self.view[name][...] = value
