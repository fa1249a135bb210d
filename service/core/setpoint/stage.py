"""From the predicted target to a setpoint that the arm can follow, and that can always stop in
time.

The setpoint is led by a linear-quadratic tracker whose input is jerk: it minimises the integral of
error² + weight jerk². Along its motion that jerk is bounded twice (discrete control barrier
functions; Agrawal and Sreenath, RSS 2017). The setpoint can stop, within its limits, where the
hands would stop at the soonest; the later, the later their tracker shows that they do. And it can
come to the target's own speed before it passes that. A step is taken only if the stop after it
keeps every limit; else the stop, which the step before had made sure of, begins now. So the limits
hold by induction, whatever the target does:

* speed, acceleration and jerk at most `max_speed`, `max_acceleration` and `max_jerk`, as norms;
* never outside the box of the workspace, nor farther than HULL_MARGIN from the box around the last
  HULL_TIME_S of targets. Where that box has moved away, or began elsewhere, the setpoint comes back
  to it at RETURN_SHARE of the greatest speed at least: docs/bounds.md has the proof.
"""

from __future__ import annotations

import math

import numpy as np

from service.config import Settings
from service.core.arm.stage import Arm
from service.core.frame import Record, Vector, as_array, parameters
from service.core.kinematics import Kinematics
from service.core.setpoint import HULL_SPANS
from service.core.setpoint.bounds import BOUNDS, farthest, what_is_wrong
from service.core.setpoint.orientation import OrientationSetpoint
from service.core.setpoint.step import finish, lead, ready, write
from service.core.setpoint.tracker import gains_for, waiting
from service.core.setpoint.tuning import GAP_STOPPED_M, GAP_WAITING_M, HULL_TIME_S
from service.core.skill.model import Target, Wanted
from service.core.skill.pose import NO_GRIPPER, decided


class SetpointGenerator:
    """Moves the state's setpoint (3, 3), position, velocity and acceleration by axis, toward
    targets.
    """

    def __init__(self, settings: Settings) -> None:
        tool, reach = settings.tool, settings.reach
        self._parameters = parameters(
            period_s=settings.period_s,
            gains=gains_for(settings),
            max_speed=float(tool.max_speed),
            max_acceleration=tool.acceleration,
            max_jerk=tool.jerk,
            stop_acceleration=tool.stop_acceleration,
            stop_jerk=tool.stop_jerk,
            stop_room=float(tool.stop_room),
            lowest=np.array([reach.min_x, -np.inf, reach.min_z]),
            span_ticks=max(1, round(HULL_TIME_S / (HULL_SPANS - 1) / settings.period_s)),
        )

    def begin(self, state: Record, setpoint: Vector) -> None:
        """Puts the setpoint where the tool is, before there are targets."""
        state["setpoint"] = setpoint
        state["hull"] = setpoint[0]
        state["hull_ticks"] = 0

    def step(self, state: Record, target: Target, box: Vector, costs: Vector, slow: float) -> int:
        """Moves the setpoint one period on; 0, or PLANNED or STOPPED where a limit was met, or
        WRONG where a bound was passed, which cannot be: it then stays where it is.

        box: (2, 3) lower and upper corner [m] of the workspace. costs: (3, 3, J) what a tool
        velocity, acceleration and jerk cost of each joint's limit, 1 for all of it. slow: share of
        the speed that is allowed, as the arm is behind.
        """
        motion = target.position, target.velocity, target.acceleration
        return int(lead(as_array(state), *motion, self._parameters, box, costs, slow))

    def stretched(self, box: Vector, setpoint: Vector) -> Vector:
        """A workspace (2, 3) [m] in which a setpoint (3, 3) can stop, so that one that is outside
        of its workspace and waits for its tool need not return.
        """
        limits = self._parameters[0]["stop_acceleration"], self._parameters[0]["stop_jerk"]
        ends = np.array(
            [[-farthest(setpoint, i, -1.0, *limits, 0.0), farthest(setpoint, i, 1.0, *limits, 0.0)] for i in range(3)]
        )
        return np.stack([np.minimum(box[0], ends[:, 0]), np.maximum(box[1], ends[:, 1])])

    def why_wrong(self, state: Record, before: Vector, box: Vector) -> str:
        """What of its bounds a setpoint passed since `before` (3, 3), seen from outside."""
        return BOUNDS[what_is_wrong(state["setpoint"], before, state["hull"], box, self._parameters)]


class SetpointStage:
    """Leads the state's setpoints within the workspace's box (2, 3) [m] of the skill in force."""

    def __init__(self, settings: Settings, arm: Arm) -> None:
        self._arm, self._period_s, self._max_speed = arm, settings.period_s, float(settings.tool.max_speed)
        self._costs = np.empty((3, 3, len(settings.joints.names)))
        self._position, self._orientation = SetpointGenerator(settings), OrientationSetpoint(settings)

    def begin(self, state: Record, frame: Record, here: Kinematics) -> None:
        """The setpoints where the commanded joints have the tool."""
        velocities = state["joints"][1]
        self._position.begin(state, np.stack([here.position, here.tasks[:3] @ velocities, np.zeros(3)]))
        self._orientation.begin(state, here.rotation, here.jacobian[3:] @ velocities)
        write(as_array(state), as_array(frame))

    def step(self, state: Record, frame: Record, wanted: Wanted, here: Kinematics, box: Vector, share: float) -> int:
        """Leads the setpoints one period on; what `SetpointGenerator.step` says. `share` is that of
        the setpoint's speed at which separation lets the tool go along.
        """
        states, frames = as_array(state), as_array(frame)
        slow = ready(states, here.record, self._arm.parameters, self._max_speed, share, self._costs)
        target, tool = wanted.target, here.record["position"][0]
        gap_m = math.dist(state["setpoint"][0].tolist(), tool.tolist())
        if gap_m > GAP_WAITING_M:
            target = waiting(target, state["setpoint"], tool)
        if gap_m > GAP_STOPPED_M:
            box = self._position.stretched(box, state["setpoint"])
        met = self._position.step(state, target, box, self._costs, slow)
        if state["closure"] != NO_GRIPPER:
            self._grip(state, wanted, here)
        finish(states, frames, self._orientation.parameters)
        return met

    def _grip(self, state: Record, wanted: Wanted, here: Kinematics) -> None:
        """Opens or closes the gripper as the skill asks, once the tool is where it is to be."""
        before, closure = int(state["gripper"]), float(state["closure"])
        since_s = self._period_s * int(state["tick"] - state["gripper_tick"])
        off = math.dist(wanted.target.position.tolist(), here.record["position"][0].tolist())
        state["gripper"] = decided(before, closure, since_s=since_s, off=off)
        if state["gripper"] != before:
            state["gripper_tick"] = state["tick"]
