"""Bounded reading of files: never more than expected, and no waiting for devices or pipes; and the
errors of a configuration.
"""

from __future__ import annotations

import codecs
import stat
import sys
from pathlib import Path
from typing import Any

from thirdhand.contract.explain import ExplainedError, NotAcceptedError

if sys.version_info >= (3, 11):  # noqa: UP036, as the client alone runs on 3.10 too
    import tomllib
else:
    import tomli as tomllib

LARGEST_CONFIGURATION = 1_000_000  # [bytes]
# begin of a file that stands for one of Git LFS
LFS_POINTER = b"version https://git-lfs.github.com/spec/"
NOT_FETCHED = "it is a pointer of Git LFS and not the file itself; `git lfs pull` fetches that"
MOST_DOTS = 1000  # in a line of TOML


class UnusableError(ExplainedError, ValueError):
    """A file cannot be used; the message has the cause."""


class SettingsError(NotAcceptedError):
    """A configuration cannot be used; the message has the field, its value, and accepted values."""


class UnreadableError(SettingsError):
    """A file with settings cannot be read."""

    exit_code = 1


def content(path: Path, largest_bytes: int, *, accepts_pipes: bool = False) -> bytes:
    """The bytes of a regular file, or of a pipe if these are accepted.

    Raises OSError, UnusableError, also for a pointer of Git LFS.
    """
    about = path.stat()
    is_file = stat.S_ISREG(about.st_mode)
    if not (
        is_file or stat.S_ISDIR(about.st_mode) or (accepts_pipes and stat.S_ISFIFO(about.st_mode))
    ):
        raise UnusableError("it is not a file")
    if is_file and about.st_size > largest_bytes:
        raise UnusableError(f"it has {about.st_size} bytes, at most {largest_bytes} accepted")
    with path.open("rb") as file:
        data = file.read(largest_bytes + 1)
    if len(data) > largest_bytes:
        raise UnusableError(f"it has more than {largest_bytes} bytes")
    if data.startswith(LFS_POINTER):
        raise UnusableError(NOT_FETCHED)
    return data


def begin_of(path: Path) -> bytes:
    """The first bytes of a file, which show its kind.

    Raises OSError, and UnusableError for a pointer of Git LFS, with the path.
    """
    with path.open("rb") as file:
        begin = file.read(len(LFS_POINTER))
    if begin == LFS_POINTER:
        raise UnusableError(f"{path}: {NOT_FETCHED}")
    return begin


def text_in(path: Path, *, accepts_pipes: bool = False) -> str:
    """The text of a file in UTF-8, of at most LARGEST_CONFIGURATION bytes, without a byte order
    mark. Raises OSError, UnusableError.
    """
    data = content(path, LARGEST_CONFIGURATION, accepts_pipes=accepts_pipes)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        kind = (
            "UTF-16"
            if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
            else f"not at byte {error.start}"
        )
        raise UnusableError(f"text in UTF-8 needed, and it is {kind}") from None


def toml_in(text: str) -> dict[str, Any]:
    """The content of TOML text. Raises ValueError."""
    for number, line in enumerate(text.splitlines(), start=1):
        if (dots := line.count(".")) > MOST_DOTS:  # as parts of one key they would take minutes
            raise ValueError(f"line {number} has {dots} dots, at most {MOST_DOTS} accepted")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("tables or lists are nested too deeply") from None
