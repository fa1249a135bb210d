"""Made tasks: hands move as people's do, and the tool reaches the named places."""

from __future__ import annotations

import numpy as np
import pytest

from thirdhand.settings.config import Reach
from thirdhand.workbench.learning.division import FOLLOWED_HAND, off_via_point
from thirdhand_sim.made_tasks import TAKE_HZ, TASK_KINDS, run, takes

pytestmark = pytest.mark.thorough


def test_takes_follow_from_their_numbers() -> None:
    """Other people, takes or seeds give other takes."""
    for kind in TASK_KINDS[:3]:
        first, other = (takes(kind, people=(0, 1), each=2) for _ in range(2))
        assert [take.person for take in first] == [0, 0, 1, 1]
        for a, b in zip(first, other, strict=True):
            for name in ("stamps_ns", "left", "right", "tool"):
                assert (
                    getattr(a.demonstration, name).tobytes()
                    == getattr(b.demonstration, name).tobytes()
                )
            assert a.demonstration.via_points == b.demonstration.via_points
        first += takes(kind, people=(0,), each=1, seed=1)
        assert len({take.demonstration.left.tobytes() for take in first}) == 5


@pytest.mark.parametrize("kind", TASK_KINDS)
def test_hands_and_tool_move_as_people_do(kind: str) -> None:
    """The tool reaches its places."""
    for person in range(3):
        trial = run(kind, person, 0)
        times = np.arange(0.0, trial.lasts_s, 0.005)
        velocity = np.gradient(trial.hands(times).reshape(-1, 2, 3), 0.005, axis=0)
        assert np.linalg.norm(velocity, axis=2).max() <= 2.0
        assert np.linalg.norm(np.gradient(velocity, 0.005, axis=0), axis=2).max() <= 16.0
        take = trial.demonstration()
        assert take.period_s == pytest.approx(1.0 / TAKE_HZ)
        assert np.abs(np.linalg.norm(np.stack(take[1:4])[..., 3:], axis=-1) - 1.0).max() < 1e-9
        for i in trial.order:
            assert (
                off_via_point(
                    take, take.via_points[i], FOLLOWED_HAND[take.via_points[i].follow]
                ).min()
                < 0.02
            )
        reach = Reach()
        away = np.linalg.norm(take.tool[:, :3] - reach.centre, axis=1)
        assert away.max() < reach.outer
        assert take.tool[:, 2].min() > reach.min_z
