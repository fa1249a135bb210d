"""Stage 2, skill: from the motion of two hands to where the tool should be, and how sure it is."""

from __future__ import annotations

from service.contract.records import Field

ORDER = 4  # filters of a hand's memory in a row: the last one tells of where it was 2 s ago, blurred by 1 s
TURNS = 3  # filters in a row that smooth how a hand is turned: its angular acceleration is then continuous

STATE = (
    Field("covariance", "float64", (3, 3)),  # of the prediction at the newest hand sample; zeros: none
    Field("orientation_covariance", "float64", (3, 3)),
    Field("closure", "float64"),
    Field("unsure", "uint8"),  # 1: the 95 % region reaches too far
    Field("trail", "float64", (3,)),  # where the predictions were lately [m]
    Field("trail_tick", "int64"),  # at which that was followed last
    Field("sure_tick", "int64"),  # the last one at which it was known which stage of the task it is
    Field("skill", "uint8", (16,)),  # digest of the skill in force, which is recorded apart
    Field("memory", "float64", (ORDER, 2, 3)),  # of where the left and the right hand were [m]
    Field("memory_ticks", "int64", (2,)),  # at which each hand entered it last; -1: not yet
    Field("stage_belief", "float64", (64,)),  # how probable each stage of the task is; zeros: not yet known
    Field("turns", "float64", (TURNS, 2, 9)),  # of the hands, rotation matrices that were smoothed
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
    Field("stage", "int64"),  # of the task, the most probable one; -1: not yet known, or it has none
    Field("stage_belief", "float64"),  # how probable that is
)
