"""Adaptation of a skill to via-points, their agreement with each other, and their errors; and the
start of a task where the hands rest.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from kmp import ViaPointMissed
from thirdhand.contract.requests import ViaPoint, ViaPointInForce
from thirdhand.core.frame import Record, Vector
from thirdhand.core.skill.segmented import SegmentedKMP
from thirdhand.core.skill.skill import Skill
from thirdhand.core.skill.task_clock import NOT_BEGUN, PROGRESS
from thirdhand.core.skill.via_points import NEIGHBOURS, neighbourhoods, rest_of
from thirdhand.skills.pose_via_points import (
    NOTED_RAD,
    check_turns,
    gripper_through,
    missed_by_rad,
    turn_through,
)
from thirdhand.skills.skill_file import SkillError, StoredSkill, with_file

# [m/m] largest ratio of the tool's motion to the hands', of an affine mean and between via-points
MAX_GAIN = 4.0
NEAR_M = 0.001  # tools this near to each other never contradict each other
DEVIATIONS = 3.0  # nor do tools within this multiple of their standard deviations
# Hands up to 8 cm beside the start begin a task as well as those at it; at 12 cm, one of 16 does.
BESIDE_START_M = 0.07
FROM_START_M = 0.25  # hands farther away are not at the start
RESTING_S = 0.5
REPORTED_M = 0.005  # via-points missed or moved by more are reported


def adapted(skill: StoredSkill, via_points: Sequence[ViaPoint], *, tolerance: float) -> StoredSkill:
    """The skill adapted to these via-points and no others, by algorithm 1 of Huang et al. 2019.

    Via-points between which the tool would move more than MAX_GAIN times as far as the hands
    contradict each other, as the tool would amplify the trembling of resting hands. Via-points of a
    task do not, as the skill's segments distinguish them.

    Raises SkillError if the via-points contradict each other, or the tolerance [m] is negative.
    """
    if not tolerance >= 0:
        names = [point.name for point in via_points]
        raise SkillError(
            f"cannot adapt to {names}: tolerance is {tolerance:g} m; 0 or more accepted"
        )
    if skill.conductor is not None:
        via_points = [of_one(point, skill.conductor) for point in via_points]
    inputs = neighbourhoods(via_points)[0]
    owners = [point for point in via_points for _ in range(points_made_of([point]))]
    check_agreement(via_points, skill)
    check_turns(owners, inputs)
    skill = replace(skill, via_points=tuple(via_points), tolerance=tolerance)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ViaPointMissed)  # `in_force` reports it
            # The covariance of IJRR 2019 is N times that of a single point. The reference is scaled
            # by 1 / N unless it is a mixture's, so the variance of a via-point is scaled, too.
            weight = 1.0 if skill.components else 1.0 / len(skill.model.primitive.base.inputs)
            skill = replace(
                skill, model=skill.model.through(via_points, tolerance=tolerance, weight=weight)
            )
            model_inputs = skill.model.inputs(
                inputs, [rest_of(point, skill.model.names) for point in owners]
            )
            turn = turn_through(skill, owners, model_inputs, tolerance)
            gripper = gripper_through(skill, owners, model_inputs, tolerance)
    except ValueError as error:
        raise SkillError(
            f"cannot adapt to {[point.name for point in via_points]}: {error}"
        ) from None
    return with_file(replace(skill, turn=turn, gripper=gripper))


def with_points(skill: Skill, points: Sequence[ViaPoint]) -> tuple[ViaPoint, ...]:
    """The skill's via-points with these, of which one replaces that of the same name."""
    named = {point.name: point for point in (*skill.via_points, *points)}
    return tuple(named.values())


def of_one(point: ViaPoint, conductor: int) -> ViaPoint:
    """The via-point with both hands at the position of the conducting one."""
    hand = (point.left, point.right)[conductor]
    return msgspec.structs.replace(point, left=hand, right=hand)


def check_agreement(via_points: Sequence[ViaPoint], skill: Skill | None = None) -> None:
    """Raise SkillError if via-points contradict each other that the skill cannot distinguish:

    |tool_i - tool_j| > MAX_GAIN |hands_i - hands_j| + NEAR_M + DEVIATIONS (std_i + std_j)
    """
    inputs, outputs, deviations = neighbourhoods(via_points)
    owners = [point for point in via_points for _ in range(points_made_of([point]))]
    is_distinct = (
        np.zeros((len(owners), len(owners)), bool)
        if skill is None
        else _are_distinct(skill, owners)
    )
    hands = np.linalg.norm(inputs[:, None] - inputs, axis=2)
    tools = np.linalg.norm(outputs[:, None] - outputs, axis=2)
    allowed = MAX_GAIN * hands + NEAR_M + DEVIATIONS * (deviations[:, None] + deviations)
    for i, j in np.argwhere((tools > allowed) & ~is_distinct)[:1].tolist():
        raise SkillError(
            f"via-points {owners[i].name!r} and {owners[j].name!r} contradict each other: their "
            f"hands are {hands[i, j]:.4f} m apart and their tools {tools[i, j]:.4f} m; at most "
            f"{allowed[i, j]:.4f} m accepted, {MAX_GAIN:g} times the hands' distance and what "
            "their std allow"
        )


def _are_distinct(skill: Skill, owners: Sequence[ViaPoint]) -> NDArray[np.bool_]:
    """True for each pair (V, V) of two via-points of the skill's task, of via-points of two of its
    segments, or of one of each.
    """
    task_names = skill.model.names

    def own_name(point: ViaPoint) -> str:
        if point.name in task_names:
            return point.name
        return f"{point.segment} ->" if point.segment in task_names else ""

    names = np.array([own_name(point) for point in owners])
    return np.asarray((names[:, None] != names) & (names[:, None] != "") & (names != ""))


def in_force(skill: Skill) -> tuple[ViaPointInForce, ...]:
    """The via-points in force, each with its error [m] and the error of its orientation [rad]."""
    return tuple(
        ViaPointInForce(
            **msgspec.structs.asdict(point),
            missed_by_m=math.dist(point.tool, tool_at(skill, point)),
            missed_by_rad=missed_by_rad(skill, point),
        )
        for point in skill.via_points
    )


def warnings_of(before: Skill, after: Skill) -> tuple[str, ...]:
    """Warnings when one skill replaces another: via-points that are missed by more than
    REPORTED_M or NOTED_RAD, and via-points of both skills that move by more.
    """
    out = [
        f"via-point {point.name!r} is missed by {1000 * point.missed_by_m:.0f} mm: what was "
        "demonstrated or taught near it says otherwise. A smaller std makes it count more; a "
        "greater tolerance removes what was shown there"
        for point in in_force(after)
        if point.missed_by_m > REPORTED_M
    ]
    out += [
        f"the orientation of via-point {point.name!r} is missed by "
        f"{math.degrees(point.missed_by_rad):.0f}°: what was demonstrated or taught near it says "
        "otherwise"
        for point in in_force(after)
        if point.missed_by_rad is not None and point.missed_by_rad > NOTED_RAD
    ]
    for point in set(before.via_points) & set(after.via_points):
        moved_m = math.dist(tool_at(before, point), tool_at(after, point))
        if moved_m > REPORTED_M:
            out.append(f"via-point {point.name!r} is moved by {1000 * moved_m:.0f} mm by this")
    return tuple(sorted(out))


def tool_at(skill: Skill, point: ViaPoint) -> Vector:
    """The tool position (3,) [m] for hands that rest at a via-point."""
    position: Vector = skill.mean(
        np.array([[*point.left, *point.right]]), [rest_of(point, skill.model.names)]
    )[0]
    return position


def points_made_of(via_points: Sequence[ViaPoint]) -> int:
    """The number of points that `neighbourhoods` makes of via-points."""
    return sum(1 + NEIGHBOURS * bool(point.radius) for point in via_points)


def are_still(skill: Skill, state: Record) -> bool:
    """True if the hands that matter to a skill rest in this state."""
    return bool(state["hand_stillness"][_sides(skill)].min() > 0.5)


def _sides(skill: Skill) -> list[int]:
    return [0, 1] if skill.conductor is None else [skill.conductor] * 2


class StartPlace:
    """Tells when hands rest beside the start of a skill's task, and where the task then begins: at
    the hands, until they rest at its usual place again.
    """

    def __init__(self, period_s: float) -> None:
        self._rest_ticks = round(RESTING_S / period_s)
        self._since = 0  # the last tick at which the hands moved
        self._is_refused = False  # True until they move again
        self._usual = np.zeros((2, 3))  # where hands begin if nothing is moved [m]
        self._placed: Vector | None = None  # where they begin because of this
        self._proposed = np.zeros((2, 3))

    def moved(self, skill: Skill, state: Record) -> list[ViaPoint]:
        """The via-points by which the task begins where the hands rest in the state; empty if it
        does. `taken` or `refused` is called with what came of them.
        """
        model = skill.model
        tick = int(state["tick"])
        if not are_still(skill, state):
            self._since = tick
            self._is_refused = False
        rests = tick - self._since >= self._rest_ticks and not self._is_refused
        if not isinstance(model, SegmentedKMP) or model.clock is None or not rests:
            return []

        segments = model.placed.segments
        begins = segments["begins"]
        if self._placed is None or _away_m(begins[0], self._placed) > NEAR_M:
            self._usual = begins[0].copy()  # another skill, or taught anew
            self._placed = None
        hands = np.array(state["hands"][_sides(skill), 0])
        away_m = _away_m(hands, begins[0])
        if self._placed is not None and _away_m(hands, self._usual) < BESIDE_START_M < away_m:
            self._proposed = self._usual
            return _at_start(skill, self._usual)

        first = model.task.names[0]
        taught = [(point.left, point.right) for point in skill.via_points if point.name != first]
        others = [*begins[1:], begins[-1] + segments["way"][-1], *map(np.array, taught)]
        is_nearest = all(away_m <= _away_m(hands, other) for other in others)
        is_beside = BESIDE_START_M < away_m < FROM_START_M
        if not (is_nearest and is_beside and state["task_clock"][PROGRESS] == NOT_BEGUN):
            return []
        self._proposed = hands
        return _at_start(skill, hands)

    def taken(self) -> None:
        """The via-points that `moved` gave are in force."""
        self._placed = self._proposed

    def refused(self) -> None:
        """They are not: nothing is moved until the hands have."""
        self._is_refused = True


def _away_m(hands: Vector, place: Vector) -> float:
    """The distance [m] of the hands (2, 3) from their places (2, 3), the larger one."""
    return float(np.linalg.norm(hands - place, axis=1).max())


def _at_start(skill: Skill, hands: Vector) -> list[ViaPoint]:
    """The first via-point of the skill's task, and those in force at which a hand is where it
    begins, with that hand at its position in `hands` (2, 3) [m].
    """
    model = skill.model
    assert isinstance(model, SegmentedKMP)
    in_force = {point.name: point for point in skill.via_points}
    out = []
    for name, corners, nominal in zip(
        model.task.names, model.task.corners, model.nominal.at.reshape(-1, 3, 3), strict=True
    ):
        left, right, tool = map(_point, nominal)
        point = in_force.get(name)
        if point is None:
            if name != model.task.names[0]:
                continue
            point = ViaPoint(name, left, right, tool)
        for side, key in enumerate(("left", "right")):
            if corners[side] == model.task.corners[0, side]:
                point = msgspec.structs.replace(point, **{key: _point(hands[side])})
        if (corners == model.task.corners[0]).any():
            out.append(point)
    return out


def _point(position: Sequence[float] | Vector) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in position)
    return x, y, z
