"""A linear prior mean of a primitive: chosen where it predicts clearly better, and as safe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kmp import KMP, AffineMean
from kmp.criteria.errors import rms
from support.circling import circling
from support.paths import RECORDINGS
from thirdhand.skills.skill_file import SkillError, StoredSkill, decoded, with_file
from thirdhand.workbench.learning.baselines import held_out_errors, linear
from thirdhand.workbench.learning.choice import MAX_GAIN, RIDGE_M, selection_of
from thirdhand.workbench.learning.direct_selection import DirectSelection, ridge_mean
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.learning.records import Evidence

APART_M = 0.15  # distance between takes, at which a constant mean attracts the tool


@pytest.fixture(scope="module")
def evidence() -> Evidence:
    results: list[Evidence] = []
    learn(
        [circling(seed, apart_m=APART_M) for seed in range(5)],
        points=120,
        ell=0.5,
        show=results.append,
    )
    return results[0]


@pytest.fixture(scope="module")
def skill(evidence: Evidence) -> StoredSkill:
    return evidence.skill


@pytest.fixture(scope="module")
def choice(evidence: Evidence) -> DirectSelection:
    return selection_of([(fold.take.hands, fold.take.position) for fold in evidence.held_out], 120)


def mean_of(skill: StoredSkill) -> AffineMean:
    prior = skill.model.primitive.prior_mean
    assert isinstance(prior, AffineMean)
    return prior


def test_linear_mean_predicts_better(evidence: Evidence, choice: DirectSelection) -> None:
    """For takes all over the table, it is better than a constant mean and than the linear function
    itself.
    """
    assert mean_of(evidence.skill).matrix.shape == (3, 6)
    error = rms(np.concatenate([fold.errors for fold in evidence.held_out]))
    constant = choice.parameters()
    residuals = choice.residuals(0.5, 0.001)
    over_constant = [
        fold.take.position - choice.primitive(constant, residuals, without=h).mean(fold.take.hands)
        for h, fold in enumerate(evidence.held_out)
    ]
    assert error < 0.010
    assert error < 0.6 * rms(np.concatenate(over_constant))
    assert error < 0.75 * rms(
        np.concatenate(held_out_errors([fold.take for fold in evidence.held_out], linear))
    )


def test_gate_holds_where_mean_extrapolates(skill: StoredSkill, evidence: Evidence) -> None:
    hands = np.concatenate([fold.take.hands[::20] for fold in evidence.held_out])
    for beside_m in (1.0, 2.0, 5.0):
        assert (
            skill.model.gates_m(hands + beside_m * np.array([1.0, 0, 0, 1.0, 0, 0]))
            > skill.threshold
        ).all()
        assert (
            skill.model.gates_m(hands + beside_m * np.array([1.0, 0, 0, 0, 0, 0])) > skill.threshold
        ).all()


def test_gain_of_mean_is_limited(skill: StoredSkill) -> None:
    """The tool moves at most `MAX_GAIN` times as far as the hands, for any demonstrations."""
    assert np.linalg.norm(mean_of(skill).matrix, 2) < MAX_GAIN
    random = np.random.default_rng(0)
    hands = random.normal(scale=0.1, size=(200, 6))
    steep = ridge_mean(
        hands, hands @ random.normal(scale=20.0, size=(6, 3)), RIDGE_M, max_gain=MAX_GAIN
    )
    assert np.linalg.norm(steep.matrix, 2) == pytest.approx(MAX_GAIN)
    still = hands * [1, 1, 1, 0.01, 0.01, 0.01]
    trembling = ridge_mean(
        still, hands[:, :3] + 3 * hands[:, 3:] * 0.01, RIDGE_M, max_gain=MAX_GAIN
    )
    assert np.abs(trembling.matrix[:, 3:]).max() < 0.2  # a hand that moved by 1 mm tells nothing


def test_file_serves_what_was_learned(skill: StoredSkill) -> None:
    restored = decoded(skill.file, origin="a file")
    hands = skill.hands[::10] + 0.01
    np.testing.assert_array_equal(restored.mean(hands), skill.mean(hands))
    step = 1e-4
    velocity = np.random.default_rng(0).normal(size=(2, 3))
    for positions in hands:
        prediction = restored.predict(positions.reshape(2, 3), velocity, np.zeros((2, 3)))
        np.testing.assert_allclose(prediction.position, skill.mean(positions[None])[0], atol=2e-6)
        ahead, behind = skill.mean(
            np.stack([positions + step * velocity.ravel(), positions - step * velocity.ravel()])
        )
        np.testing.assert_allclose(prediction.velocity, (ahead - behind) / (2 * step), atol=1e-4)


def test_a_task_between_via_points_has_none() -> None:
    shipped = decoded((RECORDINGS / "soldering.npz").read_bytes(), origin="shipped")
    primitive = shipped.model.primitive
    width = primitive.inputs.shape[1]
    outputs = primitive.outputs
    sloped = KMP.fit(
        primitive.inputs,
        primitive.reference,
        kernel=primitive.kernel,
        lambda_mean=1.0,
        representation="dense",
        prior_mean=AffineMean(np.ones((outputs, width)), np.zeros(outputs)),
    )
    model = replace(shipped.model, primitive=sloped)  # type: ignore[type-var]
    file = with_file(replace(shipped, model=model)).file
    with pytest.raises(SkillError, match="prior_mean goes with the inputs"):
        decoded(file, origin="a file")
