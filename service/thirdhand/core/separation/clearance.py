"""Distance of an arm, at given joints, from people, from things and from itself."""

from __future__ import annotations

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.frame import Records, Vector
from thirdhand.core.geometry import between_segments, nearest_to_box, place, to_box
from thirdhand.core.separation import FARTHEST_REPORTED_M

# index of a rule in `brake`, `reaction_s` and `clearance`
PEOPLE = 0
THINGS = 1
ITSELF = 2
# the nearest object, if it is not a box; boxes are numbered from 0
NEAR_HAND = -1
NEAR_ITSELF = -2
NOBODY = np.empty((0, 3))  # no hands


@compiled
def clearance(
    joints: Vector,
    hands: Vector,
    parameters: Records,
    capsules: Records,
    pairs: Vector,
    boxes: Vector,
) -> tuple[float, int, int]:
    """Smallest distance [m] of the arm beyond its clearances; see `Separation.clearance`.

    min over pairs of (distance of the capsules' axes - their radii - clearance of the rule)
    """
    config = parameters[0]
    near = np.empty(9)
    forearm = np.empty((2, 3))
    placed = np.empty((len(capsules), 2, 3))
    place(joints, config.frames, config.axes, capsules, placed)
    least = FARTHEST_REPORTED_M
    part = -1
    thing = -1
    for capsule in range(config.first, len(capsules)):
        radius = capsules[capsule].radius
        for hand in range(len(hands)):
            forearm[0] = hands[hand]
            forearm[1] = hands[hand] + config.forearm
            gap_m = between_segments(placed[capsule], forearm, near) - radius - config.hand_radius
            gap_m -= config.clearance[PEOPLE]
            if gap_m < least:
                least = gap_m
                part = capsule
                thing = NEAR_HAND
        for box in range(len(boxes)):
            inner = nearest_to_box(placed[capsule], boxes[box])
            gap_m = (
                to_box(placed[capsule], inner, boxes[box], near) - radius - config.clearance[THINGS]
            )
            if gap_m < least:
                least = gap_m
                part = capsule
                thing = box
    for pair in range(len(pairs)):
        first, other = pairs[pair]
        gap_m = between_segments(placed[first], placed[other], near) - config.clearance[ITSELF]
        gap_m -= capsules[first].radius + capsules[other].radius
        if gap_m < least:
            least = gap_m
            part = other
            thing = NEAR_ITSELF
    return least, part, thing
