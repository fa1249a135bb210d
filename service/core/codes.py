"""Codes that the stages exchange."""

from __future__ import annotations

import enum

from service.contract.records import Mode, Reason


class Known(enum.IntFlag):
    """What is known at a tick of hands and arm."""

    HANDS = 1  # both hands are seen
    ARM_HEARD = 2  # the arm has reported its joints lately enough
    ARM_STILL = 4  # the arm has reported one posture for a while
    CONTESTED = 8  # two sources report a hand or the arm
    LEFT_UNSEEN = 16  # the left hand was seen a moment ago; the right one is seen
    RIGHT_UNSEEN = 32  # the right hand was seen a moment ago; the left one is seen
    ARM_INSIDE = 64  # a part of the arm is inside of a thing, or of another part
    ONE_HAND = 128  # the leading hand is seen, and the other one has never been, or has disappeared
    STAGE_AMBIGUOUS = 256  # the stage of the task is not known
    UNSEEN_HAND_NEEDED = 512  # the target depends on the hand that is not seen


class Start(enum.IntEnum):
    """Where the arm's motion starts, as the decision says."""

    ASSUMED = 1  # at the configured posture
    MEASURED = 2  # where the arm has just reported its joints


class ArmReady(enum.IntEnum):
    """Whether the arm may follow."""

    READY = 1  # it is within its limits, and inside of nothing
    RETURNING = 2  # it is on its way to that


class Stuck(enum.IntEnum):
    """A tool that comes no nearer to its target."""

    NOTICED = 1  # it still follows
    HELD = 2  # it holds, or follows a way out


class SetpointStep(enum.IntEnum):
    """What limited a step of the setpoint."""

    PLANNED = 1  # a bound was met in planning
    STOPPED = 2  # the stop began
    WRONG = 3  # a bound was broken


# The same as plain integers: compiled functions need them, and in Python an enumeration's members
# cost a microsecond each.
HANDS_KNOWN, ARM_HEARD, ARM_STILL = int(Known.HANDS), int(Known.ARM_HEARD), int(Known.ARM_STILL)
CONTESTED, UNSEEN = int(Known.CONTESTED), (int(Known.LEFT_UNSEEN), int(Known.RIGHT_UNSEEN))
ARM_INSIDE, ONE_HAND = int(Known.ARM_INSIDE), int(Known.ONE_HAND)
STAGE_AMBIGUOUS, UNSEEN_HAND_NEEDED = int(Known.STAGE_AMBIGUOUS), int(Known.UNSEEN_HAND_NEEDED)
STARTS_ASSUMED, STARTS_MEASURED = int(Start.ASSUMED), int(Start.MEASURED)
READY, RETURNING = int(ArmReady.READY), int(ArmReady.RETURNING)
NOTICED, HELD = int(Stuck.NOTICED), int(Stuck.HELD)
PLANNED, STOPPED, WRONG = int(SetpointStep.PLANNED), int(SetpointStep.STOPPED), int(SetpointStep.WRONG)
HOLD, FOLLOW, FAULT = int(Mode.HOLD), int(Mode.FOLLOW), int(Mode.FAULT)
NONE, NO_HANDS, STALE_HAND = int(Reason.NONE), int(Reason.NO_HANDS), int(Reason.STALE_HAND)
FAR, TWO_SOURCES = int(Reason.FAR_FROM_DEMONSTRATIONS), int(Reason.TWO_SOURCES)
OPERATOR, NOT_READY, BLOCKED = int(Reason.OPERATOR), int(Reason.ARM_NOT_READY), int(Reason.BLOCKED)
AMBIGUOUS, TOOL_SPEED = int(Reason.AMBIGUOUS), int(Reason.TOOL_SPEED)
ARM_ERROR, ARM_SILENT = int(Reason.ARM_ERROR), int(Reason.ARM_SILENT)
