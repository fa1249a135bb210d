"""A posture for the first start of an arm: the tool over the table, pointing down and forward."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import least_squares

from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.frame import Vector
from thirdhand.core.separation.stage import Separation
from thirdhand.settings.config import Point, Settings
from thirdhand.settings.file_content import SettingsError
from thirdhand.settings.reachable import Shell, Workspace
from thirdhand.settings.urdf import Urdf, UrdfJoint

LOW_SHARE = 0.15  # the tool is at least this share of the reach above min_z
HIGH_SHARE = 0.2  # the tool is at most this share of the reach above the shoulder
# the tool is within these shares of the way from the inner to the outer end of the reach
WELL_WITHIN = (0.4, 0.75)
TILTS = (0.2, 0.5, 0.785)  # [rad] tried angles of the tool between straight down and forward
POSTURE_STARTS = 20  # the inverse kinematics start from this many postures
# these errors of position and direction cost 1
UNIT_ERROR_M = 0.01
UNIT_ERROR_RAD = 0.1
# cost of a joint at its limit, proportional to its distance from the middle of its range
MIDDLE_WEIGHT = 0.2
END_WEIGHT = 10.0  # cost per half range, within the last fifth before a limit
POSTURE_MARGIN_RAD = 0.001  # the posture keeps this distance from the limits, because of rounding
# a posture with a larger error is not a solution
MAX_POSTURE_ERROR_M = 0.02
MAX_POSTURE_ERROR_RAD = 0.2
ENOUGH_MARGIN = 0.3  # a larger margin to the limits, as a share of half a range, scores no more
ENOUGH_M = 0.08  # a larger distance from table and arm scores no more


def middle_of_range(joint: UrdfJoint) -> float:
    """The middle of a joint's range [rad], limited to ±pi."""
    return round(min(max(0.5 * (joint.lower + joint.upper), -math.pi), math.pi), 4)


def limit_margins(q: Vector, settings: Settings) -> Vector:
    """Distances of joints (J,) to their nearer limits, as shares of half the range."""
    lower = np.array(settings.joints.lower)
    upper = np.array(settings.joints.upper)
    return np.asarray(np.minimum(q - lower, upper - q) / (0.5 * (upper - lower)))


def first_posture(
    settings: Settings, robot: str, workspace: Workspace, shell: Shell, *, start: Point
) -> tuple[Vector, float]:
    """Joints (J,) [rad] with the tool over the table, pointing down and forward, and the tool's
    angle from straight down [rad]. Raises SettingsError.

    The tool is at `start` [m], or as near to it as the arm comfortably reaches. Of many solutions
    of the inverse kinematics the best is taken, by margin to the limits, clearance from the table
    and itself, manipulability, and distance from the middle of the joints' ranges.
    """
    arm = ArmStage(settings, robot)
    separation = Separation(settings, robot)
    place = _over_the_table(settings, shell, start)
    lower = np.array(settings.joints.lower)
    upper = np.array(settings.joints.upper)
    middle = 0.5 * (lower + upper)
    half = 0.5 * (upper - lower)
    best: tuple[float, Vector, float] | None = None
    away = np.linalg.norm(workspace.positions - place, axis=1)
    forward = (place - shell.centre)[:2] / max(
        float(np.linalg.norm((place - shell.centre)[:2])), 1e-9
    )

    def errors(q: Vector, direction: Vector) -> Vector:
        pose = arm.at(q)
        position = (pose.position - place) / UNIT_ERROR_M
        turn = (pose.rotation[:, 2] - direction) / UNIT_ERROR_RAD
        shares = (q - middle) / half
        return np.concatenate(
            (
                position,
                turn,
                MIDDLE_WEIGHT * shares,
                END_WEIGHT * np.maximum(np.abs(shares) - 0.8, 0),
            )
        )

    for tilt in TILTS:
        direction = np.array([*(math.sin(tilt) * forward), -math.cos(tilt)])
        turned = np.linalg.norm(workspace.directions - direction, axis=1)
        for i in np.argsort(away / (0.1 * workspace.extent) + turned)[:POSTURE_STARTS]:
            start = np.clip(workspace.postures[i], lower + 1e-6, upper - 1e-6)
            q = least_squares(
                errors, start, bounds=(lower, upper), max_nfev=60, args=(direction,)
            ).x
            pose = arm.at(q)
            if (
                np.linalg.norm(pose.position - place) > MAX_POSTURE_ERROR_M
                or np.linalg.norm(pose.rotation[:, 2] - direction) > MAX_POSTURE_ERROR_RAD
            ):
                continue
            clear = separation.clearance(q, np.empty((0, 3)))[0]
            volume = math.sqrt(max(np.linalg.det(pose.jacobian[:3] @ pose.jacobian[:3].T), 0.0))
            score = (
                2.0 * min(limit_margins(q, settings).min() / ENOUGH_MARGIN, 1.0)
                + min(clear / ENOUGH_M, 1.0)
                + min(volume / float(arm.parameters["singular_volume"][0]), 1.0)
                - float(np.abs((q - middle) / np.minimum(half, math.pi)).mean())
            )
            if best is None or score > best[0]:
                best = (score, q, float(np.arccos(np.clip(-pose.rotation[2, 2], -1.0, 1.0))))
    if best is None:
        raise SettingsError(
            f"no posture found with the tool at {place.round(2).tolist()} m, pointing down: give "
            f"another --plate (the last links are {', '.join(Urdf(robot).leaves)}), or another "
            "position of the base by --at"
        )
    return np.clip(best[1], lower + POSTURE_MARGIN_RAD, upper - POSTURE_MARGIN_RAD), best[2]


def _over_the_table(settings: Settings, shell: Shell, start: Point) -> Vector:
    """The position (3,) [m] nearest to `start` that is well within the reach."""
    place = np.array(start)
    centre = np.array(shell.centre)
    lowest = settings.reach.min_z + LOW_SHARE * shell.outer
    highest = centre[2] + HIGH_SHARE * shell.outer
    place[2] = max(min(place[2], highest), lowest)
    away = place - centre
    inner, outer = (shell.inner + share * (shell.outer - shell.inner) for share in WELL_WITHIN)
    distance = float(np.linalg.norm(away))
    ahead = math.sqrt(max(min(max(distance, inner), outer) ** 2 - away[2] ** 2, 0.0))
    place[:2] = centre[:2] + away[:2] * ahead / max(math.hypot(*away[:2]), 1e-9)
    return np.asarray(np.maximum(place, [settings.reach.min_x, -np.inf, settings.reach.min_z]))
