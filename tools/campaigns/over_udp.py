"""A campaign's flights as two real processes over UDP, each by the same code as `mavquad fly`; its run folder goes unless kept."""

import argparse
import copy
import functools
import shutil
from pathlib import Path
from typing import Any

from mavquad.errors import MavquadError
from tools import flight, fly, summary, warm
from tools.campaigns.grid import Flight
from tools.campaigns.store import Result

NAME = "udp"
PROCESSES = True  # a worker ends its two programs however the campaign ends


@functools.cache
def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(exit_on_error=False)
    fly.add_arguments(parser)
    return parser


def resolve(words: tuple[str, ...]) -> tuple[argparse.Namespace, Any]:
    """(the options of `mavquad fly`, both programs' configurations). Raises ConfigError."""
    changes = [i for i in range(len(words) - 1) if words[i] == "--set"]
    args = copy.copy(_options(tuple(word for i, word in enumerate(words) if i not in changes and i - 1 not in changes)))
    args.set = [words[i + 1] for i in changes]
    return args, fly.resolve(args)


@functools.lru_cache(maxsize=64)
def _options(words: tuple[str, ...]) -> argparse.Namespace:
    """Without changes the flights of a campaign have the same few options."""
    return _parser().parse_args(words)


def prepare(flights: list[Flight], say: Any) -> None:
    """Check every kind of flight and compile what it needs, once, before any worker starts. Raises ConfigError."""
    from mavquad import plan

    kinds = {(one.scenario, one.personality, one.variant): one for one in reversed(flights)}
    found = [resolve(one.words)[1] for one in kinds.values()]
    for resolved in found:
        plan.build(resolved.companion)
    for resolved in found:
        warm.ensure(f"flight {fly.stages(resolved.companion)}", functools.partial(warm.flight, resolved), say)


def chunks(flights: list[Flight]) -> list[list[Flight]]:
    """What is handed to a worker at once: one flight."""
    return [[flight] for flight in flights]


def fly_chunk(words: list[tuple[str, ...]], ids: list[str], runs: str, keep: str) -> list[Result]:
    """Fly each in a folder of its own under `runs`; keep none, the failed or all of the folders."""
    return [_one(one, Path(runs) / id_, keep) for one, id_ in zip(words, ids, strict=True)]


def _one(words: tuple[str, ...], run: Path, keep: str) -> Result:
    shutil.rmtree(run, ignore_errors=True)  # of a flight that was cut short
    try:
        args, resolved = resolve(words)
        flight.prepare(run, resolved)
        max_time_s = resolved.scenario.flight.max_time_s
        flown = flight.fly(run, flight.Pace(args.speed), max_time_s, lambda t_s, said: None)
        name = Path(args.scenario).stem
        result = Result(run.name, summary.summarise(run, name, resolved, flown, fly.command(args), args.speed is None))
    except MavquadError as error:
        result = Result(run.name, {}, str(error))
    if keep == "none" or (keep == "failed" and result.summary.get("ok")):
        shutil.rmtree(run, ignore_errors=True)
    return result
