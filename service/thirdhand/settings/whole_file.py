"""Writing of files and folders that are complete or absent."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A context with a path for a new file or folder, which is moved to `path` once it is complete,
    and removed after a failure. A `path` that exists and is no file, like a pipe, is written
    directly.

    Raises OSError with the name of `path`.
    """
    end = Path(os.path.realpath(path))  # a link remains
    if end.exists() and not end.is_file():
        yield end
        return
    part = end.with_name(f".{end.name}.part")
    _remove(part)
    try:
        yield part
        if end.exists():
            shutil.copymode(end, part)
        if part.exists():
            part.replace(end)
    except OSError as error:
        if error.errno and str(error.filename or part).startswith(str(part)):
            raise OSError(error.errno, os.strerror(error.errno), str(path)) from None
        raise
    finally:
        _remove(part)


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)
    with contextlib.suppress(OSError):
        path.unlink()
