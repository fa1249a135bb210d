"""Settings for the first start of an arm that is known by its URDF alone: the plate, where the arm
stands, a posture, accelerations and jerks. All of them are proposals, to be checked by its owner.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import msgspec
import numpy as np
import pinocchio as pin
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from service.core.arm.stage import Arm
from service.core.frame import Vector
from service.core.separation.body import Body, body_of
from service.core.separation.stage import Separation
from service.settings.arm_description import SettingsError, description
from service.settings.config import Settings, converted, robot_description
from service.settings.mesh_cover import found_meshes
from service.settings.reachable import Shell, Workspace, workspace_of
from service.settings.urdf import Joint, Urdf

PLACES = {  # [m] the tool's in the demo, frame base: where the shipped skill begins and its via-points
    "start": (0.45, -0.05, 0.35),
    "handover": (0.54, -0.28, 0.38),
    "glass": (0.50, 0.38, 0.16),
    "soldering": (0.62, 0.0, 0.26),
}
MARGIN_M = 0.011  # of a place within the reach
STAND_STEP_M, STAND_STEPS = 0.05, 6  # where the arm stands, if not at the origin, along x

UNKNOWN_VELOCITY = 1.5  # [rad/s], [m/s] of a joint of which the URDF does not say one
RISE_S = 0.25  # acceleration = velocity / 0.25 s
MAX_ACCELERATION = 15.0  # [rad/s²]
JERK_RATE, MAX_JERK = 40.0, 500.0  # [1/s] jerk by acceleration; [rad/s³]
TORQUE_SHARE = 0.5  # of a joint's effort, for gravity and acceleration of the arm
LEAST_SCALE = 0.2  # of the acceleration where the efforts are small: they may be wrong as well

LOW_SHARE, HIGH_SHARE = 0.15, 0.2  # of the reach: the tool above the table, and above the shoulder at most
WELL_WITHIN = (0.4, 0.75)  # of the way from the inner to the outer end of the reach
TILTS = (0.2, 0.5, 0.785)  # [rad] of the tool from straight down, forward
STARTS = 20  # postures from which the inverse kinematics start
NEAR_M, NEAR_RAD = 0.01, 0.1  # errors of position and direction that cost 1
MIDDLE_WEIGHT = 0.2  # cost of a joint at its limit, proportional to its distance from the middle of its range
END_WEIGHT = 10.0  # cost per half range, within the last fifth of it before a limit
EDGE_RAD = 0.001  # kept from the limits, so that rounding does not pass them
FAR_M, FAR_RAD = 0.02, 0.2  # a posture with more error is no solution
ENOUGH_MARGIN, ENOUGH_M = 0.3, 0.08  # margins to limits and to things beyond which more is no better

LEAST_ALONG = 0.1  # share of the way to the plate along the last axis, below which it says nothing
ALIGNED = 0.9  # cosine of axes that are the same

PLATE_NAMES = (r"tcp|tool_?cent", r"tool", r"(^|_)eef?(_|$)|end_?effector|flange|grasp", r"hand|gripper|palm")
GRIPPER = re.compile(r"finger|gripper|jaw|knuckle|claw|thumb", re.IGNORECASE)


class Proposal(NamedTuple):
    """Description of an arm as it was understood, and the settings proposed for it."""

    urdf: Urdf
    settings: Settings
    chain: tuple[Joint, ...]
    workspace: Workspace
    shell: Shell
    body: Body
    stand: tuple[float, float, float]
    """[m] of the URDF's root in frame base"""
    text: str
    """the URDF that stands there; empty where it stands at the origin, as it is"""
    clearance: float
    """[m] of the arm in its posture, from the table and itself"""
    margin: float
    """of the joint that is nearest to a limit, as a share of half its range"""
    tilt: float
    """[rad] of the tool from straight down"""
    efforts: bool
    """whether the accelerations follow from the URDF's masses and efforts, too"""
    unmet: tuple[str, ...]
    """places of the demo that are out of reach"""

    @property
    def plate(self) -> str:
        """The link that carries the tool."""
        return self.settings.arm.plate


def plate_of(urdf: Urdf) -> str:
    """The link that is likely to carry the tool: beyond the last joint of the longest chain that is
    no gripper's, the one whose name says it, or else the last.
    """
    children: dict[str, list[Joint]] = {}
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
        is_gripper = GRIPPER.search(best.name) or (beyond <= 3 and len(fingers) > 1)
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


def turn_of_tool(chain: Sequence[Joint]) -> tuple[float, float, float, float]:
    """The rotation from the plate to a tool whose +z leaves it: none where the plate's +z does.

    The last joint turns the tool about the direction in which it points.
    """
    turn, at, turns, points, axis = Rotation.identity(), np.zeros(3), Rotation.identity(), [], np.zeros(3)
    for joint in chain:
        at, turn = at + turn.apply(joint.translation), turn * Rotation.from_quat(joint.rotation)
        if joint.kind != "fixed":
            turns, axis = turn, np.array(joint.axis)
            points.append(at)
    axis = turn.inv().apply(turns.apply(axis))  # in the plate's frame
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


def proposed(
    path: Path,
    *,
    plate: str | None = None,
    packages: tuple[str, ...] = (),
    stand: tuple[float, float, float] | None = None,
) -> Proposal:
    """A cell for the arm in a URDF file. Raises SettingsError, UrdfError."""
    raw = description(path, cover=False)
    urdf = Urdf(raw, origin=str(path))
    plate = plate or plate_of(urdf)
    moving = urdf.movable(plate)
    acceleration, jerk, efforts = rates(raw, moving)
    given: dict[str, Any] = {
        "arm": {
            "urdf": str(path.absolute()),
            "plate": plate,
            "packages": list(packages),
            "posture": [_middle(joint) for joint in moving],
        },
        "joints": {"acceleration": acceleration, "jerk": jerk, **_velocities(moving)},
        "tool": {"plate_from_tool": [0.0, 0.0, 0.0, *turn_of_tool(urdf.chain(plate))]},
    }
    settings = converted(given, origin=str(path))
    covered = Urdf(robot_description(settings))
    at = stand or _stand(settings, covered)
    text = standing(raw, path, packages, at) if any(at) else ""
    if text:
        robot = standing(robot_description(settings), path, packages, at)
        settings = _standing_settings(settings, Urdf(robot))
    else:
        robot = robot_description(settings)
    urdf = Urdf(robot, origin=str(path))
    chain = urdf.chain(plate)
    limits = settings.joints
    workspace = workspace_of(chain, limits.lower, limits.upper, settings.tool.plate_from_tool)
    reach = settings.reach
    shell = Shell(reach.centre, reach.inner, reach.outer)
    posture, tilt = _posture(settings, robot, workspace, shell)
    arm = msgspec.structs.replace(settings.arm, posture=tuple(posture.round(3).tolist()))
    settings = msgspec.structs.replace(settings, arm=arm)
    clearance = Separation(settings, robot).clearance(np.array(arm.posture), np.empty((0, 3)))[0]
    return Proposal(
        urdf,
        settings,
        chain,
        workspace,
        shell,
        body_of(settings, robot),
        at,
        text,
        clearance,
        float(_margins(np.array(arm.posture), settings).min()),
        tilt,
        efforts,
        tuple(name for name, place in PLACES.items() if not _is_in(place, shell)),
    )


def _standing_settings(settings: Settings, urdf: Urdf) -> Settings:
    """The settings with the reach of the arm where it stands."""
    workspace = workspace_of(
        urdf.chain(settings.arm.plate), settings.joints.lower, settings.joints.upper, settings.tool.plate_from_tool
    )
    shell = workspace.shell(settings.reach.min_x, settings.reach.min_z)
    reach = msgspec.structs.replace(
        settings.reach, centre=shell.centre, inner=shell.inner, outer=min(shell.outer, settings.reach.outer)
    )
    return msgspec.structs.replace(settings, reach=reach)


# --- where it stands ------------------------------------------------------------------------------


def _is_in(place: Sequence[float], shell: Shell) -> bool:
    return shell.inner + MARGIN_M <= math.dist(place, shell.centre) <= shell.outer - MARGIN_M


def _stand(settings: Settings, urdf: Urdf) -> tuple[float, float, float]:
    """Where the arm stands nearest to the origin, along x, so that it reaches all of the demo's
    places; at the origin where it cannot.
    """
    x, y, z = settings.reach.centre
    inner, outer = settings.reach.inner, settings.reach.outer
    tried = sorted((STAND_STEP_M * i for i in range(-STAND_STEPS, STAND_STEPS + 1)), key=abs)
    shells = {at: Shell((x + at, y, z), inner, outer) for at in tried}
    best = next((at for at in tried if all(_is_in(place, shells[at]) for place in PLACES.values())), 0.0)
    return (round(best, 3), 0.0, 0.0)


def standing(text: str, path: Path, packages: tuple[str, ...], at: tuple[float, float, float]) -> str:
    """The URDF with its root at a point of frame base, by a fixed joint, and with the meshes' files
    named in full.
    """
    robot = ElementTree.fromstring(text)
    root = Urdf(text).root
    names = {link.get("name") for link in robot.findall("link")}
    base = next(name for name in ("base", "cell_base", "cell_base_of_the_arm") if name not in names)
    for mesh, file in found_meshes(robot, path, packages):
        mesh.set("filename", f"file://{file}")
    ElementTree.SubElement(robot, "link", name=base)
    joint = ElementTree.SubElement(robot, "joint", name=f"{base}_to_{root}", type="fixed")
    ElementTree.SubElement(joint, "origin", xyz=" ".join(map(repr, at)), rpy="0 0 0")
    ElementTree.SubElement(joint, "parent", link=base)
    ElementTree.SubElement(joint, "child", link=root)
    return ElementTree.tostring(robot, encoding="unicode") + "\n"


# --- accelerations --------------------------------------------------------------------------------


def rates(text: str, moving: Sequence[Joint]) -> tuple[list[float], list[float], bool]:
    """A guess of the joints' accelerations [rad/s²] and jerks [rad/s³]: from rest to full speed in
    `RISE_S`, and less where the URDF's efforts are small for its masses; whether it has both.
    """
    wanted = np.array([min(_known(joint.velocity) / RISE_S, MAX_ACCELERATION) for joint in moving])
    share = _torque_share(text, moving, wanted)
    acceleration = wanted * min(max(LEAST_SCALE, 1.0 if share is None else share), 1.0)
    jerk = np.minimum(JERK_RATE * acceleration, MAX_JERK)
    return [float(f"{a:.3g}") for a in acceleration], [float(f"{j:.3g}") for j in jerk], share is not None


def _velocities(moving: Sequence[Joint]) -> dict[str, list[float]]:
    """The joints' velocities, where the URDF does not say all of them."""
    if all(math.isfinite(joint.velocity) for joint in moving):
        return {}
    return {"velocity": [_known(joint.velocity) for joint in moving]}


def _known(velocity: float) -> float:
    return velocity if math.isfinite(velocity) else UNKNOWN_VELOCITY


def _torque_share(text: str, moving: Sequence[Joint], acceleration: Vector) -> float | None:
    """The share of accelerations (J,) that half of the efforts can give beyond gravity; None where
    the URDF has no masses or efforts.
    """
    robot = ElementTree.fromstring(text)
    limits = {joint.get("name"): joint.find("limit") for joint in robot.findall("joint")}
    if robot.find("link/inertial/mass") is None or any(
        (limit := limits[joint.name]) is None or "effort" not in limit.attrib for joint in moving
    ):
        return None
    try:
        model = pin.buildModelFromXML(text)
        numbers = [model.joints[model.getJointId(joint.name)].idx_v for joint in moving]
        data, neutral = model.createData(), pin.neutral(model)
        inertia = pin.crba(model, data, neutral)
        gravity = np.abs(pin.computeGeneralizedGravity(model, data, neutral))
        efforts = np.array(model.effortLimit)[numbers]
    except (ValueError, IndexError, RuntimeError):  # masses as no other reader takes them
        return None
    inertia = np.triu(inertia) + np.triu(inertia, 1).T
    needed = np.abs(inertia[np.ix_(numbers, numbers)]) @ acceleration
    if not (efforts > 0.0).all() or not (needed > 0.0).any() or not np.isfinite(efforts).all():
        return None
    return float(((TORQUE_SHARE * efforts - gravity[numbers]) / np.maximum(needed, 1e-9)).min())


# --- posture --------------------------------------------------------------------------------------


def _middle(joint: Joint) -> float:
    """The middle of a joint's range, within a turn of 0."""
    return round(min(max(0.5 * (joint.lower + joint.upper), -math.pi), math.pi), 4)


def _margins(q: Vector, settings: Settings) -> Vector:
    """Distances to the nearer limit (J,), as shares of half the range."""
    lower, upper = np.array(settings.joints.lower), np.array(settings.joints.upper)
    return np.asarray(np.minimum(q - lower, upper - q) / (0.5 * (upper - lower)))


def _posture(settings: Settings, robot: str, workspace: Workspace, shell: Shell) -> tuple[Vector, float]:
    """Joints (J,) [rad] with the tool over the table, pointing down and forward; and its tilt from
    straight down [rad]. Raises SettingsError.

    The best of many solutions of the inverse kinematics, by margin to the limits, clearance from
    the table and itself, manipulability, and distance from the middle of the joints' ranges.
    """
    arm, separation = Arm(settings, robot), Separation(settings, robot)
    place = _over_the_table(settings, shell)
    lower, upper = np.array(settings.joints.lower), np.array(settings.joints.upper)
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    best: tuple[float, Vector, float] | None = None
    away = np.linalg.norm(workspace.positions - place, axis=1)
    forward = (place - shell.centre)[:2] / max(float(np.linalg.norm((place - shell.centre)[:2])), 1e-9)

    def errors(q: Vector, direction: Vector) -> Vector:
        here = arm.at(q)
        position, turn = (here.position - place) / NEAR_M, (here.rotation[:, 2] - direction) / NEAR_RAD
        shares = (q - middle) / half
        return np.concatenate(
            (position, turn, MIDDLE_WEIGHT * shares, END_WEIGHT * np.maximum(np.abs(shares) - 0.8, 0))
        )

    for tilt in TILTS:
        direction = np.array([*(math.sin(tilt) * forward), -math.cos(tilt)])
        turned = np.linalg.norm(workspace.directions - direction, axis=1)
        for i in np.argsort(away / (0.1 * workspace.extent) + turned)[:STARTS]:
            start = np.clip(workspace.postures[i], lower + 1e-6, upper - 1e-6)
            q = least_squares(errors, start, bounds=(lower, upper), max_nfev=60, args=(direction,)).x
            here = arm.at(q)
            if (
                np.linalg.norm(here.position - place) > FAR_M
                or np.linalg.norm(here.rotation[:, 2] - direction) > FAR_RAD
            ):
                continue
            clear = separation.clearance(q, np.empty((0, 3)))[0]
            volume = math.sqrt(max(np.linalg.det(here.jacobian[:3] @ here.jacobian[:3].T), 0.0))
            score = (
                2.0 * min(_margins(q, settings).min() / ENOUGH_MARGIN, 1.0)
                + min(clear / ENOUGH_M, 1.0)
                + min(volume / float(arm.parameters["singular_volume"][0]), 1.0)
                - float(np.abs((q - middle) / np.minimum(half, math.pi)).mean())
            )
            if best is None or score > best[0]:
                best = (score, q, float(np.arccos(np.clip(-here.rotation[2, 2], -1.0, 1.0))))
    if best is None:
        raise SettingsError(
            f"no posture found with the tool at {place.round(2).tolist()} m, pointing down: give another --plate "
            f"(the last links are {', '.join(Urdf(robot).leaves)}), or another place to stand by --at"
        )
    return np.clip(best[1], lower + EDGE_RAD, upper - EDGE_RAD), best[2]


def _over_the_table(settings: Settings, shell: Shell) -> Vector:
    """Where demonstrations begin, or the place nearest to it that is well within the reach."""
    place, centre = np.array(PLACES["start"]), np.array(shell.centre)
    lowest, highest = settings.reach.min_z + LOW_SHARE * shell.outer, centre[2] + HIGH_SHARE * shell.outer
    place[2] = max(min(place[2], highest), lowest)
    away = place - centre
    inner, outer = (shell.inner + share * (shell.outer - shell.inner) for share in WELL_WITHIN)
    distance = float(np.linalg.norm(away))
    ahead = math.sqrt(max(min(max(distance, inner), outer) ** 2 - away[2] ** 2, 0.0))
    place[:2] = centre[:2] + away[:2] * ahead / max(math.hypot(*away[:2]), 1e-9)
    return np.asarray(np.maximum(place, [settings.reach.min_x, -np.inf, settings.reach.min_z]))


# --- the file -------------------------------------------------------------------------------------


def written(proposal: Proposal, urdf: str, source: str) -> str:
    """The configuration, as TOML, with the URDF by this name."""
    settings, arm = proposal.settings, proposal.settings.arm
    offset = settings.tool.plate_from_tool
    is_said = all(math.isfinite(joint.velocity) for joint in proposal.chain if joint.kind != "fixed")
    velocity = "" if is_said else f"velocity = {list(settings.joints.velocity)}  # [rad/s]\n"
    tool = f"[tool]  # its +z leaves the plate\nplate_from_tool = {list(offset)}\n\n" if any(offset[3:6]) else ""
    basis = "the URDF's velocities, masses and efforts" if proposal.efforts else "the URDF's velocities"
    packages = f"packages = {json.dumps(list(arm.packages))}\n" if arm.packages else ""
    return (
        f"# A first cell for {source}, by `thirdhand arm`. All of it is a proposal: check it against the arm.\n"
        "[arm]\n"
        f"urdf = {json.dumps(urdf, ensure_ascii=False)}{'' if Path(urdf).is_absolute() else '  # beside this file'}\n"
        f"plate = {json.dumps(arm.plate, ensure_ascii=False)}  # the link that carries the tool\n"
        f"{packages}"
        f"posture = {list(arm.posture)}  # [rad] the tool over the table, pointing down and forward\n"
        "\n"
        f"# A guess, from {basis}: from rest to full speed in {RISE_S:g} s or more.\n"
        "# The maker's data sheet knows better; begin with a tenth on a real arm.\n"
        "[joints]\n"
        f"{velocity}"
        f"acceleration = {list(settings.joints.acceleration)}  # [rad/s²]\n"
        f"jerk = {list(settings.joints.jerk)}  # [rad/s³]\n"
        "\n"
        f"{tool}"
        f"# [reach] follows from the kinematics: {proposal.shell.inner:g} to {proposal.shell.outer:g} m from "
        f"{list(proposal.shell.centre)}; the arm is {proposal.workspace.extent:.2f} m long.\n"
    )
