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

from kmp.compiled import compiled
from service.config import Settings
from service.core.arm.arm import Arm, Kinematics
from service.core.arm.inverse_kinematics import joint_costs
from service.core.frame import Record, Records, Vector, as_array, parameters
from service.core.geometry import axis_of, quaternion_of, swing, turn_between, turn_on
from service.core.setpoint import HULL_SPANS
from service.core.setpoint.bounds import BOUNDS, HULL_TIME_S, between, bounds_around, stopping, take_safe, what_is_wrong
from service.core.setpoint.tracker import GAP_MOST, GAP_WIDE, gains_for, waiting
from service.core.skill.model import Target, Wanted
from service.core.skill.pose import NO_GRIPPER
from service.core.skill.skill import decided

ROOM = 0.0012  # [m] by which the setpoint's stop may pass the hands'
STOP_TIME = 0.0115  # [s] times the target's speed: no hand stops at once
STOP_BRAKE = 16.0  # [m/s²] no hand brakes harder
FORESEEN = 0.11  # [s] a target that brakes is taken to be slower by its deceleration times this
PROMPT_S = 0.0285  # response time of the estimator that a good tracker at 30 Hz or more does not reach ...
LATE_SHARE = 4.0  # ... and of what another one's is longer, by so much later a stop is taken to be seen ...
LATE_MOST = 0.008  # [m] ... but for no more way than this: all motion lags by that
MEETING_ROOM = 0.004  # [m] by which the setpoint may pass its target as it comes to the target's speed ...
MEETING_SHARE, LEAST_MEETING = 0.5, 0.15  # ... of its braking, less what the target brakes; but so much at least
STOP_ERROR = 0.03  # [m] at which the tracker asks for a planned stop's jerk: what is braked harder swings
BARRIER_RATE = 100.0  # [1/s] at which the room left may be used up ...
BARRIER_TIME = 0.0035  # [s] ... and of it in a tick this by the period at most: in long ticks planning misses more
SHARE = 0.95  # of acceleration and jerk that is planned with
SPEED_SHARE = 0.97  # of speed, likewise
LEAST_SPEED = 1e-3  # [m/s] below it no motion has a direction
GAP_FREE, GAP_SLOW = 0.003, 0.012  # [m] a tool so far behind its setpoint slows it, more so by every so far
PLANNED, STOPPED, WRONG = 1, 2, 3  # a step met a bound in planning; began the stop; passed a bound


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
        return int(_lead(as_array(state), *motion, self._parameters, box, costs, slow))

    def why_wrong(self, state: Record, before: Vector, box: Vector) -> str:
        """What of its bounds a setpoint passed since `before` (3, 3), seen from outside."""
        return BOUNDS[what_is_wrong(state["setpoint"], before, state["hull"], box, self._parameters)]


@compiled
def slow_down(setpoint: Vector, tool: Vector, share: float, max_speed: float) -> float:
    """Share of the greatest speed [m/s] for a setpoint (3, 3) that is ahead of the tool (3,) [m]; 1
    where it comes back; and for one that may keep only a share of its own speed.
    """
    along = gap = 0.0
    for i in range(3):
        ahead = setpoint[0, i] - tool[i]
        along += ahead * setpoint[1, i]
        gap += ahead * ahead
    slow = 1.0 if along <= 0.0 else 1.0 / (1.0 + max(0.0, math.sqrt(gap) - GAP_FREE) / GAP_SLOW)
    if share < 1.0:
        slow = min(slow, share * _norm(setpoint[1]) / max_speed)
    return slow


@compiled
def _lead(
    states: Records,
    position: Vector,
    velocity: Vector,
    acceleration: Vector,
    parameters: Records,
    box: Vector,
    costs: Vector,
    slow: float,
) -> int:
    """`SetpointGenerator.step`."""
    state, given, setpoint = states[0], parameters[0], states[0].setpoint
    target, low, high, before = np.empty((3, 3)), np.empty(3), np.empty(3), setpoint.copy()
    target[0], target[1], target[2] = position, velocity, acceleration
    state.hull_ticks = bounds_around(state.hull, state.hull_ticks, position, parameters, box, low, high)
    jerk, ahead, dt = np.empty(3), np.empty((3, 3)), given.period_s
    late_s = LATE_SHARE * max(0.0, state.response_s - PROMPT_S)
    met = _track(setpoint, target, parameters, costs, slow, late_s, box, jerk)
    for i in range(3):
        x, v, a, j = setpoint[0, i], setpoint[1, i], setpoint[2, i], jerk[i]
        ahead[0, i] = x + dt * (v + dt * (a / 2.0 + dt * j / 6.0))
        ahead[1, i] = v + dt * (a + dt * j / 2.0)
        ahead[2, i] = a + dt * j
    if not take_safe(setpoint, ahead, parameters, costs, slow, low, high):
        met = STOPPED
    if what_is_wrong(setpoint, before, state.hull, box, parameters):
        setpoint[:] = before
        return WRONG
    return met


@compiled
def _track(
    setpoint: Vector,
    target: Vector,
    parameters: Records,
    costs: Vector,
    slow: float,
    late_s: float,
    box: Vector,
    jerk: Vector,
) -> int:
    """The tracker's jerk (3,), less of it along the motion where the stop, the target's speed or
    the greatest one asks for that. A stop of the hands is seen `late_s` later than by most.
    """
    given = parameters[0]
    gains, dt = given.gains, given.period_s
    max_speed = given.max_speed
    speed, target_speed = _norm(setpoint[1]), _norm(target[1])
    feasible = min(1.0, max_speed / target_speed) if target_speed > 0.0 else 1.0
    for i in range(3):
        jerk[i] = gains[0] * (target[0, i] - setpoint[0, i]) + gains[1] * feasible * target[1, i]
        if feasible == 1.0:  # what a target does beyond the speed limit is not followed
            jerk[i] += gains[2] * target[2, i]
        jerk[i] += gains[3] * setpoint[1, i] + gains[4] * setpoint[2, i]
    _approach_sides(setpoint, parameters, box, jerk)
    _limit_jerk(jerk, setpoint[2], parameters, costs)
    if speed <= LEAST_SPEED:
        return 0
    along = np.empty(3)
    a = u = way = v_target = a_target = 0.0
    for i in range(3):
        along[i] = setpoint[1, i] / speed
        a += along[i] * setpoint[2, i]
        u += along[i] * jerk[i]
        way += along[i] * (target[0, i] - setpoint[0, i])
        v_target += along[i] * feasible * target[1, i]
        a_target += along[i] * target[2, i]
    brake = SHARE * min(given.max_acceleration, 1.0 / max(_largest(costs[1], along), 1e-9))
    change = SHARE * min(given.stop_jerk, 1.0 / max(_largest(costs[2], along), 1e-9))
    change = min(change, STOP_ERROR * gains[0])
    top = slow * SPEED_SHARE * min(max_speed, 1.0 / max(_largest(costs[0], along), 1e-9))
    coming = max(0.0, v_target + FORESEEN * min(a_target, 0.0))
    room = ROOM - min(late_s * speed, LATE_MOST)
    room += given.stop_room * (STOP_TIME * coming + coming * coming / (2.0 * STOP_BRAKE))
    # with less jerk than the lowest it would brake on after it rests, and swing back
    now, soon = _coasting(speed, a, 0.0, change, 0.0), _coasting(speed, a, u, change, dt)
    lowest = between(u, -change, soon, _coasting(speed, a, -change, change, dt), 0.0)
    # what is left of a room shrinks at BARRIER_RATE at most
    kept = 1.0 - min(BARRIER_RATE * dt, BARRIER_TIME / dt)
    chosen = stopping(way + room, min(coming, speed) * dt, speed, a, (brake, change), (u, lowest), kept, dt)
    faster, a_faster = speed - v_target, a - a_target
    if faster > 0.0 and _coasting(faster, a_faster, 0.0, change, 0.0) > 0.0:
        meeting = max(MEETING_SHARE * brake + min(a_target, 0.0), LEAST_MEETING * brake)
        chosen = stopping(way + MEETING_ROOM, 0.0, faster, a_faster, (meeting, change), (chosen, lowest), kept, dt)
    limit = top - kept * (top - now)
    most = _coasting(speed, a, chosen, change, dt)
    chosen = between(chosen, -change, most, _coasting(speed, a, -change, change, dt), limit)
    if chosen >= u:
        return 0
    for i in range(3):
        jerk[i] += (chosen - u) * along[i]
    _limit_jerk(jerk, setpoint[2], parameters, costs)
    return PLANNED


@compiled
def _approach_sides(setpoint: Vector, parameters: Records, box: Vector, jerk: Vector) -> None:
    """Limit the jerk (3,) so that the setpoint approaches each side of the workspace without
    passing it: with h the distance to the side, (d/dt + p)³ h >= 0, that is

        jerk <= p³ h - 3 p² velocity - 3 p acceleration,    p = gains[0]^(1/3).

    A setpoint whose target lies on a side then comes to rest there. Without this, the tracker
    passes its target by a little, each time into the fastest stop, and swings for ever. Beyond a
    side h is 0: the setpoint goes no farther, and its targets bring it back.
    """
    given = parameters[0]
    p = given.gains[0] ** (1.0 / 3.0)
    for i in range(3):
        x, v, a = setpoint[0, i], setpoint[1, i], setpoint[2, i]
        damping = -3.0 * p * (p * v + a)
        highest = max(p**3 * max(box[1, i] - x, 0.0) + damping, -given.stop_jerk)
        lowest = min(p**3 * min(max(box[0, i], given.lowest[i]) - x, 0.0) + damping, given.stop_jerk)
        jerk[i] = min(max(jerk[i], min(lowest, highest)), max(lowest, highest))


@compiled
def _coasting(speed: float, a: float, jerk: float, change: float, dt: float) -> float:
    """The speed [m/s] at which the acceleration, after dt of a jerk, comes to 0 by `change`."""
    then = a + dt * jerk
    return speed + dt * (a + 0.5 * dt * jerk) + then * abs(then) / (2.0 * change)


@compiled
def _largest(costs: Vector, motion: Vector) -> float:
    """How much of its limit the busiest joint needs for a tool motion (3,), with costs (3, J)."""
    largest = 0.0
    for joint in range(costs.shape[1]):
        needed = costs[0, joint] * motion[0] + costs[1, joint] * motion[1] + costs[2, joint] * motion[2]
        largest = max(largest, abs(needed))
    return largest


@compiled
def _limit_jerk(jerk: Vector, acceleration: Vector, parameters: Records, costs: Vector) -> None:
    """The jerk (3,) cut so that it, and the acceleration after it, keep the limits of tool and
    joints.
    """
    given, ahead, dt = parameters[0], np.empty(3), parameters[0].period_s
    for i in range(3):
        ahead[i] = acceleration[i] + dt * jerk[i]
    excess = max(_norm(ahead) / given.max_acceleration, _largest(costs[1], ahead))
    if excess > 1.0:
        for i in range(3):
            jerk[i] = (ahead[i] / excess - acceleration[i]) / dt
    excess = max(_norm(jerk) / given.max_jerk, _largest(costs[2], jerk))
    if excess > 1.0:
        for i in range(3):
            jerk[i] /= excess


@compiled
def _norm(vector: Vector) -> float:
    return math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])


TURN_GAIN = 12.0  # [1/s] of a small error's decay
TURN_BRAKE_SHARE = 0.7  # of the acceleration, with which a large one's turn is planned to end
TURN_SPEED_SHARE = 0.9  # of the tool's greatest: the arm needs the rest to catch up
ROUND_TO = 1e9  # [s/rad] of the angular velocity: rounded so that a replay on another kind of CPU agrees


class OrientationSetpoint:
    """Turns the state's orientation (4,), at an angular velocity (3,) [rad/s], toward targets."""

    def __init__(self, settings: Settings) -> None:
        tool = settings.tool
        self.parameters = parameters(
            max_speed=TURN_SPEED_SHARE * tool.max_turn_speed,
            max_acceleration=float(tool.max_turn_acceleration),
            about=int(tool.orientation == "full"),
            period_s=settings.period_s,
        )

    def begin(self, state: Record, rotation: Vector, turning: Vector) -> None:
        """Puts it where the tool is, before there are targets: rotation (3, 3), turning (3,)
        [rad/s].
        """
        quaternion_of(rotation, state["orientation"])
        state["turning"] = turning

    def step(self, state: Record, orientation: Vector, turning: Vector) -> None:
        """Turns it one period on toward an orientation (4,) that turns itself (3,) [rad/s].

        Where the settings say that a direction is followed, +z goes the shortest way.
        """
        _turn(state["orientation"], state["turning"], orientation, turning, self.parameters)


@compiled
def _turn(quaternion: Vector, turning: Vector, target: Vector, target_turning: Vector, parameters: Records) -> None:
    """One period, in place."""
    given, dt = parameters[0], parameters[0].period_s
    error, wanted, axis = np.empty(3), np.empty(3), np.empty(3)
    axis_of(quaternion, axis)
    along = 0.0
    if given.about:
        turn_between(quaternion, target, error)
    else:
        swing(axis, target, error)
        for i in range(3):
            along += target_turning[i] * axis[i]
    angle = math.sqrt(error[0] * error[0] + error[1] * error[1] + error[2] * error[2])
    # in proportion to the error when near, braking evenly from afar
    brake, rate = TURN_BRAKE_SHARE * given.max_acceleration, TURN_GAIN
    near = brake / TURN_GAIN**2
    if angle > near:
        rate = math.sqrt(2.0 * brake * (angle - 0.5 * near)) / angle
    speed = 0.0
    for i in range(3):
        wanted[i] = target_turning[i] - along * axis[i] + rate * error[i]
        speed += wanted[i] * wanted[i]
    slower = min(1.0, given.max_speed / max(math.sqrt(speed), 1e-12))
    change = 0.0
    for i in range(3):
        wanted[i] = slower * wanted[i] - turning[i]
        change += wanted[i] * wanted[i]
    share = min(1.0, given.max_acceleration * dt / max(math.sqrt(change), 1e-12))
    for i in range(3):
        turning[i] = np.rint((turning[i] + share * wanted[i]) * ROUND_TO) / ROUND_TO
        wanted[i] = dt * turning[i]
    turn_on(quaternion, wanted)


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
        _write(as_array(state), as_array(frame))

    def step(self, state: Record, frame: Record, wanted: Wanted, here: Kinematics, box: Vector, share: float) -> int:
        """Leads the setpoints one period on; what `SetpointGenerator.step` says. `share` is that of
        the setpoint's speed at which separation lets the tool go along.
        """
        states, frames = as_array(state), as_array(frame)
        slow = _ready(states, here.record, self._arm.parameters, self._max_speed, share, self._costs)
        target, tool = wanted.target, here.record["position"][0]
        gap_m = math.dist(state["setpoint"][0].tolist(), tool.tolist())
        if gap_m > GAP_WIDE:
            target = waiting(target, state["setpoint"], tool)
        if gap_m > GAP_MOST:  # it waits, also outside of the workspace
            box = np.array([np.minimum(box[0], state["setpoint"][0]), np.maximum(box[1], state["setpoint"][0])])
        met = self._position.step(state, target, box, self._costs, slow)
        if state["closure"] != NO_GRIPPER:
            self._grip(state, wanted, here)
        _finish(states, frames, self._orientation.parameters)
        return met

    def _grip(self, state: Record, wanted: Wanted, here: Kinematics) -> None:
        """Opens or closes the gripper as the skill asks, once the tool is where it is to be."""
        before, closure = int(state["gripper"]), float(state["closure"])
        since_s = self._period_s * int(state["tick"] - state["gripper_tick"])
        off = math.dist(wanted.target.position.tolist(), here.record["position"][0].tolist())
        state["gripper"] = decided(before, closure, since_s=since_s, off=off)
        if state["gripper"] != before:
            state["gripper_tick"] = state["tick"]


@compiled
def _ready(states: Records, heres: Records, arms: Records, max_speed: float, share: float, costs: Vector) -> float:
    """The joints' costs of tool motion into `costs`; share of the speed that is allowed."""
    joint_costs(arms, heres, costs)
    return slow_down(states[0].setpoint, heres[0].position, share, max_speed)


@compiled
def _finish(states: Records, frames: Records, parameters: Records) -> None:
    """Turns the orientation's setpoint on toward the frame's target, and shows the setpoints."""
    state, frame = states[0], frames[0]
    _turn(state.orientation, state.turning, frame.orientation, frame.turning, parameters)
    _write(states, frames)


@compiled
def _write(states: Records, frames: Records) -> None:
    """Into the frame where the setpoints are."""
    state, frame = states[0], frames[0]
    frame.setpoint[:], frame.setpoint_velocity[:] = state.setpoint[0], state.setpoint[1]
    frame.setpoint_acceleration[:] = state.setpoint[2]
    frame.setpoint_orientation[:], frame.setpoint_turning[:] = state.orientation, state.turning
    frame.gripper = state.gripper
