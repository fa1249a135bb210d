"""Properties that every model of a skill has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from support.paths import RECORDINGS
from thirdhand.core.frame import Vector
from thirdhand.core.skill import ORDER
from thirdhand.core.skill.model import Motion, Seen
from thirdhand.core.skill.skill import MODELS, UNTOLD, Skill
from thirdhand.core.skill.tuning import TURN_LAG_S
from thirdhand.skills.skill_file import decoded, with_file
from thirdhand.skills.via_points import adapted
from thirdhand_sim.scene import Scene

FILES = {"HandsKMP": "experiments/as-paper.npz", "SegmentedKMP": "soldering.npz"}
STILL = np.array([[1.0, 1.0]])
H = 0.02
# arrays that files may lack
LATER = {
    "HandsKMP": {"error_inputs", "error_samples", "error_unknown_std", "neighbours"},
    "SegmentedKMP": {"levers"},
}


@pytest.fixture(params=MODELS, ids=lambda model: model.__name__)
def skill(request: pytest.FixtureRequest) -> Skill:
    """A skill with this model, adapted to the scene's via-points."""
    learned = decoded(
        (RECORDINGS / FILES[request.param.__name__]).read_bytes(), origin="a recording"
    )
    assert type(learned.model) is request.param
    return adapted(learned, Scene().via_points(), tolerance=0.05)


@pytest.fixture
def hands(skill: Skill) -> Vector:
    """Hands (6,) between two demonstrated samples."""
    return 0.6 * skill.hands[0] + 0.4 * skill.hands[-1]


def predicted(skill: Skill, hands: Vector, velocity: Vector, **more: object) -> Motion:
    prediction = skill.predict(
        hands.reshape(2, 3), velocity.reshape(2, 3), np.zeros((2, 3)), STILL[0], **more
    )  # type: ignore[arg-type]
    return Motion(*prediction[:6])


def test_prediction_has_its_derivative(skill: Skill, hands: Vector) -> None:
    """The rounded prediction is the mean with its derivative along the motion."""
    velocity = np.array([0.3, -0.4, 0.2, 0.4, 0.3, 0.1])
    prediction = predicted(skill, hands, velocity)
    belief = skill.model.belief(hands)
    still = predicted(skill, hands, np.zeros(6))
    np.testing.assert_allclose(still.position, skill.mean(hands[None])[0], rtol=0, atol=0.51e-6)
    behind, ahead = (
        predicted(skill, hands + step * velocity, np.zeros(6), belief=belief).position
        for step in (-H, H)
    )
    np.testing.assert_allclose(prediction.velocity, (ahead - behind) / (2 * H), atol=0.01)
    assert not predicted(skill, hands, np.zeros(6)).velocity.any()


def test_covariance_and_gate_are_those_of_many_hands(skill: Skill, hands: Vector) -> None:
    """Confidence and gate of one hand equal those of a batch."""
    prediction = predicted(skill, hands, np.zeros(6))
    np.testing.assert_allclose(
        prediction.covariance, skill.model.covariances(hands[None])[0], rtol=0, atol=0.6e-10
    )
    assert prediction.gate_m == pytest.approx(skill.model.gates_m(hands[None])[0], abs=1e-6)
    assert np.linalg.eigvalsh(prediction.covariance).min() > 0.0
    far_hands = hands + np.array([0.0, 0.0, 0.5, 0.0, 0.0, -0.5])
    assert predicted(skill, far_hands, np.zeros(6)).gate_m > skill.threshold


def test_its_inputs_move_with_the_hands(skill: Skill, hands: Vector) -> None:
    model = skill.model
    velocity = np.array([0.1, 0.2, 0.0, 0.0, -0.1, 0.2])
    moving = np.stack([hands, velocity, np.zeros(6)])
    memory = np.tile(hands, (ORDER, 1))
    observation = Seen(
        moving, STILL[0], memory, UNTOLD, TURN_LAG_S, moving, model.belief(hands), 0.0
    )
    inputs, moves = model.moving_inputs(observation)
    assert inputs.shape == (model.shape[0],)
    np.testing.assert_array_equal(inputs, model.inputs(hands[None])[0])
    behind, ahead = (
        model.moving_inputs(
            observation._replace(moving=moving + step * np.outer((1, 0, 0), velocity))
        )[0]
        for step in (-H, H)
    )
    np.testing.assert_allclose(moves, (ahead - behind) / (2 * H), atol=1e-9)


def test_stored_model_says_the_same(skill: Skill) -> None:
    """A skill that is stored and read again predicts the same bits."""
    model = skill.model
    assert (
        set(model.own_arrays()) - {"names", "task_clock"}
        == set(model.ranges) - LATER[type(model).__name__]
    )
    back = decoded(skill.file, origin="a file")
    assert type(back.model) is type(model)
    assert back.model.mean(model.hands).tobytes() == model.mean(model.hands).tobytes()
    assert back.model.covariances(model.hands).tobytes() == model.covariances(model.hands).tobytes()
    assert with_file(replace(back, file=b"")).file == skill.file
