"""Joint states as robots publish them: any subset and order of joints, from several publishers,
with velocities and efforts or without.
"""

from __future__ import annotations

import functools
import math

from thirdhand.contract.messages import JointState, in_order


def measured(
    message: JointState, names: tuple[str, ...]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Measured position and velocity of the named joints, in that order.

    A velocity that is NaN, or an array of velocities of another length than the names, is not
    measured: the velocity is 0 then. Raises WireError for missing joints or positions.
    """
    if len(message.velocity) not in (0, len(message.names)):
        message = message._replace(velocity=())
    position, velocity = in_order(message, names)
    return position, tuple(0.0 if math.isnan(value) else value for value in velocity)


class JointStates:
    """Assembles the states of an arm from messages that carry some of its joints each.

    A message with all joints is a state. Else a state is assembled once each joint was measured
    anew, all within `patience_s` [s]; its stamp is the oldest of its parts, so that a part whose
    stamp does not advance is found. Messages without joints of the arm are ignored.
    """

    def __init__(self, names: tuple[str, ...], patience_s: float) -> None:
        self._names = names
        self._patience_s = patience_s
        # arrival [s], stamp [ns], position and velocity of each joint, by name
        self._parts: dict[str, tuple[float, int, float, float]] = {}
        self._heard_s = -math.inf  # arrival of the newest message
        # arrival of the newest state, or of the first message after a pause
        self._state_s = -math.inf

    def take(self, message: JointState, at_s: float) -> JointState | None:
        """The state that is complete with a message, which arrives at the time `at_s` [s]; None if
        none is.
        """
        if at_s - self._heard_s > self._patience_s:
            self._state_s = at_s
        self._heard_s = at_s
        carried = (
            _carried(message.names, self._names)
            if len(message.position) == len(message.names)
            else ()
        )
        if not carried:
            return None
        if len(carried) == len(self._names):
            self._parts.clear()
            self._state_s = at_s
            return message
        for name, position, velocity in zip(carried, *measured(message, carried), strict=True):
            if math.isfinite(position):
                self._parts[name] = at_s, message.stamp_ns, position, velocity
        self._parts = {
            name: part for name, part in self._parts.items() if at_s - part[0] <= self._patience_s
        }
        if len(self._parts) < len(self._names):
            return None
        state = self._assembled()
        self._parts.clear()
        self._state_s = at_s
        return state

    def incomplete(self, message: JointState, at_s: float) -> JointState | None:
        """The newest incomplete state, if no whole one was found for `patience_s`: it names what is
        missing.
        """
        if at_s - self._state_s <= self._patience_s:
            return None
        return self._assembled() if self._parts else message

    def _assembled(self) -> JointState:
        """The known joints, in the arm's order."""
        names = tuple(name for name in self._names if name in self._parts)
        _, stamps, position, velocity = zip(*(self._parts[name] for name in names), strict=True)
        return JointState(min(stamps), names, position, velocity)


@functools.lru_cache(maxsize=64)
def _carried(given: tuple[str, ...], names: tuple[str, ...]) -> tuple[str, ...]:
    """The names of an arm that are among those given."""
    return tuple(name for name in names if name in given)
