"""Design-time checks of an (I)ADRC loop: what the paper's stability proof leaves out, by eigenvalues, before anything flies.

Source: Xiao & Tong 2023, Eq. (37), extended by motor lag, motor model and feed-forward, and by the joint observer.

Deviations from the paper:
  Eq. (37)  the proof has neither actuator nor filter nor rate of the disturbance, and the motor's lag decides stability.
"""

import math
from typing import Literal, NamedTuple

import numpy as np

from mavquad.errors import ConfigError


class Finding(NamedTuple):
    """One check: `value` against `limit`, and what to do about it."""

    name: str
    value: float
    limit: float
    verdict: Literal["ok", "warn", "refuse"]
    reason: str


def damping(eigenvalues: np.ndarray) -> float:
    """Least damping ratio of a set of poles: 1 for real stable ones, negative where one is unstable."""
    size = np.abs(eigenvalues)
    moving = size > 1e-9
    return float(np.min(-eigenvalues.real[moving] / size[moving])) if moving.any() else 1.0


def separation(name: str, wc_rad_s: float, w0_rad_s: float) -> Finding:
    """The observer against the controller it serves: at least 3 wc, never below 1.5 wc."""
    ratio = w0_rad_s / wc_rad_s
    if ratio < 1.5:
        return Finding(name, ratio, 1.5, "refuse", f"w0 {w0_rad_s:g} is below 1.5 wc ({wc_rad_s:g}); raise w0 or lower wc")
    if ratio < 3.0:
        return Finding(name, ratio, 3.0, "warn", f"w0 {w0_rad_s:g} is below 3 wc ({wc_rad_s:g}): observer and law interact")
    return Finding(name, ratio, 3.0, "ok", "")


def nominal(wc_rad_s: float, b: np.ndarray) -> np.ndarray:
    """Eigenvalues of Eq. (37): plant and observer (gains b, (3,)), no actuator. The law's poles and the observer's, exactly."""
    k1, k2 = wc_rad_s**2, 2.0 * wc_rad_s
    phi = np.array(
        [[0, 1, 0, 0, 0], [-k1, -k2, -k1, -k2, -1], [0, 0, -b[0], 1, 0], [0, 0, -b[1], 0, 1], [0, 0, -b[2], 0, 0]], dtype=float
    )
    return np.linalg.eigvals(phi)


def with_motor(
    wc_rad_s: float, b: np.ndarray, motor_lag_s: float, g: float, tau_f_s: float, model: bool, input_gain: float = 1.0
) -> np.ndarray:
    """Eigenvalues with a first-order motor, feed-forward g, and a motor model before the observer or none.

    States x1, x2, F, z1, z2, z3, ef, fm. input_gain multiplies what the motor does to the vehicle (1.3: 30 % more than thought).
    """
    k1, k2 = wc_rad_s**2, 2.0 * wc_rad_s
    law = np.array([0.0, 0.0, 0.0, -k1, -k2, -1.0, -g * b[1], 0.0])
    A = np.zeros((8, 8))
    error = np.array([1.0, 0, 0, -1.0, 0, 0, 0, 0])
    A[0, 1] = 1.0
    A[1, 2] = input_gain
    A[2] = law / motor_lag_s
    A[2, 2] -= 1.0 / motor_lag_s
    A[3] = b[0] * error
    A[3, 4] += 1.0
    A[4] = b[1] * error
    A[4, 5] += 1.0
    A[4] += np.eye(8)[7] if model else law
    A[5] = b[2] * error
    A[6] = error / max(tau_f_s, 1e-4)
    A[6, 6] -= 1.0 / max(tau_f_s, 1e-4)
    A[7] = law / motor_lag_s
    A[7, 7] -= 1.0 / motor_lag_s
    return np.linalg.eigvals(A)


def joint_poles(w0_rad_s: float, kalman: tuple[float, float, float, float], compensated: bool = False) -> np.ndarray:
    """Poles of filter and observer each fed by the other (J2; J2C where `compensated`).

    `kalman` are steady gains over dt: l1, l2 on the position's innovation (into position, velocity), l3, l4 on the rate's (0
    where it is not measured).
    """
    w = w0_rad_s
    l1, l2, l3, l4 = kalman
    filter_poles = np.polyadd(np.polymul([1.0, l1], [1.0, l4]), [l2 * (1.0 - l3)])
    back = np.array([3.0 * w**2, w**3, 0.0, 0.0]) if compensated else np.array([w**3, 0.0, 0.0])
    return np.roots(np.polysub(np.polymul(np.poly([-w, -w, -w]), filter_poles), (1.0 - l3) * back))


def steady_gains(q: tuple[float, float], r: tuple[float, float | None], dt_s: float) -> tuple[float, float, float, float]:
    """(l1, l2, l3, l4) of a two-state filter: process densities q, variances r of position and rate (None: not measured)."""
    from scipy.linalg import solve_discrete_are

    F = np.array([[1.0, dt_s], [0.0, 1.0]])
    H = np.eye(2) if r[1] is not None else np.array([[1.0, 0.0]])
    R = np.diag([x for x in r if x is not None])
    P = solve_discrete_are(F.T, H.T, np.diag(q) * dt_s, R)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R) / dt_s
    return (K[0, 0], K[1, 0], K[0, 1], K[1, 1]) if r[1] is not None else (K[0, 0], K[1, 0], 0.0, 0.0)


def _judged(name: str, poles: np.ndarray, warn_below: float, reason: str) -> Finding:
    if float(np.max(poles.real)) >= 0.0:
        return Finding(name, float(np.max(poles.real)), 0.0, "refuse", f"unstable: {reason}")
    least = damping(poles)
    if least < warn_below:
        return Finding(name, least, warn_below, "warn", f"least damping {least:.2f}, wanted {warn_below:g}: {reason}")
    return Finding(name, least, warn_below, "ok", "")


def motor_checks(
    name: str, wc_rad_s: float, w0_rad_s: float, b: np.ndarray, motor_lag_s: float, g: float, tau_f_s: float, model: bool
) -> list[Finding]:
    """The loop with its motor, as thought and with 30 % more authority than thought."""
    reason = f"motor lag {motor_lag_s:g} s against wc {wc_rad_s:g}, w0 {w0_rad_s:g} rad/s" + (
        "" if model else "; give the observers a motor model"
    )
    found = [separation(f"{name}: w0/wc", wc_rad_s, w0_rad_s)]
    for label, gain in (("nominal", 1.0), ("+30 % input", 1.3)):
        poles = with_motor(wc_rad_s, b, motor_lag_s, g, tau_f_s, model, gain)
        found.append(_judged(f"{name}: motor, {label}", poles, 0.2, reason))
    return found


def joint_check(name: str, w0_rad_s: float, kalman: tuple[float, float, float, float], compensated: bool = False) -> Finding:
    """Filter and observer together: refuse unstable, warn below a damping of 0.3."""
    reason = f"the filter is too slow for w0 {w0_rad_s:g} rad/s; measure the rate too, raise its q, or lower w0"
    return _judged(f"{name}: joint observer", joint_poles(w0_rad_s, kalman, compensated), 0.3, reason)


def enforce(findings: list[Finding]) -> list[str]:
    """The warnings as lines of text. Raises ConfigError for the first finding that must be refused."""
    for f in findings:
        if f.verdict == "refuse":
            raise ConfigError(f"{f.name}: {f.value:.3g}, limit {f.limit:g}: {f.reason}")
    return [f"{f.name}: {f.value:.3g}, limit {f.limit:g}: {f.reason}" for f in findings if f.verdict == "warn"]


def latency_advice(delay_s: float) -> str:
    """ "" up to 20 ms; beyond, why the attitude loop is left to the autopilot."""
    if not (math.isfinite(delay_s) and delay_s > 0.02):
        return ""
    return f"measured latency {1e3 * delay_s:.0f} ms is above 20 ms: the attitude loop is left to the autopilot"
