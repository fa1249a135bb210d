"""A cell with a Franka that franky-sim simulates, and the limits that its maker publishes."""

from __future__ import annotations

import contextlib
import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from support.paths import ROOT
from thirdhand.settings.config import JointSettings, Settings, parse

PERIOD = 0.001  # [s]
STANDS = np.array((0.0, 0.0, 0.0, -1.57, 0.0, 1.57, 0.785))  # start posture of franky-sim
# limits published by the maker
ACCELERATION = 10.0
JERK = 5000.0
Vector = npt.NDArray[np.float64]
simulated = pytest.mark.skipif(
    importlib.util.find_spec("franky_sim") is None
    or importlib.util.find_spec("pylibfranka") is None,
    reason="franky-sim or pylibfranka is not installed: pip install franky-sim 'thirdhand[franka]'",
)


def fr3() -> JointSettings:
    return JointSettings(
        names=tuple(f"fr3_joint{i}" for i in range(1, 8)),
        lower=(-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159),
        upper=(2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159),
        velocity=(1.5,) * 7,
        acceleration=(6.0,) * 7,
        jerk=(500.0,) * 7,
    )


def allowed(joints: Vector) -> tuple[Vector, Vector]:
    """Least and greatest velocities at joints (..., 7), as published for the Franka Research 3."""
    most = []
    for q, sign in ((joints, 1.0), (-joints, -1.0)):
        ends = np.array(
            (
                (2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196),
                (2.7501, 1.7918, 2.9065, 3.0481, 2.8101, -0.54092, 3.0196),
            )
        )[0 if sign > 0 else 1]
        offset = np.array((0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35))
        falls = np.array((12.0, 5.17, 7.0, 8.0, 34.0, 11.0, 34.0))
        fast = np.array((2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26))
        most.append(np.minimum(np.sqrt(falls * np.maximum(ends - q, 0.0)) - offset, fast))
    return -most[1], most[0]


def assert_allowed(velocity: Vector, joints: Vector) -> None:
    """Assert that velocities (N, 7), one a millisecond from rest, are allowed at these joints (N,
    7).
    """
    acceleration = np.diff(velocity, axis=0, prepend=0.0) / PERIOD
    jerk = np.diff(acceleration, axis=0, prepend=0.0) / PERIOD
    least, most = allowed(joints)
    assert np.isfinite(velocity).all()
    assert (velocity <= most).all()
    assert (velocity >= least).all()
    assert float(np.abs(acceleration).max()) <= ACCELERATION
    assert float(np.abs(jerk).max()) <= JERK


class Robot:
    """A simulated robot at an address; after its end, the commands that it received."""

    def __init__(self, address: str, file: Path) -> None:
        self.address = address
        self._file = file
        self.new = self.velocity = self.joints = np.empty(0)

    def load(self) -> None:
        with np.load(self._file) as cycles:
            self.new = cycles["new"]
            self.velocity = cycles["velocity"]
            self.joints = cycles["joints"]


@contextlib.contextmanager
def robot(tmp_path: Path, *options: str) -> Iterator[Robot]:
    """A context with a simulated robot."""
    script = ROOT / "tests" / "support" / "franka_robot.py"
    file = tmp_path / "cycles.npz"
    process = subprocess.Popen(
        [sys.executable, str(script), str(file), *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    arm = Robot(process.stdout.readline().strip(), file)
    try:
        yield arm
    finally:
        process.stdin.close()
        process.wait(20)
        process.stdout.close()
    arm.load()


def franka_toml() -> str:
    """Settings of a cell with a Franka, as TOML."""
    spec = importlib.util.find_spec("franky_sim")
    assert spec is not None
    assert spec.origin is not None
    joints = fr3()
    return f"""[arm]
urdf = "{Path(spec.origin).parent / "assets" / "fr3.urdf"}"
plate = "fr3_hand_tcp"
posture = {STANDS.tolist()}
link_radius = 0.09
[joints]
lower = {list(joints.lower)}
upper = {list(joints.upper)}
velocity = {list(joints.velocity)}
acceleration = {list(joints.acceleration)}
jerk = {list(joints.jerk)}
"""


def cell() -> Settings:
    """The cell of `franka_toml`."""
    return parse(franka_toml(), origin="cell.toml")
