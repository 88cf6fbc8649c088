"""What the autopilot says about itself beside the vehicle's record, and the truth, as a record that layouts read (see `frames`)."""

import numpy as np

from mavquad.jit import kernel
from sitl import frames, rotation
from sitl.state import RATES, VEHICLE

TARGET, GIVEN, SHAPED = 0, 1, 2
TRUTHS = 2  # messages of the truth
_COMPONENT = 25  # MAV_COMP_ID_USER1: truth has a sequence of its own
TOLD = np.dtype(
    [
        # set by Python
        ("booted_us", "i8"),
        ("mocap_age_us", "i8"),
        ("echo", "i8"),  # what ATTITUDE_TARGET tells: TARGET, GIVEN (echo_q_wxyz is what came over the wire) or SHAPED
        # of an instant
        ("clock_us", "i8"),  # since boot
        ("clock_ms", "i8"),
        ("wrapped_us", "i8"),  # in 32 bits
        ("mocap_us", "i8"),
        ("type_mask", "i8"),  # of ATTITUDE_TARGET
        ("echo_q_wxyz", "f8", 4),
        ("echo_rates_rad_s", "f8", 3),
        # the truth
        ("t_us", "i8"),
        ("true_q_wxyz", "f8", 4),
        ("v_frd_m_s", "f8", 3),
        ("force_m_s2", "f8", 3),  # disturbance, mean since the last time
        ("torque_rad_s2", "f8", 3),
        ("thrust_m_s2", "f8"),
        ("misses", "f8"),
        ("engaged", "f8"),
    ]
)
WORDS = frames.records(VEHICLE, TOLD)


@kernel
def tell(s, sp, a, t_us):
    """The clocks, and the attitude that the loop is after."""
    a.clock_us = t_us - a.booted_us
    a.clock_ms = a.clock_us // 1000
    a.wrapped_us = a.clock_us & 0xFFFFFFFF
    a.mocap_us = max(0, a.clock_us - a.mocap_age_us)  # the first samples after the start are as old as that
    a.type_mask = 128 if sp.kind == RATES and a.echo != SHAPED else 0
    if a.echo != GIVEN:
        q = rotation.to_quaternion(rotation.matrix(s.shaped_R if a.echo == SHAPED else s.target_R))
        for i in range(4):
            a.echo_q_wxyz[i] = q[i]
    for i in range(3):
        a.echo_rates_rad_s[i] = s.shaped_rates_rad_s[i] if a.echo == SHAPED else s.target_rates_rad_s[i]


@kernel
def find_truth(vehicle, constants, told, t_us, misses, engaged):
    """The truth of this instant; the disturbance is the mean since the last call."""
    s, c, a = vehicle[0], constants[0], told[0]
    summed = float(max(1, s.summed))
    for i in range(3):
        a.force_m_s2[i], a.torque_rad_s2[i] = s.disturbance_m_s2[i] / summed, s.disturbance_rad_s2[i] / summed
        s.disturbance_m_s2[i] = s.disturbance_rad_s2[i] = 0.0
        a.v_frd_m_s[i] = s.R[i] * s.v_ned_m_s[0] + s.R[3 + i] * s.v_ned_m_s[1] + s.R[6 + i] * s.v_ned_m_s[2]
    s.summed = 0
    q = rotation.to_quaternion(rotation.matrix(s.R))
    for i in range(4):
        a.true_q_wxyz[i] = q[i]
    a.thrust_m_s2 = (s.thrust_n[0] + s.thrust_n[1] + s.thrust_n[2] + s.thrust_n[3]) / c.mass_kg
    a.t_us, a.misses, a.engaged = t_us, misses, engaged


@kernel
def write_truth(vehicle, constants, told, t_us, messages, moves, words, more, case, log):
    """`find_truth`, and the log's records of the last messages of the tables, which are those of the truth: where they end in `log`.

    case: (stamp, sequence, system, misses, engaged).
    """
    stamp_us, seq, system, misses, engaged = case
    find_truth(vehicle, constants, told, t_us, misses, engaged)
    at, many = 0, messages.shape[0]
    for k in range(many - TRUTHS, many):
        m = messages[k]
        body = log[at + frames.STAMP + 10 : at + frames.STAMP + 10 + m.length]  # where it goes untrimmed
        frames.payload(m, moves, words, more, body)
        at = frames.stamp(stamp_us, log, at)
        at = frames.frame(body, m.length, m.msgid, m.extra, seq, system, _COMPONENT, log, at)
        seq += 1
    return at
