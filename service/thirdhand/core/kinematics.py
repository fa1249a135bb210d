"""Kinematics of the arm at some joints: the tool's pose, and its motion as the joints move."""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.arm.least_squares import factorise, substitute
from thirdhand.core.frame import Records, Struct, Vector
from thirdhand.core.geometry import rotate_about
from thirdhand.core.vectors import add_product, cross, square, transform


class Kinematics:
    """The arm at some joints, as one record (1,) that `ArmStage.at` computes: joints (J,) [rad, m],
    damping of the tasks [m²], and the properties below.
    """

    __slots__ = ("record",)

    def __init__(self, record: Records) -> None:
        self.record = record

    @property
    def position(self) -> Vector:
        """(3,) [m] of the tool, frame base."""
        return np.asarray(self.record["position"][0])

    @property
    def rotation(self) -> Vector:
        """(3, 3) of the tool, frame base."""
        return np.asarray(self.record["rotation"][0])

    @property
    def tasks(self) -> Vector:
        """(5 or 6, J) [m]: tool velocity, and turn times lever, per joint velocity. Rows 0 to 2 are
        linear, in frame base; the others turn the tool about its own x, y (and z).
        """
        return np.asarray(self.record["tasks"][0])

    @property
    def jacobian(self) -> Vector:
        """(6, J) of the tool, linear before angular rows, frame base."""
        return np.asarray(self.record["jacobian"][0])


@compiled
def tool_speeds(
    heres: Records, dq: Vector, ddq: Vector, jerk: Vector
) -> tuple[float, float, float]:
    """Speed of the tool now, its maximum as accelerations are ended, and a bound of both [m/s].

    With Jv (3, J) the first rows of the tasks:

        now   = |Jv dq|
        crest = max(now, |Jv (dq + ddq |ddq| / 2 jerk)|)
        total = sum over the joints of |Jv_j| (|dq_j| + ddq_j² / (2 jerk_j))

    The second term of crest is the speed once each joint has brought its acceleration to 0. The
    total is a bound even if the motions of the joints no longer cancel each other.
    """
    tasks = heres[0].tasks
    now = crest = total = 0.0
    for axis in range(3):
        v = v_crest = 0.0
        for joint in range(len(dq)):
            v += tasks[axis, joint] * dq[joint]
            gained = ddq[joint] * abs(ddq[joint]) / (2.0 * jerk[joint])
            v_crest += tasks[axis, joint] * (dq[joint] + gained)
        now += v * v
        crest += v_crest * v_crest
    for joint in range(len(dq)):
        column = math.sqrt(tasks[0, joint] ** 2 + tasks[1, joint] ** 2 + tasks[2, joint] ** 2)
        total += column * (abs(dq[joint]) + ddq[joint] ** 2 / (2.0 * jerk[joint]))
    return math.sqrt(now), math.sqrt(max(now, crest)), total


@compiled
def tool_speed_after(kinematics: Struct, way: Vector, dq: Vector) -> float:
    """Speed of the tool [m/s] at joint velocities dq (J,), after displacements `way` (J,) [rad, m].

    It is exact, by the product of exponentials. A revolute joint i is a screw with axis w and
    moment u = o × w, o a point of the axis; a prismatic joint has w = 0 and the direction u. Both
    follow from the present Jacobian. The joints before i move its screw by (R, s) = exp(screw_1
    way_1) ... exp(screw_(i-1) way_(i-1)):

        w' = R w,  u' = R u + s × w',  and with all joints  tool' = R tool + s

    The speed is |sum over i of dq_i (u'_i + w'_i × tool')|.
    """
    tool = kinematics.position
    rotation = np.eye(3)
    shift = np.zeros(3)
    linear = np.zeros(3)
    angular = np.zeros(3)
    origin = np.zeros(3)
    w = np.empty(3)
    u = np.empty(3)
    axis = np.empty(3)
    moment = np.empty(3)
    turn = np.empty((3, 3))
    turned = np.empty((3, 3))
    moved = np.empty(3)
    for j in range(len(dq)):
        # the moment about the origin: the tool's velocity less w × tool
        w[:] = kinematics.jacobian[3:, j]
        cross(w, tool, u)
        for i in range(3):
            u[i] = kinematics.jacobian[i, j] - u[i]

        # the screw as the joints before have moved it, w' and u', and its part of the speed
        transform(rotation, origin, w, axis)
        transform(rotation, origin, u, moment)
        linear[0] += dq[j] * (moment[0] + shift[1] * axis[2] - shift[2] * axis[1])
        linear[1] += dq[j] * (moment[1] + shift[2] * axis[0] - shift[0] * axis[2])
        linear[2] += dq[j] * (moment[2] + shift[0] * axis[1] - shift[1] * axis[0])
        for i in range(3):
            angular[i] += dq[j] * axis[i]

        # exp(screw way): the rotation `turn`, and the shift, which replaces the moment
        turns = square(w) > 0.5
        rotate_about(w, way[j] if turns else 0.0, turn)
        if turns:  # about the point o = w × u of the axis: o - turn o
            cross(w, u, axis)
            transform(turn, origin, axis, moment)
            for i in range(3):
                moment[i] = axis[i] - moment[i]
        else:
            for i in range(3):
                moment[i] = u[i] * way[j]

        # (R, s), with this joint's motion after those before
        transform(rotation, shift, moment, moved)
        shift[:] = moved
        turned[:] = 0.0
        add_product(rotation, turn, turned)
        rotation[:] = turned

    # the tool, moved by all joints
    transform(rotation, origin, tool, moved)
    for i in range(3):
        moved[i] += shift[i]
    x = linear[0] + angular[1] * moved[2] - angular[2] * moved[1]
    y = linear[1] + angular[2] * moved[0] - angular[0] * moved[2]
    z = linear[2] + angular[0] * moved[1] - angular[1] * moved[0]
    return math.sqrt(x * x + y * y + z * z)


@compiled
def joint_costs(arms: Records, heres: Records, out: Vector) -> None:
    """Write the share of each joint's planned limit per unit of tool motion into out (3, 3, J).

    The first index is the order: velocity, acceleration, jerk. The second is the axis i. With Jv
    (3, J) the first rows of the tasks, S = diag(spared) of the order, and M = Jv S:

        out[order, i] = S M^T (M M^T + damping I)^-1 e_i / (planned_limit_shares[order] joint limit)

    These are the damped least-squares joint motions that move the tool along one axis and leave its
    orientation free. S makes joints with higher limits move more.
    """
    arm = arms[0]
    kinematics = heres[0]
    joints = kinematics.tasks.shape[1]
    scaled = np.empty((3, joints))
    root = np.empty((3, 3))
    right = np.empty(3)
    for order in range(3):
        for i in range(3):
            for joint in range(joints):
                scaled[i, joint] = kinematics.tasks[i, joint] * arm.spared[order, joint]
        factorise(scaled, kinematics.damping, root)
        for axis in range(3):
            right[:] = 0.0
            right[axis] = 1.0
            substitute(root, right)
            for joint in range(joints):
                moved = 0.0
                for i in range(3):
                    moved += scaled[i, joint] * right[i]
                out[order, axis, joint] = moved / arm.planned_limits[order, joint]
