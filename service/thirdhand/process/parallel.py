"""Work on many items: in this process, in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import functools
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from typing import TypeVar
from urllib.parse import urlsplit

from thirdhand.contract.explain import ExplainedError, in_words

CLUSTER_TIMEOUT_S = 3.0
Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


def spread(
    work: Callable[[Item], Outcome], items: Sequence[Item], workers: str = "1"
) -> Iterator[Outcome]:
    """The outcome of each item, in order.

    `workers` is a number of processes, or `dask:ADDRESS`; `work` must be a function that can be
    pickled. Each piece of work has one BLAS thread. Raises ExplainedError without such workers.
    """
    alone = functools.partial(_alone, work)
    cluster, _, address = workers.partition(":")
    if cluster == "dask":
        yield from _on_cluster(alone, items, address)
    elif workers == "1":
        yield from map(alone, items)
    else:
        processes = multiprocessing.get_context("forkserver")
        with ProcessPoolExecutor(int(workers), mp_context=processes) as pool:
            try:
                yield from pool.map(alone, items)
            except BrokenExecutor:
                raise ExplainedError(
                    f"--workers {workers}: a worker was killed, perhaps for lack of memory"
                ) from None


def _on_cluster(
    work: Callable[[Item], Outcome], items: Sequence[Item], address: str
) -> Iterator[Outcome]:
    option = f"--workers dask:{address}"
    try:
        from distributed import Client, KilledWorker
    except ImportError:
        raise ExplainedError(f"{option}: the package distributed needed here") from None
    try:
        location = urlsplit(address if "://" in address else f"tcp://{address}")
        if not (location.hostname and location.port):  # Dask would wait for the domain name service
            raise ValueError("no host and port")
        client = Client(address, timeout=CLUSTER_TIMEOUT_S)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TypeError) as error:  # no address, or nothing answers there
        raise ExplainedError(
            f"{option}: {in_words(error)}; a running cluster's address needed"
        ) from None
    with client:
        try:
            yield from (future.result() for future in client.map(work, items, pure=False))
        except KilledWorker:
            raise ExplainedError(
                f"{option}: a worker was killed, perhaps for lack of memory"
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
