"""Stage 3, decision: determine the mode of this tick and the reason for it."""

from __future__ import annotations

from thirdhand.contract.records import PER_JOINT, Field

WAY = 24  # largest number of postures of a way out
STATE = (
    Field("slow_tick", "int64"),  # the last tick at which the tool was below its fault speed
    Field("followed_tick", "int64"),  # the last tick at which the arm followed
    # Tick from which a duration counts: the last progress of a tool that follows; the begin of a
    # way out; the last motion of joints that return out of a thing.
    Field("stuck_tick", "int64"),
    Field("way_next", "int64"),  # index of the posture of the way out to which the arm moves
    Field("way_count", "int64"),  # number of postures of the way out; 0: there is none
    Field("guided_tick", "int64"),  # the last tick at which the arm was led by hand
    # The begin of the operator's hold that lasts, in which a correction may be made:
    Field("held_tick", "int64"),
    Field("held_segment", "int64"),  # the most probable segment of the task; -1: not known
    Field("held_hands", "float64", (2, 3)),  # positions of the hands [m]
    Field("stuck_gap", "float64"),  # distance between tool and target at `stuck_tick` [m]
    Field("stuck_target", "float64", (3,)),  # target at `stuck_tick` [m]
    Field("stuck_hands", "float64", (2, 3)),  # hands at `stuck_tick` [m]
    # postures of the way out [rad]; the last one has the tool at its target
    Field("way", "float64", (WAY, PER_JOINT)),
    Field("mode", "uint8"),  # `contract.records.Mode`
    Field("reason", "uint8"),  # `contract.records.Reason`
    Field("operator_hold", "uint8"),  # 1: the operator holds the arm
    Field("held", "uint8"),  # `codes.Held`; 0: the operator does not hold the arm
    Field("arm_ready", "uint8"),  # `codes.ArmReady`; 0: the arm is not ready
    Field("stuck", "uint8"),  # `codes.Stuck`; 0: the tool comes nearer to its target
    Field("way_tried", "uint8"),  # 1: a way out has been taken since the tool was at a target
    # 1: the operator has confirmed that the arm may leave the thing that it is inside of
    Field("leaves", "uint8"),
)
FRAME = (
    Field("mode", "uint8"),
    Field("reason", "uint8"),
)
