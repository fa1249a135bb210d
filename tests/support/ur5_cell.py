"""Cells of a UR5 with their own URDF and settings."""

from __future__ import annotations

from pathlib import Path

from support.paths import ARMS
from thirdhand.settings.config import Settings, load

UR5 = (ARMS / "ur5.urdf").read_text(encoding="utf-8")
CELL = f"""
[arm]
urdf = "arm.urdf"
plate = "tool0"
posture = [-0.407, -1.676, 2.118, -2.755, -1.287, 0.0]
[joints]
acceleration = {[10.0] * 6}
jerk = {[500.0] * 6}
"""


def cell_in(folder: Path, urdf: str | bytes, more: str = "") -> Settings:
    """The cell of a URDF in a folder, with more lines in its settings."""
    (folder / "arm.urdf").write_bytes(urdf if isinstance(urdf, bytes) else urdf.encode())
    (folder / "cell.toml").write_text(CELL + more)
    return load(folder / "cell.toml")
