"""Stage 5, setpoint: a smooth motion toward the target that the arm can follow and always stop."""

from __future__ import annotations

from thirdhand.contract.records import Field

# the last targets are kept as bounds of this many spans of time; the newest one grows
HULL_SPANS = 7
STATE = (
    Field("hull_ticks", "int64"),  # number of targets in the newest span
    Field("gripper_tick", "int64"),  # tick of the last change of the gripper
    # position [m], velocity [m/s], acceleration [m/s²]; by axis
    Field("setpoint", "float64", (3, 3)),
    # smallest and largest target [m] of each span, newest first
    Field("hull", "float64", (HULL_SPANS, 2, 3)),
    Field("orientation", "float64", (4,)),  # orientation setpoint, a quaternion x y z w
    Field("turning", "float64", (3,)),  # angular velocity of the orientation setpoint [rad/s]
    Field("gripper", "uint8"),
    # 1: the setpoint has not been at its target since a start or a hold
    Field("engaging", "uint8"),
)
FRAME = (
    Field("setpoint", "float64", (3,)),  # position setpoint [m]
    Field("setpoint_velocity", "float64", (3,)),  # [m/s]
    Field("setpoint_acceleration", "float64", (3,)),  # [m/s²]
    Field("setpoint_orientation", "float64", (4,)),  # quaternion x y z w
    Field("setpoint_turning", "float64", (3,)),  # angular velocity [rad/s]
    Field("gripper", "uint8"),  # 0: unknown; 1: open; 2: closed
)
