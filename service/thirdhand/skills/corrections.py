"""Corrections: via-points where an operator led, or dragged, the tool to where it should have been.

They are inserted one by one into the skill in force, as in the interactive incremental learning of
Knauer et al., RA-L 2025. A correction acts in the segment of the task in which it was made. At
hands that rest at an end of that segment, it teaches the task's own via-point anew, so that both
segments that meet there still agree.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from thirdhand.contract.requests import MAX_REACH_M, Orientation, ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.core.skill.skill import Skill
from thirdhand.core.skill.tuning import PATH_END_M
from thirdhand.core.skill.via_points import rest_of
from thirdhand.skills.skill_file import SkillError, StoredSkill
from thirdhand.skills.via_points import MAX_GAIN, REPORTED_M, adapted

LEAST_CORRECTION_M = REPORTED_M  # a tool that is off by less is where the skill has it
OFFERED_AFTER = 3  # corrections at the same hands after which a demonstration is proposed
REACH_STEP_M = 0.02  # distance between the hands at which a correction's effect is examined
_NUMBERED = re.compile(r"correction-(\d+)")


class Correcting(NamedTuple):
    """A correction as a via-point, and the via-points that it replaces."""

    point: ViaPoint
    replaced: tuple[ViaPoint, ...]

    def among(self, via_points: Sequence[ViaPoint]) -> tuple[ViaPoint, ...]:
        """These via-points with the correction, which is the last one."""
        return (*(point for point in via_points if point not in self.replaced), self.point)


class Effect(NamedTuple):
    """Effect of a correction: it moves the tool by `moved_m` [m] at its hands, and by at least half
    of that while a hand is less than `reach_m` [m] away. Around them it moves the tool up to `gain`
    times as far as the hands.
    """

    moved_m: float
    reach_m: float
    gain: float


def correction_at(
    skill: Skill, hands: Vector, segment: int, tool: Vector, orientation: Orientation | None = None
) -> Correcting:
    """The correction that puts the tool (3,) [m], and its orientation if given, for hands (6,) [m]
    in a segment of the task (-1 for a skill without segments).

    It replaces earlier ones of the same segment at hands that are nearer than PATH_END_M, which
    are at the same positions.
    """
    left = _point(hands[:3])
    right = _point(hands[3:])
    names = skill.model.names
    end = _end_of(skill, hands, segment) if names else ""
    name_of_segment = None if end or not names else names[segment]
    replaced = (
        [point for point in skill.via_points if point.name == end]
        if end
        else _corrections_near(skill, hands, name_of_segment)
    )
    before = replaced[-1] if end and replaced else ViaPoint(end, left, right, _point(tool))
    point = msgspec.structs.replace(
        before,
        name=end or _new_name(skill),
        left=left,
        right=right,
        tool=_point(tool),
        orientation=orientation or before.orientation,
        segment=name_of_segment,
        corrections=1 + max((point.corrections for point in replaced), default=0),
    )
    return Correcting(point, tuple(replaced))


def _corrections_near(skill: Skill, hands: Vector, segment: str | None) -> list[ViaPoint]:
    """Earlier corrections in a segment at hands nearer than PATH_END_M to these (6,) [m]."""
    return [
        point
        for point in skill.via_points
        if _NUMBERED.fullmatch(point.name)
        and point.segment == segment
        and _apart_m(skill, hands, _hands(point)) < PATH_END_M
    ]


def _new_name(skill: Skill) -> str:
    """A name for the next correction, with a number above all others."""
    matches = [_NUMBERED.fullmatch(point.name) for point in skill.via_points]
    numbers = [int(match[1]) for match in matches if match]
    return f"correction-{1 + max(numbers, default=0)}"


def off_m(skill: Skill, correcting: Correcting) -> float:
    """The distance [m] of a correction's tool from where the skill has it for these hands."""
    point = correcting.point
    tool = skill.mean(_hands(point)[None], [rest_of(point, skill.model.names)])[0]
    return math.dist(point.tool, tool)


def newest_correction(via_points: Sequence[ViaPoint]) -> ViaPoint | None:
    """The correction that was made last; None if there is none."""
    return next((point for point in reversed(via_points) if point.corrections), None)


def offer_of(skill: Skill) -> str:
    """A proposal to learn from corrections that were repeated; empty if none was."""
    repeated = [point for point in skill.via_points if point.corrections >= OFFERED_AFTER]
    if not repeated:
        return ""
    times = max(point.corrections for point in repeated)
    names = ", ".join(point.name for point in repeated)
    return (
        f"{names} {'was' if len(repeated) == 1 else 'were'} corrected up to {times} times at "
        "nearly the same hands: show the task once as it should be, by `thirdhand record NAME`, "
        "and learn the skill again with this take, by `thirdhand learn`"
    )


def segment_of(skill: Skill, point: ViaPoint) -> tuple[str, ...]:
    """The via-points at which the segment of a correction begins and ends; empty if it has none."""
    return (
        ()
        if point.segment not in skill.model.names[:-1]
        else (str(point.segment), rest_of(point, skill.model.names))
    )


def corrected(
    skill: StoredSkill, via_points: Sequence[ViaPoint], at: ViaPoint
) -> tuple[StoredSkill, Effect]:
    """The skill with these via-points and no others, and what that changes at the correction `at`.

    Raises SkillError, also if the correction moves the tool more than MAX_GAIN times as far as
    the hands, unless it is a via-point of the task.
    """
    after = adapted(skill, via_points, tolerance=skill.tolerance)
    effect = effect_of(skill, after, at)
    if effect.gain > MAX_GAIN and at.name not in skill.model.names:
        raise SkillError(
            f"a correction of {100 * effect.moved_m:.0f} cm so near to what was shown or taught "
            f"would move the tool {effect.gain:.1f} times as far as the hands; {MAX_GAIN:g} times "
            "accepted. Correct it in smaller steps, or demonstrate this"
        )
    return after, effect


def effect_of(before: Skill, after: Skill, at: ViaPoint) -> Effect:
    """The difference that one skill makes to another around a correction.

    It is examined with one coordinate of one hand moved at a time, both ways, up to MAX_REACH_M;
    `reach_m` is the smallest one of these directions.
    """
    sides = (0, 1) if after.conductor is None else (after.conductor,)
    axes = np.concatenate(
        [sign * np.eye(6)[3 * side : 3 * side + 3] for side in sides for sign in (1.0, -1.0)]
    )
    steps = np.arange(0.0, MAX_REACH_M + 0.5 * REACH_STEP_M, REACH_STEP_M)
    hands = (_hands(at) + steps[:, None] * axes[:, None]).reshape(-1, 6)
    names = [rest_of(at, after.model.names)] * len(hands)
    change = (after.mean(hands, names) - before.mean(hands, names)).reshape(
        len(axes), len(steps), 3
    )
    size_m = np.linalg.norm(change, axis=2)
    moved_m = float(size_m[0, 0])
    is_less = size_m < 0.5 * moved_m
    reach_m = np.where(is_less.any(axis=1), steps[is_less.argmax(axis=1)], MAX_REACH_M)
    gain = np.linalg.norm(np.diff(change, axis=1), axis=2).max() / REACH_STEP_M
    return Effect(moved_m, float(reach_m.min()), float(gain))


def _end_of(skill: Skill, hands: Vector, segment: int) -> str:
    """The via-point at an end of a segment at which hands (6,) are; empty if at neither."""
    ends = {
        skill.model.names[k]: _apart_m(skill, hands, skill.model.hands[k])
        for k in (segment, segment + 1)
    }
    name = min(ends, key=lambda name: ends[name])
    return name if ends[name] < PATH_END_M else ""


def _apart_m(skill: Skill, hands: Vector, others: Vector) -> float:
    """The distance [m] between two pairs of hands (6,): that of the hand that is farther off."""
    difference = skill.conducting(hands) - skill.conducting(others)
    return float(np.linalg.norm(difference.reshape(2, 3), axis=1).max())


def _hands(point: ViaPoint) -> Vector:
    return np.array([*point.left, *point.right])


def _point(values: Vector) -> tuple[float, float, float]:
    x, y, z = (round(value, 6) for value in values.tolist())
    return x, y, z
