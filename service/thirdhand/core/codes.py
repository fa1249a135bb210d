"""Codes that the stages exchange."""

from __future__ import annotations

import enum

from thirdhand.contract.records import Cause, Mode, Reason


class Condition(enum.IntFlag):
    """Conditions of hands, arm and task that hold at a tick."""

    HANDS_KNOWN = 1  # both hands have been seen, at least one of them just now
    ARM_HEARD = 2  # the arm has reported its joints recently
    ARM_STILL = 4  # the arm has reported the same posture for a while
    CONTESTED = 8  # two sources report the arm
    LEFT_UNSEEN = 16  # the left hand is out of sight for a moment; the right hand is seen
    RIGHT_UNSEEN = 32  # the right hand is out of sight for a moment; the left hand is seen
    ARM_INSIDE = 64  # a part of the arm is inside of a thing, or of another part
    ONE_HAND = 128  # the leading hand is seen; the second hand was never seen, or has disappeared
    SEGMENT_AMBIGUOUS = 256  # the segment of the task is not known
    UNSEEN_HAND_NEEDED = 512  # the target depends on a hand that is out of sight
    CLUTCH_RELEASED = 1024  # a clutch is configured, and is not pressed
    ARM_GUIDED = 2048  # the arm's driver reports that the arm is led by hand
    WISH_LEADS = 4096  # the tool follows wishes, so the rules for hands do not apply
    WISH_UNKNOWN = 8192  # no wish has come yet
    WISH_SILENT = 16384  # no wish is due, and none came lately
    WISH_JUMPED = 32768  # a wish was far from the path a moment ago
    WISH_OUTSIDE = 65536  # the wished pose is out of the arm's reach


class LedBy(enum.IntFlag):
    """What leads the tool where wishes may."""

    SKILL = 1
    WISHES = 2


class Start(enum.IntEnum):
    """Posture at which the arm's motion starts."""

    ASSUMED = 1  # the configured posture
    MEASURED = 2  # the posture that the arm has just reported


class ArmReady(enum.IntEnum):
    """Readiness of the arm to follow."""

    READY = 1  # the arm is within its limits, and inside of nothing
    RETURNING = 2  # the arm moves back into its limits, or out of a thing


class Stuck(enum.IntEnum):
    """State of a tool that does not approach its target."""

    NOTICED = 1  # the arm still follows
    HELD = 2  # the arm holds, or moves along a way out


class Held(enum.IntEnum):
    """Knowledge of the hands at the begin of an operator's hold."""

    UNSEEN = 1  # a hand that the skill needs was not seen
    SEEN = 2


class SetpointStep(enum.IntEnum):
    """Limitation of a step of the setpoint."""

    PLANNED = 1  # the tracker's jerk was reduced to keep a bound
    STOPPED = 2  # the setpoint began its stop
    BROKEN = 3  # a bound was broken; the setpoint did not move


class SetpointBound(enum.IntEnum):
    """Bound that a step of the setpoint has broken."""

    NONE = 0
    NOT_FINITE = 1
    SPEED = 2
    ACCELERATION = 3
    JERK = 4
    POSITION = 5


class ClockTrust(enum.IntEnum):
    """Trust in a tracker's clock."""

    LEARNING = 0  # its first window is not over
    DOUBTED = 1  # the minimum delays of the last two windows differ
    TRUSTED = 2  # they agree


# The same codes as plain integers: compiled functions need them, and in Python each access to a
# member of an enumeration takes a microsecond.
(
    HANDS_KNOWN,
    ARM_HEARD,
    ARM_STILL,
    CONTESTED,
    LEFT_UNSEEN,
    RIGHT_UNSEEN,
    ARM_INSIDE,
    ONE_HAND,
    SEGMENT_AMBIGUOUS,
    UNSEEN_HAND_NEEDED,
    CLUTCH_RELEASED,
    ARM_GUIDED,
    WISH_LEADS,
    WISH_UNKNOWN,
    WISH_SILENT,
    WISH_JUMPED,
    WISH_OUTSIDE,
) = map(int, Condition)
UNSEEN = (LEFT_UNSEEN, RIGHT_UNSEEN)
EITHER_UNSEEN = LEFT_UNSEEN | RIGHT_UNSEEN
BY_SKILL, BY_WISHES = map(int, LedBy)
STARTS_ASSUMED, STARTS_MEASURED = map(int, Start)
READY, RETURNING = map(int, ArmReady)
NOTICED, HELD = map(int, Stuck)
HELD_UNSEEN, HELD_SEEN = map(int, Held)
PLANNED, STOPPED, BROKEN = map(int, SetpointStep)
(
    NO_BOUND,
    NOT_FINITE_BOUND,
    SPEED_BOUND,
    ACCELERATION_BOUND,
    JERK_BOUND,
    POSITION_BOUND,
) = map(int, SetpointBound)
LEARNING, DOUBTED, TRUSTED = map(int, ClockTrust)
HOLD = int(Mode.HOLD)
FOLLOW = int(Mode.FOLLOW)
FAULT = int(Mode.FAULT)
NONE = int(Reason.NONE)
NO_HANDS = int(Reason.NO_HANDS)
STALE_HAND = int(Reason.STALE_HAND)
FAR = int(Reason.FAR_FROM_DEMONSTRATIONS)
TWO_SOURCES = int(Reason.TWO_SOURCES)
OPERATOR = int(Reason.OPERATOR)
NOT_READY = int(Reason.ARM_NOT_READY)
BLOCKED = int(Reason.BLOCKED)
AMBIGUOUS = int(Reason.AMBIGUOUS)
TOOL_SPEED = int(Reason.TOOL_SPEED)
CLUTCH = int(Reason.CLUTCH)
ARM_ERROR = int(Reason.ARM_ERROR)
ARM_SILENT = int(Reason.ARM_SILENT)
GUIDED = int(Reason.GUIDED)
NO_WISH = int(Reason.NO_WISH)
STALE_WISH = int(Reason.STALE_WISH)
JUMPED_WISH = int(Reason.JUMPED_WISH)
UNREACHABLE_WISH = int(Reason.UNREACHABLE_WISH)
NOT_FINITE = int(Cause.NOT_FINITE)
NOT_A_ROTATION = int(Cause.NOT_A_ROTATION)
OUT_OF_RANGE = int(Cause.OUT_OF_RANGE)
REPEATED = int(Cause.REPEATED)
OLDER = int(Cause.OLDER)
AHEAD = int(Cause.AHEAD)
JUMPED = int(Cause.JUMPED)
