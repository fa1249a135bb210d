"""Skills of each kind, learned from made takes."""

from __future__ import annotations

import msgspec
import numpy as np

from thirdhand.contract.requests import ViaPoint
from thirdhand.core.skill.skill import Skill
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.lab.reached import taught
from thirdhand_sim.made_tasks import TASK_KINDS
from thirdhand_sim.made_tasks import takes as made

KINDS = (
    "clock",
    "clock between via-points",
    "memory",
    "refined by a clock",
    "mixture",
    "cyclic",
    "one_hand",
    "heading",
)


def takes(count: int, *, timetable: bool) -> list[Demonstration]:
    """Hands that move at different speeds and then rest; the tool continues during the rest, or
    moves with the left hand.
    """
    out = []
    times = np.arange(0.0, 7.0, 0.02)
    for i in range(count):
        rng = np.random.default_rng(i)
        share = np.clip((times - 0.4 - 0.3 * rng.random()) / rng.uniform(0.7, 1.6), 0.0, 1.0)
        began = times - times[np.argmax(share > 0)]
        progress = (share**3 * (10 - 15 * share + 6 * share**2))[:, None]
        left = (
            np.array((0.6, -0.2, 0.2))
            + (1.0 - progress) * (0.0, 0.25, 0.0)
            + rng.normal(0.0, 0.01, 3)
        )
        right = np.array((0.7, 0.3, 0.2)) + 0.0 * left + rng.normal(0.0, 0.01, 3)
        late = np.clip((began - 4.0) / 1.5, 0.0, 1.0)[:, None] if timetable else progress
        tool = np.array((0.5, 0.1, 0.4)) + late * np.array((0.0, 0.3, 0.1)) + 0.0 * left
        turn = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
        poses = [
            np.hstack([positions + rng.normal(0.0, 0.0005, positions.shape), turn])
            for positions in (left, right, tool)
        ]
        out.append(Demonstration((times * 1e9).astype(np.int64), poses[0], poses[1], poses[2]))
    return out


def named(count: int, *, timetable: bool) -> list[Demonstration]:
    """The takes with via-points at their begin and end."""
    out = []
    for take in takes(count, timetable=timetable):
        rows = [
            {
                "name": name,
                "left": take.left[index, :3].tolist(),
                "right": take.right[index, :3].tolist(),
            }
            | {"tool": take.tool[index, :3].tolist()}
            for name, index in (("start", 0), ("end", -1))
        ]
        out.append(take._replace(via_points=msgspec.convert(rows, tuple[ViaPoint, ...])))
    return out


def learned(kind: str) -> tuple[Skill, Demonstration]:
    """A skill of one kind, and a take that was not used in learning."""
    if kind in TASK_KINDS:
        *demonstrations, asked = (
            take.demonstration for take in made(kind, people=[0, 1, 2], each=2)
        )
        return taught(learn(demonstrations), asked.via_points), asked
    demonstrations = (named if "between" in kind else takes)(7, timetable="clock" in kind)
    if kind == "mixture":
        return learn(demonstrations[:6], components=6), demonstrations[6]
    if kind == "refined by a clock":
        return learn(demonstrations[4:6], refined=learn(demonstrations[:4])), demonstrations[6]
    return learn(demonstrations[:6]), demonstrations[6]
