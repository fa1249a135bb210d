"""The reach follows from the kinematics and the mounting of the arm; a configured reach beyond it
is refused.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from support.turning import sliding_cell
from support.ur5_cell import UR5, cell_in
from thirdhand.core.arm.stage import ArmStage
from thirdhand.recordings.shipped import ARMS, cell_of
from thirdhand.settings.config import Settings, robot_description
from thirdhand.settings.file_content import SettingsError
from thirdhand.settings.reachable import Shell, Workspace, workspace_of
from thirdhand.settings.urdf import Urdf

MOUNTS = {
    "as it is": None,
    "0.6 m to the right": ("0 -0.6 0", "0 0 0"),
    "on a stand": ("-0.3 0.4 0.4", "0 0 0.7"),
    "from the ceiling": ("0.5 0 1.2", "3.14159265 0 0"),
    "from a wall": ("0 0.7 0.6", "1.57079633 0 0"),
}


def mounted(text: str, xyz: str, rpy: str) -> str:
    return text.replace(
        "</robot>",
        '<link name="world"/><joint name="mount" type="fixed"><parent link="world"/><child '
        'link="base_link"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/></joint></robot>',
    )


def workspace(cell: Settings) -> Workspace:
    """The workspace of a cell's arm, by its kinematics."""
    chain = Urdf(robot_description(cell)).chain(cell.arm.plate)
    joints = cell.joints
    return workspace_of(chain, joints.lower, joints.upper, cell.tool.plate_from_tool)


def reached(cell: Settings, points: NDArray[np.float64]) -> float:
    """The share of points (N, 3) [m] that the arm reaches within 1 cm, by damped least squares from
    several postures.
    """
    arm = ArmStage(cell, robot_description(cell))
    lower = np.maximum(cell.joints.lower, -math.pi)
    upper = np.minimum(cell.joints.upper, math.pi)
    random = np.random.default_rng(3)
    count = 0
    for point in points:
        for _ in range(25):
            q = random.uniform(lower, upper)
            damping = 1e-3
            for _ in range(60):
                pose = arm.at(q)
                error = point - pose.position
                if (distance := float(np.linalg.norm(error))) < 0.01:
                    break
                jacobian = pose.jacobian[:3]
                step = jacobian.T @ np.linalg.solve(
                    jacobian @ jacobian.T + damping * np.eye(3), error
                )
                q = np.clip(
                    q + step * min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-9)), lower, upper
                )
            if distance < 0.01:
                count += 1
                break
    return count / len(points)


def targets(cell: Settings, count: int) -> NDArray[np.float64]:
    """Points (N, 3) of the default reach [m]."""
    reach = cell.reach
    random = np.random.default_rng(1)
    points = np.array(reach.centre) + reach.outer * random.uniform(-1.0, 1.0, (50 * count, 3))
    away = np.linalg.norm(points - reach.centre, axis=1)
    is_inside = (
        (away >= reach.inner)
        & (away <= reach.outer)
        & (points[:, 0] >= reach.min_x)
        & (points[:, 2] >= reach.min_z)
    )
    return points[is_inside][:count]


@pytest.mark.parametrize("mount", MOUNTS.values(), ids=MOUNTS)
def test_targets_of_the_default_reach_are_reached(
    mount: tuple[str, str] | None, tmp_path: Path
) -> None:
    """Inverse kinematics finds a posture for each."""
    cell = cell_in(tmp_path, mounted(UR5, *mount) if mount else UR5)
    assert cell.reach.outer > 0.85
    assert reached(cell, targets(cell, 60)) >= 0.95


@pytest.mark.parametrize("arm", ARMS)
def test_shipped_cells_have_the_reach_of_their_kinematics(arm: str) -> None:
    """The numbers agree approximately."""
    cell = cell_of(arm)
    reach = cell.reach
    space = workspace(cell)
    shell = space.shell(reach.min_x, reach.min_z)
    assert shell.centre == pytest.approx(reach.centre, abs=0.001)
    assert shell.outer == pytest.approx(reach.outer, abs=0.07)
    assert (
        space.share(Shell(reach.centre, reach.inner, reach.outer), reach.min_x, reach.min_z) > 0.99
    )


def test_an_arm_on_a_rail_reaches_along_it(tmp_path: Path) -> None:
    cell = sliding_cell(tmp_path)
    space = workspace(cell)
    assert space.shoulder == pytest.approx((0.0, 0.0, 0.089), abs=1e-3)
    assert 1.15 < space.extent < 0.95 + 0.31  # the rail is 0.3 m long each way
    ends = np.array([(0.5, y, 0.2) for y in (-1.05, 1.05, -1.3, 1.3)])
    assert space.reaches(ends).tolist() == [True, True, False, False]
    assert reached(cell, targets(cell, 40)) >= 0.95


@pytest.mark.parametrize(
    ("mount", "reach", "share"),
    [
        (
            ("0 -0.6 0", "0 0 0"),
            "centre = [0.0, 0.0, 0.089]\ninner = 0.3\nouter = 0.85",
            r"[56]\d %",
        ),
        (("0 0 0", "0 0 0"), "outer = 2.0", r"[12]?\d %"),
        (("-2.5 0 0", "0 0 0"), "", "0 %"),
        (("0 0 0", "0 0 0"), "min_x = 1.0", "0 %"),
    ],
)
def test_impossible_reach_is_refused(
    mount: tuple[str, str], reach: str, share: str, tmp_path: Path
) -> None:
    """The error names the arm's reach."""
    with pytest.raises(
        SettingsError,
        match=rf"\[reach\]: the arm reaches {share} of it; at least .*By its kinematics",
    ):
        cell_in(tmp_path, mounted(UR5, *mount), f"[reach]\n{reach}\n")
