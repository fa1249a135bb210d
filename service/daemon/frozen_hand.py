"""Detection of a tracker that has lost a hand and repeats its last pose, or a pose of its own."""

from __future__ import annotations

import math

from service.contract.messages import PoseStamped

FROZEN_S = 0.5  # a tracker measures no pose twice, bit for bit; over this time it is not the tracker's rate
TRACKED_S = 2.0  # a hand whose samples all differ for so long is measured; a program's hand rests exactly
EXACT_REST_S = 0.1  # a pose that is repeated for so long is a rest
LEAP_M = 0.02  # a hand that was lost appears farther away; one that rested goes on from where it was


class FrozenHand:
    """Repeated poses of one hand.

    A program's hands rest exactly: if most rests so far ended without a leap, repeated poses are
    accepted, as `learn` does in takes.
    """

    def __init__(self) -> None:
        self._pose: PoseStamped | None = None  # the newest pose that differs from the one before
        self._repeated_ns = 0  # stamp of its newest repetition
        self._varies_since_ns = 0  # stamp since which each sample differs from the one before
        self._is_tracked = False
        self._rests = self._leaps = 0

    def is_frozen(self, pose: PoseStamped, unit_m: float) -> bool:
        """True if a sample, with positions in `unit_m` [m], repeats the pose of a lost hand."""
        before = self._pose
        if before is not None and (pose.position, pose.orientation) == (before.position, before.orientation):
            self._repeated_ns = self._varies_since_ns = pose.stamp_ns
            lasts_s = (pose.stamp_ns - before.stamp_ns) / 1e9
            return self._is_tracked and lasts_s >= FROZEN_S and 2 * self._leaps >= self._rests
        if before is not None and self._repeated_ns - before.stamp_ns >= 1e9 * EXACT_REST_S:
            self._rests += 1
            self._leaps += unit_m * math.dist(pose.position, before.position) > LEAP_M
        if before is None or pose.stamp_ns < self._varies_since_ns:
            self._varies_since_ns = pose.stamp_ns
        self._is_tracked |= pose.stamp_ns - self._varies_since_ns >= 1e9 * TRACKED_S
        self._pose = pose
        self._repeated_ns = pose.stamp_ns
        return False
