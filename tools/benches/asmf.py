"""The set-membership filter: one step compiled, and filter with compensator in flight from Python."""

import time
from collections.abc import Callable

import numpy as np

from mavquad import active_flight, active_helicopter, airframe, quat
from mavquad.estimate import asmf, heli_error, quad_error
from mavquad.identify import models
from mavquad.jit import kernel
from mavquad.signals import NAN3, ZERO3, Applied, Attitude, Command, Controls, Demand, Estimate, Imu, Position
from tools.benches import Row

G_M_S2 = 9.80665
NOMINAL = Command((0.1, 0.2, 0.0), 0.0, 0.0, NAN3, ZERO3)


def measure(seconds: float) -> list[Row]:
    """Microseconds of CPU time per step, the least of several passes."""
    n = max(200, round(100 * seconds))
    rng, reference = np.random.default_rng(1), models.ref_13()
    heli = heli_error.gains(heli_error.Params(), reference.a, reference.b, reference.states)
    quad = quad_error.gains(quad_error.Params())
    y_heli = rng.uniform(-1.0, 1.0, (n, 8)) * heli.filter.e
    y_quad = rng.uniform(-1.0, 1.0, (n, 8)) * quad.filter.e
    begun = heli_error.init(heli), quad_error.init(quad, ZERO3, ZERO3, G_M_S2)
    return [
        _row("strips, 19 states, 8 outputs, compiled", lambda: _helicopter(heli, begun[0], y_heli), n, "limit 60 us"),
        _row("quadrotor, 10 states, compiled", lambda: _quadrotor(quad, begun[1], y_quad), n, "limit 25 us"),
        _row("quadrotor, a tick from Python", lambda: _flight(n), n, "filter, compensator, samples; limit 200 us"),
        _row("helicopter, a tick from Python", lambda: _helicopter_flight(n), n, "50 a second"),
    ]


def _row(what: str, work: Callable[[], object], n: int, note: str) -> Row:
    work()
    spent = []
    for _ in range(5):
        begun = time.thread_time()
        work()
        spent.append(time.thread_time() - begun)
    return Row(what, "mavquad", 1e6 * min(spent) / n, "us", note)


@kernel
def _helicopter(gains: heli_error.Gains, state: asmf.State, y: np.ndarray) -> asmf.State:
    stick = np.zeros(4)
    for k in range(y.shape[0]):
        state = heli_error.step(gains, state, stick, y[k], 20_000 * k)
    return state


@kernel
def _quadrotor(gains: quad_error.Gains, state: quad_error.State, y: np.ndarray) -> quad_error.State:
    for k in range(y.shape[0]):
        r = y[k]
        accel = (r[5], r[6], r[7] - G_M_S2)
        measured = quad_error.Measured((r[0], r[1], 0.0), (r[2], r[3], r[4]), accel, 0.0, 0.01, 0.004)
        state = quad_error.step(gains, state, (0.0, 0.0, G_M_S2), measured, 0.02, 20_000 * k)
    return state


def _flight(n: int) -> None:
    """A control tick of 8 ms with the samples of a PX4: four of attitude and accelerometer, a position each third."""
    gains = active_flight.gains(active_flight.Params(), airframe.load("x500"))
    state = active_flight.init(gains)
    for k in range(1, n + 1):
        t_us, q = 8000 * k, quat.from_euler(0.001 * (k % 7), 0.001 * (k % 5), 0.1)
        for at_us in (t_us - 4000, t_us):
            state = active_flight.observe(gains, state, Imu(at_us, (0.0, 0.0, -9.8), ZERO3))
            state = active_flight.observe(gains, state, Attitude(at_us, q, ZERO3))
        if k % 3 == 0:
            state = active_flight.observe(gains, state, Position(t_us, ZERO3, (0.01, 0.0, 0.0)))
        estimate = Estimate(t_us, ZERO3, ZERO3, q, ZERO3, NAN3, NAN3)
        state, _ = active_flight.step(gains, state, estimate, NOMINAL, Applied(t_us, q, 9.8, NAN3, 0.01), t_us)
        active_flight.published(state)


def _helicopter_flight(n: int) -> None:
    gains = active_helicopter.gains(active_helicopter.Params(), airframe.load("helicopter"))
    state = active_helicopter.init(gains)
    for k in range(1, n + 1):
        t_us, q = 20_000 * k, quat.from_euler(0.001 * (k % 7), 0.001 * (k % 5), 0.1)
        for sample in (Attitude(t_us, q, ZERO3), Position(t_us, ZERO3, ZERO3), Controls(t_us, (0.0,) * 4)):
            state = active_helicopter.observe(gains, state, sample)
        estimate = Estimate(t_us, ZERO3, ZERO3, q, ZERO3, NAN3, NAN3)
        applied = Applied(t_us, q, 9.8, NAN3, 0.01)
        state, _ = active_helicopter.step(gains, state, estimate, NOMINAL, applied, t_us, _at_rest)
        active_helicopter.published(state)


def _at_rest(t_us: int) -> Demand:
    return Demand(t_us, ZERO3, ZERO3, ZERO3, ZERO3, 0.0, 0.0)
