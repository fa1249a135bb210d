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
    """An arm's joints (J,) [rad, rad/s] at the begin of a period, and the time since the
    last reading.
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
    with Follower(session, drive.limits.names, cell) as follower, drive:
        driving = _Driving(drive, playback, follower, cell, wait_s, say)
        while not driving.step(stop):
            pass
    return playback


class _Driving:
    """The periods of a drive, one after the other, and the messages about them."""

    def __init__(
        self,
        drive: Drive,
        playback: Playback,
        follower: Follower,
        cell: str,
        wait_s: float,
        say: Callable[[str], None],
    ) -> None:
        self._drive = drive
        self._playback = playback
        self._follower = follower
        self._cell = cell
        self._wait_s = wait_s  # a command must arrive within this time
        self._say = say
        self._passed_s = 0.0
        self._published_s = 0.0  # time of the newest published joint state
        self._following = False
        self._refused = 0

    def step(self, stop: threading.Event) -> bool:
        """Drive the arm for one period; True once it stands after `stop`. Raises DriveError and
        UnreachableError.
        """
        drive = self._drive
        playback = self._playback
        measured = drive.read()
        self._passed_s += measured.elapsed_s
        self._publish(measured)
        stopping = stop.is_set()
        moved = playback.step(
            () if stopping else self._follower.commands(),
            measured=measured.position if drive.takes_velocity else None,
            elapsed_s=measured.elapsed_s,
        )
        drive.write(moved.position, moved.velocity)

        stands = not moved.velocity.any()
        if stopping and stands and not playback.following:
            return True
        self._report_following()
        if stands and (reason := playback.too_slow):
            raise DriveError(f"the daemon of cell {self._cell}: {reason}")
        if playback.refused and not self._refused:
            self._say(f"command refused: {playback.reason}")
        self._refused = playback.refused
        self._check_heard()
        return False

    def _publish(self, measured: Measured) -> None:
        """Publish the joints about once a tick."""
        interval_s = 0.9 * max(self._playback.tick_s, SHORTEST_TICK_S)
        if self._passed_s - self._published_s >= interval_s:
            position = self._playback.in_turn(measured.position).tolist()
            self._follower.tell(position, measured.velocity.tolist())
            self._published_s = self._passed_s

    def _report_following(self) -> None:
        """Report that the arm begins, or ends, to follow commands."""
        if self._following != self._playback.following:
            self._following = not self._following
            self._wait_s = float("inf")
            self._say(
                "commands arrive, the arm follows"
                if self._following
                else "no commands arrive, the arm brakes"
            )

    def _check_heard(self) -> None:
        """Raise UnreachableError if no command arrived in time."""
        if self._passed_s <= self._wait_s:
            return
        follower = self._follower
        others = f"; {follower.rejected} were for another arm: {follower.reason}"
        raise UnreachableError(
            f"no command arrived on {key(self._cell, 'joints/command')} within "
            f"{self._wait_s:g} s{others if follower.rejected else ''}: is the daemon running in "
            "this cell? `thirdhand doctor` shows what it waits for"
        )
