"""The arm's kinematics: where the tool is, which targets it can reach, and the joint velocities
that bring it there.

One step of differential inverse kinematics is a strictly convex least-squares problem with a bound
on each joint's speed toward its limits, so that its solution is unique and continuous: unreachable
targets and singular postures slow the arm, without chatter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dposv

from service.config import Settings
from service.core.compiled import compiled
from service.core.frame import Vector
from service.core.limiter import MARGIN, approach_gain

# Gains, speeds and damping below were chosen on the WAM, and tried on a Panda and a UR5.
NEAR_LIMIT = 0.1  # [rad]

POSITION_GAIN = 50.0  # [1/s] of a small error's decay
CLOSING_SPEED = 0.3  # [m/s] at most, of a large one's
CLOSING_BRAKES = 0.1  # of the tool's acceleration; with more, joints at their jerk limit swing about the target
DIRECTION_GAIN = 10.0  # [1/s]
DIRECTION_SPEED = 0.5  # [rad/s] at most
DIRECTION_LEVER = 0.01  # [m] 1 rad/s of direction counts as this many m/s of the tool: position goes first
POSTURE_GAIN = 1.0  # [1/s]
POSTURE_SPEED = 0.3  # [rad/s] at most, each joint
DAMPING = 1e-5  # [m²] a joint at 1 rad/s costs as much as sqrt(DAMPING) m/s of error
SINGULAR_DAMPING = 2e-3  # [m²] more at a singular posture
SINGULAR_VOLUME = 0.04  # [m³] manipulability below which damping grows; 0.06 to 0.13 over the table
FAR_DAMPING = 4.0  # [s²] more, times the square of the closing speed above FAR_SPEED: steady at unreachable targets
FAR_SPEED = 0.15  # [m/s]
BOUND_ROUNDS = 12  # joints that may enter or leave their bounds in one step
SPARING = 0.3  # power of a joint's acceleration limit by which its speed is weighed: slow ones are spared
TOOL_SHARE = 0.985  # of the tool's greatest speed, for closing and forward speed together
# Of the joints' speed, acceleration and jerk that a plan may use: turning the tool needs the rest.
PLANNED_SHARE = np.array([0.96, 0.9, 0.7])
GAP_FREE, GAP_SLOW = 0.003, 0.012  # [m] a tool so far behind its setpoint slows it, more so by every so far
DECIMALS = 9  # [rad/s] of the result: rounded so that a replay on another kind of CPU agrees


class Solution(NamedTuple):
    """Joint velocities (J,) [rad/s].

    Whether they were scaled down to the speed limits; whether a joint is within 0.1 rad of a
    position limit.
    """

    velocity: Vector
    speed_limited: bool
    near_limit: bool


class Kinematics(NamedTuple):
    """The arm at some joints: the tool's position (3,) [m] and rotation (3, 3) in frame base.

    `across` (2, 3): what of a turn moves the tool's direction, times DIRECTION_LEVER; the tasks
    (5, J): tool velocity, and that turning; their damping [m²].
    """

    joints: Vector
    position: Vector
    rotation: Vector
    across: Vector
    tasks: Vector
    damping: float


class Arm:
    """The arm that a URDF describes, with a tool on its plate.

    Stateless: every answer follows from the arguments.

    J joints, in the order of the settings; all others of the description stay at 0.
    """

    def __init__(self, settings: Settings, urdf: str) -> None:
        self._model = _chain(pin.buildModelFromXML(urdf), settings.joints.names)
        plate = self._model.frames[self._model.getFrameId(settings.arm.plate)]
        x, y, z, *quaternion = settings.tool.plate_from_tool
        unit = np.array(quaternion) / math.hypot(*quaternion)
        plate_from_tool = pin.SE3(pin.Quaternion(unit), np.array([x, y, z]))
        tool = pin.Frame("thirdhand tool", plate.parentJoint, plate.placement * plate_from_tool, pin.FrameType.OP_FRAME)
        self._tool = self._model.addFrame(tool)
        self._data = self._model.createData()
        self._braking = CLOSING_BRAKES * settings.tool.max_acceleration
        self._closing_speed = min(settings.tool.max_speed, CLOSING_SPEED)
        self._far_damping = FAR_DAMPING
        self._period = settings.period_s
        self._ahead = 1.0 / (1.0 + POSITION_GAIN * settings.period_s)  # the error decays as it will be, not as it is
        limits = settings.joints
        self._lower, self._upper = np.array(limits.lower) + MARGIN, np.array(limits.upper) - MARGIN
        self._velocity = np.array(limits.velocity)
        self._jerk = np.array(limits.jerk)
        self._gain = approach_gain(limits)
        self._posture = np.array(settings.arm.posture)
        acceleration = np.array(limits.acceleration)
        self._scale = (acceleration / acceleration.max()) ** SPARING
        self._limits = (
            PLANNED_SHARE[:, None] * np.array([limits.velocity, limits.acceleration, limits.jerk]) / self._scale
        )
        self._most = TOOL_SHARE * settings.tool.max_speed

    def pose(self, q: Vector) -> tuple[Vector, Vector]:
        """Position (3,) [m] and rotation (3, 3) of the tool in frame base, at joints q (J,)."""
        pin.forwardKinematics(self._model, self._data, q)
        placement = pin.updateFramePlacement(self._model, self._data, self._tool)
        return placement.translation.copy(), placement.rotation.copy()

    def velocity(self, q: Vector, dq: Vector) -> Vector:
        """Velocity of the tool (3,) [m/s] in frame base, at joints q (J,) [rad] and dq (J,)
        [rad/s].
        """
        linear: Vector = self._jacobian(q)[:3] @ dq
        return linear

    def at(self, q: Vector) -> Kinematics:
        """The arm at joints q (J,) [rad]."""
        q = np.minimum(np.maximum(q, -1e3), 1e3)
        jacobian = self._jacobian(q)
        placement = pin.updateFramePlacement(self._model, self._data, self._tool)
        rotation = placement.rotation.copy()
        across = DIRECTION_LEVER * rotation[:, :2].T
        tasks = np.concatenate((jacobian[:3], across @ jacobian[3:]))
        return Kinematics(q, placement.translation.copy(), rotation, across, tasks, _damping(jacobian[:3]))

    def costs(self, here: Kinematics) -> Vector:
        """What a tool velocity, acceleration and jerk cost of each joint's limit, 1 for all of it.

        (3, 3, J): by order of the derivative, then by axis. The tool's direction is kept.
        """
        out = np.empty((3, 3, len(here.joints)))
        _joint_costs(here.tasks * self._scale, here.damping, self._limits, out)
        return out

    def speeds(self, here: Kinematics, dq: Vector, ddq: Vector) -> tuple[float, float]:
        """Speed of the tool [m/s] at joint velocities and accelerations (J,) [rad/s, rad/s²]; and
        the most it comes to as these accelerations are brought to 0.
        """
        found: tuple[float, float] = _speeds(here.tasks, dq, ddq, self._jerk)
        return found

    def step(
        self, q: Vector, position: Vector, velocity: Vector, direction: Vector, here: Kinematics | None = None
    ) -> Solution:
        """Joint velocities that bring the tool to `position` (3,) [m] one period later, at
        `velocity` (3,) [m/s].

        The tool's +z turns to `direction` (3,), at any angle about it. Position goes before
        direction, both before the posture. `here` is the arm at q, where that is known. Never
        raises nor returns NaN for finite arguments.
        """
        here = self.at(q) if here is None else here
        q = here.joints
        linear = np.minimum(np.maximum(velocity, -10.0), 10.0)
        error = np.minimum(np.maximum(position - here.position, -10.0), 10.0) - self._period * linear
        closing = self._approach(error)
        _add_closing(linear, self._ahead * closing, self._most)
        wanted = np.concatenate((linear, here.across @ _turn(here.rotation[:, 2], direction)))
        posture = np.minimum(np.maximum(POSTURE_GAIN * (self._posture - q), -POSTURE_SPEED), POSTURE_SPEED)
        fastest = self._gain * np.maximum(self._upper - q, 0.0)
        slowest = self._gain * np.minimum(self._lower - q, 0.0)
        damping = here.damping + self._far_damping * max(math.hypot(*closing) - FAR_SPEED, 0.0) ** 2
        scale = self._scale
        bounds = (slowest / scale, fastest / scale)
        result = scale * _least_squares(here.tasks * scale, wanted, posture / scale, damping, bounds)
        excess = float((np.abs(result) / self._velocity).max())
        if excess > 1.0:
            result /= excess
        if not math.isfinite(excess):
            result = np.zeros(len(q))
        near = bool((np.minimum(self._upper - q, q - self._lower) < NEAR_LIMIT).any())
        result = result.round(DECIMALS)
        result.setflags(write=False)
        return Solution(result, excess > 1.0, near)

    def _jacobian(self, q: Vector) -> Vector:
        """The tool's Jacobian (6, J) in frame base, linear rows first; leaves the placements in
        `_data`.
        """
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian: Vector = pin.computeFrameJacobian(self._model, self._data, q, self._tool, axes)
        return jacobian

    def _approach(self, error: Vector) -> Vector:
        """Velocity (3,) [m/s] that closes an error (3,) [m]: in proportion when near, braking
        evenly from afar.
        """
        distance = math.hypot(*error)
        near = self._braking / POSITION_GAIN**2
        if distance <= near:
            return POSITION_GAIN * error
        speed = min(math.sqrt(2.0 * self._braking * (distance - 0.5 * near)), self._closing_speed)
        return error * (speed / distance)


def _chain(model: pin.Model, names: tuple[str, ...]) -> pin.Model:
    """The model with the named joints only, the others locked at 0."""
    locked = [model.getJointId(name) for name in model.names[1:] if name not in names]
    return pin.buildReducedModel(model, locked, pin.neutral(model)) if locked else model


def _turn(axis: Vector, direction: Vector) -> Vector:
    """Angular velocity (3,) [rad/s] that turns the tool's axis toward a direction; 0 if that has no
    length.
    """
    ax, ay, az = axis.tolist()
    dx, dy, dz = direction.tolist()
    largest = max(abs(dx), abs(dy), abs(dz))
    if not 0.0 < largest < math.inf:
        return np.zeros(3)
    dx, dy, dz = dx / largest, dy / largest, dz / largest
    turn = (ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx)
    sine, cosine = math.hypot(*turn), ax * dx + ay * dy + az * dz
    if sine < 1e-9 * math.hypot(dx, dy, dz):
        return np.zeros(3)  # there already, or exactly opposite, where no way is nearer
    speed = min(DIRECTION_GAIN * math.atan2(sine, cosine), DIRECTION_SPEED)
    return np.array(turn) * (speed / sine)


def _damping(linear: Vector) -> float:
    """Damping [m²]: small, and growing smoothly where the tool's position becomes singular."""
    (a, b, c), (_, d, e), (_, _, f) = (linear @ linear.T).tolist()
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    shortage = max(1.0 - math.sqrt(max(determinant, 0.0)) / SINGULAR_VOLUME, 0.0)
    return DAMPING + SINGULAR_DAMPING * shortage * shortage


def _least_squares(
    tasks: Vector, wanted: Vector, posture: Vector, damping: float, bounds: tuple[Vector, Vector]
) -> Vector:
    """The x (J,) in the bounds with least |tasks x - wanted|² + damping |x - posture|², by an
    active-set method.
    """
    slowest, fastest = bounds
    result = _solve(tasks, wanted, posture, damping)
    inside = (result >= slowest) & (result <= fastest)
    if inside.all():
        return result
    result = np.minimum(np.maximum(result, slowest), fastest)
    free = inside
    for _ in range(BOUND_ROUNDS):
        held = np.where(free, 0.0, result)
        best = np.where(free, _solve(tasks * free, wanted - tasks @ held, posture, damping), result)
        step = best - result
        room = np.where(step > 0.0, fastest, slowest) - result
        fraction = np.divide(room, step, out=np.full(len(step), np.inf), where=step != 0.0)
        blocked = int(fraction.argmin())
        if fraction[blocked] < 1.0:
            result = np.minimum(np.maximum(result + fraction[blocked] * step, slowest), fastest)
            free[blocked] = False
            continue
        result = best
        slope = tasks.T @ (tasks @ result - wanted) + damping * (result - posture)
        gain = np.where(free | (fastest <= slowest), 0.0, np.where(result >= fastest, slope, -slope))
        leaving = int(gain.argmax())  # the bound whose inside is better by most
        if gain[leaving] <= 1e-12:
            break
        free[leaving] = True
    return result


def _solve(tasks: Vector, wanted: Vector, posture: Vector, damping: float) -> Vector:
    """The x (J,) with least |tasks x - wanted|² + damping |x - posture|², by its dual of five
    equations.
    """
    square = tasks @ tasks.T
    square.flat[::6] += damping
    _, weights, _ = dposv(square, wanted - tasks @ posture)
    x: Vector = posture + tasks.T @ weights
    return x


def slow_down(gap: Vector, velocity: Vector) -> float:
    """Share of its speed for a setpoint that is `gap` (3,) [m] ahead of the tool; 1 where it comes
    back.
    """
    if float(gap @ velocity) <= 0.0:
        return 1.0
    return 1.0 / (1.0 + max(0.0, math.hypot(*gap) - GAP_FREE) / GAP_SLOW)


@compiled
def _speeds(tasks: Vector, dq: Vector, ddq: Vector, jerk: Vector) -> tuple[float, float]:
    """Speed now, and the greater of it and that of the crest, when the accelerations are 0."""
    now = crest = 0.0
    for axis in range(3):
        v = v_crest = 0.0
        for joint in range(len(dq)):
            v += tasks[axis, joint] * dq[joint]
            gained = ddq[joint] * abs(ddq[joint]) / (2.0 * jerk[joint])
            v_crest += tasks[axis, joint] * (dq[joint] + gained)
        now += v * v
        crest += v_crest * v_crest
    return math.sqrt(now), math.sqrt(max(now, crest))


@compiled
def _add_closing(forward: Vector, closing: Vector, most: float) -> None:
    """Adds to a forward speed (3,) [m/s] as much of a closing speed as keeps the sum at most
    `most`.
    """
    ff = fc = cc = 0.0
    for i in range(3):
        ff += forward[i] * forward[i]
        fc += forward[i] * closing[i]
        cc += closing[i] * closing[i]
    if ff > most * most:
        shrink = most / math.sqrt(ff)
        for i in range(3):
            forward[i] *= shrink
        ff *= shrink * shrink
        fc *= shrink
    share = 1.0
    if ff + 2.0 * fc + cc > most * most:
        share = (-fc + math.sqrt(max(fc * fc + cc * (most * most - ff), 0.0))) / cc
    for i in range(3):
        forward[i] += min(max(share, 0.0), 1.0) * closing[i]


@compiled
def _joint_costs(tasks: Vector, damping: float, limits: Vector, out: Vector) -> None:
    """Into out (3, 3, J): joint speeds per tool velocity, by damped least squares, as shares of
    limits (3, J).
    """
    joints = tasks.shape[1]
    root, right = np.empty((5, 5)), np.zeros((5, 3))
    for i in range(5):
        for j in range(i + 1):
            total = damping if i == j else 0.0
            for k in range(joints):
                total += tasks[i, k] * tasks[j, k]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = math.sqrt(max(total, 1e-12)) if i == j else total / root[j, j]
    for axis in range(3):
        right[axis, axis] = 1.0
        for i in range(5):
            for k in range(i):
                right[i, axis] -= root[i, k] * right[k, axis]
            right[i, axis] /= root[i, i]
        for i in range(4, -1, -1):
            for k in range(i + 1, 5):
                right[i, axis] -= root[k, i] * right[k, axis]
            right[i, axis] /= root[i, i]
    for joint in range(joints):
        for axis in range(3):
            speed = 0.0
            for i in range(5):
                speed += tasks[i, joint] * right[i, axis]
            for order in range(3):
                out[order, axis, joint] = speed / limits[order, joint]
