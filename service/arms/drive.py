"""The loop around a drive: joints measured and told, commands played back and written."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, Protocol

import zenoh

from service.arms.playback import Playback, SpeedLimits
from service.client import Follower, UnreachableError
from service.contract.channels import key
from service.contract.explain import ExplainedError
from service.core.frame import Vector
from service.settings.config import RATES_HZ, JointSettings

SHORTEST_TICK_S = 1.0 / RATES_HZ[1]


class DriveError(ExplainedError, RuntimeError):
    """A drive that cannot be reached, is another arm's, or stopped: says what to do about it."""


class Measured(NamedTuple):
    """An arm's joints (J,) [rad, rad/s] as a period begins, and the time [s] since the last."""

    position: Vector
    velocity: Vector
    elapsed_s: float


class Drive(AbstractContextManager[Any], Protocol):
    """What one file an arm provides. Within its context it is controlled; that begins and ends with
    the arm at rest. All raise DriveError.
    """

    limits: JointSettings
    """Names and limits of the drive, which nothing that is written leaves."""
    speed_limits: SpeedLimits | None
    """Least and greatest velocities by position, where it has such."""
    period_s: float
    """Of what is written, the drive's own."""
    takes_velocity: bool
    """Whether it is led by velocities: then the joints as measured close the loop."""

    def stands_at(self) -> Vector:
        """The joints (J,) [rad], before it is controlled."""

    def read(self) -> Measured:
        """The joints, as soon as the drive's next period begins."""

    def write(self, position: Vector, velocity: Vector) -> None:
        """Leads joints (J,) to a position and velocity [rad, rad/s] at the end of this period."""


def say(line: str) -> None:
    """Tells a line on standard error."""
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
    """Drives an arm by a cell's commands until `stop`, and brakes it then.

    Raises DriveError, also where commands come too slowly to be followed, and UnreachableError
    where no command came for `wait_s` [s].
    """
    playback = Playback(drive.limits, drive.stands_at(), period_s=drive.period_s, speed_limits=drive.speed_limits)
    passed_s, told_s, following, refused = 0.0, 0.0, False, 0
    with Follower(session, drive.limits.names, cell) as follower, drive:
        while True:
            measured = drive.read()
            passed_s += measured.elapsed_s
            if passed_s - told_s >= 0.9 * max(playback.tick_s, SHORTEST_TICK_S):
                follower.tell(playback.in_turn(measured.position).tolist(), measured.velocity.tolist())
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
                following, wait_s = not following, float("inf")
                say("commands come, the arm follows" if following else "no commands: the arm brakes")
            if (reason := playback.too_slow) and not moved.velocity.any():
                raise DriveError(f"the daemon of cell {cell}: {reason}")
            if playback.refused and not refused:
                say(f"refused: {playback.reason}")
            refused = playback.refused
            if passed_s > wait_s:
                heard = f"; {follower.rejected} were none of this arm's: {follower.reason}" * (follower.rejected > 0)
                raise UnreachableError(
                    f"no command came on {key(cell, 'joints/command')} within {wait_s:g} s{heard}: is the daemon "
                    "running in this cell? `thirdhand doctor` tells what it waits for"
                )
