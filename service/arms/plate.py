"""The link of a URDF that probably carries the tool, and the direction in which the tool points."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from service.settings.urdf import Urdf, UrdfJoint

LEAST_ALONG = 0.1  # the last axis points toward the plate if at least this share of the way to it is along the axis
ALIGNED = 0.9  # two axes are the same from this cosine of their angle on
# Patterns of a plate's name, from the most to the least certain.
PLATE_NAMES = (r"tcp|tool_?cent", r"tool", r"(^|_)eef?(_|$)|end_?effector|flange|grasp", r"hand|gripper|palm")
GRIPPER_NAME = re.compile(r"finger|gripper|jaw|knuckle|claw|thumb", re.IGNORECASE)


def plate_of(urdf: Urdf) -> str:
    """The link that probably carries the tool: behind the last joint of the longest chain without
    the gripper, the link whose name matches PLATE_NAMES, or else the last.
    """
    children: dict[str, list[UrdfJoint]] = {}
    for joint in urdf.joints:
        children.setdefault(joint.parent, []).append(joint)
    depth = dict.fromkeys((urdf.root, *(joint.child for joint in urdf.joints)), 0)
    for leaf in urdf.leaves:
        count = 0
        for joint in reversed(urdf.chain(leaf)):
            count += joint.kind != "fixed"
            depth[joint.parent] = max(depth[joint.parent], count)
    link = last = urdf.root
    while ahead := [joint for joint in children.get(link, ()) if joint.kind != "fixed" or depth[joint.child]]:
        fingers = [joint for joint in ahead if joint.kind != "fixed" or depth[joint.child]]
        best = max(ahead, key=lambda joint: depth[joint.child] + (joint.kind != "fixed"))
        beyond = depth[best.child] + (best.kind != "fixed")
        is_gripper = GRIPPER_NAME.search(best.name) or (beyond <= 3 and len(fingers) > 1)
        if is_gripper:
            break
        link = best.child
        if best.kind != "fixed":
            last = link
    found, waiting = [last], [last]
    while waiting:
        ahead = [joint for joint in children.get(waiting.pop(), ()) if joint.kind == "fixed"]
        found += [joint.child for joint in ahead]
        waiting += [joint.child for joint in ahead]
    for pattern in PLATE_NAMES:
        if named := [one for one in found if re.search(pattern, one, re.IGNORECASE)]:
            return named[-1]
    return found[-1] if len(found) <= 2 else last


def turn_of_tool(chain: Sequence[UrdfJoint]) -> tuple[float, float, float, float]:
    """The rotation (quaternion x y z w) from the plate to a tool whose +z leaves the plate.

    It is the identity if the plate's +z does so. The tool points along the axis of the last joint.
    """
    turn, at, turns, points, axis = Rotation.identity(), np.zeros(3), Rotation.identity(), [], np.zeros(3)
    for joint in chain:
        at, turn = at + turn.apply(joint.translation), turn * Rotation.from_quat(joint.rotation)
        if joint.kind != "fixed":
            turns, axis = turn, np.array(joint.axis)
            points.append(at)
    axis = turn.inv().apply(turns.apply(axis))  # the last axis in the plate's frame
    away = turn.inv().apply(at - points[max(len(points) - 2, 0)])
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
