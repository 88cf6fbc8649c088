"""Tables 8.4 and 8.5: order of the integrators open loop, and the bias of each map in a constant spin.

The Runge-Kutta-Munthe-Kaas schemes are written here a second time, by tableau, with the bracket and the quadratic term of
dcay^-1 as switches: the wrong ones show which slip an experiment can see (only order 4 sees any).
"""

import math

import numpy as np

from mavquad import linalg, quat
from mavquad.estimate import gsmo_relay, lie, rate_baselines
from mavquad.jit import kernel
from tools.papers.common import Row
from tools.papers.geometric import setup
from tools.papers.geometric.runs import run
from tools.papers.geometric.setup import GYRO, IDENTITY, INERTIA
from tools.papers.geometric.tables import row

STEPS_S = (0.1, 0.05, 0.025, 0.0125, 0.00625)
SPAN_S = 5.0
TABLEAUS = {
    "Euler": (((0.0,),), (1.0,)),
    "midpoint": (((0.0, 0.0), (0.5, 0.0)), (0.0, 1.0)),
    "Heun": (((0.0, 0.0), (1.0, 0.0)), (0.5, 0.5)),
    "classical": (
        ((0.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0, 0.0), (0.0, 0.5, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
        (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0),
    ),
}
SCHEMES = {  # name: (tableau, bracket, quadratic term)
    "RKMK 1 Euler": ("Euler", 0.5, 1.0),
    "RKMK 2 midpoint": ("midpoint", 0.5, 1.0),
    "RKMK 2 Heun": ("Heun", 0.5, 1.0),
    "RKMK 2 Heun, wrong bracket sign": ("Heun", -0.5, 1.0),
    "RKMK 2 Heun, no bracket": ("Heun", 0.0, 1.0),
    "RKMK 4": ("classical", 0.5, 1.0),
    "RKMK 4, wrong bracket sign": ("classical", -0.5, 1.0),
    "RKMK 4, no bracket": ("classical", 0.0, 1.0),
    "RKMK 4, no quadratic term": ("classical", 0.5, 0.0),
}


@kernel
def torque_at(t: float) -> tuple[float, float, float]:
    m = 0.01 * math.sin(t)
    return (m / INERTIA[0], m / INERTIA[1], 0.0)


@kernel
def by_tableau(a: np.ndarray, b: np.ndarray, bracket: float, quadratic: float, h: float, steps: int) -> np.ndarray:
    """Open loop from rest; the attitude (4,) at the end."""
    s = len(b)
    q, w = IDENTITY, (0.0, 0.0, 0.0)
    kappa, slope = np.zeros((s, 3)), np.zeros((s, 3))
    for k in range(steps):
        for i in range(s):
            xi, w_i, c = np.zeros(3), np.array(w), 0.0
            for j in range(i):
                c += a[i, j]
                for m in range(3):
                    xi[m] += h * a[i, j] * kappa[j, m]
                    w_i[m] += h * a[i, j] * slope[j, m]
            x, v = (xi[0], xi[1], xi[2]), (w_i[0], w_i[1], w_i[2])
            full = lie.dcay_inv(x, v, bracket)
            plain = linalg.axpy(bracket, linalg.cross(x, v), v)  # without the terms that are quadratic in xi
            f = lie.rate_derivative(GYRO, v, torque_at((k + c) * h))
            for m in range(3):
                kappa[i, m] = plain[m] + quadratic * (full[m] - plain[m])
                slope[i, m] = f[m]
        step, w_step = np.zeros(3), np.array(w)
        for i in range(s):
            for m in range(3):
                step[m] += h * b[i] * kappa[i, m]
                w_step[m] += h * b[i] * slope[i, m]
        q = quat.mul(q, quat.cayley((step[0], step[1], step[2])))
        w = (w_step[0], w_step[1], w_step[2])
    return np.array(q)


@kernel
def ours(order: int, h: float, steps: int) -> np.ndarray:
    """The same by the steps the observers use."""
    zero = (0.0, 0.0, 0.0)
    q, w = IDENTITY, zero
    for k in range(steps):
        a0, a1, a2 = torque_at(k * h), torque_at((k + 0.5) * h), torque_at((k + 1) * h)
        if order == 1:
            q, w = lie.step_1(lie.CAYLEY, GYRO, q, w, a0, zero, zero, h)
        elif order == 2:
            q, w = lie.step_2(lie.CAYLEY, GYRO, q, w, a0, a1, zero, zero, h)
        else:
            q, w = lie.step_4(GYRO, q, w, a0, a1, a2, zero, zero, h)
    return np.array(q)


@kernel
def renormalised(scheme: int, h: float, steps: int) -> np.ndarray:
    """Euler or Runge-Kutta on the four components, brought back to unit length after each step."""
    gains = rate_baselines.Gains(scheme, False, 0.0, 0.0, GYRO)
    s = rate_baselines.State(IDENTITY, (0.0, 0.0, 0.0), IDENTITY)
    for k in range(steps):
        s = rate_baselines.tick(gains, s, torque_at(k * h), torque_at((k + 0.5) * h), torque_at((k + 1) * h), h)
    return np.array(s.q)


def end_attitude(name: str, h: float) -> np.ndarray:
    """The attitude after 5 s by one scheme of the table."""
    steps = round(SPAN_S / h)
    if name in SCHEMES:
        tableau, bracket, quadratic = SCHEMES[name]
        a, b = TABLEAUS[tableau]
        return by_tableau(np.array(a), np.array(b), bracket, quadratic, h, steps)
    return renormalised(rate_baselines.RK4 if name.startswith("RK4") else rate_baselines.EULER, h, steps)


def angle_rad(q_a: np.ndarray, q_b: np.ndarray) -> float:
    """Angle between two attitudes."""
    return float(np.linalg.norm(quat.log(quat.mul(quat.conj(tuple(q_a)), tuple(q_b)))))


def integrator_order() -> list[Row]:
    """8.4: attitude error at 5 s for five steps, and the slope of its logarithm between the two smallest."""
    end = setup.truth().q[round(SPAN_S / setup.H)]
    rows = []
    for name in (*SCHEMES, "Euler + renorm", "RK4 + renorm"):
        errors = [angle_rad(end_attitude(name, h), end) for h in STEPS_S]
        rows += [row("8.4", name, "att_error_rad", "rad", e, h_s=h) for h, e in zip(STEPS_S, errors, strict=True)]
        rows.append(row("8.4", name, "slope", "1", math.log2(errors[-2] / errors[-1])))
    return rows


@kernel
def drift(group_map: int, steps: int, swing: float) -> float:
    """How far the norm is from 1 after steps of 10 ms at about 3 rad/s, never reset; swing 0: the rate is constant."""
    q = IDENTITY
    for k in range(steps):
        s = 1.0 + swing * math.sin(0.01 * k)
        q = quat.mul(q, lie.increment(group_map, (0.02 * s, -0.01 * s, 0.02 * s)))
    return abs(quat.norm(q) - 1.0)


@kernel
def plain_euler_drift(steps: int) -> float:
    """The same for q + h q'/2, not brought back."""
    q = IDENTITY
    for _ in range(steps):
        q = rate_baselines.axpy4(1.0, rate_baselines.rotate_rate(q, (0.02, -0.01, 0.02)), q)
    return abs(quat.norm(q) - 1.0)


def norm_drift() -> list[Row]:
    """Below 8.4: no renormalisation. At a constant rate each step rounds alike, so that the drift adds up instead of averaging."""
    million, few = 1_000_000, 2000
    return [
        row("8.4", "Cayley", "norm_drift", "1", drift(lie.CAYLEY, million, 0.5), steps=million),
        row("8.4", "exp", "norm_drift", "1", drift(lie.EXP, million, 0.5), steps=million),
        row("8.4", "Cayley, constant rate", "norm_drift", "1", drift(lie.CAYLEY, million, 0.0), steps=million),
        row("8.4", "plain Euler", "norm_drift", "1", plain_euler_drift(few), steps=few),
    ]


SPINS = ((0.01, 10.0), (0.01, 23.26), (0.01, 35.0), (0.02, 23.26), (0.02, 35.0))
MAPS = {"Cayley": lie.CAYLEY, "exp": lie.EXP, "Euler + renorm": lie.EULER}


def spin_bias(name: str, h: float, spin_rad_s: float) -> float:
    """8.5: mean of the observed rate minus the true one in the second half; spherical inertia, order 1, sat."""
    n = 2 * round(5.0 / h) + 1
    half = 0.5 * spin_rad_s * h * np.arange(n)
    samples = np.stack([np.cos(half), np.zeros(n), np.zeros(n), np.sin(half)], axis=1)
    every = np.arange(n) % round(max(0.02 / h, 1.0)) == 0
    gains = gsmo_relay.Gains(gsmo_relay.SAT, 1, MAPS[name], False, 4.0, 20.0, 0.5, 2.5, 0.2, (0.0, 0.0, 0.0))
    stimulus = setup.Stimulus(np.zeros((2 * n + 1, 3)), every, samples, h, 0.02)
    w, _ = run(setup.Config(name, "relay", gains), stimulus, IDENTITY, (0.0, 0.0, spin_rad_s))
    return float(np.mean(w[n // 2 :, 2]) - spin_rad_s)


def spin_theory(name: str, h: float, spin_rad_s: float) -> float:
    """What the map does to a constant rate: 4/h tan(W h/4), W, or 2/h tan(W h/2)."""
    if name == "exp":
        return 0.0
    k = 4.0 if name == "Cayley" else 2.0
    return k / h * math.tan(spin_rad_s * h / k) - spin_rad_s


def constant_spin() -> list[Row]:
    """8.5, measured and by theory."""
    rows = []
    for h, spin in SPINS:
        for name in MAPS:
            more = {"h_s": h, "spin_rad_s": spin}
            rows.append(row("8.5", name, "bias", "rad/s", spin_bias(name, h, spin), **more))
            rows.append(row("8.5", name, "bias_theory", "rad/s", spin_theory(name, h, spin), **more))
    return rows
