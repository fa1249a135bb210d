"""Reads an arm's URDF: the chain's joints to the tool, their limits, links' poses and shapes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple
from xml.etree import ElementTree

from service.contract.explain import ExplainedError
from service.contract.messages import Quaternion, Transform, Vector3

KINDS = ("revolute", "continuous", "prismatic")  # of joints that an arm may have
CONTINUOUS_RAD = 6000.0  # limit of a continuous joint each way: 950 turns, so that positions keep their precision


class UrdfError(ExplainedError, ValueError):
    """A robot description that cannot be used: says what is wrong with it and what would do."""


class Joint(NamedTuple):
    """A joint: the links it connects, where it sits in the parent, and for a movable one its axis
    and limits [rad, rad/s], of a prismatic one [m, m/s].
    """

    name: str
    kind: str  # as in the URDF: fixed, revolute, ...
    parent: str
    child: str
    translation: Vector3
    rotation: Quaternion
    axis: Vector3
    lower: float
    upper: float
    velocity: float
    mimics: str = ""  # the joint whose motion it follows


class Shape(NamedTuple):
    """A collision shape of a link, and where it sits in that link's frame."""

    link: str
    kind: str  # box, cylinder, sphere, capsule, mesh
    size: tuple[float, ...]
    """[m] box: edges; cylinder, capsule: radius, length along z; sphere: radius; mesh: the ends of
    the axis (2, 3) and the radius of a capsule that covers it, or nothing.
    """
    translation: Vector3
    rotation: Quaternion


class Urdf:
    """A robot description, read. Raises UrdfError."""

    def __init__(self, text: str, *, origin: str = "the URDF") -> None:
        self.origin = origin
        try:
            root = ElementTree.fromstring(text)
            self.joints = tuple(_joint(element) for element in root.iter("joint") if element.find("parent") is not None)
            self.shapes = tuple(
                _shape(link.get("name", ""), one) for link in root.iter("link") for one in link.iter("collision")
            )
        except (ElementTree.ParseError, ValueError) as error:
            raise UrdfError(f"{origin}: not a robot description: {error}") from None
        if root.tag != "robot" or not self.joints:
            raise UrdfError(f"{origin}: not a robot description: a <robot> with joints needed")
        self._above = {joint.child: joint for joint in self.joints}
        parents = {joint.parent for joint in self.joints}
        self.root = next(joint.parent for joint in self.joints if joint.parent not in self._above)
        self.leaves = tuple(joint.child for joint in self.joints if joint.child not in parents)

    def chain(self, tip: str) -> tuple[Joint, ...]:
        """The joints from the root to link `tip`, in order. Raises UrdfError."""
        found: list[Joint] = []
        link = tip
        while link != self.root:
            if link not in self._above:
                last = ", ".join(self.leaves)
                raise UrdfError(f"{self.origin}: no link {link!r}; the last ones of the arm are {last}")
            found.insert(0, self._above[link])
            link = found[0].parent
        return tuple(found)

    def above(self, link: str) -> Joint | None:
        """The joint whose child a link is; None for the root."""
        return self._above.get(link)

    def movable(self, tip: str) -> tuple[Joint, ...]:
        """The joints from the root to link `tip` that turn or slide, in order; continuous ones have
        the limits ±CONTINUOUS_RAD, and an infinite velocity where the description has none.

        Raises UrdfError for a joint of another kind, without limits, or that follows another one.
        """
        moving = tuple(_limited(joint) for joint in self.chain(tip) if joint.kind != "fixed")
        for joint in moving:
            mistake = ""
            if joint.kind not in KINDS:
                mistake = f"is {joint.kind}; {', '.join(KINDS)} or fixed needed"
            elif joint.mimics:
                mistake = f"follows {joint.mimics!r} by <mimic>; before {tip!r}, joints that move on their own needed"
            elif not joint.lower < joint.upper or not joint.velocity > 0:
                mistake = f"is {joint.kind}; a <limit> with lower below upper and a velocity above 0 needed"
                if joint.kind == "continuous":
                    mistake = "is continuous; a <limit> with a velocity above 0, or none, needed"
            if mistake:
                raise UrdfError(f"{self.origin}: joint {joint.name!r} {mistake}")
        if not moving:
            raise UrdfError(f"{self.origin}: no movable joint before link {tip!r}")
        return moving

    def transforms(self, positions: Mapping[str, float]) -> list[Transform]:
        """Each link in its parent link, for joint positions by name [rad, m]; others are at 0."""
        return [_moved(joint, positions.get(joint.name, 0.0)) for joint in self.joints]


def _moved(joint: Joint, position: float) -> Transform:
    """A joint's child link in its parent link."""
    at, turn = joint.translation, joint.rotation
    if position and joint.kind == "prismatic":
        dx, dy, dz = rotated(turn, joint.axis)
        at = (at[0] + position * dx, at[1] + position * dy, at[2] + position * dz)
    elif position:
        turn = multiply(turn, about(joint.axis, position))
    return Transform(joint.parent, joint.child, at, turn)


def _limited(joint: Joint) -> Joint:
    """The joint with limits of its position, which a continuous one does not have; its velocity
    need not be limited either.
    """
    if joint.kind != "continuous":
        return joint
    velocity = math.inf if math.isnan(joint.velocity) else joint.velocity
    return joint._replace(lower=-CONTINUOUS_RAD, upper=CONTINUOUS_RAD, velocity=velocity)


def with_one_coordinate(text: str) -> str:
    """The text of a description whose continuous joints are revolute ones with wide limits.

    Libraries describe a continuous joint by cosine and sine, in which its turns are lost.
    """
    if "continuous" not in text:
        return text
    root = ElementTree.fromstring(text)
    for joint in root.iter("joint"):
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")
            found = joint.find("limit")
            limit = ElementTree.SubElement(joint, "limit") if found is None else found
            limit.set("lower", str(-CONTINUOUS_RAD))
            limit.set("upper", str(CONTINUOUS_RAD))
            limit.set("velocity", limit.get("velocity", "0"))
            limit.set("effort", limit.get("effort", "0"))
    return ElementTree.tostring(root, encoding="unicode")


def _joint(element: ElementTree.Element) -> Joint:
    origin, limit, mimic = element.find("origin"), element.find("limit"), element.find("mimic")
    x, y, z = _three(element.find("axis"), "xyz", "1 0 0")
    norm = math.sqrt(x * x + y * y + z * z) or math.nan
    lower, upper, velocity = (
        float("nan" if limit is None else limit.get(name, "nan")) for name in ("lower", "upper", "velocity")
    )
    return Joint(
        element.get("name", ""),
        element.get("type", ""),
        _link(element, "parent"),
        _link(element, "child"),
        _three(origin, "xyz", "0 0 0"),
        _turn(origin),
        (x / norm, y / norm, z / norm),
        lower,
        upper,
        velocity,
        "" if mimic is None else mimic.get("joint", "another joint"),
    )


COVER = "covered_by"  # an attribute of a mesh, which is ours: others do not look at it
SIZES = {"box": ("size",), "cylinder": ("radius", "length"), "capsule": ("radius", "length"), "sphere": ("radius",)}


def _shape(link: str, element: ElementTree.Element) -> Shape:
    geometry, origin = element.find("geometry"), element.find("origin")
    if geometry is None or not len(geometry):
        raise ValueError(f"a collision of link {link!r} without geometry")
    kind, given = geometry[0].tag, geometry[0]
    size = tuple(float(number) for name in SIZES.get(kind, ()) for number in given.get(name, "nan").split())
    if not all(0.0 < number < math.inf for number in size):
        raise ValueError(f"the {kind} of link {link!r} has no size")
    if kind == "mesh":
        size = tuple(float(number) for number in given.get(COVER, "").split())
    return Shape(link, kind, size, _three(origin, "xyz", "0 0 0"), _turn(origin))


def _turn(origin: ElementTree.Element | None) -> Quaternion:
    roll, pitch, yaw = _three(origin, "rpy", "0 0 0")
    return multiply(about((0, 0, 1), yaw), multiply(about((0, 1, 0), pitch), about((1, 0, 0), roll)))


def _link(element: ElementTree.Element, which: str) -> str:
    found = element.find(which)
    return "" if found is None else found.get("link", "")


def _three(element: ElementTree.Element | None, name: str, default: str) -> Vector3:
    text = default if element is None else element.get(name, default)
    x, y, z = (float(number) for number in text.split())
    return x, y, z


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The rotation b followed by the rotation a; x y z w."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotated(turn: Quaternion, vector: Sequence[float]) -> Vector3:
    """A vector, rotated by a quaternion of norm 1."""
    x, y, z, w = turn
    product = multiply(multiply(turn, (vector[0], vector[1], vector[2], 0.0)), (-x, -y, -z, w))
    return product[:3]


def about(axis: Sequence[float], angle: float) -> Quaternion:
    """The rotation by `angle` [rad] about a unit axis; x y z w."""
    half = math.sin(angle / 2)
    return (axis[0] * half, axis[1] * half, axis[2] * half, math.cos(angle / 2))
