"""Start values without a guess: separable equation-error regression on a measured frequency response.

Source: Song et al. 2011 (paper 004), Eqs. (18)-(21).

Deviations from the paper:
  Eqs. (18)-(21)  nobody measures the rotor states; they are eliminated. For given time constants the moment equation is linear in
                  products of the parameters, every column of H is one experiment, and a grid of time constants gives several starts.
  Theorem 1       these starts are neither unbiased nor consistent: they are starts. Noise in the regressors pulls them towards zero,
                  so a point weighs by its variance, not by its deviation: noisy ones then hardly count.
"""

from typing import NamedTuple

import numpy as np

from mavquad.identify import structures
from mavquad.identify.models import G_M_S2
from mavquad.identify.spectrum import Response
from mavquad.identify.structures import Structure

HIGHEST_RAD_S = 15.0
SD_FLOOR = 0.005


class Family(NamedTuple):
    """The starts that share a first time constant: of each such family the best is kept."""

    starts: tuple[np.ndarray, ...]


def families(structure: Structure, response: Response, *, between: bool = False) -> list[Family]:
    """Starts for a rotor axis (outputs speed, rate, angle) or for yaw and heave, grouped by their first time constant.

    Seven families; with `between` the six that lie between those, for when the seven do not agree.
    """

    def grid(lo: float, hi: float) -> np.ndarray:
        return np.geomspace(lo, hi, 13)[1::2] if between else np.geomspace(lo, hi, 7)

    if "K_rfb" in structure.free:
        return [Family((_yaw_heave(structure, response, k),)) for k in grid(1.0, 30.0)]
    if "tau_s" in structure.free:
        slow = np.geomspace(0.18, 1.2, 6)
        return [Family(tuple(_rotor(structure, response, f, s) for s in slow)) for f in grid(0.02, 0.15)]
    return [Family((_rotor(structure, response, tau, tau),)) for tau in grid(0.1, 1.5)]


def literal_regression(state: np.ndarray, columns: np.ndarray, dt_s: float) -> np.ndarray:
    """One row of Eqs. (18)-(21) as printed, forward Euler on measured columns (N, n) of one state (N,); for comparison."""
    theta, *_ = np.linalg.lstsq(columns[:-1], np.diff(state) / dt_s, rcond=None)
    return theta


class _Rows:
    """Weighted complex rows of one regression, solved over the reals."""

    def __init__(self) -> None:
        self.phi: list[np.ndarray] = []
        self.target: list[np.ndarray] = []

    def add(self, target: np.ndarray, columns: list[np.ndarray], sd: np.ndarray) -> None:
        weight = 1.0 / (np.abs(target) * np.maximum(sd, SD_FLOOR) ** 2)
        self.phi.append(np.stack(columns, axis=1) * weight[:, None])
        self.target.append(target * weight)

    def solve(self) -> np.ndarray:
        phi, target = np.vstack(self.phi), np.concatenate(self.target)
        real = np.vstack([phi.real, phi.imag])
        scale = np.maximum(np.linalg.norm(real, axis=0), 1e-300)
        solution, *_ = np.linalg.lstsq(real / scale, np.concatenate([target.real, target.imag]), rcond=None)
        return solution / scale


def _band(response: Response) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the band, s, and the spectrum of a held unit input."""
    index = np.flatnonzero(response.omega_rad_s <= HIGHEST_RAD_S)
    s = 1j * response.omega_rad_s[index]
    return index, s, -np.expm1(-s * response.dt_s) / (s * response.dt_s)


def _rotor(structure: Structure, response: Response, tau_f: float, tau_s: float) -> np.ndarray:
    speed_row, moment_row, flap_row = _NAMES[structure.outputs[0]]
    index, s, d = _band(response)
    f, bar = 1.0 / (s + 1.0 / tau_f), 1.0 / (s + 1.0 / tau_s)
    direct = moment_row[2] in structure.free
    held = np.zeros_like(d)
    rows = _Rows()
    for j in range(2):
        h = response.h[index, :, j]
        lon, lat = (d, held) if j == 0 else (held, d)
        rate = h[:, 1]
        columns = [h[:, 0], -f * rate, f * lon, f * lat, -f / tau_f * bar * rate, f / tau_f * bar * lon, f / tau_f * bar * lat]
        if direct:
            columns += [lon, lat]
        rows.add(s * rate, columns, response.sd[index, 1, j])
    k = rows.solve()
    m_a, m_c = k[1], k[4]
    p = dict(structure.fixed)
    p.update({moment_row[0]: k[0], moment_row[1]: m_a, "tau_f": tau_f, "tau_s": tau_s})
    if direct:
        p.update({moment_row[2]: k[7], moment_row[3]: k[8]})
    flap = [m_c / m_a, k[2] / m_a, k[3] / m_a, k[5] / m_c, k[6] / m_c]  # bar gain, control to rotor, control to bar
    p.update(zip(flap_row, flap, strict=True))
    rows = _Rows()
    gravity = -G_M_S2 if structure.outputs[0] == "u" else G_M_S2
    for j in range(2):
        h = response.h[index, :, j]
        lon, lat = (d, held) if j == 0 else (held, d)
        bar_angle = bar * (-h[:, 1] + flap[3] * lon + flap[4] * lat)
        angle = f * (-h[:, 1] + flap[0] / tau_f * bar_angle + flap[1] * lon + flap[2] * lat)
        forces = {speed_row[0]: h[:, 0], speed_row[1]: angle, speed_row[2]: lon, speed_row[3]: lat}
        known = gravity * h[:, 2] + sum(p[name] * column for name, column in forces.items() if name in structure.fixed)
        free = [name for name in speed_row if name in structure.free]
        rows.add(s * h[:, 0] - known, [forces[name] for name in free], _relative(response, index, j, s, known))
    p.update(zip(free, rows.solve(), strict=True))
    return structures.theta_of(structure, p)


def _relative(response: Response, index: np.ndarray, j: int, s: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The spread of s u - known relative to its own size, so that the weight is that of s u."""
    whole = s * response.h[index, 0, j]
    return np.maximum(response.sd[index, 0, j], SD_FLOOR) * np.abs(whole) / np.maximum(np.abs(whole - known), 1e-300)


_NAMES = {
    "u": (("X_u", "X_a", "X_lon", "X_lat"), ("M_u", "M_a", "M_lon", "M_lat"), ("A_c", "A_lon", "A_lat", "C_lon", "C_lat")),
    "v": (("Y_v", "Y_b", "Y_lon", "Y_lat"), ("L_v", "L_b", "L_lon", "L_lat"), ("B_d", "B_lon", "B_lat", "D_lon", "D_lat")),
}


def _yaw_heave(structure: Structure, response: Response, k_rfb: float) -> np.ndarray:
    index, s, d = _band(response)
    held = np.zeros_like(d)
    p = {**structure.fixed, "K_rfb": k_rfb}
    heave, yaw = _Rows(), _Rows()
    free = [name for name in ("Z_w", "Z_r", "Z_ped", "Z_col") if name in structure.free]
    for j in range(2):
        w, r = response.h[index, 0, j], response.h[index, 1, j]
        ped, col = (d, held) if j == 0 else (held, d)
        forces = {"Z_w": w, "Z_r": r, "Z_ped": ped, "Z_col": col}
        known = sum((p[name] * forces[name] for name in forces if name in p), start=np.zeros_like(d))
        heave.add(s * w - known, [forces[name] for name in free], response.sd[index, 0, j])
        yaw.add(s * r, [w, r, ped, -r / (s + k_rfb), col], response.sd[index, 1, j])
    p.update(zip(free, heave.solve(), strict=True))
    n_w, n_r, n_ped, product, n_col = yaw.solve()
    p.update({"N_w": n_w, "N_r": n_r, "N_ped": n_ped, "K_r": product / n_ped, "N_col": n_col})
    return structures.theta_of(structure, p)
