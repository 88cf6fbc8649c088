"""Model predictive control of position in closed form: error feedback, feed-forward, disturbance cancelled, delay predicted.

Source: Yang, Lyu, Chai 2022, Eqs. (10)-(19). Inputs and outputs are thrust accelerations in NED (gravity included, so hover is
zero): a = a_ref - K e - f. With a terminal weight from the DARE the unconstrained MPC is the LQR of its step for any horizon;
constraints are in `constrained.py`.

Deviations from the paper:
  Eqs. (13)-(15) zero targets, see `prediction.py`; the preset "paper" keeps the Euler model, N = 10 and the printed weights
                 with the terminal multiplier 1, the reading of omega_sigma that flies.
  Eq. (16)-(18)  u = u_r + u~ - f/b on every axis; b is frozen over the horizon and the gain follows b each step ("paper").
  Eq. (19)       the horizontal part of the thrust direction is limited before asin.
  integral       redundant beside f and winds up: held at zero by default; frozen while saturated where it is on.
  delay          the commands still under way are predicted through before the error is formed.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from mavquad.control import prediction
from mavquad.errors import ConfigError
from mavquad.jit import kernel
from mavquad.signals import Vec3

GRAVITY_M_S2 = 9.80665
INTEGRAL_LIMIT_M_S = 5.0
COS_FLOOR = 0.2  # of cos(roll) cos(pitch), where thrust is divided by it


@dataclass(frozen=True, slots=True, kw_only=True)
class MpcParams:
    """Weights of the position loop. "default": acceleration domain, DARE terminal; "paper": the printed one (N, E, D order)."""

    preset: Literal["default", "paper"] = "default"
    mass_kg: float
    u_min_n: float  # least thrust, never 0: it keeps attitude authority
    u_max_n: float
    tilt_max_rad: float = math.radians(35.0)
    integral: bool = False
    compensate: bool = True
    f_max_m_s2: float = 8.0  # clip of the disturbance where it is used, not in the estimator
    omega: float = 1.0  # terminal multiplier of the preset "paper"
    response_rad_s: float = 8.0  # natural frequency of the attitude, as far as the delay prediction goes
    response_damping: float = 0.8
    dt_s: float = 0.01
    gravity_m_s2: float = GRAVITY_M_S2

    def __post_init__(self) -> None:
        if self.preset not in ("default", "paper"):
            raise ConfigError(f'mpc.preset must be "default" or "paper", got "{self.preset}"')
        for name in ("mass_kg", "f_max_m_s2", "omega", "response_rad_s", "response_damping", "dt_s", "gravity_m_s2"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"mpc.{name} must be a finite number > 0, got {value}")
        if not 0.0 < self.u_min_n < self.u_max_n < math.inf:
            raise ConfigError(f"mpc: 0 < u_min_n < u_max_n expected, got {self.u_min_n} and {self.u_max_n}")
        if not 0.0 < self.tilt_max_rad < math.pi / 2:
            raise ConfigError(f"mpc.tilt_max_rad must lie in 0..pi/2, got {self.tilt_max_rad}")


class MpcGains(NamedTuple):
    paper: bool
    k: tuple[Vec3, Vec3, Vec3]  # default: per axis, on position, velocity, integral
    horizon: int
    q: tuple[Vec3, Vec3, Vec3]  # paper: stage weights per axis
    r: Vec3  # paper: of u_x, u_y (direction) and U [N]
    omega: float
    mass_kg: float
    u_min_n: float
    u_max_n: float
    sin_tilt: float
    integral: bool
    compensate: bool
    f_max: float
    response: tuple[float, float, float, float]
    dt_s: float
    gravity: float


# section 5.2 of the design note: T = 0.05 s, N = 20, weights (4, 0.5, 1), R = 0.02
DEFAULT_WEIGHTS, DEFAULT_R, DEFAULT_STEP_S, DEFAULT_HORIZON = np.array([4.0, 0.5, 1.0]), 0.02, 0.05, 20
PAPER_WEIGHTS: tuple[Vec3, Vec3, Vec3] = ((70.0, 8.0, 5.0), (70.0, 5.0, 3.0), (25.0, 1.0, 2.0))
PAPER_R: Vec3 = (20.0, 20.0, 0.05)
PAPER_HORIZON = 10


def second_order(natural_rad_s: float, damping: float, dt_s: float) -> tuple[float, float, float, float]:
    """Transition of (x - command, x') over dt of x'' = wn^2 (command - x) - 2 zeta wn x', row by row."""
    from scipy.linalg import expm

    e = expm(dt_s * np.array([[0.0, 1.0], [-(natural_rad_s**2), -2.0 * damping * natural_rad_s]]))
    return (float(e[0, 0]), float(e[0, 1]), float(e[1, 0]), float(e[1, 1]))


def gains(params: MpcParams) -> MpcGains:
    k = prediction.lqr(prediction.position_model(DEFAULT_STEP_S), DEFAULT_WEIGHTS, DEFAULT_R)
    row = (float(k[0]), float(k[1]), float(k[2]))
    return MpcGains(
        paper=params.preset == "paper",
        k=(row, row, row),
        horizon=PAPER_HORIZON,
        q=PAPER_WEIGHTS,
        r=PAPER_R,
        omega=params.omega,
        mass_kg=params.mass_kg,
        u_min_n=params.u_min_n,
        u_max_n=params.u_max_n,
        sin_tilt=math.sin(params.tilt_max_rad),
        integral=params.integral,
        compensate=params.compensate,
        f_max=params.f_max_m_s2,
        response=second_order(params.response_rad_s, params.response_damping, params.dt_s),
        dt_s=params.dt_s,
        gravity=params.gravity_m_s2,
    )


class Thrust(NamedTuple):
    """What a thrust acceleration asks of the vehicle, inside its limits."""

    u_n: float
    ux: float  # north part of R e3, with the sign of the paper: a_N = -(U/m) ux
    uy: float
    saturated: bool


@kernel
def clip(x, limit):
    return min(limit, max(-limit, x))


@kernel
def no_targets(horizon):
    return np.zeros((horizon, 2)), np.zeros(horizon)


@kernel
def feedback(g, axis, e, b, targets, inputs):
    """-K e as an acceleration; b (paper): input gain of this axis, which turns the input weight into R/b^2."""
    if g.paper:
        q = g.q[axis]
        move = prediction.first_move(
            g.horizon, g.dt_s, True, q[0], q[1], q[2], g.omega, g.r[axis] / (b * b), e, targets, inputs
        )
        return move
    k = g.k[axis]
    return -(k[0] * e[0] + k[1] * e[1] + k[2] * e[2])


@kernel
def demand(g, p, v, f, p_ref, v_ref, a_ref, integral, cos_tilt, targets, inputs):
    """Wanted thrust acceleration (3,) NED: vertical first, since the horizontal gain of "paper" needs the clipped thrust.

    targets (3,N,2), inputs (3,N): zeros, unless the printed increments are wanted (inputs in accelerations).
    """
    m = g.mass_kg
    down = a_ref[2] - (clip(f[2], g.f_max) if g.compensate else 0.0)
    down += feedback(g, 2, (p[2] - p_ref[2], v[2] - v_ref[2], integral[2]), cos_tilt / m, targets[2], inputs[2])
    u = min(g.u_max_n, max(g.u_min_n, m * (g.gravity - down) / cos_tilt))
    north = a_ref[0] - (clip(f[0], g.f_max) if g.compensate else 0.0)
    north += feedback(g, 0, (p[0] - p_ref[0], v[0] - v_ref[0], integral[0]), u / m, targets[0], inputs[0])
    east = a_ref[1] - (clip(f[1], g.f_max) if g.compensate else 0.0)
    east += feedback(g, 1, (p[1] - p_ref[1], v[1] - v_ref[1], integral[1]), u / m, targets[1], inputs[1])
    return (north, east, down)


@kernel
def thrust(g, a, cos_tilt):
    """U clipped first, then the direction scaled into the tilt cone. cos_tilt = cos(roll) cos(pitch) now, floored."""
    m = g.mass_kg
    wanted = m * (g.gravity - a[2]) / cos_tilt
    u = min(g.u_max_n, max(g.u_min_n, wanted))
    ux, uy = -m * a[0] / u, -m * a[1] / u
    length = math.sqrt(ux * ux + uy * uy)
    saturated = u != wanted
    if length > g.sin_tilt:
        ux *= g.sin_tilt / length
        uy *= g.sin_tilt / length
        saturated = True
    return Thrust(u, ux, uy, saturated)


@kernel
def acceleration(g, t, cos_tilt):
    """The thrust acceleration that limited inputs give: the inverse of `thrust`."""
    s = t.u_n / g.mass_kg
    return (-s * t.ux, -s * t.uy, g.gravity - s * cos_tilt)


@kernel
def slew(a, last, limit_m_s3, dt):
    """Each axis at most limit*dt from the last applied one, and whether that bit."""
    step = limit_m_s3 * dt
    n = min(last[0] + step, max(last[0] - step, a[0]))
    e = min(last[1] + step, max(last[1] - step, a[1]))
    d = min(last[2] + step, max(last[2] - step, a[2]))
    return (n, e, d), (n != a[0] or e != a[1] or d != a[2])


@kernel
def angles(ux, uy, yaw_rad):
    """Roll and pitch that point the thrust along (ux, uy), Eq. (19)."""
    s, c = math.sin(yaw_rad), math.cos(yaw_rad)
    roll = math.asin(min(1.0, max(-1.0, ux * s - uy * c)))
    pitch = math.asin(min(1.0, max(-1.0, (ux * c + uy * s) / math.cos(roll))))
    return roll, pitch


@kernel
def integrate(integral, e, dt, saturated):
    """Integral of the position error: frozen where it would wind up a saturated input, clamped."""
    out_n = integral[0] if saturated and e[0] * integral[0] > 0.0 else clip(integral[0] + dt * e[0], INTEGRAL_LIMIT_M_S)
    out_e = integral[1] if saturated and e[1] * integral[1] > 0.0 else clip(integral[1] + dt * e[1], INTEGRAL_LIMIT_M_S)
    out_d = integral[2] if saturated and e[2] * integral[2] > 0.0 else clip(integral[2] + dt * e[2], INTEGRAL_LIMIT_M_S)
    return (out_n, out_e, out_d)


@kernel
def ahead(p, v, a_now, j_now, f, queue, steps, dt, response):
    """Position and velocity after the `steps` commands under way, oldest first in queue (n,3): accelerations after limits.

    Horizontally the acceleration (now a_now, changing at j_now) follows its command as the attitude does, vertically at once;
    f is constant. response (4,): the transition of (a - command, a') over dt, see `second_order`.
    """
    e11, e12, e21, e22 = response
    an, ae = a_now[0], a_now[1]
    jn, je = j_now[0], j_now[1]
    pn, pe, pd = p
    vn, ve, vd = v
    for i in range(steps):
        cn, ce = queue[i, 0], queue[i, 1]
        xn, xe, xd = an + f[0], ae + f[1], queue[i, 2] + f[2]
        an, jn = cn + e11 * (an - cn) + e12 * jn, e21 * (an - cn) + e22 * jn
        ae, je = ce + e11 * (ae - ce) + e12 * je, e21 * (ae - ce) + e22 * je
        xn, xe = 0.5 * (xn + an + f[0]), 0.5 * (xe + ae + f[1])
        pn += dt * vn + 0.5 * dt * dt * xn
        pe += dt * ve + 0.5 * dt * dt * xe
        pd += dt * vd + 0.5 * dt * dt * xd
        vn += dt * xn
        ve += dt * xe
        vd += dt * xd
    return (pn, pe, pd), (vn, ve, vd)
