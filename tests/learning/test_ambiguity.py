"""Contradictions between demonstrations: told from fine motion by the tracker's noise."""

from __future__ import annotations

import numpy as np
import pytest

from support.circling import circling
from support.fine_motion import fine
from support.skills import figures_of
from support.taught_scene import demonstrated
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.ambiguity import (
    ALIKE_M,
    NOISES,
    SAME_M,
    same_hands_m,
    tracker_noise_m,
)
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.learning.records import Figures


def judged(demonstrations: list[Demonstration]) -> Figures:
    return figures_of(learn(demonstrations, points=80))


@pytest.mark.parametrize("noise_m", [0.0, 0.0002, 0.001, 0.003])
@pytest.mark.parametrize("every", [1, 2])
def test_the_noise_of_a_tracker_is_found_in_takes_however_the_hands_move(noise_m: float, every: int) -> None:
    moving = [circling(seed, noise_m=noise_m).every(every) for seed in range(3)]
    assert tracker_noise_m(moving) == pytest.approx(noise_m, rel=0.15, abs=2e-4)


def test_hands_are_the_same_within_several_deviations_between_a_floor_and_a_ceiling() -> None:
    near = [same_hands_m([fine(seed, noise_m) for seed in range(2)]) for noise_m in (0.0, 0.001, 0.01)]
    assert near[0] == SAME_M
    assert near[1] == pytest.approx(NOISES * 0.001, rel=0.1)
    assert near[2] == ALIKE_M
    random = np.random.default_rng(0)
    apart = np.linalg.norm(0.001 * (random.normal(size=(20_000, 6)) - random.normal(size=(20_000, 6))), axis=1)
    assert 0.998 < (apart < near[1]).mean() < 1.0


def test_fine_motion_is_legal_where_the_tracker_can_tell_it_and_only_there() -> None:
    found = judged([fine(seed, 0.0005) for seed in range(4)])
    assert (found.unsafe, found.ambiguous) == ((), 0.0)
    assert found.all.error_mm < 10
    noisy = judged([fine(seed, 0.003) for seed in range(4)])
    assert any("contradict others" in text for text in noisy.residual)


@pytest.mark.parametrize("noise_m", [0.0, 0.0005])
def test_takes_that_go_opposite_ways_are_refused_however_good_the_tracker(noise_m: float) -> None:
    found = judged([fine(seed, noise_m, way) for seed, way in enumerate((1.0, -1.0, 1.0, -1.0))])
    assert found.ambiguous > 30
    assert any("contradict others" in text for text in found.unsafe)


def test_takes_whose_hands_are_a_centimetre_off_each_other_contradict_as_well() -> None:
    """As people's are: farther than the noise, but nothing tells which way the tool goes."""
    shown, beside = [one.every(8) for one in demonstrated(2)], np.array([0.006, 0.006, 0.006, 0, 0, 0, 0])
    mirrored = [
        one._replace(left=one.left + beside, right=one.right + beside, tool=one.tool * [1, -1, 1, 1, 1, 1, 1])
        for one in shown
    ]
    assert same_hands_m(shown) < 0.0145 < ALIKE_M
    assert any("contradict others" in text for text in judged([*shown, *mirrored]).unsafe)


def test_turns_that_go_with_fine_motion_are_legal_and_those_that_go_both_ways_are_not() -> None:
    assert judged([fine(seed, 0.0005, turned=True) for seed in range(4)]).unsafe == ()
    both = judged([fine(seed, 0.0005, way, turned=True) for seed, way in enumerate((1.0, -1.0, 1.0, -1.0))])
    assert any("contradicts itself" in text for text in both.unsafe)
