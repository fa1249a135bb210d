"""Usage errors and checks of arguments that the commands share."""

from __future__ import annotations

import argparse
import difflib
import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from service.contract.requests import Add, ViaPoint

CONNECT_TIMEOUT_S = 3.0


class UsageError(ValueError):
    """The command line is not valid."""


class Parser(argparse.ArgumentParser):
    """A parser that suggests the nearest choice for an unknown one."""

    def error(self, message: str) -> NoReturn:
        """Prints usage and message, and exits with code 2."""
        found = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        words = re.findall(r"[\w-]+", found[2]) if found else []
        near = difflib.get_close_matches(found[1], words, n=1, cutoff=0.5) if found else []
        super().error(message + (f"; did you mean {near[0]}?" if near else ""))


def check_cell(name: str) -> None:
    """Raises UsageError where a cell cannot have this name."""
    from service.config import converted  # heavy
    from service.described_arm import SettingsError

    try:
        converted({"cell": name}, origin="--cell")
    except SettingsError as error:
        raise UsageError(str(error)) from None


def check_writable(path: Path) -> None:
    """Raises UsageError where no file can be written at this path; for a check before long work."""
    folder = path.parent
    if path.is_dir():
        raise UsageError(f"{path} is a folder, the name of a file needed")
    if not folder.is_dir():
        raise UsageError(f"{path}: there is no folder {folder}")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise UsageError(f"{path} cannot be written: no permission")


def added_in(path: Path) -> Add:
    """The request to add via-points in a file (-: standard input). Raises RequestError, OSError."""
    from service.contract.requests import Add, decode_request  # heavy

    request: Add = decode_request(sys.stdin.buffer.read() if str(path) == "-" else path.read_bytes(), Add)
    return request


def places_in(path: Path) -> tuple[ViaPoint, ...]:
    """The via-points in such a file. Raises RequestError, which names the file, and OSError."""
    from service.contract.requests import RequestError  # heavy

    try:
        return added_in(path).points
    except RequestError as error:
        raise RequestError(f"{path}: {error}") from None
