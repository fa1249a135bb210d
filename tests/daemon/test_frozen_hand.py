"""The arm holds for a hand that its tracker has lost but still publishes; a program's hand may
rest.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from support.cell import LEFT, Tracker, serving
from thirdhand.contract.messages import PoseStamped
from thirdhand.core.frame import Vector
from thirdhand.daemon.cell_streams import FROZEN_S, FrozenHand

TURNED = (0.0, 0.0, 0.0, 1.0)


def refused(positions: Vector, rate_hz: float, *, unit_m: float = 1.0) -> Vector:
    """Times [s] of those samples (T, 3) [m] that are refused as frozen."""
    hand = FrozenHand()
    times = np.arange(len(positions)) / rate_hz
    poses = (
        PoseStamped(10**18 + round(1e9 * at_s), "base", tuple((position / unit_m).tolist()), TURNED)
        for at_s, position in zip(times, positions, strict=True)
    )
    return times[[hand.is_frozen(pose) for pose in poses]]


def measured(seconds: float, rate_hz: float, at: tuple[float, ...] = LEFT, seed: int = 0) -> Vector:
    """Samples of a resting hand with a tracker's noise."""
    return at + 2e-4 * np.random.default_rng(seed).standard_normal((round(seconds * rate_hz), 3))


@pytest.mark.parametrize("unit_m", [1.0, 1e-3])
@pytest.mark.parametrize("rate_hz", [15.0, 60.0, 250.0])
def test_loss_of_a_tracked_hand_is_noticed(rate_hz: float, unit_m: float) -> None:
    """Each loss is detected after half a second."""
    lost = round(2.0 * rate_hz)
    # a lost hand has its last pose, or a default pose of the tracker
    for default in (None, (0.25, -0.25, 0.1)):
        tracked = measured(3.0, rate_hz)
        pieces = [tracked, np.tile(tracked[-1] if default is None else default, (lost, 1))]
        pieces += [measured(3.0, rate_hz, (0.8, -0.1, 0.2), 1)]
        pieces += [np.tile(pieces[-1][-1], (lost, 1)), measured(1.0, rate_hz, LEFT, 2)]
        times = refused(np.concatenate(pieces), rate_hz, unit_m=unit_m)
        first = times[times < 5.5]
        assert 3.0 + FROZEN_S - 2 / rate_hz <= first[0] <= 3.0 + FROZEN_S + 2 / rate_hz
        assert first[-1] == pytest.approx(5.0 - 1 / rate_hz, abs=1e-6)
        second = times[times > 5.5]
        assert 8.0 + FROZEN_S - 2 / rate_hz <= second[0] <= 8.0 + FROZEN_S + 2 / rate_hz


def program(rate_hz: float, *, begins_at_rest: bool) -> Iterator[Vector]:
    """A hand that a program moves for one second and rests for two, without noise."""
    path = np.linspace(0.0, 0.2, round(rate_hz))
    for k in range(0 if begins_at_rest else 1, 6):
        along = np.full(round(2 * rate_hz), 0.2 * (k // 2)) if k % 2 == 0 else 0.2 * (k // 2) + path
        yield np.stack([along, np.zeros_like(along), np.zeros_like(along)], axis=1)


@pytest.mark.parametrize("rate_hz", [15.0, 60.0, 250.0])
def test_hands_that_a_program_lets_rest_are_accepted(rate_hz: float) -> None:
    for begins_at_rest in (True, False):
        assert not len(
            refused(np.concatenate([*program(rate_hz, begins_at_rest=begins_at_rest)]), rate_hz)
        )
    assert not len(refused(np.tile(LEFT, (1000, 1)), rate_hz))
    share = np.linspace(0.0, 1.0, round(3 * rate_hz))
    # a minimum-jerk reach without a rest before it
    along = 0.4 * (10 * share**3 - 15 * share**4 + 6 * share**5)
    stop = np.concatenate([along[1:], np.full(round(2 * rate_hz), along[-1])])
    assert not len(refused(np.outer(stop, (1.0, 0.5, 0.0)), rate_hz))


@pytest.mark.parametrize("rate_hz", [15.0, 60.0, 250.0])
def test_hands_that_begin_with_an_exact_rest_are_accepted(rate_hz: float) -> None:
    """Hands of a web page stop at once and continue with a leap; hands of a bench have noise."""
    count = round(3 * rate_hz)
    dragged = LEFT + np.outer(np.linspace(0.0, 0.4, count + 1)[1:], (1.0, 0.0, 0.0))
    for moves in (dragged, measured(3.0, rate_hz)):
        pieces = [np.tile(LEFT, (round(rate_hz), 1))]
        for away_m in (0.0, 0.3, 0.6):
            pieces += [moves + away_m, np.tile(moves[-1] + away_m, (count, 1))]
        assert not len(refused(np.concatenate(pieces), rate_hz))


@pytest.mark.parametrize("last_step_m", [1e-7, 1e-8, 1e-15])
@pytest.mark.parametrize("rate_hz", [40.0, 80.0, 160.0])
def test_hands_that_come_to_rest_ever_more_slowly_are_accepted(
    rate_hz: float, last_step_m: float
) -> None:
    """A page's hand is dragged at once, comes to rest by steps that shrink to the last bits of a
    number, and leaps whenever the page is loaded again.
    """
    for approach_per_s in (4.0, 8.0, 16.0):
        decay = approach_per_s / rate_hz
        count = round(np.log(0.4 * decay / last_step_m) / decay)
        reach = np.outer(1 - np.exp(-decay * np.arange(count)), (0.4, 0.1, 0.05)) + LEFT
        dragged = np.concatenate((reach, np.tile(reach[-1], (round(2 * rate_hz), 1))))
        hand = np.concatenate([dragged + away_m for away_m in (0.0, 0.3, 0.1, 0.4)])
        assert not len(refused(hand, rate_hz)), approach_per_s


def test_noise_is_never_frozen() -> None:
    assert not len(refused(measured(30.0, 100.0), 100.0))
    coarse = np.round(measured(30.0, 100.0), 3)  # a tracker that reports whole millimetres
    assert not len(refused(coarse, 100.0))


@pytest.mark.thorough
def test_the_arm_holds_for_a_lost_hand_and_says_why(tmp_path: Path) -> None:
    with serving(tmp_path, "--joints", "assumed") as daemon, Tracker(daemon.session) as tracker:
        random = np.random.default_rng(0)
        end_s = time.monotonic() + 3.0
        while time.monotonic() < end_s:
            tracker.left = tuple((LEFT + 3e-4 * random.standard_normal(3)).tolist())
            time.sleep(0.004)
        daemon.until(lambda status: status["mode"] == "follow")
        held = daemon.until(lambda status: status["reason"] == "stale_hand", timeout_s=3.0)
        assert (
            "what arrives is rejected as frozen: the pose of a hand was the same, bit for bit"
            in held["because"]
        )
        assert held["remedy"].startswith("bring the hand into the tracker's view")
        tracker.left = (LEFT[0], LEFT[1] + 0.001, LEFT[2])
        daemon.until(lambda status: status["mode"] == "follow")
