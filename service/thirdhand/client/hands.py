"""A tracker of one's own in one method."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import TypeAlias

import zenoh

from thirdhand.client.streams import UNTURNED, Tracker
from thirdhand.contract.messages import BASE
from thirdhand.contract.records import SIDES

Pose: TypeAlias = Sequence[float] | None
"""Numbers of a pose, see `Hands`."""
MAX_PAUSE_S = 0.05  # after a longer pause, what was missed is not made up


class Hands:
    """The hands that a tracker sees, for `thirdhand hands FILE.py:CLASS`: `read` is its own.

    A pose is x y z [m, or `[hands] unit`], or these and a quaternion x y z w; None: not seen.
    """

    rate_hz: float = 100.0
    """Rate at which `read` is called; math.inf if it waits for the tracker's next picture."""
    frame_id: str = BASE
    """The frame of the poses, by which the cell finds the tracker's settings."""

    def read(self) -> tuple[Pose, Pose]:
        """The poses of the left and of the right hand, as they are now."""
        raise NotImplementedError

    def publish(
        self, session: zenoh.Session, cell: str = "thirdhand", *, is_over: Callable[[], bool]
    ) -> None:
        """Publish the hands until `is_over`, from the time on at which somebody listens. Raises
        ValueError for what is no pose.
        """
        with Tracker(session, cell, timeout_s=None) as tracker:
            due_s = time.monotonic()
            while not is_over():
                asked_ns = time.time_ns()
                poses = self.read()
                seen_ns = time.time_ns() if self.rate_hz == math.inf else asked_ns
                for side, pose in zip(SIDES, poses, strict=True):
                    if pose is not None:
                        x, y, z, *turned = (float(value) for value in pose)
                        i, j, k, w = turned or UNTURNED
                        tracker.publish(
                            side, (x, y, z), (i, j, k, w), stamp_ns=seen_ns, frame_id=self.frame_id
                        )
                due_s = max(due_s + 1.0 / self.rate_hz, time.monotonic() - MAX_PAUSE_S)
                time.sleep(max(due_s - time.monotonic(), 0.0))
