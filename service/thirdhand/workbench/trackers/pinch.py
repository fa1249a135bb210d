"""Pinches of thumb and index finger as clutch and gripper."""

from __future__ import annotations

from collections.abc import Mapping

import zenoh

from thirdhand.client import Publisher
from thirdhand.contract import cdr
from thirdhand.contract.messages import GRIPPER, JointState

# thumb and index tip: a pinch begins below the first, and ends above the second
PINCHED_M = 0.02
PARTED_M = 0.04
OPEN_M = 0.08  # fingers this far apart wish an open gripper


def is_pinched(apart_m: float, before: bool) -> bool:
    """True while thumb and index tip this far apart [m] pinch, after a pinch or none `before`."""
    return apart_m < (PARTED_M if before else PINCHED_M)


class Pinches:
    """Publisher of the clutch, which is pressed while one hand pinches, and of the gripper's wish,
    which follows the distance between the fingers of one hand. `clutch` and `gripper` name these
    hands, left or right; None: no hand.
    """

    def __init__(
        self,
        session: zenoh.Session,
        cell: str,
        *,
        clutch: str | None = None,
        gripper: str | None = None,
    ) -> None:
        self._clutch = clutch
        self._gripper = gripper
        self._is_pressed = False
        self._publishers = {
            key: Publisher(session, cell, key)
            for key, side in (("clutch", clutch), ("gripper/wish", gripper))
            if side is not None
        }

    def release(self) -> None:
        """End a pinch, and publish that the clutch is released if it was pressed."""
        if self._is_pressed:
            self._is_pressed = False
            self._publishers["clutch"].put(cdr.encode_bool(False))

    def publish(self, distances_m: Mapping[str, float], stamp_ns: int) -> None:
        """Publish clutch and wish for the distances [m] of thumb and index tip of the visible
        hands, by side. A hand that is not seen does not press the clutch, and leaves the gripper as
        it is.
        """
        if self._clutch is not None:
            apart_m = distances_m.get(self._clutch, PARTED_M)
            self._is_pressed = is_pinched(apart_m, self._is_pressed)
            self._publishers["clutch"].put(cdr.encode_bool(self._is_pressed))
        if self._gripper is not None and self._gripper in distances_m:
            open_share = (distances_m[self._gripper] - PINCHED_M) / (OPEN_M - PINCHED_M)
            closure = 1.0 - min(max(open_share, 0.0), 1.0)
            self._publishers["gripper/wish"].put(
                cdr.encode_joints(JointState(stamp_ns, (GRIPPER,), (closure,), ()))
            )
