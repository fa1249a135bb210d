"""A first cell from a URDF alone: tool plate, posture, rates, and a demo that meets its
via-points.
"""

from __future__ import annotations

import importlib.util
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from support.arms import published
from support.demo import SCENE, soldered
from support.paths import ARMS
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.separation.stage import Separation
from thirdhand.settings.config import load, robot_description
from thirdhand.settings.urdf import Urdf
from thirdhand.workbench.first_cell.first_cell import Proposal, proposed, written
from thirdhand.workbench.first_cell.rates import rates

SAWYER = Path(__file__).with_name("sawyer.urdf")


def iiwa() -> Path:
    spec = importlib.util.find_spec("pybullet_data")
    if spec is None or spec.origin is None:
        pytest.skip("pybullet_data, whose description this is, is not installed")
    return Path(spec.origin).with_name("kuka_iiwa") / "model.urdf"


MODELS: dict[str, tuple[Callable[[], Path], str]] = {
    "iiwa": (iiwa, "lbr_iiwa_link_7"),
    "xarm7": (lambda: published("xarm7.urdf"), "link_eef"),
    "sawyer": (lambda: SAWYER, "right_hand"),
    "z1": (lambda: published("z1.urdf"), "gripperStator"),
    "ur3": (lambda: published("ur3_robot.urdf"), "tool0"),
    "ur10": (lambda: published("ur10_robot.urdf"), "tool0"),
    "kinova": (lambda: published("kinova.urdf"), "j2s6s200_end_effector"),
    "panda": (lambda: published("panda.urdf"), "panda_hand_tcp"),
    "wam": (lambda: ARMS / "wam.urdf", "tool_plate"),
}


def in_folder(proposal: Proposal, path: Path, folder: Path) -> Path:
    """The cell as the command writes it."""
    if proposal.text:
        (folder / "arm.urdf").write_text(proposal.text)
    urdf = "arm.urdf" if proposal.text else str(path)
    (folder / "cell.toml").write_text(written(proposal, urdf, path.name))
    return folder / "cell.toml"


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.one_case
def test_first_cell_meets_the_demos_places(name: str, tmp_path: Path) -> None:
    """The arm meets the demo's via-points, and its posture is over the table."""
    where, plate = MODELS[name]
    path = where()
    proposal = proposed(path, plate=plate)
    cell = load(in_folder(proposal, path, tmp_path))
    robot = robot_description(cell)
    arm = ArmStage(cell, robot)
    posture = np.array(cell.arm.posture)
    pose = arm.at(posture)
    assert pose.rotation[2, 2] < -math.cos(math.radians(50.0))
    low = [cell.table.centre[i] - cell.table.half_size[i] for i in range(2)]
    high = [cell.table.centre[i] + cell.table.half_size[i] for i in range(2)]
    assert (pose.position[:2] > low).all()
    assert (pose.position[:2] < high).all()
    assert 0.1 < pose.position[2] < 0.8
    beyond_m = Separation(cell, robot).clearance(posture, np.empty((0, 3)))[0]
    assert beyond_m > 0.0
    assert proposal.clearance[0] == pytest.approx(beyond_m + cell.obstacles.clearance)
    lower = np.array(cell.joints.lower)
    upper = np.array(cell.joints.upper)
    assert (np.minimum(posture - lower, upper - posture) > 0.05 * (upper - lower)).all()

    assert SCENE.in_reach(cell.reach) == (SCENE, ())
    run = soldered(cell)
    assert run.events.success
    assert max(run.errors_mm) < 15.0, run.errors_mm


def test_accelerations_follow_from_velocities_and_efforts(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Accelerations follow from velocities, and are lower where efforts are small."""
    text = (ARMS / "ur5.urdf").read_text()
    moving = Urdf(text).movable("tool0")
    acceleration, jerk, by_effort = rates(text, moving)
    velocity = np.array([joint.velocity for joint in moving])
    assert by_effort
    assert (np.array(acceleration) <= np.minimum(velocity / 0.25, 15.0) + 0.05).all()
    np.testing.assert_allclose(jerk, np.minimum(40.0 * np.array(acceleration), 500.0), rtol=0.01)
    weaker = text.replace('effort="150', 'effort="50').replace('effort="28', 'effort="9')
    assert max(rates(weaker, moving)[0]) < min(acceleration)
    for without in (
        re.sub(r' effort="[^"]*"', "", text),
        re.sub(r"<inertial>.*?</inertial>", "", text, flags=re.DOTALL),
    ):
        fallback, _, by_effort = rates(without, moving)
        assert not by_effort
        np.testing.assert_allclose(fallback, np.minimum(velocity / 0.25, 15.0), rtol=0.01)
    assert capfd.readouterr().err == ""
