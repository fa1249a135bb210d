"""What a source cannot mean: stamps far ahead, jumps, two sources of one hand or of the arm.

Each was an attack once: on hands here, on the arm in `test_arm_sources`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import settings as example_settings
from hypothesis import strategies as st

from support.followed import followed
from support.in_process import LEFT, RIGHT, led
from support.tracked import LEFT as LEFT_SIDE
from support.tracked import PERIOD_S, STRAIGHT, Hands
from thirdhand.contract.messages import PoseStamped
from thirdhand.contract.records import Cause, Mode, Reason
from thirdhand.core.frame import Tick, Vector
from thirdhand.core.skill.skill import Skill

PLACE, ELSEWHERE = (0.5, 0.1, 0.2), (0.5, 0.3, 0.2)


def tell(hands: Hands, places: Sequence[tuple[float, ...] | None], rate_hz: int) -> list[float]:
    """Samples at a rate, one after the other (None: missing); y of the estimate after each."""
    every, told = 500 // rate_hz, []
    for place in places:
        hands.advance(every)
        if place is not None:
            hands.hand(10**9 + int(hands.state["tick"]), place)
        told.append(float(hands.state["hands"][LEFT_SIDE, 0, 1]))
    return told


@pytest.mark.parametrize("rate_hz", [30, 100, 250, 500])
def test_jump_is_believed_after_three_samples(rate_hz: int) -> None:
    """A jump is accepted once three samples over 20 ms agree, and not before."""
    hands = Hands()
    tell(hands, [PLACE] * rate_hz, rate_hz)
    y = np.array(tell(hands, [ELSEWHERE] * 30, rate_hz))
    believed = int(np.argmax(y > 0.2))
    every = 500 // rate_hz
    assert believed == max(2, math.ceil(0.02 * 500 / every - 0.5))
    assert np.abs(y[:believed] - 0.1).max() < 0.001
    assert np.abs(y[believed:] - 0.3).max() < 0.001
    assert hands.rejected() == {Cause.JUMPED: believed}
    assert hands.fresh()


@pytest.mark.parametrize("rate_hz", [30, 100, 500])
@pytest.mark.parametrize("length", [1, 2])
def test_momentary_jump_leaves_no_trace(rate_hz: int, length: int) -> None:
    """Short outliers leave no trace in the estimate."""
    told, missing = Hands(), Hands()
    head, tail = [PLACE] * 40, [PLACE] * 20
    tell(told, [*head, *[ELSEWHERE] * length, *tail], rate_hz)
    tell(missing, [*head, *[None] * length, *tail], rate_hz)
    assert told.rejected() == {Cause.JUMPED: length}
    for name in ("hands", "mode_means", "mode_covariances", "noise_variance", "even_samples", "mode_probabilities"):
        assert told.state[name].tobytes() == missing.state[name].tobytes(), name


def test_wrong_samples_are_dropped_by_the_next() -> None:
    """They make the hand seem to move at 2 m/s."""
    rate_hz, off_m = 30, (0.068, 0.08)
    hands, random, place = Hands(), np.random.default_rng(5), np.array([0.5, 0.1, 0.2])
    off = {2 * rate_hz: off_m[0], 2 * rate_hz + 1: off_m[1]}
    for k in range(3 * rate_hz):
        at = place + random.normal(0.0, 0.0005, 3) + off.get(k, 0.0) * np.array([0.0, 0.6, 0.8])
        found = hands.hand(round(1e9 * (1 + k / rate_hz)), tuple(at.tolist()))
        if k == 2 * rate_hz + 2:
            assert np.linalg.norm(found - place) < 0.005  # it would run off otherwise
            assert np.linalg.norm(hands.state["hands"][LEFT_SIDE, 1]) < 0.1
            assert hands.state["hand_doubt_m"][LEFT_SIDE] > 0.05  # separation counts with both places
        hands.advance(round((k + 1) / rate_hz / PERIOD_S) - round(k / rate_hz / PERIOD_S))
    assert hands.state["hand_doubt_m"][LEFT_SIDE] == 0.0
    assert not hands.contested()


@pytest.mark.parametrize("rate_hz", [30, 100])
def test_quick_motion_is_not_dropped(rate_hz: int) -> None:
    """It starts within 50 ms to 1.2 m/s; none of its samples is dropped."""
    hands, random, kept = Hands(), np.random.default_rng(6), []
    for k in range(2 * rate_hz):
        t = k / rate_hz
        moved = 1.2 * max(0.0, t - 1.0 - 0.025 * min(1.0, max(0.0, t - 1.0) / 0.05))
        at = np.array([0.5, 0.1 + min(moved, 0.4), 0.2]) + random.normal(0.0, 0.0005, 3)
        hands.hand(round(1e9 * (1 + t)), tuple(at.tolist()))
        kept.append(int(hands.state["kept"][LEFT_SIDE]))
        hands.advance(round((k + 1) / rate_hz / PERIOD_S) - round(k / rate_hz / PERIOD_S))
    assert (np.diff(kept) >= 0).all()
    assert hands.state["hand_doubt_m"][LEFT_SIDE] == 0.0


@pytest.mark.parametrize("rate_hz", [30, 100, 500])
@pytest.mark.parametrize("apart_m", [0.09, 0.4])
def test_first_of_two_sources_is_believed(rate_hz: int, apart_m: float) -> None:
    """Of two alternating sources, the first is accepted, and the contest is detected."""
    hands = Hands()
    other = (PLACE[0], PLACE[1] + apart_m, PLACE[2])
    tell(hands, [PLACE] * 20, rate_hz)
    y = tell(hands, [other, PLACE] * (3 * rate_hz // 2), rate_hz)
    assert np.abs(np.array(y) - PLACE[1]).max() < 0.001
    assert hands.contested()
    assert hands.fresh()
    tell(hands, [PLACE] * (3 * rate_hz), rate_hz)
    assert not hands.contested(already=True)


@pytest.mark.parametrize("offset_ns", [-5_000_000, 3600 * 10**9])
def test_second_clock_is_noticed(offset_ns: int) -> None:
    """A second source with a clock of its own is noticed too."""
    hands = Hands()
    for _ in range(500):
        hands.advance(5)
        stamp_ns = 10**15 + int(hands.state["tick"]) * 2_000_000
        hands.hand(stamp_ns, PLACE)
        hands.hand(stamp_ns + offset_ns, ELSEWHERE)
    assert hands.contested()
    assert abs(hands.state["hands"][LEFT_SIDE, 0, 1] - 0.1) < 0.001


def test_flood_of_samples_is_taken() -> None:
    """A flood of ten samples a tick is taken in turn."""
    hands = Hands()
    noise = np.random.default_rng(6).normal(0.0, 0.003, (5000, 3))
    for k, row in enumerate(noise):
        if k % 10 == 0:
            hands.advance()
        hands.hand(10**9 + 200_000 * k, tuple((np.array(PLACE) + row).tolist()))
    assert hands.rejected() == {}
    np.testing.assert_allclose(hands.state["hands"][LEFT_SIDE, 0], PLACE, atol=0.002)


class BothHands(Hands):
    """Hands that go up and down, told at a rate by a tracker that may take one for the other."""

    def __init__(self, rate_hz: int) -> None:
        super().__init__()
        self.every, self.noise = 500 // rate_hz, np.random.default_rng(8)

    def at(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        up = 0.2 + 0.15 * math.sin(0.006 * float(self.state["tick"]))  # up to 0.45 m/s
        return (0.5, 0.1, up), (0.6, 0.5, up)

    def tell(self, seconds: float, *, swapped: bool = False, hidden: tuple[int, ...] = ()) -> tuple[Vector, Vector]:
        """How far each estimate was off across (T, 2) [m], and whether each was fresh, tick by
        tick, while some labels are hidden.
        """
        off, fresh = [], []
        for _ in range(round(500 * seconds)):
            self.advance()
            if int(self.state["tick"]) % self.every == 0:
                told = self.at()[::-1] if swapped else self.at()
                for side, place in enumerate(told):
                    if side in hidden:
                        continue
                    seen = np.array(place) + 0.002 * self.noise.standard_normal(3)
                    self.hand(10**9 + int(self.state["tick"]), tuple(seen.tolist()), side=side)
            off.append([abs(self.state["hands"][side, 0, 1] - place[1]) for side, place in enumerate(self.at())])
            fresh.append([self.fresh(side) for side in (0, 1)])
        return np.array(off), np.array(fresh)


@pytest.mark.parametrize("rate_hz", [30, 100, 500])
@pytest.mark.parametrize("lasts_s", [0.3, 1.5])
def test_swapped_hands_are_held_for(rate_hz: int, lasts_s: float) -> None:
    """Exchanged hands are rejected, and the arm holds."""
    hands = BothHands(rate_hz)
    assert hands.tell(1.0)[1][-1].all()
    off, fresh = hands.tell(lasts_s, swapped=True)
    assert off.max() < 0.02
    assert not fresh[75:].any()  # 0.15 s
    assert hands.rejected()[Cause.SWAPPED] >= 2 * rate_hz * lasts_s - 4
    assert hands.rejected()[Cause.JUMPED] <= 3
    off, fresh = hands.tell(1.0)
    assert fresh[2 * hands.every :].all()
    assert off.max() < 0.02
    assert not hands.contested(already=True)


@pytest.mark.parametrize("rate_hz", [30, 100, 500])
@pytest.mark.parametrize("hidden", [(0,), (1,), (0, 1)])
def test_swap_after_hiding_is_not_believed(rate_hz: int, hidden: tuple[int, ...]) -> None:
    """Hands that reappear with exchanged labels are rejected."""
    hands = BothHands(rate_hz)
    hands.tell(1.0)
    hands.tell(0.2, hidden=hidden)  # the hand is covered, then its label goes to the other
    hands.tell(0.1, swapped=True, hidden=hidden)
    off, fresh = hands.tell(0.8, swapped=True)
    assert off.max() < 0.02
    assert not fresh[25:].any()
    off, fresh = hands.tell(0.5)
    assert fresh[2 * hands.every :].all()
    assert off[2 * hands.every :].max() < 0.02


@pytest.mark.parametrize("rate_hz", [30, 100, 500])
def test_lasting_swap_is_believed_after_2_s(rate_hz: int) -> None:
    """Labels that stay exchanged are accepted after two seconds."""
    hands = BothHands(rate_hz)
    hands.tell(1.0)
    off, fresh = hands.tell(3.0, swapped=True)
    held = np.flatnonzero(~fresh.all(axis=1))
    assert held[-1] / 500 == pytest.approx(2.0, abs=0.07)
    assert off[held[-1] + 1 :].min() > 0.35


def test_one_hand_may_go_where_the_other_is() -> None:
    hands = BothHands(100)
    hands.tell(1.0)
    for _ in range(20):
        hands.advance(5)
        stamp_ns, right = 10**9 + int(hands.state["tick"]), hands.at()[1]
        hands.hand(stamp_ns, (right[0], right[1] - 0.04, right[2]), side=0)
        hands.hand(stamp_ns, right, side=1)
    assert hands.fresh(0)
    assert hands.state["hands"][0, 0, 1] == pytest.approx(0.46, abs=0.01)
    assert Cause.SWAPPED not in hands.rejected()


NUMBERS = st.one_of(
    st.floats(width=64), st.sampled_from([0.0, -0.0, 5e-324, -5e-324, 1e-310, 1.0, 0.5, math.nan, math.inf, 1e308, 5.0])
)
STAMPS = st.one_of(st.integers(-(2**63), 2**63 - 1), st.sampled_from([-(2**63), -1, 0, 1, 2**63 - 1]))
SAMPLES = st.tuples(
    st.integers(0, 60),
    STAMPS,
    st.sampled_from(["base", "", "camera"]),
    st.one_of(st.just(PLACE), st.tuples(NUMBERS, NUMBERS, NUMBERS)),
    st.one_of(st.just(STRAIGHT), st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS)),
)


@example_settings(max_examples=300, deadline=None, derandomize=True)
@given(st.lists(SAMPLES, max_size=12))
@example([(0, 2**63 - 1, "base", PLACE, STRAIGHT), (50, -(2**63), "", (5e-324,) * 3, STRAIGHT)])
def test_any_samples_leave_a_usable_state(
    samples: list[tuple[int, int, str, tuple[float, ...], tuple[float, ...]]],
) -> None:
    """All samples are accepted or counted, and leave a finite state."""
    hands = Hands()
    for k, (ticks, stamp_ns, frame, position, turn) in enumerate(samples):
        if ticks:
            hands.advance(ticks)
        newest_ns, count = int(hands.state["hand_stamps_ns"][LEFT_SIDE]), sum(hands.rejected().values())
        hands.intake.take_hand(hands.state, LEFT_SIDE, PoseStamped(stamp_ns, frame, position, turn))  # type: ignore[arg-type]
        taken = sum(hands.rejected().values()) == count
        late = taken and int(hands.state["hand_stamps_ns"][LEFT_SIDE]) == newest_ns != stamp_ns
        assert not late or 0 < newest_ns - stamp_ns <= 100_000_000
        assert taken <= (late or int(hands.state["hand_ticks"][LEFT_SIDE]) == int(hands.state["tick"])), k
        for name in ("hands", "mode_means", "mode_covariances", "noise_variance", "mode_probabilities", "contested"):
            assert np.isfinite(hands.state[name]).all(), name
        assert np.linalg.norm(hands.state["hands"][LEFT_SIDE, 0]) < 10.0


# --- in the core ---


def told(until: int, contest: range, *, swap: bool = False) -> Iterator[Tick]:
    """Ticks with hands at rest; between two sources take turns, or the hands' labels are mixed
    up in every other sample.
    """
    rest = np.array((LEFT, RIGHT))
    other = rest[::-1] if swap else np.add(rest, [(0.0, 0.3, 0.0), (0.0, 0.0, 0.0)])
    return led(other if k in contest and k // 5 % 2 else rest for k in range(until))


@pytest.mark.parametrize("swap", [False, True])
def test_two_sources_hold_then_go_on(skill: Skill, swap: bool) -> None:
    """While two sources report a hand, the arm holds; afterwards it continues."""
    contest = range(1000, 2500)
    seen = followed(skill, told(4000, contest, swap=swap))
    assert (seen["mode"][50:1000] == Mode.FOLLOW).all()
    held = np.flatnonzero(seen["mode"] == Mode.HOLD)
    assert set(seen["reason"][held[held > 50]].tolist()) == {Reason.TWO_SOURCES}
    assert held[held > 50][0] < contest.start + 500
    assert contest.stop < held[-1] < contest.stop + 1000
    assert seen["mode"][-1] == Mode.FOLLOW
    still = seen["hands"][1000:, 0] - np.array(LEFT)
    assert np.abs(still).max() < 0.002


def test_sudden_move_of_both_hands_is_followed(skill: Skill) -> None:
    """One sudden move of both hands is followed without a hold."""
    hands = np.tile((LEFT, RIGHT), (2000, 1, 1))
    hands[1000:, :, 1] += 0.09
    seen = followed(replace(skill, threshold=math.inf), led(hands, every=16))
    assert set(seen["reason"][50:].tolist()) == {Reason.NONE}


# --- plain and compiled ---


# --- two trackers of one hand, and one alone, at uneven intervals ---


def uneven(rate_hz: float, seconds: float, kind: str, seed: int) -> Vector:
    """Times [s] of samples that come evenly, early or late, at random, or three at once."""
    random, count = np.random.default_rng(seed), int(rate_hz * seconds)
    if kind == "random":
        return np.cumsum(random.exponential(1 / rate_hz, count))
    at = np.arange(count) / rate_hz
    if kind == "evenly":
        return at
    return (
        np.sort(at + random.uniform(0.0, 0.8 / rate_hz, count)) if kind == "early or late" else at - at % (3 / rate_hz)
    )


def first_contest_s(times: Vector, places: Vector) -> float | None:
    """When samples (T, 3) [m] are found to be of two sources [s], or None: never."""
    hands = Hands()
    for at_s, place in zip(times, places, strict=True):
        hands.advance(max(0, round(500 * at_s) - int(hands.state["tick"])))
        hands.hand(10**12 + round(1e9 * at_s), tuple(place.tolist()))
        if hands.contested():
            return float(at_s)
    return None


SLOW, FAST = (0.05, 2.0), (0.1, 4.0)  # amplitude [m] and rate [rad/s] of a hand that goes to and fro
TWO_TRACKERS = [
    *(
        (apart_m, (97.0, 100.0), kind, SLOW)
        for apart_m in (0.02, 0.03, 0.04, 0.055)
        for kind in ("early or late", "random")
    ),
    *(
        (apart_m, rates_hz, "early or late", FAST)
        for apart_m in (0.02, 0.1, 0.3)
        for rates_hz in ((30.0, 30.0), (100.0, 100.0), (100.0, 60.0), (60.0, 30.0))
    ),
]


@pytest.mark.parametrize(("apart_m", "rates_hz", "kind", "motion"), TWO_TRACKERS)
def test_uneven_trackers_are_noticed(
    apart_m: float, rates_hz: tuple[float, float], kind: str, motion: tuple[float, float]
) -> None:
    """Two trackers whose samples come unevenly are noticed."""
    size_m, rate = motion
    for seed, way in enumerate(np.eye(3)):
        one, other = (uneven(rate_hz, 4.0, kind, seed + round(rate_hz)) for rate_hz in rates_hz)
        both = np.concatenate((one, other + 0.003))
        order = np.argsort(both)
        times = both[order]
        of_other = order >= len(one)
        moved = np.outer(size_m * np.sin(rate * times), (0.0, 1.0, 0.0))
        noise = 0.001 * np.random.default_rng(seed).standard_normal((len(times), 3))
        found = first_contest_s(times, PLACE + moved + noise + apart_m * np.outer(of_other, way))
        assert found is not None
        assert found < 2.5


@pytest.mark.parametrize("kind", ["evenly", "early or late", "random", "three at once"])
@pytest.mark.parametrize("noise_m", [(0.003,) * 3, (0.008,) * 3, (0.002, 0.002, 0.010)])
@pytest.mark.parametrize("shaken", [False, True])
def test_poor_tracker_is_no_contest(noise_m: tuple[float, ...], kind: str, shaken: bool) -> None:
    """A single poor tracker is not taken for two, whatever the order of its samples."""
    for seed, rate_hz in enumerate((30.0, 60.0, 120.0, 250.0)):
        times, random = uneven(rate_hz, 6.0, kind, seed), np.random.default_rng(seed)
        at = np.outer(0.015 * shaken * np.sin(2 * math.pi * 5 * times), (1.0, 0.0, 1.0))
        assert first_contest_s(times, PLACE + at + np.array(noise_m) * random.standard_normal(at.shape)) is None


def spoilt(kind: str, rate_hz: float, seed: int) -> tuple[Vector, Vector]:
    """Times [s] and places (T, 3) [m] as one tracker tells them that takes a hand for elsewhere,
    each time another way: at once for some samples, or a little for one.
    """
    random, times = np.random.default_rng(seed), np.arange(0.0, 8.0, 1.0 / rate_hz)
    places = (
        PLACE + np.outer(0.1 * np.sin(2 * times), (0.0, 1.0, 0.0)) + 0.002 * random.standard_normal((len(times), 3))
    )
    at = 3
    while at < len(times):
        way, lasts = random.standard_normal(3), 1 if kind == "spikes" else int(random.integers(3, 9))
        far_m = random.uniform(0.02, 0.04) if kind == "spikes" else random.uniform(0.1, 0.2)
        places[at : at + lasts] += far_m * way / np.linalg.norm(way)
        at += lasts + int(random.integers(5, 9))
    return times, places


@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 100.0])
@pytest.mark.parametrize("kind", ["spikes", "bursts"])
def test_outliers_of_one_tracker_are_no_contest(kind: str, rate_hz: float) -> None:
    """A tracker with frequent short outliers is not taken for two."""
    for seed in range(6):
        assert first_contest_s(*spoilt(kind, rate_hz, seed)) is None
