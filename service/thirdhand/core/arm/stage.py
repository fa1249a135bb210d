"""The arm: kinematics of the tool, and the joint velocities that move it to the setpoint."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from kmp.elementary import exp, log
from thirdhand.core.arm.step import NEAR, SEPARATED, SPEED, describe, follow, joint_step, stand
from thirdhand.core.frame import RECORDS, Record, Vector, as_array, parameters, shared_dtype
from thirdhand.core.joint_limits import LIMIT_MARGIN_RAD, acceleration_rate, approach_gain
from thirdhand.core.kinematics import Kinematics, joint_costs
from thirdhand.core.numerics import ROTATION_DECIMALS
from thirdhand.core.separation.stage import Separation
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.settings.config import Reach, Settings
from thirdhand.settings.urdf import Urdf

AXES = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED  # of the tool's Jacobian: frame base, at the tool


class Solution(NamedTuple):
    """Joint velocities (J,) [rad/s] and accelerations (J,) [rad/s²] that follow the setpoint.

    `speed_limited`: the velocities were scaled down to the speed limits. `near_limit`: a joint is
    within 0.1 rad of a position limit. `separated`: separation changed the velocities.
    """

    velocity: Vector
    acceleration: Vector
    speed_limited: bool
    near_limit: bool
    separated: bool


class ArmStage:
    """The arm that a URDF describes, with a tool on its plate.

    It has no state: every result depends on the arguments only. J joints, in the order of the
    settings; all other joints of the description stay at 0.
    """

    def __init__(self, settings: Settings, urdf: str, *, tuning: Tuning = TUNING) -> None:
        numbers = tuning.arm
        self._model = pin.buildModelFromXML(Urdf(urdf).kinematics(settings.joints.names))
        plate = self._model.frames[self._model.getBodyId(settings.arm.plate)]
        x, y, z, *quaternion = settings.tool.plate_from_tool
        unit = np.array(quaternion) / math.sqrt(sum(v * v for v in quaternion))
        plate_from_tool = pin.SE3(pin.Quaternion(unit), np.array([x, y, z]))
        tool = pin.Frame(
            "thirdhand tool",
            plate.parentJoint,
            plate.placement * plate_from_tool,
            pin.FrameType.OP_FRAME,
        )
        self._tool = self._model.addFrame(tool)

        # the same bits on every processor
        for placement in (
            *self._model.jointPlacements,
            *(frame.placement for frame in self._model.frames),
        ):
            placement.rotation = np.round(placement.rotation, ROTATION_DECIMALS)

        # joints whose configuration is a cosine and a sine: those without limits
        self._turns = np.array([joint.nq == 2 for joint in self._model.joints])[1:]
        self._data = self._model.createData()

        top = settings.tool.max_speed
        limits = settings.joints
        size = settings.reach.outer / Reach().outer  # of the arm, relative to the WAM
        closing_speed = float(min(top, numbers.closing_speed_mps))
        joints = len(limits.names)
        acceleration = np.array(limits.acceleration)
        # weights of the joints, with a geometric mean of 1; and shares of motion, with a mean of 1
        scale = acceleration**numbers.sparing_power
        scale /= exp(sum(log(float(factor)) for factor in scale) / len(scale))
        self._jerk = np.array(limits.jerk)
        spared = np.array([limits.velocity, limits.acceleration, limits.jerk], np.float64)
        spared /= spared.mean(axis=1, keepdims=True)
        gain = min(
            numbers.position_gain_per_s,
            numbers.position_gain_rate_share * acceleration_rate(limits),
        )

        self.parameters = parameters(
            period_s=settings.period_s,
            closing_braking=numbers.closing_brake_share * settings.tool.stop_acceleration,
            closing_speed=closing_speed,
            far_damping=numbers.far_damping_s2,
            far_speed=0.5 * closing_speed,
            constrained_speed=2.0 * tuning.separation.slip_speed_mps,
            max_tool_speed=numbers.tool_speed_share * top,
            max_turn_speed=float(settings.tool.max_turn_speed),
            position_gain=gain,
            turn_gain=numbers.turn_gain_share * gain,
            turn_lever=numbers.turn_lever_m * size,
            damping=numbers.damping_m2 * size**2,
            singular_damping=numbers.singular_damping_m2 * size**2,
            singular_volume=math.sqrt(numbers.singular_damping_m2) * size * settings.reach.outer**2,
            near_limit_rad=float(settings.arm.fault_error_rad),
            horizon_s=numbers.turn_horizon_s,
            posture_gain=numbers.turn_gain_share * numbers.position_gain_per_s / 10.0,
            posture_speed=numbers.closing_speed_mps,  # [rad/s] on a lever of 1 m
            # Idle motion may end faster than the tool closes in: the tool does not show it.
            idle_brake_share=2.5 * numbers.closing_brake_share,
            lower=np.array(limits.lower) + LIMIT_MARGIN_RAD,
            upper=np.array(limits.upper) - LIMIT_MARGIN_RAD,
            approach_gain=approach_gain(limits),
            max_velocity=np.array(limits.velocity, np.float64),
            acceleration=acceleration,
            posture=np.array(settings.arm.posture, np.float64),
            is_continuous=np.array([int(kind == "continuous") for kind in limits.every_kind]),
            per_rad=np.array(limits.per_rad),
            scale=scale,
            spared=spared,
            planned_limits=np.array(numbers.planned_limit_shares)[:, None]
            * np.array([limits.velocity, limits.acceleration, limits.jerk])
            / spared,
        )
        self._engaging = self.parameters.copy()
        self._engaging["max_tool_speed"] = numbers.tool_speed_share * settings.tool.engaging_speed

        tasks = 6 if settings.tool.orientation == "full" else 5
        self._kinematics = shared_dtype(
            [
                ("joints", np.float64, (joints,)),
                ("configuration", np.float64, (self._model.nq,)),
                ("position", np.float64, (3,)),
                ("rotation", np.float64, (3, 3)),
                ("tasks", np.float64, (tasks, joints)),
                ("damping", np.float64),
                ("jacobian", np.float64, (6, joints)),
            ]
        )
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
        """Kinematics of the arm at joints q (J,) [rad, m]."""
        kinematics = RECORDS(1, self._kinematics, bytearray(self._kinematics.itemsize))
        stand(kinematics, self._turns, q)
        jacobian = pin.computeFrameJacobian(
            self._model, self._data, kinematics["configuration"][0], self._tool, AXES
        )
        placement = pin.updateFramePlacement(self._model, self._data, self._tool)
        describe(self.parameters, kinematics, jacobian, placement.homogeneous)
        return Kinematics(kinematics)

    def costs(self, here: Kinematics) -> Vector:
        """Share of each joint's planned limit per unit of tool velocity, acceleration and jerk.

        (3, 3, J): by order of the derivative, then by axis. See `joint_costs`.
        """
        out = np.empty((3, 3, len(self._jerk)))
        joint_costs(self.parameters, here.record, out)
        return out

    def follow(self, state: Record, here: Kinematics, separation: Separation) -> Solution:
        """Joint velocities that move the tool to the state's setpoint; see `step`. While the
        setpoint engages, its lower speed limit holds here too.
        """
        out = np.empty((2, len(self._jerk)))
        constraints = separation.constraints
        count = separation.count
        states = as_array(state)
        limits = self._engaging if states["engaging"][0] else self.parameters
        return _solution(
            out, follow(limits, here.record, states, self._goal, constraints, count, out)
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
        """Joint velocities that move the tool to `position` (3,) [m] in one period.

        It then moves at `velocity` (3,) [m/s]. The tool also turns to `orientation` (4,), which
        itself turns at `turning` (3,) [rad/s]. If the settings say so, it turns only its +z there,
        at any angle about it. The constraints of `separation`, which must be those of joints q,
        have the highest priority; then position, orientation, posture. If joints that move at
        `moving` (J,) [rad/s] cannot reach the velocities for both position and orientation soon,
        the turn is delayed.

        Never raises, and never returns NaN for finite arguments.
        """
        goal = self._goal[0]
        out = np.empty((2, len(self._jerk)))
        goal["position"] = position
        goal["velocity"] = velocity
        goal["orientation"] = orientation
        goal["turning"] = 0.0 if turning is None else turning
        goal["acceleration"] = 0.0
        goal["moving"] = 0.0 if moving is None else moving
        goal["horizon_s"] = math.inf if moving is None else self.parameters["horizon_s"][0]
        constraints, count = (
            (self._unseparated, 0)
            if separation is None
            else (separation.constraints, separation.count)
        )
        return _solution(
            out, joint_step(self.parameters, self.at(q).record, self._goal, constraints, count, out)
        )


def _solution(motion: Vector, flags: int) -> Solution:
    """Solution of velocities and accelerations (2, J), made read-only, and the flags of a step."""
    motion.setflags(write=False)
    return Solution(
        motion[0], motion[1], bool(flags & SPEED), bool(flags & NEAR), bool(flags & SEPARATED)
    )
