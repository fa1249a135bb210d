"""Corrections as via-points: within a segment, at a segment's end, of a skill without segments;
their effect, what they replace, and the offer after several corrections.
"""

from __future__ import annotations

import numpy as np
import pytest

from support.paths import RECORDINGS
from thirdhand.core.skill.skill import Skill
from thirdhand.core.skill.tuning import PATH_END_M
from thirdhand.skills.corrections import (
    OFFERED_AFTER,
    corrected,
    correction_at,
    newest_correction,
    offer_of,
    segment_of,
)
from thirdhand.skills.skill_file import SkillError, StoredSkill, decoded
from thirdhand.skills.via_points import adapted, in_force
from thirdhand_sim.scene import Scene

UP = np.array([0.0, 0.0, 0.08])


@pytest.fixture(scope="module")
def segmented() -> StoredSkill:
    """The shipped skill with the via-points of the nominal scene."""
    path = RECORDINGS / "soldering.npz"
    return adapted(
        decoded(path.read_bytes(), origin=str(path)), Scene().via_points(), tolerance=0.05
    )


def hands_in(skill: Skill, segment: int, share: float) -> np.ndarray:
    """Hands (6,) [m] on the paths of a segment."""
    begin, end = skill.model.hands[segment : segment + 2]
    return np.asarray(begin + share * (end - begin))


def tool_in(skill: Skill, hands: np.ndarray, segment: int) -> np.ndarray:
    """The tool's position (3,) [m] for hands (6,) at rest in a segment."""
    return skill.mean(hands[None], [skill.model.names[segment + 1]])[0]


@pytest.mark.parametrize(("segment", "share"), [(0, 0.2), (1, 0.5), (2, 0.5)])
def test_correction_moves_tool_in_its_segment(
    segmented: StoredSkill, segment: int, share: float
) -> None:
    """The ends of the segment do not move."""
    hands = hands_in(segmented, segment, share)
    correction = correction_at(segmented, hands, segment, tool_in(segmented, hands, segment) + UP)
    after, effect = corrected(segmented, correction.among(segmented.via_points), correction.point)
    names = segmented.model.names
    assert (correction.point.name, correction.point.segment, correction.replaced) == (
        "correction-1",
        names[segment],
        (),
    )
    assert segment_of(after, correction.point) == names[segment : segment + 2]
    assert in_force(after)[-1].missed_by_m < 1e-4
    for other in range(len(names) - 1):
        change = tool_in(after, hands, other) - tool_in(segmented, hands, other)
        np.testing.assert_allclose(change, UP if other == segment else 0.0, atol=1e-4)
    for name, via_hands in zip(names, segmented.model.hands, strict=True):
        np.testing.assert_allclose(
            after.mean(via_hands[None], [name]), segmented.mean(via_hands[None], [name]), atol=1e-4
        )
    assert effect.moved_m == pytest.approx(0.08, abs=1e-4)
    # By definition of the reach, more than half of the correction remains nearer, and less than
    # half farther away.
    for distance_m, is_more in ((effect.reach_m - 0.03, True), (effect.reach_m + 0.03, False)):
        moved = hands + np.array([0, 0, -distance_m, 0, 0, 0])
        share_left = (
            np.linalg.norm(tool_in(after, moved, segment) - tool_in(segmented, moved, segment))
            / 0.08
        )
        assert (share_left > 0.5) == is_more
    assert decoded(after.file, origin="a file").via_points == after.via_points


@pytest.mark.parametrize(
    ("segment", "share", "name"), [(0, 0.97, "handover"), (1, 0.02, "handover"), (1, 1.0, "glass")]
)
def test_correction_at_an_end_teaches_via_point(
    segmented: StoredSkill, segment: int, share: float, name: str
) -> None:
    """The via-point at that end is replaced."""
    hands = hands_in(segmented, segment, share)
    correction = correction_at(segmented, hands, segment, tool_in(segmented, hands, segment) + UP)
    (before,) = correction.replaced
    assert (correction.point.name, correction.point.segment, before.name) == (name, None, name)
    assert (correction.point.std, correction.point.radius, correction.point.follow) == (
        before.std,
        before.radius,
        before.follow,
    )
    after, _ = corrected(segmented, correction.among(segmented.via_points), correction.point)
    assert [point.name for point in after.via_points][-1] == name
    assert len(after.via_points) == len(segmented.via_points)
    index = segmented.model.names.index(name)
    for segment_beside in (index - 1, index):  # both segments agree where they meet
        np.testing.assert_allclose(
            tool_in(after, hands, segment_beside), correction.point.tool, atol=0.01
        )


def test_repeated_corrections_are_offered(segmented: StoredSkill) -> None:
    """Repeated corrections replace each other and are counted."""
    hands = hands_in(segmented, 0, 0.5)
    skill = segmented
    for count in range(1, OFFERED_AFTER + 1):
        assert offer_of(skill) == ""
        aside = 0.5 * PATH_END_M * (count % 2) * np.eye(6)[1]
        correction = correction_at(
            skill, hands + aside, 0, tool_in(segmented, hands, 0) + count * 0.5 * UP
        )
        assert len(correction.replaced) == (count > 1)
        skill, _ = corrected(skill, correction.among(skill.via_points), correction.point)
        assert (correction.point.name, correction.point.corrections) == (
            f"correction-{count}",
            count,
        )
        assert newest_correction(skill.via_points) == correction.point
    assert offer_of(skill).startswith(
        "correction-3 was corrected up to 3 times at nearly the same hands: show"
    )
    elsewhere = correction_at(
        skill, hands + 2.0 * PATH_END_M * np.eye(6)[1], 0, tool_in(skill, hands, 0) + UP
    )
    assert (elsewhere.point.name, elsewhere.replaced) == ("correction-4", ())


def test_amplifying_correction_is_refused(segmented: StoredSkill) -> None:
    """A correction that would amplify trembling hands is refused."""
    hands = hands_in(segmented, 0, 0.2)
    correction = correction_at(segmented, hands, 0, tool_in(segmented, hands, 0) + 5 * UP)
    with pytest.raises(
        SkillError,
        match=r"a correction of 40 cm so near to .* times as far as the hands; 4 times acc",
    ):
        corrected(segmented, correction.among(segmented.via_points), correction.point)
