"""Hand and arm samples as they come in: checked, mapped to frame `base`, and filtered to a state at
the tick.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.config import Settings
from service.contract.channels import BY_KEY
from service.contract.messages import JointState, PoseStamped, WireError, in_order
from service.contract.records import Cause
from service.core.frame import Record, Records, Vector, as_array
from service.core.hand_estimator import HandEstimator, is_fresh, take
from service.core.rotation import rotation

UNIT_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}
NOT_FINITE, NOT_A_ROTATION, OUT_OF_RANGE = int(Cause.NOT_FINITE), int(Cause.NOT_A_ROTATION), int(Cause.OUT_OF_RANGE)
REPEATED, OLDER = int(Cause.REPEATED), int(Cause.OLDER)
FASTEST_JOINT = 100.0  # [rad/s] beyond it a measured joint is a mistake
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
        self._stale_ticks = _stale_ticks("hands/left", settings)
        self._silent_ticks = _stale_ticks("joints/state", settings)
        self._names = settings.joints.names
        self._farthest_joint = max(2 * math.pi, *(abs(x) + 1.0 for x in settings.joints.lower + settings.joints.upper))
        origin, axes = np.array(hands.base_from_tracker[:3]), rotation(hands.base_from_tracker[3:])
        self._frame = np.column_stack((UNIT_M[hands.unit] * axes, origin))
        self._estimator = HandEstimator(noise_std_m=hands.noise_std_m, period_s=settings.period_s)

    def begin(self, state: Record) -> None:
        """Sets in a state of zeros what no sample has told yet."""
        state["tick"] = state["hand_ticks"] = state["arm_tick"] = -1
        self._estimator.begin(state)

    def is_fresh(self, state: Record, side: int) -> bool:
        """Whether a hand has been seen, and lately enough."""
        return bool(is_fresh(as_array(state), side, self._stale_ticks))

    def are_fresh(self, state: Record) -> bool:
        """Whether both hands are."""
        return self.is_fresh(state, 0) and self.is_fresh(state, 1)

    def is_arm_heard(self, state: Record) -> bool:
        """Whether the arm has told its joints lately enough."""
        seen = int(state["arm_tick"])
        return seen >= 0 and int(state["tick"]) - seen < self._silent_ticks

    def advance(self, state: Record, ticks: int) -> None:
        """The state moved on by some ticks: fresh hands by their motion, others stand still."""
        state["tick"] += ticks
        self._estimator.advance(state, ticks, self._stale_ticks)

    def take_hand(self, state: Record, side: int, sample: PoseStamped) -> None:
        """One hand's sample filtered in, or counted as rejected."""
        _take_hand(
            as_array(state),
            side,
            sample.stamp_ns,
            sample.position,
            sample.orientation,
            self._frame,
            self._stale_ticks,
            self._period_s,
        )

    def take_arm(self, state: Record, sample: JointState) -> None:
        """The arm's sample into the state, or counted as rejected."""
        try:
            position, velocity = in_order(sample, self._names)
        except WireError:
            state["rejected"][Cause.INCOMPLETE] += 1
            return
        _take_arm(
            as_array(state),
            sample.stamp_ns,
            np.array(position),
            np.array(velocity),
            self._farthest_joint,
            self._silent_ticks,
        )


@compiled
def _take_arm(
    states: Records, stamp_ns: int, position: Vector, velocity: Vector, farthest: float, silent_ticks: int
) -> None:
    state = states[0]
    fresh = state.arm_tick >= 0 and state.tick - state.arm_tick < silent_ticks
    finite = bool(np.isfinite(position).all() and np.isfinite(velocity).all())
    near = bool(np.abs(position).max() <= farthest and np.abs(velocity).max() <= FASTEST_JOINT)
    if _is_refused(state.rejected, finite, True, near, stamp_ns, state.arm_stamp_ns, fresh):
        return
    state.measured[:], state.measured_velocities[:] = position, velocity
    state.arm_stamp_ns, state.arm_tick = stamp_ns, state.tick


@compiled
def _is_refused(
    rejected: Vector, finite: bool, turned: bool, near: bool, stamp_ns: int, newest_ns: int, fresh: bool
) -> bool:
    """Whether a sample is refused, and then counted by the first cause: not finite, no rotation,
    out of range, or not newer.

    A repeated stamp is never news; an older one is, once the source has been silent: its clock was
    set back.
    """
    cause = -1
    if not finite:
        cause = NOT_FINITE
    elif not turned:
        cause = NOT_A_ROTATION
    elif not near:
        cause = OUT_OF_RANGE
    elif stamp_ns == newest_ns:
        cause = REPEATED
    elif fresh and stamp_ns < newest_ns:
        cause = OLDER
    if cause >= 0:
        rejected[cause] += 1
    return cause >= 0


@compiled
def _take_hand(
    states: Records,
    side: int,
    stamp_ns: int,
    position: tuple[float, float, float],
    turn: tuple[float, float, float, float],
    frame: Vector,
    stale_ticks: int,
    period_s: float,
) -> None:
    """`Intake.take_hand`, with the tracker's axes and origin (3, 4) in frame base."""
    state, in_base, norm, far = states[0], np.empty(3), 0.0, 0.0
    for k in range(4):
        norm += turn[k] * turn[k]
    for i in range(3):
        in_base[i] = frame[i, 3]
        for k in range(3):
            in_base[i] += frame[i, k] * position[k]
        far += in_base[i] * in_base[i]
    fresh = is_fresh(states, side, stale_ticks)
    finite = bool(np.isfinite(np.array(position)).all() and np.isfinite(np.array(turn)).all())
    turned, near = abs(math.sqrt(norm) - 1.0) <= 0.01, far <= FARTHEST_M * FARTHEST_M
    if _is_refused(state.rejected, finite, turned, near, stamp_ns, state.hand_stamps_ns[side], fresh):
        return
    since = state.tick - state.hand_ticks[side]
    take(states, side, in_base, since * period_s, fresh)
    state.hand_stamps_ns[side] = stamp_ns
    state.hand_ticks[side] = state.tick
