"""Samples that arrive late or overtake each other count at the time of their stamps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as example_settings
from hypothesis import strategies as st

from support.tracked import LEFT, PERIOD_S, RIGHT, Hands
from thirdhand.contract.records import Cause
from thirdhand.core.frame import Vector
from thirdhand.daemon.input_monitor import lateness_ms

WARM_S = 2.5  # a clock is recognised as steady within this time
ZERO_NS = 1_700_000_000_000_000_000


def moving(t: Vector) -> Vector:
    """A hand (T, 3) [m] that moves up and down at up to 0.45 m/s."""
    return np.stack([0.5 + 0.15 * np.sin(3.0 * t), 0.1 * np.cos(2.0 * t), 0.2 + 0.0 * t], axis=1)


def told(
    made_s: Vector,
    late_s: Vector,
    *,
    stamps: Callable[[Vector], Vector] = lambda made_s: made_s,
    until_s: float,
) -> tuple[Hands, Vector]:
    """An intake whose samples were made at these times and arrived later by these delays; and the
    estimates (T, 3) [m] at each tick.
    """
    hands = Hands()
    places = moving(made_s)
    come_s = made_s + late_s
    estimates = []
    order = np.argsort(come_s, kind="stable")
    stamps_s = stamps(made_s)
    nth = 0
    for tick in range(round(until_s / PERIOD_S)):
        if tick:
            hands.advance()
        while nth < len(order) and come_s[order[nth]] <= tick * PERIOD_S + 1e-9:
            index = order[nth]
            hands.hand(ZERO_NS + round(1e9 * stamps_s[index]), tuple(places[index].tolist()))
            nth += 1
        estimates.append(hands.state["hands"][LEFT, 0].copy())
    return hands, np.array(estimates)


@example_settings(max_examples=30, deadline=None, derandomize=True)
@given(st.sampled_from([30, 60, 100, 240, 500]), st.floats(0.01, 0.098), st.integers(0, 10**6))
def test_order_of_arrival_does_not_matter(rate_hz: int, latest_s: float, seed: int) -> None:
    """The estimate does not depend on the order in which samples arrive."""
    latest_s = min(latest_s, 0.098 - 1.0 / rate_hz)  # no gap is long enough to restart the filter
    until_s = WARM_S + 0.6
    made_s = np.arange(0.0, until_s, 1.0 / rate_hz)
    shuffles = (made_s > WARM_S) & (made_s < WARM_S + 0.4)
    late_s = latest_s * shuffles * np.random.default_rng(seed).random(len(made_s))
    in_order = told(made_s, 0.0 * late_s, until_s=until_s)[0]
    shuffled = told(made_s, late_s, until_s=until_s)[0]
    assert shuffled.rejected() == in_order.rejected() == {}
    np.testing.assert_allclose(
        shuffled.state["hands"], in_order.state["hands"], rtol=0.0, atol=1e-9
    )
    np.testing.assert_allclose(
        shuffled.state["noise_variance"], in_order.state["noise_variance"], rtol=1e-6
    )
    np.testing.assert_array_equal(shuffled.state["kept_ticks"], in_order.state["kept_ticks"])


@pytest.mark.parametrize("rate_hz", [30, 100, 500])
def test_samples_60_ms_late_are_nearly_as_good(rate_hz: int) -> None:
    made_s = np.arange(0.0, 8.0, 1.0 / rate_hz)
    late_s = 0.06 * np.random.default_rng(1).random(len(made_s))
    hands, estimates = told(made_s, late_s, until_s=8.0)
    assert hands.rejected() == {}
    late_ms = lateness_ms(hands.state, LEFT, PERIOD_S)
    assert late_ms is not None
    np.testing.assert_allclose(late_ms, (29.0, 57.0), atol=6.0)
    assert lateness_ms(hands.state, RIGHT, PERIOD_S) is None
    truth = moving(np.arange(len(estimates)) * PERIOD_S)
    error = np.linalg.norm(estimates - truth, axis=1)[round(3.0 / PERIOD_S) :]
    assert np.sqrt(np.mean(error**2)) < {30: 0.005, 100: 0.003, 500: 0.002}[rate_hz]


@pytest.mark.parametrize("rate_hz", [30, 100])
@pytest.mark.parametrize(
    "stamps",
    [
        lambda made_s: 1e-9 * np.arange(len(made_s)),
        lambda made_s: 0.9 * made_s,
        lambda made_s: 1.05 * made_s,
        lambda made_s: 0.985 * made_s,
    ],
)
def test_bad_clock_is_ignored(rate_hz: int, stamps: Callable[[Vector], Vector]) -> None:
    """With a useless clock, samples are stamped at their arrival."""
    made_s = np.arange(0.0, 8.0, 1.0 / rate_hz)
    usual = told(made_s, 0.0 * made_s, until_s=8.0)
    other = told(made_s, 0.0 * made_s, stamps=stamps, until_s=8.0)
    assert other[0].rejected() == {}
    np.testing.assert_array_equal(other[1], usual[1])


def test_late_sample_does_not_undo_a_jump() -> None:
    """A late sample from before a jump does not move the hand back."""
    hands = Hands()
    for k in range(400):
        hands.advance(5)
        hands.hand(ZERO_NS + 10_000_000 * k, (0.5, 0.1 if k < 380 else 0.3, 0.2))
    assert abs(hands.state["hands"][LEFT, 0, 1] - 0.3) < 0.001
    for k in range(391, 399):
        hands.hand(ZERO_NS + 10_000_000 * k - 5_000_000, (0.5, 0.1, 0.2))
    assert abs(hands.state["hands"][LEFT, 0, 1] - 0.3) < 0.001
    assert hands.rejected() == {Cause.JUMPED: 5 + 8}  # five of the samples confirm the jump


def test_restarted_tracker_is_believed_again() -> None:
    """A tracker that restarts with its clock set back is accepted again."""
    hands = Hands()
    for k in range(300):
        hands.advance(5)
        hands.hand(ZERO_NS + 10_000_000 * k)
    hands.advance(50)
    for k in range(300):
        hands.advance(5)
        hands.hand(10_000_000 * (k + 1), (0.5, 0.1 + 0.001 * k, 0.2))
        assert hands.fresh()
        assert abs(hands.state["hands"][LEFT, 0, 1] - 0.1 - 0.001 * k) < 0.002
    assert hands.rejected() == {}
