"""An arm's URDF: the chain's joints to the tool, their limits, links' poses and shapes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from thirdhand.contract.explain import ExplainedError, did_you_mean
from thirdhand.contract.messages import Quaternion, Transform, Vector3
from thirdhand.settings.link_tree import root_of
from thirdhand.settings.robot_xml import (
    Element,
    check_numbers,
    element_of,
    kinematics,
    numbers,
    three,
    unread,
)

JOINT_KINDS = ("revolute", "continuous", "prismatic")  # an arm's chain may have these
# limit of a continuous joint to either side: within 950 turns, positions remain precise
CONTINUOUS_RAD = 6000.0


class UrdfError(ExplainedError, ValueError):
    """A robot description cannot be used; the message has the cause and the remedy."""


class UrdfJoint(NamedTuple):
    """A joint: the links that it connects, its pose in the parent link, and if it is movable its
    axis and limits [rad, rad/s], for a prismatic joint [m, m/s].
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
    acceleration: float = math.inf  # [rad/s², m/s²] inf: not given
    jerk: float = math.inf  # [rad/s³, m/s³] inf: not given
    mistake: str = ""  # the reason why it cannot be a joint of the chain


class Shape(NamedTuple):
    """A collision shape of a link, and its pose in that link's frame."""

    link: str
    kind: str  # box, cylinder, sphere, capsule, mesh
    size: tuple[float, ...]
    """[m] box: edges; cylinder, capsule: radius, length along z; sphere: radius; mesh: ends of the
    axis (2, 3) and radius of a capsule that covers it, or empty.
    """
    translation: Vector3
    rotation: Quaternion


class Urdf:
    """A robot description, parsed. Raises UrdfError."""

    def __init__(self, text: str, *, origin: str = "the URDF") -> None:
        self.origin = origin
        try:
            self._robot = element_of(text)
            self.joints = tuple(_joint(element) for element in self._robot.findall("joint"))
            self._check_version()
            links = [link.get("name", "") for link in self._robot.findall("link")]
            self.root = root_of(links, self.joints)
            check_numbers(self._robot)
            self.shapes = _shapes(self._robot)
        except ValueError as error:
            raise UrdfError(f"{origin}: not a robot description: {error}") from None
        self._above = {joint.child: joint for joint in self.joints}
        parents = {joint.parent for joint in self.joints}
        self.leaves = tuple(joint.child for joint in self.joints if joint.child not in parents)

    def _check_version(self) -> None:
        """Raise ValueError if this is no robot, or in a version that is not supported."""
        if self._robot.tag != "robot" or not self.joints:
            raise ValueError("a <robot> with joints needed")
        if (version := self._robot.get("version", "1.0")) not in VERSIONS:
            raise ValueError(f"version {version!r}; {', '.join(VERSIONS)} accepted")

    def chain(self, tip: str) -> tuple[UrdfJoint, ...]:
        """The joints from the root to link `tip`, in order. Raises UrdfError."""
        joints: list[UrdfJoint] = []
        link = tip
        while link != self.root:
            if link not in self._above:
                last = ", ".join(self.leaves) + did_you_mean(link, self._above)
                raise UrdfError(
                    f"{self.origin}: no link {link!r}; the last ones of the arm are {last}"
                )
            joints.append(self._above[link])
            link = joints[-1].parent
        return tuple(reversed(joints))

    def kinematics(self, names: Sequence[str]) -> str:
        """A URDF with links and joints only, in which the joints of these names move."""
        return kinematics(
            self._robot, {joint.name: joint.axis for joint in self.joints if joint.name in names}
        )

    def above(self, link: str) -> UrdfJoint | None:
        """The joint that carries a link; None for the root."""
        return self._above.get(link)

    def movable(self, tip: str) -> tuple[UrdfJoint, ...]:
        """The joints from the root to link `tip` that turn or slide, in order. Continuous joints
        get the limits ±CONTINUOUS_RAD, and an infinite velocity if the description has none.

        Raises UrdfError for a joint of another kind, without limits, or that mimics another one,
        and for more than MAX_MOVING joints.
        """
        moving = tuple(_limited(joint) for joint in self.chain(tip) if joint.kind != "fixed")
        for joint in moving:
            mistake = joint.mistake or _lack(joint)
            if joint.kind not in JOINT_KINDS:
                mistake = f"is {joint.kind}; {', '.join(JOINT_KINDS)} or fixed needed"
            elif joint.mimics:
                mistake = (
                    f"follows {joint.mimics!r} by <mimic>; before {tip!r}, joints that move on "
                    "their own needed"
                )
            if mistake:
                raise UrdfError(f"{self.origin}: joint {joint.name!r} {mistake}")
        if len(moving) > MAX_MOVING:
            raise UrdfError(
                f"{self.origin}: {len(moving)} joints move before link {tip!r}; up to {MAX_MOVING} "
                "accepted"
            )
        if not moving:
            raise UrdfError(f"{self.origin}: no movable joint before link {tip!r}")
        return moving

    def transforms(self, positions: Mapping[str, float]) -> list[Transform]:
        """Poses of links in their parent links, for joint positions by name [rad, m], else 0."""
        return [_moved(joint, positions.get(joint.name, 0.0)) for joint in self.joints]


def _shapes(robot: Element) -> tuple[Shape, ...]:
    """The collision shapes of a robot. Raises ValueError for more than MAX_SHAPES."""
    shapes = tuple(
        _shape(link.get("name", ""), collision)
        for link in robot.findall("link")
        for collision in link.findall("collision")
    )
    if len(shapes) > MAX_SHAPES:
        raise ValueError(
            f"{len(shapes)} collision shapes; up to {MAX_SHAPES} accepted: give links fewer"
        )
    return shapes


def _moved(joint: UrdfJoint, position: float) -> Transform:
    """Pose of a joint's child link in its parent link."""
    translation = joint.translation
    turn = joint.rotation
    if position and joint.kind == "prismatic":
        dx, dy, dz = rotated(turn, joint.axis)
        translation = (
            translation[0] + position * dx,
            translation[1] + position * dy,
            translation[2] + position * dz,
        )
    elif position:
        turn = multiply(turn, about(joint.axis, position))
    return Transform(joint.parent, joint.child, translation, turn)


def _limited(joint: UrdfJoint) -> UrdfJoint:
    """The joint; a continuous one with the limits ±CONTINUOUS_RAD, and with an infinite velocity if
    the description does not limit it.
    """
    if joint.kind != "continuous":
        return joint
    velocity = math.inf if math.isnan(joint.velocity) else joint.velocity
    return joint._replace(lower=-CONTINUOUS_RAD, upper=CONTINUOUS_RAD, velocity=velocity)


def _lack(joint: UrdfJoint) -> str:
    """The reason why a joint of the chain cannot be moved; empty if it can."""
    is_continuous = joint.kind == "continuous"
    unit = "m" if joint.kind == "prismatic" else "rad"
    if not any(joint.axis):
        return "has the axis 0 0 0; a direction needed"
    if not is_continuous and not -MAX_JOINT_LIMIT <= joint.lower < joint.upper <= MAX_JOINT_LIMIT:
        problem = f"has the limits {_or_none(joint.lower)} to {_or_none(joint.upper)}"
        return (
            f"{problem}; lower below upper, within {MAX_JOINT_LIMIT:g} {unit}, needed in its "
            "<limit> and soft limits"
        )
    if not 0.0 < joint.velocity <= MAX_JOINT_LIMIT and not (
        is_continuous and joint.velocity == math.inf
    ):
        problem = f"has the velocity {_or_none(joint.velocity)}"
        return f"{problem}; above 0, up to {MAX_JOINT_LIMIT:g} {unit}/s, needed in its <limit>"
    if not min(joint.acceleration, joint.jerk) > 0.0:
        problem = f"has the acceleration {joint.acceleration:g} and the jerk {joint.jerk:g}"
        return f"{problem}; numbers above 0 needed in its <limit>"
    return ""


def _or_none(number: float) -> str:
    return "none" if math.isnan(number) else f"{number:g}"


def _joint(element: Element) -> UrdfJoint:
    name = element.get("name", "")
    kind = element.get("type", "")
    origin = element.find("origin")
    limit = element.find("limit")
    mimic = element.find("mimic")
    soft = element.find("safety_controller") if kind != "continuous" else None
    soft_lower, soft_upper = (_limit(soft, f"soft_{side}_limit") for side in ("lower", "upper"))
    if soft_lower == soft_upper == 0.0:  # as if they were not given
        soft_lower = soft_upper = math.nan
    acceleration, deceleration, jerk = (
        _limit(limit, name) for name in ("acceleration", "deceleration", "jerk")
    )
    try:
        x, y, z = three(element.find("axis"), "xyz", "1 0 0")
        # a joint with the axis 0 0 0 cannot move: `movable` rejects it
        norm = math.hypot(x, y, z) or 1.0
        return UrdfJoint(
            name,
            kind,
            _link(element, "parent"),
            _link(element, "child"),
            three(origin, "xyz", "0 0 0"),
            _turn(origin),
            (x / norm, y / norm, z / norm),
            max(filter(_is_given, (_limit(limit, "lower"), soft_lower)), default=math.nan),
            min(filter(_is_given, (_limit(limit, "upper"), soft_upper)), default=math.nan),
            _limit(limit, "velocity"),
            "" if mimic is None else mimic.get("joint", "another joint"),
            min(filter(_is_given, (acceleration, deceleration)), default=math.inf),
            jerk if _is_given(jerk) else math.inf,
            _mistake(element),
        )
    except ValueError as error:
        raise ValueError(f"joint {name!r}: {error}") from None


def _is_given(number: float) -> bool:
    return not math.isnan(number)


def _mistake(joint: Element) -> str:
    """The attribute of an axis or of limits that would be ignored; empty without one."""
    for tag, accepted in ATTRIBUTES.items():
        for element in joint.findall(tag):
            for name in element.attrib:
                if name not in accepted:
                    return f"cannot be read: {unread(tag, name, accepted)}"
                if name in OPTIONAL and math.isnan(_limit(element, name)):
                    return f"has <{tag} {name}={element.get(name)!r}>; a number needed"
    return ""


def _limit(limit: Element | None, which: str) -> float:
    """A limit; NaN if it is missing or not a number, as only joints of the chain need limits."""
    try:
        return math.nan if limit is None else float(limit.get(which, "nan"))
    except ValueError:
        return math.nan


COVER = "covered_by"  # our own attribute of a mesh with its capsule; other readers ignore it
SIZES = {
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
    "sphere": ("radius",),
}
# numbers in the attributes of SIZES
SIZE_COUNTS = {
    "box": 3,
    "cylinder": 2,
    "capsule": 2,
    "sphere": 1,
}
VERSIONS = ("1", "1.0", "1.1", "1.2")
ATTRIBUTES = {  # attributes that are read, for joints of the chain
    "axis": {"xyz"},
    "limit": {"lower", "upper", "velocity", "effort", "acceleration", "deceleration", "jerk"},
    "safety_controller": {"soft_lower_limit", "soft_upper_limit", "k_position", "k_velocity"},
}
OPTIONAL = ("acceleration", "deceleration", "jerk", "soft_lower_limit", "soft_upper_limit")
MAX_MOVING = 32  # joints before the tool; arms have 7, humanoids 12 with their torso
MAX_JOINT_LIMIT = 1000.0  # [rad, rad/s, m, m/s] larger limits are rejected as mistakes
MAX_SHAPES = 500  # an arm with a hand has 30


def _shape(link: str, element: Element) -> Shape:
    geometry = element.find("geometry")
    origin = element.find("origin")
    if geometry is None or not len(geometry):
        raise ValueError(f"a collision of link {link!r} without geometry")
    kind = geometry[0].tag
    shape = geometry[0]
    try:
        if kind == "mesh":
            size = numbers(shape, COVER, "")
        elif kind in SIZES:
            size = tuple(number for name in SIZES[kind] for number in numbers(shape, name, ""))
            if len(size) != SIZE_COUNTS[kind] or not all(number > 0.0 for number in size):
                raise ValueError(
                    f"<{kind}> has no size; {' and '.join(SIZES[kind])} above 0 needed"
                )
        else:
            raise ValueError(f"<{kind}> is no shape; {', '.join(SIZES)} and mesh accepted")
        return Shape(link, kind, size, three(origin, "xyz", "0 0 0"), _turn(origin))
    except ValueError as error:
        raise ValueError(f"the collision of link {link!r}: {error}") from None


def _turn(origin: Element | None) -> Quaternion:
    roll, pitch, yaw = three(origin, "rpy", "0 0 0")
    return multiply(
        about((0, 0, 1), yaw), multiply(about((0, 1, 0), pitch), about((1, 0, 0), roll))
    )


def _link(element: Element, which: str) -> str:
    child = element.find(which)
    return "" if child is None else child.get("link", "")


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The rotation b followed by the rotation a, as quaternions x y z w."""
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
