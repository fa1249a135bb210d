"""What a skill is judged by: good demonstrations pass, and what is wrong with others is said."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from support.paths import ROOT
from support.skills import figures_of, made
from support.taught_scene import demonstrated
from thirdhand.settings.config import Reach
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import SkillError
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.learning.picture import draw, drawn
from thirdhand.workbench.learning.records import Evidence, Figures
from thirdhand.workbench.learning.table import table


def judged(demonstrations: list[Demonstration], **options: object) -> Figures:
    """The figures of what is learned from these."""
    return figures_of(learn(demonstrations, points=80, **options))  # type: ignore[arg-type]


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
        (lambda d: [one._replace(tool=np.roll(one.tool, 80 * i, axis=0)) for i, one in enumerate(d)], "too little of"),
    ],
    ids=["same hands, other tool", "not in metres", "frames", "all out of step"],
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
        (lambda d: d[:2], "5 or more advised"),
    ],
    ids=["repeated", "repeated at another rate", "another frame", "two"],
)
def test_what_is_doubtful_is_warned_of(good: list[Demonstration], spoil: object, says: str) -> None:
    found = judged(spoil(good))  # type: ignore[operator]
    assert found.unsafe == ()
    assert any(says in text for text in found.warnings), found.warnings


def test_a_demonstration_given_twice_is_one(good: list[Demonstration]) -> None:
    with pytest.raises(SkillError, match=r"1 demonstration given.*; take-2 repeats take-1, and is left out$"):
        learn([good[0], good[0]], names=["take-1", "take-2"])


def test_the_reach_is_that_of_the_arm_at_hand(good: list[Demonstration]) -> None:
    assert judged(good, reach=Reach(outer=0.6)).beyond_reach > 5


def test_the_picture_is_one(good: list[Demonstration], tmp_path: Path) -> None:
    seen: list[Evidence] = []
    learn(good, points=80, show=seen.append)
    draw(seen[0], tmp_path / "skill.png")
    assert (tmp_path / "skill.png").read_bytes().startswith(b"\x89PNG")
    assert not [axes for axes in drawn(seen[0]).axes if "segment" in axes.get_title()]


def test_the_picture_shows_the_segments_of_a_demonstration_and_what_was_predicted_of_its_errors() -> None:
    seen: list[Evidence] = []
    learn(made("cyclic", range(2)), show=seen.append)
    by_title = {axes.get_title(): axes for axes in drawn(seen[0]).axes}
    (segments,) = (axes for title, axes in by_title.items() if "segment" in title)
    name = segments.get_title().split(",")[0]
    h = [row.name for row in seen[0].figures.demonstrations].index(name)
    labels = [text.get_text() for text in segments.get_legend().get_texts()]
    told = ["1: start → left out", "2: left out → work", "3: work → left out again"]
    assert labels == [*told, "error of the predicted tool", "expected before calibration"]
    off, predicted = (np.asarray(line.get_ydata()) for line in segments.get_lines())
    row = seen[0].figures.demonstrations[h]
    assert np.sqrt(np.mean(off**2)) == pytest.approx(row.error_mm)
    belief = seen[0].held_out[h].belief
    assert belief is not None
    likely = belief.argmax(axis=1)
    shown = [patch for patch in segments.patches if patch.get_alpha()]
    assert len(shown) == 1 + np.count_nonzero(np.diff(likely))
    # what is predicted is of the tool, not how far hands are off their ways
    (line,) = (line for line in by_title["error of the predicted tool"].get_lines() if "expected" in line.get_label())
    variance = [np.trace(one.covariance, axis1=1, axis2=2).mean() for one in seen[0].held_out]
    usual = 1000 * np.sqrt(np.mean(variance))
    assert np.sqrt(np.mean(np.asarray(line.get_ydata()) ** 2)) == pytest.approx(usual, rel=0.1)
    assert predicted.shape == off.shape


def test_the_error_at_the_moment_stands_in_the_table_where_it_is_another(good: list[Demonstration]) -> None:
    found = judged(good, names=["a", "b", "c", "d"])
    for more_mm in (0.0, 7.0):
        rows = [msgspec.structs.replace(row, moment_mm=row.error_mm + more_mm) for row in found.demonstrations]
        total = msgspec.structs.replace(found.all, moment_mm=found.all.error_mm)
        head, first, *_ = table(msgspec.structs.replace(found, demonstrations=tuple(rows), all=total)).splitlines()
        assert ("of blocks" in head) == bool(more_mm)
        told = (rows[0].error_mm, rows[0].worst_mm, *[rows[0].moment_mm] * bool(more_mm), rows[0].predicted_mm)
        assert first.split()[1 : 2 * len(told) : 2] == [f"{mm:.0f}" for mm in told]


def test_each_column_of_the_table_is_explained_below_it_and_on_the_page(good: list[Demonstration]) -> None:
    found = judged(good)
    head, _, below = table(found).partition("The columns:")
    columns = ("error", "worst", "expected", "in 50 %", "95 %", "held", *found.all.other_mm)
    page = (ROOT / "docs/learning.md").read_text(encoding="utf-8")
    for column in columns:
        assert column in head.splitlines()[0]
        assert column in below.partition("docs/learning.md")[0]
        assert column in page.partition("## Judged")[2]
