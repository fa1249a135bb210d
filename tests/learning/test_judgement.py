"""The judgement of a skill: good demonstrations pass, and faults of others are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.skills import figures_of
from support.taught_scene import demonstrated
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import SkillError
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.learning.picture import draw, drawn
from thirdhand.workbench.learning.records import Evidence, Figures
from thirdhand.workbench.learning.table import table


def judged(demonstrations: list[Demonstration], **options: object) -> Figures:
    """The figures of a skill learned from these demonstrations."""
    return figures_of(learn(demonstrations, points=80, **options))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def good() -> list[Demonstration]:
    return [take.every(8) for take in demonstrated(4)]


def with_tool(one: Demonstration, tool: np.ndarray) -> Demonstration:
    return one._replace(tool=np.hstack([tool, one.tool[:, 3:]]))


def test_good_demonstrations_are_safe(good: list[Demonstration]) -> None:
    """The errors of the demonstrations are listed one by one."""
    figures = judged(good, names=["a", "b", "c", "d"])
    assert figures.unsafe == ()
    assert [row.name for row in figures.demonstrations] == ["a", "b", "c", "d"]
    assert all(5 < row.error_mm < 45 for row in figures.demonstrations)
    assert figures.all.error_mm == pytest.approx(figures.all.predicted_mm, rel=0.6)
    assert (figures.ambiguous, figures.beyond_reach) == (0, 0)
    assert min(figures.swapped, figures.beside) > 95


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (
            lambda d: [*d[:2], *(with_tool(take, take.tool[:, :3] * (1, -1, 1)) for take in d[:2])],
            "contradict others",
        ),
        (lambda d: [with_tool(take, 3 * take.tool[:, :3]) for take in d], "out of the arm's reach"),
        (lambda d: [*d[:3], d[3]._replace(frame="camera")], "different frames: 'base', 'camera'"),
        (
            lambda d: [
                take._replace(tool=np.roll(take.tool, 80 * i, axis=0)) for i, take in enumerate(d)
            ],
            "too little of",
        ),
    ],
    ids=["same hands, other tool", "not in metres", "frames", "all out of step"],
)
def test_what_would_be_unsafe_is_said(good: list[Demonstration], spoil: object, says: str) -> None:
    figures = judged(spoil(good))  # type: ignore[operator]
    assert any(says in text for text in figures.unsafe), figures
    assert f"unsafe: {figures.unsafe[0]}" in table(figures)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (
            lambda d: [d[0], d[0], *d[1:]],
            "demonstration 2 repeats demonstration 1, and is left out",
        ),
        (lambda d: [d[0], d[0].every(2), *d[1:]], "demonstration 2 repeats demonstration 1"),
        (
            lambda d: [take._replace(frame="camera") for take in d],
            "in frame 'camera': it is taken to be 'base'",
        ),
        (lambda d: d[:2], "5 or more advised"),
    ],
    ids=["repeated", "repeated at another rate", "another frame", "two"],
)
def test_what_is_doubtful_is_warned_of(good: list[Demonstration], spoil: object, says: str) -> None:
    figures = judged(spoil(good))  # type: ignore[operator]
    assert figures.unsafe == ()
    assert any(says in text for text in figures.warnings), figures.warnings


def test_a_demonstration_given_twice_is_one(good: list[Demonstration]) -> None:
    with pytest.raises(
        SkillError, match=r"1 demonstration given.*; take-2 repeats take-1, and is left out$"
    ):
        learn([good[0], good[0]], names=["take-1", "take-2"])


def test_the_picture_is_one(good: list[Demonstration], tmp_path: Path) -> None:
    evidence: list[Evidence] = []
    learn(good, points=80, show=evidence.append)
    draw(evidence[0], tmp_path / "skill.png")
    assert (tmp_path / "skill.png").read_bytes().startswith(b"\x89PNG")
    assert not [axes for axes in drawn(evidence[0]).axes if "segment" in axes.get_title()]
