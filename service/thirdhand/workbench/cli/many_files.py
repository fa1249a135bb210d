"""Commands on many files: one file that cannot be used does not stop the others."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from thirdhand.contract.explain import ExplainedError, in_file
from thirdhand.process.parallel import attempt, spread
from thirdhand.process.progress import progress, say

Found = TypeVar("Found")


def of_each(
    args: argparse.Namespace,
    what: str,
    work: Callable[[Path], Found],
    *,
    alone: Callable[[Path], Found] | None = None,
) -> list[tuple[Path, Found]]:
    """The files of a command line for which there is an outcome, with it, in the given order. The
    others are named on standard error. The error of a single file is raised.

    The work is spread over `args.workers`, and must be a function that can be pickled; `alone` is
    for a single file, in this process.
    """
    paths: list[Path] = args.files
    if len(paths) == 1:
        return [(paths[0], (alone or work)(paths[0]))]
    results = []
    with progress(what, unit="files", total=len(paths)) as done:
        outcomes = spread(functools.partial(attempt, work), paths, args.workers or "1")
        for i, (path, outcome) in enumerate(zip(paths, outcomes, strict=True), start=1):
            done(i)
            if isinstance(outcome, ExplainedError):
                where = "" if path.name in str(outcome) else f"{path}: "
                say(f"thirdhand {args.command}: {where}{in_file(str(outcome))}")
            else:
                results.append((path, outcome))
    if len(results) < len(paths):
        say(
            f"thirdhand {args.command}: {len(paths) - len(results)} of {len(paths)} files cannot "
            "be used"
        )
    return results
