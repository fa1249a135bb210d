"""Made tasks: people move as people do, and the tool comes to the places that are named."""

from __future__ import annotations

import numpy as np
import pytest

from thirdhand.settings.config import Reach
from thirdhand.workbench.learning.division import FOLLOW, off_via_point
from thirdhand_sim.made_tasks import (
    CARRIED_M,
    LEAD_S,
    REACTION_S,
    TAKE_HZ,
    TASK_KINDS,
    run,
    takes,
)
from thirdhand_sim.sessions import along

pytestmark = pytest.mark.thorough


def test_takes_are_the_same_from_the_same_numbers_and_differ_between_people_takes_and_seeds() -> None:
    for kind in TASK_KINDS[:3]:
        one, other = (takes(kind, people=(0, 1), each=2) for _ in range(2))
        assert [take.person for take in one] == [0, 0, 1, 1]
        for a, b in zip(one, other, strict=True):
            for name in ("stamps_ns", "left", "right", "tool"):
                assert getattr(a.demonstration, name).tobytes() == getattr(b.demonstration, name).tobytes()
            assert a.demonstration.places == b.demonstration.places
        one += takes(kind, people=(0,), each=1, seed=1)
        assert len({take.demonstration.left.tobytes() for take in one}) == 5


@pytest.mark.parametrize("kind", TASK_KINDS)
def test_hands_move_as_hands_do_and_the_tool_comes_to_the_places(kind: str) -> None:
    for who in range(3):
        one = run(kind, who, 0)
        times = np.arange(0.0, one.lasts_s, 0.005)
        velocity = np.gradient(one.hands(times).reshape(-1, 2, 3), 0.005, axis=0)
        assert np.linalg.norm(velocity, axis=2).max() <= 2.0
        assert np.linalg.norm(np.gradient(velocity, 0.005, axis=0), axis=2).max() <= 16.0
        shown = one.demonstration()
        assert shown.period_s == pytest.approx(1.0 / TAKE_HZ)
        assert np.abs(np.linalg.norm(np.stack(shown[1:4])[..., 3:], axis=-1) - 1.0).max() < 1e-9
        for i in one.order:
            assert off_via_point(shown, shown.places[i], FOLLOW[shown.places[i].follow]).min() < 0.02
        reach = Reach()
        away = np.linalg.norm(shown.tool[:, :3] - reach.centre, axis=1)
        assert away.max() < reach.outer
        assert shown.tool[:, 2].min() > reach.min_z


@pytest.mark.parametrize("kind", TASK_KINDS)
def test_takes_move_every_place(kind: str) -> None:
    places = np.array([[p.tool for p in take.demonstration.places] for take in takes(kind, people=range(8), each=1)])
    spread = places.std(axis=0)
    assert 0.04 < spread[:, :2].mean() < 0.10
    assert spread.min() > 0.005
    assert spread.max() < 0.2


def test_the_kinds_are_what_they_say() -> None:
    cyclic = run("cyclic", 0, 0)
    out, again = (cyclic.task.names.index(name) for name in ("left out", "left out again"))
    assert np.array_equal(cyclic.scene.left[out], cyclic.scene.left[again])
    assert np.linalg.norm(cyclic.scene.tool[out] - cyclic.scene.tool[again]) > 0.08
    ahead = run("ahead", 0, 0)
    began = [next(leg.begin_s for leg in legs if leg.progress[0] < leg.progress[1]) for legs in ahead.legs]
    assert began[1] - began[0] == pytest.approx(LEAD_S, abs=0.5)
    orders = {run("loose", who, 0).order for who in range(24)}
    assert {len(order) for order in orders} == {5, 6, 8}
    lasts = [run("long", who, 0).lasts_s for who in range(3)]
    assert all(150 < s < 260 for s in lasts)
    resting = np.array([run("one_hand", who, 0).scene.right[0] for who in range(8)])
    assert resting.std(axis=0)[:2].min() > 0.08


def test_the_tool_is_fixed_to_what_a_hand_carries_and_comes_late() -> None:
    one = run("heading", 1, 0)
    times = np.arange(0.0, one.lasts_s, 0.02)
    tool, _ = one.tool(times)
    fixed = [
        np.abs(np.linalg.norm(tool - along(one.legs[0], times - s)[0], axis=1) - np.linalg.norm(CARRIED_M)).max()
        for s in np.linspace(*REACTION_S, 61)
    ]
    assert min(fixed) < 0.004
    assert fixed[0] > min(fixed)
    turned = [np.ptp(run("heading", who, 0).scene.turns[:, 0]) for who in range(8)]
    assert np.mean(turned) > 0.4
