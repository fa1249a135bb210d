"""Work on many items, spread over the workers of joblib: processes of this machine, a Dask cluster,
or whatever `joblib.parallel_config` sets in a program.
"""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from typing import Any, TypeVar

from service.contract.explain import ExplainedError, in_words

DASK = "dask:"  # begins the workers of a Dask cluster; its scheduler's address follows
Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


def spread(work: Callable[[Item], Outcome], items: Sequence[Item], workers: str = "") -> Iterator[Outcome]:
    """The outcome of each item, in order.

    `workers` is a number of processes, or `dask:ADDRESS`. If it is empty, joblib decides: by
    `joblib.parallel_config` where a program set it, else the work is done in this process. Each
    piece of work has one BLAS thread. Raises ExplainedError without such workers.
    """
    from joblib import Parallel, delayed, parallel_config  # slow to import

    backend: dict[str, Any] = {}
    if workers.startswith(DASK):
        if importlib.util.find_spec("distributed") is None:
            raise ExplainedError(f"--workers {workers}: the package distributed, of Dask, needed here")
        backend = {"backend": "dask", "scheduler_host": workers.removeprefix(DASK)}
    elif workers:
        backend = {"backend": "loky", "n_jobs": int(workers)}
    try:
        with parallel_config(**backend) if backend else contextlib.nullcontext():
            parallel = Parallel(return_as="generator", max_nbytes=None)
    except (OSError, ValueError) as error:  # the scheduler's address is not one, or nothing answers there
        raise ExplainedError(f"--workers {workers}: {in_words(error)}; a running scheduler's address needed") from None
    try:
        yield from parallel(delayed(_alone)(work, item) for item in items)
    except BrokenExecutor:
        raise ExplainedError(f"--workers {workers}: a worker was killed, perhaps for lack of memory") from None


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
