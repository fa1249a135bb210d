"""What a sample of the arm's joints is compared with: what an arm can have, and what this had.

Tolerances are in rad; for a prismatic joint they are multiplied by `per_rad`, which gives metres.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.config import JointSettings, Settings
from service.core.frame import Records, Vector
from service.core.intake.tuning import ARM_STILL_S, MAX_JOINT_RADPS

TURN = 2.0 * math.pi


def in_turn(joints: JointSettings, position: Vector, near: Vector) -> Vector:
    """Joints (..., J) [rad], the continuous ones in the turn nearest to other joints (..., J)."""
    is_continuous = np.array(joints.every_kind) == "continuous"
    return position + np.where(is_continuous, TURN * np.rint((near - position) / TURN), 0.0)


def still_ticks(settings: Settings) -> int:
    """The ticks over which an arm must report one posture before it is believed."""
    return math.ceil(round(ARM_STILL_S / settings.period_s, 6))


@compiled
def compared(states: Records, parameters: Records, position: Vector, velocity: Vector) -> tuple[bool, float, float]:
    """Whether joints can be so [rad, rad/s]; how far one is off the newest sample, and off the
    posture that was constant, both by `per_rad` [rad].
    """
    state, given, near, off, moved = states[0], parameters[0], True, 0.0, 0.0
    for i in range(len(position)):
        near = near and given.plausible_joints[0, i] <= position[i] <= given.plausible_joints[1, i]
        near = near and abs(velocity[i]) <= MAX_JOINT_RADPS * given.per_rad[i]
        off = max(off, abs(position[i] - state.measured[i]) / given.per_rad[i])
        moved = max(moved, abs(position[i] - state.arm_still_posture[i]) / given.per_rad[i])
    return near, off, moved


@compiled
def unwrap(states: Records, parameters: Records, position: Vector) -> None:
    """Brings continuous joints (J,) [rad] to the turn nearest to where they were measured last, in
    place: a state that wraps at ±pi then goes on as one that counts turns.
    """
    for i in range(len(position)):
        if parameters[0].is_continuous[i] and math.isfinite(position[i]):
            position[i] += TURN * np.rint((states[0].measured[i] - position[i]) / TURN)
