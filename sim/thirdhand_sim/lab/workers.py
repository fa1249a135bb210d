"""Tasks of an experiment, distributed over workers."""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from thirdhand.process.parallel import spread

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")
_prepared: list[bytes] = []  # pickle of the preparation that this process has run


def shared_out(
    work: Callable[[Task], Outcome],
    tasks: Sequence[Task],
    workers: str,
    *,
    prepare: Callable[[], None] | None = None,
) -> Iterator[Outcome]:
    """The outcome of each task, in order. With one worker, tasks run in this process, after
    `prepare`; otherwise in the workers of `spread`, which run `prepare` before their first task.
    """
    if workers == "1":
        yield from map(work, tasks)
        return
    yield from spread(functools.partial(_prepared_work, work, prepare), tasks, workers)


def _prepared_work(
    work: Callable[[Task], Outcome], prepare: Callable[[], None] | None, task: Task
) -> Outcome:
    if prepare is not None and _prepared != [key := pickle.dumps(prepare)]:
        prepare()
        _prepared[:] = [key]
    return work(task)
