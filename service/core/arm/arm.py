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

from service.config import Settings
from service.core.arm.inverse_kinematics import APART, NEAR, SPEED, joint_costs, joint_step, tool_speeds, tool_tasks
from service.core.frame import Vector
from service.core.limiter.limiter import MARGIN, approach_gain
from service.core.separation.separation import Separation

# As those of `inverse_kinematics` chosen on the WAM, and tried on a Panda and a UR5.
CLOSING_SPEED = 0.3  # [m/s] at most, of a large one's
CLOSING_BRAKES = 0.1  # of the tool's acceleration; with more, joints at their jerk limit swing about the target
FAR_DAMPING = 4.0  # [s²] more, times the square of the closing speed above FAR_SPEED: steady at unreachable targets
SOON_S = 0.02  # in which joints have to come to what turns the tool, or it turns less
SPARING = 0.2  # power of a joint's acceleration limit by which its speed is weighed: slow ones are spared
TOOL_SHARE = 0.985  # of the tool's greatest speed, for closing and forward speed together
# Of the joints' speed, acceleration and jerk that a plan may use: turning the tool needs the rest.
PLANNED_SHARE = np.array([0.96, 0.9, 0.7])


class Solution(NamedTuple):
    """Joint velocities (J,) [rad/s].

    Whether they were scaled down to the speed limits; whether a joint is within 0.1 rad of a
    position limit; whether something is so near that they are others for it.
    """

    velocity: Vector
    speed_limited: bool
    near_limit: bool
    apart: bool


class Closing(NamedTuple):
    """How the tool closes in on a position that is far: braking [m/s²], greatest speed [m/s], and
    the damping [s²] by which it is steady at unreachable ones.
    """

    braking: float
    speed: float
    far_damping: float


class Kinematics(NamedTuple):
    """The arm at some joints: the tool's position (3,) [m] and rotation (3, 3) in frame base.

    The tasks (5 or 6, J): the tool's velocity by the joints', and what turns it, in its own axes,
    times TURN_LEVER; their damping [m²]. The tool's Jacobian (6, J), velocity before turning.
    """

    joints: Vector
    position: Vector
    rotation: Vector
    tasks: Vector
    damping: float
    jacobian: Vector


class Arm:
    """The arm that a URDF describes, with a tool on its plate.

    Stateless: every answer follows from the arguments.

    J joints, in the order of the settings; all others of the description stay at 0.
    """

    def __init__(self, settings: Settings, urdf: str, closing: Closing | None = None) -> None:
        self._model = _chain(pin.buildModelFromXML(urdf), settings.joints.names)
        plate = self._model.frames[self._model.getFrameId(settings.arm.plate)]
        x, y, z, *quaternion = settings.tool.plate_from_tool
        unit = np.array(quaternion) / math.hypot(*quaternion)
        plate_from_tool = pin.SE3(pin.Quaternion(unit), np.array([x, y, z]))
        tool = pin.Frame("thirdhand tool", plate.parentJoint, plate.placement * plate_from_tool, pin.FrameType.OP_FRAME)
        self._tool = self._model.addFrame(tool)
        self._data = self._model.createData()
        max_speed, max_acceleration = settings.tool.max_speed, settings.tool.max_acceleration
        closing = closing or Closing(CLOSING_BRAKES * max_acceleration, min(max_speed, CLOSING_SPEED), FAR_DAMPING)
        self._tasks = 6 if settings.tool.orientation == "full" else 5
        turn = settings.tool.max_turn_speed
        self._closing = np.array([settings.period_s, *closing, TOOL_SHARE * max_speed, turn])
        limits = settings.joints
        self._within = np.array([np.array(limits.lower) + MARGIN, np.array(limits.upper) - MARGIN])
        self._velocity = np.array(limits.velocity)
        self._still = np.zeros(3)
        self._nothing, self._none = np.empty((0, len(limits.velocity))), np.empty(0)
        self._jerk = np.array(limits.jerk)
        self._gain = approach_gain(limits)
        self._posture = np.array(settings.arm.posture)
        acceleration = np.array(limits.acceleration)
        self._at_rest = np.zeros(len(acceleration))
        self._change, self._any_change = SOON_S * acceleration, np.full(len(acceleration), np.inf)
        self._scale = (acceleration / acceleration.max()) ** SPARING
        self._limits = (
            PLANNED_SHARE[:, None] * np.array([limits.velocity, limits.acceleration, limits.jerk]) / self._scale
        )

    def at(self, q: Vector) -> Kinematics:
        """The arm at joints q (J,) [rad]."""
        q = np.minimum(np.maximum(q, -1e3), 1e3)
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian = pin.computeFrameJacobian(self._model, self._data, q, self._tool, axes)
        placement = pin.updateFramePlacement(self._model, self._data, self._tool)
        rotation, tasks = placement.rotation.copy(), np.empty((self._tasks, len(q)))
        jacobian = np.ascontiguousarray(jacobian)
        damping = tool_tasks(jacobian, rotation, tasks)
        return Kinematics(q, placement.translation.copy(), rotation, tasks, damping, jacobian)

    def costs(self, here: Kinematics) -> Vector:
        """What a tool velocity, acceleration and jerk cost of each joint's limit, 1 for all of it.

        (3, 3, J): by order of the derivative, then by axis. The tool does not turn.
        """
        out = np.empty((3, 3, len(here.joints)))
        joint_costs(here.tasks * self._scale, here.damping, self._limits, out)
        return out

    def speeds(self, here: Kinematics, dq: Vector, ddq: Vector) -> tuple[float, float]:
        """Speed of the tool [m/s] at joint velocities and accelerations (J,) [rad/s, rad/s²]; and
        the most it comes to as these accelerations are brought to 0.
        """
        found: tuple[float, float] = tool_speeds(here.tasks, dq, ddq, self._jerk)
        return found

    def step(
        self,
        q: Vector,
        position: Vector,
        velocity: Vector,
        orientation: Vector,
        turning: Vector | None = None,
        *,
        moving: Vector | None = None,
        here: Kinematics | None = None,
        apart: Separation | None = None,
    ) -> Solution:
        """Joint velocities that bring the tool to `position` (3,) [m] one period later, at
        `velocity` (3,) [m/s].

        The tool turns to `orientation` (4,), which turns at `turning` (3,) [rad/s]: all of it or,
        as the settings say, its +z only, at any angle about it. Position goes before orientation,
        both before the posture; where joints that are `moving` (J,) [rad/s] cannot have both at
        once, it turns later. `here` is the arm at q, where that is known; `apart` has
        looked at it and says what goes before all. Never raises nor returns NaN for finite
        arguments.
        """
        here = self.at(q) if here is None else here
        out = np.empty(len(here.joints))
        said = joint_step(
            here.joints,
            here.position,
            here.rotation,
            here.tasks,
            here.damping,
            position,
            velocity,
            orientation,
            self._still if turning is None else turning,
            self._posture,
            self._within,
            self._gain,
            self._scale,
            self._at_rest if moving is None else moving,
            self._velocity,
            self._any_change if moving is None else self._change,
            self._closing,
            self._nothing if apart is None else apart.rows,
            self._none if apart is None else apart.plan,
            0 if apart is None else apart.count,
            out,
        )
        out.setflags(write=False)
        return Solution(out, bool(said & SPEED), bool(said & NEAR), bool(said & APART))


def _chain(model: pin.Model, names: tuple[str, ...]) -> pin.Model:
    """The model with the named joints only, the others locked at 0."""
    locked = [model.getJointId(name) for name in model.names[1:] if name not in names]
    return pin.buildReducedModel(model, locked, pin.neutral(model)) if locked else model
