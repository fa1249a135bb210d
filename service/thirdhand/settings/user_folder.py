"""The folders of this user in which the commands keep files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from thirdhand.contract.explain import ExplainedError

IN_HOME = {"cache": ".cache", "config": ".config", "state": ".local/state"}


class HomelessError(ExplainedError, OSError):
    """The user has no home folder, and no variable names another one."""


def user_folder(kind: Literal["cache", "config", "state"]) -> Path:
    """The user's folder for files of a kind: `thirdhand` in $XDG_CACHE_HOME, $XDG_CONFIG_HOME or
    $XDG_STATE_HOME if that is an absolute path, else in the home folder. Raises HomelessError.
    """
    variable = f"XDG_{kind.upper()}_HOME"
    folder = Path(os.environ.get(variable) or "")
    if not folder.is_absolute():
        try:
            folder = Path.home() / IN_HOME[kind]
        except RuntimeError:
            raise HomelessError(
                f"this user has no home folder; ${variable} or $HOME needed"
            ) from None
    return folder / "thirdhand"
