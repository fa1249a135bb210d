"""Tasks of an experiment, distributed over processes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")


def shared_out(
    work: Callable[[Task], Outcome],
    tasks: Sequence[Task],
    workers: int,
    *,
    prepare: Callable[[], None] | None = None,
    chunk: int = 1,
) -> Iterator[Outcome]:
    """The outcome of each task, in order: in this process if there is one worker, which is prepared
    then; else in new ones, which run `prepare` first.
    """
    if workers == 1:
        yield from map(work, tasks)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=prepare) as pool:
        yield from pool.map(work, tasks, chunksize=chunk)
