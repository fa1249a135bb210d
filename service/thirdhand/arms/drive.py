"""The loop around an arm: publish the measured joints, play back the commands, write them."""

from __future__ import annotations

import contextlib
import math
import sys
import threading
from collections.abc import Callable
from numbers import Real

import numpy as np
import zenoh

from thirdhand.arms import DriveError
from thirdhand.arms.arm import Arm
from thirdhand.arms.playback import REJOIN_RAD, Playback
from thirdhand.arms.standstill import Standstill
from thirdhand.client import Follower, UnreachableError
from thirdhand.contract.channels import key
from thirdhand.contract.explain import ExplainedError
from thirdhand.core.frame import Vector
from thirdhand.process.own_class import failure
from thirdhand.settings.config import RATES_HZ

SHORTEST_TICK_S = 1.0 / RATES_HZ[1]
STOOD_S = 0.5  # a servo that is late has come to rest


def say(line: str) -> None:
    """Print a line on standard error."""
    print(line, file=sys.stderr, flush=True)


def follow(
    arm: Arm,
    session: zenoh.Session,
    cell: str,
    *,
    stop: threading.Event,
    wait_s: float = float("inf"),
    say: Callable[[str], None] = say,
    interrupt: Callable[[], None] = lambda: None,
) -> Playback:
    """Drive an arm by a cell's commands until `stop`, then brake it. `interrupt` is called, from
    another thread, where a method of the arm does not return after `stop`.

    Raises DriveError, also if commands arrive too slowly to be followed, and UnreachableError if no
    command arrives within `wait_s` [s].
    """
    arm.check()
    standstill = Standstill(type(arm), stop=stop, say=say, interrupt=interrupt)
    try:
        with contextlib.closing(standstill):
            playback = Playback(
                arm.limits, arm.measured()[0], period_s=arm.period_s, speed_limits=arm.speed_limits
            )
            # the arm's end takes the time that it needs
            with (
                Follower(session, arm.limits.names, cell) as follower,
                arm,
                contextlib.closing(standstill),
            ):
                driving = _Driving(arm, playback, follower, cell, wait_s, say)
                while not driving.step(stop):
                    standstill.moves()
    except ExplainedError:
        raise
    except Exception as error:  # of the maker's library
        raise DriveError(failure(error, type(arm))) from error
    return playback


class _Driving:
    """The periods of an arm, one after the other, and the messages about them."""

    def __init__(
        self,
        arm: Arm,
        playback: Playback,
        follower: Follower,
        cell: str,
        wait_s: float,
        say: Callable[[str], None],
    ) -> None:
        self._arm = arm
        self._playback = playback
        self._follower = follower
        self._cell = cell
        self._wait_s = wait_s  # a command must arrive within this time
        self._say = say
        self._passed_s = 0.0
        self._published_s = 0.0  # time of the newest published joint state
        self._following = False
        self._was_guided = False
        self._stood_s = 0.0  # without commands, at rest
        self._written = arm.measured()[0]
        self._refused = 0

    def step(self, stop: threading.Event) -> bool:
        """Drive the arm for one period; True once it stands after `stop`. Raises DriveError and
        UnreachableError.
        """
        arm = self._arm
        playback = self._playback
        elapsed_s = arm.wait()
        if not (isinstance(elapsed_s, Real) and math.isfinite(elapsed_s)):
            raise DriveError(
                f"{type(arm).__name__}.wait gives {elapsed_s!r}; the time [s] since it was called "
                "last needed"
            )
        position, velocity = arm.measured()
        self._passed_s += elapsed_s
        self._publish(position, velocity)
        stopping = stop.is_set()
        moved = playback.step(
            () if stopping else self._follower.commands(),
            measured=position if arm.takes_velocity or self._stands_elsewhere(position) else None,
            elapsed_s=elapsed_s,
        )
        arm.lead(moved)

        stands = not moved.velocity.any()
        self._stood_s = self._stood_s + elapsed_s if stands and not playback.following else 0.0
        self._written = moved.position
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

    def _stands_elsewhere(self, position: Vector) -> bool:
        """True for an arm that is led by hand, or has stood for STOOD_S away from where it was
        written: the motion then goes on from where it is.
        """
        away_rad = np.abs(self._playback.in_turn(position) - self._written)
        per_rad = np.array(self._arm.limits.per_rad)
        is_away = bool((away_rad > REJOIN_RAD * per_rad).any())
        return self._arm.guided or (self._stood_s > STOOD_S and is_away)

    def _publish(self, position: Vector, velocity: Vector) -> None:
        """Publish the joints about once a tick, and whether the arm is led by hand."""
        interval_s = 0.9 * max(self._playback.tick_s, SHORTEST_TICK_S)
        if self._passed_s - self._published_s >= interval_s:
            self._follower.tell(self._playback.in_turn(position).tolist(), velocity.tolist())
            if self._arm.guided or self._was_guided:
                self._follower.guided(self._arm.guided)
            self._was_guided = self._arm.guided
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
