"""Predictions are as uncertain as errors at similar inputs, and more uncertain far from all
errors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kmp import KMP, GaussianKernel, Gaussians
from thirdhand.core.controller import start_state
from thirdhand.core.frame import blank, frame_layout
from thirdhand.core.numerics import UNPRIMED_DECIDED
from thirdhand.core.skill.model import NORMAL_WEIGHTS
from thirdhand.core.skill.segmented import SegmentedKMP, Unknown
from thirdhand.core.skill.skill import Skill
from thirdhand.core.skill.stage import SkillStage
from thirdhand.core.skill.support import LocalErrors, error_probability
from thirdhand.core.skill.tuning import LEAST_STD_M, UNSURE_M
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings
from thirdhand_sim.scene import Scene

FAR_STD_M = 0.3


@pytest.fixture(scope="module")
def errors() -> LocalErrors:
    """Errors of 2 cm along x at inputs about the origin, and of 5 cm along y a metre away."""
    primitive = KMP.fit(
        np.random.default_rng(1).normal(size=(8, 2)),
        Gaussians(np.zeros((8, 3)), np.tile(np.eye(3), (8, 1, 1))),
        kernel=GaussianKernel(5.0),
        lambda_mean=1.0,
    )
    inputs = np.concatenate([np.zeros((20, 2)), np.ones((20, 2))])
    errors_m = np.concatenate(
        [np.tile([0.02, 0.0, 0.0], (20, 1)), np.tile([0.0, 0.05, 0.0], (20, 1))]
    )
    return LocalErrors.of(primitive, inputs, errors_m, FAR_STD_M)


def test_covariance_is_scatter_of_near_errors(errors: LocalErrors) -> None:
    """The covariance is the scatter of near errors; far from all inputs it is that of the tool."""
    least = LEAST_STD_M**2 * np.eye(3)
    near, other, far = errors.covariances(np.array([[0.0, 0.0], [1.0, 1.0], [6.0, -6.0]])) - least
    prior = 0.1 / 20.1 * FAR_STD_M**2
    np.testing.assert_allclose(
        near, np.diag([0.02**2, 0.0, 0.0]) * 20 / 20.1 + prior * np.eye(3), atol=1e-9
    )
    np.testing.assert_allclose(
        other, np.diag([0.0, 0.05**2, 0.0]) * 20 / 20.1 + prior * np.eye(3), atol=1e-9
    )
    np.testing.assert_allclose(far, FAR_STD_M**2 * np.eye(3), atol=1e-9)
    away = np.linspace(0.0, 3.0, 30)[:, None] * [1.0, -1.0]
    grows = np.trace(errors.covariances(away), axis1=1, axis2=2)
    assert (np.diff(grows) >= -1e-12).all()


def test_error_probability_is_about_a_normal_distributions() -> None:
    """Without a detector, it grows with the covariance, and is near the share of larger errors."""
    weights = np.array(NORMAL_WEIGHTS)
    stds = np.geomspace(0.005, 3.0, 60)
    probabilities = [error_probability(std**2 * np.eye(3), 0.0, 0.0, weights) for std in stds]
    assert (np.diff(probabilities) >= 0.0).all()
    assert probabilities[0] < 1e-4
    assert probabilities[-1] > 0.99
    random = np.random.default_rng(2)
    for std in (0.04, 0.05, 0.06, 0.08):
        drawn = np.linalg.norm(std * random.normal(size=(20_000, 3)), axis=1) > UNSURE_M
        assert error_probability(std**2 * np.eye(3), 0.0, 0.0, weights) == pytest.approx(
            drawn.mean(), abs=0.05
        )
    assert error_probability(0.05**2 * np.eye(3), 0.0075, 0.0, weights) == error_probability(
        0.005 * np.eye(3), 0.0, 0.0, weights
    )
    assert error_probability(np.zeros((3, 3)), 0.0, 5.0, weights) == 0.0
    surer, less_sure = (
        error_probability(0.05**2 * np.eye(3), 0.0, signs, weights) for signs in (-1.0, 1.0)
    )
    assert surer < less_sure


def segmented(**more: object) -> SegmentedKMP:
    model = shipped_skill().model
    assert isinstance(model, SegmentedKMP)
    return replace(model, **more)  # type: ignore[arg-type]


def test_unshown_places_are_uncertain() -> None:
    """Between via-points, the prediction is uncertain where nothing was demonstrated or no place is
    given.
    """
    certain = segmented(unknown=None)
    count = len(certain.names)
    scatters = np.tile(np.diag([0.02, 0.03, 0.01]), (count, 1, 1))
    model = segmented(unknown=Unknown(FAR_STD_M, scatters))
    at_last = certain.hands[-1:]
    last = certain.names[-1:]

    def covariance(one: SegmentedKMP, hands: np.ndarray) -> np.ndarray:
        belief = np.zeros(64)
        belief[count - 2] = 1.0
        return one.placed.covariance(hands[0], belief)

    taught = model.through(Scene().via_points()[-1:], tolerance=0.05, weight=1.0)
    assert taught.via_points[0].name == last[0]
    added = covariance(model, at_last) - covariance(certain, at_last)
    assert np.diag(added) == pytest.approx([0.02, 0.03, 0.01], rel=0.2)
    assert np.abs(covariance(taught, at_last) - covariance(certain, at_last)).max() < 2e-3
    few = segmented(
        unknown=Unknown(FAR_STD_M, 0.0 * scatters),
        errors=certain.errors[certain.errors[:, 2] < 0.5],
    )
    alone = segmented(errors=few.errors, unknown=None)
    assert np.trace(covariance(few, at_last)) > 5 * np.trace(covariance(alone, at_last)), (
        "no errors of this segment"
    )


def doubts(skill: Skill, hands: np.ndarray, ticks: int) -> tuple[list[float], list[bool], float]:
    """Error probabilities and flags of resting hands (2, 3), and the final belief in the first
    segment without its prior.
    """
    settings = Settings()
    segment = SkillStage(settings, skill)
    state = start_state(settings, skill)
    frame = blank(frame_layout(len(settings.joints.names)))
    state["hands"][:, 0] = hands
    state["hand_stillness"] = 1.0
    probabilities = []
    unsure = []
    for tick in range(1, ticks + 1):
        state["tick"] = tick
        state["hand_ticks"] = tick
        segment.step(state, frame)
        probabilities.append(float(frame["error_probability"]))
        unsure.append(bool(state["unsure"]))
    return probabilities, unsure, float(state["unprimed_belief"][0])


def test_possible_other_segment_is_unsure() -> None:
    """If the task may have begun in another segment, the skill is uncertain until the hands show
    it.
    """
    shipped = shipped_skill()
    regions = shipped.regions._replace(weights=NORMAL_WEIGHTS, alarm=0.2)
    model = segmented()
    begin = model.hands[0].reshape(2, 3)
    places = model.nominal.at.copy()
    # the hands return to their start, where the tool then has another position
    places[2, :6] = model.hands[0]
    places[2, 6:] = places[0, 6:] + (0.0, 0.3, 0.0)
    task = model.task._replace(corners=np.tile(np.arange(len(places))[:, None], 2))
    variant = replace(model, task=task, nominal=model.nominal._replace(at=places))
    alike = replace(shipped, model=variant, regions=regions)
    probabilities, unsure, _ = doubts(alike, begin, 5)
    assert probabilities[-1] > 0.3
    assert unsure[-1]
    _, unsure, decided = doubts(replace(shipped, regions=regions), begin, 600)
    assert decided == UNPRIMED_DECIDED
    assert not unsure[-1]
