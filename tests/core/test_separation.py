"""Speed and separation: positions and distances of capsules, the speeds that the rule allows, and
the core's compliance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import coal
import msgspec
import numpy as np
import numpy.typing as npt
import pinocchio as pin
import pytest

from support.arms import MODELS, cell_of
from support.followed import changed, followed
from support.in_process import ASSUMED, LEFT, RIGHT, seen
from support.wam import STATE, URDF
from thirdhand.contract.records import Flag, Mode
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.controller import start_state
from thirdhand.core.frame import Record, Tick, Vector, blank, frame_layout
from thirdhand.core.geometry import between_segments, nearest_to_box, place, quaternion_of, to_box
from thirdhand.core.intake import MODES
from thirdhand.core.kinematics import Kinematics
from thirdhand.core.limiter.stage import LimiterStage
from thirdhand.core.separation import TABLE_DEPTH_M
from thirdhand.core.separation.body import Body, body_of
from thirdhand.core.separation.clearance import NEAR_ITSELF, NOBODY
from thirdhand.core.separation.stage import Separation
from thirdhand.core.separation.step import allowed_speed
from thirdhand.core.skill.skill import Skill
from thirdhand.core.tuning import TUNING
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Box, Obstacles, Settings, TableTop, robot_description
from thirdhand_sim.lab.separation import nearest
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

SLIP_SPEED_MPS = TUNING.separation.slip_speed_mps
RETREAT_SPEED_MPS = 2.0 * SLIP_SPEED_MPS


ARM = ArmStage(ASSUMED, URDF)
BODY = body_of(ASSUMED, URDF)
LOWER = np.array(ASSUMED.joints.lower)
UPPER = np.array(ASSUMED.joints.upper)
POSTURE = np.array(ASSUMED.arm.posture)
ARMS = ("wam", *MODELS)
FRAME = blank(frame_layout(7))


def placed(q: Vector, body: Body = BODY) -> Vector:
    out = np.empty((len(body.capsules), 2, 3))
    place(q, body.frames, body.axes, body.capsules, out)
    return out


def orientation_of(here: Kinematics) -> Vector:
    out = np.empty(4)
    quaternion_of(here.rotation, out)
    return out


def test_capsules_cover_collision_shapes() -> None:
    """Capsules enclose the collision shapes as Pinocchio places them."""
    model = pin.buildModelFromXML(URDF)
    shapes = pin.buildGeomFromUrdfString(model, URDF, pin.GeometryType.COLLISION)
    data = model.createData()
    geometry = pin.GeometryData(shapes)
    random = np.random.default_rng(1)
    assert len(BODY.capsules) == len(shapes.geometryObjects)
    for q in random.uniform(LOWER, UPPER, (20, 7)):
        pin.updateGeometryPlacements(model, data, shapes, geometry, q)
        capsules = placed(q)
        covered = set()
        for shape, placement in zip(shapes.geometryObjects, geometry.oMg, strict=True):
            if isinstance(shape.geometry, coal.Box):
                corners = (
                    shape.geometry.halfSide * np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, 8).T
                )
            else:
                angles = np.linspace(0, 2 * math.pi, 12)
                r = shape.geometry.radius
                h = shape.geometry.halfLength
                corners = np.array(
                    [[r * math.cos(a), r * math.sin(a), z] for a in angles for z in (-h, h)]
                )
            points = np.array([placement.act(corner) for corner in corners])
            for k in np.flatnonzero(BODY.capsules["link"] == shape.parentJoint):
                far = [between_segments(np.array([p, p]), capsules[k], np.empty(9)) for p in points]
                if (
                    max(far) <= BODY.capsules["radius"][k] + 1e-9
                    and max(far) > BODY.capsules["radius"][k] - 1e-3
                ):
                    covered.add(int(k))
                    break
            else:
                pytest.fail(f"{shape.name} is not covered")
        assert covered == set(range(len(BODY.capsules)))


def coal_capsule(segment: Vector) -> tuple[Any, Any]:
    """A capsule of 1 cm around a segment (2, 3), and its placement."""
    axis = segment[1] - segment[0]
    along = axis if axis.any() else np.array([0.0, 0.0, 1.0])
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along).matrix()
    return coal.Capsule(0.01, float(np.linalg.norm(axis))), coal.Transform3s(
        turn, segment.mean(axis=0)
    )


def test_capsule_distances_are_those_of_coal() -> None:
    random = np.random.default_rng(2)
    near = np.empty(9)
    for _ in range(300):
        segment, other = random.uniform(-0.5, 0.5, (2, 2, 3))
        if random.random() < 0.2:
            other[1] = other[0] + (segment[1] - segment[0])  # parallel
        if random.random() < 0.2:
            segment[1] = segment[0]  # a ball
        distance_m = between_segments(segment, other, near)
        expected = coal.distance(
            *coal_capsule(segment),
            *coal_capsule(other),
            coal.DistanceRequest(),
            coal.DistanceResult(),
        )
        assert distance_m - 0.02 == pytest.approx(expected, abs=1e-5)
        assert np.linalg.norm(near[3:6] - near[:3]) == pytest.approx(distance_m, abs=1e-12)
        assert near[:3] + distance_m * near[6:] == pytest.approx(near[3:6], abs=1e-9)


def test_distance_of_capsule_and_box() -> None:
    """The distance of a capsule and a box is the minimum along the capsule, and negative inside."""
    random = np.random.default_rng(3)
    near = np.empty(9)
    box = np.array([[-0.2, -0.3, -0.1], [0.2, 0.3, 0.1]])
    for _ in range(300):
        segment = random.uniform(-0.6, 0.6, (2, 3))
        distance_m = to_box(segment, nearest_to_box(segment, box), box, near)
        points = segment[0] + np.linspace(0, 1, 2001)[:, None] * (segment[1] - segment[0])
        least = np.linalg.norm(points - points.clip(*box), axis=1).min()
        assert max(distance_m, 0.0) == pytest.approx(least, abs=3e-4)
    inside = np.array([[0.0, 0.0, 0.07], [0.0, 0.0, 0.07]])
    assert to_box(inside, 0.0, box, near) == pytest.approx(-0.03)
    assert near[6:].tolist() == [0.0, 0.0, -1.0]  # moving down is moving in


@pytest.mark.parametrize("hand_speed", [0.0, 0.4, 1.6])
def test_stop_from_allowed_speed_keeps_clear(hand_speed: float) -> None:
    """A stop from the allowed speed ends at the clearance."""
    for distance in (0.05, 0.2, 0.6):
        speed = allowed_speed(distance, hand_speed, 3.0, 0.13, 0.03)
        left = distance - (speed + hand_speed) * 0.13 - speed**2 / 6.0 - hand_speed * speed / 3.0
        assert left == pytest.approx(0.03, abs=1e-12) if speed > 0 else left <= 0.03
    assert allowed_speed(0.02, hand_speed, 3.0, 0.13, 0.03) == 0.0


def test_constraints_are_derivatives_of_distance() -> None:
    """Constraints are the rates at which distances shrink."""
    settings = changed(
        ASSUMED, obstacles=Obstacles(boxes=(Box(centre=(0.5, 0, 0.2), half_size=(0.05,) * 3),))
    )
    separation = Separation(settings, URDF)
    table = settings.table
    low = np.array(table.centre) - [*table.half_size, TABLE_DEPTH_M]
    high = np.add(table.centre, [*table.half_size, 0.0])
    boxes = np.array([[low, high], [(0.45, -0.05, 0.15), (0.55, 0.05, 0.25)]])
    state = with_hands(*(np.array([LEFT, RIGHT]) - [0.3, 0.0, -0.2]), settings)
    random = np.random.default_rng(4)
    near = np.empty(9)
    total = 0
    for q, dq in zip(
        random.uniform(LOWER, UPPER, (20, 7)), random.uniform(-1, 1, (20, 7)), strict=True
    ):
        pose = ARM.at(q)
        separation.step(state, FRAME, pose.record)
        total += separation.count
        speeds = separation.constraints["row"][: separation.count] @ dq
        pair = [placed(q + h * dq) for h in (-1e-6, 1e-6)]
        rates = []
        for side in range(2):
            arm = state["hands"][side, 0] + np.array([[0.0, 0, 0], [0.24, 0, 0]])
            for k in np.flatnonzero(BODY.capsules["link"]):
                rates.append(
                    -np.diff([between_segments(capsules[k], arm, near) for capsules in pair])[0]
                    / 2e-6
                )
        for i, j in BODY.pairs:
            rates.append(
                -np.diff([between_segments(capsules[i], capsules[j], near) for capsules in pair])[0]
                / 2e-6
            )
        for k in np.flatnonzero(BODY.capsules["link"]):
            for box in boxes:
                for share in (nearest_to_box(placed(q)[k], box), 0.0, 1.0):
                    rates.append(
                        -np.diff([to_box(capsules[k], share, box, near) for capsules in pair])[0]
                        / 2e-6
                    )
        expected = np.array(rates)
        assert all(np.abs(expected - speed).min() < 1e-5 for speed in speeds)
    assert total > 50


class _Nothing:
    digest = bytes(16)
    orientation = (0.0, 0.0, 0.0, 1.0)


def with_hands(
    left: npt.ArrayLike, right: npt.ArrayLike = RIGHT, settings: Settings = ASSUMED
) -> Record:
    """A state in which hands are seen at positions (3,) [m], at rest."""
    state = start_state(settings, _Nothing())  # type: ignore[arg-type]
    state["hand_ticks"] = 0
    state["hands"][:, 0] = left, right
    return state


def thrust(
    place: tuple[float, float, float], at_s: float, seconds: float = 3.5
) -> Iterator[tuple[Tick, Vector]]:
    """Hands of the nominal scene from its handover on; at `at_s` the right hand moves to `place`
    within a tenth of a second.
    """
    script = HandScript(Scene(), seed=5)
    for k in range(round(seconds / 0.002)):
        t = max(0.0, k * 0.002 - 0.5)
        motions = script.truth(t)
        share = min(max((t - at_s) / 0.1, 0.0), 1.0)
        hands = np.array(
            [motions.left.position, (1 - share) * motions.right.position + share * np.array(place)]
        )
        yield Tick(k, seen(hands, k) if k % 5 == 0 else ()), hands


@pytest.mark.parametrize("arm", ARMS)
def test_the_arm_stops_for_a_hand_in_its_way(taught: Skill, arm: str) -> None:
    """The hand stops where a resting arm would not touch it."""
    cell = changed(cell_of(arm), people={"position_uncertainty": 0.03})
    ticks, hands = zip(*thrust((0.53, -0.27, 0.37), 1.2), strict=True)
    frames = followed(taught, list(ticks), cell)
    assert (frames["flags"] & Flag.SEPARATION).any() or (frames["mode"] == Mode.HOLD).any()
    joints = np.stack([frames["joints"], frames["joint_velocities"]], axis=1)
    distance, speed, *_ = nearest(
        cell, body_of(cell, robot_description(cell)), joints, np.array(hands)
    )
    assert distance.min() > 0
    late = slice(round((0.5 + 1.3 + 0.13) / 0.002), None)  # after a reaction time
    least_m = cell.people.clearance + cell.people.position_uncertainty
    allowed = np.array(
        [allowed_speed(d, 0.0, cell.people.brake, 0.13, least_m) for d in distance[late].ravel()]
    )
    assert (speed[late].ravel() - allowed).max() <= SLIP_SPEED_MPS + 1e-3


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.one_case
def test_table_and_box_are_not_touched(taught: Skill, arm: str) -> None:
    """The table is so high that the glass is inside, and a box stands before the handover."""
    cell = cell_of(arm)
    urdf = robot_description(cell)
    body = body_of(cell, urdf)
    box = Box(centre=(0.52, -0.2, 0.36), half_size=(0.08, 0.04, 0.3))
    cells = [
        changed(cell, table=TableTop(centre=(0.8, 0.0, 0.27))),
        changed(cell, obstacles=Obstacles(boxes=(box,))),
    ]
    for settings in cells:
        frames = followed(taught, [tick for tick, _ in thrust((0.9, 0.3, 0.1), 9.0, 7.5)], settings)
        assert (frames["mode"] == Mode.FOLLOW).all()
        assert (frames["flags"] & Flag.SEPARATION).any()
        behind = 0.1 if len(settings.joints.names) > 6 else 0.15  # six joints have no way around
        assert np.linalg.norm(frames["setpoint"] - frames["tool"], axis=1).max() < behind
        if settings.obstacles.boxes:
            corners = np.array(
                [np.subtract(box.centre, box.half_size), np.add(box.centre, box.half_size)]
            )
        else:
            corners = np.array([[0.35, -0.6, -0.73], [1.25, 0.6, 0.27]])
        distances_m = np.array(
            [_apart_from(corners, placed(q, body), body) for q in frames["joints"][::5]]
        )
        # a part that starts nearer moves away
        least = np.minimum(distances_m[0], settings.obstacles.clearance)
        assert (distances_m > least - 0.001).all(), distances_m.min(axis=0)


def _apart_from(corners: Vector, capsules: Vector, body: Body) -> list[float]:
    """The distances of the moving capsules from a box."""
    near = np.empty(9)
    return [
        to_box(capsules[k], nearest_to_box(capsules[k], corners), corners, near)
        - body.capsules["radius"][k]
        for k in np.flatnonzero(body.capsules["link"])
    ]


@pytest.mark.parametrize("arm", ARMS)
def test_near_parts_move_apart(arm: str) -> None:
    """Otherwise small errors of many stops would accumulate."""
    cell = cell_of(arm)
    urdf = robot_description(cell)
    separation = Separation(cell, urdf)
    kinematics = ArmStage(cell, urdf)
    random = np.random.default_rng(3)
    planned = []
    for q in random.uniform(cell.joints.lower, cell.joints.upper, (4000, len(cell.joints.names))):
        clear, _, thing = separation.clearance(q, NOBODY)
        if thing != NEAR_ITSELF or not -0.009 < clear < -0.001:
            continue
        separation.step(
            start_state(cell, shipped_skill()), blank(frame_layout(len(q))), kinematics.at(q).record
        )
        least = separation.constraints[: separation.count]
        assert least["allowed"].min() == pytest.approx(0.1 * SLIP_SPEED_MPS)
        planned.append(least["planned"].min())
    assert min(planned) == pytest.approx(-RETREAT_SPEED_MPS)
    assert max(planned) <= 0.0  # parts that the joints can hardly move may rest


def test_leaving_motion_is_not_slowed() -> None:
    separation = Separation(ASSUMED, URDF)
    pose = ARM.at(POSTURE)
    state = with_hands(np.add(pose.position, (0.09, 0.0, 0.0)))
    for velocity in ([-0.4, 0.0, 0.0], [-0.2, 0.1, 0.3]):
        separation.step(state, FRAME, pose.record)
        free = ARM.step(POSTURE, pose.position, np.array(velocity), orientation_of(pose))
        guarded = ARM.step(
            POSTURE, pose.position, np.array(velocity), orientation_of(pose), separation=separation
        )
        assert separation.count
        assert (guarded.separated, guarded.velocity.tobytes()) == (False, free.velocity.tobytes())
    toward = ARM.step(
        POSTURE,
        pose.position,
        np.array([0.4, 0.0, 0.0]),
        orientation_of(pose),
        separation=separation,
    )
    assert toward.separated
    assert pose.tasks[0] @ toward.velocity < 0.05


@pytest.mark.parametrize("hand_speed", [0.0, 0.05, 1.5])
def test_passing_hand_is_foreseen(hand_speed: float) -> None:
    """The tool leaves the hand now, but moves to where a fast hand will be 0.1 s later."""
    separation = Separation(ASSUMED, URDF)
    pose = ARM.at(POSTURE)
    velocity = np.array([0.3, 0.4, 0.0])
    near = np.empty(9)
    state = with_hands(np.add(pose.position, (0.14, -0.16, 0.0)))
    state["hands"][0, 1, 1] = hand_speed
    free = ARM.step(POSTURE, pose.position, velocity, orientation_of(pose))
    state["joints"][1] = free.velocity
    separation.step(state, FRAME, pose.record)
    guarded = ARM.step(
        POSTURE, pose.position, velocity, orientation_of(pose), separation=separation
    )
    forearm = state["hands"][0, 0] + np.array([[0.0, 0.0, 0.0], [0.24, 0.0, 0.0]])
    for k in np.flatnonzero(BODY.capsules["link"] == 7):
        distance_m = between_segments(placed(POSTURE + 1e-6 * free.velocity)[k], forearm, near)
        assert distance_m > between_segments(placed(POSTURE)[k], forearm, near)
    if hand_speed < 1.0:
        assert (guarded.separated, guarded.velocity.tobytes()) == (False, free.velocity.tobytes())
    else:
        assert guarded.separated
        assert (pose.tasks[:3] @ guarded.velocity)[0] < 0.8 * (pose.tasks[:3] @ free.velocity)[0]


def test_only_the_tool_touches_receiving_hand(taught: Skill) -> None:
    """Contact is allowed only with a gentle receiving hand."""
    separation = Separation(ASSUMED, URDF)
    separation.set_contacts(taught.via_points)
    pose = ARM.at(POSTURE)
    tool = BODY.capsules["link"] == 7
    for offset_m, gentle in ((0.0, True), (0.1, False)):
        state = with_hands(Scene().handover, Scene().right_start)
        state["hands"][:, 0, 2] += offset_m
        separation.step(state, FRAME, pose.record)
        limits = sorted(
            set(separation.constraints["planned"][: separation.count].round(6).tolist())
        )
        assert tool.sum() == 1
        assert all(limit >= 0 for limit in limits)
        # with the hand at the tool, contact is allowed only where the hand receives
        state["hands"][0, 0] = pose.position
        if gentle:
            place, *others = taught.via_points
            separation.set_contacts(
                [msgspec.structs.replace(place, left=tuple(pose.position.tolist())), *others]
            )
        separation.step(state, FRAME, pose.record)
        allowed = separation.constraints["allowed"][: separation.count] - SLIP_SPEED_MPS
        assert (abs(allowed - 0.25) < 1e-9).sum() == (1 if gentle else 0)
        # the right hand receives nothing
        state["hands"][0, 0] = Scene().handover
        state["hands"][1, 0] = pose.position
        separation.step(state, FRAME, pose.record)
        assert not (
            abs(separation.constraints["allowed"][: separation.count] - SLIP_SPEED_MPS - 0.25)
            < 1e-9
        ).any()
        state["hands"][0, 0] = pose.position
        state["hands"][1, 0] = Scene().right_start
        separation.step(state, FRAME, pose.record)
        assert separation.speed_limit == 0.0  # no other part may come nearer


def test_a_hand_just_seen_counts_as_fast() -> None:
    separation = Separation(ASSUMED, URDF)
    pose = ARM.at(POSTURE)
    state = with_hands(np.add(pose.position, (0.25, 0.0, 0.0)))
    state["mode_probabilities"] = 1 / MODES
    separation.step(state, FRAME, pose.record)
    limit_mps = separation.speed_limit
    state["mode_covariances"][0, :, 1, 1] = 0.3**2
    separation.step(state, FRAME, pose.record)
    assert separation.speed_limit == pytest.approx(
        allowed_speed(separation.nearest_m, 1.6, 3.0, 0.13, 0.03)
    )
    assert separation.speed_limit < 0.5 * limit_mps


def test_braking_joints_do_not_take_turns() -> None:
    """The case of a Panda whose forearm slides along a box: braking joints one by one and braking
    all together approach the box alternately.
    """
    cell = cell_of("panda")
    urdf = robot_description(cell)
    arm = ArmStage(cell, urdf)
    separation = Separation(cell, urdf)
    state = blank(STATE)
    frame = blank(frame_layout(7))
    segment = LimiterStage(cell, arm)
    segment.begin(state, np.array(cell.arm.posture))
    state["joints"][1:] = [
        [-0.4, -0.17, 0.33, 0.12, 0.18, -0.28, -0.1],
        [-1.29, -3.0, -2.22, -1.79, -1.4, -1.89, 1.32],
    ]
    separation.constraints["row"][0] = row = np.array([-0.5, 0.03, -0.48, -0.1, 0.12, 0.06, -0.01])
    separation.constraints["planned"][0] = 0.0
    separation.constraints["allowed"][0] = 0.006
    separation.count = 1
    target = np.array([-0.5, -0.02, 0.54, 0.12, 0.2, -0.12, -0.1])
    approach = []
    for _ in range(100):
        segment.step(state, frame, target, np.zeros(7), separation)
        approach.append(row @ state["joints"][1])
    assert max(approach) < 0.05
    assert max(approach[50:]) <= 0.006


def test_stop_does_not_approach_passing_hand() -> None:
    """As a hand sweeps past, the direction to it turns, until a straight stop approaches it."""
    separation = Separation(ASSUMED, URDF)
    state = blank(STATE)
    frame = blank(frame_layout(7))
    segment = LimiterStage(ASSUMED, ARM)
    approach = []
    for is_heeded in (False, True):
        segment.begin(state, POSTURE)
        state["joints"][1] = [0.8, -0.35, 1.0, 0.25, 1.4, 0.45, 0.0]
        along = ARM.at(POSTURE).tasks[:3] @ state["joints"][1]
        along /= np.linalg.norm(along)
        away = np.cross([0.0, 0.0, 1.0], along)
        away /= np.linalg.norm(away)
        speeds = []
        for tick in range(90):
            turn = 0.0044 * tick - 0.1
            row = (math.sin(turn) * along + math.cos(turn) * away) @ ARM.at(
                state["joints"][0]
            ).tasks[:3]
            separation.constraints["row"][0] = row
            separation.constraints["allowed"][0] = SLIP_SPEED_MPS
            separation.count = int(is_heeded)
            segment.stop(state, frame, separation)
            speeds.append(row @ state["joints"][1])
        assert not state["joints"][1].any()
        approach.append(max(speeds))
    assert approach[0] > 0.04
    assert approach[1] < 0.5 * approach[0]
