"""Clock of a task, or of each of its segments: how long ago the hands began it.

The clock t [s] starts when a hand first moves faster than CLOCK_START_MPS after rest. Over the time
t' [s] it advances at a rate r, which follows its goal g with the time constant CLOCK_LAG_S:

    dt/dt' = r,   dr/dt' = (g - r) / CLOCK_LAG_S

* A clock that was REQUESTED starts by a request alone: t = r = 0 then, and g = 1 from there to
  `longest_s`. Of what follows, nothing applies to it.
* g = 1 for a clock that runs. g = 1 - s for a clock that waits, with the stillness s of the hand
  that is less still.
* g = 0 once t has reached `longest_s`, the end of the longest demonstration.
* g = 0 once the hands have rested for `rest_s`, longer than in any demonstration. If the task may
  be over then (t at least `over_s`), the next motion starts the clock anew. Otherwise the user has
  paused, and the clock continues.
* t = r = 0 once the hands have rested for `home_s` where demonstrations begin, or have come back to
  where they rested before they began, longer than in any demonstration there. The task begins
  again: the memory of the hands is that of hands that have always been there, no segment is known,
  and the next motion starts the clock.
* If the task has segments, the clock starts anew in each. When the most probable segment changes,
  or after a rest of `rest_s` where the segment begins, the clock is set to 0, and starts with the
  next motion.

So the clock is continuous within a segment, and constant where nothing was demonstrated.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kmp.compiled import compiled
from kmp.elementary import exp
from thirdhand.core.frame import Records, Vector
from thirdhand.core.numerics import MEMORY_STEP_S
from thirdhand.core.skill import MAX_SKILL_DISTANCE_M
from thirdhand.core.skill.tuning import (
    CLOCK_LAG_S,
    CLOCK_START_MPS,
    MEMORY_LONGEST_STEP_S,
    OWN_NEAR_M,
)
from thirdhand.core.vectors import norm, squared_distance

# entries of `task_clock` in the state
CLOCK_S, CLOCK_RATE, CLOCK_CHANGE, REST_LEFT_S, CLOCK_SEGMENT, PROGRESS, OWN_BEGIN = range(7)
CLOCK_SIZE = OWN_BEGIN + 6  # their number
BEGUN_TICK = CLOCK_SEGMENT  # of a requested clock, which knows no segments: when it was
# values of `TaskClock.pace`: the clock runs on while the hands rest, waits for them, or is started
# by a request
RUNS = 0
WAITS = 1
REQUESTED = 2
# values of PROGRESS: hands that rest, that moved, that left where they began; a request is GONE
NOT_BEGUN = 0.0
NEAR_BEGIN = 1.0
GONE = 2.0
# entries of `TaskClock.numbers`
PACE_AT = 0
LONGEST_AT = 2
OVER_AT = 3
REST_AT = 4
HOME_AT = 5
NEAR_AT = 6
BEGIN_AT = 7
# limits of what a file may hold
LONGEST_CLOCK_S = 3600.0
MOST_CLOCK_WEIGHT = 100.0


class TaskClock(NamedTuple):
    """Parameters of the clock of a skill."""

    pace: int  # RUNS, WAITS or REQUESTED
    # As an input, a second counts as this length [m], with segments as this share of a path. With
    # 0, the clock is no input, and only shows when a task begins again.
    weight: float
    longest_s: float  # the clock stops at this time
    over_s: float  # from this time on the task may be over
    rest_s: float  # a longer rest ends the task, or is a pause
    home_s: float  # at most `rest_s`: after a longer rest near a begin the task begins again
    near_m: float  # hands within this distance of `begin` are where demonstrations begin
    begin: tuple[float, ...]  # (6,) [m] mean hands at the begin of the demonstrations

    @property
    def numbers(self) -> Vector:
        """The parameters (13,) as one array, as compiled functions and a skill's file have them."""
        return np.array([*self[:-1], *self.begin], np.float64)

    def rows(self, begins: Vector) -> Vector:
        """The parameters (K, 13) in each of K segments that begin with the hands `begins` (K, 6)
        [m].
        """
        out = np.tile(self.numbers, (len(begins), 1))
        out[:, BEGIN_AT:] = begins
        return out

    @staticmethod
    def of(numbers: Iterable[float]) -> TaskClock:
        """The clock with these `numbers`. Raises ValueError if they are no clock's."""
        values = [float(number) for number in numbers]
        if len(values) != BEGIN_AT + 6:
            raise ValueError(f"task_clock has {len(values)} numbers, {BEGIN_AT + 6} needed")
        pace, weight, longest_s, over_s, rest_s, home_s, near_m = values[:BEGIN_AT]
        largest = (
            REQUESTED,
            MOST_CLOCK_WEIGHT,
            *4 * [LONGEST_CLOCK_S],
            *7 * [MAX_SKILL_DISTANCE_M],
        )
        is_in_range = all(abs(value) <= most for value, most in zip(values, largest, strict=True))
        if not is_in_range or min(values[:BEGIN_AT]) < 0.0 or pace % 1.0:
            raise ValueError(
                f"task_clock is {values}: numbers from 0 to {largest[:BEGIN_AT]} and a begin [m] "
                "needed"
            )
        return TaskClock(
            int(pace), weight, longest_s, over_s, rest_s, home_s, near_m, tuple(values[BEGIN_AT:])
        )


def is_requested(clock: TaskClock | None) -> bool:
    """True if there is a clock that only a request starts."""
    return clock is not None and clock.pace == REQUESTED


@compiled
def _are_near(hands: Vector, begin: Vector, near_m: float) -> bool:
    """True if both hands (6,) [m] are within `near_m` [m] of their positions `begin` (6,) [m]."""
    for side in range(2):
        part = slice(3 * side, 3 * side + 3)
        if squared_distance(hands[part], begin[part]) > near_m**2:
            return False
    return True


@compiled
def _have_returned(hands: Vector, numbers: Vector, clock: Vector) -> bool:
    """True if the hands (6,) [m] are where demonstrations begin, or again where they began."""
    if _are_near(hands, numbers[BEGIN_AT:], numbers[NEAR_AT]):
        return True
    return clock[PROGRESS] == GONE and _are_near(
        hands, clock[OWN_BEGIN:], min(numbers[NEAR_AT], OWN_NEAR_M)
    )


@compiled
def count(
    hands: Vector,
    speed: float,
    still: float,
    period_s: float,
    segment: int,
    rows: Vector,
    clock: Vector,
) -> bool:
    """Advance a clock (12,) by the time `period_s` [s]; see the equations of this module. The
    faster one of the hands (6,) [m] has the speed `speed` [m/s], the less still one the stillness
    `still`. Returns true if the task begins again.

    `clock` holds t [s], r, dr/dt' [1/s], the time [s] for which the hands may continue to rest, the
    segment, the progress (NOT_BEGUN, NEAR_BEGIN or GONE), and where (6,) [m] these hands rested
    before they began. `rows` (K, 13) are `TaskClock.numbers` of each segment; a task without
    segments has one row.
    """
    numbers = rows[segment]
    begins_again = False
    goal = 0.0
    if numbers[PACE_AT] == REQUESTED:
        if clock[PROGRESS] == GONE and clock[CLOCK_S] < numbers[LONGEST_AT]:
            goal = 1.0
    else:
        begins_again = _follow(hands, speed, period_s, segment, still, rows, clock)
        if clock[REST_LEFT_S] > 0.0 and clock[CLOCK_S] < numbers[LONGEST_AT]:
            goal = 1.0 - still if numbers[PACE_AT] == WAITS else 1.0
    clock[CLOCK_RATE] += (1.0 - exp(-period_s / CLOCK_LAG_S)) * (goal - clock[CLOCK_RATE])
    clock[CLOCK_S] += period_s * clock[CLOCK_RATE]
    if numbers[PACE_AT] == REQUESTED:  # after hands that were not seen for long
        clock[CLOCK_S] = min(clock[CLOCK_S], numbers[LONGEST_AT] + CLOCK_LAG_S)
    clock[CLOCK_CHANGE] = (goal - clock[CLOCK_RATE]) / CLOCK_LAG_S
    return begins_again


@compiled
def _follow(
    hands: Vector,
    speed: float,
    period_s: float,
    segment: int,
    still: float,
    rows: Vector,
    clock: Vector,
) -> bool:
    """Start and end a clock by the hands, see `count`; true if the task begins again."""
    numbers = rows[segment]
    begins_again = False
    if clock[CLOCK_SEGMENT] != segment:
        clock[:CLOCK_SEGMENT] = 0.0
        clock[CLOCK_SEGMENT] = segment

    if clock[PROGRESS] == NOT_BEGUN and still > 0.5:
        clock[OWN_BEGIN:] = hands
    if speed > CLOCK_START_MPS:
        if clock[PROGRESS] == NOT_BEGUN:
            clock[PROGRESS] = NEAR_BEGIN
        elif not _are_near(hands, clock[OWN_BEGIN:], OWN_NEAR_M):
            clock[PROGRESS] = GONE
        if clock[REST_LEFT_S] <= 0.0 and clock[CLOCK_S] >= numbers[OVER_AT]:
            clock[CLOCK_S] = clock[CLOCK_RATE] = 0.0
        clock[REST_LEFT_S] = numbers[REST_AT]
    else:
        before_s = clock[REST_LEFT_S]
        clock[REST_LEFT_S] = max(before_s - period_s, 0.0)
        has_rested = clock[REST_LEFT_S] <= numbers[REST_AT] - numbers[HOME_AT]
        if before_s > 0.0 and has_rested and _have_returned(hands, rows[0], clock):
            begins_again = True
            clock[:CLOCK_SEGMENT] = 0.0
            clock[PROGRESS] = NOT_BEGUN
        elif (
            before_s > 0.0
            and clock[REST_LEFT_S] == 0.0
            and _are_near(hands, numbers[BEGIN_AT:], numbers[NEAR_AT])
        ):
            clock[CLOCK_S] = clock[CLOCK_RATE] = 0.0
    return begins_again


@compiled
def move(states: Records, sides: NDArray[np.int64], period_s: float, rows: Vector) -> None:
    """Advance the clock in the state to this tick by `count`, in the most probable segment; memory
    and belief end where the task begins again. The speeds are those of the hands `sides` (2,)
    without their tremor. While a hand is not seen, at most MEMORY_LONGEST_STEP_S is counted, unless
    the clock is REQUESTED.
    """
    state = states[0]
    before = state.memory_ticks.max()
    starts_on_request = rows[0, PACE_AT] == REQUESTED
    if starts_on_request:
        before = max(before, int(state.task_clock[BEGUN_TICK]))
    passed_s = period_s if before < 0 else (state.tick - before) * period_s
    if not starts_on_request:
        passed_s = min(passed_s, MEMORY_LONGEST_STEP_S)

    hands = np.empty(6)
    speed = 0.0
    still = 1.0
    segment = state.segment_belief[: len(rows)].argmax()
    for i in range(2):
        hands[3 * i : 3 * i + 3] = state.hands[sides[i], 0]
        speed = max(speed, norm(state.hand_velocity_lowpass[sides[i]]))
        still = min(still, state.hand_stillness[sides[i]])
    if count(hands, speed, still, passed_s, segment, rows, state.task_clock):
        forget(states)


@compiled
def forget(states: Records) -> None:
    """End the memory of the hands and the belief: the task begins again."""
    states[0].memory_ticks[:] = -1
    states[0].segment_belief[:] = 0.0
    states[0].unprimed_belief[:] = 0.0


@compiled
def _counted(
    moving: Vector,
    segments: NDArray[np.int64],
    period_s: float,
    steps: int,
    ahead: int,
    rows: Vector,
    out: Vector,
) -> None:
    """Compiled part of `counted`; `moving` (T, 8) are hands, speed and stillness, and a clock that
    was REQUESTED started `ahead` steps before them.
    """
    clock = np.zeros(CLOCK_SIZE)
    if rows[0, PACE_AT] == REQUESTED:
        clock[PROGRESS] = GONE
        for _ in range(ahead):
            count(moving[0, :6], 0.0, 1.0, period_s / steps, 0, rows, clock)
    for t in range(len(moving)):
        for step in range(steps if t else 0):
            now = moving[t - 1] + (step + 1) / steps * (moving[t] - moving[t - 1])
            count(now[:6], now[6], now[7], period_s / steps, segments[t], rows, clock)
        out[t] = clock[CLOCK_S]


def counted(
    hands: Vector,
    speeds: Vector,
    stillness: Vector,
    period_s: float,
    rows: Vector,
    segments: NDArray[np.int64] | None = None,
    begun_s: float = 0.0,
) -> Vector:
    """The clock (T,) [s] along hands (T, 6) [m], in the `segments` (T,). `speeds` (T,) [m/s] are
    those of the faster hand, `stillness` (T,) is that of the less still one. `rows` are those of
    `count`. A clock that was REQUESTED started `begun_s` [s] before the first sample.
    """
    out = np.empty(len(hands))
    steps = max(1, math.ceil(period_s / MEMORY_STEP_S))
    if segments is None:
        segments = np.zeros(len(hands), np.int64)
    moving = np.column_stack([hands, speeds, stillness])
    ahead = round(begun_s * steps / period_s)
    _counted(moving, segments, period_s, steps, ahead, rows, out)
    return out
