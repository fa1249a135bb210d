"""Implausible samples: stamps far ahead, jumps, two sources of one hand.

Each case was an attack once; those on the arm are in `test_arm_sources`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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
from thirdhand.contract.records import Cause, Reason
from thirdhand.core.skill.skill import Skill

PLACE = (0.5, 0.1, 0.2)
ELSEWHERE = (0.5, 0.3, 0.2)


def tell(hands: Hands, places: Sequence[tuple[float, ...] | None], rate_hz: int) -> list[float]:
    """The estimated y after each of these samples at a rate; None is a missing sample."""
    every = 500 // rate_hz
    estimates_m = []
    for place in places:
        hands.advance(every)
        if place is not None:
            hands.hand(10**9 + int(hands.state["tick"]), place)
        estimates_m.append(float(hands.state["hands"][LEFT_SIDE, 0, 1]))
    return estimates_m


@pytest.mark.parametrize("rate_hz", [30, 100, 250, 500])
def test_jump_is_believed_after_50_ms(rate_hz: int) -> None:
    """A jump is accepted once three samples over 50 ms agree, and not before."""
    hands = Hands()
    tell(hands, [PLACE] * rate_hz, rate_hz)
    y = np.array(tell(hands, [ELSEWHERE] * 70, rate_hz))
    believed = int(np.argmax(y > 0.2))
    every = 500 // rate_hz
    assert believed == max(2, math.ceil((0.05 * 500 - 0.5) / every))
    assert np.abs(y[:believed] - 0.1).max() < 0.001
    assert np.abs(y[believed:] - 0.3).max() < 0.001
    assert hands.rejected() == {Cause.JUMPED: believed}
    assert hands.fresh()


@pytest.mark.parametrize("rate_hz", [30, 100, 500])
@pytest.mark.parametrize("length", [1, 2])
def test_momentary_jump_leaves_no_trace(rate_hz: int, length: int) -> None:
    """Short outliers leave no trace in the estimate."""
    disturbed = Hands()
    missing = Hands()
    head = [PLACE] * 40
    tail = [PLACE] * 20
    tell(disturbed, [*head, *[ELSEWHERE] * length, *tail], rate_hz)
    tell(missing, [*head, *[None] * length, *tail], rate_hz)
    assert disturbed.rejected() == {Cause.JUMPED: length}
    for name in (
        "hands",
        "mode_means",
        "mode_covariances",
        "noise_variance",
        "even_samples",
        "mode_probabilities",
    ):
        assert disturbed.state[name].tobytes() == missing.state[name].tobytes(), name


def test_wrong_samples_are_dropped_by_the_next() -> None:
    """Two wrong samples make the hand seem to move at 2 m/s."""
    rate_hz = 30
    off_m = (0.068, 0.08)
    hands = Hands()
    random = np.random.default_rng(5)
    place = np.array([0.5, 0.1, 0.2])
    offsets_m = {2 * rate_hz: off_m[0], 2 * rate_hz + 1: off_m[1]}
    for k in range(3 * rate_hz):
        sample_m = (
            place
            + random.normal(0.0, 0.0005, 3)
            + offsets_m.get(k, 0.0) * np.array([0.0, 0.6, 0.8])
        )
        estimate_m = hands.hand(round(1e9 * (1 + k / rate_hz)), tuple(sample_m.tolist()))
        if k == 2 * rate_hz + 2:
            assert np.linalg.norm(estimate_m - place) < 0.005  # the wrong speed has no effect
            assert np.linalg.norm(hands.state["hands"][LEFT_SIDE, 1]) < 0.1
            # separation considers both positions
            assert hands.state["hand_doubt_m"][LEFT_SIDE] > 0.05
        hands.advance(round((k + 1) / rate_hz / PERIOD_S) - round(k / rate_hz / PERIOD_S))
    assert hands.state["hand_doubt_m"][LEFT_SIDE] == 0.0


@pytest.mark.parametrize("rate_hz", [30, 100])
def test_quick_motion_is_not_dropped(rate_hz: int) -> None:
    """A hand accelerates to 1.2 m/s within 50 ms."""
    hands = Hands()
    random = np.random.default_rng(6)
    counts = []
    for k in range(2 * rate_hz):
        t = k / rate_hz
        moved = 1.2 * max(0.0, t - 1.0 - 0.025 * min(1.0, max(0.0, t - 1.0) / 0.05))
        sample_m = np.array([0.5, 0.1 + min(moved, 0.4), 0.2]) + random.normal(0.0, 0.0005, 3)
        hands.hand(round(1e9 * (1 + t)), tuple(sample_m.tolist()))
        counts.append(int(hands.state["kept"][LEFT_SIDE]))
        hands.advance(round((k + 1) / rate_hz / PERIOD_S) - round(k / rate_hz / PERIOD_S))
    assert (np.diff(counts) >= 0).all()
    assert hands.state["hand_doubt_m"][LEFT_SIDE] == 0.0


@pytest.mark.parametrize("rate_hz", [30, 100, 500])
@pytest.mark.parametrize("apart_m", [0.09, 0.4])
def test_first_of_two_sources_is_believed(rate_hz: int, apart_m: float) -> None:
    """Of two publishers without a name that take turns, the first is accepted."""
    hands = Hands()
    other = (PLACE[0], PLACE[1] + apart_m, PLACE[2])
    tell(hands, [PLACE] * 20, rate_hz)
    y = tell(hands, [other, PLACE] * (3 * rate_hz // 2), rate_hz)
    assert np.abs(np.array(y) - PLACE[1]).max() < 0.001
    assert hands.fresh()
    assert hands.rejected() == {Cause.JUMPED: 3 * rate_hz // 2}


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


def test_one_hand_may_go_where_the_other_is() -> None:
    hands = Hands()
    for k in range(120):
        hands.advance(5)
        stamp_ns = 10**9 + int(hands.state["tick"])
        left_y = 0.1 if k < 100 else 0.46
        hands.hand(stamp_ns, (0.5, left_y, 0.2), side=0)
        hands.hand(stamp_ns, (0.5, 0.5, 0.2), side=1)
    assert hands.fresh(0)
    assert hands.state["hands"][0, 0, 1] == pytest.approx(0.46, abs=0.01)


NUMBERS = st.one_of(
    st.floats(width=64),
    st.sampled_from([0.0, -0.0, 5e-324, -5e-324, 1e-310, 1.0, 0.5, math.nan, math.inf, 1e308, 5.0]),
)
STAMPS = st.one_of(
    st.integers(-(2**63), 2**63 - 1), st.sampled_from([-(2**63), -1, 0, 1, 2**63 - 1])
)
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
        newest_ns = int(hands.state["hand_stamps_ns"][LEFT_SIDE])
        count = sum(hands.rejected().values())
        hands.intake.take_hand(hands.state, LEFT_SIDE, PoseStamped(stamp_ns, frame, position, turn))  # type: ignore[arg-type]
        taken = sum(hands.rejected().values()) == count
        late = taken and int(hands.state["hand_stamps_ns"][LEFT_SIDE]) == newest_ns != stamp_ns
        assert not late or 0 < newest_ns - stamp_ns <= 100_000_000
        assert taken <= (
            late or int(hands.state["hand_ticks"][LEFT_SIDE]) == int(hands.state["tick"])
        ), k
        for name in (
            "hands",
            "mode_means",
            "mode_covariances",
            "noise_variance",
            "mode_probabilities",
        ):
            assert np.isfinite(hands.state[name]).all(), name
        assert np.linalg.norm(hands.state["hands"][LEFT_SIDE, 0]) < 10.0


# --- in the core ---


def test_sudden_move_of_both_hands_is_followed(skill: Skill) -> None:
    """One sudden move of both hands is followed without a hold."""
    hands = np.tile((LEFT, RIGHT), (2000, 1, 1))
    hands[1000:, :, 1] += 0.09
    frames = followed(replace(skill, threshold=math.inf), led(hands, every=16))
    assert set(frames["reason"][50:].tolist()) == {Reason.NONE}
