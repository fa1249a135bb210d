"""Stage 2, skill: from the motion of two hands to where the tool should be, and how sure it is."""

from __future__ import annotations

from service.contract.records import Field

ORDER = 4  # filters of a hand's memory in a row: the last one tells of where it was 2 s ago, blurred by 1 s

STATE = (
    Field("covariance", "float64", (3, 3)),  # of the prediction at the newest hand sample; zeros: none
    Field("orientation_covariance", "float64", (3, 3)),
    Field("closure", "float64"),
    Field("skill", "uint8", (16,)),  # digest of the skill in force, which is recorded apart
    Field("memory", "float64", (ORDER, 2, 3)),  # of where the left and the right hand were [m]
    Field("memory_ticks", "int64", (2,)),  # at which each hand entered it last; -1: not yet
)
FRAME = (
    Field("target", "float64", (3,)),  # what the skill predicts, clamped [m]
    Field("target_velocity", "float64", (3,)),
    Field("target_acceleration", "float64", (3,)),
    Field("covariance", "float64", (3, 3)),  # of the prediction [m²]
    Field("gate_m", "float64"),  # what is compared with the skill's threshold [m]
    Field("orientation", "float64", (4,)),  # of the target, quaternion x y z w
    Field("turning", "float64", (3,)),  # its angular velocity [rad/s]
    Field("orientation_covariance", "float64", (3, 3)),  # of small rotations [rad²]; 0 where it was not learned
    Field("closure", "float64"),  # of the gripper as predicted, 0 to 1; -1: the skill has none
)
