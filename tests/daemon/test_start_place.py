"""A task whose hands rest beside its start begins there, and at its usual start again later."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.cell import Tracker, serving, until
from thirdhand.client import Client
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.skill.segmented import SegmentedKMP
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import StoredSkill
from thirdhand.skills.via_points import (
    BESIDE_START_M,
    FROM_START_M,
    StartPlace,
    adapted,
    with_points,
)
from thirdhand_sim.lab.open_loop import controller
from thirdhand_sim.lab.people.comparison import PEOPLE_METHODS
from thirdhand_sim.lab.people.trials import judge, seen
from thirdhand_sim.scene import Scene
from thirdhand_sim.sessions import BREAKING, breaking, demonstrations

SCENE = Scene()
LEFT = np.array(SCENE.left_start)
RIGHT = np.array(SCENE.right_start)
BESIDE = np.array((0.1, -0.1, 0.0))


def starts(client: Client) -> dict[str, ViaPoint]:
    return {point.name: point for point in client.via_points()}


@pytest.mark.thorough
def test_the_daemon_begins_where_hands_rest(tmp_path: Path) -> None:
    """The start moves with the hands, and back."""
    with serving(tmp_path, "--joints", "assumed") as daemon, Tracker(daemon.session) as hands:
        client = daemon.client
        hands.left = tuple(LEFT + BESIDE)
        hands.right = tuple(RIGHT)
        until(lambda: "start" in starts(client))
        moved = starts(client)
        np.testing.assert_allclose(moved["start"].left, LEFT + BESIDE, atol=0.005)
        assert "the task begins where the hands rest: start moved" in daemon.log.read_text()
        hands.left = tuple(LEFT)
        until(lambda: np.linalg.norm(starts(client)["start"].left - LEFT) < BESIDE_START_M)


@pytest.mark.parametrize(
    ("off_m", "is_moved"),
    [(0.0, False), (BESIDE_START_M - 0.02, False), (0.15, True), (FROM_START_M + 0.02, False)],
)
def test_only_hands_beside_the_start_move_it(off_m: float, is_moved: bool) -> None:
    settings = Settings()
    skill = shipped_skill()
    state = controller(skill, settings).state
    start = StartPlace(settings.period_s)
    assert isinstance(skill.model, SegmentedKMP)
    hands = skill.model.placed.segments["begins"][0] - np.array((0.0, off_m, 0.0))
    state["hands"][:, 0] = hands
    state["hand_stillness"] = 1.0
    found = []
    for tick in range(0, round(1.0 / settings.period_s), 50):
        state["tick"] = tick
        found.append(start.moved(skill, state))
    assert [bool(points) for points in found] == [
        is_moved and tick >= 0.5 / settings.period_s
        for tick in range(0, round(1.0 / settings.period_s), 50)
    ]
    state["hand_stillness"] = 0.0
    assert not start.moved(skill, state)


def test_the_usual_start_is_not_forgotten() -> None:
    """However often the start was moved, hands at the usual one begin there again; what was refused
    is not proposed again before the hands move; and a start that is taught anew is the usual one.
    """
    settings = Settings()
    skill = shipped_skill()
    state = controller(skill, settings).state
    start = StartPlace(settings.period_s)

    def proposed(hands: np.ndarray) -> list[ViaPoint]:
        for stillness in (0.0, 1.0, 1.0):
            state["hands"][:, 0] = hands
            state["hand_stillness"] = stillness
            state["tick"] += round(1.0 / settings.period_s)
            points = start.moved(skill, state)
        return points

    def taught(points: list[ViaPoint]) -> StoredSkill:
        return adapted(skill, with_points(skill, points), tolerance=skill.tolerance)

    assert isinstance(skill.model, SegmentedKMP)
    usual = skill.model.placed.segments["begins"][0].copy()
    assert not proposed(usual)
    for step in (1.0, 2.0):
        hands = usual - step * np.array((0.0, 0.14, 0.0))
        points = proposed(hands)
        assert points
        skill = taught(points)
        start.taken()
        assert not proposed(hands)
    points = proposed(usual)
    assert points
    start.refused()
    state["tick"] += 10_000
    assert not start.moved(skill, state)
    points = proposed(usual)
    assert points
    np.testing.assert_allclose(points[0].left, usual[0])
    skill = taught([ViaPoint(points[0].name, *(usual + 0.1).tolist(), points[0].tool)])
    assert not proposed(usual + 0.1)
    assert not proposed(usual + 0.5)


@pytest.mark.thorough
def test_sessions_that_start_15_cm_beside_succeed() -> None:
    (service,) = PEOPLE_METHODS["ours"].candidates
    model = service.learn(demonstrations(4))
    for number in range(3):
        one = seen(breaking(BREAKING[1], number, group="tuning"))
        assert judge(model.place(one.session.told), one).success
