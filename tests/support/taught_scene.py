"""The soldering scene's demonstrations and via-points, for the tests of learning."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from support.skills import at_rest
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.core.skill.skill import Skill
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.scene import Scene
from thirdhand_sim.teach import demonstrations

SCENE = Scene()
VIA_POINTS = SCENE.via_points()
HANDOVER = VIA_POINTS[0]


def demonstrated(count: int, *, late: int = 0) -> list[Demonstration]:
    """Demonstrations of the scene, in which the tool trails the hands by some samples."""
    out = []
    for taught in demonstrations(SCENE, count=count, seed=1):
        stamps, left, right = (part[late:] for part in taught[:3])
        out.append(Demonstration(stamps, left, right, taught.tool[: len(taught.tool) - late]))
    return out


def quickly(taught: Sequence[Demonstration]) -> Skill:
    """A coarse skill of two demonstrations, which is learned fast."""
    return learn(taught, name="coarse", components=5, points=60)


def error_m(skill: Skill, held_out: Sequence[Demonstration]) -> float:
    """The mean distance between predicted and demonstrated tool [m]."""
    return float(
        np.mean(
            [
                np.linalg.norm(skill.mean(take.hands) - take.tool[:, :3], axis=1).mean()
                for take in held_out
            ]
        )
    )


def deviations(skill: Skill, hands: Vector) -> Vector:
    """Standard deviations (T,) [m] of the predictions for resting hands (T, 6), as used by the
    gate.
    """
    return np.array([at_rest(skill, row).gate_m for row in hands])


def with_hands(point: ViaPoint, *, left: Sequence[float] = (0.0, 0.0, 0.0)) -> Vector:
    """Hands (6,) at a via-point, with an offset of the left one [m]."""
    return np.array([*(np.array(point.left) + left), *point.right])
