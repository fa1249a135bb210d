"""Judgement whether via-points are reached, for several experiments: the places of a scene are
taught, and the three events are judged in open loop, in closed loop (`rehearsal`) or live
(`load.live`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from thirdhand.contract.requests import TOLERANCE_M, ViaPoint
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.skills.skill_file import StoredSkill
from thirdhand.skills.via_points import adapted
from thirdhand_sim.bench import Bench, TaskEvents
from thirdhand_sim.lab.open_loop import targets
from thirdhand_sim.lab.rehearsal import demonstrated
from thirdhand_sim.lab.results import Array
from thirdhand_sim.lab.scenes import OFFSET_M, Drawn
from thirdhand_sim.people import Places
from thirdhand_sim.scene import TOOL_FROM_HAND, Scene
from thirdhand_sim.script import HandScript
from thirdhand_sim.sessions import SessionDemonstration

EVENTS = TaskEvents.__struct_fields__


def taught(skill: StoredSkill, via_points: Sequence[ViaPoint]) -> Skill:
    """The skill adapted to via-points, as the service does by default. Raises SkillError."""
    return adapted(skill, via_points, tolerance=TOLERANCE_M)


def ours(scene: Scene) -> Callable[[Bench], Skill]:
    """The shipped skill, adapted to the three via-points of a scene as in the demo."""
    skill = taught(shipped_skill(), scene.via_points())
    return lambda bench: skill


def places_in(scene: Scene) -> Places:
    """The places of a scene, without errors."""
    s = scene
    points = (s.left_start, s.right_start, s.handover, s.glass, s.soldering, s.iron, s.robot_start)
    return Places._make([*(np.array(point) for point in points), 0.0])


def shown() -> list[SessionDemonstration]:
    """The shipped demonstrations, with the places of their scene."""
    places = places_in(Scene())
    return [
        SessionDemonstration(
            np.arange(len(demonstration.tool), dtype=np.float64) * demonstration.period_s,
            demonstration.hands,
            demonstration.tool[:, :3],
            places,
        )
        for demonstration in demonstrated()
    ]


def at_the_events(scene: Scene, seed: int) -> tuple[Array, Array]:
    """Both hands (3, 6) [m] at the end of each rest, with errors of 8 mm per axis, and the wanted
    tool positions (3, 3) [m].
    """
    script = HandScript(scene, seed=seed, offset_std=OFFSET_M)
    motions = [script.truth(end) for _, end in scene.dwells]
    hands = np.array(
        [np.concatenate([motion.left.position, motion.right.position]) for motion in motions]
    )
    return hands, np.array([motions[0].left.position + TOOL_FROM_HAND, scene.glass, scene.carry])


def open_loop_mm(skill: Skill, drawn: Drawn) -> Array:
    """Distances (3,) [mm] of a taught skill's target from the place of each event."""
    hands, tool_places = at_the_events(drawn.scene, drawn.seed)
    return np.asarray(1000 * np.linalg.norm(targets(skill, hands) - tool_places, axis=1))
