"""`thirdhand arm`: a report on an arm's URDF, and a first cell for the arm."""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree import ElementTree

from thirdhand.cli.usage import check_writable
from thirdhand.contract.explain import ExplainedError
from thirdhand.settings.arm_description import description
from thirdhand.settings.config import load
from thirdhand.settings.mesh_cover import unfound
from thirdhand.settings.whole_file import whole
from thirdhand.workbench.first_cell.arm_picture import draw
from thirdhand.workbench.first_cell.first_cell import DEMO_TOOL_M, Proposal, proposed, written
from thirdhand.workbench.first_cell.rates import JERK_RATE, RISE_S, TORQUE_SHARE

DEGREES = 7.0  # [rad] larger limits of a revolute joint are probably in degrees


class ExistsError(ExplainedError):
    """A file exists already, and is not overwritten."""


def arm(args: argparse.Namespace) -> int:
    """Exit code 0 once the cell is written and loads.

    Raises SettingsError, UrdfError, ExistsError, OSError.
    """
    cell: Path = args.output
    picture = cell.with_suffix(".png")
    standing = cell.with_name(f"{cell.stem}.urdf")
    check_writable(cell, ".toml")
    for file in (cell, picture):
        if file.exists():
            raise ExistsError(f"{file} exists already: name another file by --output, or remove it")
    proposal = proposed(
        args.urdf,
        plate=args.plate,
        packages=tuple(str(Path(folder).absolute()) for folder in args.packages or ()),
        stand=None if args.at is None else tuple(args.at),
    )
    if proposal.text and standing.exists():
        raise ExistsError(f"{standing} exists already: name another cell by --output, or remove it")
    files = [cell, picture, *([standing] if proposal.text else [])]
    _write(proposal, args.urdf, files)
    print(text(proposal, args.urdf))
    print(f"\nwritten: {', '.join(map(str, files))}")
    print(f"next:    thirdhand {'serve --config' if proposal.unmet else 'demo --arm'} {cell}")
    return 0


def _write(proposal: Proposal, urdf: Path, files: Sequence[Path]) -> None:
    """Write a cell that loads, its picture and, for an arm that stands elsewhere, its URDF; all or
    none of these files.
    """
    cell, picture, *standing = files
    with contextlib.ExitStack() as undo:
        for file in files:
            undo.callback(file.unlink, missing_ok=True)
        for file in standing:
            _write_text(file, proposal.text)
        named = _named(standing[0] if standing else urdf, cell.parent)
        _write_text(cell, written(proposal, named, urdf.name))
        load(cell)
        draw(proposal, picture)
        undo.pop_all()


def _write_text(path: Path, content: str) -> None:
    with whole(path) as part:
        part.write_text(content, encoding="utf-8")


def _named(urdf: Path, folder: Path) -> str:
    """The file's path relative to a folder that contains it, or else its absolute path."""
    try:
        return str(urdf.absolute().relative_to(folder.absolute()))
    except ValueError:
        return str(urdf.absolute())


def text(proposal: Proposal, path: Path) -> str:
    """The report in text: the arm by its URDF, and the proposed settings."""
    urdf = proposal.urdf
    others = [leaf for leaf in urdf.leaves if leaf != proposal.plate]
    ends = f"; other ends: {', '.join(others[:4])}" if others else ""
    lines = [
        f"{path.name}: {len(urdf.joints) + 1} links, {len(proposal.settings.joints.names)} joints "
        "before the plate",
        f"  plate     {proposal.plate}{ends}",
        f"  units     metres and radians, as a URDF has them: the chain is {_length(proposal):.2f} "
        "m long",
        "",
        *_joints(proposal),
        "",
        *_body(proposal, path),
        *_reach(proposal),
        *_tool(proposal),
        *_base(proposal),
        *_demo(proposal),
    ]
    return "\n".join(lines)


def _joints(proposal: Proposal) -> Iterator[str]:
    """The table of the joints' limits, and their origin."""
    limits = proposal.settings.joints
    yield (
        f"  {'joint':<28} {'kind':<10} {'lower':>8} {'upper':>8} {'velocity':>9} "
        f"{'acceleration':>13} {'jerk':>6}"
    )
    for joint in proposal.chain:
        if joint.name in limits.names:
            i = limits.names.index(joint.name)
            yield (
                f"  {joint.name:<28} {joint.kind:<10} {limits.lower[i]:8.2f} "
                f"{limits.upper[i]:8.2f} {limits.velocity[i]:9.2f} {limits.acceleration[i]:13.2f} "
                f"{limits.jerk[i]:6.0f}"
            )
    if proposal.slides:
        yield "  prismatic joints are in m, m/s, m/s², m/s³"
    yield (
        "  [rad, rad/s, rad/s², rad/s³]; accelerations and jerks are a guess: from rest to full "
        "speed in"
    )
    basis = (
        f"at most {100 * TORQUE_SHARE:.0f} % of the URDF's efforts"
        if proposal.efforts
        else "no efforts in the URDF"
    )
    yield (
        f"  {RISE_S:g} s or more, {basis}, jerk = {JERK_RATE:g}/s * acceleration. See the data "
        "sheet"
    )
    if wide := _in_degrees(proposal):
        yield f"  limits of {', '.join(wide)} exceed a turn: a URDF has radians, not degrees"


def _in_degrees(proposal: Proposal) -> list[str]:
    """The names of revolute joints whose upper limits are probably in degrees."""
    limits = proposal.settings.joints
    revolute = {joint.name for joint in proposal.chain if joint.kind == "revolute"}
    return [
        name
        for name, upper in zip(limits.names, limits.upper, strict=True)
        if name in revolute and upper > DEGREES
    ]


def _body(proposal: Proposal, path: Path) -> Iterator[str]:
    """The capsules that cover the arm, and the meshes and shapes that are missing."""
    settings = proposal.settings
    radii = proposal.body.capsules["radius"]
    yield (
        f"  body      {len(radii)} capsules with radii from {radii.min():.3f} to {radii.max():.3f} "
        f"m; {len(proposal.body.pairs)} pairs of them are checked for collision"
    )
    raw = ElementTree.fromstring(description(path, cover=False))
    if lost := unfound(raw, path, settings.arm.packages, "visual"):
        yield f"  meshes    {lost}."
        yield (
            "            The service does not need them. Drawings show the capsules of the "
            "collision shapes instead."
        )
    names = settings.joints.names
    covered = {_link(proposal, shape.link) for shape in proposal.urdf.shapes}
    if bare := sorted({*range(len(names) + 1)} - covered):
        yield (
            f"            no collision shape {' and '.join(_bare(names, i) for i in bare)}: "
            f"a capsule of [arm] link_radius = {settings.arm.link_radius:g} m replaces it"
        )


def _reach(proposal: Proposal) -> Iterator[str]:
    """The arm's reach, and its posture."""
    settings = proposal.settings
    shell = proposal.shell
    x, y, z = shell.centre
    posture = ", ".join(f"{value:.3f}" for value in settings.arm.posture)
    yield (
        f"  reach     {shell.inner:.2f} to {shell.outer:.2f} m from ({x:.2f}, {y:.2f}, {z:.2f}), "
        f"where z ≥ {settings.reach.min_z:g} m and x ≥ {settings.reach.min_x:g} m"
    )
    yield f"  posture   [{posture}] rad{', m for prismatic joints' if proposal.slides else ''}"
    yield (
        f"            the tool is {math.degrees(proposal.tilt):.0f}° from straight down, the arm "
        f"{100 * proposal.clearance[0]:.0f} cm from {proposal.clearance[1]}, and the nearest limit "
        f"{100 * proposal.margin:.0f} % of half a range away"
    )


def _tool(proposal: Proposal) -> Iterator[str]:
    """The tool's limits by the joints and by the settings, and the tool's axes."""
    tool = proposal.settings.tool
    where = "in this posture" if proposal.unmet else "where the demo's tool goes"
    for number, (direction, limit) in enumerate(proposal.tool_limits.items()):
        yield f"  {'' if number else 'can do':<9} {direction}, {where}: {limit.text}"
    yield (
        f"            [tool] allows {tool.max_speed:g} m/s and {tool.acceleration:g} m/s²; a joint "
        "in brackets allows less"
    )
    if any(tool.plate_from_tool[3:6]):
        yield (
            "  tool      the plate's +z does not point away from the arm: [tool] plate_from_tool "
            f"turns it, ({', '.join(f'{value:g}' for value in tool.plate_from_tool[3:])}) "
            "as x y z w"
        )


def _base(proposal: Proposal) -> Iterator[str]:
    """The position of an arm that does not stand at the origin."""
    if proposal.text:
        x, y, z = proposal.stand
        yield (
            f"  base      the URDF's root is at ({x:g}, {y:g}, {z:g}) m of frame base; --at 0 0 0 "
            "puts it at the origin"
        )


def _demo(proposal: Proposal) -> Iterator[str]:
    """The tool positions of the demo that the arm does not reach."""
    if proposal.unmet:
        far = ", ".join(
            f"{name} at {math.dist(DEMO_TOOL_M[name], proposal.shell.centre):.2f} m"
            for name in proposal.unmet
        )
        yield (
            f"  demo      its scene is out of reach, which needs the tool for {far}. The demo "
            "moves things by at most\n"
            "            15 cm; teach tasks of this arm's size (docs/tutorial.md)"
        )


def _bare(names: tuple[str, ...], link: int) -> str:
    """The position of a link in the chain, by the number of joints that move it."""
    return f"after {names[link - 1]}" if link else f"before {names[0]}"


def _length(proposal: Proposal) -> float:
    return sum(math.hypot(*joint.translation) for joint in proposal.chain)


def _link(proposal: Proposal, link: str) -> int:
    """Number of joints of the chain that move a link."""
    names = proposal.settings.joints.names
    while (joint := proposal.urdf.above(link)) is not None:
        if joint.name in names:
            return names.index(joint.name) + 1
        link = joint.parent
    return 0
