"""Predictions of a skill: position, velocity, acceleration and covariance."""

from __future__ import annotations

import numpy as np
import pytest

from support.taught_scene import SCENE
from thirdhand.core.frame import Vector
from thirdhand.core.skill.skill import Skill
from thirdhand.skills.demonstration import Demonstration
from thirdhand_sim.script import HandMotions, HandScript


def stacked(hands: HandMotions) -> tuple[Vector, Vector, Vector]:
    """Positions, velocities and accelerations (2, 3) of both hands."""
    return tuple(np.stack(pair) for pair in zip(hands.left, hands.right, strict=True))  # type: ignore[return-value]


@pytest.mark.parametrize("t", [1.5, 5.9])
def test_prediction_has_derivatives_of_motion(aimed: Skill, t: float) -> None:
    """Velocity and acceleration are those of the predicted motion."""
    script = HandScript(SCENE, seed=11)
    h = 1e-3
    before, now, after = (
        aimed.mean(stacked(script.truth(time_s))[0].reshape(1, 6))[0]
        for time_s in (t - h, t, t + h)
    )
    prediction = aimed.predict(*stacked(script.truth(t)))
    np.testing.assert_allclose(prediction.position, now, atol=1e-6)
    np.testing.assert_allclose(prediction.velocity, (after - before) / (2 * h), atol=1e-5)
    np.testing.assert_allclose(
        prediction.acceleration, (after - 2 * now + before) / h**2, atol=1e-4
    )


def test_prediction_is_rounded(learned: Skill, taught: list[Demonstration]) -> None:
    """The covariance is symmetric and positive definite."""
    random = np.random.default_rng(2)
    prediction = learned.predict(
        taught[4].hands[300].reshape(2, 3), random.normal(size=(2, 3)), random.normal(size=(2, 3))
    )
    for value in prediction[:3]:
        np.testing.assert_array_equal(value, np.round(value, 6))
    np.testing.assert_array_equal(prediction.covariance, prediction.covariance.T)
    assert np.linalg.eigvalsh(prediction.covariance).min() > 0
    # multiples of the primitive's covariance, not of held-out errors
    gate_m = learned.model.gates_m(taught[4].hands[300:301])[0]
    assert prediction.gate_m == pytest.approx(gate_m, rel=1e-4)
