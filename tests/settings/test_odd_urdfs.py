"""Unusual URDFs: each loads with finite numbers only, or is refused in one sentence that names the
fault, in bounded time.
"""

from __future__ import annotations

import contextlib
import re
import time
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.ur5_cell import UR5, cell_in
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.separation.body import body_of
from thirdhand.settings.arm_description import description
from thirdhand.settings.config import Settings, robot_description
from thirdhand.settings.file_content import SettingsError
from thirdhand.viewer.static import ArmModels

SPHERE = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'
BOUND_S = 10.0


def more(elements: str) -> str:
    """The UR5 with more elements at the end of the file."""
    return UR5.replace("</robot>", f"{elements}</robot>")


def fixed(parent: str, child: str, name: str = "") -> str:
    return (
        f'<joint name="{name or f"{parent}_{child}"}" type="fixed"><parent link="{parent}"/>'
        f'<child link="{child}"/></joint>'
    )


def every(attribute: str, value: str | None) -> str:
    """The UR5 with another value for an attribute of all limits or axes, or without the
    attribute.
    """
    replaced = "" if value is None else f' {attribute}="{value}"'
    pattern = rf'(<(?:limit|axis)[^>]*?) {attribute}="[^"]*"'
    return re.sub(pattern, rf"\1{replaced}", UR5)


def chain_of(count: int) -> str:
    links = "".join(f'<link name="l{i}"/>' for i in range(count))
    return more(
        links
        + fixed("tool0", "l0")
        + "".join(fixed(f"l{i}", f"l{i + 1}") for i in range(count - 1))
    )


def tried(folder: Path, text: str | bytes) -> Settings:
    """The cell of an arm; asserts that it is read in bounded time, and that its core has finite
    numbers.
    """
    start = time.process_time()
    try:
        cell = cell_in(folder, text)
    finally:
        assert time.process_time() - start < BOUND_S
    robot = robot_description(cell)
    arm = ArmStage(cell, robot)
    body = body_of(cell, robot)
    pose = arm.at(np.array(cell.arm.posture))
    for numbers in (pose.position, pose.jacobian, body.frames, body.axes, body.capsules["ends"]):
        assert np.isfinite(numbers).all()
    assert np.isfinite([*cell.reach.centre, cell.reach.inner, cell.reach.outer]).all()
    np.testing.assert_allclose(np.linalg.norm(body.axes, axis=1), 1.0, atol=1e-9)
    return cell


REFUSED = {
    "a closed loop below the plate": (
        more('<link name="x"/><link name="y"/>' + fixed("x", "y") + fixed("y", "x")),
        "the joints above 'x', 'y' form a cycle",
    ),
    "a closed loop through the plate": (more(fixed("tool0", "base_link")), "form a cycle"),
    "a link with two parents": (
        more('<link name="x"/>' + fixed("x", "tool0", "second")),
        "link 'tool0' is the child of two joints, 'wrist_3-tool0_fixed_joint' and 'second'",
    ),
    "two roots": (more('<link name="x"/>'), "no joint connects 'base_link', 'x'"),
    "a link declared twice": (more('<link name="tool0"/>'), "link 'tool0' is declared twice"),
    "a joint declared twice": (
        more('<link name="x"/>' + fixed("tool0", "x", "elbow_joint")),
        "joint 'elbow_joint' is declared twice",
    ),
    "a link not declared": (more(fixed("tool0", "x")), "its child 'x' is not declared"),
    "a joint without a child": (
        more('<joint name="x" type="fixed"><parent link="tool0"/></joint>'),
        "joint 'x' names no child link",
    ),
    "a link without a name": (more("<link/>" + fixed("tool0", "")), "a link without a name"),
    "a velocity of 0": (every("velocity", "0"), "'shoulder_pan_joint' has the velocity 0; above 0"),
    "a velocity of inf": (every("velocity", "inf"), "'shoulder_pan_joint' has the velocity inf"),
    "no velocity": (every("velocity", None), "'shoulder_pan_joint' has the velocity none"),
    "limits the other way round": (
        every("upper", "-9"),
        "'shoulder_pan_joint' has the limits -6.2832 to -9",
    ),
    "a limit without end": (every("upper", "1e300"), "within 1000 rad, needed"),
    "an axis of 0": (
        every("xyz", "0 0 0"),
        "'shoulder_pan_joint' has the axis 0 0 0; a direction needed",
    ),
    "an axis of NaN": (every("xyz", "nan 0 0"), "<axis xyz='nan 0 0'>: finite numbers"),
    "an axis of two numbers": (every("xyz", "0 1"), "<axis xyz='0 1'>: 2 numbers, 3 needed"),
    "an origin without end": (UR5.replace('xyz="0', 'xyz="inf', 1), "finite numbers up to"),
    "a box of two numbers": (
        re.sub("<cylinder[^>]*/>", '<box size="0.1 0.1"/>', UR5),
        "the collision of link 'base_link': <box> has no size",
    ),
    "an unknown shape": (
        UR5.replace("<cylinder", "<ellipsoid"),
        "<ellipsoid> is no shape; box, cylinder",
    ),
    "a shape longer than the arm": (
        re.sub("<cylinder[^>]*/>", '<box size="60 60 60"/>', UR5),
        "the box of link 'base_link' is 104 m long, and the arm 1.33 m",
    ),
    "10 000 links": (chain_of(10_000), "10008 links; up to 1000 accepted"),
    "10 000 joints on one link": (
        more('<link name="x"/>' + "".join(fixed("tool0", "x", f"j{i}") for i in range(10_000))),
        "link 'x' is the child of two joints",
    ),
    "600 shapes": (
        UR5.replace('<link name="tool0"/>', f'<link name="tool0">{600 * SPHERE}</link>'),
        "collision shapes; up to 500 accepted",
    ),
    "very deep XML": (
        "<robot>" + "<a>" * 100_000 + "</a>" * 100_000 + "</robot>",
        "more than 64 elements in each",
    ),
    "very many elements": ("<robot>" + "<a/>" * 300_000 + "</robot>", "more than 100000 elements"),
    "entities that grow": (
        "<!DOCTYPE r [<!ENTITY a 'aaaaaaaaaa'>"
        + "".join(
            f"<!ENTITY {b} '{f'&{a};' * 10}'>" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
        )
        + "]><robot>&i;</robot>",
        "amplification",
    ),
    "macros of xacro": (
        more('<xacro:include filename="arm.xacro"/>'),
        "`xacro arm.urdf.xacro > arm.urdf`",
    ),
    "a macro's argument": (
        UR5.replace('xyz="0 0', 'xyz="${x} 0', 1),
        "its macros are not expanded",
    ),
    "an unknown encoding": (
        b'<?xml version="1.0" encoding="klingon"?><robot/>',
        "unknown encoding",
    ),
    "an empty file": ("", "not a robot description"),
    "half a file": (UR5[: len(UR5) // 2], "no XML"),
    "a robot without joints": (
        '<robot name="r"><link name="a"/></robot>',
        "a <robot> with joints needed",
    ),
    "no plate": (UR5.replace("tool0", "flange"), "no link 'tool0'; the last ones of the arm are"),
}


@pytest.mark.parametrize(("text", "said"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_arm_is_refused_in_one_sentence(
    text: str | bytes, said: str, tmp_path: Path
) -> None:
    with pytest.raises(SettingsError) as error:
        tried(tmp_path, text)
    message = str(error.value)
    assert said in message
    assert message.startswith(f"{tmp_path / 'cell.toml'}: ")
    assert len(message) < 600
    assert "\n" not in message


LATIN = '<?xml version="1.0" encoding="ISO-8859-1"?>' + UR5[UR5.index("<robot") :].replace(
    "base_link", "grün"
)
LOADED = {
    "no effort": re.sub(r' effort="[^"]*"', "", UR5),
    "an undeclared prefix": more('<gazebo><sensor:camera a:b="1"><x/></sensor:camera></gazebo>'),
    "macros where nobody looks": more('<gazebo><plugin file="$(find arm)/x"/></gazebo>'),
    "non-ASCII names": UR5.replace("base_link", "Größe_底"),
    "ISO 8859-1": LATIN.encode("latin-1"),
    "UTF-16": UR5[UR5.index("<robot") :].encode("utf-16"),
    "a byte order mark": b"\xef\xbb\xbf" + UR5.encode(),
    "an axis that is no unit vector": every("xyz", "0 0 1e-3").replace(
        '<axis xyz="0 0 1e-3"', '<axis xyz="0 1e5 0"', 1
    ),
    "a link named as a joint": UR5.replace("wrist_3-tool0_fixed_joint", "tool0"),
    "masses that are none": UR5.replace(
        '<link name="tool0"/>', '<link name="tool0"><inertial/></link>'
    ),
    "900 links": chain_of(900),
    "joints of a gripper without limits": more(
        '<link name="x"/><joint name="g" type="prismatic"><parent link="tool0"/><child link="x"/>'
        '<axis xyz="0 0 0"/><limit velocity="inf"/></joint>'
    ),
}


@pytest.mark.parametrize("text", LOADED.values(), ids=LOADED)
def test_what_others_accept_moves_as_the_plain_one(text: str | bytes, tmp_path: Path) -> None:
    cell = tried(tmp_path, text)
    assert cell.joints.names[0] == "shoulder_pan_joint"
    ElementTree.fromstring(robot_description(cell))  # readers of XML accept the description
    assert ArmModels(tmp_path / "arm.urdf", cell).body.capsules.shape


def test_what_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    for path, message in (
        (Path("/dev/zero"), "is not a file; a URDF"),
        (tmp_path, "a directory"),
        (tmp_path / "x", "cannot read"),
    ):
        with pytest.raises(SettingsError, match=message):
            description(path)
    with (tmp_path / "large.urdf").open("wb") as file:
        file.truncate(1_000_000_000)
    with pytest.raises(
        SettingsError, match="it has 1000000000 bytes, at most 20000000 accepted; a URDF needed"
    ):
        description(tmp_path / "large.urdf")


# --- drawn ----------------------------------------------------------------------------------------

VALUES = (
    "",
    "0",
    "-1",
    "nan",
    "inf",
    "-inf",
    "1e300",
    "1e-320",
    "x",
    "0 0 0",
    "0 0",
    "1 2 3 4",
    "nan nan nan",
    "1_0",
)
COUNT = len(list(ElementTree.fromstring(UR5).iter()))


@st.composite
def spoilt(draw: st.DrawFn) -> bytes:
    """The UR5 with one to three elements or attributes changed, moved, doubled or left out."""
    robot = ElementTree.fromstring(UR5)
    for _ in range(draw(st.integers(1, 3))):
        elements = list(robot.iter())
        element = elements[draw(st.integers(0, COUNT)) % len(elements)]
        match draw(st.sampled_from(("value", "drop", "double", "remove", "move", "tag"))):
            case "value" if element.attrib:
                element.set(
                    draw(st.sampled_from(sorted(element.attrib))), draw(st.sampled_from(VALUES))
                )
            case "drop" if element.attrib:
                del element.attrib[draw(st.sampled_from(sorted(element.attrib)))]
            case "double" if len(element):
                element.append(element[draw(st.integers(0, len(element) - 1))])
            case "remove" if len(element):
                element.remove(element[draw(st.integers(0, len(element) - 1))])
            case "move":
                links = ["base_link", "tool0", "forearm_link", "nowhere"]
                for end in element.findall("parent") + element.findall("child"):
                    end.set("link", draw(st.sampled_from(links)))
            case "tag":
                element.tag = draw(
                    st.sampled_from(
                        ("link", "joint", "robot", "collision", "geometry", "axis", "mesh")
                    )
                )
            case _:
                pass
    return ElementTree.tostring(robot)


@settings(deadline=None, max_examples=120, derandomize=True)
@given(spoilt())
def test_spoilt_description_is_refused_or_finite(
    tmp_path_factory: pytest.TempPathFactory, text: bytes
) -> None:
    with contextlib.suppress(SettingsError):
        tried(tmp_path_factory.getbasetemp(), text)
