"""Storage of the learned skill, with the bytes of its file."""

from __future__ import annotations

import msgspec
import numpy as np

from thirdhand.skills.demonstration import NamedDemonstration, fingerprint
from thirdhand.skills.residual_risk import ResidualRisk
from thirdhand.skills.skill_file import StoredSkill, with_file
from thirdhand.skills.stored_demonstrations import packed
from thirdhand.workbench.learning.judgement import Judgement
from thirdhand.workbench.learning.records import Fitted, Pose
from thirdhand.workbench.learning.takes import Division, conductor_of

BOX_MARGIN_M = 0.25  # targets may leave the box of the demonstrated positions by this distance


def stored(
    name: str, division: Division, fitted: Fitted, pose: Pose, judgement: Judgement
) -> StoredSkill:
    """The skill of a model and pose with its figures."""
    takes = [*division.takes, *division.earlier]
    positions = np.concatenate([take.position for take in takes])
    figures = msgspec.json.encode(judgement.figures).decode()
    skill = StoredSkill(
        name=name,
        model=fitted.model,
        orientation=pose.orientation,
        turn=pose.turn,
        gripper=pose.gripper,
        workspace=np.stack(
            [positions.min(axis=0) - BOX_MARGIN_M, positions.max(axis=0) + BOX_MARGIN_M]
        ),
        threshold=fitted.gate.threshold,
        learned_from=fingerprint(take.demonstration for take in takes),
        demonstrations=packed(
            [NamedDemonstration(take.name, take.demonstration) for take in takes]
        ),
        components=division.options.components or 0,
        figures=figures,
        conductor=conductor_of(division, fitted),
        regions=judgement.regions,
        residual_risk=ResidualRisk.of(figures).accepted,
    )
    return with_file(skill)
