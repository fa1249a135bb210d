"""Adaptation of the primitives of orientation and gripper to via-points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kmp import KMP, Gaussians
from kmp.orientation import OrientationKMP, log
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.core.geometry import angles
from thirdhand.core.skill.pose import LearnedGripper, LearnedOrientation
from thirdhand.core.skill.skill import Skill
from thirdhand.core.skill.via_points import rest_of
from thirdhand.skills.flat import flat_gripper, flat_orientation, is_flat
from thirdhand.skills.skill_file import SkillError

# standard deviations of a via-point's orientation and closure
STD_RAD = 0.004
STD_CLOSURE = 0.02
# largest turn between via-points: hands that tremble by 1 mm turn the tool by 2°
STEEPEST_RAD_PER_M = 40.0
NEAR_RAD = math.radians(1.0)  # orientations this near to each other never contradict each other
SAME_HANDS_NEAR_M = 0.01  # a gripper cannot be open and closed at hands this near to each other
NOTED_RAD = math.radians(2.0)  # orientations missed by more are reported
CLOSURES = {"open": 0.0, "closed": 1.0}


def turn_through(
    skill: Skill, owners: Sequence[ViaPoint], inputs: Vector, tolerance: float
) -> LearnedOrientation | None:
    """The learned orientation adapted to those of via-points; `owners` are the via-points of the
    inputs (V, I). None if the orientation is constant.
    """
    taught = {
        i: point.orientation for i, point in enumerate(owners) if point.orientation is not None
    }
    base = skill.turn and replace(skill.turn, primitive=skill.turn.primitive.base)
    if not taught:
        return None if base is None or is_flat(base.primitive) else base
    if base is None:
        learned = skill.model.primitive.base
        base = flat_orientation(learned.inputs, learned.kernel, skill.orientation)
    taught_inputs = inputs[list(taught)]
    quaternions = np.array(list(taught.values()))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    # of q and -q, which are the same orientation, the one nearer to what was learned
    now = OrientationKMP(base.primitive, base.auxiliary).mean(taught_inputs)
    quaternions *= np.where((now * quaternions).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    zeta = log(quaternions, base.auxiliary)
    return replace(
        base, primitive=_through(base.primitive, taught_inputs, zeta, STD_RAD / 2, tolerance)
    )


def gripper_through(
    skill: Skill, owners: Sequence[ViaPoint], inputs: Vector, tolerance: float
) -> LearnedGripper | None:
    """The learned gripper adapted to those of via-points; None if neither has a gripper."""
    taught = {
        i: CLOSURES[point.gripper] for i, point in enumerate(owners) if point.gripper is not None
    }
    base = skill.gripper.primitive.base if skill.gripper else None
    if not taught:
        return None if base is None or is_flat(base) else LearnedGripper(base)
    base = (
        base
        or flat_gripper(skill.model.primitive.base.inputs, ell=skill.model.gripper_ell).primitive
    )
    closures = np.array(list(taught.values()))[:, None]
    return LearnedGripper(_through(base, inputs[list(taught)], closures, STD_CLOSURE, tolerance))


def check_turns(owners: Sequence[ViaPoint], inputs: Vector) -> None:
    """Raise SkillError if via-points turn the tool by more than STEEPEST_RAD_PER_M, or open and
    close the gripper at the same hands; `owners` are the via-points of the inputs (V, 6).
    """
    hands = np.linalg.norm(inputs[:, None] - inputs, axis=2)
    for i, j in np.argwhere(np.triu(hands < math.pi / STEEPEST_RAD_PER_M, 1)).tolist():
        first = owners[i]
        other = owners[j]
        distance_m = float(hands[i, j])
        pair = (
            f"via-points {first.name!r} and {other.name!r} contradict each other: their hands are "
            f"{distance_m:.4f} m apart"
        )
        if first.orientation is not None and other.orientation is not None:
            turn = _angle(first.orientation, other.orientation)
            most = STEEPEST_RAD_PER_M * distance_m + NEAR_RAD
            if turn > most:
                by = math.degrees(turn)
                to = math.degrees(most)
                raise SkillError(
                    f"{pair} and their tools turned by {by:.0f}°; up to {to:.0f}° accepted"
                )
        if {first.gripper, other.gripper} == {"open", "closed"} and distance_m < SAME_HANDS_NEAR_M:
            raise SkillError(
                f"{pair}, with the gripper open at one and closed at the other; "
                f"{SAME_HANDS_NEAR_M} m needed"
            )


def missed_by_rad(skill: Skill, point: ViaPoint) -> float | None:
    """The error [rad] of a via-point's orientation; None if it has none."""
    if point.orientation is None or skill.turn is None:
        return None
    inputs = skill.model.inputs(
        np.array([[*point.left, *point.right]]), [rest_of(point, skill.model.names)]
    )
    x, y, z, w = OrientationKMP(skill.turn.primitive, skill.turn.auxiliary).mean(inputs)[0].tolist()
    return _angle(point.orientation, (x, y, z, w))


def _angle(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return float(angles(np.array(a) / math.hypot(*a), np.array(b) / math.hypot(*b)))


def _through(base: KMP, at: Vector, outputs: Vector, deviation: float, tolerance: float) -> KMP:
    """The primitive adapted to outputs (V, O) at inputs (V, I), each with this deviation."""
    covariance = deviation**2 / len(base.inputs) * np.eye(outputs.shape[1])
    return base.adapt(
        at, Gaussians(outputs, np.tile(covariance, (len(at), 1, 1))), tolerance=tolerance
    )
