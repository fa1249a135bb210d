"""An arm on a rail: kinematics, separation and limits in metres. Joints beyond the tool plate have
no effect.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from support.in_process import Loop, assert_limits_hold, assert_replays, script_hands
from support.turning import ARMS, BEYOND, cell_in, sliding_cell
from thirdhand.contract.records import Cause, Mode, Reason
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.geometry import place
from thirdhand.core.separation.body import body_of
from thirdhand.core.skill.skill import Skill
from thirdhand.settings.config import Settings, robot_description
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Settings:
    return sliding_cell(tmp_path_factory.mktemp("sliding"))


def test_the_body_moves_as_the_links_do(cell: Settings) -> None:
    urdf = robot_description(cell)
    body = body_of(cell, urdf)
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    rng = np.random.default_rng(2)
    for _ in range(20):
        q = rng.uniform(cell.joints.lower, cell.joints.upper)
        pin.forwardKinematics(model, data, q)
        placed = np.empty((len(body.capsules), 2, 3))
        place(q, body.frames, body.axes, body.capsules, placed)
        for capsule, ends in zip(body.capsules, placed, strict=True):
            joint = data.oMi[int(capsule["link"])]
            np.testing.assert_allclose(ends, [joint.act(end) for end in capsule["ends"]], atol=1e-9)


def test_no_part_is_faster_than_its_bound(cell: Settings) -> None:
    body = body_of(cell, robot_description(cell))
    rng = np.random.default_rng(3)
    ends = np.empty((2, len(body.capsules), 2, 3))
    for _ in range(300):
        q = rng.uniform(cell.joints.lower, cell.joints.upper)
        velocity = np.array(cell.joints.velocity) * rng.choice([-1.0, 1.0], len(q))
        for out, posture in zip(ends, (q, q + 1e-6 * velocity), strict=True):
            place(posture, body.frames, body.axes, body.capsules, out)
        speed = np.linalg.norm(ends[1] - ends[0], axis=2).max(axis=1) / 1e-6
        assert (speed <= body.capsules["max_speed"] * (1 + 1e-4)).all()


def test_rail_follows_within_limits_and_replays(
    cell: Settings, skill: Skill, tmp_path: Path
) -> None:
    """The session replays."""
    loop = Loop(cell, skill)
    loop.hands = script_hands(HandScript(Scene(), seed=3))
    frames = loop.run(3500)
    assert (frames["mode"][1000:] == Mode.FOLLOW).all()
    assert np.ptp(frames["joints"][frames["commanded"] != 0], axis=0)[0] > 0.05, (
        "the rail is not used"
    )
    assert_limits_hold(frames, cell)
    off_mm = 1000 * np.linalg.norm(frames["tool"] - frames["setpoint"], axis=1)[1000:]
    assert np.sqrt(np.mean(off_mm**2)) < 1.0, off_mm.max()
    assert_replays(tmp_path / "a.mcap", cell, skill, loop.steps)


@pytest.mark.parametrize(("off_m", "reason"), [(0.04, Reason.NONE), (0.06, Reason.ARM_ERROR)])
def test_rail_that_does_not_follow_is_a_fault(
    cell: Settings, skill: Skill, off_m: float, reason: Reason
) -> None:
    """An error above 50 mm is a fault."""
    loop = Loop(cell, skill)
    rail = np.eye(7)[0]
    loop.reports = lambda q, dq: (q + off_m * max(0, loop.index - 200) / 100 * rail, 0.0 * dq)
    assert int(loop.run(300)["reason"][-1]) == reason


@pytest.mark.parametrize(
    ("rail_m", "cause"),
    [(0.2, None), (0.38, None), (0.42, Cause.OUT_OF_RANGE), (200.0, Cause.OUT_OF_RANGE)],
)
def test_rail_outside_limits_returns(
    cell: Settings, skill: Skill, rail_m: float, cause: Cause | None
) -> None:
    """A rail outside its limits is brought back or refused."""
    loop = Loop(cell, skill, (rail_m, *cell.arm.posture[1:]))
    loop.hands = None
    loop.reports = lambda q, dq: (q, 0.0 * dq)
    frames = loop.run(1500)
    if cause is None:
        assert not frames["rejected"][-1].any()
        assert loop.joints[0] <= 0.3
        assert np.abs(frames["joint_velocities"][frames["commanded"] != 0]).max() <= 0.06
    else:
        assert not frames["commanded"].any()
        assert int(frames["rejected"][-1][cause]) == 1500


def test_joints_beyond_plate_change_nothing(tmp_path: Path) -> None:
    plain = (ARMS / "ur5.urdf").read_text(encoding="utf-8")
    cells = []
    for name, urdf in (("plain", plain), ("more", plain.replace("</robot>", BEYOND + "</robot>"))):
        (tmp_path / name).mkdir()
        cells.append(cell_in(tmp_path / name, urdf))
    assert cells[0].joints == cells[1].joints
    arms = [ArmStage(variant, robot_description(variant)) for variant in cells]
    q = np.array(cells[0].arm.posture) + 0.1
    np.testing.assert_array_equal(arms[0].at(q).jacobian, arms[1].at(q).jacobian)
    assert len(body_of(cells[1], robot_description(cells[1])).capsules) > 5
