"""Arms at the bench: the shipped cells do the soldering task, and their descriptions agree with
those that others publish.
"""

from __future__ import annotations

import struct

import msgspec
import numpy as np
import numpy.typing as npt
import pinocchio as pin
import pytest

from support.arms import published
from support.demo import SCENE, assert_soldered, soldered
from support.franka_cell import allowed
from thirdhand.core.geometry import rotation
from thirdhand.core.separation.body import body_of
from thirdhand.daemon.launch import described
from thirdhand.recordings.shipped import ARMS, cell_of
from thirdhand.settings.config import Box, Obstacles, Reach, Settings, parse, robot_description
from thirdhand.settings.urdf import Urdf
from thirdhand_sim.bench import Bench
from thirdhand_sim.scene import SceneError


@pytest.mark.parametrize("arm", ["franka", "ur5"])
def test_shipped_arm_does_the_task(arm: str) -> None:
    """The arm keeps its limits, and its distance from the hands."""
    cell = cell_of(arm)
    near = []

    def look(bench: Bench) -> None:
        if bench.tick % 10 == 0:
            near.append(
                min(
                    bench.world.clearance(bench.world.left),
                    bench.world.clearance(bench.world.right),
                )
            )

    run = soldered(cell, look=look)
    assert_soldered(run, cell)
    frames = run.frames
    limits = cell.joints
    assert (run.joints[:, 0] >= np.array(limits.lower) - 1e-3).all()
    assert (run.joints[:, 0] <= np.array(limits.upper) + 1e-3).all()
    assert (
        np.abs(frames["joint_accelerations"]) <= np.array(limits.acceleration) * (1 + 1e-9)
    ).all()
    assert min(near) > 0.01
    if arm == "franka":
        low, high = allowed(frames["joints"])
        assert (frames["joint_velocities"] >= low).all()
        assert (frames["joint_velocities"] <= high).all()


def test_franka_keeps_makers_velocity_limits() -> None:
    """A joint that can stop before its end with `acceleration` is within the maker's speed limit
    there.
    """
    limits = cell_of("franka").joints
    lower, upper, acceleration = (
        np.array(getattr(limits, name)) for name in ("lower", "upper", "acceleration")
    )
    assert (acceleration <= 10.0).all()
    assert max(limits.jerk) <= 5000
    for share in np.linspace(0.0, 1.0, 1001)[:, None]:
        q = lower + share * (upper - lower)
        fastest = np.minimum(limits.velocity, np.sqrt(2 * acceleration * (upper - q)))
        slowest = -np.minimum(limits.velocity, np.sqrt(2 * acceleration * (q - lower)))
        low, high = allowed(q)
        assert (fastest <= high).all(), (q, fastest, high)
        assert (slowest >= low).all(), (q, slowest, low)


def test_ur5_needs_half_of_its_torque() -> None:
    """All joints have full speed and acceleration around the posture, each in the worse
    direction.
    """
    cell = cell_of("ur5")
    model = pin.buildModelFromXML(robot_description(cell))
    data = model.createData()
    rng = np.random.default_rng(0)
    for _ in range(300):
        q = np.array(cell.arm.posture) + rng.uniform(-0.5, 0.5, model.nv)
        velocity = np.array(cell.joints.velocity) * rng.choice([-1.0, 1.0], model.nv)
        inertia = pin.crba(model, data, q)
        inertia = np.triu(inertia) + np.triu(inertia, 1).T
        torque = np.abs(inertia) @ cell.joints.acceleration + np.abs(
            pin.nonLinearEffects(model, data, q, velocity)
        )
        assert (torque < 0.5 * model.effortLimit).all(), torque


# --- descriptions ---------------------------------------------------------------------------------


def tips(
    text: str, names: tuple[str, ...], tip: str, postures: npt.NDArray[np.float64]
) -> list[pin.SE3]:
    """The pose of a link in postures (N, J) of some joints; the other joints are at 0."""
    model = pin.buildModelFromXML(text)
    data = model.createData()
    frame = model.getFrameId(tip)
    placed = []
    for posture in postures:
        q = pin.neutral(model)
        for name, angle in zip(names, posture, strict=True):
            q[model.joints[model.getJointId(name)].idx_q] = angle
        pin.framesForwardKinematics(model, data, q)
        placed.append(data.oMf[frame].copy())
    return placed


@pytest.mark.parametrize(
    ("arm", "file", "theirs", "tip", "stand"),
    [
        (
            "franka",
            "panda.urdf",
            tuple(f"panda_joint{i}" for i in range(1, 8)),
            "panda_hand_tcp",
            (-0.15, 0, 0),
        ),
        ("ur5", "ur5_robot.urdf", (), "tool0", (0, 0, 0)),
    ],
)
def test_shipped_arm_moves_as_published(
    arm: str, file: str, theirs: tuple[str, ...], tip: str, stand: tuple[float, float, float]
) -> None:
    """The arm's kinematics equals that of a published description."""
    cell = cell_of(arm)
    names = cell.joints.names
    postures = np.random.default_rng(0).uniform(
        cell.joints.lower, cell.joints.upper, (20, len(names))
    )
    ours = tips(robot_description(cell), names, cell.arm.plate, postures)
    for pose, other in zip(
        ours, tips(published(file).read_text(), theirs or names, tip, postures), strict=True
    ):
        np.testing.assert_allclose(pose.translation, other.translation + stand, atol=1e-4)
        np.testing.assert_allclose(pose.rotation, other.rotation, atol=1e-4)


FR3_MESHES = {f"fr3_link{i}": f"panda_description/meshes/collision/link{i}.stl" for i in range(8)}
UR5_LINKS = ("base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
UR5_MESHES = {f"{link}_link": f"ur5/collision/{link.replace('_', '')}.stl" for link in UR5_LINKS}


@pytest.mark.parametrize(
    ("arm", "meshes"),
    [
        ("franka", FR3_MESHES | {"fr3_hand": "panda_description/meshes/collision/hand.stl"}),
        ("ur5", UR5_MESHES),
    ],
)
def test_capsules_cover_published_meshes(arm: str, meshes: dict[str, str]) -> None:
    cell = cell_of(arm)
    text = robot_description(cell)
    urdf = Urdf(text)
    for link, file in meshes.items():
        data = published(file).read_bytes()
        triangles = np.frombuffer(
            data[84:], np.dtype("3<f4, 9<f4, <u2"), struct.unpack("<I", data[80:84])[0]
        )
        alone = [shape for shape in urdf.shapes if shape.link == link]
        points = triangles["f1"].reshape(-1, 3)
        beyond = np.inf
        for shape in alone:  # as a cylinder; the service's capsules are larger
            local = (points - shape.translation) @ rotation(shape.rotation)
            sides = np.column_stack((np.hypot(local[:, 0], local[:, 1]), np.abs(local[:, 2])))
            beyond = np.minimum(
                beyond, np.hypot(*np.maximum(sides - (shape.size[0], shape.size[1] / 2), 0.0).T)
            )
        assert np.max(beyond) < 0.008, f"{link}: {1000 * np.max(beyond):.1f} mm"
    assert len(body_of(cell, text).capsules) == len(urdf.shapes)


# --- cells ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", ARMS)
def test_described_cell_is_read_back(arm: str) -> None:
    """The cell's description comes back as published in the status."""
    boxes = (Box(centre=(0.5, 0.6, 0.1), half_size=(0.1, 0.1, 0.1)),)
    cell = msgspec.structs.replace(cell_of(arm), obstacles=Obstacles(boxes=boxes))
    assert parse(described(cell), origin="cell.toml") == cell
    assert described(Settings()) == ""


def test_places_are_moved_into_reach() -> None:
    """Via-points out of reach are moved into it and reported."""
    for arm in ARMS:
        assert SCENE.in_reach(cell_of(arm).reach) == (SCENE, ())
    short = Reach(centre=(0.0, 0.0, 0.3), inner=0.2, outer=0.6)
    moved, notes = SCENE.in_reach(short)
    assert notes == (
        "handover moved by 2 cm into the arm's reach",
        "glass moved by 5 cm into the arm's reach",
        "soldering moved by 3 cm into the arm's reach",
    )
    for tool in (moved.offer, moved.glass, moved.carry):
        assert np.linalg.norm(np.subtract(tool, short.centre)) <= short.outer
    assert moved.robot_start == SCENE.robot_start


@pytest.mark.parametrize(
    ("reach", "words"),
    [
        (
            Reach(centre=(0.0, -0.05, 0.12), inner=0.23, outer=0.26),  # an SO-100
            "moved by 0.15 m: handover needs the tool 0.64 m from the shoulder; glass needs the "
            "tool 0.66 m from the shoulder; soldering needs the tool 0.64 m from the shoulder. "
            "Its tool reaches from 0.23 to 0.26 m around its shoulder at [0.0, -0.05, 0.12], "
            "where x is at least 0.15 and z at least 0.02 m. What to do: use a",
        ),
        (
            Reach(min_z=0.2),
            "moved by 0.15 m: glass needs the tool at x = 0.50, z = 0.16 m. Its tool reaches",
        ),
        (Reach(inner=2.0, outer=2.5), "Its tool reaches from 2.00 to 2.50 m around its shoulder"),
    ],
)
def test_scene_beyond_reach_is_refused(reach: Reach, words: str) -> None:
    """A scene beyond the arm is refused with each place and what to do."""
    with pytest.raises(SceneError) as refused:
        SCENE.in_reach(reach)
    assert words in str(refused.value)
    for way_out in ("--scene", "a larger arm", "thirdhand arm URDF --at", "docs/tutorial.md"):
        assert way_out in str(refused.value)
