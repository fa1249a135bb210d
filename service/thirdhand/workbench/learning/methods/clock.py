"""Clock of a task along demonstrations, as the core would count it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from thirdhand.contract.messages import BASE, PoseStamped
from thirdhand.core.frame import Records, Vector, blank, state_layout
from thirdhand.core.intake.stage import Intake
from thirdhand.core.skill.task_clock import LONGEST_CLOCK_S, REQUESTED, WAITS, TaskClock, counted
from thirdhand.core.skill.tuning import CLOCK_START_MPS, LEAST_PATH_M, OWN_NEAR_M
from thirdhand.settings.config import Settings
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.regions import blocks_of

LONGER = 1.5  # the hands may rest this many times as long as in any demonstration
LEAST_REST_S = 1.0  # a shorter rest is no pause
LEAST_HOME_S = 0.25  # a shorter rest where demonstrations begin may be a hesitation
# on this share of the way to the end, or to another segment's begin, hands are not at the begin
HALF_WAY = 0.5
# hands within this distance of where demonstrations begin have returned there
LEAST_NEAR_M = 2.0 * OWN_NEAR_M
# so have those within this multiple of the largest distance of their begins from the mean
NEAR_TIMES = 2.0
MOST_TEMPO_HZ = 125.0  # samples beyond this rate are left out: the intake takes as long for each
LEAST_PAIRS = 3  # with fewer blocks, too few takes remain to learn from
FIRST_STAMP_NS = 1_000_000_000


class Tempo(NamedTuple):
    """Hands (T, 6) [m], their speeds (T, 2) [m/s] without tremor, and their stillness (T, 2) along
    a demonstration, as the core's intake estimates them.
    """

    hands: Vector
    speeds: Vector
    stillness: Vector
    period_s: float
    begun_s: float | None = None  # since a request, see `Demonstration`

    @classmethod
    def of(cls, demonstration: Demonstration) -> Self:
        """The tempo of a demonstration, sample by sample."""
        step = max(1, math.floor(1.0 / (MOST_TEMPO_HZ * demonstration.period_s)))
        settings = Settings()
        intake = Intake(settings)
        state = blank(state_layout(len(settings.joints.names)))
        intake.begin(state)
        state["tick"] = 0
        ticked = 0
        samples = []
        since_ns = demonstration.stamps_ns - demonstration.stamps_ns[0] + FIRST_STAMP_NS
        left = demonstration.left[::step].tolist()
        right = demonstration.right[::step].tolist()
        for stamp_ns, *poses in zip(since_ns[::step].tolist(), left, right, strict=True):
            tick = round((stamp_ns - FIRST_STAMP_NS) * 1e-9 / settings.period_s)
            intake.advance(state, tick - ticked)
            ticked = tick
            for side, row in enumerate(poses):
                intake.take_hand(
                    state, side, PoseStamped(stamp_ns, BASE, tuple(row[:3]), tuple(row[3:]))
                )
            samples.append(
                np.hstack(
                    [
                        np.linalg.norm(state["hand_velocity_lowpass"], axis=1),
                        state["hand_stillness"],
                    ]
                )
            )
        times_s = demonstration.seconds
        sampled_s = (since_ns[::step] - FIRST_STAMP_NS) * 1e-9
        columns = np.stack(
            [np.interp(times_s, sampled_s, column) for column in np.array(samples).T], axis=1
        )
        return cls(
            demonstration.hands,
            columns[:, :2],
            columns[:, 2:],
            demonstration.period_s,
            demonstration.begun_s,
        )

    def seconds(self, clock: TaskClock, alone: int | None) -> Vector:
        """The clock (T,) [s]; `alone` is the side of the only hand that matters."""
        hands = self.hands
        sides = slice(None) if alone is None else [alone]
        if alone is not None:
            hands = np.tile(hands[:, 3 * alone :][:, :3], 2)
        return counted(
            hands,
            self.speeds[:, sides].max(axis=1),
            self.stillness[:, sides].min(axis=1),
            self.period_s,
            clock.numbers[None],
            begun_s=self.begun_s or 0.0,
        )

    def in_segments(self, rows: Vector, segments: NDArray[np.int64]) -> Vector:
        """The clock (T,) [s] in these segments (T,), with the parameters `rows` of the clock."""
        return counted(
            self.hands,
            self.speeds.max(axis=1),
            self.stillness.min(axis=1),
            self.period_s,
            rows,
            segments,
        )

    def rested_s(self, alone: int | None) -> Vector:
        """Times (T,) [s] since the hands moved; 0 before their first motion."""
        sides = slice(None) if alone is None else [alone]
        is_moving = self.speeds[:, sides].max(axis=1) > CLOCK_START_MPS
        samples = np.arange(len(is_moving))
        latest_motion = np.maximum.accumulate(np.where(is_moving, samples, -1))
        return np.where(latest_motion < 0, 0, samples - latest_motion) * self.period_s

    def has_returned(self, begin: Vector, near_m: float, alone: int | None) -> NDArray[np.bool_]:
        """True (T,) where the hands that matter are within `near_m` of `begin` (6,) [m], or again
        where they were at first.
        """
        is_at_begin, is_at_own = (
            self._are_near(hands, radius_m, alone)
            for hands, radius_m in ((begin, near_m), (self.hands[0], min(near_m, OWN_NEAR_M)))
        )
        return is_at_begin | (is_at_own & np.maximum.accumulate(~is_at_own))

    def _are_near(self, place: Vector, radius_m: float, alone: int | None) -> NDArray[np.bool_]:
        distances_m = np.linalg.norm((self.hands - place).reshape(-1, 2, 3), axis=2)
        return np.asarray(
            (distances_m[:, slice(None) if alone is None else [alone]] <= radius_m).all(axis=1)
        )


def clock_of(tempos: Sequence[Tempo], alone: int | None, *, pace: int) -> TaskClock:
    """The clock of demonstrations with these tempos, with a weight of 1 m/s."""
    begins, ends = (
        np.array([_conducting(tempo.hands[row], alone) for tempo in tempos]) for row in (0, -1)
    )
    begin = begins.mean(axis=0)
    off_m = float(np.linalg.norm((begins - begin).reshape(-1, 2, 3), axis=2).max())
    ends_m = np.linalg.norm((ends - begin).reshape(-1, 2, 3), axis=2).max(axis=1)
    near_m = max(LEAST_NEAR_M, min(NEAR_TIMES * off_m, HALF_WAY * float(np.median(ends_m))))
    free = _endless(tempos, [begin] * len(tempos), near_m, alone, pace=pace)._replace(
        begin=tuple(begin.tolist())
    )
    ends_s = [float(tempo.seconds(free, alone)[-1]) for tempo in tempos]
    return free._replace(longest_s=max(ends_s), over_s=min(ends_s))


def _conducting(hands: Vector, alone: int | None) -> Vector:
    """Hands (6,) [m]; the one that matters alone, twice."""
    return hands if alone is None else np.tile(hands[3 * alone :][:3], 2)


def _endless(
    tempos: Sequence[Tempo],
    begins: Sequence[Vector],
    near_m: float,
    alone: int | None,
    *,
    pace: int,
) -> TaskClock:
    """A clock that does not stop by itself, whose rests are longer than those of demonstrations
    that begin with these hands (6,) [m].
    """
    rested_s = [tempo.rested_s(alone) for tempo in tempos]
    is_home = [
        tempo.has_returned(begin, near_m, alone)
        for tempo, begin in zip(tempos, begins, strict=True)
    ]
    rest_s = LONGER * max(float(times_s.max()) for times_s in rested_s)
    home_s = LONGER * max(
        float(times_s[inside].max(initial=0.0))
        for times_s, inside in zip(rested_s, is_home, strict=True)
    )
    rest_s = max(rest_s, LEAST_REST_S)
    home_s = max(home_s, LEAST_HOME_S)
    return TaskClock(
        pace, 1.0, LONGEST_CLOCK_S, LONGEST_CLOCK_S, rest_s, home_s, near_m, (0.0,) * 6
    )


def segment_clock_of(
    tempos: Sequence[Tempo],
    placed: Sequence[Records],
    labels: Sequence[NDArray[np.int64]],
    *,
    pace: int,
) -> TaskClock:
    """The clock of the segments (K,) of demonstrations with these tempos and labels (T,), with a
    weight of 1. Only where a segment begins does a rest start it anew.
    """
    begins = [begins_of(segments) for segments in placed]
    near_m = min(LEAST_NEAR_M, *(HALF_WAY * _nearest_m(hands) for hands in begins))
    free = _endless(tempos, [hands[0] for hands in begins], near_m, None, pace=pace)
    ends_s = [
        float(tempo.in_segments(free.rows(hands), label).max())
        for tempo, hands, label in zip(tempos, begins, labels, strict=True)
    ]
    return free._replace(longest_s=max(ends_s))


def begins_of(segments: Records) -> Vector:
    """The hands (K, 6) [m] with which each of K segments begins."""
    return np.asarray(segments["begins"].reshape(-1, 6))


def _nearest_m(begins: Vector) -> float:
    """The distance [m] of the hand that moves farther, from where the task begins (K, 6) to the
    nearest begin of another segment at which the hands are elsewhere.
    """
    distances_m = np.linalg.norm((begins[1:] - begins[0]).reshape(-1, 2, 3), axis=2).max(axis=1)
    return float(distances_m[distances_m > LEAST_PATH_M].min(initial=math.inf))


def paired(persons: NDArray[np.intp]) -> NDArray[np.intp]:
    """The numbers (H,) of blocks of at least two takes that follow each other, by the takes'
    persons (H,). Such takes are often of one person, whose pace others need not have. All are 0 if
    there would be fewer than LEAST_PAIRS blocks.
    """
    in_time = {person: number for number, person in enumerate(dict.fromkeys(persons.tolist()))}
    numbers = np.array([in_time[person] for person in persons.tolist()], np.intp)
    out = np.zeros_like(persons)
    blocks = blocks_of(numbers, len(persons) // 2)
    for number, block in enumerate(blocks if len(blocks) >= LEAST_PAIRS else ()):
        out[block] = number
    return out


def remark_on(clock: TaskClock) -> str:
    """The remark on a skill that has a clock."""
    if clock.pace == REQUESTED:
        return (
            "the tool follows a timetable: a clock, which `thirdhand begin` starts, predicts it "
            f"better. It stops after {clock.longest_s:.1f} s"
        )
    rests = "waits while the hands rest" if clock.pace == WAITS else "runs on while the hands rest"
    return (
        "the tool partly follows a timetable: a clock, which starts when a hand moves faster than "
        f"{CLOCK_START_MPS} m/s, predicts it better. It {rests}, and stops after "
        f"{clock.longest_s:.1f} s"
    )
