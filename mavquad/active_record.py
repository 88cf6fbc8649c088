"""The set-membership filter of the compensator `asmf` over a whole record, compiled: `active_flight` on `record.Events`, no correction.

What the vehicle acted on is the record's COMMAND (the autopilot's own echo of it). It stands beside the pipeline as `active_flight` does.
"""

import math

from mavquad import linalg, quat
from mavquad.active_flight import Gains
from mavquad.active_tick import GAP_S
from mavquad.estimate import quad_error, record
from mavquad.jit import kernel

_ATTITUDE, _POSITION, _IMU, _COMMAND = record.ATTITUDE, record.POSITION, record.IMU, record.COMMAND
_ZERO3 = (0.0, 0.0, 0.0)
_NAN3 = (math.nan, math.nan, math.nan)


def run(gains: Gains, events: record.Events) -> record.Observed:
    """The model error at the steps with its bounds, guaranteed while the stated noise and rate bounds hold (`guaranteed`)."""
    out = record.outputs(events)
    _run(
        gains.model, events.kind, events.t_us, events.x, events.step,
        out.v_ned_m_s, out.f_ned_m_s2, out.low_m_s2, out.high_m_s2, out.guaranteed,
    )  # fmt: skip
    return out


@kernel
def _run(gains, kinds, stamps, x, steps, out_v, out_f, low, high, guaranteed):
    state = quad_error.init(gains, _ZERO3, _ZERO3, quad_error.G_M_S2)
    last_us, taken_us, attitude_us, velocity_us = 0, 0, 0, 0
    attitude, velocity, accel_sum = _ZERO3, _ZERO3, _ZERO3
    count, accel_us = 0, 0
    command = (0.0, 0.0, quad_error.G_M_S2)
    begun = False
    row = 0
    for i in range(kinds.size):
        kind, t_us = kinds[i], stamps[i]
        if kind == _COMMAND:
            command = (x[i, 0], x[i, 1], x[i, 2])
        elif kind == _POSITION:
            velocity, velocity_us = (x[i, 3], x[i, 4], x[i, 5]), t_us
        elif kind == _IMU:
            accel_sum = linalg.add(accel_sum, (x[i, 0], x[i, 1], x[i, 2]))
            count, accel_us = count + 1, accel_us + t_us
        elif kind == _ATTITUDE:
            attitude, attitude_us = quat.to_euler((x[i, 0], x[i, 1], x[i, 2], x[i, 3])), t_us
        if not steps[i]:
            continue
        dt_s = 1e-6 * (t_us - last_us)
        if velocity_us == 0 or attitude_us == 0:
            last_us = t_us
            row += 1
            continue
        if not begun or not 0.0 < dt_s <= GAP_S:
            state, taken_us, begun = quad_error.init(gains, velocity, attitude, command[2]), t_us, True
        else:
            accel, mean_us = _NAN3, t_us
            if count > 0:
                accel, mean_us = linalg.scale(1.0 / count, accel_sum), accel_us // count
            measured = quad_error.Measured(
                attitude if attitude_us > last_us else _NAN3,
                velocity if velocity_us > taken_us else _NAN3,
                accel,
                max(0.0, 1e-6 * (t_us - attitude_us)),
                max(0.0, 1e-6 * (t_us - velocity_us)),
                max(0.0, 1e-6 * (t_us - mean_us)),
            )
            taken_us = velocity_us if velocity_us > taken_us else taken_us
            state = quad_error.step(gains, state, command, measured, dt_s, t_us)
        last_us, accel_sum, count, accel_us = t_us, _ZERO3, 0, 0
        consistent = state.filter.guarantee
        for k in range(3):
            cut = quad_error.bounds_f(state, k)
            out_v[row, k], out_f[row, k] = state.filter.x[quad_error.V + k], state.filter.x[quad_error.F + k]
            low[row, k], high[row, k] = cut.low, cut.high
            consistent = consistent and cut.consistent
        guaranteed[row] = 1.0 if consistent else 0.0
        row += 1
