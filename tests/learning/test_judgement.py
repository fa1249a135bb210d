"""What a skill is judged by: good demonstrations pass, and what is wrong with others is said."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from service.config import Reach
from service.learning.demonstration import Demonstration
from service.learning.judgement import Figures, table
from service.learning.learn import Evidence, learn
from service.learning.picture import draw
from service.learning.skill_file import SkillError
from support.taught_scene import demonstrated


def judged(demonstrations: list[Demonstration], **options: object) -> Figures:
    """The figures of what is learned from these."""
    return msgspec.json.decode(learn(demonstrations, points=80, **options).figures, type=Figures)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def good() -> list[Demonstration]:
    return [one.every(8) for one in demonstrated(4)]


def with_tool(one: Demonstration, tool: np.ndarray) -> Demonstration:
    return one._replace(tool=np.hstack([tool, one.tool[:, 3:]]))


def test_good_demonstrations_are_judged_safe_and_their_errors_told_one_by_one(good: list[Demonstration]) -> None:
    found = judged(good, names=["a", "b", "c", "d"])
    assert found.unsafe == ()
    assert [row.name for row in found.demonstrations] == ["a", "b", "c", "d"]
    assert all(5 < row.error_mm < 45 for row in found.demonstrations)
    assert found.all.error_mm == pytest.approx(found.all.predicted_mm, rel=0.6)
    assert (found.ambiguous, found.beyond_reach) == (0, 0)
    assert min(found.swapped, found.beside) > 95


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda d: [*d[:2], *(with_tool(one, one.tool[:, :3] * (1, -1, 1)) for one in d[:2])], "contradict others"),
        (lambda d: [with_tool(one, 3 * one.tool[:, :3]) for one in d], "out of the arm's reach"),
        (lambda d: [*d[:3], d[3]._replace(frame="camera")], "different frames: 'base', 'camera'"),
        (lambda d: [*d[:3], d[3]._replace(tool=np.roll(d[3].tool, 25, axis=0))], "missed by"),
    ],
    ids=["same hands, other tool", "not in metres", "frames", "one out of step"],
)
def test_what_would_be_unsafe_is_said(good: list[Demonstration], spoil: object, says: str) -> None:
    found = judged(spoil(good))  # type: ignore[operator]
    assert any(says in text for text in found.unsafe), found
    assert f"unsafe: {found.unsafe[0]}" in table(found)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda d: [d[0], d[0], *d[1:]], "demonstration 2 repeats demonstration 1, and is left out"),
        (lambda d: [d[0], d[0].every(2), *d[1:]], "demonstration 2 repeats demonstration 1"),
        (lambda d: [one._replace(frame="camera") for one in d], "in frame 'camera': it is taken to be 'base'"),
        (lambda d: d[:2], "5 advised"),
    ],
    ids=["repeated", "repeated at another rate", "another frame", "two"],
)
def test_what_is_doubtful_is_warned_of(good: list[Demonstration], spoil: object, says: str) -> None:
    found = judged(spoil(good))  # type: ignore[operator]
    assert found.unsafe == ()
    assert any(says in text for text in found.warnings), found.warnings


def test_a_demonstration_given_twice_is_one(good: list[Demonstration]) -> None:
    with pytest.raises(SkillError, match=r"1 demonstration given.*; again repeats take-1, and is left out$"):
        learn([good[0], good[0]], names=["take-1", "again"])


def test_the_reach_is_that_of_the_arm_at_hand(good: list[Demonstration]) -> None:
    assert judged(good, reach=Reach(outer=0.6)).beyond_reach > 5


def test_the_picture_is_one(good: list[Demonstration], tmp_path: Path) -> None:
    seen: list[Evidence] = []
    learn(good, points=80, show=seen.append)
    draw(seen[0], tmp_path / "skill.png")
    assert (tmp_path / "skill.png").read_bytes().startswith(b"\x89PNG")
