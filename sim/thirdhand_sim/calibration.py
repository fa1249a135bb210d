"""`python -m thirdhand_sim.calibration` prints how accurate calibrations are: the errors of mapped
positions over the bench, by arm, tracker and method, of a simulated arm that is led by hand.
"""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import argparse
import sys
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thirdhand.recordings.shipped import ARMS, cell_of
from thirdhand.settings.config import Settings, robot_description
from thirdhand.workbench.takes.tool_poses import tool_poses
from thirdhand.workbench.trackers.calibration.solver import (
    Calibration,
    CalibrationError,
    HeldTool,
    bench_corners,
    solve_held,
    solve_points,
)

Array = NDArray[np.float64]

HAND_HZ = 50
JOINTS_HZ = 100
WANDERING_S = 2.0  # time in which a tracker's wandering error changes
FINGER_M = 0.004  # a fingertip misses the point that it touches by this, on each axis
GRIP = (0.03, -0.02, -0.05)  # [m] the hand in the frame of the tool
SWINGS_HZ = (0.05, 0.25)  # frequencies at which a led joint swings
# amplitudes of the swings: of all joints, and of the last three
SWING_RAD = (0.5, 0.35, 0.5, 0.35)
WRIST_SWING_RAD = (0.6, 0.6, 0.8)
MARGIN_RAD = 0.05
# y of the tracker points up, and its axes are a few degrees off the bench's
TRUE_TURN = Rotation.from_quat([0.5, 0.5, 0.5, 0.5]) * Rotation.from_rotvec([0.02, 0.09, -0.03])
ORIGIN = np.array([1.4, 0.03, -0.75])
BENCH = np.stack(
    np.meshgrid(np.linspace(0.4, 1.0, 5), np.linspace(-0.4, 0.4, 5), np.linspace(0.0, 0.4, 3)), -1
).reshape(-1, 3)  # [m] where errors are measured


class TrackerKind(NamedTuple):
    """A kind of tracker: standard deviations of its noise and of its wandering error on each axis
    [m], and the delay of its stamps [s].
    """

    noise_m: float
    wandering_m: float
    delay_s: float


TRACKER_KINDS = {
    "mocap": TrackerKind(0.0005, 0.0003, 0.0),
    "headset": TrackerKind(0.002, 0.006, 0.035),
    "camera": TrackerKind(0.005, 0.020, 0.080),
}


class LedArm(NamedTuple):
    """An arm that is led: times (M,) [s], joints (M, J) [rad], and the tool's positions (M, 3) [m]
    and quaternions (M, 4).
    """

    times_s: Array
    joints: Array
    tool: Array
    turn: Array


def led(
    settings: Settings, seconds: float, random: np.random.Generator, *, rate_hz: float = JOINTS_HZ
) -> LedArm:
    """Slow swings of all joints about the arm's posture, within its limits."""
    times_s = np.arange(0.0, seconds, 1 / rate_hz)
    joints = len(settings.joints.names)
    size = np.array(SWING_RAD[: joints - 3] + WRIST_SWING_RAD)
    swings = np.zeros((len(times_s), joints))
    for _ in range(3):
        frequency = random.uniform(*SWINGS_HZ, joints)
        phase = random.uniform(0, 2 * np.pi, joints)
        swings += size / 3 * np.sin(2 * np.pi * frequency * times_s[:, None] + phase)
    low = np.array(settings.joints.lower) + MARGIN_RAD
    high = np.array(settings.joints.upper) - MARGIN_RAD
    led_joints = np.clip(np.array(settings.arm.posture) + swings, low, high)
    poses, indices = tool_poses(
        settings, robot_description(settings), np.rint(1e9 * times_s).astype(np.int64), led_joints
    )
    return LedArm(times_s[indices], led_joints[indices], poses[:, :3], poses[:, 3:])


def tracked(
    base: Array, kind: TrackerKind, random: np.random.Generator, *, rate_hz: float
) -> Array:
    """Positions (N, 3) [m] that a tracker measures in its frame, of positions in frame `base`."""
    wandering = random.normal(size=3) * kind.wandering_m
    keep = np.exp(-1 / (rate_hz * WANDERING_S))
    errors = np.zeros_like(base)
    for i in range(len(base)):
        wandering = keep * wandering + np.sqrt(1 - keep**2) * kind.wandering_m * random.normal(
            size=3
        )
        errors[i] = wandering
    return np.asarray(
        TRUE_TURN.inv().apply(base - ORIGIN)
        + kind.noise_m * random.normal(size=base.shape)
        + errors
    )


def held(
    arm: LedArm, kind: TrackerKind, random: np.random.Generator, *, rate_hz: float = HAND_HZ
) -> HeldTool:
    """A hand that holds the tool of an arm that is led, as a tracker measures it."""
    at_s = np.arange(arm.times_s[0], arm.times_s[-1] - 0.2, 1 / rate_hz)
    hands = arm.tool + Rotation.from_quat(arm.turn).apply(GRIP)
    base = np.stack([np.interp(at_s, arm.times_s, axis) for axis in hands.T], axis=1)
    return HeldTool(
        at_s + kind.delay_s,
        tracked(base, kind, random, rate_hz=rate_hz),
        arm.times_s,
        arm.tool,
        arm.turn,
    )


def touched(
    arm: LedArm, count: int, kind: TrackerKind, random: np.random.Generator
) -> tuple[Array, Array]:
    """Positions of a finger (N, 3) [m] as a tracker measures it, and of the tool that it touches:
    each is the farthest from those before.
    """
    rows = [int(random.integers(len(arm.tool)))]
    while len(rows) < count:
        rows.append(
            int(np.linalg.norm(arm.tool[:, None] - arm.tool[rows], axis=2).min(axis=1).argmax())
        )
    base = arm.tool[rows]
    finger = base + FINGER_M * random.normal(size=base.shape)
    return np.stack(
        [tracked(position_m[None], kind, random, rate_hz=1.0)[0] for position_m in finger]
    ), base


def error_m(found: Calibration, bench: Array = BENCH) -> float:
    """Mean error of mapped positions over the bench [m]."""
    return float(
        np.linalg.norm(found.mapped(TRUE_TURN.inv().apply(bench - ORIGIN)) - bench, axis=1).mean()
    )


# points, or seconds
CALIBRATION_METHODS = {
    "points, 4": 4,
    "points, 8": 8,
    "held, 15 s": 15.0,
    "held, 40 s": 40.0,
}


def errors_mm(arm: str, kind: TrackerKind, method: float, seeds: range) -> Array:
    """Errors of mapped positions over the bench, and their expected standard deviation at its
    corners (S, 2) [mm], for each seed. A refused calibration has the error infinity.
    """
    settings = cell_of(arm)
    rows = []
    corners = bench_corners(settings)
    for seed in seeds:
        random = np.random.default_rng([seed, round(method)])
        path = led(settings, 40.0 if isinstance(method, int) else method, random)
        try:
            if isinstance(method, int):
                calibration = solve_points(*touched(path, method, kind, random), corners)
            else:
                calibration = solve_held(held(path, kind, random), corners)
        except CalibrationError:
            rows.append((np.inf, np.inf))
        else:
            rows.append((1e3 * error_m(calibration), 1e3 * calibration.std_m))
    return np.array(rows)


def table(seeds: range) -> str:
    """The errors of all arms, trackers and methods, as a table in Markdown."""
    lines = [
        f"| arm | tracker | {' | '.join(CALIBRATION_METHODS)} |",
        "|---" * (2 + len(CALIBRATION_METHODS)) + "|",
    ]
    for arm in ARMS:
        for name, kind in TRACKER_KINDS.items():
            cells = []
            for method in CALIBRATION_METHODS.values():
                error, expected = errors_mm(arm, kind, method, seeds).T
                cells.append(
                    f"{np.median(error):.1f} ({error.max():.1f}; {np.median(expected):.1f})"
                )
            lines.append(f"| {arm} | {name} | {' | '.join(cells)} |")
            print(lines[-1], file=sys.stderr, flush=True)
    return "\n".join(lines)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m thirdhand_sim.calibration",
        description="Prints the errors of calibrations in simulation, in mm: median over the "
        "seeds, in parentheses the worst, and the median of the expected standard deviation at the "
        "corners of the bench.",
    )
    parser.add_argument(
        "--seeds", metavar="N", type=int, default=12, help="number of seeds (default: 12)"
    )
    print(table(range(parser.parse_args().seeds)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
