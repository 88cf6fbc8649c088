"""What crosses a folder border: NamedTuples whose field names carry unit and frame.

NED world, FRD body, Hamilton quaternion scalar first (body to world), SI, radians. Time `t_us` is the autopilot's boot clock in
integer microseconds. Vectors are tuples of floats.
"""

import math
from typing import NamedTuple

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Sticks = tuple[float, float, float, float]  # of a helicopter, -1..1: roll (lat), pitch (lon), yaw (ped), throttle (col)
ZERO3: Vec3 = (0.0, 0.0, 0.0)
NAN3: Vec3 = (math.nan, math.nan, math.nan)
NO_STICKS: Sticks = (math.nan, math.nan, math.nan, math.nan)


# ---- samples: what the autopilot says -------------------------------------------------------------------------------
class Attitude(NamedTuple):
    """Attitude and rates as the autopilot reports them (its own filter's output: already contains the gyro)."""

    t_us: int
    q_wxyz: Quat
    omega_rad_s: Vec3  # body, low-pass filtered by most autopilots


class Mocap(NamedTuple):
    """Attitude and position from outside, independent of the gyro (ATT_POS_MOCAP)."""

    t_us: int
    q_wxyz: Quat
    p_ned_m: Vec3


class Imu(NamedTuple):
    """Specific force and rates as measured: body axes."""

    t_us: int
    accel_m_s2: Vec3
    gyro_rad_s: Vec3


class Position(NamedTuple):
    t_us: int
    p_ned_m: Vec3
    v_ned_m_s: Vec3


class Motors(NamedTuple):
    """What the autopilot sends to its motors, each 0..1 of the PWM span 1000..2000 us."""

    t_us: int
    command: tuple[float, ...]


class Target(NamedTuple):
    """The autopilot's echo of the attitude setpoint it acts on (ATTITUDE_TARGET)."""

    t_us: int
    q_wxyz: Quat
    omega_rad_s: Vec3
    thrust: float  # collective, 0..1
    type_mask: int


class Controls(NamedTuple):
    """A helicopter's sticks as applied, the inner loop's share included (ACTUATOR_CONTROL_TARGET)."""

    t_us: int
    sticks: Sticks


# ---- between the stages ------------------------------------------------------------------------------------------------
class Applied(NamedTuple):
    """What the vehicle is thought to be doing of what was sent: the input of every observer. Never what was only wished."""

    t_us: int
    q_wxyz: Quat  # attitude last sent
    thrust_m_s2: float  # specific thrust last sent, or as echoed by the autopilot; > 0 pushes along -z body
    omega_rad_s: Vec3  # rates last sent (NaN where none)
    delay_s: float  # measured command delay, companion to autopilot and back into telemetry
    age_s: float = 0.0  # of the newest sample when it arrived, less its mean, which is in delay_s
    collective: float = math.nan  # what was sent for thrust_m_s2, 0..1: the autopilot's echo of it is recognised


class Estimate(NamedTuple):
    """The state a controller acts on, at t_us. A field that is not known is NaN."""

    t_us: int
    p_ned_m: Vec3
    v_ned_m_s: Vec3
    q_wxyz: Quat
    omega_rad_s: Vec3
    f_ned_m_s2: Vec3  # total disturbance as an acceleration: v' = g e3 - R e3 thrust + f
    tau_rad_s2: Vec3  # rotational disturbance, body
    delay_s: float = 0.0  # what is commanded now reaches the vehicle this much after t_us; 0 where not measured
    thrust_m_s2: float = math.nan  # specific thrust thought to act now


class Demand(NamedTuple):
    """Where the path wants the vehicle at one time."""

    t_us: int
    p_ned_m: Vec3
    v_ned_m_s: Vec3
    a_ned_m_s2: Vec3
    j_ned_m_s3: Vec3
    yaw_rad: float
    yaw_rate_rad_s: float


class Command(NamedTuple):
    """What a controller wants: an inertial acceleration v' (gravity not included) and a heading.

    `setpoint/` turns it into attitude and thrust. omega_rad_s is NaN unless the controller closes the attitude loop itself
    (`--loop rates`) or feeds rates forward beside the attitude.
    """

    a_ned_m_s2: Vec3
    yaw_rad: float
    yaw_rate_rad_s: float
    omega_rad_s: Vec3
    f_cancelled_m_s2: Vec3  # the disturbance this command already cancels (zero where none)
    sticks: Sticks = NO_STICKS  # of a helicopter: sent in place of attitude and thrust


class Setpoint(NamedTuple):
    """What goes on the wire after the limits gate."""

    q_wxyz: Quat
    omega_rad_s: Vec3
    thrust: float  # collective 0..1 (or the autopilot's own scale: see link/signals)
    type_mask: int
