"""The stated uncertainty of predictions holds on left-out demonstrations at each moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from support.skills import figures_of, made
from thirdhand.core.controller import start_state
from thirdhand.core.frame import blank, frame_layout
from thirdhand.core.skill import SIGNS
from thirdhand.core.skill.model import LEVELS, NORMAL, REGION_95, Regions
from thirdhand.core.skill.stage import SkillStage
from thirdhand.core.skill.step import calibrate
from thirdhand.core.skill.tuning import UNSURE_M
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import SkillError, StoredSkill, decoded, with_file
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.learning.records import TimedErrors
from thirdhand.workbench.learning.regions import (
    REGION_BLOCKS,
    blocks_of,
    calibrated,
    calibrated_without,
)

NO_SIGNS = np.zeros((150, SIGNS))


def apart(rng: np.random.Generator, *, times: float = 1.0) -> TimedErrors:
    """Errors on a demonstration that are not normal: three times the covariance, heavy tails, early
    or late.
    """
    count = 150
    person = np.exp(0.3 * rng.normal())
    covariance = np.tile(np.diag([4e-4, 1e-4, 2e-4]), (count, 1, 1))
    velocity = np.clip(rng.normal(size=(count, 3)), -1, 1) * (rng.random(count) < 0.5)[:, None]
    tails = rng.standard_t(4, size=(count, 3)) * np.sqrt(np.diagonal(covariance[0]))
    errors = times * (3.0 * person * tails + 0.2 * rng.normal(size=(count, 1)) * velocity)
    return TimedErrors(errors, covariance, velocity, NO_SIGNS)


@pytest.mark.parametrize("count", [6, 12, 40])
def test_regions_hold_on_other_people(count: int) -> None:
    """Regions of every level contain the stated share."""
    held = []
    for seed in range(20):
        rng = np.random.default_rng([seed, count])
        regions = calibrated([apart(rng) for _ in range(count)], np.arange(count))
        held.append(np.mean([apart(rng).inside(regions) for _ in range(40)], axis=0))
    shares = dict(zip(LEVELS, np.mean(held, axis=0), strict=True))
    assert shares[0.5] == pytest.approx(0.5, abs=0.05)
    assert shares[0.95] == pytest.approx(0.95, abs=0.02)
    assert shares[0.99] > 0.97
    assert regions.radii[LEVELS.index(0.95)] == pytest.approx(REGION_95)
    assert regions.std_s == pytest.approx(0.07, abs=0.05), (
        "in units of a covariance that is too small"
    )


def places(rng: np.random.Generator) -> TimedErrors:
    """Errors on a demonstration that are normal: 1 cm, and 10 cm in a tenth of the samples; the
    covariance has another scale.
    """
    std = np.where(rng.random(150) < 0.1, 0.1, 0.01)
    covariance = std[:, None, None] ** 2 * np.eye(3)
    return TimedErrors(
        std[:, None] * rng.normal(size=(150, 3)), 0.3 * covariance, np.zeros((150, 3)), NO_SIGNS
    )


def test_unsure_where_wrong() -> None:
    """The skill is rarely unsure elsewhere."""
    rng = np.random.default_rng(4)
    regions = calibrated([places(rng) for _ in range(12)], np.arange(12))
    asked = [places(rng) for _ in range(40)]
    wrong = np.concatenate([case.is_wrong for case in asked])
    probabilities = np.concatenate([case.probabilities(regions) for case in asked])
    assert probabilities.mean() == pytest.approx(wrong.mean(), abs=0.02)
    assert (probabilities > regions.alarm)[wrong].mean() > 0.9
    assert (probabilities > regions.alarm)[~wrong].mean() < 0.15
    assert probabilities[wrong].mean() > 5 * probabilities[~wrong].mean()


def test_detector_learns_which_signs_tell() -> None:
    """A sign that tells large errors, beside a covariance that does not, raises the alarm at them;
    signs that tell nothing are hardly weighed, and where no error is large, no probability is.
    """
    rng = np.random.default_rng(5)

    def take(wrong_share: float) -> TimedErrors:
        is_large = rng.random(150) < wrong_share
        signs = rng.normal(size=(150, SIGNS))
        signs[:, 3] += 2.5 * is_large
        length = np.where(is_large, 0.15, 0.02)
        errors = length[:, None] * rng.normal(size=(150, 3))
        covariance = np.tile(1e-3 * np.eye(3), (150, 1, 1))
        return TimedErrors(errors, covariance, np.zeros((150, 3)), signs)

    takes = [take(0.15) for _ in range(12)]
    regions = calibrated(takes, np.arange(12))
    weights = np.array(regions.weights[2:])
    assert weights[3] > 5 * np.abs(np.delete(weights, 3)).max()
    asked = [take(0.15) for _ in range(40)]
    wrong = np.concatenate([case.is_wrong for case in asked])
    probabilities = np.concatenate([case.probabilities(regions) for case in asked])
    assert (probabilities > regions.alarm)[wrong].mean() > 0.8
    assert (probabilities > regions.alarm)[~wrong].mean() < 0.17
    constant = wrong.mean() * (1 - wrong.mean())
    assert ((probabilities - wrong) ** 2).mean() < 0.6 * constant
    good = [take(0.0) for _ in range(12)]
    calm = calibrated(good, np.arange(12))
    assert max(case.probabilities(calm).max() for case in good) < 0.05


def test_own_region_has_no_part_in_judgement() -> None:
    rng = np.random.default_rng(2)
    usual = [apart(rng) for _ in range(12)]
    spoilt = [*usual[:4], apart(rng, times=30.0), *usual[5:]]
    assert [len(block) for block in blocks_of(np.arange(12))] == [2] * REGION_BLOCKS
    together = np.arange(len(usual))
    before = calibrated_without(usual, together)
    after = calibrated_without(spoilt, together)
    assert before[4][1] == after[4][1] == after[5][1]
    assert before[0][1] != after[0][1]
    assert after[4][0].inside(after[4][1])[LEVELS.index(0.95)] < 0.5


def test_covariance_is_scaled_along_motion() -> None:
    """The covariance reaches as far as its longest axis."""
    rng = np.random.default_rng(3)
    out = np.empty((3, 3))
    for _ in range(50):
        root = 0.05 * rng.normal(size=(3, 3))
        velocity = rng.normal(size=3)
        expected = 2.5 * (root @ root.T + 0.3**2 * np.outer(velocity, velocity))
        reach_m = calibrate(root @ root.T, velocity, 2.5, 0.3, out)
        np.testing.assert_allclose(out, expected, rtol=0, atol=1e-10)
        assert reach_m == pytest.approx(
            np.sqrt(REGION_95 * np.linalg.eigvalsh(expected)[-1]), rel=1e-6
        )
    assert calibrate(1e-4 * np.eye(3), np.zeros(3), 1.0, 0.0, out) == pytest.approx(
        0.01 * np.sqrt(REGION_95)
    )


def test_unsure_flag_does_not_flicker() -> None:
    """The flag is raised where the region is too large."""
    settings = Settings()
    skill = shipped_skill()
    state = start_state(settings, skill)
    frame = blank(frame_layout(len(settings.joints.names)))
    state["hands"][:, 0] = skill.hands[0].reshape(2, 3)

    def told(times: float) -> bool:
        """The flag, for a region with this multiple of the limit."""
        state["covariance"] = np.eye(3) * (times * UNSURE_M) ** 2 / REGION_95
        segment = SkillStage(settings, replace(skill, regions=Regions(1.0)))
        segment.step(state, frame)
        assert np.sqrt(REGION_95 * np.linalg.eigvalsh(frame["covariance"])[-1]) == pytest.approx(
            times * UNSURE_M
        )
        return bool(state["unsure"])

    state["tick"] = 5
    state["hand_ticks"] = 3
    assert [told(times) for times in (0.9, 1.1, 0.9, 0.7, 0.9, 1.1)] == [
        False,
        True,
        True,
        False,
        False,
        True,
    ]
    SkillStage(settings, skill).nothing(state, frame)
    assert not state["unsure"]


@pytest.fixture(scope="module")
def learned() -> StoredSkill:
    """A skill of six people, of whom the fifth is quick; the teacher reacts late."""
    return learn([take.every(4) for take in made("path", range(6), each=1)])


def test_learned_regions_hold(learned: StoredSkill) -> None:
    """The learned regions include the teacher's lag."""
    figures = figures_of(learned)
    assert learned.regions.std_s > 0.0
    assert figures.all.within_50 == pytest.approx(50, abs=10)
    assert figures.all.within_95 == pytest.approx(95, abs=3)
    stored = decoded(learned.file, origin="memory")
    assert stored.regions == learned.regions != NORMAL
    assert 0.0 < learned.regions.alarm <= 0.5
    assert figures.all.falsely_told < 20.0


def test_wrong_regions_in_file_are_refused(learned: StoredSkill) -> None:
    """A skill whose file has no regions has those of a normal distribution."""
    without = with_file(replace(learned, regions=NORMAL))
    assert decoded(without.file, origin="memory").regions == NORMAL
    for spoilt in (
        learned.regions._replace(scale=0.0),
        learned.regions._replace(std_s=-1.0),
        learned.regions._replace(radii=learned.regions.radii[::-1]),
        learned.regions._replace(radii=learned.regions.radii[1:]),
        learned.regions._replace(radii=tuple(2 * radius for radius in learned.regions.radii)),
        learned.regions._replace(weights=learned.regions.weights[1:]),
        learned.regions._replace(alarm=1.5),
    ):
        with pytest.raises(SkillError, match=r"region|radii|alarm|detector"):
            decoded(with_file(replace(learned, regions=spoilt)).file, origin="memory")
