"""Import of PyBullet without the line that it prints on standard error."""

from __future__ import annotations

import os
import sys

__all__ = ["pybullet"]

sys.stderr.flush()
_shown = os.dup(2)
_nowhere = os.open(os.devnull, os.O_WRONLY)
os.dup2(_nowhere, 2)
try:
    import pybullet
finally:
    os.dup2(_shown, 2)
    os.close(_shown)
    os.close(_nowhere)
