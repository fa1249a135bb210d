"""Hand and arm samples as they come in: checked, mapped to frame `base`, and filtered to a state at
the tick.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from kmp.compiled import compiled
from service.config import Settings
from service.contract.channels import BY_KEY
from service.contract.messages import BASE, JointState, PoseStamped, WireError, in_order
from service.contract.records import SOURCES, Cause
from service.core.frame import Record, Records, Vector, as_array
from service.core.intake.hand_estimator import HandEstimator, has_jumped, is_fresh, take
from service.core.intake.plausibility import REPEATED, is_confirmed, is_contested, is_swapped, note, refusal
from service.core.rotation import rotation

UNIT_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}
NOT_FINITE, NOT_A_ROTATION, OUT_OF_RANGE = int(Cause.NOT_FINITE), int(Cause.NOT_A_ROTATION), int(Cause.OUT_OF_RANGE)
JUMPED, SWAPPED, ARM = int(Cause.JUMPED), int(Cause.SWAPPED), SOURCES.index("arm")
FASTEST_JOINT = 100.0  # [rad/s] beyond it a measured joint is a mistake
JUMP_RAD, JUMP_RADPS = 0.2, 5.0  # so far and so fast no joint gets from one sample to the next
FARTHEST_OUTSIDE = 0.2  # [rad] a joint farther outside its limits is a mistake, or to be brought back by hand
REST_RAD, REST_S = 0.02, 0.1  # an arm is at rest that stayed within so much for so long
FARTHEST_M = 5.0  # a hand farther from the base plate is a mistake of units


def _stale_ticks(key: str, settings: Settings) -> int:
    """The ticks, at least one, after which a channel's source is silent; rounding of the period
    does not make it one more.
    """
    section, name = BY_KEY[key].stale_after or ("", "")
    duration_ms: float = getattr(getattr(settings, section), name)
    return max(1, math.ceil(round(duration_ms / 1000 / settings.period_s, 6)))


def rest_ticks(settings: Settings) -> int:
    """The ticks over which an arm must tell one posture before it is believed."""
    return math.ceil(round(REST_S / settings.period_s, 6))


class Refused(NamedTuple):
    """A sample that was rejected, and the stamp [ns] of the newest one accepted before."""

    cause: Cause
    sample: PoseStamped | JointState
    newest_ns: int


class Intake:
    """Hand and arm samples into the state: each hand's estimate, the arm's newest sample.

    For people only, no part of the state: `rejected` counts (sources, causes) what this intake
    rejected, and `refused` has the newest of it, by source and cause.
    """

    def __init__(self, settings: Settings) -> None:
        hands = settings.hands
        self._period_s = settings.period_s
        self._stale_ticks = _stale_ticks("hands/left", settings)
        self._silent_ticks = _stale_ticks("joints/state", settings)
        self._rest_ticks = rest_ticks(settings)
        self._names, self._frames = settings.joints.names, ("", BASE, hands.frame)
        limits = np.array([settings.joints.lower, settings.joints.upper])
        self._plausible = limits + FARTHEST_OUTSIDE * np.array([[-1.0], [1.0]])
        origin, axes = np.array(hands.base_from_tracker[:3]), rotation(hands.base_from_tracker[3:])
        self._tracker = np.column_stack((UNIT_M[hands.unit] * axes, origin))
        self._in_base = np.eye(3, 4)
        # a tracker with a frame of its own: what says that it is in base has been mapped already
        self._maps_base = hands.frame in ("", BASE)
        self.rejected = np.zeros((len(SOURCES), len(Cause)), np.int64)
        self.refused: dict[tuple[str, Cause], Refused] = {}
        self._estimator = HandEstimator(noise_std_m=hands.noise_std_m, period_s=settings.period_s)

    def begin(self, state: Record) -> None:
        """Sets in a state of zeros what no sample has told yet."""
        state["tick"] = state["hand_ticks"] = state["arm_tick"] = state["rest_tick"] = state["told_ticks"] = -1
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

    def is_arm_at_rest(self, state: Record) -> bool:
        """Whether the arm is heard and has told one posture for a while, by whatever source."""
        return self.is_arm_heard(state) and int(state["tick"]) - int(state["rest_tick"]) >= self._rest_ticks

    @staticmethod
    def is_contested(state: Record, *, already: bool) -> bool:
        """Whether a hand or the arm is told by two sources; `already`: it was found so before."""
        return is_contested(state, already=already)

    def advance(self, state: Record, ticks: int) -> None:
        """The state moved on by some ticks: fresh hands by their motion, others stand still."""
        state["tick"] += ticks
        self._estimator.advance(state, ticks, self._stale_ticks)

    def take_hand(self, state: Record, side: int, sample: PoseStamped) -> None:
        """One hand's sample filtered in, or counted as rejected."""
        if sample.frame_id not in self._frames:
            state["rejected"][Cause.WRONG_FRAME] += 1
            self._note(state, side, Cause.WRONG_FRAME, sample)
            return
        cause = _take_hand(
            as_array(state),
            side,
            sample.stamp_ns,
            sample.position,
            sample.orientation,
            self._tracker if self._maps_base or sample.frame_id != BASE else self._in_base,
            self._stale_ticks,
            self._period_s,
        )
        if cause >= 0:
            self._note(state, side, cause, sample)

    def take_arm(self, state: Record, sample: JointState) -> None:
        """The arm's sample into the state, or counted as rejected."""
        try:
            position, velocity = in_order(sample, self._names)
        except WireError:
            state["rejected"][Cause.INCOMPLETE] += 1
            self._note(state, ARM, Cause.INCOMPLETE, sample)
            return
        cause = _take_arm(
            as_array(state),
            sample.stamp_ns,
            np.array(position),
            np.array(velocity),
            self._plausible,
            self._silent_ticks,
            self._period_s,
        )
        if cause >= 0:
            self._note(state, ARM, cause, sample)

    def _note(self, state: Record, source: int, cause: int, sample: PoseStamped | JointState) -> None:
        newest_ns = int(state["arm_stamp_ns"] if source == ARM else state["hand_stamps_ns"][source])
        self.refused[SOURCES[source], Cause(cause)] = Refused(Cause(cause), sample, newest_ns)
        self.rejected[source, cause] += 1  # last: who sees it, in another thread, finds the other


@compiled
def _take_arm(
    states: Records,
    stamp_ns: int,
    position: Vector,
    velocity: Vector,
    plausible: Vector,
    silent_ticks: int,
    period_s: float,
) -> int:
    """`Intake.take_arm`, with the least and the greatest plausible joints (2, J) [rad]: the cause
    for which it was rejected, or -1.
    """
    state = states[0]
    passed = state.tick - state.arm_tick
    fresh = state.arm_tick >= 0 and passed < silent_ticks
    if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
        state.rejected[NOT_FINITE] += 1
        return NOT_FINITE
    near, off, moved = True, 0.0, 0.0
    for i in range(len(position)):
        near = near and plausible[0, i] <= position[i] <= plausible[1, i] and abs(velocity[i]) <= FASTEST_JOINT
        off = max(off, abs(position[i] - state.measured[i]))
        moved = max(moved, abs(position[i] - state.rest[i]))
    cause = -1 if near else OUT_OF_RANGE
    if near:
        cause = refusal(stamp_ns, state.arm_stamp_ns, fresh, passed * period_s, silent_ticks * period_s)
    if near and cause != REPEATED:
        jumped = fresh and off > JUMP_RAD + JUMP_RADPS * passed * period_s
        note(states, ARM, jumped, period_s)
        if jumped and cause < 0:
            cause = JUMPED
    if near and (moved > REST_RAD or not fresh):
        state.rest[:] = position
        state.rest_tick = state.tick
    if cause >= 0:
        state.rejected[cause] += 1
        return cause
    state.measured[:], state.measured_velocities[:] = position, velocity
    state.arm_stamp_ns, state.arm_tick = stamp_ns, state.tick
    return -1


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
) -> int:
    """`Intake.take_hand`, with the tracker's axes and origin (3, 4) in frame base: the cause for
    which it was rejected, or -1.
    """
    state, in_base, norm, far = states[0], np.empty(3), 0.0, 0.0
    for k in range(4):
        norm += turn[k] * turn[k]
    for i in range(3):
        in_base[i] = frame[i, 3]
        for k in range(3):
            in_base[i] += frame[i, k] * position[k]
        far += in_base[i] * in_base[i]
    fresh = is_fresh(states, side, stale_ticks)
    since = state.tick - state.hand_ticks[side]
    jumped, cause = False, -1
    if not (np.isfinite(np.array(position)).all() and np.isfinite(np.array(turn)).all()):
        cause = NOT_FINITE
    elif not abs(math.sqrt(norm) - 1.0) <= 0.01:
        cause = NOT_A_ROTATION
    elif not far <= FARTHEST_M * FARTHEST_M:
        cause = OUT_OF_RANGE
    else:
        cause = refusal(stamp_ns, state.hand_stamps_ns[side], fresh, since * period_s, stale_ticks * period_s)
        if cause != REPEATED:
            jumped = fresh and has_jumped(states, side, in_base, since * period_s)
            note(states, side, jumped, period_s)
            jumped = jumped or is_swapped(states, side, in_base, stale_ticks, period_s)
        if cause < 0 and jumped and not is_confirmed(states, side, in_base, stale_ticks, period_s):
            cause = SWAPPED if state.doubts[side, 3] else JUMPED
    if cause >= 0:
        state.rejected[cause] += 1
        return cause
    take(states, side, in_base, since * period_s, jumped or not fresh)
    state.doubts[side, 2:] = 0
    state.doubts[1 - side, 3] = 0  # this hand is where it is said to be
    state.hand_stamps_ns[side] = stamp_ns
    state.hand_ticks[side] = state.tick
    return -1
