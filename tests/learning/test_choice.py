"""Hyper-parameters chosen by leaving one demonstration out: the closed form, the choice, and how
sure the skill then is of people it has not seen.
"""

from __future__ import annotations

import numpy as np
import pytest

from kmp import KMP, GaussianKernel, Gaussians
from kmp.criteria.cross_validation import mahalanobis, rms
from kmp.criteria.direct import DirectSelection, ridge_mean
from thirdhand.core.skill.model import CHI_SQUARE, LEVELS
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import SkillError
from thirdhand.workbench.learning.choice import (
    MAX_GAIN,
    POSITION_SCALES,
    RIDGE_M,
    selection_of,
    thinned,
)
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript, Teacher


def shown(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Hands (T, 6) and tool (T, 3) [m] of one run through the scene."""
    scene = Scene()
    script, teacher = HandScript(scene, seed=seed), Teacher(scene, seed=seed)
    times = np.arange(0.0, scene.duration_s, 0.1)
    hands = np.array([np.concatenate([pose[:3] for pose in script.sample(t)]) for t in times])
    return hands, np.array([teacher.truth(t).position for t in times])


@pytest.fixture(scope="module")
def choice() -> DirectSelection:
    return selection_of([shown(seed) for seed in range(4)], 60)


@pytest.mark.parametrize("ridge_m", [None, RIDGE_M])
def test_the_residuals_left_out_are_those_of_primitives_and_means_fitted_without(
    choice: DirectSelection, ridge_m: float | None
) -> None:
    ell, noise = 4.0, 0.1
    for group in range(4):
        mine = choice.group == group
        inputs = choice.inputs[~mine]
        outputs = choice.outputs[~mine]
        prior = choice.outputs.mean(axis=0)
        if ridge_m is not None:
            prior = ridge_mean(inputs, outputs, ridge_m, max_gain=MAX_GAIN)
        reference = Gaussians.of(outputs, deviation=1.0)
        fitted = KMP.fit(inputs, reference, kernel=GaussianKernel(ell), lambda_mean=noise, prior_mean=prior)
        expected = choice.outputs[mine] - fitted.mean(choice.inputs[mine])
        np.testing.assert_allclose(choice.residuals(ell, noise, ridge_m)[mine], expected, atol=1e-9)


def test_the_choice_is_as_good_as_any_that_was_tried(choice: DirectSelection) -> None:
    found = choice.parameters()
    errors = {
        (ell, noise): rms(choice.residuals(ell, noise))
        for ell in POSITION_SCALES.ells
        for noise in 10.0 ** np.arange(-3.0, 0.1, 0.5)
    }
    assert errors[found.ell, found.noise] == min(errors.values())
    assert choice.parameters(8.0).ell == 8.0


def test_the_primitive_has_the_mean_that_was_chosen_and_the_deviation_far_away(choice: DirectSelection) -> None:
    found = choice.parameters()
    primitive = choice.primitive(found, choice.residuals(found.ell, found.noise))
    far = primitive.predict(np.full((1, 6), 50.0))
    np.testing.assert_allclose(np.sqrt(np.diagonal(far.covariance[0])), found.deviation, rtol=1e-6)
    assert primitive.kernel.ell == found.ell


def test_rests_keep_some_of_the_points_and_motion_most() -> None:
    hands, tool = shown(3)
    kept, _ = thinned(hands, tool, 40)
    way = np.linalg.norm(np.diff(kept, axis=0), axis=1)
    assert 36 <= len(kept) <= 40
    assert way.max() < 4 * np.median(way)


def test_one_demonstration_is_too_few_to_choose_by() -> None:
    with pytest.raises(ValueError, match="1 number given, at least 2 needed to hold one out"):
        selection_of([shown(1)], 60).parameters()


def test_a_penalty_without_components_is_refused(taught: list[Demonstration]) -> None:
    with pytest.raises(SkillError, match="goes with a number of components"):
        learn(taught[:2], penalty=2.0)


def test_people_who_were_not_seen_are_where_the_skill_says_they_may_be() -> None:
    """Five demonstrations, drawn four times, and ten others: error, what is predicted of it, and
    what the regions hold. Over many draws 55 and 92 %; four of them scatter about that.
    """
    unseen = [shown(900 + seed) for seed in range(10)]
    hands, tools = (np.concatenate(parts) for parts in zip(*unseen, strict=True))
    error, expected, within = [], [], []
    regions = [CHI_SQUARE[LEVELS.index(level)] for level in (0.5, 0.95)]
    for draw in range(4):
        choice = selection_of([shown(100 * draw + seed) for seed in range(50, 55)], 120)
        found = choice.parameters()
        predicted = choice.primitive(found, choice.residuals(found.ell, found.noise)).predict(hands)
        errors = tools - predicted.mean
        error.append(rms(errors))
        expected.append(np.sqrt(np.trace(predicted.covariance, axis1=1, axis2=2).mean()))
        within.append((mahalanobis(errors, predicted.covariance)[:, None] <= regions).mean(axis=0))
    assert np.mean(error) < 0.026
    assert np.mean(expected) == pytest.approx(np.mean(error), rel=0.25)
    half, most = np.mean(within, axis=0)
    assert 0.42 <= half <= 0.66
    assert 0.86 <= most <= 0.98
