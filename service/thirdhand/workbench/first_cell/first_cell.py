"""Settings for the first start of an arm of which only the URDF is known: the plate, the position
of its base, a posture, accelerations and jerks. All are proposals that its owner must check.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import msgspec
import numpy as np

from thirdhand.contract.requests import ANY_DIRECTION, ToolLimits
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.geometry import quaternion_of
from thirdhand.core.separation.body import Body, body_of
from thirdhand.core.separation.clearance import NEAR_ITSELF
from thirdhand.core.separation.stage import Separation
from thirdhand.core.tool_limits import limits_of_task, tool_limits
from thirdhand.settings.arm_description import description
from thirdhand.settings.config import Settings, converted, robot_description
from thirdhand.settings.mesh_cover import found_meshes
from thirdhand.settings.reachable import Shell, Workspace, workspace_of
from thirdhand.settings.urdf import Urdf, UrdfJoint
from thirdhand.workbench.first_cell.first_posture import (
    first_posture,
    limit_margins,
    middle_of_range,
)
from thirdhand.workbench.first_cell.plate import plate_of, turn_of_tool
from thirdhand.workbench.first_cell.rates import RISE_S, rates, velocities

# [m] tool positions of the demo in frame base: the begin of the shipped skill, and its via-points
DEMO_TOOL_M = {
    "start": (0.45, -0.05, 0.35),
    "handover": (0.54, -0.28, 0.38),
    "glass": (0.50, 0.38, 0.16),
    "soldering": (0.62, 0.0, 0.26),
}
REACH_MARGIN_M = 0.011  # a position counts as reached if it is this far inside the shell
STAND_STEP_M = 0.05  # tried positions of the base on the x axis are multiples of this
STAND_STEPS = 6  # tried multiples to either side


class Proposal(NamedTuple):
    """The description of an arm, and the settings proposed for it."""

    urdf: Urdf
    settings: Settings
    chain: tuple[UrdfJoint, ...]
    workspace: Workspace
    shell: Shell
    body: Body
    stand: tuple[float, float, float]
    """[m] position of the URDF's root in frame base"""
    text: str
    """the URDF with its root at `stand`; empty for a root at the origin"""
    clearance: tuple[float, str]
    """[m] distance of the arm in its posture from the table or itself, and the nearer of both"""
    margin: float
    """smallest distance of a joint to a limit, as a share of half its range"""
    tilt: float
    """[rad] angle of the tool from straight down"""
    efforts: bool
    """True if the accelerations depend on the URDF's masses and efforts too"""
    unmet: tuple[str, ...]
    """names of DEMO_TOOL_M that are out of reach"""
    tool_limits: dict[str, ToolLimits]
    """limits of the tool on the way through DEMO_TOOL_M; if one is out of reach, in the posture"""

    @property
    def plate(self) -> str:
        """The link that carries the tool."""
        return self.settings.arm.plate

    @property
    def slides(self) -> bool:
        """True if a joint of the chain is prismatic."""
        return "m" in self.settings.joints.units


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
    values: dict[str, Any] = {
        "arm": {
            "urdf": str(path.absolute()),
            "plate": plate,
            "packages": list(packages),
            "posture": [middle_of_range(joint) for joint in moving],
        },
        "joints": {"acceleration": acceleration, "jerk": jerk, **velocities(moving)},
        "tool": {"plate_from_tool": [0.0, 0.0, 0.0, *turn_of_tool(urdf.chain(plate))]},
    }
    settings = converted(values, origin=str(path))
    position_m = stand or _stand(settings)
    robot = robot_description(settings)
    text = ""
    if any(position_m):
        robot, text = (standing(xml, path, packages, position_m) for xml in (robot, raw))
    urdf = Urdf(robot, origin=str(path))
    chain = urdf.chain(plate)
    limits = settings.joints
    workspace = workspace_of(chain, limits.lower, limits.upper, settings.tool.plate_from_tool)
    if text:
        settings = _with_reach_of(settings, workspace)
    reach = settings.reach
    shell = Shell(reach.centre, reach.inner, reach.outer)
    posture, tilt = first_posture(settings, robot, workspace, shell, start=DEMO_TOOL_M["start"])
    arm = msgspec.structs.replace(settings.arm, posture=tuple(posture.round(3).tolist()))
    settings = msgspec.structs.replace(settings, arm=arm)
    depth_m, _, nearest = Separation(settings, robot).intrusion(np.array(arm.posture))
    unmet = tuple(name for name, place in DEMO_TOOL_M.items() if not _is_in(place, shell))
    return Proposal(
        urdf,
        settings,
        chain,
        workspace,
        shell,
        body_of(settings, robot),
        position_m,
        text,
        (-depth_m, "itself" if nearest == NEAR_ITSELF else "the table"),
        float(limit_margins(np.array(arm.posture), settings).min()),
        tilt,
        efforts,
        unmet,
        _limits(settings, robot, is_demo=not unmet),
    )


def _limits(settings: Settings, robot: str, *, is_demo: bool) -> dict[str, ToolLimits]:
    """Limits of the tool on the way through DEMO_TOOL_M, or in the posture alone."""
    arm = ArmStage(settings, robot)
    posture = np.array(settings.arm.posture)
    orientation = np.empty(4)
    quaternion_of(arm.at(posture).rotation, orientation)
    limits = (
        limits_of_task(settings, robot, np.array([*DEMO_TOOL_M.values()]), orientation)
        if is_demo
        else {}
    )
    return limits or {ANY_DIRECTION: tool_limits(arm, settings, posture[None])}


def _with_reach_of(settings: Settings, workspace: Workspace) -> Settings:
    """The settings with the reach of a workspace."""
    shell = workspace.shell(settings.reach.min_x, settings.reach.min_z)
    reach = msgspec.structs.replace(
        settings.reach,
        centre=shell.centre,
        inner=shell.inner,
        outer=min(shell.outer, settings.reach.outer),
    )
    return msgspec.structs.replace(settings, reach=reach)


def _is_in(position: Sequence[float], shell: Shell) -> bool:
    return (
        shell.inner + REACH_MARGIN_M
        <= math.dist(position, shell.centre)
        <= shell.outer - REACH_MARGIN_M
    )


def _stand(settings: Settings) -> tuple[float, float, float]:
    """The position of the base [m] on the x axis, nearest to the origin, from which the arm reaches
    all of DEMO_TOOL_M; the origin if there is none.
    """
    x, y, z = settings.reach.centre
    inner = settings.reach.inner
    outer = settings.reach.outer
    tried = sorted((STAND_STEP_M * i for i in range(-STAND_STEPS, STAND_STEPS + 1)), key=abs)
    shells = {offset_m: Shell((x + offset_m, y, z), inner, outer) for offset_m in tried}
    best = next(
        (
            offset_m
            for offset_m in tried
            if all(_is_in(place, shells[offset_m]) for place in DEMO_TOOL_M.values())
        ),
        0.0,
    )
    return (round(best, 3), 0.0, 0.0)


def standing(
    text: str, path: Path, packages: tuple[str, ...], at: tuple[float, float, float]
) -> str:
    """The URDF with a fixed joint that puts its root at a point [m] of frame base, and with
    absolute paths of mesh files.
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


def written(proposal: Proposal, urdf: str, source: str) -> str:
    """The configuration as TOML text, with `urdf` as the path of the URDF."""
    settings = proposal.settings
    arm = proposal.settings.arm
    offset = settings.tool.plate_from_tool
    is_known = all(
        math.isfinite(joint.velocity) for joint in proposal.chain if joint.kind != "fixed"
    )
    rad, rate, acceleration, jerk = (
        f"[rad{per}; m{per} if prismatic]" if proposal.slides else f"[rad{per}]"
        for per in ("", "/s", "/s²", "/s³")
    )
    velocity = "" if is_known else f"velocity = {list(settings.joints.velocity)}  # {rate}\n"
    tool = (
        f"[tool]  # its +z leaves the plate\nplate_from_tool = {list(offset)}\n\n"
        if any(offset[3:6])
        else ""
    )
    basis = (
        "the URDF's velocities, masses and efforts" if proposal.efforts else "the URDF's velocities"
    )
    remark = "" if Path(urdf).is_absolute() else "  # beside this file"
    packages = f"packages = {json.dumps(list(arm.packages))}\n" if arm.packages else ""
    return (
        f"# A first cell for {source}, made by `thirdhand arm`. All values are proposals: check "
        "them for your arm.\n"
        "[arm]\n"
        f"urdf = {json.dumps(urdf, ensure_ascii=False)}{remark}\n"
        f"plate = {json.dumps(arm.plate, ensure_ascii=False)}  # the link that carries the tool\n"
        f"{packages}"
        f"posture = {list(arm.posture)}  # {rad} the tool over the table, pointing down and "
        "forward\n"
        'start = "held"  # after every start the arm waits for `thirdhand resume`\n'
        "\n"
        f"# The URDF's own, else a guess from {basis}: from rest to full speed in {RISE_S:g} s or "
        "more.\n"
        "# Take the values of the maker's data sheet if you have it; begin with a tenth on a real "
        "arm.\n"
        "[joints]\n"
        f"{velocity}"
        f"acceleration = {list(settings.joints.acceleration)}  # {acceleration}\n"
        f"jerk = {list(settings.joints.jerk)}  # {jerk}\n"
        "\n"
        f"{tool}"
        "[people]\n"
        "# A default: `thirdhand report` of a recording with stops has the line for this arm.\n"
        f"brake = {settings.people.brake:g}  # [m/s²]\n"
        "\n"
        f"# [reach] follows from the kinematics: {proposal.shell.inner:g} to "
        f"{proposal.shell.outer:g} m from "
        f"{list(proposal.shell.centre)}; the arm is {proposal.workspace.extent:.2f} m long.\n"
    )
