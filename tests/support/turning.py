"""Arms with continuous and sliding joints, made of the shipped UR5."""

from __future__ import annotations

import math
import re
from pathlib import Path

from support.paths import ARMS
from thirdhand.settings.config import Settings, load

CONTINUOUS = ("shoulder_pan_joint", "wrist_1_joint", "wrist_3_joint")
# [rad] base joint at the start posture; the task moves it to both sides of pi
NEAR_SEAM = math.pi - 0.02
BASE = '<origin xyz="0 0 0.089159"/>'
# Joints without commands: a gripper with <mimic>, a wheel, floating objects.
BEYOND = "".join(
    f'<link name="{name}"><collision><geometry><sphere '
    'radius="0.02"/></geometry></collision></link>'
    f'<joint name="{name}_joint" type="{kind}"><parent link="{parent}"/><child '
    f'link="{name}"/>{more}</joint>'
    for name, kind, parent, more in (
        ("finger", "prismatic", "tool0", '<limit lower="0" upper="0.04" velocity="1" effort="1"/>'),
        (
            "thumb",
            "prismatic",
            "tool0",
            '<limit lower="0" upper="0.04" velocity="1" effort="1"/><mimic joint="finger_joint"/>',
        ),
        ("wheel", "continuous", "tool0", ""),
        ("cart", "floating", "base_link", '<origin xyz="0 0 -3"/>'),
        ("sheet", "planar", "base_link", '<origin xyz="0 0 -3"/>'),
    )
)


def _kind(urdf: str, joint: str, kind: str) -> str:
    return urdf.replace(
        f'<joint name="{joint}" type="revolute">', f'<joint name="{joint}" type="{kind}">'
    )


def continuous_urdf() -> str:
    """The UR5 with three continuous joints; its base is turned, so that the first joint is near pi
    at the start posture.
    """
    urdf = (ARMS / "ur5.urdf").read_text(encoding="utf-8")
    for joint in CONTINUOUS:
        urdf = _kind(urdf, joint, "continuous")
    yaw = -0.407 - NEAR_SEAM
    return urdf.replace(BASE, f'<origin xyz="0 0 0.089159" rpy="0 0 {yaw!r}"/>', 1)


def sliding_urdf() -> str:
    """The UR5 on a rail across the table, along which it slides by 0.3 m each way."""
    urdf = (ARMS / "ur5.urdf").read_text(encoding="utf-8").replace('"base_link"', '"carriage"')
    rail = (
        '<link name="base_link"/><joint name="rail_joint" type="prismatic"><parent '
        'link="base_link"/>'
        '<child link="carriage"/><axis xyz="0 1 0"/><limit lower="-0.3" upper="0.3" effort="500" '
        'velocity="0.5"/>'
        "</joint>"
    )
    return re.sub(r"(<robot[^>]*>)", lambda found: found[1] + rail, urdf, count=1)


def cell_in(folder: Path, urdf: str, **changed: tuple[float, ...] | str) -> Settings:
    """The shipped UR5's cell with another description and other numbers."""
    (folder / "arm.urdf").write_text(urdf, encoding="utf-8")
    text = (ARMS / "ur5.toml").read_text(encoding="utf-8").replace("ur5.urdf", "arm.urdf")
    for name, value in changed.items():
        literal = f'"{value}"' if isinstance(value, str) else str(list(value))
        text = re.sub(rf"^{name} = .*$", f"{name} = {literal}", text, flags=re.MULTILINE)
    (folder / "cell.toml").write_text(text, encoding="utf-8")
    return load(folder / "cell.toml")


def continuous_cell(folder: Path) -> Settings:
    """A cell with `continuous_urdf`."""
    return cell_in(
        folder, continuous_urdf(), posture=(NEAR_SEAM, -1.676, 2.118, -2.755, -1.287, 0.0)
    )


def sliding_cell(folder: Path) -> Settings:
    """A cell with `sliding_urdf`."""
    return cell_in(
        folder,
        sliding_urdf(),
        posture=(0.0, -0.407, -1.676, 2.118, -2.755, -1.287, 0.0),
        velocity=(0.4, *(2.0,) * 6),
        acceleration=(2.0, 12.0, 12.0, 15.0, 15.0, 15.0, 15.0),
        jerk=(100.0, *(500.0,) * 6),
    )
