"""How fast thrust follows its command: gain, first-order lag and delay from the collective as sent to the accelerometer's z.

Source: identification note, section 7 (thrust swept by +-0.05 to 0.08 of full collective); method of attitude.py.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from mavquad.errors import LogError
from mavquad.identify import attitude
from mavquad.identify.spectrum import Response
from mavquad.identify.timebase import Held, Sampled

LOWEST_HZ, HIGHEST_HZ = 0.3, 8.0  # below, the drag of heaving shows; above, no sweep goes
WORST_CHI2 = 30.0
Span = tuple[float, float]


class Lift(NamedTuple):
    """gain / (lag s + 1) e^(-s delay), each with its standard deviation."""

    gain_m_s2: float  # specific force per unit collective
    lag_s: float
    delay_s: float
    sd: tuple[float, float, float]
    chi2: float
    response: Response


def lift(thrust: Held, up_m_s2: Sampled, spans: Sequence[Span]) -> Lift:
    """From the collective and the specific force upward in the body. Raises LogError where thrust was not swept."""
    response, _ = attitude.measured(thrust, up_m_s2, spans, LOWEST_HZ, HIGHEST_HZ, what="the accelerometer")
    h, sd, g2 = response.h[:, 0, 0], response.sd[:, 0, 0], response.coherence[:, 0, 0]
    use = (g2 >= attitude.COHERENT) & (np.abs(h) > 0.0)
    if use.sum() < attitude.FEWEST_POINTS:
        raise LogError(
            f"{int(use.sum())} of {use.size} frequencies are coherent (needs {attitude.FEWEST_POINTS}); sweep thrust"
            " (mavquad fly sweep --axis thrust)"
        )
    omega, target, weight = response.omega_rad_s[use], h[use], 1.0 / np.maximum(sd[use], attitude.SD_FLOOR)

    def residuals(p: np.ndarray) -> np.ndarray:
        error = (p[0] - np.log(1.0 + 1j * omega * p[1]) - 1j * omega * p[2] - np.log(target)) * weight
        wrapped = (error.imag / weight + np.pi) % (2.0 * np.pi) - np.pi
        return np.concatenate([error.real, wrapped * weight])

    start = float(np.log(np.abs(target[0])))
    found = least_squares(residuals, (start, 0.05, 0.02), x_scale=(1.0, 0.05, 0.02), bounds=([-5, 0.0, 0.0], [10, 1.0, 0.5]))
    chi2 = 2.0 * float(found.cost) / max(1, 2 * int(use.sum()) - 3)
    if chi2 > WORST_CHI2:
        raise LogError(
            f"the accelerometer does not follow thrust as a lag would (chi2 {chi2:.0f}): is thrust a climb rate here?"
        )
    spread = np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)) * max(1.0, chi2))
    gain = float(np.exp(found.x[0]))
    bars = (gain * float(spread[0]), float(spread[1]), float(spread[2]))
    return Lift(gain, float(found.x[1]), float(found.x[2]), bars, chi2, response)
