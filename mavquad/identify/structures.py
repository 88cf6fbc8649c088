"""What of a hover model is to be found: which parameters are free, which are held, tied or bounded.

Source: Song et al. 2011 (paper 004), Eqs. (3)-(5) and Table 1.

Deviations from the paper:
  section 1  REF holds X_a = -g, Y_b = +g and the direct control forces at zero; Table 1 frees them and ties tau_s to tau_f.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mavquad.errors import ConfigError
from mavquad.identify import models

DELAY = "delay_"  # prefix of a free pure delay (s) per input


class Structure(NamedTuple):
    name: str
    build: Callable[[Mapping[str, float]], models.Model]
    free: tuple[str, ...]
    fixed: Mapping[str, float]
    tied: Mapping[str, tuple[str, float]]  # name -> (of, ratio): value = ratio * value(of)
    bounds: Mapping[str, tuple[float, float]]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


TAU_BOUNDS_REF = {"tau_f": (0.01, 0.2), "tau_s": (0.12, 2.0)}

REF_LON = Structure(
    "REF-lon", models.lon,
    ("X_u", "M_u", "M_a", "A_c", "A_lon", "A_lat", "C_lon", "C_lat", "tau_f", "tau_s"),
    {"X_a": -models.G_M_S2, "X_lon": 0.0, "X_lat": 0.0, "M_lon": 0.0, "M_lat": 0.0},
    {}, {"M_a": (1.0, 1000.0), **TAU_BOUNDS_REF}, ("lon", "lat"), ("u", "q", "theta"),
)  # fmt: skip
REF_LAT = Structure(
    "REF-lat", models.lat,
    ("Y_v", "L_v", "L_b", "B_d", "B_lon", "B_lat", "D_lon", "D_lat", "tau_f", "tau_s"),
    {"Y_b": models.G_M_S2, "Y_lon": 0.0, "Y_lat": 0.0, "L_lon": 0.0, "L_lat": 0.0},
    {}, {"L_b": (1.0, 1000.0), **TAU_BOUNDS_REF}, ("lon", "lat"), ("v", "p", "phi"),
)  # fmt: skip
REF_YAW = Structure(
    "REF-yaw", models.yaw_heave,
    ("Z_w", "Z_r", "N_w", "N_r", "N_ped", "K_r", "K_rfb", "Z_col", "N_col"), {"Z_ped": 0.0},
    {}, {"K_rfb": (0.1, 100.0)}, ("ped", "col"), ("w", "r"),
)  # fmt: skip
T1_LON = Structure(
    "T1-lon", models.lon, models.LON_NAMES[:-1], {}, {"tau_s": ("tau_f", 1.0)},
    {"M_a": (1.0, 1000.0), "tau_f": (0.05, 2.0)}, ("lon", "lat"), ("u", "q", "theta"),
)  # fmt: skip
T1_LAT = Structure(
    "T1-lat", models.lat, models.LAT_NAMES[:-1], {}, {"tau_s": ("tau_f", 1.0)},
    {"L_b": (1.0, 1000.0), "tau_f": (0.05, 2.0)}, ("lon", "lat"), ("v", "p", "phi"),
)  # fmt: skip


def values(structure: Structure, theta: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Every parameter by name: free ones from `theta`, then the fixed, then the tied."""
    p = dict(zip(structure.free, (float(x) for x in theta), strict=True))
    p.update(structure.fixed)
    for name, (of, ratio) in structure.tied.items():
        p[name] = ratio * p[of]
    return p


def theta_of(structure: Structure, p: Mapping[str, float]) -> np.ndarray:
    """The free parameters (n,) out of a full set, inside their bounds."""
    lo, hi = limits(structure)
    return np.clip([p[name] for name in structure.free], lo, hi)


def limits(structure: Structure) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds (n,) of the free parameters."""
    pairs = [structure.bounds.get(name, (-np.inf, np.inf)) for name in structure.free]
    return np.array([lo for lo, _ in pairs]), np.array([hi for _, hi in pairs])


def fix(structure: Structure, name: str, value: float) -> Structure:
    """The same structure with one free parameter held, and what was tied to it. Raises ConfigError for a name that is not free."""
    _free(structure, name)
    followers = {other: ratio * value for other, (of, ratio) in structure.tied.items() if of == name}
    return structure._replace(
        free=tuple(x for x in structure.free if x != name),
        fixed={**structure.fixed, name: value, **followers},
        tied={other: to for other, to in structure.tied.items() if other not in followers},
    )


def tie(structure: Structure, name: str, of: str, ratio: float) -> Structure:
    """The same structure with one free parameter, and what was tied to it, a multiple of another free one."""
    _free(structure, name)
    _free(structure, of)
    followers = {other: (of, r * ratio) for other, (to, r) in structure.tied.items() if to == name}
    return structure._replace(
        free=tuple(x for x in structure.free if x != name), tied={**structure.tied, **followers, name: (of, ratio)}
    )


def with_delays(structure: Structure, longest_s: float = 0.1, least_s: float = 0.0) -> Structure:
    """The same structure with one free pure delay per input, least_s..longest_s (below zero: inputs may be stamped late)."""
    names = tuple(DELAY + x for x in structure.inputs)
    return structure._replace(
        free=structure.free + names, bounds={**structure.bounds, **{name: (least_s, longest_s) for name in names}}
    )


def delays_s(structure: Structure, p: Mapping[str, float]) -> np.ndarray:
    """The pure delay of every input (m,), zero where the structure has none."""
    return np.array([p.get(DELAY + x, 0.0) for x in structure.inputs])


def _free(structure: Structure, name: str) -> None:
    if name not in structure.free:
        raise ConfigError(f"{structure.name}: {name} is not free; free are {', '.join(structure.free)}")
