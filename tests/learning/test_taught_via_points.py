"""Via-points: met, followed in their neighbourhood, removed, refused if they contradict each other,
and reported if missed or moved.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from support.taught_scene import HANDOVER, VIA_POINTS, with_hands
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.skill.skill import Skill
from thirdhand.skills.skill_file import SkillError
from thirdhand.skills.via_points import adapted, in_force, warnings_of


def test_via_points_are_met(aimed: Skill) -> None:
    assert [point.name for point in in_force(aimed)] == ["handover", "glass", "soldering"]
    assert all(point.missed_by_m < 0.003 for point in in_force(aimed))


@pytest.mark.parametrize("step", [(0.02, 0.0, 0.0), (0.0, -0.02, 0.0), (-0.01, 0.01, 0.01)])
def test_neighbourhood_follows_a_hand_or_is_flat(aimed: Skill, step: tuple[float, ...]) -> None:
    glass = VIA_POINTS[1]
    followed = aimed.mean([with_hands(HANDOVER, left=step)])[0]
    np.testing.assert_allclose(followed, np.add(HANDOVER.tool, step), atol=0.006)
    np.testing.assert_allclose(
        aimed.mean([with_hands(glass, left=step)])[0], glass.tool, atol=0.006
    )


def test_via_points_are_taught_to_the_base(learned: Skill, aimed: Skill) -> None:
    """Via-points are not added to an adapted primitive."""
    anew = adapted(aimed, VIA_POINTS[1:], tolerance=0.05)
    assert anew.file == adapted(learned, VIA_POINTS[1:], tolerance=0.05).file
    assert adapted(aimed, (), tolerance=learned.tolerance).file == learned.file


def moved(point: ViaPoint, name: str, *, hands: float, tool: float, **more: Any) -> ViaPoint:
    """A via-point whose left hand and tool are elsewhere [m]."""
    left = point.left
    tool_m = point.tool
    return msgspec.structs.replace(
        point,
        name=name,
        left=(left[0] + hands, left[1], left[2]),
        tool=(tool_m[0], tool_m[1] + tool, tool_m[2]),
        **more,
    )


EXACT = msgspec.structs.replace(HANDOVER, radius=0.0, std=0.0001)


@pytest.mark.parametrize("hands", [0.0, 0.001, 0.01, 0.05])
def test_contradicting_via_points_are_refused(skill: Skill, hands: float) -> None:
    """The error names them."""
    steep = 4.0 * hands + 0.001 + 0.0006
    with pytest.raises(
        SkillError, match=r"'handover' and 'twin' contradict each other: their hands are"
    ) as caught:
        adapted(
            skill, (EXACT, moved(EXACT, "twin", hands=hands, tool=steep + 0.001)), tolerance=0.05
        )
    assert f"at most {steep:.4f} m accepted, 4 times the hands' distance" in str(caught.value)
    allowed = adapted(
        skill, (EXACT, moved(EXACT, "twin", hands=hands, tool=steep - 0.0005)), tolerance=0.05
    )
    query = np.array([*EXACT.left, *EXACT.right])
    assert np.linalg.norm(allowed.model.primitive.jacobian(query), 2) < 10.0


def test_loose_via_points_contradict_less(skill: Skill) -> None:
    """A larger deviation allows more; neighbourhoods allow less."""
    adapted(skill, (EXACT, moved(EXACT, "twin", hands=0.001, tool=0.05, std=0.02)), tolerance=0.05)
    twin = moved(EXACT, "twin", hands=0.05, tool=0.12)
    adapted(skill, (EXACT, twin), tolerance=0.05)
    with pytest.raises(SkillError, match="contradict each other"):
        adapted(skill, (EXACT, msgspec.structs.replace(twin, radius=0.025)), tolerance=0.05)


def test_missed_and_moved_via_points_are_named(aimed: Skill) -> None:
    loose = moved(HANDOVER, "loose", hands=0.06, tool=0.2, radius=0.0, std=0.05)
    after = adapted(aimed, (*VIA_POINTS, loose), tolerance=0.05)
    missed = next(point.missed_by_m for point in in_force(after) if point.name == "loose")
    assert missed > 0.005
    assert f"via-point 'loose' is missed by {1000 * missed:.0f} mm" in warnings_of(aimed, after)[0]

    soft = moved(HANDOVER, "soft", hands=0.0, tool=0.0, radius=0.0, std=0.02)
    first = adapted(aimed, (soft,), tolerance=0.05)
    second = adapted(
        aimed,
        (soft, moved(HANDOVER, "hard", hands=0.03, tool=0.1, radius=0.0, std=0.0001)),
        tolerance=0.05,
    )
    assert any("via-point 'soft' is moved by" in text for text in warnings_of(first, second))
