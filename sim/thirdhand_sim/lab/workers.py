"""Tasks of an experiment, distributed over workers."""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from thirdhand.process.parallel import spread

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")
_prepared: list[bytes] = []  # the preparation of this process, by its pickle


def shared_out(
    work: Callable[[Task], Outcome],
    tasks: Sequence[Task],
    workers: str,
    *,
    prepare: Callable[[], None] | None = None,
) -> Iterator[Outcome]:
    """The outcome of each task, in order: in this process if there is one worker, which is prepared
    then; else by the workers that `spread` takes, which run `prepare` before their first task.
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
