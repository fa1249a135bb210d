"""Access to skills: figures, predictions for hands at rest, and files with other arrays."""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from kmp.storage import checksum
from thirdhand.core.frame import Vector
from thirdhand.core.skill import TURNS
from thirdhand.core.skill.skill import Prediction, Skill
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import StoredSkill
from thirdhand.workbench.learning.records import Figures
from thirdhand_sim.made_tasks import takes

STILL = np.zeros((2, 3))


def figures_of(skill: StoredSkill) -> Figures:
    """The figures that a skill's file holds."""
    return msgspec.json.decode(skill.figures, type=Figures)


def at_rest(skill: Skill, hands: npt.ArrayLike, **more: Any) -> Prediction:
    """The prediction for hands (6,) or (2, 3) [m] that do not move."""
    return skill.predict(np.reshape(hands, (2, 3)), STILL, STILL, **more)


def turns_of(rate: Vector, at_s: float, lag_s: float) -> Vector:
    """Rows (TURNS, 2, 9) of the filters of hands that turn evenly at `rate` (3,) [rad/s]; each
    filter adds the same lag.
    """
    rows = [
        Rotation.from_rotvec(rate * (at_s - (i + 1) * lag_s)).as_matrix().ravel()
        for i in range(TURNS)
    ]
    return np.stack([rows, rows], axis=1)


def file_with(skill: Skill, **arrays: Any) -> bytes:
    """The skill's file with other arrays, and their checksum; None leaves one out."""
    with np.load(io.BytesIO(skill.file), allow_pickle=False) as original:
        changed = {
            name: value for name, value in (dict(original) | arrays).items() if value is not None
        }
    if "checksum" not in arrays and not any(value.dtype == object for value in changed.values()):
        changed["checksum"] = np.array(checksum(changed))
    out = io.BytesIO()
    np.savez(out, allow_pickle=True, **changed)
    return out.getvalue()


def made(kind: str, people: Iterable[int], *, each: int = 2) -> list[Demonstration]:
    """Demonstrations of a made task, some by each of the people."""
    return [take.demonstration for take in takes(kind, people=people, each=each)]
