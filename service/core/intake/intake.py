"""Hand and arm samples as they come in: checked, mapped to frame `base`, and filtered to a state at
the tick.

What a source tells, against what it told before: stamps, jumps, and a second source that
contradicts it. One rule for both hands and the arm:

* A stamp must be newer than the newest one, and no farther ahead of it than the time since then
  plus the time after which the source is silent. Silence is judged by arrival; after it any stamp
  is taken, but the same again.
* Where a sample cannot come from what was known it has jumped. A hand's jump is believed once
  `CONFIRMED` samples in a row, over `CONFIRMED_S` at least, agree with each other; the arm's never,
  before it was silent: it has a body.
* A hand that comes to where the other one was, which is not seen there any more, has not moved: its
  tracker takes one for the other. That is believed after `hands.swapped_s`, as it may have put
  itself right.
* A source is contested from when a quarter of what it told within about a second had jumped, or of
  a hand went to and fro between two places, until that is less than a tenth; and while a hand's
  samples scatter more than any tracker's, as those of two that are some centimetres apart do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from kmp.compiled import compiled
from service.config import Settings
from service.contract.channels import BY_KEY
from service.contract.messages import BASE, JointState, PoseStamped, WireError, in_order
from service.contract.records import SIDES, SOURCES, Cause, Reason
from service.core.frame import Event, Record, Records, Vector, as_array, parameters
from service.core.geometry import rotation
from service.core.intake.hand_estimator import HandEstimator, has_jumped, is_to_and_fro, take

REPEATED, OLDER, AHEAD = int(Cause.REPEATED), int(Cause.OLDER), int(Cause.AHEAD)
CONFIRMED = 3  # samples in a row that agree
CONFIRMED_S = 0.02  # over so long at least
SWAPPED_M = 0.05  # so near to where the other hand was ...
SWAPPED_MPS = 0.2  # [m/s] ... which may have moved on
AGREE_M = 0.03  # samples of a hand that jumped agree within this ...
AGREE_MPS = 2.0  # [m/s] ... and what a fast hand moves
CONTESTED_SHARE = 0.25  # share of the samples that jumped at which a source is contested
MOST_SHARE = 0.5  # to which samples that went to and fro raise it
SETTLED = 0.1  # share below which it is no more
SCATTERED_M = 0.012  # standard deviation of a hand's samples, each axis, at which it is contested
GATHERED_M = 0.010  # below which it is no more
MEMORY_S = 1.0  # over which the share is averaged
MOST_S = 1 / 30  # that one sample counts, whatever the pause before it
ROUND_TO = 1e9  # of the share: machines that differ in the last bits agree


@compiled
def is_contested(states: Records, already: bool) -> bool:
    """Whether some source is contradicted by another; `already`: it was found so before."""
    share, scatter_m = (SETTLED, GATHERED_M) if already else (CONTESTED_SHARE, SCATTERED_M)
    return bool(states[0].contested.max() > share or states[0].noise_variance.max() > scatter_m**2)


@compiled
def refusal(stamp_ns: int, newest_ns: int, fresh: bool, passed_s: float, silent_s: float) -> int:
    """The cause for which a stamp is refused, or -1; the newest one came `passed_s` ago."""
    if stamp_ns == newest_ns:
        return REPEATED
    if not fresh:
        return -1
    ahead_s = (float(stamp_ns) - float(newest_ns)) * 1e-9  # the difference of integers may overflow
    if ahead_s > passed_s + silent_s:
        return AHEAD
    return OLDER if stamp_ns < newest_ns else -1


@compiled
def note(states: Records, source: int, jumped: bool, period_s: float) -> None:
    """Remembers how much a source is contradicted; of two that take turns, however soon one comes
    after the other, the samples count alike.
    """
    state = states[0]
    ticks, share = state.sample_ticks[source], state.contested[source]
    passed = float(state.tick - ticks[0])
    if ticks[1] < state.tick:
        passed *= 0.5  # since the sample before the last
        ticks[0], ticks[1] = ticks[1], state.tick
    passed_s = min(passed * period_s, MOST_S)
    share += (1.0 - math.exp(-passed_s / MEMORY_S)) * ((1.0 if jumped else 0.0) - share)
    state.contested[source] = np.rint(share * ROUND_TO) / ROUND_TO if share > 1e-6 else 0.0


@compiled
def is_swapped(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """Whether a hand's sample (3,) [m], the first after a silence, is the other hand's, or goes on
    from samples that were.
    """
    state, given = states[0], parameters[0]
    is_swap, seen = state.jump_is_swap[side], state.hand_ticks[side]
    if is_swap and (state.tick - state.jump_first_tick[side]) * given.period_s >= given.swapped_s:
        return False
    if is_swap and _goes_on(states, parameters, side, position):
        return True
    silent = state.tick - seen
    lately = given.stale_ticks <= silent and silent * given.period_s < given.swapped_s
    return bool(seen >= 0 and lately and _is_at_other(states, parameters, side, position))


@compiled
def is_confirmed(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """Whether a hand's sample (3,) [m] that jumped is to be believed, by those just before it."""
    state, given = states[0], parameters[0]
    if state.jump_count[side] == 0 or not _goes_on(states, parameters, side, position):
        state.jump_first_tick[side], state.jump_count[side], state.jump_is_swap[side] = state.tick, 0, 0
    state.jumped_to[side, :] = position
    state.jump_newest_tick[side] = state.tick
    state.jump_count[side] += 1
    first, count = state.jump_first_tick[side], state.jump_count[side]
    unseen = state.hand_ticks[1 - side] < first
    if count > 1 and unseen and _is_at_other(states, parameters, side, position):
        state.jump_is_swap[side] = 1
    enough_s = given.swapped_s if state.jump_is_swap[side] else CONFIRMED_S
    return bool(count >= CONFIRMED and (state.tick - first + 0.5) * given.period_s >= enough_s)


@compiled
def _is_at_other(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """Whether a hand's sample is where the other hand was, and not where this one was."""
    state, given = states[0], parameters[0]
    seen = state.hand_ticks[1 - side]
    here, there = state.hands[side, 0], state.hands[1 - side, 0]
    near = SWAPPED_M + SWAPPED_MPS * min((state.tick - seen) * given.period_s, given.swapped_s)
    return bool(seen >= 0 and _distance(position, there) < min(near, 0.5 * _distance(here, there)))


@compiled
def _goes_on(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """Whether a sample is where a hand can be that was at the newest one that jumped."""
    state, given = states[0], parameters[0]
    passed = state.tick - state.jump_newest_tick[side]
    near = _distance(position, state.jumped_to[side]) <= AGREE_M + AGREE_MPS * passed * given.period_s
    return bool(passed < given.stale_ticks and near)


@compiled
def _distance(a: Vector, b: Vector) -> float:
    square = 0.0
    for axis in range(3):
        square += (a[axis] - b[axis]) ** 2
    return math.sqrt(square)


UNIT_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # of `hands.unit`
NOT_FINITE, NOT_A_ROTATION, OUT_OF_RANGE = int(Cause.NOT_FINITE), int(Cause.NOT_A_ROTATION), int(Cause.OUT_OF_RANGE)
JUMPED, SWAPPED, ARM = int(Cause.JUMPED), int(Cause.SWAPPED), SOURCES.index("arm")
TWO_SOURCES = int(Reason.TWO_SOURCES)
MAX_JOINT_SPEED = 100.0  # [rad/s] beyond it a measured joint is a mistake
JUMP_RAD = 0.2  # [rad] jump gate of a joint ...
JUMP_RADPS = 5.0  # [rad/s] ... for each second without a sample, as by hand an arm is moved so fast ...
JUMP_SPEEDS = 2.0  # ... or as many times its fastest joint's greatest speed, where that is more
FARTHEST_OUTSIDE = 0.2  # [rad] a joint farther outside its limits is a mistake, or to be brought back by hand
STILL_RAD = 0.02  # an arm is at rest that stayed within so much ...
STILL_S = 0.1  # ... for so long
FARTHEST_M = 5.0  # a hand farther from the base plate is a mistake of units
HANDS_KNOWN = 1  # what a step says: both hands are seen
ARM_HEARD = 2  # the arm has reported its joints lately enough
ARM_STILL = 4  # ... and has reported one posture for a while
CONTESTED = 8  # a hand or the arm is reported by two sources


def _stale_ticks(key: str, settings: Settings) -> int:
    """The ticks, at least one, after which a channel's source is silent; rounding of the period
    does not make it one more.
    """
    section, name = BY_KEY[key].stale_after or ("", "")
    duration_ms: float = getattr(getattr(settings, section), name)
    return max(1, math.ceil(round(duration_ms / 1000 / settings.period_s, 6)))


def still_ticks(settings: Settings) -> int:
    """The ticks over which an arm must report one posture before it is believed."""
    return math.ceil(round(STILL_S / settings.period_s, 6))


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
        self.stale_ticks = _stale_ticks("hands/left", settings)
        self._silent_ticks = _stale_ticks("joints/state", settings)
        self._still_ticks = still_ticks(settings)
        self._names, self._frames = settings.joints.names, ("", BASE, hands.frame)
        limits = np.array([settings.joints.lower, settings.joints.upper])
        self._parameters = parameters(
            period_s=settings.period_s,
            stale_ticks=self.stale_ticks,
            silent_ticks=self._silent_ticks,
            still_ticks=self._still_ticks,
            jump=float(hands.jump),
            jump_speed=float(hands.jump_speed),
            swapped_s=float(hands.swapped_s),
            joint_jump_speed=max(JUMP_RADPS, JUMP_SPEEDS * max(settings.joints.velocity)),
            plausible_joints=limits + FARTHEST_OUTSIDE * np.array([[-1.0], [1.0]]),
        )
        origin, axes = np.array(hands.base_from_tracker[:3]), rotation(hands.base_from_tracker[3:])
        self._tracker = np.column_stack((UNIT_M[hands.unit] * axes, origin))
        self._in_base = np.eye(3, 4)
        # a tracker with a frame of its own: what says that it is in base has been mapped already
        self._maps_base = hands.frame in ("", BASE)
        self.rejected = np.zeros((len(SOURCES), len(Cause)), np.int64)
        self.refused: dict[tuple[str, Cause], Refused] = {}
        self._estimator = HandEstimator(hands, settings.period_s)

    def begin(self, state: Record) -> None:
        """Sets in a state of zeros what no sample has reported yet."""
        for field in ("tick", "hand_ticks", "memory_ticks", "arm_tick", "arm_still_tick", "sample_ticks"):
            state[field] = -1
        self._estimator.begin(state)

    def step(self, state: Record, frame: Record, ticks: int, samples: list[Event]) -> int:
        """Moves the state on by some ticks and takes the samples in; the flags HANDS_KNOWN,
        ARM_HEARD, ARM_STILL and CONTESTED.
        """
        self.advance(state, ticks)
        for event in samples:
            if event.kind == "joints/state":
                self.take_arm(state, event.value)
            else:
                self.take_hand(state, SIDES.index(event.kind[6:]), event.value)
        return int(_report(as_array(state), as_array(frame), self._parameters))

    def advance(self, state: Record, ticks: int) -> None:
        """The state moved on by some ticks: fresh hands by their motion, others stand still."""
        state["tick"] += ticks
        self._estimator.advance(state, ticks, self.stale_ticks)

    def take_hand(self, state: Record, side: int, sample: PoseStamped) -> None:
        """One hand's sample filtered in, or counted as rejected."""
        if sample.frame_id not in self._frames:
            state["rejected"][Cause.WRONG_FRAME] += 1
            self._note(state, side, Cause.WRONG_FRAME, sample)
            return
        cause = _take_hand(
            as_array(state),
            self._parameters,
            side,
            sample.stamp_ns,
            sample.position,
            sample.orientation,
            self._tracker if self._maps_base or sample.frame_id != BASE else self._in_base,
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
        cause = _take_arm(as_array(state), self._parameters, sample.stamp_ns, np.array(position), np.array(velocity))
        if cause >= 0:
            self._note(state, ARM, cause, sample)

    def _note(self, state: Record, source: int, cause: int, sample: PoseStamped | JointState) -> None:
        newest_ns = int(state["arm_stamp_ns"] if source == ARM else state["hand_stamps_ns"][source])
        self.refused[SOURCES[source], Cause(cause)] = Refused(Cause(cause), sample, newest_ns)
        self.rejected[source, cause] += 1  # last: who sees it, in another thread, finds the other


@compiled
def _take_arm(states: Records, parameters: Records, stamp_ns: int, position: Vector, velocity: Vector) -> int:
    """`Intake.take_arm`: the cause for which it was rejected, or -1."""
    state, given = states[0], parameters[0]
    passed = state.tick - state.arm_tick
    passed_s, silent_s = passed * given.period_s, given.silent_ticks * given.period_s
    fresh = state.arm_tick >= 0 and passed < given.silent_ticks
    if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
        state.rejected[NOT_FINITE] += 1
        return NOT_FINITE
    near, off, moved = True, 0.0, 0.0
    for i in range(len(position)):
        near = near and given.plausible_joints[0, i] <= position[i] <= given.plausible_joints[1, i]
        near = near and abs(velocity[i]) <= MAX_JOINT_SPEED
        off = max(off, abs(position[i] - state.measured[i]))
        moved = max(moved, abs(position[i] - state.arm_still_posture[i]))
    cause = -1 if near else OUT_OF_RANGE
    if near:
        cause = refusal(stamp_ns, state.arm_stamp_ns, fresh, passed_s, silent_s)
    if near and cause != REPEATED:
        jumped = fresh and off > JUMP_RAD + given.joint_jump_speed * passed_s
        note(states, ARM, jumped, given.period_s)
        if jumped and cause < 0:
            cause = JUMPED
    if near and (moved > STILL_RAD or not fresh):
        state.arm_still_posture[:] = position
        state.arm_still_tick = state.tick
    if cause >= 0:
        state.rejected[cause] += 1
        return cause
    state.measured[:], state.measured_velocities[:] = position, velocity
    state.arm_stamp_ns, state.arm_tick = stamp_ns, state.tick
    return -1


@compiled
def _take_hand(
    states: Records,
    parameters: Records,
    side: int,
    stamp_ns: int,
    position: tuple[float, float, float],
    turn: tuple[float, float, float, float],
    frame: Vector,
) -> int:
    """`Intake.take_hand`, with the tracker's axes and origin (3, 4) in frame base: the cause for
    which it was rejected, or -1.
    """
    state, given, in_base, norm, far = states[0], parameters[0], np.empty(3), 0.0, 0.0
    for k in range(4):
        norm += turn[k] * turn[k]
    for i in range(3):
        in_base[i] = frame[i, 3]
        for k in range(3):
            in_base[i] += frame[i, k] * position[k]
        far += in_base[i] * in_base[i]
    stale_ticks, period_s = given.stale_ticks, given.period_s
    since = state.tick - state.hand_ticks[side]
    fresh = state.hand_ticks[side] >= 0 and since < stale_ticks
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
            jumped = fresh and has_jumped(states, parameters, side, in_base, since * period_s)
            doubtful = state.contested[side] < MOST_SHARE  # no more is needed, and it would settle late
            twofold = fresh and doubtful and is_to_and_fro(states, side, in_base, since * period_s)
            note(states, side, jumped or twofold, period_s)
            jumped = jumped or is_swapped(states, parameters, side, in_base)
        if cause < 0 and jumped and not is_confirmed(states, parameters, side, in_base):
            cause = SWAPPED if state.jump_is_swap[side] else JUMPED
    if cause >= 0:
        state.rejected[cause] += 1
        return cause
    take(states, side, in_base, turn, frame, since * period_s, jumped or not fresh)
    state.jump_count[side] = state.jump_is_swap[side] = 0
    state.jump_is_swap[1 - side] = 0  # this hand is where it is reported to be
    state.hand_stamps_ns[side] = stamp_ns
    state.hand_ticks[side] = state.tick
    return -1


@compiled
def _report(states: Records, frames: Records, parameters: Records) -> int:
    """Into the frame what is known of the hands; flags of what is."""
    frame, state, given = frames[0], states[0], parameters[0]
    left, right = state.hand_ticks[0], state.hand_ticks[1]
    if left == right:
        frame.hand_stamp_ns = max(state.hand_stamps_ns[0], state.hand_stamps_ns[1])
    else:
        frame.hand_stamp_ns = state.hand_stamps_ns[0 if left > right else 1]
    for side in range(2):
        seen = state.hand_ticks[side]
        frame.hand_ages[side] = -1 if seen < 0 else state.tick - seen
        frame.hands[side], frame.hand_velocities[side] = state.hands[side, 0], state.hands[side, 1]
    frame.tick = state.tick
    frame.rejected[:] = state.rejected
    known = HANDS_KNOWN if frame.hand_ages.min() >= 0 and frame.hand_ages.max() < given.stale_ticks else 0
    if state.arm_tick >= 0 and state.tick - state.arm_tick < given.silent_ticks:
        known |= ARM_HEARD
        if state.tick - state.arm_still_tick >= given.still_ticks:
            known |= ARM_STILL
    contested = is_contested(states, state.reason == TWO_SOURCES)
    return known | CONTESTED if contested else known
