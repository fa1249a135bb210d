"""What the commands share: the error of a command line that cannot be meant, and where the shipped
files are.
"""

from __future__ import annotations

from pathlib import Path

CONNECT_TIMEOUT_S = 3.0
SHIPPED_SKILL = "soldering.npz"


class UsageError(ValueError):
    """A command line that cannot be meant."""


def recordings() -> Path:
    """The folder of the shipped recordings and their skill."""
    service = Path(__file__).parents[1]
    folders = (service / "recordings", service.parent / "recordings")
    return next((folder for folder in folders if folder.is_dir()), folders[1])
