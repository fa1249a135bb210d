"""The bench: physics that follow commands, a task that succeeds only if the tool is where it must
be, and its channels on the network.
"""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pinocchio as pin
import pytest
import zenoh

from support.cell import thirdhand
from support.cell_commands import started
from support.demo import SCENE, Bytes, Sample
from support.repeated import repeated
from support.wam import JOINT_NAMES
from thirdhand.client import endpoints, open_session
from thirdhand.contract import cdr, channels, messages
from thirdhand.core.skill.pose import CLOSED, OPEN
from thirdhand.settings.config import WAM, Settings
from thirdhand.skills.via_points import adapted
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.bench import Bench, Observation
from thirdhand_sim.lab.rehearsal import rehearse
from thirdhand_sim.network import BenchError, Commands, Dropout, Live, RunReport, run
from thirdhand_sim.observed_world import ObservedWorld
from thirdhand_sim.script import GRIP_S, HandScript, Teacher
from thirdhand_sim.teach import demonstrations

STILL = (0.0,) * 7
TURNING = np.array([0.8, 0, 0, 0, 0, 0, 0])  # [rad/s]


class Follower:
    """Joint commands that move the tool plate to a point: one damped least-squares step a tick,
    with the posture in the null space.
    """

    def __init__(self, joints: tuple[float, ...]) -> None:
        self.model = pin.buildModelFromUrdf(str(WAM))
        self.data = self.model.createData()
        self.frame = self.model.getFrameId("tool_plate")
        self.joints = np.array(joints)
        self.posture = self.joints.copy()

    def command(self, point: npt.ArrayLike) -> tuple[tuple[float, ...], tuple[float, ...]]:
        jacobian = pin.computeFrameJacobian(
            self.model, self.data, self.joints, self.frame, pin.LOCAL_WORLD_ALIGNED
        )[:3]
        pin.framesForwardKinematics(self.model, self.data, self.joints)
        error = np.subtract(point, self.data.oMf[self.frame].translation)
        inverse = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + 1e-4 * np.eye(3))
        velocity = inverse @ (30.0 * error) + (np.eye(7) - inverse @ jacobian) @ (
            self.posture - self.joints
        )
        velocity = np.clip(velocity, -1.5, 1.5)
        self.joints = self.joints + 0.002 * velocity
        return tuple(self.joints.tolist()), tuple(velocity.tolist())


def test_opening_fingers_let_go() -> None:
    with Bench(HandScript(SCENE, seed=1)) as bench:
        bench.begin()
        assert bench.step(gripper=1.0).gripper == 1.0
        held = bench.world.pose(bench.world.board).position
        closures = [bench.step(gripper=0.0).gripper for _ in range(round(GRIP_S / bench.period_s))]
        assert closures[-1] == pytest.approx(0.0, abs=1e-9)
        assert closures[len(closures) // 2] == pytest.approx(0.5, abs=0.02)
        assert held[2] > 0.2
        # no hand took the board
        assert bench.world.pose(bench.world.board).position[2] == pytest.approx(0.0)
        assert not bench.events().handover.reached


def test_learned_gripper_does_the_task() -> None:
    """A learned gripper hands the board over and grasps the glass."""
    takes = [take.every(2) for take in demonstrations(SCENE, count=3, seed=1, gripper=True)]
    taught = adapted(
        learn(takes, components=5, points=60), SCENE.via_points(gripper=True), tolerance=0.05
    )
    run = rehearse(HandScript(SCENE, seed=31), lambda bench: taught, rate_hz=100, keep=True)
    assert run.events.success
    changes = np.flatnonzero(np.diff(run.frames["gripper"].astype(int)))
    assert run.frames["gripper"][changes + 1].tolist() == [CLOSED, OPEN, CLOSED]


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench(HandScript(SCENE, seed=1)) as built:
        yield built


def play(bench: Bench, *, aside: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[Observation]:
    """A whole run in which the tool moves on the teacher's path with an offset of `aside` [m]."""
    follower = Follower(bench.observe().joints)
    teacher = Teacher(SCENE, seed=1, clock=bench.script.clock)
    for _ in range(750):
        bench.step(*follower.command(teacher.truth(0.0).position))
    bench.begin()
    observations = []
    while not bench.finished:
        observations.append(
            bench.step(*follower.command(teacher.truth(bench.time_s).position + aside))
        )
    return observations


@pytest.mark.quick
def test_taught_path_does_the_task(bench: Bench) -> None:
    play(bench)
    events = bench.events()
    assert events.success
    assert max(event.error_mm for event in (events.handover, events.grasp, events.carry)) < 30.0
    assert [round(event.time_s, 1) for event in (events.handover, events.grasp, events.carry)] == [
        3.0,
        6.9,
        10.3,
    ]
    world = bench.world
    # the board lies at the hand
    assert np.linalg.norm(np.subtract(world.pose(world.board).position, SCENE.soldering)) < 0.11
    assert np.linalg.norm(np.subtract(world.pose(world.glass).position, SCENE.carry)) < 0.06
    assert np.linalg.norm(np.subtract(world.pose(world.iron).position, SCENE.right_final)) < 0.06


def test_path_above_misses_every_event(bench: Bench) -> None:
    """A tool that passes six centimetres above misses every event."""
    play(bench, aside=(0.0, 0.0, 0.06))
    events = bench.events()
    assert not any(event.reached for event in (events.handover, events.grasp, events.carry))
    assert events.handover.error_mm == pytest.approx(60.0, abs=20.0)
    world = bench.world
    assert world.pose(world.glass).position == pytest.approx(SCENE.glass)


def test_same_commands_give_same_run() -> None:
    """Two runs with the same commands are identical."""
    traces = []
    for _ in range(2):
        with Bench(HandScript(SCENE, seed=2)) as bench:
            traces.append(
                [(observation.joints, observation.tool) for observation in play(bench)[::50]]
            )
    assert traces[0] == traces[1]


def turned(bench: Bench) -> npt.NDArray[np.float64]:
    """The commanded joints [rad], after the first one has turned at TURNING for 0.2 s."""
    joints = np.array(bench.observe().joints)
    for _ in range(100):
        joints = joints + 0.002 * TURNING
        bench.step(tuple(joints), tuple(TURNING))
    return joints


def test_arm_brakes_without_commands(bench: Bench) -> None:
    """The arm brakes 20 ms after the last command."""
    joints = turned(bench)
    for _ in range(9):
        bench.step()
    assert bench.observe().joint_velocities[0] == pytest.approx(0.8, abs=0.01)
    for _ in range(20):
        observation = bench.step()
    assert np.abs(observation.joint_velocities).max() < 0.02
    assert observation.joints[0] - joints[0] < 0.8 * 0.025


def test_arm_does_not_leap_after_commands(bench: Bench) -> None:
    """The commands are far ahead of the arm."""
    joints = np.array(bench.observe().joints)
    speeds = []
    for tick in range(400):
        # the bench had slept for 50 ms
        joints = joints + (26 if tick == 100 else 1) * 0.002 * TURNING
        observation = bench.step(tuple(joints), tuple(TURNING))
        speeds.append(max(map(abs, observation.joint_velocities)))
    assert max(speeds) < 0.8 + 0.3
    assert observation.joints[0] == pytest.approx(joints[0] + 0.002 * 0.8, abs=1e-3)


def test_late_commands_do_not_move_the_arm(bench: Bench) -> None:
    """A restored network delivers them."""
    joints = turned(bench)
    for _ in range(60):  # the network is cut for 120 ms
        stood = np.array(bench.step().joints)
    late = [(joints + 0.002 * k * TURNING, TURNING) for k in range(1, 60)]
    late.append((late[-1][0], 0 * TURNING))  # the service had stopped by then
    for position, velocity in late[::3] + late[-1:]:
        observation = bench.step(tuple(position), tuple(velocity))
        assert np.abs(np.array(observation.joints) - stood).max() < 2e-3
    assert bench.refused == 21
    # a service that takes over begins at the arm's position
    for k in range(100):
        observation = bench.step(tuple(stood + 0.00001 * k**2 * TURNING), tuple(0.01 * k * TURNING))
    assert observation.joints[0] - stood[0] == pytest.approx(0.00001 * 99**2 * 0.8, abs=0.01)
    assert bench.refused == 21


def test_hands_return_the_way_they_went() -> None:
    """Before the script begins, they rest at their start."""
    with Bench(HandScript(SCENE, seed=1, speed=20.0)) as bench:
        start = bench.observe().hands.left.position
        for _ in range(20):
            np.testing.assert_array_equal(bench.step().hands.left.position, start)
        bench.begin()
        forth = []
        while not bench.finished:
            forth.append(bench.step().hands.left.position)
        bench.turn_back()
        steps = 0
        while not bench.back:
            observation = bench.step()
            steps = steps + 1
            assert (
                min(
                    np.linalg.norm(np.subtract(observation.hands.left.position, was))
                    for was in (start, *forth)
                )
                < 1e-9
            )
        np.testing.assert_array_equal(observation.hands.left.position, start)
        assert steps == np.ceil(bench.script.duration_s / 0.002)


# --- on the network ------------------------------------------------------------------------------


class Service:
    """A substitute for the daemon, which answers each hand sample at once with a command to stand
    still.
    """

    def __init__(self, session: zenoh.Session, cell: str) -> None:
        self.hands: dict[str, list[messages.PoseStamped]] = {"left": [], "right": []}
        self.joints: messages.JointState | None = None
        self._command = session.declare_publisher(channels.key(cell, "joints/command"))
        self._subscribers = [
            session.declare_subscriber(channels.key(cell, "joints/state"), self.state),
            session.declare_subscriber(channels.key(cell, "hands/*"), self.hand),
        ]

    def state(self, sample: zenoh.Sample) -> None:
        self.joints = self.joints or cdr.decode_joints(sample.payload.to_bytes())

    def hand(self, sample: zenoh.Sample) -> None:
        pose = cdr.decode_pose(sample.payload.to_bytes())
        self.hands[str(sample.key_expr).rpartition("/")[2]].append(pose)
        if self.joints is not None:
            tick = len(self.hands["left"])
            stamp_ns = 10_000_000 * tick  # 100 Hz, even if this machine is late
            command = messages.JointState(
                stamp_ns, self.joints.names[::-1], self.joints.position[::-1], STILL
            )
            attachment = messages.Attachment(tick, time.time_ns(), pose.stamp_ns)
            self._command.put(
                cdr.encode_joints(command), attachment=cdr.encode_attachment(attachment)
            )


@pytest.fixture
def network() -> Iterator[tuple[zenoh.Session, str]]:
    with open_session(listen=["tcp/127.0.0.1:0"]) as session:
        yield session, endpoints(session)[0]


def test_run_on_network_reports_latency(network: tuple[zenoh.Session, str]) -> None:
    """Events are reported too, and a hidden hand is not published."""
    listening, endpoint = network
    service = Service(listening, "lab/bench")
    reports: list[RunReport] = []
    lines: list[str] = []
    live = Live(
        cell="lab/bench",
        once=True,
        wait_s=10.0,
        dropout=Dropout(start_s=0.2, lasts_s=0.2, hand="right"),
    )
    with (
        Bench(HandScript(SCENE, seed=1, speed=20.0)) as bench,
        open_session(connect=[endpoint]) as session,
    ):
        run(bench, session, live, stop=threading.Event(), report=reports.append, say=lines.append)
    (report,) = reports
    assert not report.success
    assert report.scene == SCENE
    assert service.joints is not None
    assert service.joints.names == JOINT_NAMES
    assert {pose.frame_id for pose in service.hands["left"]} == {"base"}
    assert 0 < report.answered <= report.hands
    assert report.commands > report.hands  # one answer for each hand
    assert 0.0 < report.latency_ms.p50 <= report.latency_ms.p99 <= report.latency_ms.max
    assert [line.split(":")[0] for line in lines[-3:]] == ["handover", "grasp", "carry"]
    left, right = ({pose.stamp_ns for pose in service.hands[hand]} for hand in ("left", "right"))
    assert 15 <= len(left - right) <= 25


def test_missing_commands_are_reported(network: tuple[zenoh.Session, str]) -> None:
    result = thirdhand("sim", "--connect", network[1], "--once", "--wait", "0.2")
    assert result.returncode == 1
    assert "no command on thirdhand/joints/command within 0.2 s" in result.stderr
    assert "Traceback" not in result.stderr


def test_arm_elsewhere_is_scored(network: tuple[zenoh.Session, str]) -> None:
    """The arm stands where the board is offered, so that only this event succeeds."""
    listening, endpoint = network
    follower = Follower(Settings().arm.posture)
    for _ in range(1000):
        joints, _ = follower.command(SCENE.offer)
    state = cdr.encode_joints(messages.JointState(1, JOINT_NAMES, joints, STILL))
    publisher = listening.declare_publisher("lab/joints/state")
    keys = list[str]()
    heard = [
        listening.declare_subscriber(f"lab/{key}", lambda sample: keys.append(str(sample.key_expr)))
        for key in ("joints/state", "hands/left", "objects")
    ]
    Service(listening, "lab")
    reports: list[RunReport] = []
    script = HandScript(SCENE, seed=1, speed=20.0)
    with Bench(script, world=ObservedWorld) as bench, open_session(connect=[endpoint]) as session:

        def play_live(live: Live) -> None:
            run(bench, session, live, stop=threading.Event(), report=reports.append)

        with pytest.raises(BenchError, match="no joint states arrive on lab/joints/state"):
            play_live(Live(cell="lab", wait_s=1.0))
        assert set(keys) == {"lab/hands/left", "lab/objects"}
        with repeated(lambda: publisher.put(state)):
            play_live(Live(cell="lab", once=True))
    (report,) = reports
    assert len(heard) == 3
    assert report.events.handover.reached
    assert report.events.handover.error_mm < 30.0
    assert not report.events.grasp.reached
    assert not report.events.carry.reached


def test_process_ends_on_signal_with_report(
    network: tuple[zenoh.Session, str], tmp_path: Path
) -> None:
    """The process plays until the signal."""
    service = Service(network[0], "thirdhand")
    target = tmp_path / "report.json"
    arguments = (
        "sim",
        "--connect",
        network[1],
        "--output",
        str(target),
        "--speed",
        "20",
        "--seed",
        "5",
    )
    with started(*arguments) as process:
        for line in process.stderr:
            if "the hands move back" in line:
                process.send_signal(signal.SIGTERM)
                break
        stderr = process.stderr.read()
        assert process.wait(timeout=10) == 0, stderr
    assert service.hands["left"]
    (line,) = target.read_text().splitlines()
    report = json.loads(line)
    assert report["seed"] == 5
    assert set(report["events"]) == {"handover", "grasp", "carry"}
    assert set(report["events"]["carry"]) == {"reached", "error_mm", "time_s"}
    assert set(report["latency_ms"]) == {"p50", "p99", "max"}


def test_exit_codes(tmp_path: Path) -> None:
    """Exit codes of bad usage and bad scenes."""
    (tmp_path / "scene.toml").write_text("glass = [0.5, 0.38, 0.5]")
    usage = thirdhand("sim", "--once", "--hands-rate", "7")
    assert usage.returncode == 2
    assert "30 to 500 accepted" in usage.stderr
    bad = thirdhand("sim", "--connect", "tcp/127.0.0.1:1", "--scene", str(tmp_path / "scene.toml"))
    assert bad.returncode == 1
    assert "lies 0.34 m from" in bad.stderr
    assert "example:" in thirdhand("sim", "--help").stdout


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\x00\x01\x00\x00garbage",
        cdr.encode_joints(messages.JointState(1, ("somebody/else",) * 7, STILL, STILL)),
        cdr.encode_joints(messages.JointState(1, JOINT_NAMES, (float("nan"),) * 7, STILL)),
    ],
)
def test_invalid_command_is_never_followed(payload: bytes) -> None:
    """Bytes that are no command are counted."""
    commands = Commands(JOINT_NAMES)
    commands.receive(Sample(Bytes(payload)))  # type: ignore[arg-type]
    assert (commands.count, commands.rejected, commands.take()) == (0, 1, (None, None))
    assert commands.last_error


def test_first_answer_counts_for_latency() -> None:
    """Later commands with the same sample do not count."""
    commands = Commands(JOINT_NAMES)
    payload = cdr.encode_joints(messages.JointState(1, JOINT_NAMES, STILL, STILL))
    now = time.time_ns()
    # the first stamp is older than the start of counting
    for stamp in (now - 10**10, now, now, now + 1, now, now + 1):
        attachment = Bytes(cdr.encode_attachment(messages.Attachment(1, 0, stamp)))
        commands.receive(Sample(Bytes(payload), attachment))  # type: ignore[arg-type]
    assert commands.count == 6
    assert len(commands.latencies_ms) == 2
    assert commands.take() == (STILL, STILL)
    assert commands.take() == (None, None)
