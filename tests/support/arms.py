"""Cells with arms of other authors, a Panda with locked fingers and a UR5 of six joints, and with
the shipped arm.
"""

from __future__ import annotations

import json
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import NamedTuple

import pytest

from support.in_process import ASSUMED
from thirdhand.settings.config import Settings, parse


class Model(NamedTuple):
    """An arm: its file in `example-robot-data`, the link that carries the tool, and the joints at
    the tool's start [rad].
    """

    file: str
    plate: str
    posture: tuple[float, ...]


# In these postures the tool is where demonstrations begin, and points 45 degrees down.
MODELS = {
    "panda": Model(
        "panda.urdf", "panda_hand_tcp", (0.045, -0.527, -0.145, -2.885, 0.071, 3.138, 0.8)
    ),
    "ur5": Model("ur5_robot.urdf", "tool0", (-0.39, -1.67, 2.129, -2.772, -1.303, 0.0)),
}


def published(file: str) -> Path:
    """A file of `example-robot-data`, by the end of its path; skips if that package is not
    installed.
    """
    try:
        return next(
            Path(str(f.locate()))
            for f in files("example-robot-data") or ()
            if f"/{f}".endswith(f"/{file}")
        )
    except PackageNotFoundError:
        pytest.skip("example-robot-data, whose descriptions these are, is not installed")


def toml_of(model: Model, **changed: str) -> str:
    """The settings of a cell with this arm; empty lines are omitted."""
    count = len(model.posture)
    lines = {
        "urdf": f"[arm]\nurdf = {json.dumps(str(published(model.file)))}",
        "plate": f'plate = "{model.plate}"',
        "source": 'source = "assumed"',
        "posture": f"posture = {list(model.posture)}",
        "acceleration": f"[joints]\nacceleration = {[10.0] * count}",
        "jerk": f"jerk = {[500.0] * count}",
    }
    return "\n".join((lines | changed).values())


def cell_of(name: str) -> Settings:
    """A cell with one of the models, or `wam`, whose arm is assumed to be at its start posture."""
    return ASSUMED if name == "wam" else parse(toml_of(MODELS[name]), origin=name)
