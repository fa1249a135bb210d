"""Learning from demonstrations: results, determinism, and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from support.skills import figures_of
from support.taught_scene import deviations, error_m, quickly
from thirdhand.core.skill.skill import Skill
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import SkillError
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.learning.pose import mean_orientation


def test_held_out_demonstration_is_predicted(learned: Skill, taught: list[Demonstration]) -> None:
    """The error is a few centimetres."""
    assert error_m(learned, taught[3:]) < 0.035


def test_learning_is_deterministic(coarse: Skill, taught: list[Demonstration]) -> None:
    assert quickly(taught[:2]).file == coarse.file


def test_gate_passes_demonstrations_only(aimed: Skill, taught: list[Demonstration]) -> None:
    """Hands far from the demonstrations are held for."""
    for take in taught:
        assert deviations(aimed, take.hands[::20]).max() <= aimed.threshold
        assert (
            deviations(aimed, take.hands[::20] + np.array([0.0, 0.0, 0.5] * 2)).min()
            > aimed.threshold
        )


def test_mean_orientation_ignores_signs() -> None:
    """A mean orientation does not depend on the quaternions' signs."""
    random = np.random.default_rng(0)
    near = np.array([0.0, 0.9, 0.0, 0.44]) + 0.01 * random.normal(size=(50, 4))
    flipped = near * random.choice([-1.0, 1.0], size=(50, 1))
    np.testing.assert_allclose(mean_orientation(flipped), mean_orientation(near), atol=1e-12)
    assert np.linalg.norm(mean_orientation(flipped)) == pytest.approx(1.0)


def test_unusable_demonstrations_are_refused(taught: list[Demonstration]) -> None:
    """Demonstrations that cannot be learned from are refused."""
    take = taught[0]
    turned = take.tool.copy()
    turned[:, 3:] *= 2
    for wrong, message in (
        ([], "no demonstrations given, at least 1 needed"),
        ([take.every(400)], "3 samples is too short"),
        ([take._replace(stamps_ns=take.stamps_ns * 0)], "too short"),
        ([take._replace(tool=np.full_like(take.tool, np.nan))], "not finite"),
        ([take._replace(tool=turned)], "not quaternions of norm 1"),
        ([take._replace(left=1000 * take.left)], "is it in metres"),
        ([take._replace(left=take.left[:500])], "500 left"),
        ([take], r"1 demonstration given \(demonstration 1\): at least 2 needed"),
    ):
        with pytest.raises(SkillError, match=message):
            learn(wrong)
    still = [take._replace(tool=np.tile(pose, (len(take.tool), 1))) for pose in take.tool[[0, -1]]]
    with pytest.raises(
        SkillError, match=r"^demonstrations in which hands or tool move by less than 10 mm"
    ):
        learn(still)
    with pytest.raises(SkillError, match=r"^take-2: .*not finite"):
        learn(
            [take, take._replace(tool=np.full_like(take.tool, np.nan))], names=["take-1", "take-2"]
        )


def test_resting_take_is_learned_with_others(taught: list[Demonstration]) -> None:
    resting = taught[3].every(8)
    resting = resting._replace(
        left=np.tile(resting.left[0], (len(resting.left), 1)),
        right=np.tile(resting.right[0], (len(resting.left), 1)),
    )
    skill = learn([*(take.every(4) for take in taught[:2]), resting], points=60)
    assert len(figures_of(skill).demonstrations) == 3
