"""Contradictions between demonstrations are distinguished from fine motion by the tracker's
noise.
"""

from __future__ import annotations

import pytest

from support.circling import circling
from support.fine_motion import fine
from support.skills import figures_of
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.ambiguity import tracker_noise_m
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.learning.records import Figures


def judged(demonstrations: list[Demonstration]) -> Figures:
    return figures_of(learn(demonstrations, points=80))


@pytest.mark.parametrize("noise_m", [0.0, 0.0002, 0.001, 0.003])
@pytest.mark.parametrize("every", [1, 2])
def test_tracker_noise_is_found(noise_m: float, every: int) -> None:
    """The estimate does not depend on the hands' motion."""
    moving = [circling(seed, noise_m=noise_m).every(every) for seed in range(3)]
    assert tracker_noise_m(moving) == pytest.approx(noise_m, rel=0.15, abs=2e-4)


def test_fine_motion_is_legal_if_tracked_well() -> None:
    """Fine motion is accepted only where the tracker can resolve it."""
    figures = judged([fine(seed, 0.0005) for seed in range(4)])
    assert (figures.unsafe, figures.ambiguous) == ((), 0.0)
    assert figures.all.error_mm < 10
    noisy = judged([fine(seed, 0.003) for seed in range(4)])
    assert any("contradict others" in text for text in noisy.residual)


@pytest.mark.parametrize("noise_m", [0.0, 0.0005])
def test_opposite_ways_are_refused(noise_m: float) -> None:
    """The tracker may be of any quality."""
    figures = judged(
        [fine(seed, noise_m, sign) for seed, sign in enumerate((1.0, -1.0, 1.0, -1.0))]
    )
    assert figures.ambiguous > 30
    assert any("contradict others" in text for text in figures.unsafe)


def test_turns_of_fine_motion() -> None:
    """Turns along with fine motion are accepted, alternating ones are not."""
    assert judged([fine(seed, 0.0005, turned=True) for seed in range(4)]).unsafe == ()
    figures = judged(
        [fine(seed, 0.0005, sign, turned=True) for seed, sign in enumerate((1.0, -1.0, 1.0, -1.0))]
    )
    assert any("contradicts itself" in text for text in figures.unsafe)
