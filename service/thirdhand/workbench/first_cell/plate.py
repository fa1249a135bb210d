"""The link of a URDF that carries the tool, and the direction in which the tool points."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from thirdhand.settings.urdf import Urdf, UrdfError, UrdfJoint

# the last axis points toward the plate if at least this share of the way to it is along the axis
LEAST_ALONG = 0.1
ALIGNED = 0.9  # two axes are the same from this cosine of their angle on


def plate_of(urdf: Urdf) -> str:
    """The only end of an arm's chain. Raises UrdfError with the candidates if it has several."""
    if len(urdf.leaves) == 1:
        return urdf.leaves[0]
    raise UrdfError(
        f"the arm has {len(urdf.leaves)} ends: name the link that carries the tool by --plate; the "
        f"ends are {', '.join(urdf.leaves)}, and every link before them is accepted too"
    )


def turn_of_tool(chain: Sequence[UrdfJoint]) -> tuple[float, float, float, float]:
    """The rotation (quaternion x y z w) from the plate to a tool whose +z leaves the plate.

    It is the identity if the plate's +z does so. The tool points along the axis of the last joint.
    """
    turn = Rotation.identity()
    position_m = np.zeros(3)
    turns = Rotation.identity()
    points = []
    axis = np.zeros(3)
    for joint in chain:
        position_m = position_m + turn.apply(joint.translation)
        turn = turn * Rotation.from_quat(joint.rotation)
        if joint.kind != "fixed":
            turns = turn
            axis = np.array(joint.axis)
            points.append(position_m)
    axis = turn.inv().apply(turns.apply(axis))  # the last axis in the plate's frame
    away = turn.inv().apply(position_m - points[max(len(points) - 2, 0)])
    along = float(axis @ away)
    if abs(along) < LEAST_ALONG * float(np.linalg.norm(away)):
        return (0.0, 0.0, 0.0, 1.0)
    outward = np.sign(along) * axis
    if outward[2] > ALIGNED:
        return (0.0, 0.0, 0.0, 1.0)
    nearest = int(np.abs(outward).argmax())
    if abs(outward[nearest]) > ALIGNED:
        outward = np.sign(outward[nearest]) * np.eye(3)[nearest]
    across = np.cross([0.0, 0.0, 1.0], outward)
    sine = float(np.linalg.norm(across))
    turned = Rotation.from_rotvec(
        (across / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])) * math.atan2(sine, outward[2])
    )
    x, y, z, w = turned.as_quat().round(6).tolist()
    return (x, y, z, w)
