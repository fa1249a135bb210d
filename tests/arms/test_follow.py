"""`thirdhand follow`: bad input ends in a sentence; an arm whose daemon is killed in motion comes
to rest, and follows the next daemon.
"""

from __future__ import annotations

import contextlib
import math
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from support.arms import MODELS, toml_of
from support.cell import LEFT, Tracker, serving, thirdhand, told, until
from support.driven_arms import NEAR_LEFT, driven
from support.franka_cell import assert_allowed, franka_toml, robot, simulated
from support.paths import ROOT
from thirdhand.arms import place_of
from thirdhand.arms.arm import ARM_ATTRIBUTES, Arm
from thirdhand.arms.drive import follow
from thirdhand.arms.simulated import SimulatedArm
from thirdhand.client import UnreachableError, endpoints, open_session
from thirdhand.contract import cdr
from thirdhand.contract.explain import ExplainedError
from thirdhand.core.frame import Vector
from thirdhand.core.limiter.stage import Limited
from thirdhand.daemon.launch import free_port
from thirdhand.process.own_class import explained, own_class
from thirdhand.settings.config import Settings

STILL_RADPS = 0.02  # a slower measured joint is at rest


@contextlib.contextmanager
def hub(folder: Path) -> Iterator[zenoh.Session]:
    """A router to which all connect, so that a daemon may come and go."""
    (folder / "router.json5").write_text('{mode: "router"}')
    with open_session(listen=["tcp/127.0.0.1:0"], zenoh_config=folder / "router.json5") as session:
        yield session


class Following:
    """A running `thirdhand follow`, and its output."""

    def __init__(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "thirdhand", "follow", *arguments]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=ROOT)
        self.said: list[str] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        self.said += iter(self.process.stderr.readline, "")

    def until(self, line: str, times: int = 1) -> None:
        self.waits(lambda: sum(line in log_line for log_line in self.said) >= times)

    def waits(self, what: Callable[[], bool], timeout_s: float = 60.0) -> None:
        end = time.monotonic() + timeout_s
        while not what():
            if time.monotonic() > end:
                raise TimeoutError(f"not within {timeout_s} s: {self.said}")
            assert self.process.poll() is None, self.said
            time.sleep(0.005)

    def ended(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(20)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join(10)
        assert self.process.stderr is not None
        self.process.stderr.close()


@contextlib.contextmanager
def following(*arguments: str) -> Iterator[Following]:
    running = Following(*arguments)
    try:
        yield running
    finally:
        running.close()


class Joints:
    """The joints that the arm reported last."""

    def __init__(self, session: zenoh.Session) -> None:
        self._subscriber = session.declare_subscriber("thirdhand/joints/state", self._take)
        self.position = self.velocity = np.zeros(7)

    def _take(self, sample: zenoh.Sample) -> None:
        state = cdr.decode_joints(sample.payload.to_bytes())
        self.position = np.array(state.position)
        self.velocity = np.array(state.velocity)

    def moving(self) -> bool:
        return bool(np.abs(self.velocity).max() > 0.05)


def killed_and_started_again(folder: Path, arm: str, network: str, *more: str) -> None:
    """Kill a daemon while the arm moves, and start another, which the arm then follows; stop the
    second one in motion as well. The arm is at rest at the end.
    """
    config = folder / "arm.toml"
    config.write_text(network)
    with hub(folder) as session, Tracker(session) as tracker:
        connect = ("--connect", *endpoints(session))
        joints = Joints(session)
        with following(
            arm, *connect, "--config", str(config), *more
        ) as running:  # `follow` waits for the daemon
            with serving(folder, *connect, network=network) as daemon:
                running.until("commands arrive")
                for attempt in range(20):
                    tracker.left = LEFT if attempt % 2 else NEAR_LEFT
                    with contextlib.suppress(TimeoutError):
                        running.waits(joints.moving, 3.0)
                        break
                daemon.process.kill()
            running.until("the arm brakes")
            running.waits(lambda: not np.abs(joints.velocity).max() > STILL_RADPS, 5.0)
            stands = joints.position
            time.sleep(0.3)
            assert np.abs(joints.position - stands).max() < 1e-3
            with serving(folder, *connect, network=network) as daemon:
                running.until("commands arrive", times=2)
                tracker.left = LEFT if tracker.left == NEAR_LEFT else NEAR_LEFT
                running.waits(joints.moving)
                daemon.end()
                running.until("the arm brakes", times=2)
            assert running.ended() == 0
    assert re.search(
        r"ended at rest; delay -?\d+\.\d ticks; 0 commands were refused", running.said[-1]
    )


PATIENT = """[network]
listen = ["tcp/127.0.0.1:0"]
[arm]
silent_ms = 1000
fault_error_rad = 0.5
"""


@pytest.mark.thorough
def test_arm_rests_when_its_daemon_is_killed(tmp_path: Path) -> None:
    killed_and_started_again(tmp_path, "simulated", PATIENT)


@simulated
def test_franka_keeps_its_limits_while_daemons_are_killed(tmp_path: Path) -> None:
    network = franka_toml().replace("[arm]\n", "[arm]\nsilent_ms = 1000\nfault_error_rad = 0.5\n")
    with robot(tmp_path) as device:
        killed_and_started_again(
            tmp_path,
            "franka",
            network + PATIENT.split("[arm]", maxsplit=1)[0],
            "--robot",
            device.address,
        )
    assert device.new.mean() > 0.99
    assert_allowed(device.velocity[device.new], device.joints[device.new])


# --- bad input -----------------------------------------------------------------------------------


def refused(*arguments: str, exit_code: int = 1) -> str:
    """The standard error of a `thirdhand follow` that fails."""
    done = told("follow", *arguments)
    assert (done.returncode, done.stdout) == (exit_code, "")
    (line,) = done.stderr.splitlines()
    return line


def test_bad_input_ends_in_a_sentence_with_what_to_do(tmp_path: Path) -> None:
    assert "no arm 'frankia'; franka, simulated, ur, wam, xarm accepted, or one" in refused(
        "frankia", exit_code=2
    )
    assert "is a daemon or a router running" in refused(
        "simulated", "--connect", "tcp/127.0.0.1:1", "--wait", "0.2"
    )
    six = tmp_path / "six.toml"
    six.write_text(toml_of(MODELS["ur5"]))
    with serving(tmp_path) as daemon:
        connect = ("--connect", daemon.endpoint)
        assert "only daemons of other cells run" in refused(
            "simulated", *connect, "--cell", "nowhere", "--wait", "0.2"
        )
        assert "commands 7 joints, wam/base_yaw_joint, " in (
            line := refused("simulated", *connect, "--config", str(six))
        )
        assert "the settings here have 6" in line
        assert "give the daemon's settings by --config" in line
        assert "give --config with its own URDF" in refused("franka", *connect)


@pytest.mark.thorough
def test_it_waits_for_a_daemon_that_starts_later_and_says_so(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with following("simulated", "--connect", endpoint) as running:
        running.until("waiting, up to 60 s: ")
        # longer than the time-outs of a connection and a request
        time.sleep(3.0)
        with (
            serving(tmp_path, network=f'[network]\nlisten = ["{endpoint}"]\n') as daemon,
            Tracker(daemon.session),
        ):
            running.until("commands arrive, the arm follows")
            assert running.ended() == 0


@pytest.mark.parametrize("program", ["follow", "sim"])
@pytest.mark.one_case
def test_rate_without_room_to_brake_is_refused(program: str, tmp_path: Path) -> None:
    """The refusal is one sentence."""
    with serving(tmp_path, "--rate", "50") as daemon, Tracker(daemon.session):
        done = thirdhand(
            program, *(("simulated",) if program == "follow" else ()), "--connect", daemon.endpoint
        )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith(
        "50 Hz is too slow: commands would arrive every 20 ms, and an arm brakes 20 ms after its "
        "last command; 67 Hz or more needed"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("class A: pass", "is no class of thirdhand.Arm"),
        ("import nothing_like_this", "ModuleNotFoundError: No module named 'nothing_like_this'"),
        ("from dataclasses import dataclass\n@dataclass\nclass A:\n  x: int", "is no class of"),
        ("class B: pass", "has no attribute 'A'"),
        ("read: return [0.0], [0.0]", "A.read gives 1 positions and 1 velocities; positions and"),
        ("read: return 2 * ([[0.0]] * 7,)", "gives positions of shape (7, 1) and velocities of"),
        ("read: return [0.0] * 7, None", "gives 7 positions and velocities of shape (); positions"),
        ("read: return [0.0, 0.0, 0.0]", "gives [0.0, 0.0, 0.0]; positions and velocities needed"),
        ("read: return 2 * ([math.nan] * 7,)", "A.read gives a joint that is not finite"),
        ("read: assert helper()", "A.read: mine.py:5: ZeroDivisionError: division by zero"),
        ("wait: return None", "A.wait gives None; the time [s] since it was called last needed"),
        ("speak: pass", "mine.py:A has no read, write, which a class of thirdhand.Arm needs"),
        ("__init__: pass", "A.__init__ does not call super().__init__(settings, address)"),
        ("__init__: 1 / 0", "A.__init__: mine.py:3: ZeroDivisionError: division by zero"),
        ("__enter__: assert False", "A.__enter__: mine.py:3: AssertionError"),
        ("x = 1\ny = 1 / 0", "mine.py:A: mine.py:2: ZeroDivisionError: division by zero"),
    ],
)
def test_what_is_wrong_with_an_arm_of_ones_own_is_said(
    text: str, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "mine.py"
    method, _, body = text.partition(": ")
    if method in ("read", "wait", "speak", "__init__", "__enter__"):
        kind = "thirdhand.Arm" if method == "speak" else "SimulatedArm"
        text = (
            "import math, thirdhand; from thirdhand.arms.simulated import SimulatedArm\n"
            f"class A({kind}):\n  def {method}(self, *_): {body}\ndef helper():\n  return 1 / 0"
        )
    file.write_text(text)

    def run() -> None:
        with open_session() as session:
            kind = own_class(place_of(f"{file}:A"), Arm)
            with explained(kind):
                arm = kind(Settings())
            follow(arm, session, "thirdhand", stop=threading.Event())

    with pytest.raises(ExplainedError, match=re.escape(message)):
        run()


class Led(SimulatedArm):
    """An arm led by positions, which keeps what was written last."""

    def write(self, position: Vector, velocity: Vector, acceleration: Vector) -> None:
        self.written = position
        if not self.guided:
            self.position = position


def test_an_arm_that_was_led_stays_where_it_was_led_to() -> None:
    """So does one that stands elsewhere for another reason, after a moment."""
    arm = Led(Settings())
    begin = arm.position.copy()
    with open_session() as session, driven(arm, session):
        until(lambda: hasattr(arm, "written"))
        arm.guided = True
        for step in range(20):
            arm.position = begin + 0.02 * step
            time.sleep(0.01)
        until(lambda: np.abs(arm.written - arm.position).max() < 1e-9)
        arm.guided = False
        time.sleep(0.1)
        assert np.abs(arm.position - begin - 0.38).max() < 1e-6


def test_an_arm_outside_its_limits_does_not_jump() -> None:
    arm = Led(Settings())
    outside = np.array(arm.limits.lower) - 0.1
    still = np.zeros(7)
    arm.lead(Limited(outside, still, still, limited=False))
    np.testing.assert_array_equal(arm.written, outside)


def test_an_arm_of_another_distribution_is_found_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "theirs-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[thirdhand.arms]\ntheirs = their_arm:Their\n")
    (tmp_path / "their_arm.py").write_text(
        "import thirdhand\nclass Their(thirdhand.Arm): read = write = print\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert own_class(place_of("theirs"), Arm).__name__ == "Their"


def test_where_no_command_comes_that_is_told_and_the_arm_stays() -> None:
    arm = SimulatedArm(Settings())
    told_so = r"no command arrived on thirdhand/joints/command within 0\.3 s: is the daemon"
    with open_session() as session, pytest.raises(UnreachableError, match=told_so):
        follow(arm, session, "thirdhand", stop=threading.Event(), wait_s=0.3)
    assert arm.position.tolist() == list(Settings().arm.posture)


@pytest.mark.parametrize("value", [-1, 0, 20, math.nan, "0.1", None, True, print])
@pytest.mark.parametrize("name", ARM_ATTRIBUTES)
def test_attributes_of_a_class_are_checked(name: str, value: object) -> None:
    is_accepted, needed = ARM_ATTRIBUTES[name]
    accepted = {
        **dict.fromkeys(("takes_velocity", "guided"), (True,)),
        "speed_limits": (None, print),
        "lag_s": (0,),
        "gain": (20,),
    }
    assert is_accepted(value) == (value in accepted.get(name, ()))
    assert is_accepted(getattr(Arm, name))
    if is_accepted(value):
        return
    kind = type("Mine", (SimulatedArm,), {name: staticmethod(value) if value is print else value})
    with open_session() as session, pytest.raises(ExplainedError, match=f"^Mine.{name}: ") as said:
        follow(kind(Settings()), session, "thirdhand", stop=threading.Event())
    assert str(said.value).endswith(f"{needed} needed")


def test_each_attribute_of_an_arm_has_a_check() -> None:
    assert ARM_ATTRIBUTES.keys() == Arm.__annotations__.keys()


@given(
    st.lists(st.tuples(st.floats(-1, 1), st.floats(-20, 20)), min_size=2, max_size=20),
    st.floats(0.0, 0.5),
    st.sampled_from((1.0, 300.0, math.inf)),
)
def test_what_leads_keeps_the_speed_limits(
    moves: list[tuple[float, float]], lag_s: float, gain: float
) -> None:
    """Also where velocity and acceleration jump."""
    arm = Led(Settings())
    arm.lag_s = lag_s
    arm.gain = gain
    max_step = np.array(arm.limits.velocity) * arm.period_s
    position = np.array(Settings().arm.posture)
    still = np.zeros(7)
    arm.lead(Limited(position, still, still, limited=False))
    for share, acceleration in moves:
        before = arm.written
        velocity = share * np.array(arm.limits.velocity)
        position = np.clip(position + velocity * arm.period_s, arm.limits.lower, arm.limits.upper)
        arm.lead(Limited(position, velocity, np.full(7, acceleration), limited=False))
        assert (np.abs(arm.written - before) <= max_step + 1e-9).all()


def test_a_lead_that_is_not_finite_is_not_written() -> None:
    arm = Led(Settings())
    arm.lag_s = math.nan
    still = np.zeros(7)
    with pytest.raises(ExplainedError, match=r"lag_s nan and gain inf given; 0 to 0\.5 s and"):
        arm.lead(Limited(arm.position, still, still, limited=False))
    assert not hasattr(arm, "written")


BLOCKS = """import time
from thirdhand.arms.simulated import SimulatedArm
class Blocks(SimulatedArm):
    def __exit__(self, *_):
        print("switched off", flush=True)
    def read(self):
        self.calls = vars(self).get("calls", 0) + 1
        while self.calls > 20:
            HANG
        return super().read()
"""


@pytest.mark.parametrize("hang", ["time.sleep(60)", "swallowed()"])
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_follow_ends_while_a_method_blocks(hang: str, sent: signal.Signals, tmp_path: Path) -> None:
    """So it does where the class catches all exceptions."""
    file = tmp_path / "mine.py"
    file.write_text(
        BLOCKS.replace("HANG", hang)
        + "def swallowed():\n    try:\n        time.sleep(60)\n    except BaseException: pass\n"
    )
    with (
        serving(tmp_path) as daemon,
        following(f"{file}:Blocks", "--connect", daemon.endpoint) as running,
    ):
        running.until("Blocks.read has not returned for 2 s, at mine.py:")
        running.process.send_signal(sent)
        assert running.process.wait(10) == 130
