"""A skill of other people, refined by takes of the person who will work with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from support.circling import circling
from support.skills import figures_of, made
from thirdhand.core.frame import Vector
from thirdhand.skills.demonstration import Demonstration, NamedDemonstration
from thirdhand.skills.skill_file import SkillError, StoredSkill, decoded
from thirdhand.skills.stored_demonstrations import KEPT_HZ, packed, stored_demonstrations
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.learning.table import table

HABIT_M = np.array([0.0, 0.0, 0.05])  # the user's tool differs by this offset


def with_habit(one: Demonstration) -> Demonstration:
    """The take with another path of the tool: an arc between the same ends."""
    bow = np.sin(np.pi * np.linspace(0.0, 1.0, len(one.tool)))[:, None] * HABIT_M
    return one._replace(tool=np.hstack([one.tool[:, :3] + bow, one.tool[:, 3:]]))


def missed_mm(skill: StoredSkill, one: Demonstration) -> float:
    """The root mean square error for resting hands along a take."""
    errors: Vector = one.tool[:, :3] - skill.mean(one.hands)
    return 1000 * float(np.sqrt((errors**2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def others() -> StoredSkill:
    """A skill of four takes, as read from its file."""
    takes = [circling(seed).every(4) for seed in range(4)]
    names = [f"take-{i}" for i in range(4)]
    return decoded(learn(takes, name="others", names=names, points=80).file, origin="others.npz")


def test_own_takes_refine_a_skill(others: StoredSkill) -> None:
    """Takes of the skill's user refine it."""
    mine = [circling(seed).every(4) for seed in range(10, 14)]
    mine = [take._replace(tool=take.tool + np.concatenate([HABIT_M, np.zeros(4)])) for take in mine]
    refined = learn(mine[:3], name="mine", names=["a", "b", "c"], points=80, refined=others)
    figures = figures_of(refined)
    assert [row.name for row in figures.demonstrations] == ["a", "b", "c"]
    assert list(figures.weights_mm) == ["1", "4", "16", "64", "yours alone"]
    assert (
        figures.weights_mm[figures.weight]
        == min(figures.weights_mm.values())
        < figures.weights_mm["1"]
    )
    assert f"{figures.weight} is taken:" in table(figures)
    assert missed_mm(refined, mine[3]) < 0.5 * missed_mm(others, mine[3])
    # The file suffices for the next refinement; takes without a name then count as other people's.
    stored = stored_demonstrations(decoded(refined.file, origin="mine.npz"))
    assert sorted(entry.name for entry in stored) == [
        "a",
        "b",
        "c",
        "take-0",
        "take-1",
        "take-2",
        "take-3",
    ]


@pytest.mark.thorough
def test_earlier_takes_of_a_person_count() -> None:
    """A task between via-points is refined twice; earlier takes of a person count as that
    person's.
    """
    takes = [take.every(3) for take in made("three", range(3))]
    takes = [take._replace(person=f"person {i // 2}") for i, take in enumerate(takes)]
    skill = learn(takes, name="others")
    mine = [with_habit(take.every(3)) for take in made("three", [7], each=4)]
    mine = [take._replace(person="me") for take in mine]
    first = learn(mine[:2], name="first", names=["a", "b"], refined=skill)
    figures = figures_of(learn(mine[2:], name="both", names=["c", "d"], refined=first))
    assert sorted(row.name for row in figures.demonstrations) == ["a", "b", "c", "d"]
    assert figures.weights_mm[figures.weight] < figures.weights_mm["1"]
    assert figures.delay_s is not None
    with pytest.raises(
        SkillError,
        match=r"demonstration 1 has the via-points \(none\): segment 1, .* needed, as in the",
    ):
        learn([take._replace(via_points=()) for take in mine[:2]], refined=skill)


def test_impossible_refinement_is_refused(others: StoredSkill) -> None:
    """Skills that cannot be refined are refused with the remedy."""
    mine = [circling(seed).every(4) for seed in (30, 31)]
    with pytest.raises(SkillError, match=r"does not hold the demonstrations .*learn it anew"):
        learn(mine, refined=replace(others, demonstrations=b""))
    for spoilt in (others.demonstrations[:-100], b"PK" + bytes(300), bytes(50)):
        with pytest.raises(SkillError, match=r"its demonstrations are damaged .*learn it anew"):
            learn(mine, refined=replace(others, demonstrations=spoilt))
    with pytest.raises(SkillError, match=r"neither a number of components nor ell"):
        learn(mine, refined=others, ell=4.0)
    with pytest.raises(
        SkillError, match=r"1 demonstration given .*again repeats take-0, and is left out"
    ):
        learn(
            [mine[0], stored_demonstrations(others)[0].demonstration],
            names=["mine", "again"],
            refined=others,
        )
    with pytest.raises(
        SkillError, match="all demonstrations repeat those of the skill that is refined"
    ):
        learn([entry.demonstration for entry in stored_demonstrations(others)], refined=others)


def test_a_skill_holds_its_demonstrations(others: StoredSkill) -> None:
    take = made("three", [0], each=1)[0]
    closure = np.linspace(0.0, 1.0, len(take.stamps_ns))
    take = take._replace(person="Ada", gripper=closure, begins=(200,), conducts="left")
    entry, other = (
        NamedDemonstration(name, part) for name, part in (("a", take), ("b", take.every(2)))
    )
    first, second = stored_demonstrations(replace(others, demonstrations=packed([entry, other])))
    step = max(1, int(1.0 / (KEPT_HZ * take.period_s) + 1e-6))
    expected = take.every(step)
    assert (first.name, second.name) == ("a", "b")
    for name in ("frame", "via_points", "conducts", "person", "begins"):
        assert getattr(first.demonstration, name) == getattr(expected, name), name
    assert np.array_equal(first.demonstration.stamps_ns, expected.stamps_ns)
    for name in ("left", "right", "tool", "gripper"):
        np.testing.assert_allclose(
            getattr(first.demonstration, name), getattr(expected, name), atol=1e-6
        )
    assert first.demonstration.period_s >= 1.0 / KEPT_HZ - 1e-6
