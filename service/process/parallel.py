"""Work on many items, spread over the workers of joblib: processes of this machine, a Dask or Ray
cluster, or whatever `joblib.parallel_config` sets in a program.
"""

from __future__ import annotations

import contextlib
import importlib.util
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from typing import Any, TypeVar

from service.contract.channels import tcp_address
from service.contract.explain import ExplainedError, in_words

CLUSTERS = {"dask": "distributed", "ray": "ray"}  # back ends of joblib that are clusters, and their packages
CLUSTER_TIMEOUT_S = 3.0
Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


def spread(work: Callable[[Item], Outcome], items: Sequence[Item], workers: str = "") -> Iterator[Outcome]:
    """The outcome of each item, in order.

    `workers` is a number of processes, `dask:ADDRESS` or `ray:ADDRESS`. If it is empty, joblib
    decides: by `joblib.parallel_config` where a program set it, else the work is done in this
    process. Each piece of work has one BLAS thread. Raises ExplainedError without such workers.
    """
    from joblib import Parallel, delayed, parallel_config  # slow to import
    from joblib.parallel import get_active_backend

    cluster, _, address = workers.partition(":")
    backend: dict[str, Any] = {"backend": cluster, "n_jobs": -1} if address else {}  # else Ray gets no work
    if backend and importlib.util.find_spec(CLUSTERS[cluster]) is None:
        raise ExplainedError(f"--workers {workers}: the package {CLUSTERS[cluster]} needed here")
    if workers and not backend:
        backend = {"backend": "loky", "n_jobs": int(workers)}
    lost: tuple[type[Exception], ...] = (BrokenExecutor,)
    try:
        if cluster in CLUSTERS:
            _try(address)
        if cluster == "dask":
            backend["scheduler_host"] = address
        elif cluster == "ray":
            lost = (_connect_to_ray(address),)
        with parallel_config(**backend) if backend else contextlib.nullcontext():
            in_turn = "generator" if get_active_backend()[0].supports_return_generator else "list"
            parallel = Parallel(return_as=in_turn, max_nbytes=None)
    except (OSError, ValueError, RuntimeError, OverflowError) as error:  # no address, or nothing answers there
        raise ExplainedError(f"--workers {workers}: {in_words(error)}; a running cluster's address needed") from None
    try:
        yield from parallel(delayed(_alone)(work, item) for item in items)
    except lost:
        raise ExplainedError(f"--workers {workers}: a worker was killed, perhaps for lack of memory") from None


def _try(address: str) -> None:
    """Connect to a cluster's address and leave: where nothing listens, its client would wait for
    minutes. Raises OSError, ValueError, OverflowError.
    """
    if (found := tcp_address(f"tcp/{address.rpartition('/')[2]}")) is None:
        raise ValueError("it has no port")
    socket.create_connection(found, timeout=CLUSTER_TIMEOUT_S).close()


def _connect_to_ray(address: str) -> type[Exception]:
    """Connect to a Ray cluster, whose workers joblib then knows. Returns the error of a worker that
    was killed. Raises OSError, ValueError.
    """
    import ray
    from ray.exceptions import RayActorError
    from ray.util.joblib import register_ray

    register_ray()
    ray.init(address=address, log_to_driver=False, logging_level="ERROR", ignore_reinit_error=True)
    return RayActorError  # type: ignore[no-any-return]  # Ray may not be installed


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
