"""A Franka by libfranka's protocol: each cycle that is written holds the limits that its maker
publishes, whatever commands arrive; and the arm follows the commands.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from support.franka_cell import STANDS, assert_allowed, cell, fr3, robot, simulated
from thirdhand.arms import franka
from thirdhand.arms.drive import DriveError
from thirdhand.arms.playback import Playback
from thirdhand.client import Command
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.limiter.stage import Limiter
from thirdhand.settings.config import JointSettings, Settings, robot_description

# period of the commands [s]
TICK = 0.002
PERIOD = franka.FRANKA_PERIOD_S
Vector = npt.NDArray[np.float64]


def motion(wanted: Vector) -> list[Command]:
    """Commands as the service gives them, from where the arm stands."""
    limiter = Limiter(fr3(), TICK)
    state = (STANDS, np.zeros(7), np.zeros(7))
    commands = [Command(0, tuple(STANDS), (0.0,) * 7, 0, 0, 0)]
    for tick, velocity in enumerate(wanted, start=1):
        state = limiter.step(*state, velocity)[:3]
        commands.append(
            Command(round(1e9 * TICK * tick), tuple(state[0]), tuple(state[1]), tick, 0, 0)
        )
    return commands


def sway(seconds: float) -> Vector:
    times = TICK * np.arange(round(seconds / TICK))[:, None]
    swayed: Vector = 0.9 * np.clip(times, 0.0, 1.0) * np.sin(2.0 * times + 0.5 * np.arange(7))
    return swayed


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_toward_its_ends_each_joint_is_slower_as_the_robot_asks(way: float, lost: float) -> None:
    """The commands move toward a joint's end faster than the robot allows there."""
    rng = np.random.default_rng(1)
    commands = motion(np.full((2000, 7), way * 1.5))
    limits = franka.limits_of(fr3())
    playback = Playback(limits, STANDS, period_s=PERIOD, speed_limits=franka.speed_limits)
    joints = [STANDS]
    velocity = []
    for i in range(4000):
        came = [commands[i // 2]] if i % 2 == 0 and rng.uniform() >= lost else []
        moved = playback.step(came, measured=joints[-1])
        joints.append(moved.position)
        velocity.append(moved.velocity)
    assert_allowed(np.array(velocity), np.array(joints[:-1]))
    assert np.abs(np.array(velocity)).max() > 1.4


@simulated
@pytest.mark.parametrize(
    ("jitter_s", "lost", "rms_rad"), [(0.0, 0.0, 4e-3), (0.001, 0.0, 4e-3), (0.003, 0.05, 4.7e-3)]
)
def test_it_follows_within_its_limits_where_it_is_told_to_be(
    tmp_path: Path, jitter_s: float, lost: float, rms_rad: float
) -> None:
    rng = np.random.default_rng(2)
    commands = motion(np.vstack((sway(5.0), np.zeros((750, 7)))))
    late = np.where(
        rng.uniform(size=len(commands)) < lost,
        math.inf,
        rng.uniform(0.0, 1.0, len(commands)) * jitter_s,
    )
    arriving = sorted(
        ((i * TICK + late[i], command) for i, command in enumerate(commands)),
        key=lambda one: one[0],
    )
    measured = []
    passed_s = 0.0
    index = 0
    with robot(tmp_path, "--fast") as device:
        arm = franka.FrankaArm(cell(), device.address)
        playback = Playback(
            arm.limits, arm.measured()[0], period_s=arm.period_s, speed_limits=arm.speed_limits
        )
        with arm:
            while passed_s < 6.3:
                elapsed_s = arm.wait()
                joints, _ = arm.measured()
                passed_s += elapsed_s
                came = []
                while index < len(arriving) and arriving[index][0] <= passed_s:
                    came.append(arriving[index][1])
                    index += 1
                measured.append((passed_s, joints))
                moved = playback.step(came, measured=joints, elapsed_s=elapsed_s)
                arm.lead(moved)
    assert playback.refused == 0
    assert device.new.mean() > 0.999
    assert_allowed(device.velocity, device.joints)
    times = TICK * np.arange(len(commands))
    commanded = np.array([command.position for command in commands])
    speeds = np.array([command.velocity for command in commands])
    when = np.array([sample[0] for sample in measured])
    where = np.array([sample[1] for sample in measured])
    expected, fast = (
        np.stack([np.interp(when, times, x[:, j]) for j in range(7)], axis=1)
        for x in (commanded, speeds)
    )
    error = where - expected
    late_s = -float((error * fast).sum() / (fast * fast).sum())
    rms = float(np.sqrt((error**2).mean()))
    print(
        f"jitter {jitter_s}: {1e3 * rms:.2f} mrad rms, {1e3 * np.abs(error).max():.1f} worst, "
        f"{1e3 * late_s:.1f} ms"
    )
    assert rms <= rms_rad
    assert late_s <= 0.010
    kinematics = ArmStage(cell(), robot_description(cell()))
    distance_m = max(
        math.dist(kinematics.at(q).position, kinematics.at(commanded[-1]).position)
        for q in where[-100:]
    )
    assert distance_m <= 1e-3, "at rest the tool is within 1 mm"


@pytest.mark.parametrize("which", ["six joints", "another arm"])
def test_what_is_configured_for_another_arm_is_refused(which: str) -> None:
    joints = Settings().joints
    if which == "six joints":
        joints = JointSettings(
            **{name: getattr(joints, name)[:6] for name in JointSettings.__struct_fields__}
        )
    with pytest.raises(DriveError, match="give --config with its own URDF"):
        franka.limits_of(joints)


@simulated
def test_a_robot_that_does_not_answer_is_told() -> None:
    with pytest.raises(DriveError, match=r"no Franka at 127\.9\.9\.9: .*--robot its address"):
        franka.FrankaArm(cell(), "127.9.9.9")
