"""Stage 7, limiter: joint commands that hold every limit, whatever is asked for."""

from __future__ import annotations

from service.contract.records import PER_JOINT, Field

STATE = (Field("joints", "float64", (3, PER_JOINT)),)  # position, velocity, acceleration; by joint
FRAME = (
    Field("tool", "float64", (3,)),  # where the command puts the tool [m]
    Field("tool_orientation", "float64", (4,)),  # how it turns the tool
    Field("joints", "float64", (PER_JOINT,)),  # the command [rad]
    Field("joint_velocities", "float64", (PER_JOINT,)),
    Field("joint_accelerations", "float64", (PER_JOINT,)),
    Field("flags", "uint8"),
    Field("commanded", "uint8"),  # 0: the joints are not to be sent
)
