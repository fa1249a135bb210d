"""Stage 5, setpoint: from the target to one that the arm can follow and that can always stop."""

from __future__ import annotations

from service.contract.records import Field

HULL_SPANS = 7  # of time, of which one is always being filled
STATE = (
    Field("hull_ticks", "int64"),  # in the newest span
    Field("gripper_tick", "int64"),  # at which the gripper was last moved
    Field("setpoint", "float64", (3, 3)),  # position, velocity, acceleration; by axis
    Field("hull", "float64", (HULL_SPANS, 2, 3)),  # least and greatest target of the last spans of time
    Field("orientation", "float64", (4,)),  # of the setpoint
    Field("turning", "float64", (3,)),  # its angular velocity [rad/s]
    Field("gripper", "uint8"),
)
FRAME = (
    Field("setpoint", "float64", (3,)),  # after smoothing [m]
    Field("setpoint_velocity", "float64", (3,)),
    Field("setpoint_acceleration", "float64", (3,)),
    Field("setpoint_orientation", "float64", (4,)),
    Field("setpoint_turning", "float64", (3,)),
    Field("gripper", "uint8"),  # 0: unknown; 1: open; 2: closed
)
