"""The joints of the state moved on by one period, or stopped: within their limits, no faster than
the tool may be, and no faster toward anything than separation allows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from kmp.compiled import compiled
from service.config import Settings
from service.core.arm.arm import Arm, Kinematics
from service.core.limiter.limiter import Limited, Limiter
from service.core.record import Record, Records, Vector
from service.core.separation.separation import Separation

NEAR_SPEED = 0.95  # of the tool's greatest; what the joints turn in a tick changes it by less than the rest


class Moved(NamedTuple):
    """What came of a step: where the arm is then; whether a limit kept the joints from what was
    wanted, and whether that was separation; the tool's speed [m/s] where it is too fast, else 0.
    """

    here: Kinematics
    limited: bool
    separated: bool
    too_fast: float


class LimiterStage:
    """Moves the state's joints (3, J): position, velocity, acceleration [rad, rad/s, rad/s²]."""

    def __init__(self, settings: Settings, arm: Arm) -> None:
        self._arm, self._max_speed = arm, settings.tool.max_speed
        self._limiter = Limiter(settings.joints, settings.period_s)
        self._still = np.zeros(len(settings.joints.names))

    def begin(self, state: Record, joints: Vector) -> None:
        """The joints (J,) [rad] at rest where the arm is."""
        state["joints"] = 0.0
        state["joints"][0] = joints

    def is_moving(self, state: Record) -> bool:
        """Whether the commanded joints have not come to rest."""
        return bool(state["joints"][1:].any())

    def step(self, state: Record, wanted: Vector, separation: Separation) -> Moved:
        """Moves the joints on toward wanted velocities (J,) [rad/s].

        They brake where the tool would pass its greatest speed, and one that does all the same is
        too fast; and where they would approach something too fast, unless that brakes less.
        """
        q, dq, ddq = state["joints"]
        moved = self._limiter.step(q, dq, ddq, wanted)
        limited, excess = moved.limited, separation.excess(*moved[1:3])
        separated = excess > 0.0
        if separated:
            stop = self._limiter.stop(q, dq, ddq)
            separated = separation.excess(*stop[1:3]) < excess
            moved, limited = (stop, True) if separated else (moved, limited)
        here, too_fast = self._arm.at(moved.position), 0.0
        if self._comes_to(moved, here) > self._max_speed:
            moved, limited = self._limiter.stop(q, dq, ddq), True
            here = self._arm.at(moved.position)
            speed = self._arm.speeds(here, *moved[1:3])[0]
            too_fast = speed if speed > self._max_speed else 0.0
        state["joints"] = moved[:3]
        return Moved(here, limited, separated, too_fast)

    def stop(self, state: Record, separation: Separation) -> Moved:
        """The joints one period on their way to rest, together; or each as it can, where that
        approaches things less.
        """
        q, dq, ddq = state["joints"]
        moved = self._limiter.stop(q, dq, ddq)
        excess = separation.excess(*moved[1:3])
        if excess > 0.0:
            other = self._limiter.step(q, dq, ddq, self._still)
            moved = other if separation.excess(*other[1:3]) < excess else moved
        state["joints"] = moved[:3]
        return Moved(self._arm.at(moved.position), limited=False, separated=False, too_fast=0.0)

    def _comes_to(self, moved: Limited, here: Kinematics) -> float:
        """The greatest speed [m/s] that the tool comes to if the joints stop after a step; near the
        limit also as the arm will stand then, for what joints do to the tool changes on the way.
        """
        speed = self._arm.speeds(here, *moved[1:3])[1]
        if not NEAR_SPEED * self._max_speed < speed <= self._max_speed:
            return speed
        stop = self._limiter.stop(*moved[:3])
        return max(speed, self._arm.speeds(self._arm.at(stop.position), *stop[1:3])[1])


@compiled
def write_joints(states: Records, frames: Records, flags: int, commanded: int) -> None:
    """Into the frame the command, and whether it is to be sent."""
    state, frame = states[0], frames[0]
    frame.joints[:], frame.joint_velocities[:] = state.joints[0], state.joints[1]
    frame.joint_accelerations[:] = state.joints[2]
    frame.flags, frame.commanded = flags, commanded
