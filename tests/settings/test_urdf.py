"""The URDF: chain, limits and link frames equal Pinocchio's; errors name what is accepted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from support.arms import MODELS, cell_of, published, toml_of
from support.turning import continuous_urdf, sliding_urdf
from support.wam import JOINT_NAMES, URDF
from thirdhand.core.arm.stage import ArmStage
from thirdhand.settings.arm_description import completed
from thirdhand.settings.config import load, parse, robot_description
from thirdhand.settings.file_content import SettingsError
from thirdhand.settings.robot_xml import readable
from thirdhand.settings.urdf import Urdf, UrdfError
from thirdhand.workbench.first_cell.rates import rates
from thirdhand_sim.scene import Scene


def test_chain_has_its_joints_in_order_with_limits() -> None:
    joints = Urdf(URDF).movable("tool_plate")
    assert tuple(joint.name for joint in joints) == JOINT_NAMES
    assert (joints[3].lower, joints[3].upper, joints[3].velocity) == (-0.9, 3.1, 2.0)


TILTED = sliding_urdf().replace('<axis xyz="0 1 0"/>', '<axis xyz="0.6 0.8 0"/>')


@pytest.mark.parametrize(
    ("description", "plate", "around"),
    [
        (URDF, "tool_plate", 0.0),
        (continuous_urdf(), "tool0", 20.0),
        (sliding_urdf(), "tool0", 0.0),
        (TILTED, "tool0", 0.0),
    ],
    ids=["wam", "continuous", "sliding", "tilted"],
)
def test_link_frames_are_where_another_implementation_has_them(
    description: str, plate: str, around: float
) -> None:
    urdf = Urdf(description)
    names = [joint.name for joint in urdf.movable(plate)]
    model = pin.buildModelFromXML(urdf.kinematics(names))
    data = model.createData()
    assert list(model.names)[1:] == names
    q = np.random.default_rng(1).uniform(-0.3, 0.3, len(names)) + around
    # continuous joints have cosine and sine as coordinates
    turns = [joint.nq == 2 for joint in list(model.joints)[1:]]
    pairs = zip(turns, q.tolist(), strict=True)
    pin.framesForwardKinematics(
        model, data, np.concatenate([[np.cos(x), np.sin(x)] if turn else [x] for turn, x in pairs])
    )
    placed = {urdf.root: pin.SE3.Identity()}
    for link in urdf.transforms(dict(zip(names, q.tolist(), strict=True))):
        x, y, z, w = link.rotation
        placed[link.child] = placed[link.parent] * pin.SE3(
            pin.Quaternion(w, x, y, z), np.array(link.translation)
        )
        expected = data.oMf[model.getFrameId(link.child)]
        np.testing.assert_allclose(placed[link.child].homogeneous, expected.homogeneous, atol=1e-9)


FOLLOWING = URDF.replace(
    '<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><mimic joint="wam/elbow_pitch_joint"/>', 1
)
BARE = (
    '<robot name="r"><link name="base"/><link name="tool_plate"/>'
    '<joint name="a" type="{}"><parent link="base"/><child link="tool_plate"/><axis xyz="1 0 0"/>'
    "</joint></robot>"
)


LIMITED = BARE.format("revolute").replace(
    "</joint>",
    '<limit lower="-2" upper="2" velocity="3" effort="1" acceleration="7" deceleration="5" '
    'jerk="9"/>'
    '<safety_controller k_velocity="1" soft_lower_limit="-1" soft_upper_limit="1.5"/></joint>',
)
CHAIN = '<robot name="r"><link name="l0"/>{}</robot>'.format(
    "".join(
        f'<link name="{link}"/><joint name="j{i}" type="continuous"><parent link="l{i}"/><child '
        f'link="{link}"/></joint>'
        for i, link in enumerate([*(f"l{i}" for i in range(1, 33)), "tool_plate"])
    )
).replace("</joint>", '<limit velocity="1"/></joint>')


@given(
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
    | st.just((0, 1, 0, 1))
)
def test_newer_urdfs_are_read_as_by_every_reader(quaternion: tuple[float, ...]) -> None:
    """Quaternions, limits and rates equal those of other readers."""
    turn = np.array(quaternion) / np.linalg.norm(quaternion)
    origin = f'<origin xyz="1 0 0" quat_xyzw="{" ".join(map(repr, turn.tolist()))}"/><axis'
    text = readable(LIMITED.replace("<axis", origin).encode())
    assert "quat_xyzw" not in text
    (joint,) = Urdf(text).movable("tool_plate")
    assert abs(np.dot(joint.rotation, turn)) == pytest.approx(1.0, abs=1e-12)
    # at a pitch of 90 degrees, roll and yaw have half of the digits
    placed = pin.buildModelFromXML(Urdf(text).kinematics(["a"])).jointPlacements[1].rotation
    np.testing.assert_allclose(placed, Rotation.from_quat(turn).as_matrix(), atol=1e-6)
    assert (joint.lower, joint.upper, joint.acceleration, joint.jerk) == (-1.0, 1.5, 5.0, 9.0)
    assert rates(text, [joint])[:2] == ([5.0], [9.0])
    joints = completed({"arm": {"plate": "tool_plate", "posture": [0.0]}}, Urdf(text))["joints"]
    assert (joints["lower"], joints["acceleration"], joints["jerk"]) == ([-1.0], [5.0], [9.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (URDF.replace('xyz="0 0 0.346"', 'xyz="0 0 high"'), "not a robot description"),
        (
            URDF.replace('type="revolute"', 'type="floating"', 1),
            "'wam/base_yaw_joint' is floating; revolute, contin",
        ),
        (
            FOLLOWING,
            "'wam/base_yaw_joint' follows 'wam/elbow_pitch_joint' by <mimic>; before 'tool_plate', "
            "joints that",
        ),
        (
            BARE.format("prismatic"),
            "joint 'a' has the limits none to none; lower below upper, within 1000 m, needed",
        ),
        (
            URDF.replace("<robot ", '<robot version="2.0" '),
            "version '2.0'; 1, 1.0, 1.1, 1.2 accepted",
        ),
        (
            LIMITED.replace('xyz="1 0 0"', 'xyz="1 0 0" frame="base"'),
            "cannot be read: <axis frame=...> is not read",
        ),
        (
            LIMITED.replace('jerk="9"', 'jerk="-9"'),
            "has the acceleration 5 and the jerk -9; numbers above 0 needed",
        ),
        (
            LIMITED.replace('limit="1.5"', 'limit="high"'),
            "has <safety_controller soft_upper_limit='high'>; a number",
        ),
        (
            LIMITED.replace("<axis", '<origin rpy="0 0 0" quat_xyzw="0 0 0 1"/><axis'),
            "has rpy and quat_xyzw; one needed",
        ),
        (CHAIN, "33 joints move before link 'tool_plate'; up to 32 accepted"),
    ],
)
def test_what_cannot_be_used_is_refused_in_words(text: str, message: str) -> None:
    with pytest.raises(UrdfError) as caught:
        Urdf(text, origin="cell.urdf").movable("tool_plate")
    assert str(caught.value).startswith("cell.urdf: ")
    assert message in str(caught.value)


# --- arms that we did not write: a Panda, its fingers locked, and a UR5 of six joints ---


@pytest.mark.parametrize("name", MODELS)
def test_names_limits_and_reach_come_from_the_description(name: str) -> None:
    cell = cell_of(name)
    arm = ArmStage(cell, robot_description(cell))
    pose = arm.at(np.array(cell.arm.posture))
    position = pose.position
    rotation = pose.rotation
    assert position == pytest.approx(Scene().robot_start, abs=0.03)
    assert rotation[:, 2] == pytest.approx([np.sqrt(0.5), 0.0, -np.sqrt(0.5)], abs=0.01)
    assert len(cell.joints.names) == len(cell.joints.lower) == len(cell.arm.posture)
    assert 0.3 < cell.reach.inner < cell.reach.outer < 1.4


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"posture": ""}, "[arm] posture: missing; the URDF does not define it, 6 numbers needed"),
        (
            {"posture": "posture = [0, 0, 0]"},
            "[arm] posture: 3 numbers, 6 needed, one for each of [joints] names",
        ),
        (
            {"jerk": f"jerk = {[500] * 6}\nvelocity = {[9] * 6}"},
            "[joints] velocity, entry 1: 9.0 given; up to 3.15",
        ),
        (
            {"jerk": f'jerk = {[500] * 6}\nnames = ["a", "b", "c", "d", "e", "f"]'},
            "[joints] names: ['a', 'b'",
        ),
    ],
)
def test_settings_that_do_not_fit_the_description_are_refused(
    changed: dict[str, str], message: str
) -> None:
    with pytest.raises(SettingsError) as caught:
        parse(toml_of(MODELS["ur5"], **changed), origin="cell.toml")
    assert str(caught.value).startswith("cell.toml: ")
    assert message in str(caught.value)


def test_a_description_is_looked_for_beside_the_settings(tmp_path: Path) -> None:
    meshes = f'packages = ["{published(MODELS["ur5"].file).parents[4]}"]'
    (tmp_path / "arm.urdf").write_bytes(published(MODELS["ur5"].file).read_bytes())
    (tmp_path / "cell.toml").write_text(
        toml_of(MODELS["ur5"], urdf=f'[arm]\nurdf = "arm.urdf"\n{meshes}')
    )
    assert load(tmp_path / "cell.toml").joints.names[0] == "shoulder_pan_joint"
