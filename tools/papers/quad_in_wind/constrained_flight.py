"""The same flight with the quadratic programs between sensing and acting: mavquad's constrained MPC in S3."""

import math
from typing import NamedTuple

import numpy as np

from mavquad.control import constrained, mpc, prediction, qp
from tools.papers.quad_in_wind import loop
from tools.papers.quad_in_wind.loop import Flight


class Counts(NamedTuple):
    """What the solver did in one flight."""

    solves: int
    fallbacks: int
    iterations: np.ndarray
    cpu_s: np.ndarray  # of each control step's programs, for the speed table only


def design(max_iter: int = qp.MAX_ITER) -> constrained.Design:
    """T = 0.05 s, N = 20, the default weights."""
    model = prediction.position_model(mpc.DEFAULT_STEP_S)
    weights, horizon = mpc.DEFAULT_WEIGHTS, mpc.DEFAULT_HORIZON
    return constrained.design(model, model, weights, mpc.DEFAULT_R, mpc.DEFAULT_STEP_S, horizon, max_iter)


def fly(
    fl: Flight, lp: loop.Loop, noise: np.ndarray, wind: np.ndarray, log: np.ndarray, d: constrained.Design, always: bool = False
) -> tuple[int, Counts]:
    """As `loop.fly`; returns the steps flown and what the solver did. A failed program falls back to the closed form."""
    import time

    g = fl.mpc
    state = constrained.init(d)
    iterations: list[int] = []
    cpu: list[float] = []
    m = g.mass_kg
    for k in range(len(log)):
        if loop.lost(lp.x):
            return k, Counts(state.solves, state.fallbacks, np.array(iterations), np.array(cpu))
        t = k * loop.DT
        loop.sense(fl, lp, k, noise[k])
        a = loop.want(fl, lp, t)
        e = loop.acting(fl, lp)
        cos_tilt = max(mpc.COS_FLOOR, float(loop.direction((e[3, 0], e[4, 0], e[5, 0]))[2]))
        f = [min(g.f_max, max(-g.f_max, float(e[i, 2]))) if g.compensate else 0.0 for i in range(3)]
        path = np.array([np.subtract(loop.reference(t + fl.lead_s + j * d.stage_s)[2], f) for j in range(d.horizon)])
        limits = constrained.Horizon(
            down_low=g.gravity - g.u_max_n * cos_tilt / m,
            down_high=g.gravity - g.u_min_n * cos_tilt / m,
            tilt=constrained.OCTAGON * g.sin_tilt / cos_tilt,  # |a| <= (U/m) sin(tilt), U/m = (g - a_D)/cos(tilt now)
            slew=fl.slew_m_s3,
            first_s=loop.DT,
        )
        start = time.process_time()
        state, move = constrained.solve(d, state, lp.error.copy(), path, tuple(lp.last), limits, g.gravity, always)
        cpu.append(time.process_time() - start)
        iterations.append(state.iterations)
        loop.record(lp, t, log[k])
        loop.act(fl, lp, move.u if move.usable else a, move.active, wind[k])
    return len(log), Counts(state.solves, state.fallbacks, np.array(iterations), np.array(cpu))


def overshoot(log: np.ndarray) -> float:
    """How far beyond the target the vehicle comes: the largest -(e_N, e_E).d0, d0 along the first horizontal error."""
    e = log[:, 1:3] - log[:, 4:6]
    d0 = e[0] / math.hypot(*e[0])
    return float(np.max(-(e @ d0)))
