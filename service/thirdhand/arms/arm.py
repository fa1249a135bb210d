"""An arm of one's own in two methods; playback, lead, braking and limits are inherited."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Self

import numpy as np

from thirdhand.arms import DriveError
from thirdhand.arms.playback import SpeedLimits
from thirdhand.core.frame import Vector
from thirdhand.core.limiter.stage import Limited
from thirdhand.settings.config import Settings

MAX_BEHIND_S = 0.05  # a loop that is later than this does not make up for its delay


class Arm(AbstractContextManager["Arm"]):
    """One arm, for `thirdhand follow MODULE:CLASS`: `read` and `write` are its own. Its context
    switches the drives on and off; it begins and ends with the arm at rest. J joints are in the
    order of `limits.names`, in rad or m, and s.

    A servo that receives positions is late. So what is written leads by `lag_s`, its delay, and by
    the acceleration / `gain`, if it accelerates by `gain` [1/s²] times its error:

        q + lag_s dq/dt + (1 / gain) d²q/dt²
    """

    period_s: float = 0.002
    """Period at which the drive takes what is written."""
    lag_s: float = 0.0
    """Delay of its servo, which `thirdhand doctor` measures."""
    gain: float = math.inf
    """Stiffness of its servo [1/s²]."""
    takes_velocity: bool = False
    """True if the drive follows velocities; what is read then closes the loop."""
    guided: bool = False
    """True while the arm is led by hand."""
    speed_limits: SpeedLimits | None = None
    """Velocity limits that depend on the position, if the drive has such."""

    def __init__(self, settings: Settings, address: str = "") -> None:
        self.limits = settings.joints  # names and limits; nothing that is written exceeds them
        self.address = address
        self._due_s = time.monotonic()

    def read(self) -> tuple[Sequence[float] | Vector, Sequence[float] | Vector]:
        """The measured positions and velocities (J,)."""
        raise NotImplementedError

    def write(self, position: Vector, velocity: Vector, acceleration: Vector) -> None:
        """Move the joints to this position, velocity and acceleration (J,) until the next period
        ends.
        """
        raise NotImplementedError

    def wait(self) -> float:
        """Wait for the next period; the time [s] since it was called last. For a drive with a clock
        of its own.
        """
        before_s = self._due_s
        due_s = before_s + self.period_s
        time.sleep(max(due_s - time.monotonic(), 0.0))
        self._due_s = max(due_s, time.monotonic() - MAX_BEHIND_S)
        return self._due_s - before_s

    def __enter__(self) -> Self:
        self._due_s = time.monotonic()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the control; the arm stands, or has failed."""

    def measured(self) -> tuple[Vector, Vector]:
        """The joints (n,) that `read` gives: position [rad or m] and velocity [rad/s or m/s].
        Raises DriveError.
        """
        position, velocity = (np.array(part, np.float64) for part in self.read())
        count = len(self.limits.names)
        if position.shape != (count,) or velocity.shape != (count,):
            raise DriveError(
                f"{type(self).__name__}.read gives {position.size} positions and {velocity.size} "
                f"velocities; {count} of each needed, of {', '.join(self.limits.names)}"
            )
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            raise DriveError(f"{type(self).__name__}.read gives a joint that is not finite")
        return position, velocity

    def lead(self, moved: Limited) -> None:
        """Write a motion, ahead by what its servo lags."""
        position = moved.position + self.lag_s * moved.velocity + moved.acceleration / self.gain
        # an arm that stands outside its limits does not jump into them
        lower = np.minimum(self.limits.lower, moved.position)
        upper = np.maximum(self.limits.upper, moved.position)
        self.write(np.clip(position, lower, upper), moved.velocity, moved.acceleration)
