"""Work on many items: in this process, in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from typing import Any, Protocol, TypeVar
from urllib.parse import urlsplit

from thirdhand.contract.explain import ExplainedError, in_words
from thirdhand.process.child import end_with_parent

CLUSTER_TIMEOUT_S = 3.0
Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


class Workers(Protocol):
    """A function that applies `work`, which can be pickled, to each item. The outcomes are in
    order, and the same wherever the work is done: each piece has one BLAS thread.
    """

    def __call__(
        self, work: Callable[[Item], Outcome], items: Sequence[Item], /
    ) -> Iterable[Outcome]: ...


def here(work: Callable[[Item], Outcome], items: Sequence[Item]) -> Iterable[Outcome]:
    """The outcome of each item, one after the other in this process."""
    return map(functools.partial(_alone, work), items)


@contextlib.contextmanager
def workers_of(workers: str = "1") -> Iterator[Workers]:
    """A context with the function that shares work out to `workers`: a number of processes, or
    `dask:ADDRESS`. Raises ExplainedError without such workers.
    """
    cluster, _, address = workers.partition(":")
    option = f"--workers {workers}"
    if workers == "1":
        yield here
    elif cluster == "dask":
        with _cluster(address, option) as client, _explained(option):
            yield lambda work, items: (
                future.result()
                for future in client.map(functools.partial(_alone, work), items, pure=False)
            )
    else:
        processes = ProcessPoolExecutor(
            int(workers),
            mp_context=multiprocessing.get_context("forkserver"),
            initializer=_serve_until_the_command_ends,
        )
        with processes as pool, _explained(option):
            yield lambda work, items: pool.map(functools.partial(_alone, work), items)


def _serve_until_the_command_ends() -> None:
    """Leave Ctrl-C to the command, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def spread(
    work: Callable[[Item], Outcome], items: Sequence[Item], workers: str = "1"
) -> Iterator[Outcome]:
    """The outcome of each item, in order, by `workers_of`."""
    with workers_of(workers) as each:
        yield from each(work, items)


@contextlib.contextmanager
def _explained(option: str) -> Iterator[None]:
    """Raise ExplainedError if a worker is killed."""
    try:
        yield
    except Exception as error:
        if isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker":
            raise ExplainedError(
                f"{option}: a worker was killed, perhaps for lack of memory"
            ) from None
        raise


def _cluster(address: str, option: str) -> Any:
    """A client of the Dask cluster at this address. Raises ExplainedError without one."""
    try:
        from distributed import Client
    except ImportError:
        raise ExplainedError(f"{option}: the package distributed needed here") from None
    try:
        location = urlsplit(address if "://" in address else f"tcp://{address}")
        if not (location.hostname and location.port):  # Dask would wait for the domain name service
            raise ValueError("no host and port")
        return Client(address, timeout=CLUSTER_TIMEOUT_S)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TypeError) as error:  # no address, or nothing answers there
        raise ExplainedError(
            f"{option}: {in_words(error)}; a running cluster's address needed"
        ) from None


def attempt(work: Callable[[Item], Outcome], item: Item) -> Outcome | ExplainedError:
    """The outcome of an item, or the error that explains why there is none."""
    try:
        return work(item)
    except (ExplainedError, OSError) as error:
        return ExplainedError(in_words(error))


def _alone(work: Callable[[Item], Outcome], item: Item) -> Outcome:
    from threadpoolctl import threadpool_limits  # a worker may be of a process with more threads

    with threadpool_limits(1):
        return work(item)
