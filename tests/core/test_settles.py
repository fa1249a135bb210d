"""Where hands rest, the arm comes to rest: with slow joints, a slow tracker, long tools, all of the
orientation, on every arm.

`THIRDHAND_EXAMPLES=100 pytest tests/core/test_settles.py` draws more cells.
"""

from __future__ import annotations

import os

import numpy as np
import pytest
from msgspec.structs import replace

from service.contract.records import Mode
from service.core.controller import Controller, start_state
from service.core.frame import Frame, Tick, Vector
from service.core.skill.skill import Skill
from service.learning.via_points import adapted
from service.settings.config import Settings, robot_description
from sim.scene import Scene
from support.arms import cell_of
from support.in_process import hand
from support.starts import free_postures

EXAMPLES = int(os.environ.get("THIRDHAND_EXAMPLES", "2"))
AT_REST = 0.02  # [rad/s²] rms of each joint


@pytest.fixture(scope="module")
def taught(skill: Skill) -> Skill:
    return adapted(skill, Scene().via_points(), tolerance=0.05)


def changed(cell: Settings, *, rate_hz: int, slower: float = 1.0, jerk: float = 1.0, **tool: object) -> Settings:
    """The cell with a share of its joints' speed and acceleration, and of their jerk."""
    joints = cell.joints
    return replace(
        cell,
        rate_hz=rate_hz,
        tool=replace(cell.tool, **tool),
        joints=replace(
            joints,
            velocity=tuple(slower * v for v in joints.velocity),
            acceleration=tuple(slower * a for a in joints.acceleration),
            jerk=tuple(jerk * j for j in joints.jerk),
        ),
    )


def accelerations(cell: Settings, skill: Skill, start: Vector, hands: list[Vector], seconds: float) -> Vector:
    """The last second's joint accelerations (T, J) [rad/s²] of an arm that starts somewhere; the
    hands (2, 3) go from the first place to the second at 2 s, and rest there.
    """
    state = start_state(cell, skill)
    state["joints"][0] = start
    controller, dt = Controller(cell, skill, state, urdf=robot_description(cell)), cell.period_s
    every, seen = max(1, round(0.01 / dt)), []
    for k in range(1, round(seconds / dt)):
        u = min(max((k * dt - 2.0) / 0.8, 0.0), 1.0)
        at = hands[0] + u**3 * (10 - 15 * u + 6 * u * u) * (hands[1] - hands[0])
        sampled = [hand(side, tuple(p.tolist()), k) for side, p in zip(("left", "right"), at, strict=True)]
        frame: Frame = controller.step(Tick(k, tuple(sampled) if k % every == 1 else ()))
        assert frame["mode"] in (Mode.FOLLOW, Mode.HOLD)
        if k * dt > seconds - 1.0:
            seen.append(frame["joint_accelerations"])
    return np.array(seen)


def rms(values: Vector) -> float:
    return float(np.sqrt(np.mean(values**2, axis=0)).max())


@pytest.mark.parametrize(("number", "name"), [(2, "glass"), (11, "start")])
def test_joints_that_change_their_acceleration_slowly_come_to_rest(taught: Skill, number: int, name: str) -> None:
    cell = changed(cell_of("panda"), rate_hz=250, jerk=0.2, orientation="full")
    rest = taught.hands.reshape(-1, 2, 3)[taught.model.names.index(name)]
    found = accelerations(cell, taught, free_postures(cell, 1, number)[0], [rest, rest], 16.0)
    assert rms(found) < AT_REST


def test_a_clearance_greater_than_the_arms_own_gaps_does_not_swing_it(taught: Skill) -> None:
    """Of its elbow from its base, which are 12.2 cm apart as it stands."""
    cell = replace(cell_of("wam"), rate_hz=250, obstacles=replace(Settings().obstacles, clearance=0.12))
    places = taught.hands.reshape(-1, 2, 3)
    rest = places[np.random.default_rng(12).integers(len(places))]
    found = accelerations(cell, taught, np.array(cell.arm.posture), [rest, rest], 16.0)
    assert rms(found) < AT_REST


@pytest.mark.parametrize(
    ("rate_hz", "tool"), [(250, {"jerk_weight": 1e-11, "max_jerk": 43.0}), (500, {"max_jerk": 2.0})]
)
def test_a_tool_of_little_jerk_comes_to_rest(taught: Skill, rate_hz: int, tool: dict[str, float]) -> None:
    cell, places = changed(cell_of("panda"), rate_hz=rate_hz, **tool), taught.hands.reshape(-1, 2, 3)
    hands = list(places[np.random.default_rng(0).integers(len(places), size=2)])
    assert rms(accelerations(cell, taught, np.array(cell.arm.posture), hands, 16.0)) < AT_REST


@pytest.mark.parametrize("number", sorted({*range(EXAMPLES), 10}))  # 10: once swung for ever
def test_whatever_the_cell_the_arm_comes_to_rest(taught: Skill, number: int) -> None:
    random, cell = np.random.default_rng(number), cell_of(("wam", "panda", "ur5")[number % 3])
    cell = changed(
        cell,
        rate_hz=int(random.choice([250, 500, 1000])),
        slower=float(random.choice([0.3, 1.0])),
        jerk=float(random.choice([0.2, 0.5, 1.0])),
        jerk_weight=float(random.choice([1e-11, 2.8e-9, 1e-5])),
        orientation=str(random.choice(["direction", "full"])),
        plate_from_tool=(0.0, 0.0, float(random.choice([0.0, 0.2])), 0.0, 0.0, 0.0, 1.0),
    )
    places = taught.hands.reshape(-1, 2, 3)
    hands = [
        places[random.integers(len(places))],
        places[random.integers(len(places))] + random.normal(0, 0.03, (2, 3)),
    ]
    found = accelerations(cell, taught, np.array(cell.arm.posture), hands, 20.0)
    assert rms(found) < AT_REST
