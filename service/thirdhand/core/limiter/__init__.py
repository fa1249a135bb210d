"""Stage 7, limiter: joint commands within all limits, for any wanted velocities."""

from __future__ import annotations

from thirdhand.contract.records import PER_JOINT, Field

# commanded position, velocity, acceleration; by joint
STATE = (Field("joints", "float64", (3, PER_JOINT)),)
FRAME = (
    Field("tool", "float64", (3,)),  # position of the tool at the commanded joints [m]
    Field("tool_orientation", "float64", (4,)),  # orientation of the tool at the commanded joints
    Field("joints", "float64", (PER_JOINT,)),  # commanded position [rad]
    Field("joint_velocities", "float64", (PER_JOINT,)),  # commanded velocity [rad/s]
    Field("joint_accelerations", "float64", (PER_JOINT,)),  # commanded acceleration [rad/s²]
    Field("flags", "uint8"),
    Field("commanded", "uint8"),  # 0: the command is not sent to the arm
)
