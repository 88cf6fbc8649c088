"""What a flight in bulk carries besides the vehicle's own records: the companion's side, and what is on the wire both ways."""

import numpy as np

from sitl.sensors import COLUMNS

ON_WIRE = 512  # samples or setpoints under way at most: a second of delay and more
PID, AUTOPILOT = 0, 1  # FLIGHT.controller: the integer branch of the fused function
GYRO, DRIFT, POSITION, AIR = 0, 1, 2, 3  # NOISE.generators
DRAWN = (0, 2, 3, 5)  # which of the simulated autopilot's generators these are
FLYING, TOUCHED, LOST = 0, 1, 2  # FLIGHT.ended

FLIGHT = np.dtype(
    [
        ("t_us", "i8"),  # vehicle time; always the end of a control period between calls
        ("period_us", "i8"),
        ("step_us", "i8"),
        ("delay_us", "i8"),  # of the wire, each way
        ("attitude_us", "i8"),  # interval of the stream
        ("position_us", "i8"),
        ("echo_us", "i8"),  # of ATTITUDE_TARGET
        ("attitude_due_us", "i8"),
        ("position_due_us", "i8"),
        ("echo_due_us", "i8"),
        ("controller", "i8"),
        ("ended", "i8"),
        # the companion
        ("engage_us", "i8"),  # setpoints flow from here on
        ("engaged", "i8"),
        ("settle_us", "i8"),
        ("wanted_gap_us", "i8"),  # control period asked for
        ("control_us", "i8"),
        ("gap_us", "i8"),  # smallest between two attitudes
        ("last_attitude_us", "i8"),
        ("path_t0_us", "i8"),
        ("carry_s", "f8"),
        ("anchor_p", "f8", 3),
        ("anchor_yaw", "f8"),
        ("estimate_q", "f8", 4),  # of the last control step
        ("position_stamp_us", "i8"),
        ("p", "f8", 3),
        ("v", "f8", 3),
        ("integral", "f8", 3),
        ("sent_q", "f8", 4),
        ("sent_thrust", "f8"),
        ("hover_thrust", "f8"),
        ("echo_thrust", "f8"),
        # on the wire: rings of the first not yet delivered and the next free place
        ("attitude_first", "i8"),
        ("attitude_next", "i8"),
        ("position_first", "i8"),
        ("position_next", "i8"),
        ("echo_first", "i8"),
        ("echo_next", "i8"),
        ("setpoint_first", "i8"),
        ("setpoint_next", "i8"),
        # scores: from..to in vehicle time, sums over control steps
        ("score_from_us", "i8"),
        ("score_to_us", "i8"),
        ("scored", "i8"),
        ("sum_e2", "f8", 3),
        ("max_e2", "f8"),
        ("control_steps", "i8"),
    ]
)

NOISE = np.dtype([("generators", "u8", (4, 4)), ("normals", "f8", COLUMNS)])  # by number below; of one step
ATTITUDES = np.dtype([("t_us", "i8"), ("q", "f8", 4), ("p_true", "f8", 3)])
ECHOES = np.dtype([("t_us", "i8"), ("thrust", "f8"), ("upright", "f8")])
POSITIONS = np.dtype([("t_us", "i8"), ("p", "f8", 3), ("v", "f8", 3)])
SETPOINTS = np.dtype(
    [("due_us", "i8"), ("q", "f8", 4), ("thrust", "f8"), ("p", "f8", 3), ("v", "f8", 3), ("a", "f8", 3), ("yaw", "f8")]
)
WIRES = np.dtype(
    [
        ("attitudes", ATTITUDES, ON_WIRE),
        ("positions", POSITIONS, ON_WIRE),
        ("echoes", ECHOES, ON_WIRE),
        ("setpoints", SETPOINTS, ON_WIRE),
    ]
)
TRACE = 11  # columns per control period: t_us, true p, v, thrust axis, collective asked for
