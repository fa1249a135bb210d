"""The setpoints of position, orientation and gripper, led to what the skill asks for."""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.config import Settings
from service.core.arm.arm import Arm, Kinematics
from service.core.record import Record, Records, Vector
from service.core.setpoint.orientation import OrientationSetpoint
from service.core.setpoint.setpoint import SetpointGenerator
from service.core.skill.pose import decided
from service.core.skill.stage import Wanted


class SetpointStage:
    """Leads the state's setpoints within the workspace's box (2, 3) [m] of the skill in force."""

    def __init__(self, settings: Settings, arm: Arm) -> None:
        self._arm, self._period_s = arm, settings.period_s
        self._position, self._orientation = SetpointGenerator(settings), OrientationSetpoint(settings)

    def begin(self, state: Record, here: Kinematics) -> None:
        """The setpoints where the commanded joints have the tool."""
        velocities = state["joints"][1]
        self._position.begin(state, np.stack([here.position, here.tasks[:3] @ velocities, np.zeros(3)]))
        self._orientation.begin(state, here.rotation, here.jacobian[3:] @ velocities)

    def step(self, state: Record, wanted: Wanted, here: Kinematics, box: Vector, share: float) -> int:
        """Leads the setpoints one period on; what `SetpointGenerator.step` says. `share` is that of
        the setpoint's speed at which separation lets the tool go along.
        """
        slow = self._position.slow_down(state, here.record, share)
        met = self._position.step(state, wanted.target, box, self._arm.costs(here), slow)
        self._orientation.step(state, wanted.orientation, wanted.turning)
        self._grip(state, wanted, here)
        return met

    def _grip(self, state: Record, wanted: Wanted, here: Kinematics) -> None:
        """Opens or closes the gripper as the skill asks, once the tool is where it is to be."""
        before, closure = int(state["gripper"]), float(state["closure"])
        since_s = self._period_s * int(state["tick"] - state["gripper_tick"])
        off = math.dist(wanted.target.position.tolist(), here.position.tolist())
        state["gripper"] = decided(before, closure, since_s=since_s, off=off)
        if state["gripper"] != before:
            state["gripper_tick"] = state["tick"]


@compiled
def write_setpoint(states: Records, frames: Records) -> None:
    """Into the frame where the setpoints are."""
    state, frame = states[0], frames[0]
    frame.setpoint[:], frame.setpoint_velocity[:] = state.setpoint[0], state.setpoint[1]
    frame.setpoint_acceleration[:] = state.setpoint[2]
    frame.setpoint_orientation[:], frame.setpoint_turning[:] = state.orientation, state.turning
    frame.gripper = state.gripper
