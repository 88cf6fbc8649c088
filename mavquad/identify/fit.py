"""A frequency response becomes a model: two costs, several starts, and the spread of every parameter.

Source: Song et al. 2011 (paper 004), Eqs. (14)-(17), (22)-(24); weights after Tischler & Cauffman.

Deviations from the paper:
  Eq. (16)  the model is sampled, C(e^{jw Ts} I - Ad)^-1 Bd, as the held input and the sampled output are.
  Eq. (17)  weights written out: dB and degrees, 1 and 0.01745, times [1.58 (1 - exp(-g2))]^2. It serves to report; the estimate
            comes from the maximum likelihood residuals, log(T/H) over its standard deviation.
  Eq. (22)  the step is measured before it is scaled by alpha: a small alpha would "converge" anywhere.
  step 5    the relaxation alternates odd and even frequencies: on the same data nothing would change.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import scipy.linalg
from scipy.optimize import least_squares

from mavquad.errors import LogError
from mavquad.identify import structures
from mavquad.identify.models import Model
from mavquad.identify.spectrum import Response
from mavquad.identify.start import Family, families
from mavquad.identify.structures import Structure

Cost = Literal["ml", "cifer"]
SD_FLOOR = 0.002
COHERENCE_FLOOR = 0.5
FEWEST_POINTS = 5
CHI2_BAND = (0.7, 1.6)  # outside, the spread is scaled and the model flagged


class Fit(NamedTuple):
    """A fitted structure with its honesty: spread, correlation, agreement of the starts."""

    structure: Structure
    theta: np.ndarray  # (n,)
    sd: np.ndarray  # (n,) with what neighbouring frequencies and outputs share
    bound: np.ndarray  # (n,) Cramer-Rao, as if every residual stood alone
    correlation: np.ndarray  # (n, n)
    chi2: float
    j: float  # Eq. (17)
    ml: float  # sum of squared ML residuals
    agreeing: int  # starts whose cost is within 1 % of the best
    starts: int
    evaluations: int

    @property
    def parameters(self) -> dict[str, float]:
        return structures.values(self.structure, self.theta)

    @property
    def cr_pct(self) -> dict[str, float]:
        return dict(zip(self.structure.free, 100.0 * self.bound / np.maximum(np.abs(self.theta), 1e-12), strict=True))

    @property
    def trusted(self) -> bool:
        """chi2 in its band and at least two starts (where there were two) in one minimum."""
        return CHI2_BAND[0] <= self.chi2 <= CHI2_BAND[1] and self.agreeing >= min(2, self.starts)


# ---- the model's response --------------------------------------------------------------------------------------------
def sampled_response(model: Model, omega_rad_s: np.ndarray, dt_s: float) -> np.ndarray:
    """(K, p, m): the response of the sampled model to an input held over each `dt_s`."""
    return _responses(model.a[None], model.b[None], model.c, np.asarray(omega_rad_s, dtype=float), dt_s)[0]


def continuous_response(model: Model, omega_rad_s: np.ndarray) -> np.ndarray:
    """(K, p, m): Eq. (16) as printed."""
    return _solve(model.a[None], model.b[None], model.c, 1j * np.asarray(omega_rad_s, dtype=float))[0]


def discretized(a: np.ndarray, b: np.ndarray, dt_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact Ad, Bd under a held input; leading axes are a batch."""
    n, m = b.shape[-2:]
    block = np.zeros((*a.shape[:-2], n + m, n + m))
    block[..., :n, :n] = a
    block[..., :n, n:] = b
    step = scipy.linalg.expm(block * dt_s)
    return step[..., :n, :n], step[..., :n, n:]


def _responses(a: np.ndarray, b: np.ndarray, c: np.ndarray, omega: np.ndarray, dt_s: float | None) -> np.ndarray:
    if dt_s is None:
        return _solve(a, b, c, 1j * omega)
    ad, bd = discretized(a, b, dt_s)
    return _solve(ad, bd, c, np.exp(1j * omega * dt_s))


def _solve(a: np.ndarray, b: np.ndarray, c: np.ndarray, z: np.ndarray) -> np.ndarray:
    """C (z I - A)^-1 B for a batch of models and all z: (P, K, p, m)."""
    n = a.shape[-1]
    shifted = z[None, :, None, None] * np.eye(n) - a[:, None]
    return c @ np.linalg.solve(shifted, np.broadcast_to(b[:, None], (a.shape[0], z.size, *b.shape[1:])).astype(complex))


# ---- residuals -------------------------------------------------------------------------------------------------------
class Problem(NamedTuple):
    """One response to be fitted by one structure: what is used of it, and how it is weighted."""

    structure: Structure
    response: Response
    sampled: bool
    use: np.ndarray  # (K, p, m) bool
    target: np.ndarray  # (N,) complex, the points used
    sd: np.ndarray  # (N,) floored
    cifer: np.ndarray  # (N,) square root of the weight of Eq. (17), for an error in dB


def problem(structure: Structure, response: Response, *, sampled: bool = True, bins: slice = slice(None)) -> Problem:
    """Choose the points: coherence at least 0.5, pairs with at least five of them. Raises LogError where too few are left."""
    use = (response.coherence >= COHERENCE_FLOOR) & (np.abs(response.h) > 0.0) & np.isfinite(response.sd)
    wanted = np.zeros(response.omega_rad_s.size, dtype=bool)
    wanted[bins] = True
    use &= wanted[:, None, None]
    points = use.sum(axis=0)
    use &= points >= FEWEST_POINTS
    points = use.sum(axis=0)
    if 2 * use.sum() <= len(structure.free):
        raise LogError(
            f"{structure.name}: {int(use.sum())} frequency points with coherence >= {COHERENCE_FLOOR} for"
            f" {len(structure.free)} parameters; sweep with a larger amplitude"
        )
    pairs = int(np.count_nonzero(points))
    g2 = response.coherence[use]
    per_pair = np.broadcast_to(np.maximum(points, 1), use.shape)[use]
    cifer = 1.58 * (1.0 - np.exp(-g2)) * np.sqrt(20.0 / (pairs * per_pair))
    return Problem(structure, response, sampled, use, response.h[use], np.maximum(response.sd[use], SD_FLOOR), cifer)


def _errors(task: Problem, thetas: np.ndarray) -> np.ndarray:
    """log(T/H) at the points used for a batch of parameter sets: (P, N) complex."""
    structure, response = task.structure, task.response
    named = [structures.values(structure, theta) for theta in thetas]
    built = [structure.build(p) for p in named]
    t = _responses(
        np.stack([model.a for model in built]),
        np.stack([model.b for model in built]),
        built[0].c,
        response.omega_rad_s,
        response.dt_s if task.sampled else None,
    )
    delays = np.stack([structures.delays_s(structure, p) for p in named])
    if np.any(delays):
        t = t * np.exp(-1j * response.omega_rad_s[None, :, None] * delays[:, None, :])[:, :, None, :]
    ratio = t[:, task.use] / task.target
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.log(ratio)
    return np.where(np.isfinite(error), error, 1e3)


def _weighted(task: Problem, errors: np.ndarray, cost: Cost) -> np.ndarray:
    """Real residuals (P, 2N) whose sum of squares is the cost."""
    if cost == "ml":
        scaled = errors / task.sd
        return np.concatenate([scaled.real, scaled.imag], axis=-1)
    db = errors.real * (20.0 / np.log(10.0)) * task.cifer
    degrees = np.degrees(errors.imag) * np.sqrt(0.01745) * task.cifer
    return np.concatenate([db, degrees], axis=-1)


def residuals(task: Problem, theta: np.ndarray, cost: Cost = "ml") -> np.ndarray:
    """The residuals (2N,) of one parameter set."""
    return _weighted(task, _errors(task, theta[None]), cost)[0]


def jacobian(task: Problem, theta: np.ndarray, cost: Cost = "ml") -> np.ndarray:
    """d residuals / d theta (2N, n) by central differences, all parameter sets in one batch."""
    step = 1e-6 * np.maximum(np.abs(theta), 0.05)
    shifts = np.diag(step)
    forward, backward = _errors(task, theta + shifts), _errors(task, theta - shifts)
    slope = forward - backward
    slope = slope.real + 1j * ((slope.imag + np.pi) % (2.0 * np.pi) - np.pi)  # neither side of the cut
    return (_weighted(task, slope, cost) / (2.0 * step[:, None])).T


def cost_of(task: Problem, theta: np.ndarray, cost: Cost = "ml") -> float:
    return float(np.sum(residuals(task, theta, cost) ** 2))


# ---- the search ------------------------------------------------------------------------------------------------------
def minimise(task: Problem, start: np.ndarray, cost: Cost = "ml", evaluations: int = 80) -> tuple[np.ndarray, float, int]:
    """Trust region search from one start: parameters, cost, evaluations spent."""
    lo, hi = structures.limits(task.structure)
    inside = np.clip(start, np.where(np.isfinite(lo), lo + 1e-9, lo), np.where(np.isfinite(hi), hi - 1e-9, hi))
    found = least_squares(
        lambda theta: residuals(task, theta, cost),
        inside,
        jac=lambda theta: jacobian(task, theta, cost),
        method="trf",
        x_scale=np.maximum(np.abs(inside), 0.05),
        bounds=(lo, hi),
        max_nfev=evaluations,
    )
    return found.x, 2.0 * float(found.cost), int(found.nfev)


def ranked_starts(task: Problem, groups: Sequence[Family]) -> list[np.ndarray]:
    """The best start of every family in the ML cost, best first."""
    best = []
    for family in groups:
        costs = [cost_of(task, start) for start in family.starts]
        k = int(np.argmin(costs))
        best.append((costs[k], family.starts[k]))
    return [start for _, start in sorted(best, key=lambda pair: pair[0])]


def fit(
    structure: Structure,
    response: Response,
    *,
    starts: Sequence[np.ndarray] | None = None,
    cost: Cost = "ml",
    sampled: bool = True,
    evaluations: int = 80,
) -> Fit:
    """Fit from every start (the regression's own unless given) and keep the smallest cost. Raises LogError on too little data.

    Where fewer than two of the regression's starts end in the same minimum, or that minimum does not explain the data (chi2 above
    1.6), more of them are tried.
    """
    task = problem(structure, response, sampled=sampled)

    def search(these: Sequence[np.ndarray]) -> list[tuple[np.ndarray, float, int]]:
        return [minimise(task, start, cost, evaluations) for start in these]

    runs = search(ranked_starts(task, families(structure, response)) if starts is None else starts)
    best = min(runs, key=lambda run: run[1])
    if starts is None and (_agreeing(runs) < 2 or _chi2(task, cost_of(task, best[0])) > CHI2_BAND[1]):
        runs += search(ranked_starts(task, families(structure, response, between=True)))
        best = min(runs, key=lambda run: run[1])
    return _finished(task, best[0], _agreeing(runs), len(runs), sum(run[2] for run in runs))


def _agreeing(runs: Sequence[tuple[np.ndarray, float, int]]) -> int:
    least = min(run[1] for run in runs)
    return sum(run[1] <= 1.01 * least + 1e-9 for run in runs)


def relaxed(
    structure: Structure, response: Response, theta: np.ndarray, *, alpha: float = 0.4, rounds: int = 20
) -> tuple[np.ndarray, int]:
    """Eqs. (23)-(24): th <- (1-a) th + a th_bar over odd and even frequencies in turn, then once over all; rounds used.

    It ends when th_bar differs from th by less than 1e-3 on the same half as before (not multiplied by alpha).
    """
    halves = [problem(structure, response, bins=slice(k, None, 2)) for k in (0, 1)]
    bars: list[np.ndarray | None] = [None, None]
    for s in range(rounds):
        bar, _, _ = minimise(halves[s % 2], theta)
        previous = bars[s % 2]
        bars[s % 2] = bar
        theta = (1.0 - alpha) * theta + alpha * bar
        if previous is not None and np.max(np.abs(bar - previous) / np.maximum(np.abs(bar), 0.05)) < 1e-3:
            break
    theta, _, _ = minimise(problem(structure, response), theta)
    return theta, s + 1


def _chi2(task: Problem, ml: float) -> float:
    return ml / max(1, 2 * task.target.size - len(task.structure.free))


def _finished(task: Problem, theta: np.ndarray, agreeing: int, starts: int, evaluations: int) -> Fit:
    r = residuals(task, theta)
    slope = jacobian(task, theta)
    scale = np.maximum(np.linalg.norm(slope, axis=0), 1e-300)
    inverse = np.linalg.pinv(slope / scale)
    cov = inverse @ inverse.T / np.outer(scale, scale)
    chi2 = _chi2(task, float(r @ r))
    bound = np.sqrt(np.diag(cov))
    correlation = cov / np.outer(bound, bound)
    sd = bound
    if task.response.covariance is not None:
        pull = inverse / scale[:, None]
        sd = np.sqrt(np.diag(pull @ _residual_covariance(task) @ pull.T))
    if not CHI2_BAND[0] <= chi2 <= CHI2_BAND[1]:
        sd, bound = sd * np.sqrt(chi2), bound * np.sqrt(chi2)
    j = cost_of(task, theta, "cifer")
    return Fit(task.structure, theta, sd, bound, correlation, chi2, j, float(r @ r), agreeing, starts, evaluations)


def _residual_covariance(task: Problem) -> np.ndarray:
    """(2N, 2N) of the ML residuals: circular noise, so real and imaginary parts share half of the complex covariance."""
    n = task.use.size
    used = np.flatnonzero(task.use)
    assert task.response.covariance is not None
    c = task.response.covariance.reshape(n, n)[np.ix_(used, used)] / np.outer(task.sd, task.sd)
    return 0.5 * np.block([[c.real, -c.imag], [c.imag, c.real]])


# ---- what cannot be told from this record ----------------------------------------------------------------------------
INSENSITIVE_PCT = 40.0
ALIKE = 0.98


def reduced(found: Fit, response: Response) -> tuple[Fit, list[str]]:
    """Fix what the record does not tell (Cramer-Rao above 40 %), tie what it cannot tell apart (correlation above 0.98), refit.

    One change at a time, the worst first; returns the last fit and what was done, in words.
    """
    done: list[str] = []
    while True:
        structure, cr = found.structure, found.cr_pct
        worst = max(cr, key=lambda name: cr[name])
        pair = _most_alike(found)
        if cr[worst] > INSENSITIVE_PCT and len(structure.free) > 1:
            held = found.parameters[worst] if worst.startswith("tau") or worst in structure.bounds else 0.0
            structure = structures.fix(structure, worst, held)
            done.append(
                f"{worst} = {found.parameters[worst]:.4g} +- {cr[worst]:.0f} % cannot be told from this record: held at {held:.4g}"
            )
        elif pair is not None:
            name, of = pair
            ratio = found.parameters[name] / found.parameters[of]
            structure = structures.tie(structure, name, of, ratio)
            done.append(f"{name} and {of} cannot be told apart (correlation above {ALIKE}): tied at {ratio:.4g}")
        else:
            return found, done
        start = structures.theta_of(structure, found.parameters)
        found = fit(structure, response, starts=[start])


def _most_alike(found: Fit) -> tuple[str, str] | None:
    size = np.abs(np.triu(found.correlation, 1))
    i, j = np.unravel_index(int(np.argmax(size)), size.shape)
    free = found.structure.free
    if size[i, j] <= ALIKE or found.theta[i] == 0.0:
        return None
    return free[j], free[i]
