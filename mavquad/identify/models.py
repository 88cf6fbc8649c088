"""Hover models of a helicopter: state-space matrices from named derivatives, and the reference numbers.

Source: Song et al. 2011 (paper 004), Eqs. (1)-(6) and Table 1; hover structure after Mettler, Tischler & Kanade. Body axes FRD,
SI, radians; inputs are normalised sticks in [-1, 1]; g enters the rows of u and v.

Deviations from the paper:
  Eq. (1)   the state is X, not its derivative.
  Eq. (2)   w and r are states 9 and 10 alone; an accelerometer reads rows 1, 2, 9 of X' plus gravity, not the last three rows.
  Eqs. (3), (4)  the stabiliser bar has its own constant tau_s; the lateral derivatives are those of v and b.
  Eq. (5)   N_ped stands in two places and is one parameter.
  Eq. (6)   B_0 is blkdiag([B_lon; B_lat], B_yaw_heave), 13 x 4: U has four entries.
  Table 1   read as printed ("lon" is the printed "lon" entry). No repair of its signs gives a flyable plant: it is an exercise
            in identification, never a vehicle. Its third column is missing: REF (R-50-like) stands in.

A_lon, C_lon, ... are per time constant: Mettler's tau_f a' = ... + A d is A_lon = A / tau_f here.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy.linalg

from mavquad.errors import ConfigError

G_M_S2 = 9.80665


class Model(NamedTuple):
    """x' = A x + B u, y = C x, with the names of what stands in x, u and y."""

    a: np.ndarray  # (n, n)
    b: np.ndarray  # (n, m)
    c: np.ndarray  # (p, n)
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


# ---- reference numbers -----------------------------------------------------------------------------------------------
REF_LON: Mapping[str, float] = {
    "X_u": -0.0505, "X_a": -G_M_S2, "X_lon": 0.0, "X_lat": 0.0,
    "M_u": -0.184, "M_a": 82.6, "M_lon": 0.0, "M_lat": 0.0,
    "A_c": 0.644, "A_lon": -2.174, "A_lat": 0.680, "C_lon": -0.757, "C_lat": 0.12, "tau_f": 0.046, "tau_s": 0.342,
}  # fmt: skip
REF_LAT: Mapping[str, float] = {
    "Y_v": -0.154, "Y_b": G_M_S2, "Y_lon": 0.0, "Y_lat": 0.0,
    "L_v": 0.469, "L_b": 166.0, "L_lon": 0.0, "L_lat": 0.0,
    "B_d": 0.71, "B_lon": 0.300, "B_lat": 3.043, "D_lon": 0.10, "D_lat": 0.798, "tau_f": 0.046, "tau_s": 0.342,
}  # fmt: skip
REF_YAW_HEAVE: Mapping[str, float] = {
    "Z_w": -0.614, "Z_r": 0.2835, "N_w": 0.0988, "N_r": -4.13, "N_ped": 33.1,
    "K_r": 2.16, "K_rfb": 8.26, "Z_ped": 0.0, "Z_col": -13.96, "N_col": -3.33,
}  # fmt: skip
TABLE1_LON: Mapping[str, float] = {
    "X_u": 0.2446, "X_a": -4.962, "X_lon": 0.0896, "X_lat": -0.0686,
    "M_u": -1.258, "M_a": 46.06, "M_lon": 3.394, "M_lat": -0.6269,
    "A_c": 0.1628, "A_lon": -0.2585, "A_lat": -0.0178, "C_lon": -4.144, "C_lat": 2.238, "tau_f": 0.5026, "tau_s": 0.5026,
}  # fmt: skip
TABLE1_LAT: Mapping[str, float] = {
    "Y_v": -0.0577, "Y_b": 9.812, "Y_lon": 2.191, "Y_lat": -1.823,
    "L_v": 15.84, "L_b": 126.6, "L_lon": 28.64, "L_lat": -4.875,
    "B_d": -1.654, "B_lon": -9.288, "B_lat": 0.04732, "D_lon": -5.726, "D_lat": -0.7798, "tau_f": 0.5054, "tau_s": 0.5054,
}  # fmt: skip


# ---- matrices from derivatives ---------------------------------------------------------------------------------------
LON_NAMES = (
    "X_u",
    "X_a",
    "X_lon",
    "X_lat",
    "M_u",
    "M_a",
    "M_lon",
    "M_lat",
    "A_c",
    "A_lon",
    "A_lat",
    "C_lon",
    "C_lat",
    "tau_f",
    "tau_s",
)
LAT_NAMES = (
    "Y_v",
    "Y_b",
    "Y_lon",
    "Y_lat",
    "L_v",
    "L_b",
    "L_lon",
    "L_lat",
    "B_d",
    "B_lon",
    "B_lat",
    "D_lon",
    "D_lat",
    "tau_f",
    "tau_s",
)
YAW_HEAVE_NAMES = ("Z_w", "Z_r", "N_w", "N_r", "N_ped", "K_r", "K_rfb", "Z_ped", "Z_col", "N_col")


def lon(p: Mapping[str, float]) -> Model:
    """Eq. (3): x = (u, q, theta, a, c), inputs (lon, lat), outputs (u, q, theta). `p` holds every name of LON_NAMES."""
    return _rotor_axis(_values(p, LON_NAMES), -G_M_S2, ("u", "q", "theta", "a", "c"))


def lat(p: Mapping[str, float]) -> Model:
    """Eq. (4): x = (v, p, phi, b, d), inputs (lon, lat), outputs (v, p, phi). `p` holds every name of LAT_NAMES."""
    return _rotor_axis(_values(p, LAT_NAMES), G_M_S2, ("v", "p", "phi", "b", "d"))


def yaw_heave(p: Mapping[str, float]) -> Model:
    """Eq. (5): x = (w, r, r_fb), inputs (ped, col), outputs (w, r). `p` holds every name of YAW_HEAVE_NAMES."""
    z_w, z_r, n_w, n_r, n_ped, k_r, k_rfb, z_ped, z_col, n_col = _values(p, YAW_HEAVE_NAMES)
    a = np.array([[z_w, z_r, 0.0], [n_w, n_r, -n_ped], [0.0, k_r, -k_rfb]])
    b = np.array([[z_ped, z_col], [n_ped, n_col], [0.0, 0.0]])
    return Model(a, b, np.eye(2, 3), ("w", "r", "r_fb"), ("ped", "col"), ("w", "r"))


def semi_decoupled(lon_axis: Model, lat_axis: Model, yaw_heave_axis: Model) -> Model:
    """Eq. (6): 13 states in three blocks, U = (lon, lat, ped, col), Y = (u, q, theta, v, p, phi, w, r)."""
    axes = (lon_axis, lat_axis, yaw_heave_axis)
    return Model(
        scipy.linalg.block_diag(*(axis.a for axis in axes)),
        scipy.linalg.block_diag(np.vstack([lon_axis.b, lat_axis.b]), yaw_heave_axis.b),
        scipy.linalg.block_diag(*(axis.c for axis in axes)),
        sum((axis.states for axis in axes), ()),
        lon_axis.inputs + yaw_heave_axis.inputs,
        sum((axis.outputs for axis in axes), ()),
    )


STATES_EQ1 = ("u", "v", "p", "q", "phi", "theta", "a", "b", "w", "r", "r_fb", "c", "d")
INPUTS_EQ1 = ("lat", "lon", "ped", "col")


def reordered(model: Model, states: tuple[str, ...] = STATES_EQ1, inputs: tuple[str, ...] = INPUTS_EQ1) -> Model:
    """The same model with its states and inputs in another order; without arguments that of Eq. (1)."""
    if sorted(states) != sorted(model.states) or sorted(inputs) != sorted(model.inputs):
        raise ConfigError(f"cannot reorder {model.states} | {model.inputs} into {states} | {inputs}: other names")
    i = [model.states.index(name) for name in states]
    j = [model.inputs.index(name) for name in inputs]
    return Model(model.a[np.ix_(i, i)], model.b[np.ix_(i, j)], model.c[:, i], states, inputs, model.outputs)


def measurement_eq2(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Eq. (2), corrected: y = (u, v, p, q, phi, theta, w, r, a_x, a_y, a_z) = C x + D u, shapes (11, 13) and (11, m).

    The accelerometer at the centre of mass reads u' + g theta, v' - g phi and w' (hover, small angles, its -g taken off).
    """
    at = model.states.index
    c = np.zeros((11, len(model.states)))
    d = np.zeros((11, model.b.shape[1]))
    for row, name in enumerate(("u", "v", "p", "q", "phi", "theta", "w", "r")):
        c[row, at(name)] = 1.0
    for row, name in ((8, "u"), (9, "v"), (10, "w")):
        c[row] = model.a[at(name)]
        d[row] = model.b[at(name)]
    c[8, at("theta")] += G_M_S2
    c[9, at("phi")] -= G_M_S2
    return c, d


def ref_lon() -> Model:
    """REF, longitudinal: R-50-like, one slow unstable mode."""
    return lon(REF_LON)


def ref_lat() -> Model:
    """REF, lateral."""
    return lat(REF_LAT)


def ref_yaw_heave() -> Model:
    """REF, yaw and heave: stable."""
    return yaw_heave(REF_YAW_HEAVE)


def ref_13() -> Model:
    """REF with all 13 states and four inputs, in the order of Eq. (6)."""
    return semi_decoupled(ref_lon(), ref_lat(), ref_yaw_heave())


def table1_lon() -> Model:
    """Table 1 as printed, longitudinal: unstable (+0.870 1/s), for identification only."""
    return lon(TABLE1_LON)


def table1_lat() -> Model:
    """Table 1 as printed, lateral: unstable (+3.139 1/s), for identification only."""
    return lat(TABLE1_LAT)


def _rotor_axis(values: list[float], gravity: float, states: tuple[str, ...]) -> Model:
    x_u, x_a, x_lon, x_lat, m_u, m_a, m_lon, m_lat, a_c, a_lon, a_lat, c_lon, c_lat, tau_f, tau_s = values
    if not (tau_f > 0.0 and tau_s > 0.0):
        raise ConfigError(f"rotor and bar time constants must be > 0 s, got tau_f {tau_f:g}, tau_s {tau_s:g}")
    a = np.array(
        [
            [x_u, 0.0, gravity, x_a, 0.0],
            [m_u, 0.0, 0.0, m_a, 0.0],
            [0.0, 1.0, 0.0, 0.0, 0.0],
            [0.0, -1.0, 0.0, -1.0 / tau_f, a_c / tau_f],
            [0.0, -1.0, 0.0, 0.0, -1.0 / tau_s],
        ]
    )
    b = np.array([[x_lon, x_lat], [m_lon, m_lat], [0.0, 0.0], [a_lon, a_lat], [c_lon, c_lat]])
    return Model(a, b, np.eye(3, 5), states, ("lon", "lat"), states[:3])


def _values(p: Mapping[str, float], names: tuple[str, ...]) -> list[float]:
    missing = [name for name in names if name not in p]
    if missing:
        raise ConfigError(f"hover model: parameters {', '.join(missing)} are missing; expected {', '.join(names)}")
    return [float(p[name]) for name in names]
