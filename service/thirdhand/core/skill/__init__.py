"""Stage 2, skill: predict from the motion of two hands where the tool should be, with its
covariance.
"""

from __future__ import annotations

from thirdhand.contract.records import Field

# cascaded filters of a hand's memory: the last one has its position 2 s ago, blurred by 1 s
ORDER = 4
# cascaded filters of a hand's orientation, so that its angular acceleration is continuous
TURNS = 3
SIGNS = 8  # of an error, beside the covariance; see `support`

MAX_SKILL_DISTANCE_M = 10.0  # largest distance of anything in a skill's file from the base plate
STATE = (
    # of the prediction at the newest hand sample [m²]; zeros: none
    Field("covariance", "float64", (3, 3)),
    # of the prediction at the newest hand sample [rad²]
    Field("orientation_covariance", "float64", (3, 3)),
    Field("closure", "float64"),  # of the gripper, as predicted at the newest hand sample
    Field("known_gate_m", "float64"),  # `gate_m` at the newest hand sample [m]
    Field("signs", "float64"),  # of an error at the newest hand sample, weighted and added
    Field("unsure", "uint8"),  # 1: the tool may be too far from its target
    Field("trail", "float64", (3,)),  # lowpass of the predicted positions [m]
    Field("trail_tick", "int64"),  # tick of the newest prediction in `trail`
    Field("sure_tick", "int64"),  # the last tick at which the segment of the task was unambiguous
    # digest of the skill in force; a recording has the skill itself elsewhere
    Field("skill", "uint8", (16,)),
    # cascaded filters of the left and the right hand's position [m]
    Field("memory", "float64", (ORDER, 2, 3)),
    # tick at which each hand entered `memory` last; -1: not yet
    Field("memory_ticks", "int64", (2,)),
    # probability of each segment of the task; zeros: not yet known
    Field("segment_belief", "float64", (64,)),
    Field("turns", "float64", (TURNS, 2, 9)),  # cascaded filters of the hands' rotation matrices
    # seconds since the hands began task or segment; see `task_clock.count`
    Field("task_clock", "float64", (12,)),
    Field("unprimed_belief", "float64", (64,)),  # belief in each segment if none is the first
)
FRAME = (
    Field("target", "float64", (3,)),  # predicted position, clamped to workspace and reach [m]
    Field("target_velocity", "float64", (3,)),  # [m/s]
    Field("target_acceleration", "float64", (3,)),  # [m/s²]
    Field("covariance", "float64", (3, 3)),  # of the prediction [m²]
    Field("gate_m", "float64"),  # distance that is compared with the skill's threshold [m]
    Field("orientation", "float64", (4,)),  # of the target, quaternion x y z w
    Field("turning", "float64", (3,)),  # angular velocity of the target [rad/s]
    # of small rotations [rad²]; 0 if no orientation was learned
    Field("orientation_covariance", "float64", (3, 3)),
    # predicted closure of the gripper, 0 to 1; -1: the skill has no gripper
    Field("closure", "float64"),
    # the most probable segment of the task; -1: not yet known, or the task has none
    Field("segment", "int64"),
    Field("segment_belief", "float64"),  # probability of that segment
    # probability that the tool is more than 10 cm from where it belongs
    Field("error_probability", "float64"),
)
