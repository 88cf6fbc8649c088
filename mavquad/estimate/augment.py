"""A linear model joined by its own model error: what the ASMF runs on (design time, dense numpy).

Source: Song et al. 2011 (paper 004), Eqs. (6), (25): x' = A x + B u + k(y) + B_f f, f' = w_f, held inputs.

Deviations from the paper:
  Eq. (25)  B_f is discretised like B; as printed f would be the change per sample, 1/Ts times smaller.
  Eq. (6)   B_f = I cannot be told apart by eight outputs; B_f picks the rows that `rows` names.
  no text   k(y): the terms known from measurements enter through the same hold, `known`.
"""

from typing import NamedTuple

import numpy as np

from mavquad.errors import ConfigError
from mavquad.statespace import zoh


class Augmented(NamedTuple):
    """z = (x, f): z(k+1) = F z + G u + known k(y), y = C z."""

    f: np.ndarray  # (n + n_f, n + n_f)
    g: np.ndarray  # (n + n_f, n_u)
    known: np.ndarray  # (n + n_f, n)
    c: np.ndarray  # (n_y, n + n_f)


def with_model_error(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, states: tuple[str, ...], rows: tuple[str, ...], dt_s: float
) -> Augmented:
    """Join x' = A x + B u by one model error for each name in `rows`. a (n, n), b (n, m), c (p, n), names of the n states.

    Raises ConfigError where `rows` names a state that is not there or an error that the outputs cannot tell apart.
    """
    unknown = [row for row in rows if row not in states]
    if unknown:
        raise ConfigError(f"model error on {', '.join(unknown)}: no such state; known: {', '.join(states)}")
    n, n_f = a.shape[0], len(rows)
    b_f = np.zeros((n, n_f))
    for k, row in enumerate(rows):
        b_f[states.index(row), k] = 1.0
    rank = rank_with_constant_error(a, b_f, c)
    if rank < n + n_f:
        raise ConfigError(
            f"model error on {', '.join(rows)}: {n + n_f} unknowns, but the {c.shape[0]} outputs tell only {rank} apart;"
            " take fewer rows"
        )
    a_d, b_d = zoh(a, np.hstack([b, b_f, np.eye(n)]), dt_s)
    m = b.shape[1]
    f = np.block([[a_d, b_d[:, m : m + n_f]], [np.zeros((n_f, n)), np.eye(n_f)]])
    g = np.vstack([b_d[:, :m], np.zeros((n_f, m))])
    known = np.vstack([b_d[:, m + n_f :], np.zeros((n_f, n))])
    return Augmented(f, g, known, np.hstack([c, np.zeros((c.shape[0], n_f))]))


def rank_with_constant_error(a: np.ndarray, b_f: np.ndarray, c: np.ndarray) -> int:
    """Rank of [A B_f; C 0]: n + n_f where a constant model error can be told from the state (Hautus test at eigenvalue 0)."""
    return int(np.linalg.matrix_rank(np.block([[a, b_f], [c, np.zeros((c.shape[0], b_f.shape[1]))]])))
