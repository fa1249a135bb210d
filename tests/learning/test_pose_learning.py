"""Orientation and gripper: learned, judged, taught with via-points and stored."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.skills import at_rest, figures_of
from support.taught_scene import SCENE, VIA_POINTS, with_hands
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import SkillError, decoded
from thirdhand.skills.via_points import adapted, in_force
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.scene import TOOL_ORIENTATION
from thirdhand_sim.teach import demonstrations

TURN = np.radians(120.0) * np.array([0.0, 0.6, 0.8])
START = Rotation.from_quat(TOOL_ORIENTATION)


def turning(one: Demonstration, whole: Vector) -> Demonstration:
    """A demonstration in which the tool turns by an angle on its way to the board."""
    begin, end = SCENE.segments[2]
    share = np.clip((np.arange(len(one.tool)) * one.period_s - begin) / (end - begin), 0, 1)
    turned = (Rotation.from_rotvec(share[:, None] * whole) * START).as_quat()
    return one._replace(tool=np.hstack([one.tool[:, :3], turned]))


@pytest.fixture(scope="module")
def shown() -> list[Demonstration]:
    """Three demonstrations in which the tool turns and the gripper moves."""
    return [
        turning(take.every(2), TURN)
        for take in demonstrations(SCENE, count=3, seed=1, gripper=True)
    ]


@pytest.fixture(scope="module")
def posed(shown: list[Demonstration]) -> Skill:
    return learn(shown, components=5, points=80)


def angle_deg(skill: Skill, hands: Sequence[float], orientation: Sequence[float]) -> float:
    """The angle between the prediction for resting hands (6,) and an orientation."""
    prediction = at_rest(skill, hands).turn.orientation
    return float(
        np.degrees(
            (Rotation.from_quat(prediction) * Rotation.from_quat(orientation).inv()).magnitude()
        )
    )


def test_turn_of_120_degrees_is_learned(posed: Skill, shown: list[Demonstration]) -> None:
    figures = figures_of(posed)
    assert not any("orientation" in text for text in (*figures.unsafe, *figures.warnings))
    assert figures.orientation_error_deg < 5
    for row in (0, -1):
        take = shown[0]
        # an averaged orientation would be 60 degrees off
        assert angle_deg(posed, take.hands[row], take.tool[row, 3:]) < 15
    assert (START.inv() * Rotation.from_quat(shown[0].tool[-1, 3:])).magnitude() == pytest.approx(
        np.radians(120)
    )


def test_pose_comes_back_from_file(posed: Skill) -> None:
    """A skill with orientation and gripper comes back from its file."""
    back = decoded(posed.file, origin="x.npz")
    pose, other = (at_rest(skill, with_hands(VIA_POINTS[2])) for skill in (posed, back))
    assert pose.turn.orientation.tobytes() == other.turn.orientation.tobytes()
    assert pose.turn.covariance.tobytes() == other.turn.covariance.tobytes()
    assert pose.closure == other.closure
    assert back.digest == posed.digest


def test_via_points_teach_orientation_and_gripper(posed: Skill, skill: Skill) -> None:
    """Via-points store orientation and gripper, and return them."""
    x, y, z, w = (Rotation.from_rotvec([0.0, -0.7, 0.0]) * START).as_quat().tolist()
    point = msgspec.structs.replace(VIA_POINTS[2], orientation=(x, y, z, w), gripper="open")
    hands = with_hands(point)
    for base in (posed, skill, shipped_skill()):  # the last skill is between via-points
        taught = adapted(base, (*VIA_POINTS[:2], point), tolerance=0.05)
        assert angle_deg(taught, hands, (x, y, z, w)) < 1.0
        missed = in_force(taught)[2].missed_by_rad
        assert missed is not None
        assert missed < 0.02
        assert at_rest(taught, hands).closure < 0.1
        assert decoded(taught.file, origin="x").digest == taught.digest
        cleared = adapted(taught, (), tolerance=0.05)
        assert (cleared.turn is None, cleared.gripper is None) == (
            base.turn is None,
            base.gripper is None,
        )


def test_contradicting_via_points_are_refused(skill: Skill) -> None:
    """Via-points that contradict each other are refused."""
    x, y, z, w = TOOL_ORIENTATION
    near = ViaPoint(
        "near",
        VIA_POINTS[2].left,
        VIA_POINTS[2].right,
        VIA_POINTS[2].tool,
        std=0.01,
        orientation=(y, x, w, z),
    )
    with pytest.raises(
        SkillError, match=r"'soldering' and 'near' contradict each other: .* turned by 1\d\d°"
    ):
        adapted(
            skill,
            (msgspec.structs.replace(VIA_POINTS[2], orientation=(x, y, z, w)), near),
            tolerance=0.05,
        )
    near = msgspec.structs.replace(near, orientation=None, gripper="open")
    with pytest.raises(SkillError, match="gripper open at one and closed"):
        adapted(
            skill, (msgspec.structs.replace(VIA_POINTS[2], gripper="closed"), near), tolerance=0.05
        )


def test_gripper_in_millimetres_is_refused(shown: list[Demonstration]) -> None:
    spoilt = [take._replace(gripper=80.0 * np.asarray(take.gripper)) for take in shown]
    with pytest.raises(SkillError, match=r"from 0 to 80: 0 \(open\) to 1 \(closed\) needed"):
        learn(spoilt, components=5, points=60)


@pytest.mark.parametrize("turn_deg", [200, 300, 400, 480])
def test_more_than_half_a_turn_is_learned(turn_deg: int) -> None:
    """The signs of each take's quaternions do not matter."""
    figures = figures_of(learn([spinning(seed, turn_deg) for seed in range(4)], points=60))
    assert figures.orientation_error_deg < 15
    assert figures.unsafe == ()


def test_wrongly_learned_turns_are_unsafe() -> None:
    """A skill whose tool turns wrongly is unsafe."""
    figures = figures_of(learn([spinning(seed, 1500) for seed in range(4)], points=60))
    assert any("up to 60° accepted: it turns by up to" in line for line in figures.unsafe)


def spinning(seed: int, turn_deg: float) -> Demonstration:
    """A take in which the tool turns as the hands move; takes differ by some degrees."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, 8.0, 0.04)
    progress = 0.5 - 0.5 * np.cos(np.pi * t / 8)
    ones = np.ones_like(t)
    unturned = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    left = np.stack(
        [0.4 + 0.5 * progress, 0.3 * ones, 0.3 + 0.05 * np.sin(3 * progress)], axis=1
    ) + 0.01 * random.normal(size=3)
    right = np.stack(
        [0.5 + 0.4 * progress, -0.3 * ones, 0.3 * ones], axis=1
    ) + 0.01 * random.normal(size=3)
    turn = Rotation.from_rotvec(
        np.radians(turn_deg * progress + 2 * random.normal())[:, None] * [0.0, 0.0, 1.0]
    ).as_quat()
    tool = 0.5 * (left + right) + [0.0, 0.0, 0.2]
    positions = [
        position + 1e-3 * random.normal(size=position.shape) for position in (left, right, tool)
    ]
    turns = (unturned, unturned, turn * random.choice([-1.0, 1.0]))
    return Demonstration(
        np.round(1e9 * t).astype(np.int64), *map(np.hstack, zip(positions, turns, strict=True))
    )
