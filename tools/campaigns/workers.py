"""Chunks of flights over processes: started afresh, ended with us however we end, and replaced where one is killed."""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from mavquad.errors import FlightError

_A = TypeVar("_A")
_B = TypeVar("_B")
_TRIES = 3  # of a chunk whose worker was killed
_GRACE_S = 25.0  # for a worker to end its flight's own processes
_busy = False  # in a worker


def run(
    function: Callable[..., _B],
    chunks: Sequence[_A],
    arguments: Callable[[_A], tuple[Any, ...]],
    jobs: int,
    processes: bool = True,
) -> Iterator[tuple[_A, _B]]:
    """(chunk, function(*arguments(chunk))) as they end; one job needs a process of its own only where `processes` says so.

    Raises FlightError where a chunk kills its worker every time.
    """
    if jobs == 1 and not processes:
        yield from ((chunk, function(*arguments(chunk))) for chunk in chunks)
        return
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):  # the cores are taken by the workers themselves
        os.environ.setdefault(name, "1")
    context = multiprocessing.get_context("spawn")
    todo, tries = deque(chunks), dict.fromkeys(range(len(chunks)), 0)
    number = {id(chunk): i for i, chunk in enumerate(chunks)}
    while todo:
        ours, theirs = context.Pipe()
        pool = ProcessPoolExecutor(min(jobs, len(todo)), mp_context=context, initializer=_begin, initargs=(theirs,))
        flying: dict[Future[_B], _A] = {}
        try:
            while todo or flying:
                while todo and len(flying) < 2 * jobs:
                    chunk = todo.popleft()
                    flying[pool.submit(_call, function, arguments(chunk))] = chunk
                for future in wait(flying, return_when=FIRST_COMPLETED).done:
                    answer = future.result()
                    yield flying.pop(future), answer
        except BrokenProcessPool:  # one of them was killed: what was flying is flown again
            for chunk in flying.values():
                tries[number[id(chunk)]] += 1
                if tries[number[id(chunk)]] >= _TRIES:
                    raise FlightError(f"{_TRIES} workers were killed over the same flights: {arguments(chunk)[0]}") from None
            todo.extendleft(reversed(flying.values()))
        finally:
            ours.close()  # the workers see it and end
            theirs.close()
            pool.shutdown(wait=True, cancel_futures=True)


def _call(function: Callable[..., _B], arguments: tuple[Any, ...]) -> _B:
    global _busy
    _busy = True
    try:
        return function(*arguments)
    except KeyboardInterrupt:  # our parent has gone, or was stopped
        os._exit(1)
    finally:
        _busy = False


def _begin(line: Connection) -> None:
    """In a worker: Ctrl-C is our parent's to judge; its end of `line` closes when it ends, by whatever cause."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _stopped)
    threading.Thread(target=_watch, args=(line,), daemon=True).start()


def _watch(line: Connection) -> None:
    try:
        line.recv_bytes()
    except (EOFError, OSError):
        os.kill(os.getpid(), signal.SIGTERM)
        threading.Event().wait(_GRACE_S)
        os._exit(1)


def _stopped(*_: Any) -> None:
    if _busy:
        raise KeyboardInterrupt
    os._exit(0)
