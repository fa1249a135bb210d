"""Files that a daemon reads as it starts: none of them, however damaged, keeps it from starting."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from service.contract.explain import ExplainedError, in_file, in_words
from service.settings.file_content import content

log = logging.getLogger("thirdhand")
NOT_OURS = "it is damaged, or was not written by this service"
LARGEST_BYTES = 32_000_000
T = TypeVar("T")


def restored(path: Path, read: Callable[[bytes], T], otherwise: T, *, what: str) -> T:
    """The value that `read` makes of a file's content; `otherwise` where there is no file.

    A file that cannot be read, or of which `read` makes an exception of whatever kind, is set aside
    under another name, which the log reports, and `otherwise` is returned.
    """
    try:
        return read(content(path, LARGEST_BYTES))
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
            "%s in %s cannot be used: %s; the file %s, and the daemon goes on without it", what, path, reason, where
        )
        return otherwise
