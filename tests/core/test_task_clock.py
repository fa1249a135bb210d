"""The clock of a task: it starts, waits, ends and restarts; learning and the live service count
alike; `learn` uses the clock for timetables only; and no memory of a skill outlasts a round of a
session.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from support.kinds import KINDS, learned, named, takes
from support.skills import at_rest, figures_of
from thirdhand.core.skill import task_clock
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.core.skill.segmented import SegmentedKMP
from thirdhand.core.skill.skill import Prediction
from thirdhand.core.skill.task_clock import (
    CLOCK_CHANGE,
    CLOCK_RATE,
    CLOCK_S,
    CLOCK_SIZE,
    REST_LEFT_S,
    TaskClock,
    count,
    counted,
)
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import StoredSkill, decoded
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.lab.people.left_out import judged, left_out, predicted_rounds

RUNS = TaskClock(task_clock.RUNS, 1.0, 5.0, 4.0, 2.0, 0.3, 0.1, (0.5, 0.2, 0.1, 0.5, -0.2, 0.1))
WAITS = RUNS._replace(pace=task_clock.WAITS)
REQUESTED = RUNS._replace(pace=task_clock.REQUESTED)
HOME = np.array(RUNS.begin)
AWAY = np.array(RUNS.begin) + 0.5
OWN = HOME + 0.3  # a person's start away from that of the demonstrations
PERIOD_S = 0.01


def along(
    clock: TaskClock, *parts: tuple[str, float, np.ndarray], period_s: float = PERIOD_S
) -> np.ndarray:
    """The clock (T, CLOCK_SIZE) while the hands move or rest at these positions for these times."""
    state = np.zeros(CLOCK_SIZE)
    out = []
    for activity, lasts_s, hands in parts:
        for _ in range(round(lasts_s / period_s)):
            moves = activity == "move"
            count(hands, 0.3 * moves, 1.0 - moves, period_s, 0, clock.numbers[None], state)
            out.append(state.copy())
    return np.array(out)


@pytest.mark.parametrize(
    ("clock", "parts", "seconds"),
    [
        (RUNS, [("rest", 3.0, HOME), ("move", 1.0, AWAY)], 0.9),
        (RUNS, [("move", 1.0, AWAY), ("rest", 1.0, AWAY), ("move", 1.0, AWAY)], 2.9),
        (WAITS, [("move", 1.0, AWAY), ("rest", 1.0, AWAY), ("move", 1.0, AWAY)], 1.9),
        (RUNS, [("move", 20.0, AWAY)], 5.1),  # it ends with the longest demonstration
        (RUNS, [("move", 1.0, AWAY), ("rest", 60.0, AWAY), ("move", 1.0, AWAY)], 3.9),
        (RUNS, [("move", 1.0, AWAY), ("rest", 0.5, HOME)], 0.0),  # a rest at the start resets it
        # the rest is too short to reset the clock
        (RUNS, [("move", 1.0, AWAY), ("rest", 0.2, HOME), ("move", 1.0, AWAY)], 2.1),
        # the rest is not where demonstrations begin
        (RUNS, [("move", 20.0, AWAY), ("rest", 60.0, HOME + 0.2)], 5.1),
        # the rest is where this person began
        (RUNS, [("rest", 0.5, OWN), ("move", 1.0, AWAY), ("rest", 0.5, OWN + 0.02)], 0.0),
        (RUNS, [("rest", 0.5, OWN), ("move", 1.0, AWAY), ("rest", 0.5, AWAY + 0.2)], 1.4),
        # a pause before leaving
        (RUNS, [("rest", 0.5, OWN), ("move", 1.0, OWN), ("rest", 0.5, OWN)], 1.4),
        # the hands were in motion when first seen
        (RUNS, [("move", 1.0, OWN), ("move", 1.0, AWAY), ("rest", 0.5, OWN)], 2.4),
        # the task was over
        (RUNS, [("move", 4.5, AWAY), ("rest", 60.0, AWAY), ("move", 1.0, AWAY)], 0.9),
        # the task was over, but the rest is too short
        (RUNS, [("move", 4.5, AWAY), ("rest", 1.0, AWAY), ("move", 1.0, AWAY)], 5.1),
    ],
)
def test_clock_counts_from_first_motion(
    clock: TaskClock, parts: list[tuple[str, float, np.ndarray]], seconds: float
) -> None:
    assert along(clock, *parts)[-1, CLOCK_S] == pytest.approx(seconds, abs=0.06)


@pytest.mark.parametrize("clock", [RUNS, WAITS])
def test_rate_and_change_are_derivatives(clock: TaskClock) -> None:
    """Rate and change of a clock equal finite differences."""
    series = along(
        clock, ("move", 1.0, AWAY), ("rest", 0.5, AWAY), ("move", 1.0, AWAY), period_s=1e-3
    )
    assert np.abs(np.diff(series[:, CLOCK_S]) / 1e-3 - series[1:, CLOCK_RATE]).max() < 1e-9
    assert (
        np.quantile(np.abs(np.diff(series[:, CLOCK_RATE]) / 1e-3 - series[:-1, CLOCK_CHANGE]), 0.99)
        < 0.1
    )
    assert series[:, REST_LEFT_S].min() >= 0.0


@pytest.mark.parametrize("rate_hz", [24, 100, 500])
def test_learned_clock_is_the_live_one(rate_hz: int) -> None:
    """The clock counts the same at any rate."""
    times = np.arange(0.0, 4.0, 1.0 / rate_hz)
    speeds = np.where(times > 1.0, 0.3, 0.0)
    stillness = np.where(times > 1.0, 0.0, 1.0)
    expected_s = counted(
        np.tile(AWAY, (len(times), 1)), speeds, stillness, 1.0 / rate_hz, RUNS.numbers[None]
    )
    live = along(RUNS, ("rest", 1.0, AWAY), ("move", 3.0, AWAY), period_s=0.002)[:, CLOCK_S]
    assert np.abs(np.interp(times, np.arange(len(live)) * 0.002, live) - expected_s).max() < 0.05


def test_task_begins_again_once_in_a_rest() -> None:
    """The task restarts once in each rest at its start."""
    rows = RUNS.rows(np.stack([HOME, AWAY]))
    state = np.zeros(CLOCK_SIZE)
    begun = []
    for speed, hands, segment in (
        [(0.3, AWAY, 1)] * 50 + [(0.0, HOME, 1)] * 300 + [(0.0, AWAY, 1)] * 300
    ):
        begun.append(count(hands, speed, 0.0, PERIOD_S, segment, rows, state))
    assert np.flatnonzero(begun).tolist() == pytest.approx([50 + RUNS.home_s / PERIOD_S], abs=1)
    for speed, hands in [(0.3, AWAY)] * 50 + [
        (0.0, AWAY)
    ] * 300:  # the segment restarts, the task does not
        assert not count(hands, speed, 0.0, PERIOD_S, 1, rows, state)
    assert state[CLOCK_S] == 0.0


def test_own_begin_is_kept_through_segments() -> None:
    rows = RUNS.rows(np.stack([HOME, HOME + 1.0]))
    state = np.zeros(CLOCK_SIZE)
    begun = [
        count(hands, speed, float(speed == 0.0), PERIOD_S, segment, rows, state)
        for speed, hands, segment, ticks in [
            (0.0, OWN, 0, 50),
            (0.3, AWAY, 0, 50),
            (0.3, AWAY, 1, 50),
            (0.0, OWN, 1, 50),
        ]
        for _ in range(ticks)
    ]
    assert np.flatnonzero(begun).tolist() == pytest.approx([150 + RUNS.home_s / PERIOD_S], abs=1)


def test_numbers_of_no_clock_are_refused() -> None:
    for good in (RUNS, WAITS, REQUESTED):
        assert TaskClock.of(good.numbers) == good
    half = RUNS.numbers + 0.5
    for bad in (half, RUNS.numbers[:-1], -RUNS.numbers, np.full(13, np.nan), np.full(13, 1e9)):
        with pytest.raises(ValueError, match="task_clock"):
            TaskClock.of(bad)


def clock(skill: StoredSkill) -> TaskClock | None:
    """The clock among the inputs of a skill's model; None without a clock."""
    assert isinstance(skill.model, HandsKMP | SegmentedKMP)
    return skill.model.clock if skill.model.is_timed else None


@pytest.mark.parametrize(
    ("kind_of_takes", "says", "late_s", "error_mm"),
    [(takes, "timetable", 6.0, 30.0), (named, "anew in each segment", 7.0, 20.0)],
    ids=["one clock", "in each segment"],
)
@pytest.mark.thorough
def test_learn_takes_a_clock_for_a_timetable(
    kind_of_takes: Callable[..., list[Demonstration]], says: str, late_s: float, error_mm: float
) -> None:
    """`learn` uses a clock for a timetable, and for no other task."""
    demonstrations = kind_of_takes(6, timetable=True)
    skill = learn(demonstrations)
    figures = figures_of(skill)
    back = decoded(skill.file, origin="again")
    learned_clock = clock(skill)
    assert learned_clock is not None
    assert learned_clock.pace == task_clock.RUNS
    assert clock(back) == learned_clock
    assert clock(learn(kind_of_takes(8, timetable=False))) is None
    assert figures.taken.endswith("and a clock")
    assert figures.tried_mm[figures.taken] < 0.5 * figures.tried_mm["positions"]
    assert figures.all.error_mm < 30.0
    assert any(says in text for text in figures.warnings)

    def at(one: StoredSkill, clock_s: float) -> Prediction:
        return at_rest(one, demonstrations[0].hands[-1], clock=np.array([clock_s, 1.0, 0.0]))

    late = at(skill, late_s)
    np.testing.assert_array_equal(late.position, at(back, late_s).position)
    assert 1000.0 * np.linalg.norm(late.position - demonstrations[0].tool[-1, :3]) < error_mm
    assert np.linalg.norm(late.position - at(skill, 3.0).position) > 0.2
    behind, moving, ahead = (at(skill, 4.8 + step_s) for step_s in (-0.02, 0.0, 0.02))
    np.testing.assert_allclose(
        moving.velocity, (ahead.position - behind.position) / 0.04, atol=2e-3
    )


def test_a_request_alone_starts_a_requested_clock() -> None:
    """Motion starts none, a rest at the begin ends none, and it counts from before the first sample
    of a take.
    """
    parts = [("move", 1.0, AWAY), ("rest", 3.0, HOME), ("move", 1.0, AWAY)]
    assert not along(REQUESTED, *parts)[:, CLOCK_S].any()
    counts = {
        begun_s: counted(
            np.tile(HOME, (400, 1)),
            np.zeros(400),
            np.ones(400),
            PERIOD_S,
            REQUESTED.numbers[None],
            begun_s=begun_s,
        )
        for begun_s in (0.0, 1.5)
    }
    assert counts[0.0][-1] == pytest.approx(3.9, abs=0.02)
    assert counts[1.5][0] == pytest.approx(1.4, abs=0.02)
    assert counts[1.5][-1] == pytest.approx(5.1, abs=0.06)  # the longest demonstration


def test_a_requested_clock_ends_with_the_longest_take() -> None:
    """Also after hands that were unseen for long, in one step."""
    state = np.zeros(CLOCK_SIZE)
    state[task_clock.PROGRESS] = task_clock.GONE
    count(HOME, 0.0, 1.0, 25.0, 0, REQUESTED.numbers[None], state)
    assert state[CLOCK_S] == pytest.approx(REQUESTED.longest_s, abs=0.11)


def requested_takes() -> list[Demonstration]:
    """Takes of a timetable that the teacher's request begins, up to 3 s before the hands move."""
    random = np.random.default_rng(1)
    out = []
    for number, take in enumerate(takes(8, timetable=True)):
        rest = round(random.uniform(0.5, 3.0) / take.period_s)
        poses = [np.repeat(part[:1], rest, axis=0) for part in (take.left, take.right)]
        left, right = (
            np.concatenate([still, part])
            for still, part in zip(poses, (take.left, take.right), strict=True)
        )
        tool = np.concatenate([take.tool, np.repeat(take.tool[-1:], rest, axis=0)])
        stamps_ns = np.round(1e9 * (20.0 * number + take.period_s * np.arange(len(tool))))
        out.append(Demonstration(stamps_ns.astype(np.int64), left, right, tool, begun_s=0.0))
    return out


@pytest.mark.thorough
def test_a_timetable_from_a_request_is_learned_and_begun() -> None:
    """The tool moves by the time since the request, whenever the hands move. Without requests, the
    same takes are learned worse.
    """
    *shown, asked = requested_takes()
    skill = learn(shown)
    assert clock(skill) is not None
    assert clock(decoded(skill.file, origin="again")) == clock(skill)
    assert any("`thirdhand begin` starts" in text for text in figures_of(skill).warnings)
    without = learn([take._replace(begun_s=None) for take in shown])
    assert figures_of(skill).all.error_mm < 0.5 * figures_of(without).all.error_mm
    rounds = [
        judged(take, said)
        for take in [left_out("", "", asked)]
        for said in predicted_rounds(skill, take)
    ]
    for one in rounds:
        assert 1e3 * np.sqrt(one.squares / one.samples) < 2.0 * figures_of(skill).all.error_mm


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.thorough
def test_every_round_is_predicted_as_the_first(kind: str) -> None:
    """Rests at the start of the take last 0.5 to 6 s; one round is broken off halfway."""
    skill, asked = learned(kind)
    take = left_out("asked", "", asked)
    rounds = [*predicted_rounds(skill, take), *predicted_rounds(skill, take, broken_share=0.5)]
    first, *others = [judged(take, prediction) for prediction in rounds]
    first_mm = 1e3 * np.sqrt(first.squares / first.samples)
    for later in others:
        assert 1e3 * np.sqrt(later.squares / later.samples) < max(1.1 * first_mm, first_mm + 2.0)
        assert (later.held or 0) - (first.held or 0) <= 0.03 * first.samples


def test_each_segment_restarts_the_clock() -> None:
    """A clock restarts with the first motion in the segment."""
    rows = np.tile(RUNS.numbers, (2, 1))
    state = np.zeros(CLOCK_SIZE)
    seconds = []
    for speed, segment in [(0.3, 0)] * 200 + [(0.0, 1)] * 100 + [(0.3, 1)] * 100:
        count(AWAY, speed, float(speed == 0.0), PERIOD_S, segment, rows, state)
        seconds.append(state[CLOCK_S])
    assert seconds[199] == pytest.approx(1.9, abs=0.05)
    assert not any(seconds[200:300])
    assert seconds[-1] == pytest.approx(0.9, abs=0.05)
