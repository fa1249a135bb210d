"""The XML of a robot's description, read in bounded time.

Undeclared prefixes are accepted, because other readers of URDF accept them. Elements with a prefix
are ignored: they hold nothing that a URDF defines.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from xml.etree import ElementTree
from xml.parsers import expat

Element = ElementTree.Element
MAX_DEPTH = 64  # nested elements; a URDF needs 6
MAX_ELEMENTS = 100_000  # an arm with a hand has about 1000
# Pinocchio requires a <limit>
ANY_LIMIT = {
    "lower": "-1e4",
    "upper": "1e4",
    "velocity": "1e4",
    "effort": "0",
}
MAX_NUMBER = 1e6  # largest magnitude of any number of a link or joint
NUMERIC = {  # attributes with numbers by element, in addition to xyz and rpy
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
    "sphere": ("radius",),
    "mesh": ("scale",),
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
}
QUATERNION = "quat_xyzw"  # of URDF 1.1, read as the equal `rpy`
ORIGIN_ATTRIBUTES = {"xyz", "rpy"}  # attributes of an <origin> that are read
MAX_NORM_ERROR = 1e-3  # of a quaternion
MIN_COSINE = 1e-9  # of a pitch at which roll and yaw differ
MACROS = (
    "its macros are not expanded: make a URDF of it first, by `xacro arm.urdf.xacro > arm.urdf`"
)


def element_of(text: str | bytes) -> Element:
    """The outermost element, without elements and attributes that have a prefix.

    Bytes are decoded by their XML declaration. Raises ValueError for text that is not XML, is
    nested too deeply, has too many elements, or holds xacro macros.
    """
    encoded = text if isinstance(text, bytes) else text.encode("utf-8", "replace")
    encoding = None if isinstance(text, bytes) else "utf-8"
    try:
        return _ElementReader(encoding).element(encoded)
    except (expat.ExpatError, LookupError) as error:  # LookupError: an unknown encoding
        raise ValueError(f"no XML: {error}") from None


class _ElementReader:
    """Builds the elements of one document."""

    def __init__(self, encoding: str | None) -> None:
        self._builder = ElementTree.TreeBuilder()
        self._open_tags: list[str] = []
        self._count = 0  # elements
        self._foreign_count = 0  # open elements with a prefix, and inside one
        self._parser = expat.ParserCreate(encoding)
        self._parser.buffer_text = True
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.CharacterDataHandler = self._characters

    def element(self, encoded: bytes) -> Element:
        """The outermost element of the document. Raises ValueError and ExpatError."""
        self._parser.Parse(encoded, True)
        return self._builder.close()

    def _error(self, problem: str) -> ValueError:
        return ValueError(f"line {self._parser.CurrentLineNumber}: {problem}")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._count += 1
        self._open_tags.append(tag)
        if len(self._open_tags) > MAX_DEPTH:
            raise self._error(f"more than {MAX_DEPTH} elements in each other")
        if self._count > MAX_ELEMENTS:
            raise self._error(f"more than {MAX_ELEMENTS} elements")
        if self._is_macro(tag, attributes):
            raise self._error(f"<{tag}>: {MACROS}")
        if self._foreign_count or ":" in tag:
            self._foreign_count += 1
            return

        plain = {name: value for name, value in attributes.items() if ":" not in name}
        if tag == "origin" and QUATERNION in plain:
            if "rpy" in plain:
                raise self._error(f"<origin> has rpy and {QUATERNION}; one needed")
            plain["rpy"] = _rpy(Element(tag, {QUATERNION: plain.pop(QUATERNION)}))
        self._builder.start(tag, plain)

    def _is_macro(self, tag: str, attributes: Mapping[str, str]) -> bool:
        """True for an element of xacro, and for a link or joint with its expressions."""
        is_part = len(self._open_tags) > 1 and self._open_tags[1] in ("link", "joint")
        return tag.startswith("xacro:") or (
            is_part and any("${" in value or "$(" in value for value in attributes.values())
        )

    def _end(self, tag: str) -> None:
        self._open_tags.pop()
        if self._foreign_count:
            self._foreign_count -= 1
        else:
            self._builder.end(tag)

    def _characters(self, data: str) -> None:
        if not self._foreign_count and self._open_tags:
            self._builder.data(data)


def _rpy(origin: Element) -> str:
    """Roll, pitch and yaw of an origin's quaternion. Raises ValueError."""
    quaternion = numbers(origin, QUATERNION, "")
    norm = math.hypot(*quaternion)
    if len(quaternion) != 4 or abs(norm - 1.0) > MAX_NORM_ERROR:
        raise ValueError(
            f"<origin {QUATERNION}={origin.get(QUATERNION)!r}>: a quaternion x y z w of norm 1 "
            "needed"
        )
    x, y, z, w = (number / norm for number in quaternion)
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    cosine = math.hypot(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z))
    pitch = math.atan2(2.0 * (w * y - z * x), cosine)
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    if cosine < MIN_COSINE:  # roll and yaw turn about the same axis
        roll = 0.0
        yaw = math.atan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (x * x + z * z))
    return f"{roll!r} {pitch!r} {yaw!r}"


def readable(data: bytes) -> str:
    """The text of a file in a form that every reader of URDF accepts. A file with undeclared
    prefixes or quaternions, or in an encoding other than UTF-8, is rewritten. Raises ValueError.
    """
    robot = element_of(data)
    try:
        text = data.decode("utf-8-sig")
        expat.ParserCreate("utf-8", " ").Parse(text, True)
    except (UnicodeDecodeError, expat.ExpatError):
        text = QUATERNION
    return ElementTree.tostring(robot, encoding="unicode") if QUATERNION in text else text


def numbers(element: Element | None, name: str, default: str) -> tuple[float, ...]:
    """The finite numbers in an attribute. Raises ValueError."""
    text = default if element is None else element.get(name, default)
    try:
        values = tuple(float(number) for number in text.split())
    except ValueError:
        values = (math.nan,)
    if element is not None and not all(abs(number) <= MAX_NUMBER for number in values):
        raise ValueError(
            f"<{element.tag} {name}={text!r}>: finite numbers up to {MAX_NUMBER:g} needed"
        )
    return values


def three(element: Element | None, name: str, default: str) -> tuple[float, float, float]:
    """The three finite numbers in an attribute. Raises ValueError."""
    values = numbers(element, name, default)
    if len(values) != 3:
        assert element is not None
        raise ValueError(
            f"<{element.tag} {name}={element.get(name)!r}>: {len(values)} numbers, 3 needed"
        )
    return values[0], values[1], values[2]


def check_numbers(robot: Element) -> None:
    """Reject numbers of links and joints that are not finite or too large, and attributes of their
    origins that are not read. Raises ValueError.
    """
    for part in (*robot.findall("link"), *robot.findall("joint")):
        for element in part.iter():
            for name in element.attrib:
                if element.tag == "origin" and name not in ORIGIN_ATTRIBUTES:
                    raise ValueError(
                        f"{part.tag} {part.get('name', '')!r}: "
                        f"{unread('origin', name, ORIGIN_ATTRIBUTES)}"
                    )
                if name in ("xyz", "rpy") or name in NUMERIC.get(element.tag, ()):
                    try:
                        numbers(element, name, "")
                    except ValueError as error:
                        raise ValueError(f"{part.tag} {part.get('name', '')!r}: {error}") from None


def unread(tag: str, name: str, accepted: Iterable[str]) -> str:
    """The message about an attribute that would be ignored."""
    return f"<{tag} {name}=...> is not read; {', '.join(sorted(accepted))} accepted"


def kinematics(robot: Element, moving: Mapping[str, tuple[float, float, float]]) -> str:
    """A URDF with only the links, joints and origins of a robot, without shapes and masses.

    `moving` has the axes of the joints that move, by name; all others are fixed. Moving joints get
    the limits ANY_LIMIT. All that turn become continuous: Pinocchio takes their cosine and sine.
    """
    out = Element("robot", name="arm")
    for link in robot.findall("link"):
        ElementTree.SubElement(out, "link", name=link.get("name", ""))
    for joint in robot.findall("joint"):
        name = joint.get("name", "")
        kind = "fixed"
        if name in moving:
            kind = "prismatic" if joint.get("type") == "prismatic" else "continuous"
        joint_copy = ElementTree.SubElement(out, "joint", name=name, type=kind)
        for tag in ("parent", "child", "origin"):
            if (source := joint.find(tag)) is not None:
                part = ElementTree.SubElement(joint_copy, tag, source.attrib)
                for number in part.attrib.keys() & {"xyz", "rpy"}:
                    part.set(number, " ".join(map(repr, numbers(source, number, ""))))
        if name in moving:
            ElementTree.SubElement(joint_copy, "axis", xyz=" ".join(map(repr, moving[name])))
            ElementTree.SubElement(joint_copy, "limit", ANY_LIMIT)
    return ElementTree.tostring(out, encoding="unicode")
