"""Compile every kernel once, with progress; a second run finds them in the cache and returns at once.

`python -m tools.warm`, and `make install` for it. What is compiled: each controller with its estimator in the companion's own warm-up, the
compensator, the observers, the simulated vehicles, the reader of logs, and what a paper's module compiles in its `warm()`.
"""

import argparse
import functools
import importlib
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from mavquad import jit
from mavquad.errors import MavquadError

if TYPE_CHECKING:
    from tools.scenarios import Resolved

Step = tuple[str, Callable[[], object]]


def main(argv: list[str] | None = None) -> int:
    """Compile what is not compiled yet. 1 where a part of it failed."""
    parser = argparse.ArgumentParser(prog="python -m tools.warm", description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.parse_args(argv)
    if not jit.COMPILED or _stamp("everything").exists():
        return 0
    failed = 0
    todo = list(steps())
    for i, (label, step) in enumerate(todo, 1):
        begun = time.monotonic()
        print(f"compiling kernels (once), {i} of {len(todo)}: {label} ...", end="", file=sys.stderr, flush=True)
        try:
            step()
            print(f" {time.monotonic() - begun:.1f} s", file=sys.stderr, flush=True)
        except MavquadError as error:  # the rest is still worth compiling
            failed += 1
            print(f" {error}", file=sys.stderr, flush=True)
    if not failed:
        _stamp("everything").touch()
    return 1 if failed else 0


def ensure(label: str, step: Callable[[], object], say: Callable[[str], None]) -> None:
    """Run `step` once for these sources, before processes that must not wait for the compiler."""
    if not jit.COMPILED or _stamp("everything").exists() or _stamp(label).exists():
        return
    say(f"compiling kernels (once): {label}")
    step()
    _stamp(label).touch()


def steps() -> Iterator[Step]:
    """Everything there is to compile, each with its name."""
    from mavquad.plan import COMPENSATORS, CONTROLLERS, OBSERVERS

    yield "reading logs", _logs
    yield "the simulated vehicles", vehicle
    for name in OBSERVERS:
        yield f"observer {name}", lambda name=name: _stages(observers=[name])  # type: ignore[misc]
    for name in CONTROLLERS:
        yield f"controller {name}", lambda name=name: _stages(controller=name)  # type: ignore[misc]
    for name in COMPENSATORS:
        yield f"compensator {name}", lambda name=name: _stages(compensator=name)  # type: ignore[misc]
    yield "observers over whole records", records
    for path in sorted((Path(__file__).parent / "papers").glob("*.py")):
        if "\ndef warm(" in path.read_text(encoding="utf-8"):
            yield f"paper {path.stem}", importlib.import_module(f"tools.papers.{path.stem}").warm


def _stages(**chosen: object) -> None:
    """The warm-up of a companion with what is chosen, nothing else beside it."""
    from mavquad import config, plan, warm
    from mavquad.settings import Companion

    warm.run(plan.build(config.convert({"observers": [], **chosen}, Companion, "warm")))


def flight(resolved: "Resolved") -> None:
    """What one flight needs, in both of its programs and for its score."""
    from mavquad import plan, warm

    warm.run(plan.build(resolved.companion))
    vehicle()
    _logs()


def vehicle() -> None:
    """A second of each simulated vehicle: alone, then with a peer and a log."""
    from sitl.config import Sitl
    from sitl.simulation import Simulation

    for airframe in ("x500", "helicopter"):
        sim = Simulation(Sitl(airframe=airframe), lambda t_us, records: None)
        sim.run_period()
        link = sim.open_link()
        while sim.t_us < 1_100_000:
            sim.run_period()
            sim.collect(link)
            sim.record_period()


def records() -> None:
    """Every observer over a record of a few samples."""
    import numpy as np

    from mavquad import active_flight, active_record, airframe
    from mavquad.estimate import extended_state_flight, extended_state_record, gsmo, joint_flight, joint_record, record

    t_us, level = 20_000 * np.arange(1, 5), np.tile([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], (4, 1))
    events = record.events({kind: (t_us, t_us, level[:, : (7, 6, 6, 3)[kind]]) for kind in range(4)}, 20_000)
    vehicle = airframe.load("x500")
    joint_record.run(joint_flight.gains(joint_flight.Params(), vehicle), events)
    extended_state_record.run(extended_state_flight.gains(extended_state_flight.Params(), vehicle), events)
    active_record.run(active_flight.gains(active_flight.Params(), vehicle), events)
    for variant in ("online", "relay"):
        gsmo.run_record(gsmo.gains(gsmo.Params(variant=variant)), t_us, level[:, :4])


def _logs() -> None:
    """A log of a few frames, read by columns."""
    from mavquad import wire
    from mavquad.link import tlog
    from mavquad.link.columns import Log

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "warm.tlog"
        with tlog.Writer(path) as writer:
            for i in range(3):
                writer.write(i, wire.encode("HEARTBEAT", (2, 12, 0, 0, 4, 3), seq=i, system=1, component=1))
        log = Log(path)
        log.columns("HEARTBEAT")
        log.everything()


@functools.cache
def _sources() -> str:
    return jit.source_hash(jit.kernel_modules())


def _stamp(label: str) -> Path:
    return jit.base_folder() / f"warm {label} {_sources()}".replace(" ", "-").replace("/", "-")


if __name__ == "__main__":
    raise SystemExit(main())
