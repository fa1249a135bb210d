"""Records of fixed layout, and the enumerations that say what the numbers in them mean.

A layout's bytes are, behind the four-byte header, the CDR encoding of a ROS 2 message of the same
fields: `assembled` orders these by size, so that no padding is needed.
"""

from __future__ import annotations

import enum
import math
from typing import NamedTuple, TypeAlias

SIDES = ("left", "right")
GONE_S = 5.0  # a hand that a skill does without is waited for so long: what hides it in passing is gone sooner
SOURCES = (*SIDES, "arm")


class Mode(enum.IntEnum):
    """What the controller does."""

    HOLD = 0
    FOLLOW = 1
    FAULT = 2


class Reason(enum.IntEnum):
    """Why it holds or is at fault."""

    NONE = 0
    NO_HANDS = 1
    STALE_HAND = 2
    FAR_FROM_DEMONSTRATIONS = 3
    OPERATOR = 4
    ARM_NOT_READY = 5
    ARM_ERROR = 6
    ARM_SILENT = 7
    TOOL_SPEED = 8  # measured, or commanded in spite of all bounds
    SETPOINT = 9  # passed a bound of its own, which cannot be
    TWO_SOURCES = 10  # of one hand or of the arm, which contradict each other
    SERVICE = 11  # a part of the service failed; the log says which
    BLOCKED = 12  # joints at their ends or things around keep the tool from its target: it leaves, or waits
    AMBIGUOUS = 13  # which stage of the task it is: the tool should be in one place or in another


class Flag(enum.IntFlag):
    """What limits it while it follows."""

    TARGET_CLAMPED = 1
    SPEED_LIMITED = 2
    NEAR_JOINT_LIMIT = 4
    SEPARATION = 8  # a hand, the table, a thing or the arm itself is near
    STUCK = 16  # the tool comes no nearer to its target; a way out is looked for
    UNSURE = 32  # the tool may belong elsewhere by more than 10 cm


class Cause(enum.IntEnum):
    """Why a sample was rejected."""

    NOT_FINITE = 0
    NOT_A_ROTATION = 1
    OUT_OF_RANGE = 2
    REPEATED = 3
    OLDER = 4
    INCOMPLETE = 5
    AHEAD = 6  # stamped later than the time that has passed explains
    JUMPED = 7  # not where it can have come to, and not yet confirmed
    WRONG_FRAME = 8
    SWAPPED = 9  # where the other hand was, while that is said to be where this one was


PER_JOINT = 0  # in a shape: one for each joint of the arm


class Field(NamedTuple):
    """One field: name, ROS 2 type of its numbers, shape."""

    name: str
    type: str
    shape: tuple[int, ...] = ()

    def shape_for(self, joints: int) -> tuple[int, ...]:
        """The shape for an arm with so many joints."""
        return tuple(size or joints for size in self.shape)


Layout: TypeAlias = tuple[Field, ...]
_SIZES = {"int64": 8, "float64": 8, "int32": 4, "uint32": 4, "float32": 4, "uint8": 1}  # [bytes]


def assembled(*parts: Layout) -> Layout:
    """The fields of some layouts as one: the larger types first, else in their order."""
    return tuple(sorted((field for part in parts for field in part), key=lambda field: -_SIZES[field.type]))


def definition(layout: Layout, joints: int) -> str:
    """The ROS 2 message definition of a layout for an arm with so many joints."""
    lines = []
    for field in layout:
        size = f"[{math.prod(field.shape_for(joints))}]" if field.shape else ""
        lines.append(f"{field.type}{size} {field.name}\n")
    return "".join(lines)
