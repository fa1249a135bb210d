"""Made tasks: people move as people do, and the tool comes to the places that are named."""

from __future__ import annotations

import numpy as np
import pytest

from thirdhand.settings.config import Reach
from thirdhand.workbench.learning.division import FOLLOW, off_via_point
from thirdhand_sim.made_tasks import TAKE_HZ, TASK_KINDS, run, takes

pytestmark = pytest.mark.thorough


def test_takes_follow_from_their_numbers() -> None:
    """Takes are the same from the same numbers and differ between people takes and seeds."""
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
def test_hands_and_tool_move_as_people_do(kind: str) -> None:
    """Hands move as hands do and the tool comes to the places."""
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
