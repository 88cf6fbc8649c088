"""The attitude response of an autopilot from a log: gain, natural frequency, damping and delay from setpoint to attitude.

Source: identification note, section 7 ("multirotor companion"); method of Song et al. 2011 (paper 004), section 2.

Two inputs, never mixed: SET_ATTITUDE_TARGET (the command as sent: what a companion meets) and ATTITUDE_TARGET (what the autopilot
made of it: on ArduCopter after its own input shaping, the inner loop only).

Deviations from the paper:
  Eq. (16)  the command is piecewise constant at irregular times: its exact mean over every sample interval stands for it, and the
            known factor of that mean is taken out of the response, which is therefore that of the continuous system.
  Eq. (17)  weights from the measured spread, floored at 2 %: a real autopilot's shaping is not linear.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from mavquad.errors import LogError
from mavquad.identify import spectrum, timebase
from mavquad.identify.spectrum import Record, Response
from mavquad.identify.timebase import Held, Sampled

SD_FLOOR = 0.02
COHERENT = 0.8  # points below are not fitted
FEWEST_POINTS = 8
SLOWEST_PERIOD_S = 0.06  # of the telemetry: below 17 Hz the phase of an attitude loop is not told
EXCITED_RAD = 0.01  # least standard deviation of the command
HIGHEST_RAD_S = 300.0  # of the search
FASTEST_RAD_S = 150.0  # above, wn lies outside any band that is swept
Span = tuple[float, float]


class SecondOrder(NamedTuple):
    """gain wn^2 / (s^2 + 2 zeta wn s + wn^2) e^(-s delay), each with its standard deviation."""

    gain: float
    omega_n_rad_s: float
    zeta: float
    delay_s: float
    sd: tuple[float, float, float, float]
    chi2: float
    points: int


class Axis(NamedTuple):
    """One axis of one input: what was measured, what was fitted, how it predicts."""

    model: SecondOrder
    response: Response
    f_hz: np.ndarray  # of the ordinary coherence over 10 s segments
    coherence: np.ndarray
    fitted_from: tuple[Span, ...]
    offset_rad: float  # attitude at zero command: trim


def measured(
    u: Held, y: Sampled, spans: Sequence[Span], lo_hz: float, hi_hz: float, count: int = 40, what: str = "attitude"
) -> tuple[Response, list[Record]]:
    """The continuous response from a held command to a sampled answer (`what`) over the given spans of time, and its even records.

    Raises LogError where the telemetry is too slow, full of gaps, or the command does not move.
    """
    steady = timebase.rhythm(y.t_s)
    if steady.period_s > SLOWEST_PERIOD_S:
        raise LogError(
            f"{what} comes at {1 / steady.period_s:.1f} Hz; needs {1 / SLOWEST_PERIOD_S:.0f} Hz or more, 50-100 Hz is good"
        )
    dt = steady.period_s
    records = []
    for start, end in spans:
        for a, b in whole_parts(start, end, steady.gaps):
            if b - a < spectrum.SHORTEST_S:
                continue
            t = a + dt * np.arange(int((b - a) / dt))
            mean = timebase.held_mean(u, np.append(t, t[-1] + dt))[:, None]
            records.append(Record(dt, mean, mean, np.interp(t, y.t_s, y.value)[:, None]))
    if not records:
        raise LogError(
            f"no stretch of {spectrum.SHORTEST_S:g} s without a gap in both command and {what}; record a sweep of 70 s"
        )
    moved = max(float(np.std(record.r)) for record in records)
    if moved < EXCITED_RAD:
        told = f"{np.degrees(moved):.2f} deg" if what == "attitude" else f"{100.0 * moved:.2f} % of full"
        needs = f"{np.degrees(EXCITED_RAD):.1f} deg" if what == "attitude" else f"{100.0 * EXCITED_RAD:.0f} %"
        raise LogError(f"the command moves by {told} rms only (needs {needs}); record a sweep")
    longest = max(len(record.r) for record in records) * dt
    lo = max(lo_hz, 1.0 / longest)
    hi = min(hi_hz, 0.35 / dt)
    found = spectrum.lpm(records, 2.0 * np.pi * np.geomspace(lo, hi, count))
    s = 1j * found.omega_rad_s
    mean_factor = (np.expm1(s * dt) / (s * dt))[:, None, None]
    return found._replace(h=found.h * mean_factor), records


def second_order(p: Sequence[float] | np.ndarray, omega_rad_s: np.ndarray) -> np.ndarray:
    """(K,) response of (gain, wn, zeta, delay)."""
    gain, wn, zeta, delay = p
    s = 1j * omega_rad_s
    return gain * wn**2 / (s * s + 2.0 * zeta * wn * s + wn**2) * np.exp(-s * delay)


def fit_second_order(response: Response) -> SecondOrder:
    """Weighted fit of log(model/measured) from several starts. Raises LogError on fewer than eight coherent points."""
    h, sd, g2 = response.h[:, 0, 0], response.sd[:, 0, 0], response.coherence[:, 0, 0]
    use = (g2 >= COHERENT) & (np.abs(h) > 0.0)
    if use.sum() < FEWEST_POINTS:
        raise LogError(
            f"{int(use.sum())} of {use.size} frequencies are coherent (needs {FEWEST_POINTS}); sweep longer or larger"
        )
    if np.median(h[use][: max(3, int(use.sum()) // 4)].real) < 0.0:
        raise LogError("the attitude moves against the command: the two have different sign conventions, or the wrong axis")
    omega, target, weight = response.omega_rad_s[use], h[use], 1.0 / np.maximum(sd[use], SD_FLOOR)

    def residuals(p: np.ndarray) -> np.ndarray:
        error = np.log(second_order(p, omega) / target) * weight
        return np.concatenate([error.real, error.imag])

    runs = [
        least_squares(
            residuals,
            (1.0, wn, 0.8, delay),
            x_scale=(1.0, 5.0, 0.5, 0.05),
            bounds=([0.05, 0.3, 0.05, 0.0], [5, HIGHEST_RAD_S, 5, 0.5]),
        )
        for wn in (3.0, 8.0, 20.0)
        for delay in (0.01, 0.1)
    ]
    best = min(runs, key=lambda run: float(run.cost))
    chi2 = 2.0 * float(best.cost) / max(1, 2 * int(use.sum()) - 4)
    covariance = np.linalg.pinv(best.jac.T @ best.jac) * max(1.0, chi2)
    sd = np.sqrt(np.diag(covariance))
    if best.x[1] > 0.99 * HIGHEST_RAD_S:  # at the end of the search: wn and zeta are not told apart
        sd[1:3] = np.inf
    gain, wn, zeta, delay = (float(x) for x in best.x)
    return SecondOrder(gain, wn, zeta, delay, (float(sd[0]), float(sd[1]), float(sd[2]), float(sd[3])), chi2, int(use.sum()))


def identify(u: Held, y: Sampled, spans: Sequence[Span], lo_hz: float = 0.1, hi_hz: float = 5.0) -> Axis:
    """Response, coherence and model of one axis from the spans given. Raises LogError with what is missing."""
    response, records = measured(u, y, spans, lo_hz, hi_hz)
    model = fit_second_order(response)
    longest = max(records, key=lambda record: len(record.r))
    f_hz, g2 = spectrum.ordinary_coherence(longest.r[:, 0], longest.y[:, 0], longest.dt_s)
    offset = float(np.mean([np.median(record.y - model.gain * record.r) for record in records]))
    return Axis(model, response, f_hz, g2, tuple(spans), offset)


def predict(model: SecondOrder, u: Held, t_s: np.ndarray, offset_rad: float = 0.0) -> np.ndarray:
    """(n,) attitude at even times `t_s` from the commands alone, starting in balance with the first of them."""
    dt = float(t_s[1] - t_s[0])
    fine = max(1, round(dt / 0.002))
    h = dt / fine
    edges = t_s[0] + h * np.arange(fine * len(t_s) + 1) - model.delay_s
    command = timebase.held_mean(u, edges)
    from scipy import signal  # half a second to import: only where something is predicted

    wn, zeta = model.omega_n_rad_s, model.zeta
    plant = signal.cont2discrete(([model.gain * wn**2], [1.0, 2.0 * zeta * wn, wn**2]), h)
    b, a = np.ravel(plant[0]), plant[1]
    rest = signal.lfilter_zi(b, a) * command[0]
    y, _ = signal.lfilter(b, a, command, zi=rest)
    return y[::fine][: len(t_s)] + offset_rad


def step_time_s(model: SecondOrder, share: float = 0.63) -> float:
    """Time from a step of the command until the attitude has gone `share` of its way, delay included."""
    zeta = model.zeta if abs(model.zeta - 1.0) > 1e-4 else 1.0001  # two equal poles have another formula
    root = np.sqrt(complex(zeta * zeta - 1.0))
    first, second = -zeta + root, -zeta - root
    tau = np.linspace(0.0, 20.0 * max(1.0, zeta), 8001)  # in units of 1/wn
    y = 1.0 - ((second * np.exp(first * tau) - first * np.exp(second * tau)) / (second - first)).real
    k = int(np.argmax(y >= share))
    return float(np.interp(share, y[k - 1 : k + 1], tau[k - 1 : k + 1])) / model.omega_n_rad_s + model.delay_s


def whole_parts(start: float, end: float, gaps: Sequence[Span]) -> list[Span]:
    """[start, end] cut at the gaps: nothing is interpolated across one."""
    parts, at = [], start
    for a, b in gaps:
        if b <= start or a >= end:
            continue
        if a > at:
            parts.append((at, a))
        at = max(at, b)
    if end > at:
        parts.append((at, end))
    return parts


# ---- which part of a flight to use -----------------------------------------------------------------------------------
class Parts(NamedTuple):
    """Spans to fit and spans to check, of one axis."""

    fit: tuple[Span, ...]
    check: tuple[Span, ...]
    swept: bool  # the fit spans move this axis alone


def parts(t_s: np.ndarray, commands: np.ndarray, axis: int) -> Parts:
    """Where the command of `axis` moves, out of commands (n, k) at `t_s`: alone (a sweep, to be fitted), or with others.

    Without a sweep the first 60 % of the moving time are fitted; what moves and is not fitted is left for the check. Raises LogError
    where nothing moves.
    """
    step = 0.1
    t = np.arange(t_s[0], t_s[-1], step)
    if t.size * step < spectrum.SHORTEST_S:
        raise LogError(f"commands for {t.size * step:.1f} s; needs {spectrum.SHORTEST_S:g} s; record a sweep of 70 s")
    gaps = timebase.rhythm(t_s).gaps
    live = np.ones(t.size, bool)
    for a, b in gaps:
        if b - a > 0.5:
            live &= (t < a) | (t > b)
    level = np.column_stack([_moving_std(timebase.held_at(Held(t_s, commands[:, k]), t), 40) for k in range(commands.shape[1])])
    own = level[:, axis]
    strong = own[own > 0.5 * EXCITED_RAD]
    if strong.size * step < spectrum.SHORTEST_S:
        raise LogError(
            f"its command moves for {strong.size * step:.0f} s only (needs {spectrum.SHORTEST_S:g}); record a sweep on it, 70 s"
        )
    active = live & (own > max(0.5 * EXCITED_RAD, 0.1 * float(np.percentile(strong, 90))))
    others = np.delete(level, axis, axis=1)
    alone = active & np.all(others < 0.3 * own[:, None], axis=1)
    sweeps = _runs(t, alone & live, hole_s=4.0, least_s=30.0)
    moving = _runs(t, active, hole_s=4.0, least_s=5.0)
    if sweeps:
        fit = tuple(sweeps)
    else:
        whole = sum(b - a for a, b in moving)
        fit = tuple(span for span in _first(moving, 0.6 * whole) if span[1] - span[0] >= spectrum.SHORTEST_S)
    if not fit:
        raise LogError(f"its command moves in pieces shorter than {spectrum.SHORTEST_S:g} s only; record a sweep on it, 70 s")
    check = tuple((a, b) for a, b in _without(moving, fit, margin_s=1.0) if b - a >= 5.0)
    return Parts(fit, check, bool(sweeps))


def _moving_std(x: np.ndarray, n: int) -> np.ndarray:
    ones = np.convolve(np.ones(len(x)), np.ones(n), "same")
    mean = np.convolve(x, np.ones(n), "same") / ones
    return np.sqrt(np.maximum(np.convolve(x * x, np.ones(n), "same") / ones - mean * mean, 0.0))


def _runs(t: np.ndarray, on: np.ndarray, *, hole_s: float, least_s: float) -> list[Span]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int))).reshape(-1, 2)
    found: list[Span] = []
    for a, b in edges:
        start, end = float(t[a]), float(t[min(b, len(t) - 1)])
        if found and start - found[-1][1] <= hole_s:
            found[-1] = (found[-1][0], end)
        else:
            found.append((start, end))
    return [(a, b) for a, b in found if b - a >= least_s]


def _first(spans: Sequence[Span], seconds: float) -> list[Span]:
    found, left = [], seconds
    for a, b in spans:
        if left <= 0.0:
            break
        found.append((a, min(b, a + left)))
        left -= b - a
    return found


def _without(spans: Sequence[Span], taken: Sequence[Span], *, margin_s: float) -> list[Span]:
    found = list(spans)
    for start, end in taken:
        lo, hi = start - margin_s, end + margin_s
        cut = []
        for a, b in found:
            cut += [(x, y) for x, y in ((a, min(b, lo)), (max(a, hi), b)) if y > x]
        found = cut
    return found
