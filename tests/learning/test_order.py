"""The results of `learn` do not depend on the order of the files, on chance, or on one bad take."""

from __future__ import annotations

import functools
from random import Random

import pytest

from support.skills import figures_of, made
from thirdhand.skills.demonstration import Demonstration, persons
from thirdhand.skills.skill_file import SkillError
from thirdhand.workbench.learning.learn import learn


@functools.cache
def shown() -> list[Demonstration]:
    return made("three", range(3))


@pytest.mark.thorough
@pytest.mark.parametrize("named", [True, False])
def test_order_of_files_makes_no_difference(named: bool) -> None:
    demonstrations = [take if named else take._replace(via_points=()) for take in shown()]
    names = [f"take {number}" for number in range(len(demonstrations))]
    first = learn(demonstrations, names=names)
    for seed in range(2):
        order = Random(seed).sample(range(len(names)), len(names))
        relearned = learn([demonstrations[i] for i in order], names=[names[i] for i in order])
        assert relearned.file == first.file


@pytest.mark.thorough
@pytest.mark.parametrize("named", [True, False])
def test_workers_make_no_difference(named: bool) -> None:
    demonstrations = [take if named else take._replace(via_points=()) for take in shown()]
    assert learn(demonstrations, workers="2").file == learn(demonstrations).file


def test_sitting_is_held_out_together() -> None:
    base = shown()[0]
    hour_ns = 3600 * 10**9
    later = [
        base._replace(stamps_ns=base.stamps_ns + (n // 2) * hour_ns + n % 2 * 60 * 10**9)
        for n in range(8)
    ]
    assert persons(later) == [0, 0, 1, 1, 2, 2, 3, 3]
    assert persons(later[:4]) == [0, 1, 2, 3]  # two sittings are too few to hold one out


@pytest.mark.thorough
def test_take_with_exchanged_hands_is_left_out() -> None:
    """A take with exchanged hands is left out and named."""
    good = shown()
    spoilt = good[2]._replace(left=good[2].right, right=good[2].left)
    names = [f"take {number}" for number in range(len(good))]
    skill = learn([*good[:2], spoilt, *good[3:]], names=names)
    warnings = figures_of(skill).warnings
    assert warnings[0].startswith("take 2 stands out, and is left out: its tool is ")
    assert "with its hands exchanged: put each tracker on its own hand" in warnings[0]
    assert {row.name for row in figures_of(skill).demonstrations} == {*names} - {"take 2"}
    assert figures_of(skill).gate_mm < 150.0
    others = learn([*good[:2], *good[3:]], names=[name for name in names if name != "take 2"])
    assert figures_of(skill).all == figures_of(others).all


@pytest.mark.thorough
def test_a_delay_that_is_given_is_taken() -> None:
    assert figures_of(learn(shown(), delay_s=0.35)).delay_s == 0.35
    with pytest.raises(SkillError, match=r"a delay goes with via-points"):
        learn([take._replace(via_points=()) for take in shown()], delay_s=0.1)
