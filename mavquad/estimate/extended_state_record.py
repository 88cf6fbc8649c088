"""The extended-state filter over a whole record, compiled: `extended_state_flight` on `record.Events`, with its own 3 sigma.

The thrust that acts is the record's COMMAND, which here stands for what was sent and for its echo.
"""

import math

from mavquad import quat
from mavquad.estimate import extended_state_flight as flight
from mavquad.estimate import extended_state_kf as eskf
from mavquad.estimate import record
from mavquad.estimate.extended_state_flight import Gains
from mavquad.estimate.extended_state_kf import KfState
from mavquad.jit import kernel

_G_M_S2 = flight.G_M_S2
_ATTITUDE, _POSITION, _COMMAND = record.ATTITUDE, record.POSITION, record.COMMAND
_LATE_S, _COAST_S = 0.25, 0.5  # as in extended_state_flight
_ZERO3 = (0.0, 0.0, 0.0)


def run(gains: Gains, events: record.Events) -> record.Observed:
    """What the filter estimates at the steps; low and high are three of its own sigmas, a belief and no guarantee."""
    out = record.outputs(events)
    first = tuple(eskf.init(g, 0.0, 0.0) for g in (gains.horizontal, gains.horizontal, gains.vertical))
    _run(
        gains, first, events.kind, events.t_us, events.x, events.step,
        out.p_ned_m, out.v_ned_m_s, out.f_ned_m_s2, out.low_m_s2, out.high_m_s2,
    )  # fmt: skip
    return out


@kernel
def _to(gains, axes, growth, placed, q, thrust, wanted, now_us, t_us):
    """(axes, thrust, now) at t, if that is ahead."""
    dt_s = 1e-6 * (t_us - now_us)
    if dt_s <= 0.0:
        return axes, thrust, now_us
    if now_us == 0 or dt_s > _COAST_S:
        return axes, thrust, t_us
    keep = math.exp(-dt_s / gains.thrust_lag_s) if gains.thrust_lag_s > 1e-4 else 0.0
    lagged = wanted + keep * (thrust - wanted)
    if placed:
        axes = flight.advance(gains, axes, growth, q, 0.5 * (thrust + lagged), dt_s)
    return axes, lagged, t_us


@kernel
def _begun(first, p, v):
    return KfState((p, v, 0.0), first.p, first.r, first.delta)


@kernel
def _hears(g, axis):
    return KfState(axis.x, axis.p, (g.r_first, g.r_second), axis.delta)


@kernel
def _run(gains, first, kinds, stamps, x, steps, out_p, out_v, out_f, low, high):
    axes, growth = first, flight.FULL
    now_us, position_us, command_us = 0, 0, 0
    placed = False
    thrust, command, before = _G_M_S2, _G_M_S2, _G_M_S2
    q, offset = quat.IDENTITY, _ZERO3
    row = 0
    for i in range(kinds.size):
        kind, t_us = kinds[i], stamps[i]
        wanted = command if command_us <= t_us else before
        if kind == _COMMAND:
            if t_us > command_us:
                before, command, command_us = command, x[i, 2], t_us
        elif kind == _ATTITUDE:
            axes, thrust, now_us = _to(gains, axes, growth, placed, q, thrust, wanted, now_us, t_us)
            q = (x[i, 0], x[i, 1], x[i, 2], x[i, 3])
        elif kind == _POSITION:
            p, v = (x[i, 0], x[i, 1], x[i, 2]), (x[i, 3], x[i, 4], x[i, 5])
            if not placed:
                axes = (_begun(first[0], p[0], v[0]), _begun(first[1], p[1], v[1]), _begun(first[2], p[2], v[2]))
                now_us, position_us, placed = max(now_us, t_us), t_us, True
            else:
                axes, thrust, now_us = _to(gains, axes, growth, placed, q, thrust, wanted, now_us, t_us)
                age_s = 1e-6 * (now_us - t_us)
                if age_s <= _LATE_S:
                    axes, growth = flight.correct(gains, axes, growth, p, v, q, thrust, age_s)
                    n, e, d = axes
                    if gains.adapt == 0.0:
                        n, e, d = _hears(gains.horizontal, n), _hears(gains.horizontal, e), _hears(gains.vertical, d)
                    axes = (n, e, d)
                    if gains.anchor_s > 0.0 and position_us > 0:
                        w = 1.0 - math.exp(-min(1.0, 1e-6 * max(0, t_us - position_us)) / gains.anchor_s)
                        offset = (
                            offset[0] + w * (p[0] - (n.x[0] - age_s * n.x[1]) - offset[0]),
                            offset[1] + w * (p[1] - (e.x[0] - age_s * e.x[1]) - offset[1]),
                            offset[2] + w * (p[2] - (d.x[0] - age_s * d.x[1]) - offset[2]),
                        )
                    position_us = max(t_us, position_us)
        if steps[i]:
            if placed:
                n, e, d = axes
                _write(gains, n, e, d, offset, row, out_p, out_v, out_f, low, high)
            row += 1


@kernel
def _write(gains, n, e, d, offset, row, out_p, out_v, out_f, low, high):
    v = (n.x[1], e.x[1], d.x[1])
    air = flight.drag(gains.drag_linear_1_s, gains.drag_quadratic_1_m, v)
    at, f = (n.x[0], e.x[0], d.x[0]), (n.x[2], e.x[2], d.x[2])
    spread = (n.p[5], e.p[5], d.p[5])
    for k in range(3):
        out_p[row, k], out_v[row, k], out_f[row, k] = at[k] + offset[k], v[k], f[k] + air[k]
        half = 3.0 * math.sqrt(max(spread[k], 0.0))
        low[row, k], high[row, k] = f[k] + air[k] - half, f[k] + air[k] + half
