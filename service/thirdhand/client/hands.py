"""A tracker of one's own in one method."""

from __future__ import annotations

import abc
import contextlib
import math
import reprlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import zenoh

from thirdhand.client.calls import Client
from thirdhand.client.connection import checked_pose
from thirdhand.client.session import UnreachableError
from thirdhand.client.streams import FRAME, Tracker, is_frame
from thirdhand.contract.explain import ExplainedError
from thirdhand.contract.messages import BASE
from thirdhand.contract.records import SIDES
from thirdhand.process.own_class import Accepted, check_attributes, number
from thirdhand.process.progress import say

Pose: TypeAlias = Sequence[float] | None
"""Numbers of a pose, see `Hands`."""
MAX_PAUSE_S = 0.05  # after a longer pause, what was missed is not made up
HANDS_ATTRIBUTES: Mapping[str, Accepted] = {
    "rate_hz": number(1.0, 1000.0, " Hz", math.inf),
    "frame_id": (is_frame, FRAME.rstrip(",")),
}


class Hands(abc.ABC):
    """The hands that a tracker sees, for `thirdhand hands FILE.py:CLASS`: `read` is its own.

    A pose is x y z [m, or `[hands] unit`], or these and a quaternion x y z w; None: not seen.
    """

    rate_hz: float = 100.0
    """Rate at which `read` is called; math.inf if it waits for the tracker's next picture."""
    frame_id: str = BASE
    """The frame of the poses, by which the cell finds the tracker's settings."""

    @abc.abstractmethod
    def read(self) -> tuple[Pose, Pose]:
        """The poses of the left and of the right hand, as they are now."""

    def publish(
        self, session: zenoh.Session, cell: str = "thirdhand", *, is_over: Callable[[], bool]
    ) -> None:
        """Publish the hands until `is_over`, from the time on at which somebody listens.

        What is no pose is not published: the first one is said, all are counted. Raises
        ExplainedError for a class that gives anything but two hands.
        """
        check_attributes(self, HANDS_ATTRIBUTES)
        refused = 0
        with Tracker(session, cell, timeout_s=None) as tracker:
            self._check_frame(Client(session, cell))
            due_s = time.monotonic()
            try:
                while not is_over():
                    for reason in self._publish(tracker):
                        refused += 1
                        if refused == 1:
                            say(f"{type(self).__name__}.read: {reason}; not published")
                    due_s = max(due_s + 1.0 / self.rate_hz, time.monotonic() - MAX_PAUSE_S)
                    time.sleep(max(due_s - time.monotonic(), 0.0))
            finally:
                if refused:
                    say(f"{refused} poses of {type(self).__name__}.read were not published")

    def _publish(self, tracker: Tracker) -> list[str]:
        """Publish both hands once; the reasons why a pose was not."""
        asked_ns = time.time_ns()
        poses: Any = self.read()
        seen_ns = time.time_ns() if self.rate_hz == math.inf else asked_ns
        try:
            left, right = poses
        except (TypeError, ValueError):
            raise ExplainedError(
                f"{type(self).__name__}.read gives {reprlib.repr(poses)}; the poses of the left "
                "and of the right hand needed, None for a hand that is not seen"
            ) from None

        reasons = []
        for side, pose in zip(SIDES, (left, right), strict=True):
            if pose is None:
                continue
            try:
                position, orientation = checked_pose(side, pose)
            except ValueError as error:
                reasons.append(str(error))
                continue
            tracker.publish(side, position, orientation, stamp_ns=seen_ns, frame_id=self.frame_id)
        return reasons

    def _check_frame(self, client: Client) -> None:
        """Say that the cell does not know the frame of the poses."""
        with contextlib.suppress(UnreachableError):
            frames = client.status().frames
            if frames and self.frame_id not in frames:
                say(
                    f"{type(self).__name__}.frame_id: {self.frame_id!r} given; the cell accepts "
                    f"{', '.join(map(repr, frames))}"
                )
