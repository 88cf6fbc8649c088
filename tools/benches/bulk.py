"""flights in bulk: plant steps a second of one vehicle and of many, beside RotorPy, crazyflow and a C-written limit.

The physics stands beside each figure; a ratio between different physics says so. Peers live in an environment of their own
(`make bench`, tools/peers.py); one that is missing is said, nothing fails for want of it.
"""

import math
import os
import shutil
import statistics
import subprocess
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from mavquad.errors import ConfigError
from tools import peers, scenarios
from tools.benches import Row
from tools.bulk import setup

_OURS = "17 states (rotation matrix, 4 rotor lags), midpoint 2 ms, drag, Dryden wind"
_CONTROLLED = f"{_OURS}, wind held, attitude and rate loops on the truth, 500 Hz"
_C_SOURCE = r"""
#include <math.h>
#include <stdio.h>
#include <time.h>
typedef struct { double p[3], v[3], R[9], w[3], T[4]; } S;
static const double m = 2.0, J[3] = {0.022, 0.022, 0.04}, g = 9.80665, d1 = 0.25, arm = 0.18, ct = 0.016;
static void rates(const double *v, const double *R, const double *w, const double *T, const double *wind, double *dv, double *dw) {
  double a[3], r[3] = {wind[0]-v[0], wind[1]-v[1], wind[2]-v[2]};
  for (int i = 0; i < 3; i++) a[i] = d1*(R[i]*r[0] + R[3+i]*r[1] + R[6+i]*r[2]);
  double U = T[0]+T[1]+T[2]+T[3], tx = arm*(-T[0]+T[1]+T[2]-T[3]), ty = arm*(T[0]-T[1]+T[2]-T[3]), tz = ct*(T[0]+T[1]-T[2]-T[3]);
  a[2] -= U;
  for (int i = 0; i < 3; i++) dv[i] = (R[3*i]*a[0] + R[3*i+1]*a[1] + R[3*i+2]*a[2])/m;
  dv[2] += g;
  dw[0] = (tx + (J[1]-J[2])*w[1]*w[2])/J[0]; dw[1] = (ty + (J[2]-J[0])*w[2]*w[0])/J[1]; dw[2] = (tz + (J[0]-J[1])*w[0]*w[1])/J[2];
}
static void turned(const double *R, const double *w, double h, double *out) {
  double x = h*w[0], y = h*w[1], z = h*w[2], n2 = x*x+y*y+z*z, n = sqrt(n2), a, b;
  if (n2 < 1e-8) { a = 1 - n2/6; b = 0.5 - n2/24; } else { a = sin(n)/n; b = (1-cos(n))/n2; }
  double E[9] = {1-b*(y*y+z*z), b*x*y-a*z, b*x*z+a*y, b*x*y+a*z, 1-b*(x*x+z*z), b*y*z-a*x, b*x*z-a*y, b*y*z+a*x, 1-b*(x*x+y*y)};
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++) out[3*i+j] = R[3*i]*E[j] + R[3*i+1]*E[3+j] + R[3*i+2]*E[6+j];
}
static void step(S *s, const double *u, const double *wind, double dt) {
  double k1[3], j1[3], k2[3], j2[3], vm[3], wm[3], Rm[9], Tm[4], Te[4], Rn[9], keep = exp(-0.5*dt/0.03), h = 0.5*dt;
  for (int i = 0; i < 4; i++) { Tm[i] = u[i] + keep*(s->T[i]-u[i]); Te[i] = u[i] + keep*(Tm[i]-u[i]); }
  rates(s->v, s->R, s->w, s->T, wind, k1, j1);
  for (int i = 0; i < 3; i++) { vm[i] = s->v[i] + h*k1[i]; wm[i] = s->w[i] + h*j1[i]; }
  turned(s->R, s->w, h, Rm);
  rates(vm, Rm, wm, Tm, wind, k2, j2);
  turned(s->R, wm, dt, Rn);
  for (int i = 0; i < 3; i++) { s->p[i] += dt*vm[i]; s->v[i] += dt*k2[i]; s->w[i] += dt*j2[i]; }
  double half = 0.5*(Rn[0]*Rn[3]+Rn[1]*Rn[4]+Rn[2]*Rn[5]), a[3], b[3];
  for (int i = 0; i < 3; i++) { a[i] = Rn[i]-half*Rn[3+i]; b[i] = Rn[3+i]-half*Rn[i]; }
  double ka = 1/sqrt(a[0]*a[0]+a[1]*a[1]+a[2]*a[2]), kb = 1/sqrt(b[0]*b[0]+b[1]*b[1]+b[2]*b[2]);
  for (int i = 0; i < 3; i++) { s->R[i] = a[i] *= ka; s->R[3+i] = b[i] *= kb; }
  s->R[6] = a[1]*b[2]-a[2]*b[1]; s->R[7] = a[2]*b[0]-a[0]*b[2]; s->R[8] = a[0]*b[1]-a[1]*b[0];
  for (int i = 0; i < 4; i++) s->T[i] = Te[i];
}
int main(void) {
  S s = {{0,0,-5},{0,0,0},{1,0,0,0,1,0,0,0,1},{0.1,0.05,0.02},{4.9,4.9,4.9,4.9}};
  double u[4] = {4.9,4.9,4.9,4.9}, wind[3] = {3,1,0};
  clock_t begun = clock();
  long n = 3000000;
  for (long i = 0; i < n; i++) { u[i & 3] = 4.9 + 1e-3*(i & 7); step(&s, u, wind, 0.002); }
  printf("%.9g %.9g\n", (double)(clock()-begun)/CLOCKS_PER_SEC/n, s.p[0]);
  return 0;
}
"""


def measure(seconds: float) -> list[Row]:
    """Ours from the bare rigid body to whole flights, then the others."""
    single, limit = _single(seconds), _limit()
    rows = [*single, *_fleets(seconds), _many(seconds), limit]
    if math.isfinite(limit.value):
        rows.append(Row("rigid-body step, share of", limit.who, single[0].value / limit.value, "of 1"))
    return [*rows, *_rotorpy(single[1])]


def _single(seconds: float) -> list[Row]:
    from tools.bulk import rates as kernels

    resolved = _resolved(seconds)
    steps = max(20_000, round(20_000 * seconds))
    rows = []
    for what, physics, kernel in (
        ("rigid-body step", f"{_OURS}, wind held", kernels.plant_alone),
        (
            "plant + attitude control, one vehicle",
            _CONTROLLED,
            kernels.with_loops,
        ),
        (
            "plant + attitude control + sensors + wind, one vehicle",
            f"{_OURS}; gyro, AHRS and position with noise, 500 Hz",
            kernels.with_sensors,
        ),
    ):
        p = setup.prepare(resolved)
        setup.fly(p, setup.START_US + 3_000_000)
        v, best = p.vehicle, math.inf
        for i in range(16):
            begun = time.perf_counter()
            kernel(v.state.array, v.setpoint.array, v.constants.array, v._gusts, p.noise.array, steps if i else 8)
            best = min(best, time.perf_counter() - begun) if i else best
        rows.append(Row(what, "ours, one core", 1e-6 * steps / best, "M steps/s", physics))
    best = math.inf
    for i in range(4):
        p = setup.prepare(resolved)
        begun = time.perf_counter()
        setup.fly(p)
        best = min(best, time.perf_counter() - begun) if i else best
    n = (p.flight["t_us"] - setup.START_US) / p.flight["step_us"]
    physics = f"{_OURS}; all of the above, link delay, pid at 125 Hz, setpoint gate"
    return [*rows, Row("whole flight, one vehicle", "ours, one core", 1e-6 * n / best, "M steps/s", physics)]


def _fleets(seconds: float) -> list[Row]:
    """1000 vehicles, each of a seed of its own, moved on by one call over all cores; crazyflow's between two halves of our rounds."""
    from tools.bulk import fleet

    flights, steps, cores = 1000, max(200, round(200 * seconds)), os.cpu_count() or 1
    prepared = [setup.prepare(_resolved(1.0, seed)) for seed in range(1, flights + 1)]
    for p in prepared:
        setup.fly(p, setup.START_US + 3_000_000)
    vehicles = fleet.gather(prepared)
    fleet.advance(vehicles, 1)

    def round_() -> float:
        begun = time.perf_counter()
        fleet.advance(vehicles, steps)
        return 1e-6 * flights * steps / (time.perf_counter() - begun)

    ours = [round_() for _ in range(4)]
    theirs = [_crazyflow(flights, *contest) for contest in ((1, "euler"), (cores, "euler"), (cores, "rk4"))]
    ours += [round_() for _ in range(4)]
    what, mine = f"{flights} flights in one call, plant + attitude and rate loops", statistics.median(ours)
    rows = [
        Row(what, f"ours, {cores} cores", mine, "M steps/s", f"{_spread(ours)}; {_CONTROLLED}; wanted: 6 on 2 cores"),
        *theirs,
    ]
    note = "different physics: see the lines above; wanted: 3"
    return [*rows, *(Row(f"{what}, ours over", r.who, mine / r.value, "times", note) for r in theirs if math.isfinite(r.value))]


def _crazyflow(flights: int, devices: int, integrator: str) -> Row:
    """Its worlds, each a drone under attitude control: on one device as it comes, or spread over as many as there are cores."""
    what = f"{flights} worlds in one call, first-principles dynamics + attitude control"
    who = f"crazyflow, {integrator}, {devices} device{'s' if devices > 1 else ''}"
    evaluations = {"euler": 1, "rk4": 4}[integrator]
    physics = f"13 states + 4 rotor speeds, float32, {integrator} 2 ms ({evaluations} evaluation{'s' if evaluations > 1 else ''}, ours has 2)"
    try:
        rates = [1e-6 * rate for rate in peers.run("crazyflow", peers.CRAZYFLOW, flights, 200, devices, integrator)]
    except ConfigError as problem:
        return Row(what, who, math.nan, "M steps/s", str(problem))
    return Row(
        what, who, statistics.median(rates), "M steps/s", f"{_spread(rates)}; {physics}, drag, no wind, 500 Hz, jit on the CPU"
    )


def _spread(values: list[float]) -> str:
    return f"rounds {min(values):.3g} to {max(values):.3g}"


def _many(seconds: float) -> Row:
    """1000 whole flights (fewer in a short run) over all cores, from a call to their scores."""
    cores, flights = os.cpu_count() or 1, 1000 if seconds >= 5.0 else 40
    with ProcessPoolExecutor(cores, mp_context=get_context("spawn")) as pool:
        list(pool.map(_flights, [(1, 2)] * cores))  # started, compiled
        parts = [(first, min(first + 25, flights + 1)) for first in range(1, flights + 1, 25)]
        begun = time.perf_counter()
        steps = sum(pool.map(_flights, parts))
        spent = time.perf_counter() - begun
    return Row(
        f"{flights} whole flights in one call",
        f"ours, {cores} cores",
        1e-6 * steps / spent,
        "M steps/s",
        "as one vehicle, set-up and scores included",
    )


def _flights(seeds: tuple[int, int]) -> float:
    steps = 0.0
    for seed in range(*seeds):
        p = setup.prepare(_resolved(10.0, seed))
        setup.fly(p)
        steps += (p.flight["t_us"] - setup.START_US) / p.flight["step_us"]
    return steps


def _resolved(seconds: float, seed: int = 1) -> scenarios.Resolved:
    changes = [f"path.duration_s={min(15.5, 1.5 * seconds)}", "wind.mean_m_s=4", "wind.w20_m_s=8"]
    return scenarios.resolve(scenarios.load("hover", changes), scenarios.Options(seed=seed, controller="pid"))


def _limit() -> Row:
    what, who = "rigid-body step", "written in C, -O3"
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return Row(what, who, math.nan, "M steps/s", "no C compiler here")
    with tempfile.TemporaryDirectory() as folder:
        source, program = Path(folder) / "limit.c", Path(folder) / "limit"
        source.write_text(_C_SOURCE)
        done = subprocess.run(
            [compiler, "-O3", "-march=native", str(source), "-o", str(program), "-lm"], capture_output=True, text=True
        )
        if done.returncode:
            return Row(what, who, math.nan, "M steps/s", f"does not compile here: {done.stderr.strip().splitlines()[-1]}")
        told = [
            float(subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout.split()[0])
            for _ in range(3)
        ]
    return Row(
        what,
        who,
        1e-6 / min(told),
        "M steps/s",
        "17 states, midpoint 2 ms, linear drag, wind held; no disturbance sums, no ground",
    )


def _rotorpy(ours: Row) -> list[Row]:
    """RotorPy's vehicle, and ours over it."""
    what, who = "plant + motors, one vehicle", "RotorPy"
    physics = "13 states + 4 motors, scipy RK45 adaptive, drag and rotor aerodynamics"
    try:
        rates = [1e-6 * rate for rate in peers.run("RotorPy", peers.ROTORPY)]
    except ConfigError as problem:
        return [Row(what, who, math.nan, "M steps/s", str(problem))]
    rate, note = statistics.median(rates), "different physics: see the lines above; wanted: 2000"
    return [
        Row(what, who, rate, "M steps/s", f"{_spread(rates)}; {physics}"),
        Row("plant + attitude control, ours over", who, ours.value / rate, "times", note),
    ]
