"""Chunks of flights on an existing dask.distributed cluster: the same function, the same rows.

The workers need this project installed in the same version. A worker that dies takes nothing with it: what it had is flown again by
another, and a row that comes twice is kept once.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from mavquad.errors import ConfigError, FlightError

_A = TypeVar("_A")
_B = TypeVar("_B")
_RETRIES = 3


def run(
    function: Callable[..., _B], chunks: Sequence[_A], arguments: Callable[[_A], tuple[Any, ...]], address: str
) -> Iterator[tuple[_A, _B]]:
    """(chunk, function(*arguments(chunk))) as they end. Raises ConfigError without dask or a cluster, FlightError from a worker."""
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise ConfigError("--dask needs dask.distributed: pip install 'mavquad[dask]'") from None
    try:
        client = Client(address, timeout=10.0, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise ConfigError(f"--dask {address}: no scheduler answers there: {error or type(error).__name__}") from None
    with client:
        if not client.scheduler_info()["workers"]:
            raise ConfigError(f"--dask {address}: the cluster has no workers; start some with `dask worker {address}`")
        flying = {client.submit(function, *arguments(chunk), pure=False, retries=_RETRIES): chunk for chunk in chunks}
        try:
            for future in as_completed(list(flying), loop=client.loop):
                try:
                    answer = future.result()
                except Exception as error:  # whatever a worker raised, or its death for the fourth time
                    raise FlightError(f"a worker of {address} failed: {type(error).__name__}: {error}") from None
                yield flying.pop(future), answer
                future.release()
        finally:
            client.cancel(list(flying))
