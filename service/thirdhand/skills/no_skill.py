"""The stand-in for a skill in a cell where a policy leads alone."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from kmp import KMP, GaussianKernel, Gaussians
from thirdhand.core.skill import MAX_SKILL_DISTANCE_M
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import (
    HIGHEST_GATE_M,
    SkillError,
    StoredSkill,
    skill_in,
    with_file,
)

NO_SKILL = "none, wishes lead"
OF_WISHES = "wishes"  # instead of the hash of demonstrations


def stand_in(path: Path) -> StoredSkill:
    """The stand-in in a file that `learn --wishes` has written. Raises SkillError."""
    skill = skill_in(path)
    if skill.learned_from != OF_WISHES:
        raise SkillError(
            f"{path}: a skill that was learned from demonstrations, and the tool follows wishes "
            "alone: leave `[files] skill` out, or set `[skill] blend = true`"
        )
    return skill


def leads_alone(settings: Settings) -> bool:
    """True for a cell in which wishes lead, and no skill does."""
    return settings.skill.has_wishes and not settings.skill.blend


@cache
def no_skill() -> StoredSkill:
    """A skill that is never asked: it has the tool in front of the base plate, pointing down."""
    tool = Gaussians(np.array([[0.5, 0.0, 0.3]]), np.eye(3)[None])
    primitive = KMP.fit(np.zeros((1, 6)), tool, kernel=GaussianKernel(1.0), lambda_mean=1.0)
    box = MAX_SKILL_DISTANCE_M * np.array([[-1.0] * 3, [1.0] * 3])
    skill = StoredSkill(
        name=NO_SKILL,
        model=HandsKMP(primitive),
        orientation=np.array([1.0, 0.0, 0.0, 0.0]),
        workspace=box,
        threshold=HIGHEST_GATE_M,
        learned_from=OF_WISHES,
    )
    return with_file(skill)
