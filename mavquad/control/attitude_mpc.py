"""Attitude MPC by feedback linearisation: torques from angles, rates and the rotational disturbance.

Source: Yang, Lyu, Chai 2022, Eqs. (20)-(24). On a MAVLink vehicle the autopilot runs this loop; it serves the experiments that
fly the whole cascade.

Deviations from the paper:
  Eq. (3)        body rates stand where Euler-angle rates are printed.
  after Eq. (24) the definition of V is inverted (Eq. (20) holds no torque); gyroscopic and gust torques live in f.
  preset         "default": DARE terminal weight, Q (100, 0.5), yaw (10, 0.5); "paper": Euler, N = 10, the last stage times 30.
"""

from typing import Literal, NamedTuple

import numpy as np

from mavquad.control import prediction
from mavquad.jit import kernel

Pair = tuple[float, float]
R_ATTITUDE = 0.01


class AttitudeGains(NamedTuple):
    roll: Pair  # on angle and rate
    pitch: Pair
    yaw: Pair


def gains(preset: Literal["default", "paper"] = "default", dt_s: float = 0.01, omega: float = 30.0) -> AttitudeGains:
    """Feedback of each angle; they do not depend on the vehicle."""
    rows = []
    for q in ((100.0, 0.5), (10.0, 0.5)) if preset == "default" else ((10.0, 0.5), (50.0, 0.5)):
        weights = np.array(q)
        if preset == "default":
            k = prediction.lqr(prediction.angle_model(dt_s), weights, R_ATTITUDE)
        else:
            model = prediction.angle_model(dt_s, "euler")
            k = prediction.first_gain(prediction.stack(model, 10, weights, R_ATTITUDE, np.diag(omega * weights)))
        rows.append((float(k[0]), float(k[1])))
    return AttitudeGains(rows[0], rows[0], rows[1])


@kernel
def wrap(angle):
    """Into -pi..pi."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


@kernel
def angular(g, angles, rates, wanted):
    """V0 = -K e for the three angles: (3,) rad/s^2, before the disturbance is cancelled."""
    return (
        -g.roll[0] * (angles[0] - wanted[0]) - g.roll[1] * rates[0],
        -g.pitch[0] * (angles[1] - wanted[1]) - g.pitch[1] * rates[1],
        -g.yaw[0] * wrap(angles[2] - wanted[2]) - g.yaw[1] * rates[2],
    )


@kernel
def torque(inertia, v, rates):
    """tau that makes the angular accelerations v: tau_x = Ix V - (Iy - Iz) q r and so on."""
    ix, iy, iz = inertia
    p, q, r = rates
    return (ix * v[0] - (iy - iz) * q * r, iy * v[1] - (iz - ix) * p * r, iz * v[2] - (ix - iy) * p * q)
