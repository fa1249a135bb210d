"""Hand and arm samples as they come in: checked, mapped to frame `base`, and filtered to a state at
the tick.
"""

from __future__ import annotations

import math

import numpy as np

from service.config import Settings
from service.contract.channels import BY_KEY
from service.contract.messages import JointState, PoseStamped, WireError, finite, in_order
from service.contract.records import SIDES, Cause
from service.core.frame import Record, Vector
from service.core.hand_estimator import HandEstimator
from service.core.rotation import rotation

UNIT_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}
FARTHEST_M = 5.0  # a hand farther from the base plate is a mistake of units


def _stale_ticks(key: str, settings: Settings) -> int:
    """The ticks, at least one, after which a channel's source is silent; rounding of the period
    does not make it one more.
    """
    section, name = BY_KEY[key].stale_after or ("", "")
    duration_ms: float = getattr(getattr(settings, section), name)
    return max(1, math.ceil(round(duration_ms / 1000 / settings.period_s, 6)))


class Intake:
    """Hand and arm samples into the state: each hand's estimate, the arm's newest sample."""

    def __init__(self, settings: Settings) -> None:
        hands = settings.hands
        self._period_s = settings.period_s
        self._stale_ticks = tuple(_stale_ticks(f"hands/{side}", settings) for side in SIDES)
        self._silent_ticks = _stale_ticks("joints/state", settings)
        self._names = settings.joints.names
        self._farthest_joint = max(2 * math.pi, *(abs(x) + 1.0 for x in settings.joints.lower + settings.joints.upper))
        self._scale = UNIT_M[hands.unit]
        self._origin = np.array(hands.base_from_tracker[:3])
        self._axes = rotation(hands.base_from_tracker[3:])
        self._estimator = HandEstimator(noise_std_m=hands.noise_std_m, period_s=settings.period_s)

    def begin(self, state: Record) -> None:
        """Sets in a state of zeros what no sample has told yet."""
        state["tick"] = state["hand_ticks"] = state["arm_tick"] = -1
        self._estimator.begin(state)

    def is_fresh(self, state: Record, side: int) -> bool:
        """Whether a hand has been seen, and lately enough."""
        seen = int(state["hand_ticks"][side])
        return seen >= 0 and int(state["tick"]) - seen < self._stale_ticks[side]

    def is_arm_heard(self, state: Record) -> bool:
        """Whether the arm has told its joints lately enough."""
        seen = int(state["arm_tick"])
        return seen >= 0 and int(state["tick"]) - seen < self._silent_ticks

    def advance(self, state: Record, ticks: int) -> None:
        """The state moved on by some ticks: fresh hands by their motion, others stand still."""
        state["tick"] += ticks
        for side in (0, 1):
            if self.is_fresh(state, side):
                self._estimator.advance(state, side, ticks)
            else:
                self._estimator.rest(state, side)

    def take_hand(self, state: Record, side: int, sample: PoseStamped) -> None:
        """One hand's sample filtered in, or counted as rejected."""
        fresh = self.is_fresh(state, side)
        cause: Cause | None = None
        if not (finite(sample.position) and finite(sample.orientation)):
            cause = Cause.NOT_FINITE
        elif abs(math.hypot(*sample.orientation) - 1.0) > 0.01:
            cause = Cause.NOT_A_ROTATION
        elif math.hypot(*(position := self._in_base(sample.position)).tolist()) > FARTHEST_M:
            cause = Cause.OUT_OF_RANGE
        else:
            cause = self._why_not_newer(sample.stamp_ns, int(state["hand_stamps_ns"][side]), fresh=fresh)
        if cause is not None:
            state["rejected"][cause] += 1
            return
        since = int(state["tick"]) - int(state["hand_ticks"][side])
        self._estimator.take(state, side, position, interval_s=since * self._period_s, fresh=fresh)
        state["hand_stamps_ns"][side] = sample.stamp_ns
        state["hand_ticks"][side] = state["tick"]

    def _in_base(self, position: tuple[float, float, float]) -> Vector:
        """A tracker's position (3,) in frame `base` [m]."""
        return np.asarray(self._axes @ (self._scale * np.array(position)) + self._origin)

    @staticmethod
    def _why_not_newer(stamp_ns: int, newest_ns: int, *, fresh: bool) -> Cause | None:
        """A repeated stamp is never news; an older one is, once the source has been silent: its
        clock was set back.
        """
        if stamp_ns == newest_ns:
            return Cause.REPEATED
        return Cause.OLDER if fresh and stamp_ns < newest_ns else None

    def take_arm(self, state: Record, sample: JointState) -> None:
        """The arm's sample into the state, or counted as rejected."""
        try:
            position, velocity = in_order(sample, self._names)
        except WireError:
            state["rejected"][Cause.INCOMPLETE] += 1
            return
        if not (finite(position) and finite(velocity)):
            cause: Cause | None = Cause.NOT_FINITE
        elif max(map(abs, position)) > self._farthest_joint or max(map(abs, velocity)) > 100:
            cause = Cause.OUT_OF_RANGE
        else:
            cause = self._why_not_newer(sample.stamp_ns, int(state["arm_stamp_ns"]), fresh=self.is_arm_heard(state))
        if cause is not None:
            state["rejected"][cause] += 1
            return
        state["measured"] = position
        state["measured_velocities"] = velocity
        state["arm_stamp_ns"] = sample.stamp_ns
        state["arm_tick"] = state["tick"]
