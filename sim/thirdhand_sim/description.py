"""The arm's URDF in a form for the physics engines."""

from __future__ import annotations

import math
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from thirdhand.core.separation.body import body_of
from thirdhand.settings.config import Settings, robot_description
from thirdhand.settings.urdf import Urdf

NO_INERTIA = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")
# mass of moving links without one in the URDF, because engines move no link without a mass
UNKNOWN_KG = "1"
UNKNOWN_INERTIA = {**NO_INERTIA, "ixx": "0.01", "iyy": "0.01", "izz": "0.01"}  # [kg m²]
SHORTEST = 1e-3  # [m] a capsule with a shorter axis becomes a sphere


def simulated(settings: Settings, **compiler: str) -> str:
    """The arm's URDF, in which all joints outside the chain are fixed.

    Meshes, whose files the engines would not find, are replaced by the capsules that the service
    uses for distances. `compiler` has settings of MuJoCo.
    """
    text = robot_description(settings)
    names = settings.joints.names
    robot = ElementTree.fromstring(text)
    urdf = Urdf(text)
    for joint in robot.findall("joint"):
        if joint.get("name") not in names:
            joint.set("type", "fixed")
    links = {link.get("name", ""): link for link in robot.findall("link")}
    driven = {joint.child for joint in urdf.joints if joint.name in names}
    for name, link in links.items():
        if not _is_massive(link):
            _weigh(link, is_driven=name in driven)
    if robot.find(".//mesh") is not None:
        _cover_links(links, settings, urdf, text)
    if compiler:
        SubElement(SubElement(robot, "mujoco"), "compiler", compiler)
    return ElementTree.tostring(robot, encoding="unicode")


def _weigh(link: Element, *, is_driven: bool) -> None:
    """Give a link a mass: without one, PyBullet gives 1 kg also to links without a body."""
    for without in link.findall("inertial"):
        link.remove(without)
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "mass", value=UNKNOWN_KG if is_driven else "0")
    SubElement(inertial, "inertia", UNKNOWN_INERTIA if is_driven else NO_INERTIA)


def _cover_links(links: dict[str, Element], settings: Settings, urdf: Urdf, text: str) -> None:
    """Replace all shapes of the links by the capsules of the arm's body."""
    for link in links.values():
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    names = settings.joints.names
    moved = {joint.name: joint.child for joint in urdf.joints}
    for capsule in body_of(settings, text).capsules:
        number = int(capsule["link"])
        link = links[moved[names[number - 1]] if number else urdf.root]
        _cover(link, capsule["ends"].tolist(), float(capsule["radius"]))


def _is_massive(link: Element) -> bool:
    """True if a link has a mass above 0 and moments of inertia."""
    mass = link.find("inertial/mass")
    inertia = link.find("inertial/inertia")
    return mass is not None and inertia is not None and float(mass.get("value", "0")) > 0.0


def _cover(link: Element, ends: list[list[float]], radius: float) -> None:
    """Give a link a visible and colliding capsule between two ends [m]."""
    start, end = ends
    x, y, z = (end[i] - start[i] for i in range(3))
    middle = [(start[i] + end[i]) / 2 for i in range(3)]
    for use in ("visual", "collision"):
        shape = SubElement(link, use)
        turn = f"0 {math.atan2(math.hypot(x, y), z)} {math.atan2(y, x)}"
        SubElement(shape, "origin", xyz=" ".join(map(str, middle)), rpy=turn)
        length = math.hypot(x, y, z)
        long = length > SHORTEST
        geometry = SubElement(
            SubElement(shape, "geometry"), "capsule" if long else "sphere", radius=str(radius)
        )
        if long:
            geometry.set("length", str(length))
