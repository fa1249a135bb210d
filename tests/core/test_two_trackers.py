"""Two trackers of one hand that are nearly of one mind, and one alone, at uneven intervals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from service.core.frame import Vector
from sim.people import person
from sim.sessions import session
from support.tracked import Hands

PLACE = (0.5, 0.1, 0.2)


def uneven(rate_hz: float, seconds: float, kind: str, seed: int) -> Vector:
    """Times [s] of a tracker's samples that come early or late, at random, or three at once."""
    random, count = np.random.default_rng(seed), int(rate_hz * seconds)
    if kind == "random":
        return np.cumsum(random.exponential(1 / rate_hz, count))
    at = np.arange(count) / rate_hz
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


@pytest.mark.parametrize("kind", ["early or late", "random"])
@pytest.mark.parametrize("apart_m", [0.02, 0.03, 0.04, 0.055])
def test_two_trackers_whose_samples_come_at_uneven_intervals_are_noticed(apart_m: float, kind: str) -> None:
    for seed, way in enumerate(np.eye(3)):
        one, other = uneven(97.0, 3.0, kind, seed), uneven(100.0, 3.0, kind, 10 + seed)
        order, random = np.argsort(np.concatenate((one, other))), np.random.default_rng(seed)
        times, of_other = np.concatenate((one, other))[order], order >= len(one)
        moved = np.outer(0.05 * np.sin(2 * times), (0.0, 1.0, 0.0)) + 0.001 * random.standard_normal((len(times), 3))
        found = first_contest_s(times, PLACE + moved + apart_m * np.outer(of_other, way))
        assert found is not None
        assert found < 2.5


@pytest.mark.parametrize("apart_m", [0.055, 0.3])
@pytest.mark.parametrize("behind_ticks", [1, 2])
def test_of_two_trackers_of_one_rate_the_one_that_comes_just_behind_is_noticed(
    apart_m: float, behind_ticks: int
) -> None:
    times = np.repeat(np.arange(180) / 60, 2) + np.tile((0.0, 0.002 * behind_ticks), 180)
    found = first_contest_s(times, PLACE + np.outer(np.tile((0.0, apart_m), 180), (0.0, 1.0, 0.0)))
    assert found is not None
    assert found < 1.5


@pytest.mark.parametrize("kind", ["early or late", "random", "three at once"])
@pytest.mark.parametrize("noise_m", [(0.003,) * 3, (0.008,) * 3, (0.002, 0.002, 0.010)])
@pytest.mark.parametrize("shaken", [False, True])
def test_a_poor_tracker_alone_is_no_contest_at_uneven_intervals(
    noise_m: tuple[float, ...], kind: str, shaken: bool
) -> None:
    for seed, rate_hz in enumerate((30.0, 60.0, 120.0, 250.0)):
        times, random = uneven(rate_hz, 6.0, kind, seed), np.random.default_rng(seed)
        at = np.outer(0.015 * shaken * np.sin(2 * math.pi * 5 * times), (1.0, 0.0, 1.0))
        assert first_contest_s(times, PLACE + at + np.array(noise_m) * random.standard_normal(at.shape)) is None


def test_nobodys_hands_are_a_contest_at_uneven_intervals() -> None:
    random = np.random.default_rng(4)
    for number in range(6):
        who = person("tuning", number)
        who = who._replace(swaps=0.0, speed=1.5 * who.speed, tracker=who.tracker._replace(jumps_hz=0.0))
        for times, places in session(who, 0, group="tuning").samples():
            kept = random.random(len(times)) < 0.6
            assert first_contest_s(times[kept], places[kept]) is None


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
def test_one_tracker_that_is_often_elsewhere_for_a_moment_is_no_contest(kind: str, rate_hz: float) -> None:
    for seed in range(6):
        assert first_contest_s(*spoilt(kind, rate_hz, seed)) is None


@pytest.mark.parametrize("rates_hz", [(30.0, 30.0), (100.0, 100.0), (100.0, 60.0), (60.0, 30.0)])
@pytest.mark.parametrize("apart_m", [0.02, 0.1, 0.3])
def test_two_trackers_of_any_rates_are_noticed_of_a_hand_that_moves(
    apart_m: float, rates_hz: tuple[float, float]
) -> None:
    for seed, way in enumerate(np.eye(3)):
        one, other = (uneven(rate_hz, 4.0, "early or late", seed + round(rate_hz)) for rate_hz in rates_hz)
        order, random = np.argsort(np.concatenate((one, other + 0.003))), np.random.default_rng(seed)
        times, of_other = np.concatenate((one, other + 0.003))[order], order >= len(one)
        moved = np.outer(0.1 * np.sin(4 * times), (0.0, 1.0, 0.0)) + 0.001 * random.standard_normal((len(times), 3))
        found = first_contest_s(times, PLACE + moved + apart_m * np.outer(of_other, way))
        assert found is not None
        assert found < 2.5
