"""Largest speed and acceleration that the joints leave to the tool, and the limit that binds.

With the `joint_costs` c (3, 3, J) of a posture, by order of the derivative, axis and joint, a tool
motion of magnitude x along the unit vector u needs the share x |u · c_j| of the limit of joint j.
So the largest magnitude is

    1 / max_j |u · c_j|    along u,        1 / max_j |c_j|    in every direction.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from thirdhand.contract.records import Flag, Mode
from thirdhand.contract.requests import ALONG_TASK, ANY_DIRECTION, ToolLimits
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.frame import Records, Vector
from thirdhand.core.skill.skill import Skill
from thirdhand.core.tuning import TUNING
from thirdhand.settings.config import Settings

# duration of a step along a path, and its speed / max_speed
PATH_STEP_S = 0.02
PATH_SPEED_SHARE = 0.3
PATH_END_STEPS = 300  # steps in which the arm reaches the first point of a path
ON_PATH_M = 0.03  # a posture whose tool is farther from the path is left out
POSTURE_EVERY = 10  # every tenth step along a path gives a posture
MOST_PATH_POINTS = 40  # points of a path without an order


def tool_limits(
    arm: ArmStage, settings: Settings, postures: Vector, directions: Vector | None = None
) -> ToolLimits:
    """Limits of the tool at the postures (N, J) [rad, m] where they are least.

    They hold along the unit vectors `directions` (N, 3); without these, in every direction.
    """
    costs = np.array([arm.costs(arm.at(q))[:2] for q in postures])
    if directions is None:
        shares = np.linalg.norm(costs, axis=2)
    else:
        shares = np.abs(np.einsum("ni,noij->noj", directions, costs))
    bounds = (settings.tool.max_speed, settings.tool.acceleration)
    names = settings.joints.names
    limits: list[tuple[float, str]] = []
    for order, setting in enumerate(bounds):
        joint = int(shares[:, order].max(axis=0).argmax())
        needed = float(shares[:, order].max())
        limits.append((1.0 / needed, names[joint]) if needed * setting > 1.0 else (setting, ""))
    (speed, speed_joint), (acceleration, acceleration_joint) = limits
    return ToolLimits(round(speed, 3), speed_joint, round(acceleration, 2), acceleration_joint)


def limits_of_task(
    settings: Settings, urdf: str, positions: Vector, orientation: Vector
) -> dict[str, ToolLimits]:
    """Limits of the tool on a path through `positions` (M, 3) [m] in an orientation (4,), one named
    ANY_DIRECTION and one named ALONG_TASK; empty if the arm reaches none of the positions.
    """
    arm = ArmStage(settings, urdf)
    postures, directions = _along(arm, settings, positions, orientation)
    if not len(postures):
        return {}
    return {
        ANY_DIRECTION: tool_limits(arm, settings, postures),
        ALONG_TASK: tool_limits(arm, settings, postures, directions),
    }


def path_of(skill: Skill) -> Vector:
    """Tool positions (M, 3) [m] of a skill in the order of the task. Without named via-points the
    order is unknown: each position is followed by the nearest one that is left.
    """
    positions = skill.mean(skill.hands, skill.model.names)
    if skill.model.names:
        return positions
    left = list(positions[:: -(-len(positions) // MOST_PATH_POINTS)])
    path = [left.pop(0)]
    while left:
        nearest = int(np.linalg.norm(np.array(left) - path[-1], axis=1).argmin())
        path.append(left.pop(nearest))
    return np.array(path)


def _along(
    arm: ArmStage, settings: Settings, positions: Vector, orientation: Vector
) -> tuple[Vector, Vector]:
    """Postures (N, J) along straight lines between positions (M, 3) [m], from the configured one
    on, by the arm's own inverse kinematics, and the directions of motion there (N, 3).
    """
    q = np.array(settings.arm.posture)
    still = np.zeros(3)
    step_m = PATH_SPEED_SHARE * settings.tool.max_speed * PATH_STEP_S
    # to the first position
    for _ in range(PATH_END_STEPS):
        q = q + PATH_STEP_S * arm.step(q, positions[0], still, orientation).velocity

    postures = []
    directions = []
    step = 0
    for begin, end in itertools.pairwise(positions):
        length = float(np.linalg.norm(end - begin))
        count = int(length / step_m)
        for i in range(count):
            position = begin + (end - begin) * (i + 1) / count
            q = (
                q
                + PATH_STEP_S
                * arm.step(q, position, (end - begin) / (count * PATH_STEP_S), orientation).velocity
            )
            step += 1
            if (
                step % POSTURE_EVERY == 0
                and np.linalg.norm(arm.at(q).position - position) < ON_PATH_M
            ):
                postures.append(q)
                directions.append((end - begin) / length)
    return np.array(postures), np.array(directions)


def binding(settings: Settings, frames: Records) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Each limit that a frame of the T `frames` meets, and a mask (T,) of the frames that do.

    A frame that follows meets the one limit of which it uses the largest share: speed or
    acceleration of a joint, or of the tool's setpoint. It meets none if that share is below the
    square of the planned one: setpoint and joints are each planned with the planned share.
    """
    least = TUNING.arm.planned_limit_shares[1] ** 2
    joints = settings.joints
    tool = settings.tool
    engages = frames["flags"] & int(Flag.ENGAGING) > 0
    speed = np.linalg.norm(frames["setpoint_velocity"], axis=1)
    shares = {
        "[tool] max_speed": np.where(engages, 0.0, speed / tool.max_speed),
        "[tool] engage_speed": np.where(engages, speed / tool.engaging_speed, 0.0),
        "[tool] max_acceleration": np.linalg.norm(frames["setpoint_acceleration"], axis=1)
        / tool.acceleration,
    }
    for kind, field, limits in (
        ("speed", "joint_velocities", joints.velocity),
        ("acceleration", "joint_accelerations", joints.acceleration),
    ):
        for joint, name in enumerate(joints.names):
            shares[f"{kind} of {name}"] = np.abs(frames[field][:, joint]) / limits[joint]
    used = np.array([*shares.values()])
    largest = np.where(
        (used.max(axis=0) >= least) & (frames["mode"] == Mode.FOLLOW), used.argmax(axis=0), -1
    )
    for number, name in enumerate(shares):
        if (met := largest == number).any():
            yield name, met
