"""The loop around a drive: publish the measured joints, play back the commands, write them."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, Protocol

import zenoh

from thirdhand.arms.playback import Playback, SpeedLimits
from thirdhand.client import Follower, UnreachableError
from thirdhand.contract.channels import key
from thirdhand.contract.explain import ExplainedError
from thirdhand.core.frame import Vector
from thirdhand.settings.config import RATES_HZ, JointSettings

SHORTEST_TICK_S = 1.0 / RATES_HZ[1]


class DriveError(ExplainedError, RuntimeError):
    """A drive cannot be reached, belongs to another arm, or stopped; the message has the remedy."""


class Measured(NamedTuple):
    """An arm's joints (J,) [rad, rad/s] at the begin of a period, and the time [s] since the
    last.
    """

    position: Vector
    velocity: Vector
    elapsed_s: float


class Drive(AbstractContextManager[Any], Protocol):
    """The drive of one arm. Its context controls the arm; it begins and ends with the arm at rest.
    All methods raise DriveError.
    """

    limits: JointSettings
    """Names and limits of the joints; nothing that is written exceeds them."""
    speed_limits: SpeedLimits | None
    """Velocity limits that depend on the position, if the drive has such."""
    period_s: float
    """Period of the drive [s]."""
    takes_velocity: bool
    """True if the drive follows velocities; the measured joints then close the loop."""

    def stands_at(self) -> Vector:
        """The joints (J,) [rad] before the arm is controlled."""

    def read(self) -> Measured:
        """The joints at the begin of the drive's next period, for which it waits."""

    def write(self, position: Vector, velocity: Vector) -> None:
        """Move joints (J,) to a position and velocity [rad, rad/s] at the end of this period."""


def say(line: str) -> None:
    """Print a line on standard error."""
    print(line, file=sys.stderr, flush=True)


def follow(
    drive: Drive,
    session: zenoh.Session,
    cell: str,
    *,
    stop: threading.Event,
    wait_s: float = float("inf"),
    say: Callable[[str], None] = say,
) -> Playback:
    """Drive an arm by a cell's commands until `stop`, then brake it.

    Raises DriveError, also if commands arrive too slowly to be followed, and UnreachableError if no
    command arrives within `wait_s` [s].
    """
    playback = Playback(
        drive.limits, drive.stands_at(), period_s=drive.period_s, speed_limits=drive.speed_limits
    )
    passed_s = 0.0
    told_s = 0.0
    following = False
    refused = 0
    with Follower(session, drive.limits.names, cell) as follower, drive:
        while True:
            measured = drive.read()
            passed_s += measured.elapsed_s
            if passed_s - told_s >= 0.9 * max(playback.tick_s, SHORTEST_TICK_S):
                follower.tell(
                    playback.in_turn(measured.position).tolist(), measured.velocity.tolist()
                )
                told_s = passed_s
            stopping = stop.is_set()
            moved = playback.step(
                () if stopping else follower.commands(),
                measured=measured.position if drive.takes_velocity else None,
                elapsed_s=measured.elapsed_s,
            )
            drive.write(moved.position, moved.velocity)
            if stopping and not playback.following and not moved.velocity.any():
                return playback
            if following != playback.following:
                following = not following
                wait_s = float("inf")
                say(
                    "commands arrive, the arm follows"
                    if following
                    else "no commands arrive, the arm brakes"
                )
            if (reason := playback.too_slow) and not moved.velocity.any():
                raise DriveError(f"the daemon of cell {cell}: {reason}")
            if playback.refused and not refused:
                say(f"command refused: {playback.reason}")
            refused = playback.refused
            if passed_s > wait_s:
                others = f"; {follower.rejected} were for another arm: {follower.reason}" * (
                    follower.rejected > 0
                )
                raise UnreachableError(
                    f"no command arrived on {key(cell, 'joints/command')} within {wait_s:g} "
                    f"s{others}: is the daemon running in this cell? `thirdhand doctor` shows what "
                    "it waits for"
                )
