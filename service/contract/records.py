"""Records of fixed layout: what a tick decided (Frame), what the core remembers (State), how long
it took (Timing).

Their bytes are, behind the four-byte header, the CDR encoding of a ROS 2 message of the same
fields: these are ordered by size, so that no padding is needed. The enumerations say what the
numbers in them mean.
"""

from __future__ import annotations

import enum
import math
from typing import NamedTuple, TypeAlias

SIDES = ("left", "right")
SOURCES = (*SIDES, "arm")
STAGES = ("intake", "skill", "setpoint", "arm", "limiter")


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


class Flag(enum.IntFlag):
    """What limits it while it follows."""

    TARGET_CLAMPED = 1
    SPEED_LIMITED = 2
    NEAR_JOINT_LIMIT = 4
    SEPARATION = 8  # a hand, the table, a thing or the arm itself is near


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

FRAME = (
    Field("tick", "int64"),
    Field("hand_stamp_ns", "int64"),  # of the newest sample in it; 0: none yet
    Field("hands", "float64", (2, 3)),  # left and right, filtered, at this tick [m]
    Field("hand_velocities", "float64", (2, 3)),
    Field("target", "float64", (3,)),  # what the skill predicts, clamped [m]
    Field("target_velocity", "float64", (3,)),
    Field("target_acceleration", "float64", (3,)),
    Field("covariance", "float64", (3, 3)),  # of the prediction [m²]
    Field("deviation", "float64"),  # its standard deviation, root mean square over the axes [m]
    Field("setpoint", "float64", (3,)),  # after smoothing [m]
    Field("setpoint_velocity", "float64", (3,)),
    Field("setpoint_acceleration", "float64", (3,)),
    Field("tool", "float64", (3,)),  # where the commanded joints put the tool [m]
    Field("orientation", "float64", (4,)),  # of the target, quaternion x y z w
    Field("turning", "float64", (3,)),  # its angular velocity [rad/s]
    Field("orientation_covariance", "float64", (3, 3)),  # of small rotations [rad²]; 0 where it was not learned
    Field("setpoint_orientation", "float64", (4,)),  # after smoothing
    Field("setpoint_turning", "float64", (3,)),
    Field("tool_orientation", "float64", (4,)),  # how the commanded joints turn the tool
    Field("closure", "float64"),  # of the gripper as predicted, 0 to 1; -1: the skill has none
    Field("joints", "float64", (PER_JOINT,)),  # the command [rad]
    Field("joint_velocities", "float64", (PER_JOINT,)),
    Field("joint_accelerations", "float64", (PER_JOINT,)),
    Field("hand_distance", "float64"),  # from the nearest hand to the arm, before this tick's motion; 3 at most [m]
    Field("hand_limit", "float64"),  # least speed toward a hand that is allowed at some part of the arm [m/s]
    Field("hand_ages", "int32", (2,)),  # ticks since the newest sample; -1: none yet
    Field("rejected", "uint32", (len(Cause),)),
    Field("mode", "uint8"),
    Field("reason", "uint8"),
    Field("flags", "uint8"),
    Field("gripper", "uint8"),  # 0: nothing is known of it; 1: open; 2: closed
    Field("commanded", "uint8"),  # 0: the joints are not to be sent
)
STATE = (
    Field("tick", "int64"),
    Field("hand_stamps_ns", "int64", (2,)),
    Field("hand_ticks", "int64", (2,)),  # tick of the newest sample; -1: none yet
    Field("arm_stamp_ns", "int64"),
    Field("arm_tick", "int64"),
    Field("hull_ticks", "int64"),  # in the newest span
    Field("slow_tick", "int64"),  # the last one at which the tool was not too fast
    Field("gripper_tick", "int64"),  # at which the gripper was told to move
    Field("rest_tick", "int64"),  # since which the arm tells one posture, `rest`, and nothing else
    Field("told_ticks", "int64", (len(SOURCES), 2)),  # the last two at which a sample could have been right
    # of samples of a hand that jumped, in a row: first and newest tick, count, whether it was where
    # the other hand had been
    Field("doubts", "int64", (2, 4)),
    Field("hands", "float64", (2, 3, 3)),  # estimated position, velocity, acceleration; by axis
    Field("paces", "float64", (2, 3)),  # their velocities without tremor; see `core.rest`
    Field("repose", "float64", (2,)),  # how much each hand rests
    Field("means", "float64", (2, 3, 3, 3)),  # of each hand's three modes; see `core.hand_estimator`
    Field("covariances", "float64", (2, 3, 3, 3)),
    Field("modes", "float64", (2, 3)),
    Field("noise", "float64", (2, 4)),
    Field("past", "float64", (2, 3, 3)),
    Field("doubted", "float64", (2, 3)),  # where the newest of those was
    Field("contested", "float64", (len(SOURCES),)),  # the share of the last second's samples that contradict the others
    Field("rest", "float64", (PER_JOINT,)),
    Field("measured", "float64", (PER_JOINT,)),
    Field("measured_velocities", "float64", (PER_JOINT,)),
    Field("setpoint", "float64", (3, 3)),  # position, velocity, acceleration; by axis
    Field("hull", "float64", (7, 2, 3)),  # least and greatest target of the last spans of time
    Field("joints", "float64", (3, PER_JOINT)),  # position, velocity, acceleration; by joint
    Field("covariance", "float64", (3, 3)),  # of the prediction at the newest hand sample; zeros: none
    Field("orientation", "float64", (4,)),  # of the setpoint
    Field("turning", "float64", (3,)),
    Field("orientation_covariance", "float64", (3, 3)),  # of the prediction at the newest hand sample
    Field("closure", "float64"),
    Field("rejected", "uint32", (len(Cause),)),
    Field("mode", "uint8"),
    Field("reason", "uint8"),
    Field("gripper", "uint8"),
    Field("operator_hold", "uint8"),
    Field("arm_ready", "uint8"),  # 1: yes; 2: on its way into its limits
    Field("skill", "uint8", (16,)),  # digest of the skill in force, which is recorded apart
)
TIMING = (
    Field("tick", "int64"),
    Field("time_ns", "int64"),  # the tick's deadline on the wall clock
    Field("missed", "int64"),  # deadlines skipped since start
    Field("lateness_us", "float32"),
    Field("work_us", "float32"),
    Field("latency_us", "float32"),  # newest hand's stamp to command published; 0: no new sample
    Field("stages_us", "float32", (len(STAGES),)),
)


def definition(layout: Layout, joints: int) -> str:
    """The ROS 2 message definition of a layout for an arm with so many joints."""
    lines = []
    for field in layout:
        size = f"[{math.prod(field.shape_for(joints))}]" if field.shape else ""
        lines.append(f"{field.type}{size} {field.name}\n")
    return "".join(lines)
