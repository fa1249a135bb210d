"""The URDF: chain, limits and link frames as Pinocchio has them; errors that say what would do."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from service.settings.urdf import Urdf, UrdfError, multiply
from support.turning import continuous_urdf, sliding_urdf
from support.wam import JOINT_NAMES, URDF


def test_the_chain_to_the_tool_has_the_joints_in_order_with_their_limits() -> None:
    joints = Urdf(URDF).movable("tool_plate")
    assert tuple(joint.name for joint in joints) == JOINT_NAMES
    assert (joints[3].lower, joints[3].upper, joints[3].velocity) == (-0.9, 3.1, 2.0)


def test_link_frames_are_where_another_implementation_has_them() -> None:
    urdf, model = Urdf(URDF), pin.buildModelFromXML(URDF)
    data = model.createData()
    q = np.random.default_rng(1).uniform(model.lowerPositionLimit, model.upperPositionLimit)
    pin.framesForwardKinematics(model, data, q)
    placed = {urdf.root: pin.SE3.Identity()}
    for link in urdf.transforms(dict(zip(JOINT_NAMES, q.tolist(), strict=True))):
        x, y, z, w = link.rotation
        placed[link.child] = placed[link.parent] * pin.SE3(pin.Quaternion(w, x, y, z), np.array(link.translation))
        expected = data.oMf[model.getFrameId(link.child)]
        np.testing.assert_allclose(placed[link.child].homogeneous, expected.homogeneous, atol=1e-12)


@pytest.mark.parametrize("description", [continuous_urdf(), sliding_urdf()])
def test_links_of_turning_and_sliding_joints_are_where_another_implementation_has_them(description: str) -> None:
    urdf = Urdf(description)
    names = [joint.name for joint in urdf.movable("tool0")]
    model = pin.buildModelFromXML(urdf.kinematics(names))
    data = model.createData()
    assert list(model.names)[1:] == names
    q = np.random.default_rng(1).uniform(-0.3, 0.3, len(names)) + (0.0 if "rail_joint" in names else 20.0)
    pin.framesForwardKinematics(model, data, q)
    placed = {urdf.root: pin.SE3.Identity()}
    for link in urdf.transforms(dict(zip(names, q.tolist(), strict=True))):
        x, y, z, w = link.rotation
        placed[link.child] = placed[link.parent] * pin.SE3(pin.Quaternion(w, x, y, z), np.array(link.translation))
        expected = data.oMf[model.getFrameId(link.child)]
        np.testing.assert_allclose(placed[link.child].homogeneous, expected.homogeneous, atol=1e-9)


def test_joints_beyond_the_plate_never_matter() -> None:
    gripper = "".join(
        f'<link name="{name}"/><joint name="{name}_joint" type="{kind}"><parent link="{parent}"/><child link="{name}"/>'
        f"{more}</joint>"
        for name, kind, parent, more in (
            ("finger", "prismatic", "tool_plate", '<limit lower="0" upper="0.04" velocity="1" effort="1"/>'),
            ("thumb", "prismatic", "tool_plate", '<mimic joint="finger_joint"/>'),
            ("wheel", "continuous", "tool_plate", ""),
            ("cart", "floating", "wam/base_link", ""),
            ("sheet", "planar", "wam/base_link", ""),
        )
    )
    urdf = Urdf(URDF.replace("</robot>", gripper + "</robot>").replace("wam/base_link", Urdf(URDF).root))
    assert urdf.movable("tool_plate") == Urdf(URDF).movable("tool_plate")


def test_rotations_are_multiplied_as_quaternions() -> None:
    half = np.sqrt(0.5)
    assert multiply((0, 0, half, half), (0, 0, half, half)) == pytest.approx((0, 0, 1, 0))


FOLLOWING = URDF.replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><mimic joint="wam/elbow_pitch_joint"/>', 1)
BARE = (
    '<robot name="r"><link name="base"/><link name="tool_plate"/>'
    '<joint name="a" type="{}"><parent link="base"/><child link="tool_plate"/><axis xyz="1 0 0"/>'
    "</joint></robot>"
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a robot description"),
        ("<robot/>", "a <robot> with joints needed"),
        (URDF.replace('xyz="0 0 0.346"', 'xyz="0 0 high"'), "not a robot description"),
        (URDF.replace('type="revolute"', 'type="floating"', 1), "'wam/base_yaw_joint' is floating; revolute, contin"),
        (URDF.replace('type="revolute"', 'type="planar"', 1), "'wam/base_yaw_joint' is planar; revolute, continuous"),
        (
            FOLLOWING,
            "'wam/base_yaw_joint' follows 'wam/elbow_pitch_joint' by <mimic>; before 'tool_plate', joints that",
        ),
        (BARE.format("revolute"), "joint 'a' has the limits none to none; lower below upper, within 1000 rad, needed"),
        (BARE.format("prismatic"), "joint 'a' has the limits none to none; lower below upper, within 1000 m, needed"),
        (
            BARE.format("continuous").replace("<axis", '<limit velocity="0"/><axis'),
            "joint 'a' has the velocity 0; above 0, up to 1000 rad/s, needed",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_in_words(text: str, message: str) -> None:
    with pytest.raises(UrdfError) as caught:
        Urdf(text, origin="cell.urdf").movable("tool_plate")
    assert str(caught.value).startswith("cell.urdf: ")
    assert message in str(caught.value)
