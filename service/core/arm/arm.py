"""The arm's kinematics: where the tool is, which targets it can reach, and the joint velocities
that bring it there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from service.config import JointSettings, Settings
from service.core.arm.inverse_kinematics import NEAR, SEPARATED, SPEED, describe, follow, joint_costs, joint_step
from service.core.arm.inverse_kinematics import tool_speeds as _tool_speeds
from service.core.frame import Record, Records, Vector, as_array, parameters, structured
from service.core.separation.separation import Separation
from service.urdf import Urdf

REACH_M = 0.88  # of the WAM, on which the next four were chosen; they are scaled by the arm's own
TURN_LEVER = 0.0115  # [m] 1 rad/s counts as this many m/s of the tool: position goes first, the posture last
DAMPING = 1e-5  # [m²] a joint at 1 rad/s costs as much as sqrt(DAMPING) m/s of error
SINGULAR_DAMPING = 2e-3  # [m²] more at a singular posture
SINGULAR_VOLUME = 0.04  # [m³] manipulability below which damping grows; 0.06 to 0.13 over the WAM's table

POSITION_GAIN, TURN_GAIN = 50.0, 10.0  # [1/s] of small errors' decay; at most ...
POSITION_GAIN_SHARE, TURN_GAIN_SHARE = 2.0, 0.4  # ... these of `acceleration_rate`, or joints swing about the target
CLOSING_SPEED = 0.3  # [m/s] at most, of a large error's
CLOSING_BRAKES = 0.1  # of the tool's acceleration in a stop; with more, joints at their jerk limit swing about it
FAR_DAMPING = 4.0  # [s²] more, times the square of the closing speed above FAR_SPEED: steady at unreachable targets
# [m/s] of the tool that constraints take away, at which half of SINGULAR_DAMPING is added. Where
# several of them leave few directions free, the least motion would else change the solution much.
KEPT_SPEED = 0.02
HORIZON_S = 0.008  # for reaching the joint velocities that an orientation step needs; else it is scaled down
SPARING = 0.8  # power of a joint's acceleration limit by which its speed is weighed: slow ones are spared
TOOL_SHARE = 0.985  # of the tool's greatest speed, for closing and forward speed together
# Of the joints' speed, acceleration and jerk that a plan may use: closing in needs the rest.
PLANNED_SHARE = np.array([0.97, 0.95, 0.85])

FARTHEST_RAD = 1e4  # beyond it a joint is not calculated with
MARGIN = 1e-6  # [rad] kept from the position limits, so that rounding along a stop (< 1e-7 rad) does not pass them


class Solution(NamedTuple):
    """Joint velocities (J,) [rad/s], and the accelerations (J,) [rad/s²] with which they change as
    the tool's does.

    Whether they were scaled down to the speed limits; whether a joint is within 0.1 rad of a
    position limit; whether something is so near that they are others for it.
    """

    velocity: Vector
    acceleration: Vector
    speed_limited: bool
    near_limit: bool
    separated: bool


class Closing(NamedTuple):
    """How the tool closes in on a position that is far: braking [m/s²], greatest speed [m/s], and
    the damping [s²] by which it is steady at unreachable ones.
    """

    braking: float
    speed: float
    far_damping: float


class Kinematics:
    """The arm at some joints, as one record (1,), see `Arm.at`."""

    __slots__ = ("record",)

    def __init__(self, record: Records) -> None:
        self.record = record

    @property
    def joints(self) -> Vector:
        """(J,) [rad]."""
        return self.record["joints"][0]  # type: ignore[no-any-return]

    @property
    def position(self) -> Vector:
        """The tool's (3,) [m], frame base."""
        return self.record["position"][0]  # type: ignore[no-any-return]

    @property
    def rotation(self) -> Vector:
        """The tool's (3, 3), frame base."""
        return self.record["rotation"][0]  # type: ignore[no-any-return]

    @property
    def tasks(self) -> Vector:
        """(5 or 6, J): the tool's velocity by the joints', and what turns it, in its own axes,
        times the turn lever [m].
        """
        return self.record["tasks"][0]  # type: ignore[no-any-return]

    @property
    def damping(self) -> float:
        """Of the tasks [m²]."""
        return float(self.record["damping"][0])

    @property
    def jacobian(self) -> Vector:
        """The tool's (6, J), velocity before turning, frame base."""
        return self.record["jacobian"][0]  # type: ignore[no-any-return]


class Arm:
    """The arm that a URDF describes, with a tool on its plate.

    Stateless: every answer follows from the arguments.

    J joints, in the order of the settings; all others of the description stay at 0.
    """

    def __init__(self, settings: Settings, urdf: str, closing: Closing | None = None) -> None:
        self._model = pin.buildModelFromXML(Urdf(urdf).kinematics(settings.joints.names))
        plate = self._model.frames[self._model.getBodyId(settings.arm.plate)]
        x, y, z, *quaternion = settings.tool.plate_from_tool
        unit = np.array(quaternion) / math.hypot(*quaternion)
        plate_from_tool = pin.SE3(pin.Quaternion(unit), np.array([x, y, z]))
        tool = pin.Frame("thirdhand tool", plate.parentJoint, plate.placement * plate_from_tool, pin.FrameType.OP_FRAME)
        self._tool = self._model.addFrame(tool)
        self._data = self._model.createData()
        top, limits, size = settings.tool.max_speed, settings.joints, settings.reach.outer / REACH_M
        closing = closing or Closing(
            CLOSING_BRAKES * settings.tool.stop_acceleration, min(top, CLOSING_SPEED), FAR_DAMPING
        )
        joints, acceleration = len(limits.names), np.array(limits.acceleration)
        scale = acceleration**SPARING
        scale /= np.exp(np.log(scale).mean())
        self._jerk = np.array(limits.jerk)
        spared = np.array([limits.velocity, limits.acceleration, limits.jerk], np.float64)
        spared /= spared.mean(axis=1, keepdims=True)
        rate = acceleration_rate(limits)
        self.parameters = parameters(
            period_s=settings.period_s,
            closing_braking=closing.braking,
            closing_speed=float(closing.speed),
            far_damping=closing.far_damping,
            kept_speed=KEPT_SPEED,
            max_tool_speed=TOOL_SHARE * top,
            max_turn_speed=float(settings.tool.max_turn_speed),
            position_gain=min(POSITION_GAIN, POSITION_GAIN_SHARE * rate),
            turn_gain=min(TURN_GAIN, TURN_GAIN_SHARE * rate),
            turn_lever=TURN_LEVER * size,
            damping=DAMPING * size**2,
            singular_damping=SINGULAR_DAMPING * size**2,
            singular_volume=SINGULAR_VOLUME * size**3,
            horizon_s=HORIZON_S,
            lower=np.array(limits.lower) + MARGIN,
            upper=np.array(limits.upper) - MARGIN,
            approach_gain=approach_gain(limits),
            max_velocity=np.array(limits.velocity, np.float64),
            acceleration=acceleration,
            posture=np.array(settings.arm.posture, np.float64),
            is_continuous=np.array([int(kind == "continuous") for kind in limits.every_kind]),
            per_rad=np.array(limits.per_rad),
            scale=scale,
            spared=spared,
            planned_limits=PLANNED_SHARE[:, None]
            * np.array([limits.velocity, limits.acceleration, limits.jerk])
            / spared,
        )
        tasks = 6 if settings.tool.orientation == "full" else 5
        self._kinematics = np.dtype(
            [
                ("joints", np.float64, (joints,)),
                ("position", np.float64, (3,)),
                ("rotation", np.float64, (3, 3)),
                ("tasks", np.float64, (tasks, joints)),
                ("damping", np.float64),
                ("jacobian", np.float64, (6, joints)),
            ]
        )
        self._blank = structured(1, self._kinematics)
        self._goal = parameters(
            position=np.zeros(3),
            velocity=np.zeros(3),
            acceleration=np.zeros(3),
            orientation=np.zeros(4),
            turning=np.zeros(3),
            moving=np.zeros(joints),
            horizon_s=0.0,
        )
        self._unseparated = Separation.constraints_for(joints, 0)

    def at(self, q: Vector) -> Kinematics:
        """The arm at joints q (J,) [rad, m]."""
        q = np.minimum(np.maximum(q, -FARTHEST_RAD), FARTHEST_RAD)
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian = pin.computeFrameJacobian(self._model, self._data, q, self._tool, axes)
        placement = pin.updateFramePlacement(self._model, self._data, self._tool)
        here = self._blank.copy()
        here["joints"][0], here["position"][0] = q, placement.translation
        describe(self.parameters, here, np.ascontiguousarray(jacobian), placement.rotation.copy())
        return Kinematics(here)

    def costs(self, here: Kinematics) -> Vector:
        """What a tool velocity, acceleration and jerk cost of each joint's limit, 1 for all of it.

        (3, 3, J): by order of the derivative, then by axis. The tool turns where it spares joints.
        """
        out = np.empty((3, 3, len(self._jerk)))
        joint_costs(self.parameters, here.record, out)
        return out

    def speeds(self, here: Kinematics, dq: Vector, ddq: Vector) -> tuple[float, float]:
        """Speed of the tool [m/s] at joint velocities and accelerations (J,) [rad/s, rad/s²]; and
        the most it comes to as these accelerations are brought to 0.
        """
        now, crest, _ = _tool_speeds(here.record, dq, ddq, self._jerk)
        return now, crest

    def follow(self, state: Record, here: Kinematics, separation: Separation) -> Solution:
        """Joint velocities that bring the tool to the state's setpoint, as `step` says."""
        out = np.empty((2, len(self._jerk)))
        constraints, count = separation.constraints, separation.count
        return _solution(
            out, follow(self.parameters, here.record, as_array(state), self._goal, constraints, count, out)
        )

    def step(
        self,
        q: Vector,
        position: Vector,
        velocity: Vector,
        orientation: Vector,
        turning: Vector | None = None,
        *,
        moving: Vector | None = None,
        separation: Separation | None = None,
    ) -> Solution:
        """Joint velocities that bring the tool to `position` (3,) [m] one period later, at
        `velocity` (3,) [m/s].

        The tool turns to `orientation` (4,), which turns at `turning` (3,) [rad/s]: all of it or,
        as the settings say, its +z only, at any angle about it. Position goes before orientation,
        both before the posture; where joints that are `moving` (J,) [rad/s] cannot have both at
        once, it turns later. `separation` was updated there and goes before all. Never raises nor
        returns NaN for finite arguments.
        """
        goal, out = self._goal[0], np.empty((2, len(self._jerk)))
        goal["position"], goal["velocity"], goal["orientation"] = position, velocity, orientation
        goal["turning"], goal["acceleration"] = 0.0 if turning is None else turning, 0.0
        goal["moving"] = 0.0 if moving is None else moving
        goal["horizon_s"] = math.inf if moving is None else HORIZON_S
        constraints, count = (
            (self._unseparated, 0) if separation is None else (separation.constraints, separation.count)
        )
        return _solution(out, joint_step(self.parameters, self.at(q).record, self._goal, constraints, count, out))


def _solution(found: Vector, flags: int) -> Solution:
    found.setflags(write=False)
    return Solution(found[0], found[1], bool(flags & SPEED), bool(flags & NEAR), bool(flags & SEPARATED))


def acceleration_rate(limits: JointSettings) -> float:
    """Jerk by acceleration [1/s] of the joint that changes its acceleration most slowly."""
    return float((np.array(limits.jerk) / np.array(limits.acceleration)).min())


def approach_gain(limits: JointSettings) -> Vector:
    """Greatest speed toward a position limit per distance to it, (J,) [1/s].

    Braking along it takes at most half of the acceleration and a quarter of the jerk.
    """
    velocity = np.array(limits.velocity)
    gain: Vector = 0.5 * np.minimum(np.array(limits.acceleration) / velocity, np.sqrt(np.array(limits.jerk) / velocity))
    return gain
