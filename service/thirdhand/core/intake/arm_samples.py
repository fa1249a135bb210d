"""Plausibility of the arm's joint samples: within the joints' range, near the newest sample, and
near the posture of an arm at rest.

Tolerances are in rad. For a prismatic joint they are multiplied by `per_rad` [m/rad].
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.frame import Struct, Vector
from thirdhand.settings.config import JointSettings

TURN = 2.0 * math.pi


def in_turn(joints: JointSettings, position: Vector, near: Vector) -> Vector:
    """Joint positions (..., J) [rad], those of continuous joints shifted by whole turns to be the
    nearest to the positions `near` (..., J).
    """
    is_continuous = np.array(joints.every_kind) == "continuous"
    return position + np.where(is_continuous, TURN * np.rint((near - position) / TURN), 0.0)


@compiled
def compared(
    state: Struct, config: Struct, position: Vector, velocity: Vector
) -> tuple[bool, float, float]:
    """Plausibility of joint positions and velocities (J,) [rad, rad/s], and their differences from
    earlier samples.

    Returns: true if every joint is within `plausible_joints` and not faster than max_joint_radps;
    the largest difference from the newest sample [rad]; and from `arm_still_posture` [rad].
    Differences are divided by `per_rad`.
    """
    low, high = config.plausible_joints
    plausible = True
    deviation = 0.0
    moved = 0.0
    for i in range(len(position)):
        is_slow = abs(velocity[i]) <= config.max_joint_radps * config.per_rad[i]
        plausible = plausible and is_slow and low[i] <= position[i] <= high[i]
        deviation = max(deviation, abs(position[i] - state.measured[i]) / config.per_rad[i])
        moved = max(moved, abs(position[i] - state.arm_still_posture[i]) / config.per_rad[i])
    return plausible, deviation, moved


@compiled
def unwrap(state: Struct, config: Struct, position: Vector) -> None:
    """Shift continuous joints (J,) [rad] by whole turns to be nearest to the newest sample, in
    place. A driver that wraps at ±π and one that counts turns then give the same positions.
    """
    for i in range(len(position)):
        if config.is_continuous[i] and math.isfinite(position[i]):
            position[i] += TURN * np.rint((state.measured[i] - position[i]) / TURN)
