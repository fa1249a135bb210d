"""An arm of one's own in two methods; playback, lead, braking and limits are inherited."""

from __future__ import annotations

import abc
import math
import reprlib
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Self

import numpy as np

from thirdhand.arms import DRIVE_PERIOD_S, GAIN, LAG_S, DriveError
from thirdhand.arms.playback import SpeedLimits
from thirdhand.core.frame import Vector
from thirdhand.core.limiter.stage import Limited
from thirdhand.process.own_class import Accepted, check_attributes, number
from thirdhand.settings.config import Settings

MAX_BEHIND_S = 0.05  # a loop that is later than this does not make up for its delay
IS_BOOL: Accepted = (lambda value: isinstance(value, bool | np.bool_), "True or False")
ARM_ATTRIBUTES: Mapping[str, Accepted] = {
    "period_s": number(*DRIVE_PERIOD_S, " s"),
    "lag_s": number(*LAG_S, " s"),
    "gain": number(*GAIN, " 1/s²", math.inf),
    "takes_velocity": IS_BOOL,
    "guided": IS_BOOL,
    "speed_limits": (
        lambda value: value is None or callable(value),
        "None or a function of position and velocity",
    ),
}


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
        self._max_velocity = np.array(settings.joints.velocity)
        self._position: Vector | None = None  # of the motion that `lead` wrote last
        self._ahead = np.zeros(len(self.limits.names))  # what was written led it by this

    def check(self) -> None:
        """Raise ExplainedError for a class that cannot be driven."""
        check_attributes(self, ARM_ATTRIBUTES)
        if not hasattr(self, "limits"):
            raise DriveError(
                f"{type(self).__name__}.__init__ does not call "
                "super().__init__(settings, address); that is needed"
            )

    @abc.abstractmethod
    def read(self) -> tuple[Sequence[float] | Vector, Sequence[float] | Vector]:
        """The measured positions and velocities (J,)."""

    @abc.abstractmethod
    def write(self, position: Vector, velocity: Vector, acceleration: Vector) -> None:
        """Move the joints to this position, velocity and acceleration (J,) until the next period
        ends.
        """

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
        joints: Any = self.read()
        names = self.limits.names
        try:
            position, velocity = (np.array(part, np.float64) for part in joints)
        except (TypeError, ValueError):
            raise self._refused(reprlib.repr(joints)) from None
        if not position.shape == velocity.shape == (len(names),):
            raise self._refused(
                f"{_form('positions', position)} and {_form('velocities', velocity)}"
            )
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            raise DriveError(f"{type(self).__name__}.read gives a joint that is not finite")
        return position, velocity

    def lead(self, moved: Limited) -> None:
        """Write a motion, ahead by what its servo lags."""
        position = moved.position
        ahead = self.lag_s * moved.velocity + moved.acceleration / self.gain
        if not np.isfinite(ahead).all():
            raise DriveError(
                f"{type(self).__name__}: lag_s {self.lag_s} and gain {self.gain} given; "
                f"{ARM_ATTRIBUTES['lag_s'][1]} and {ARM_ATTRIBUTES['gain'][1]} needed"
            )

        # motion and lead together keep the speed limits, except where the arm was led by hand
        before = position if self._position is None else self._position
        max_step = self.period_s * self._max_velocity
        step = (position - before).clip(-max_step, max_step)
        ahead = (ahead - self._ahead).clip(-max_step - step, max_step - step) + self._ahead

        # an arm that stands outside its limits does not jump into them
        lower = np.minimum(self.limits.lower, position)
        upper = np.maximum(self.limits.upper, position)
        written = (position + ahead).clip(lower, upper)
        self._position = position
        self._ahead = written - position
        self.write(written, moved.velocity, moved.acceleration)

    def _refused(self, joints: str) -> DriveError:
        """The error for joints that `read` gives, in words."""
        names = self.limits.names
        return DriveError(
            f"{type(self).__name__}.read gives {joints}; positions and velocities needed, "
            f"{len(names)} of each, of {', '.join(names)}"
        )


def _form(what: str, values: Vector) -> str:
    """The shape of values in words."""
    return f"{len(values)} {what}" if values.ndim == 1 else f"{what} of shape {values.shape}"
