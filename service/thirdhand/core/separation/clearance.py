"""Distance of an arm, at given joints, from people, from things and from itself."""

from __future__ import annotations

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.frame import Records, Vector
from thirdhand.core.geometry import between_segments, nearest_to_box, place, to_box
from thirdhand.core.separation import FARTHEST_REPORTED_M

PEOPLE, THINGS, ITSELF = 0, 1, 2  # index of a rule in `brake`, `reaction_s` and `clearance`
NEAR_HAND, NEAR_ITSELF = -1, -2  # the nearest object, if it is not a box; boxes are numbered from 0
NOBODY = np.empty((0, 3))  # no hands


@compiled
def clearance(
    joints: Vector, hands: Vector, parameters: Records, capsules: Records, pairs: Vector, boxes: Vector
) -> tuple[float, int, int]:
    """Smallest distance [m] of the arm beyond its clearances; see `Separation.clearance`.

    min over pairs of (distance of the capsules' axes - their radii - clearance of the rule)
    """
    config, near, forearm = parameters[0], np.empty(9), np.empty((2, 3))
    placed = np.empty((len(capsules), 2, 3))
    place(joints, config.frames, config.axes, capsules, placed)
    least, part, thing = FARTHEST_REPORTED_M, -1, -1
    for capsule in range(config.first, len(capsules)):
        radius = capsules[capsule].radius
        for hand in range(len(hands)):
            forearm[0], forearm[1] = hands[hand], hands[hand] + config.forearm
            gap_m = between_segments(placed[capsule], forearm, near) - radius - config.hand_radius
            gap_m -= config.clearance[PEOPLE]
            if gap_m < least:
                least, part, thing = gap_m, capsule, NEAR_HAND
        for box in range(len(boxes)):
            inner = nearest_to_box(placed[capsule], boxes[box])
            gap_m = to_box(placed[capsule], inner, boxes[box], near) - radius - config.clearance[THINGS]
            if gap_m < least:
                least, part, thing = gap_m, capsule, box
    for pair in range(len(pairs)):
        first, other = pairs[pair]
        gap_m = between_segments(placed[first], placed[other], near) - config.clearance[ITSELF]
        gap_m -= capsules[first].radius + capsules[other].radius
        if gap_m < least:
            least, part, thing = gap_m, other, NEAR_ITSELF
    return least, part, thing
