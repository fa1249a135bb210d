"""The URDF: chain, limits and link frames as Pinocchio has them; errors that say what would do."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from service.urdf import Urdf, UrdfError, multiply
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


def test_rotations_are_multiplied_as_quaternions() -> None:
    half = np.sqrt(0.5)
    assert multiply((0, 0, half, half), (0, 0, half, half)) == pytest.approx((0, 0, 1, 0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a robot description"),
        ("<robot/>", "a <robot> with joints needed"),
        (URDF.replace('xyz="0 0 0.346"', 'xyz="0 0 high"'), "not a robot description"),
        (URDF.replace('type="revolute"', 'type="continuous"', 1), "'wam/base_yaw_joint' is continuous; revolute with"),
    ],
)
def test_what_cannot_be_used_is_refused_in_words(text: str, message: str) -> None:
    with pytest.raises(UrdfError) as caught:
        Urdf(text, origin="cell.urdf").movable("tool_plate")
    assert str(caught.value).startswith("cell.urdf: ")
    assert message in str(caught.value)
