"""The arm's URDF as the engines read it."""

from __future__ import annotations

import math
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from service.core.separation.body import body_of
from service.settings.config import Settings, robot_description
from service.settings.urdf import Urdf

NO_INERTIA = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")
UNKNOWN_KG = "1"  # of a link that a joint moves and of which the URDF does not say a mass: engines move none without
UNKNOWN_INERTIA = {**NO_INERTIA, "ixx": "0.01", "iyy": "0.01", "izz": "0.01"}  # [kg m²]
SHORTEST = 1e-3  # [m] of a capsule's axis; without one it is a sphere


def simulated(settings: Settings, **compiler: str) -> str:
    """The arm's URDF, in which what is no joint of the chain is fixed.

    An arm of meshes, whose files no engine would find, is of the capsules by which the service
    keeps its distances. `compiler` are settings of MuJoCo's.
    """
    text, names = robot_description(settings), settings.joints.names
    robot, urdf = ElementTree.fromstring(text), Urdf(text)
    for joint in robot.findall("joint"):
        if joint.get("name") not in names:
            joint.set("type", "fixed")
    links = {link.get("name"): link for link in robot.findall("link")}
    driven = {joint.child for joint in urdf.joints if joint.name in names}
    for name, link in links.items():
        if not _is_massive(link):
            for without in link.findall("inertial"):
                link.remove(without)
            inertial = SubElement(link, "inertial")  # without one PyBullet gives 1 kg to mere frames, too
            SubElement(inertial, "mass", value=UNKNOWN_KG if name in driven else "0")
            SubElement(inertial, "inertia", UNKNOWN_INERTIA if name in driven else NO_INERTIA)
    if robot.find(".//mesh") is not None:
        for link in links.values():
            for shape in [*link.findall("visual"), *link.findall("collision")]:
                link.remove(shape)
        moved = {joint.name: joint.child for joint in urdf.joints}
        for capsule in body_of(settings, text).capsules:
            number = int(capsule["link"])
            link = links[moved[names[number - 1]] if number else urdf.root]
            _cover(link, capsule["ends"].tolist(), float(capsule["radius"]))
    if compiler:
        SubElement(SubElement(robot, "mujoco"), "compiler", compiler)
    return ElementTree.tostring(robot, encoding="unicode")


def _is_massive(link: Element) -> bool:
    """True if a link has a mass and moments of inertia."""
    mass, inertia = link.find("inertial/mass"), link.find("inertial/inertia")
    return mass is not None and inertia is not None and float(mass.get("value", "0")) > 0.0


def _cover(link: Element, ends: list[list[float]], radius: float) -> None:
    """Gives a link a capsule between two ends [m], to be seen and to touch."""
    start, end = ends
    (x, y, z), middle = (end[i] - start[i] for i in range(3)), [(start[i] + end[i]) / 2 for i in range(3)]
    for use in ("visual", "collision"):
        shape = SubElement(link, use)
        turn = f"0 {math.atan2(math.hypot(x, y), z)} {math.atan2(y, x)}"
        SubElement(shape, "origin", xyz=" ".join(map(str, middle)), rpy=turn)
        length = math.hypot(x, y, z)
        long = length > SHORTEST
        made = SubElement(SubElement(shape, "geometry"), "capsule" if long else "sphere", radius=str(radius))
        if long:
            made.set("length", str(length))
