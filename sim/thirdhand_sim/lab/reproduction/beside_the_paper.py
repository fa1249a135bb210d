"""The numbers of the soldering skill that differ from the paper's (section III-C), and the worth of
each difference: the same five demonstrations, learned and taught with one number at a time as in
the paper.

The figures are measured in open loop, in random scenes: the distance of the target from the places
at the three events, with hands 8 mm per axis off their taught positions, and the gain from hand to
tool.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from thirdhand.core.skill.skill import Skill
from thirdhand.skills.skill_file import SkillError, StoredSkill
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.reached import at_the_events, open_loop_mm, taught
from thirdhand_sim.lab.rehearsal import demonstrated
from thirdhand_sim.lab.results import Array
from thirdhand_sim.lab.rivals.service import GMR_COMPONENTS
from thirdhand_sim.lab.scenes import draw
from thirdhand_sim.scene import GRASP_DISTANCE

PAPER_ELL = 0.5  # section III-C, which names no unit; metres are assumed
REAL_SCENES = EXPERIMENTS["hands"].seeds.evaluation["scenes"]


class Variant(NamedTuple):
    """A skill without via-points, and whether a place is one point (the paper) or a
    neighbourhood.
    """

    skill: StoredSkill
    bare: bool


class Reached(NamedTuple):
    """Errors of the target at each event (T, 3) [mm] in T scenes, the largest gain from hands to
    tool there (T, 3), and the number of scenes refused as contradictory.
    """

    errors_mm: Array
    steepness: Array
    refused: int

    def numbers(self) -> dict[str, Any]:
        """The figures by name."""
        return {
            "within_3_cm_at_all_events_percent": 100
            * float((self.errors_mm <= 1000 * GRASP_DISTANCE).all(axis=1).mean()),
            "error_median_mm": float(np.median(self.errors_mm)),
            "error_p95_mm": float(np.percentile(self.errors_mm, 95)),
            "steepness_median": float(np.median(self.steepness)),
            "refused": self.refused,
        }


def differences(share: float = 1.0, seed_offset: int = 0) -> dict[str, dict[str, Any]]:
    """The figures with our numbers, with each difference undone, and with all undone."""
    learned = functools.partial(learn, demonstrated(), components=GMR_COMPONENTS)
    ours = learned()
    variants = {
        "ours": Variant(ours, bare=False),
        "ell 0.5": Variant(learned(ell=PAPER_ELL), bare=False),
        "no spread": Variant(learned(spread_m=0.0), bare=False),
        "one point a place": Variant(ours, bare=True),
        "all three: the paper's": Variant(learned(ell=PAPER_ELL, spread_m=0.0), bare=True),
    }
    numbers = REAL_SCENES.moved(seed_offset).share(share, least=3)
    return {name: reached(variant, numbers).numbers() for name, variant in variants.items()}


def reached(variant: Variant, numbers: Sequence[int]) -> Reached:
    """Errors and steepness of a variant in random scenes."""
    errors = []
    steepness = []
    refused = 0
    for number in numbers:
        drawn = draw(number, seed=REAL_SCENES.seed)
        via_points = drawn.scene.via_points()
        if variant.bare:
            via_points = tuple(
                msgspec.structs.replace(point, radius=0.0, follow="none") for point in via_points
            )
        try:
            skill = taught(variant.skill, via_points)
        except SkillError:
            refused += 1
            continue
        errors.append(open_loop_mm(skill, drawn))
        hands, _ = at_the_events(drawn.scene, drawn.seed)
        steepness.append([np.linalg.norm(_slope(skill, row), ord=2) for row in hands])
    return Reached(np.array(errors).reshape(-1, 3), np.array(steepness).reshape(-1, 3), refused)


def _slope(skill: Skill, hands: Array) -> Array:
    """The tool's velocities (6, 3) for 1 m/s of each axis of the hands, at hands (6,) [m]."""
    positions = hands.reshape(2, 3)
    still = np.zeros((2, 3))
    return np.array(
        [skill.predict(positions, axis.reshape(2, 3), still).velocity for axis in np.eye(6)]
    )
