"""Reading of files at the start of a daemon, which continues without a damaged one."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from thirdhand.contract.explain import ExplainedError, in_file, in_words
from thirdhand.settings.file_content import content

log = logging.getLogger("thirdhand")
NOT_OURS = "it is damaged, or was not written by this service"
MAX_STATE_BYTES = 32_000_000
Restored = TypeVar("Restored")


def restored(
    path: Path, read: Callable[[bytes], Restored], otherwise: Restored, *, what: str
) -> Restored:
    """The value that `read` returns for a file's content; `otherwise` if there is no file.

    If the file cannot be read, or `read` raises any exception, the file is renamed, which the log
    reports, and `otherwise` is returned.
    """
    try:
        return read(content(path, MAX_STATE_BYTES))
    except (FileNotFoundError, NotADirectoryError):
        return otherwise
    except Exception as error:
        aside = path.with_suffix(".damaged")
        is_ours = isinstance(error, OSError | ExplainedError)
        reason = in_file(in_words(error, named=False)) if is_ours else NOT_OURS
        try:
            path.replace(aside)
        except OSError as failure:
            where = f"cannot be set aside ({failure.strerror})"
        else:
            where = f"is kept as {aside}"
        log.warning(
            "%s in %s cannot be used: %s; the file %s, and the daemon continues without it",
            what,
            path,
            reason,
            where,
        )
        return otherwise
