"""Corrections as via-points: of one stage, at a stage's end, of a skill without stages; their
effect, what they replace, and what is proposed after several.
"""

from __future__ import annotations

import numpy as np
import pytest

from support.paths import RECORDINGS
from thirdhand.core.skill.skill import Skill
from thirdhand.core.skill.tuning import SEGMENT_END_M
from thirdhand.skills.corrections import (
    OFFERED_AFTER,
    corrected,
    correction_at,
    newest_correction,
    offer_of,
    stage_of,
)
from thirdhand.skills.skill_file import SkillError, StoredSkill, decoded
from thirdhand.skills.via_points import adapted, in_force
from thirdhand_sim.scene import Scene

UP = np.array([0.0, 0.0, 0.08])


@pytest.fixture(scope="module")
def staged() -> StoredSkill:
    """The shipped skill with the via-points of the nominal scene."""
    path = RECORDINGS / "soldering.npz"
    return adapted(decoded(path.read_bytes(), origin=str(path)), Scene().via_points(), tolerance=0.05)


def hands_in(skill: Skill, stage: int, share: float) -> np.ndarray:
    """Hands (6,) [m] on the segments of a stage."""
    begin, end = skill.model.hands[stage : stage + 2]
    return np.asarray(begin + share * (end - begin))


def tool_in(skill: Skill, hands: np.ndarray, stage: int) -> np.ndarray:
    """The tool's position (3,) [m] for hands (6,) at rest in a stage."""
    return skill.mean(hands[None], [skill.model.names[stage + 1]])[0]


@pytest.mark.parametrize(("stage", "share"), [(0, 0.5), (0, 0.2), (1, 0.5), (2, 0.5)])
def test_a_correction_moves_the_tool_in_its_stage_and_leaves_the_ends(
    staged: StoredSkill, stage: int, share: float
) -> None:
    hands = hands_in(staged, stage, share)
    made = correction_at(staged, hands, stage, tool_in(staged, hands, stage) + UP)
    after, effect = corrected(staged, made.among(staged.via_points), made.point)
    names = staged.model.names
    assert (made.point.name, made.point.stage, made.replaced) == ("correction-1", names[stage], ())
    assert stage_of(after, made.point) == names[stage : stage + 2]
    assert in_force(after)[-1].missed_by_m < 1e-4
    for other in range(len(names) - 1):
        change = tool_in(after, hands, other) - tool_in(staged, hands, other)
        np.testing.assert_allclose(change, UP if other == stage else 0.0, atol=1e-4)
    for name, at in zip(names, staged.model.hands, strict=True):
        np.testing.assert_allclose(after.mean(at[None], [name]), staged.mean(at[None], [name]), atol=1e-4)
    assert effect.moved_m == pytest.approx(0.08, abs=1e-4)
    # As its reach says: more than half of it remains nearer, and less than half farther away.
    for distance_m, is_more in ((effect.reach_m - 0.03, True), (effect.reach_m + 0.03, False)):
        moved = hands + np.array([0, 0, -distance_m, 0, 0, 0])
        share_left = np.linalg.norm(tool_in(after, moved, stage) - tool_in(staged, moved, stage)) / 0.08
        assert (share_left > 0.5) == is_more
    assert decoded(after.file, origin="a file").via_points == after.via_points


@pytest.mark.parametrize(("stage", "share", "name"), [(0, 0.97, "handover"), (1, 0.02, "handover"), (1, 1.0, "glass")])
def test_a_correction_at_an_end_of_a_stage_teaches_that_via_point_anew(
    staged: StoredSkill, stage: int, share: float, name: str
) -> None:
    hands = hands_in(staged, stage, share)
    made = correction_at(staged, hands, stage, tool_in(staged, hands, stage) + UP)
    (before,) = made.replaced
    assert (made.point.name, made.point.stage, before.name) == (name, None, name)
    assert (made.point.std, made.point.radius, made.point.follow) == (before.std, before.radius, before.follow)
    after, _ = corrected(staged, made.among(staged.via_points), made.point)
    assert [point.name for point in after.via_points][-1] == name
    assert len(after.via_points) == len(staged.via_points)
    index = staged.model.names.index(name)
    for stage_beside in (index - 1, index):  # both stages agree where they meet
        np.testing.assert_allclose(tool_in(after, hands, stage_beside), made.point.tool, atol=0.01)


def test_repeated_corrections_replace_each_other_are_counted_and_offered(staged: StoredSkill) -> None:
    hands, skill = hands_in(staged, 0, 0.5), staged
    for count in range(1, OFFERED_AFTER + 1):
        assert offer_of(skill) == ""
        aside = 0.5 * SEGMENT_END_M * (count % 2) * np.eye(6)[1]
        made = correction_at(skill, hands + aside, 0, tool_in(staged, hands, 0) + count * 0.5 * UP)
        assert len(made.replaced) == (count > 1)
        skill, _ = corrected(skill, made.among(skill.via_points), made.point)
        assert (made.point.name, made.point.corrections) == (f"correction-{count}", count)
        assert newest_correction(skill.via_points) == made.point
    assert offer_of(skill).startswith("correction-3 was corrected up to 3 times at nearly the same hands: show")
    elsewhere = correction_at(skill, hands + 2.0 * SEGMENT_END_M * np.eye(6)[1], 0, tool_in(skill, hands, 0) + UP)
    assert (elsewhere.point.name, elsewhere.replaced) == ("correction-4", ())


def test_a_skill_without_stages_is_corrected_by_its_kernel(skill: StoredSkill) -> None:
    hands = skill.hands[len(skill.hands) // 2].copy()
    made = correction_at(skill, hands, -1, skill.mean(hands[None])[0] + 0.5 * UP)
    assert (made.point.name, made.point.stage) == ("correction-1", None)
    after, effect = corrected(skill, made.among(()), made.point)
    assert effect.moved_m == pytest.approx(0.04, abs=2e-3)
    assert 0.0 < effect.reach_m <= 0.4
    assert adapted(after, (), tolerance=skill.tolerance).file == skill.file


def test_a_correction_that_would_amplify_trembling_hands_is_refused(staged: StoredSkill) -> None:
    hands = hands_in(staged, 0, 0.2)
    made = correction_at(staged, hands, 0, tool_in(staged, hands, 0) + 5 * UP)
    with pytest.raises(SkillError, match=r"a correction of 40 cm so near to .* times as far as the hands; 4 times acc"):
        corrected(staged, made.among(staged.via_points), made.point)
