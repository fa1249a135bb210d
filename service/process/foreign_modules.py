"""Modules and libraries of another Python, which a terminal's variables put before this one's."""

from __future__ import annotations

import contextlib
import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path

from service.contract.explain import ExplainedError

OWN_FOLDER = Path(__file__).parents[2]


class ForeignModuleError(ExplainedError):
    """A module cannot be imported from where a variable of the environment leads."""


@contextlib.contextmanager
def named() -> Iterator[None]:
    """A context in which a failed import raises ForeignModuleError, with file and variable, if a
    folder in $PYTHONPATH has the module, or if it loads libraries from $LD_LIBRARY_PATH.
    """
    try:
        yield
    except ImportError as error:
        variable, file = "PYTHONPATH", _origin((error.name or "").partition(".")[0])
        folders = [Path(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder]
        if not any(file.is_relative_to(folder.absolute()) for folder in folders if folder != OWN_FOLDER):
            variable, file = "LD_LIBRARY_PATH", Path(error.path or "")
            if not os.environ.get(variable) or ".so" not in str(error):
                raise
        raise ForeignModuleError(
            f"{file} cannot be imported here: {error}. ${variable} leads to another Python's files, as where ROS is "
            f"sourced; a terminal without it needed, or `env -u {variable} thirdhand ...`"
        ) from None


def _origin(package: str) -> Path:
    """The file or folder from which a package would be imported; an empty path if there is none."""
    with contextlib.suppress(ImportError, ValueError):
        if package and (spec := importlib.util.find_spec(package)) is not None:
            return Path(spec.origin or next(iter(spec.submodule_search_locations or ()), ""))
    return Path()
