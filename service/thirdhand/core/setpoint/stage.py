"""Setpoint stage: from the predicted target to a setpoint that the arm can follow and always stop.

A linear-quadratic tracker with jerk as its input leads the setpoint. It minimises

    integral of |target - setpoint|² + jerk_weight |jerk|².

Discrete control barrier functions (Agrawal and Sreenath, RSS 2017) limit this jerk along the motion
(`step._track`). The setpoint can stop, within its limits, where the hands can stop at the earliest.
It can reach the target's own speed before it passes the target. Its speed stays within the speed
that the joints and the tool's lag allow.

A step is taken only if the stop after it keeps every limit. Otherwise the setpoint begins the stop
that the step before has checked. So these limits hold by induction, whatever the target does:

* the norms of speed, acceleration and jerk are at most `max_speed`, `max_acceleration`, `max_jerk`;
* after a start or a hold, until the setpoint is within 2 stuck_gap_m of its target, the norm of its
  speed is at most `engaging_speed`, and the tool turns at the same share of its limit;
* the setpoint stays inside the workspace, and within hull_margin_m of the box around the targets of
  the last hull_time_s. If that box has moved away, or if following began outside of it, the
  setpoint returns at return_share of max_speed or faster. docs/bounds.md has the proof.
"""

from __future__ import annotations

import math

import numpy as np

from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.frame import Record, Records, Vector, as_array, parameters
from thirdhand.core.kinematics import Kinematics
from thirdhand.core.setpoint import HULL_SPANS
from thirdhand.core.setpoint.bounds import farthest
from thirdhand.core.setpoint.orientation import OrientationSetpoint
from thirdhand.core.setpoint.step import finish, lead, ready, write
from thirdhand.core.setpoint.tracker import gains_for, waiting
from thirdhand.core.skill.model import Target, Wanted
from thirdhand.core.skill.pose import NO_GRIPPER, decided
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.core.vectors import times
from thirdhand.settings.config import Settings


class SetpointGenerator:
    """Position setpoint of the state (3, 3): position, velocity and acceleration; by axis."""

    def __init__(self, settings: Settings, *, tuning: Tuning = TUNING) -> None:
        tool = settings.tool
        reach = settings.reach
        numbers = tuning.setpoint
        # [m] a stop at full braking, and one second at max_speed: no stop from outside takes more
        longest_stop = (
            0.5 * tool.max_speed * tool.max_speed / tool.stop_acceleration + 1.0 * tool.max_speed
        )
        # Planned shares of the tool's limits, and of the joints', which `joint_costs` has already
        # reduced by them once.
        speed_share, brake_share, jerk_share = tuning.arm.planned_limit_shares
        self._parameters = parameters(
            period_s=settings.period_s,
            gains=gains_for(settings, tuning),
            max_speed=float(tool.max_speed),
            max_acceleration=tool.acceleration,
            max_jerk=tool.jerk,
            stop_acceleration=tool.stop_acceleration,
            stop_jerk=tool.stop_jerk,
            stop_room=tool.room,
            longest_stop=longest_stop,
            lowest=np.array([reach.min_x, -np.inf, reach.min_z]),
            span_ticks=max(1, round(numbers.hull_time_s / (HULL_SPANS - 1) / settings.period_s)),
            **numbers._asdict(),
            gap_free_m=numbers.gap_free_m,
            # A planned stop uses at most the tracker's jerk for this error, or it oscillates.
            stop_jerk_error_m=numbers.hull_margin_m,
            # The setpoint may stop this far beyond the hands' stop: noise moves resting targets.
            stop_overshoot_m=2.0 * tuning.intake.least_noise_m,
            planned_speed_share=speed_share,
            planned_brake_share=brake_share,
            # To meet a target that brakes too, the share of the jerk that planning leaves.
            meeting_brake_least_share=1.0 - jerk_share,
            # as the tool closes in on its setpoint
            barrier_rate_per_s=tuning.arm.position_gain_per_s,
            # In long periods, where the prediction over one period is less accurate.
            barrier_time_s=1.0 / (6.0 * tuning.arm.position_gain_per_s),
            # Progress that is expected of a tool, from up to 0.75 stuck_s of max_speed away.
            return_share=0.75 * tuning.decision.progress_share,
        )
        self._engaging = self._parameters.copy()
        self._engaging["max_speed"] = tool.engaging_speed
        self._engages = tool.engaging_speed < tool.max_speed
        self._engaged_gap_m = 2.0 * tuning.decision.stuck_gap_m

    def begin(self, state: Record, setpoint: Vector, *, engages: bool = True) -> None:
        """Start from the motion of the tool (3, 3), which becomes the only known target.

        If it `engages`, it engages anew; otherwise an engaging that has not ended continues.
        """
        state["setpoint"] = setpoint
        state["engaging"] = self._engages and (engages or state["engaging"])
        state["hull"] = setpoint[0]
        state["hull_ticks"] = 0

    def limits(self, state: Record) -> Records:
        """Parameters (1,) of a step from this state, in which `max_speed` is the present limit."""
        return self._engaging if as_array(state)["engaging"][0] else self._parameters

    def engage(self, state: Record, target: Vector) -> None:
        """End the engaging of a setpoint that is within 2 stuck_gap_m of its target (3,) [m]."""
        if not as_array(state)["engaging"][0]:
            return
        if math.dist(target.tolist(), state["setpoint"][0].tolist()) < self._engaged_gap_m:
            state["engaging"] = 0

    def step(self, state: Record, target: Target, box: Vector, costs: Vector, slow: float) -> int:
        """Move the setpoint one period toward a target.

        box: lower and upper corner (2, 3) [m] of the workspace. costs: (3, 3, J) of `joint_costs`,
        the share of each joint's limit that a tool velocity, acceleration and jerk need. slow:
        share of max_speed that is allowed while the tool is behind.

        Returns 0 if no limit was met, PLANNED or STOPPED if one was, and BROKEN if a bound is
        broken. BROKEN means an error in this program; the setpoint then stays where it is.
        """
        motion = target.position, target.velocity, target.acceleration
        return int(lead(as_array(state), *motion, self.limits(state), box, costs, slow))

    def stretched(self, box: Vector, setpoint: Vector) -> Vector:
        """Workspace (2, 3) [m], extended so that a setpoint (3, 3) can stop inside of it. Read-only
        as the workspace of a skill is, for which the step is compiled.

        A setpoint outside of its workspace that waits for its tool then need not return.
        """
        limits = self._parameters[0]["stop_acceleration"], self._parameters[0]["stop_jerk"]
        ends = np.array(
            [
                [
                    -farthest(setpoint, i, -1.0, *limits, 0.0),
                    farthest(setpoint, i, 1.0, *limits, 0.0),
                ]
                for i in range(3)
            ]
        )
        stretched = np.stack([np.minimum(box[0], ends[:, 0]), np.maximum(box[1], ends[:, 1])])
        stretched.setflags(write=False)
        return stretched


class SetpointStage:
    """Position and orientation setpoints and gripper, in the box (2, 3) [m] of the active skill."""

    def __init__(self, settings: Settings, arm: ArmStage, *, tuning: Tuning = TUNING) -> None:
        self._arm = arm
        self._period_s = settings.period_s
        self._gap_waiting_m = tuning.setpoint.gap_waiting_m
        self._gap_stopped_m = tuning.setpoint.gap_stopped_m
        self._takes_wishes = settings.hands.gripper == "key"
        self._costs = np.empty((3, 3, len(settings.joints.names)))
        self._position = SetpointGenerator(settings, tuning=tuning)
        self._orientation = OrientationSetpoint(settings, tuning=tuning)

    def begin(
        self, state: Record, frame: Record, here: Kinematics, *, engages: bool = True
    ) -> None:
        """Start the setpoints where the commanded joints place the tool, at the tool's velocity."""
        velocities = state["joints"][1]
        moving = np.stack([here.position, times(here.tasks[:3], velocities), np.zeros(3)])
        self._position.begin(state, moving, engages=engages)
        self._orientation.begin(state, here.rotation, times(here.jacobian[3:], velocities))
        write(as_array(state), as_array(frame))

    def step(
        self,
        state: Record,
        frame: Record,
        wanted: Wanted,
        here: Kinematics,
        box: Vector,
        share: float,
    ) -> int:
        """Move the setpoints one period on; return the code of `SetpointGenerator.step`.

        `share`: share of the setpoint's speed at which separation lets the tool follow.
        """
        states = as_array(state)
        frames = as_array(frame)
        target = wanted.target
        tool = here.record["position"][0]
        self._position.engage(state, target.position)
        limits = self._position.limits(state)

        slow, gap_m = ready(states, here.record, self._arm.parameters, limits, share, self._costs)
        if gap_m > self._gap_waiting_m:
            gaps_m = self._gap_waiting_m, self._gap_stopped_m
            target = waiting(target, state["setpoint"], tool, gaps_m)
        if gap_m > self._gap_stopped_m:
            box = self._position.stretched(box, state["setpoint"])
        met = self._position.step(state, target, box, self._costs, slow)

        closure = float(states["closure"][0])
        if closure != NO_GRIPPER:
            distance_m = math.dist(wanted.target.position.tolist(), tool.tolist())
            self._grip(state, closure, distance_m)
        elif self._takes_wishes:
            self._grip(state, float(state["gripper_wish"]), 0.0)

        finish(states, frames, self._orientation.limits(state))
        return met

    def _grip(self, state: Record, closure: float, off: float) -> None:
        """Open or close the gripper for a `closure` that the skill predicts or a person wishes, if
        the tool is near its target, `off` [m] away.
        """
        states = as_array(state)
        before = int(states["gripper"][0])
        tick = int(states["tick"][0])
        since_s = self._period_s * (tick - int(states["gripper_tick"][0]))
        after = decided(before, closure, since_s=since_s, off=off)
        if after != before:
            state["gripper"] = after
            state["gripper_tick"] = tick
