"""Modules that are not installed, and those of another Python, which a terminal's variables put
before this one's.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path

from thirdhand.contract.explain import ExplainedError

EXTRAS = {  # the modules that each extra of the distribution brings
    "cell": (
        "kmp",
        "mcap",
        "numba",
        "numpy",
        "pinocchio",
        "psutil",
        "rich",
        "ruckig",
        "scipy",
        "threadpoolctl",
    ),
    "view": ("PIL", "rerun"),
    "learn": ("matplotlib", "sklearn", "tomlkit"),
    "formats": ("ezc3d", "rosbags"),
    "hands": ("aiohttp",),
    "camera": ("mediapipe",),
    "lerobot": ("av", "pyarrow"),
    "metrics": ("prometheus_client",),
    "sim": ("mujoco", "pybullet"),
}
EXTRA_OF = {module: extra for extra, modules in EXTRAS.items() for module in modules}


class MissingModuleError(ExplainedError):
    """A module is not installed, and belongs to an extra."""


class ForeignModuleError(ExplainedError):
    """A module cannot be imported from where a variable of the environment leads."""


@contextlib.contextmanager
def named() -> Iterator[None]:
    """A context in which a failed import raises MissingModuleError with the extra to install, or
    ForeignModuleError with file and variable, if a folder in $PYTHONPATH has the module, or if it
    loads libraries from $LD_LIBRARY_PATH.
    """
    try:
        yield
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        if isinstance(error, ModuleNotFoundError) and error.name == package and package in EXTRA_OF:
            raise MissingModuleError(
                f"{package} is not installed: pip install 'thirdhand[{EXTRA_OF[package]}]'"
            ) from None
        variable = "PYTHONPATH"
        file = _origin(package)
        folders = [
            Path(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder
        ]
        if not any(file.is_relative_to(folder.absolute()) for folder in folders):
            variable = "LD_LIBRARY_PATH"
            file = Path(error.path or "")
            if not os.environ.get(variable) or ".so" not in str(error):
                raise
        raise ForeignModuleError(
            f"{file} cannot be imported here: {error}. ${variable} leads to another Python's "
            f"files, as where ROS is sourced; a terminal without it needed, or `env -u {variable} "
            "thirdhand ...`"
        ) from None


def require(module: str) -> None:
    """Raise ModuleNotFoundError if a module is not installed, which another process will import."""
    if importlib.util.find_spec(module) is None:
        raise ModuleNotFoundError(f"No module named {module!r}", name=module)


def _origin(package: str) -> Path:
    """The file or folder from which a package would be imported; an empty path if there is none."""
    with contextlib.suppress(ImportError, ValueError):
        if package and (spec := importlib.util.find_spec(package)) is not None:
            return Path(spec.origin or next(iter(spec.submodule_search_locations or ()), ""))
    return Path()
