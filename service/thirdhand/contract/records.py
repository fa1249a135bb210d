"""Records of fixed layout, and the enumerations of the codes in them.

After a header of four bytes, the bytes of a layout are the CDR encoding of a ROS 2 message with the
same fields. `assembled` orders the fields by size, so that no padding is needed.
"""

from __future__ import annotations

import enum
import math
from typing import NamedTuple, TypeAlias

SIDES = ("left", "right")
# a hand that the skill does not need has disappeared after this time; occlusions are shorter
GONE_S = 5.0
# a wish may be due a second after it arrives; clocks differ by less than the rest
FARTHEST_WISH_S = 1.05
SOURCES = (*SIDES, "arm", "wish")


class Mode(enum.IntEnum):
    """Mode of the controller."""

    HOLD = 0
    FOLLOW = 1
    FAULT = 2


class Reason(enum.IntEnum):
    """Reason of a hold or a fault."""

    NONE = 0
    NO_HANDS = 1
    STALE_HAND = 2
    FAR_FROM_DEMONSTRATIONS = 3
    OPERATOR = 4
    ARM_NOT_READY = 5
    ARM_ERROR = 6
    ARM_SILENT = 7
    TOOL_SPEED = 8
    SETPOINT = 9
    TWO_SOURCES = 10
    SERVICE = 11
    BLOCKED = 12
    AMBIGUOUS = 13
    CLUTCH = 14
    GUIDED = 15
    NO_WISH = 16
    STALE_WISH = 17
    JUMPED_WISH = 18
    UNREACHABLE_WISH = 19


class Flag(enum.IntFlag):
    """Limit that is active while the arm follows."""

    TARGET_CLAMPED = 1
    SPEED_LIMITED = 2
    NEAR_JOINT_LIMIT = 4
    SEPARATION = 8
    STUCK = 16
    UNSURE = 32
    ENGAGING = 64


class Cause(enum.IntEnum):
    """Cause of a rejected sample."""

    NOT_FINITE = 0
    NOT_A_ROTATION = 1
    OUT_OF_RANGE = 2
    REPEATED = 3
    OLDER = 4
    INCOMPLETE = 5
    AHEAD = 6
    JUMPED = 7
    WRONG_FRAME = 8


PER_JOINT = 0  # in a shape, stands for the number of joints


class Field(NamedTuple):
    """A field: name, ROS 2 type of its numbers, shape."""

    name: str
    type: str
    shape: tuple[int, ...] = ()

    def shape_for(self, joints: int) -> tuple[int, ...]:
        """The shape for an arm with this number of joints."""
        return tuple(size or joints for size in self.shape)


Layout: TypeAlias = tuple[Field, ...]
_SIZES = {"int64": 8, "float64": 8, "int32": 4, "uint32": 4, "float32": 4, "uint8": 1}  # [bytes]


def assembled(*parts: Layout) -> Layout:
    """The fields of several layouts as one, larger types first, otherwise in their order."""
    return tuple(
        sorted((field for part in parts for field in part), key=lambda field: -_SIZES[field.type])
    )


def definition(layout: Layout, joints: int) -> str:
    """The ROS 2 message definition of a layout for an arm with this number of joints."""
    lines = []
    for field in layout:
        size = f"[{math.prod(field.shape_for(joints))}]" if field.shape else ""
        lines.append(f"{field.type}{size} {field.name}\n")
    return "".join(lines)
