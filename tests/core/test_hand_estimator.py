"""The hand estimator: accurate between samples, whether the tracker's noise is configured or
not.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from support.tracked import LEFT, PERIOD_S, Hands, follow
from thirdhand.core.frame import Vector
from thirdhand.core.intake.motion_model import REST
from thirdhand.core.tuning import TUNING
from thirdhand.skills.recognition import stillness_of

LEAST_NOISE_M = TUNING.intake.least_noise_m


def reach(t: float) -> Vector:
    """A minimum-jerk reach of 30 cm in one second, beginning at 1 s."""
    u = min(max(t - 1.0, 0.0), 1.0)
    return np.array([0.5, 0.0, 0.2]) + u**3 * (10 - 15 * u + 6 * u * u) * np.array([0.2, -0.2, 0.1])


@pytest.mark.parametrize("rate_hz", [30, 100, 500])
def test_reach_is_known_between_samples(rate_hz: int) -> None:
    """The error is a millimetre at most."""
    states = follow(Hands(), reach, until_s=3.0, rate_hz=rate_hz)
    truth = np.array([reach(k * PERIOD_S) for k in range(len(states))])
    error = np.linalg.norm(states[100:, 0] - truth[100:], axis=1)
    assert np.sqrt(np.mean(error**2)) < (0.0015 if rate_hz < 100 else 0.0005)
    velocity = np.gradient(truth, PERIOD_S, axis=0)
    assert np.abs(states[100:, 1] - velocity[100:]).max() < (0.25 if rate_hz < 100 else 0.1)


@pytest.mark.parametrize(("speed_mps", "kept"), [(0.01, 0.99), (0.05, 0.95), (0.3, 0.85)])
def test_slow_motion_is_expected_to_go_on(speed_mps: float, kept: float) -> None:
    """The speed of a slow hand is estimated without a bias, and kept for 60 ms without a sample; a
    faster hand loses at most 15 % of it.
    """
    noise = np.random.default_rng(2).normal(0.0, 5e-4, (300, 3))
    hands = Hands()
    states = follow(hands, lambda t: np.array([speed_mps * t, 0.0, 0.2]), until_s=3.0, noise=noise)
    speeds = states[1000:, 1, 0]
    assert np.mean(speeds) == pytest.approx(speed_mps, rel=0.1 if kept < 0.9 else 0.05)
    assert np.std(speeds) < 0.2 * speed_mps
    hands.intake.advance(hands.state, 30)
    assert hands.state["hands"][LEFT, 1, 0] > kept * states[-1, 1, 0]


@pytest.mark.parametrize("noise_m", [0.0005, 0.002, 0.005])
def test_noise_is_reduced_and_measured(noise_m: float) -> None:
    """Noise is reduced, and its size is estimated."""
    noise = np.random.default_rng(1).normal(0.0, noise_m, (600, 3))
    still = np.array([0.5, 0.0, 0.2])
    hands = Hands()
    states = follow(hands, lambda t: still, until_s=6.0, noise=noise)
    assert np.sqrt(np.mean((states[500:, 0] - still) ** 2)) < 0.65 * noise_m
    estimated_m = math.sqrt(hands.state["noise_variance"][LEFT])
    assert max(noise_m, LEAST_NOISE_M) * 0.7 < estimated_m < max(noise_m, LEAST_NOISE_M) * 1.4


def test_jump_over_ticks_equals_single_ticks() -> None:
    """A jump over missed ticks predicts as single ticks do."""
    single = Hands()
    many = Hands()
    for hands in (single, many):
        follow(hands, lambda t: np.array([0.3 * t * t, -0.2 * t, 0.1]), until_s=0.5)
    for _ in range(20):
        single.advance()
    many.advance(20)
    assert single.state["tick"] == many.state["tick"]
    np.testing.assert_allclose(many.state["hands"], single.state["hands"], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(
        many.state["mode_covariances"], single.state["mode_covariances"], rtol=1e-9, atol=1e-15
    )


def test_pause_of_minutes_keeps_position() -> None:
    """In that time the covariance of the motion model overflows."""
    hands = Hands()
    follow(hands, reach, until_s=1.5)
    before = hands.state["hands"][LEFT, 0].copy()
    hands.intake.advance(hands.state, round(300.0 / PERIOD_S))
    np.testing.assert_array_equal(hands.state["hands"][LEFT], [before, np.zeros(3), np.zeros(3)])


def test_covariances_stay_positive() -> None:
    """Covariances stay symmetric and positive and probabilities sum to one."""
    hands = Hands()
    random = np.random.default_rng(3)
    for tick in range(3000):
        hands.advance()
        if tick % 7 == 0:
            position_m = random.choice([0.0, 0.05, 0.3]) + random.normal(
                0.0, random.choice([0.0, 0.01]), 3
            )
            hands.hand(tick + 1, tuple(position_m.tolist()))
    state = hands.state
    for mode, whole in enumerate(state["mode_covariances"][LEFT]):
        covariance = whole if mode == REST else whole[:3, :3]
        np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9)
        assert np.linalg.eigvalsh(covariance).min() > 0
    assert state["mode_probabilities"][LEFT].sum() == pytest.approx(1.0)
    assert (state["mode_probabilities"][LEFT] > 0).all()
    assert LEAST_NOISE_M**2 <= state["noise_variance"][LEFT] < math.inf
    assert np.isfinite(state["hands"]).all()


def shaking(hz: float, size_m: float, speed: float) -> tuple[Vector, Vector]:
    """Deviation of position [m] and velocity [m/s], (T, 3) each, of the estimate from a hand that
    moves evenly along y and shakes along x at a frequency, in the last 3 s of 6.
    """
    noise = np.random.default_rng(11).normal(0.0, 0.0005, (601, 3))
    x = np.array([1.0, 0.0, 0.0])
    motion = np.array([0.0, speed, 0.0])
    states = follow(
        Hands(),
        lambda t: motion * t + size_m * np.sin(2 * np.pi * hz * t) * x,
        until_s=6.0,
        noise=noise,
    )[1500:]
    times = PERIOD_S * np.arange(1500, 1500 + len(states))
    return states[:, 0] - times[:, None] * motion, states[:, 1] - motion


def part_at(hz: float, deviation: Vector) -> float:
    """Amplitude of the component of a deviation (T, 3) at a frequency."""
    waves = np.exp(2j * np.pi * hz * PERIOD_S * np.arange(len(deviation)))
    return float(
        np.linalg.norm(2.0 * (deviation - deviation.mean(axis=0)).T @ waves / len(deviation))
    )


@pytest.mark.parametrize("hz", [4.0, 4.4, 5.0, 6.0, 8.0, 10.0, 12.0])
def test_slow_tremor_at_rest_is_removed(hz: float) -> None:
    """The estimated hand rests."""
    position, velocity = shaking(hz, 0.002, 0.0)
    assert part_at(hz, position) < 0.0002
    assert np.sqrt(np.mean(np.sum(velocity**2, axis=1))) < 0.003


@pytest.mark.parametrize(("size_m", "speed"), [(0.003, 0.1), (0.002, 0.25)])
@pytest.mark.parametrize("hz", [4.0, 4.4, 5.0, 6.0, 9.1, 13.0])
def test_tremor_hardly_ripples_velocity(hz: float, size_m: float, speed: float) -> None:
    _, velocity = shaking(hz, size_m, speed)
    assert part_at(hz, velocity) < 0.15 * 2 * np.pi * hz * size_m


@pytest.mark.parametrize(("rate_hz", "noise_m"), [(30, 0.002), (100, 0.0005)])
@pytest.mark.parametrize("unseen_s", [0.1, 0.2, 0.4])
def test_unseen_hand_at_rest_does_not_dart(rate_hz: int, noise_m: float, unseen_s: float) -> None:
    """The hand disappears for a moment."""
    hands = Hands()
    still = np.array([0.5, 0.0, 0.2])
    random = np.random.default_rng(9)
    follow(
        hands,
        lambda t: still,
        until_s=4.0,
        rate_hz=rate_hz,
        noise=random.normal(0.0, noise_m, (4 * rate_hz, 3)),
    )
    hands.advance(round(unseen_s / PERIOD_S))
    fastest = 0.0
    for k in range(rate_hz):
        stamp_ns = round(1e9 * (5.0 + unseen_s + k / rate_hz))
        hands.hand(stamp_ns, tuple((still + random.normal(0.0, noise_m, 3)).tolist()))
        fastest = max(fastest, float(np.linalg.norm(hands.state["hands"][LEFT, 1])))
        hands.advance(round(1.0 / rate_hz / PERIOD_S))
    assert fastest < 0.01


@pytest.mark.parametrize("speed", [0.0, 0.002, 0.005, 0.02])
@pytest.mark.parametrize("rate_hz", [30, 100, 240])
def test_a_slow_hand_goes_on_evenly(rate_hz: int, speed: float) -> None:
    noise = np.random.default_rng(7).normal(0.0, 0.0005, (8 * rate_hz, 3))
    states = follow(
        Hands(),
        lambda t: np.array([speed * t, 0.0, 0.0]),
        until_s=8.0,
        rate_hz=rate_hz,
        noise=noise,
    )[1500:]
    assert states[:, 1, 0].std() < 0.001
    assert states[:, 1, 0].mean() == pytest.approx(speed, abs=1e-3)


@pytest.mark.parametrize("rate_hz", [100, 334, 500])
def test_quickest_reaches_are_not_lost(rate_hz: int) -> None:
    """The hand moves there and back at 1.5 m/s, in a third of a second each; no motion model
    describes such a reach.
    """

    def hand(t: float) -> Vector:
        turns, u = divmod(t / 0.32, 1.0)
        progress = u**3 * (10 - 15 * u + 6 * u * u)
        return np.array([0.257 * (1.0 - progress if turns % 2 else progress), 0.0, 0.0])

    states = follow(Hands(), hand, until_s=2.0, rate_hz=rate_hz)
    truth_m = np.array([hand(PERIOD_S * tick) for tick in range(len(states))])
    assert np.linalg.norm(states[:, 0] - truth_m, axis=1).max() < (
        0.02 if rate_hz == 100 else 0.014
    )


# --- hands that rest ---


HZ = 125


def rest_of(along: Vector, hz: int = HZ) -> Vector:
    """The rest (T,) of a left hand with these speeds (T,) [m/s] along x; the right hand does not
    move.
    """
    velocities = np.zeros((len(along), 6))
    velocities[:, 0] = along
    stillness = stillness_of(velocities, 1.0 / hz)
    np.testing.assert_array_equal(stillness[:, 1], 1.0)
    return stillness[:, 0]


@pytest.mark.parametrize("tremor_m", [0.0005, 0.0012])
def test_a_hand_that_trembles_rests(tremor_m: float) -> None:
    t = np.arange(0.0, 3.0, 1.0 / HZ)
    for hz in (8.0, 9.3, 12.0):
        speed = 2 * np.pi * hz * np.sqrt(2) * tremor_m * np.cos(2 * np.pi * hz * t)
        assert rest_of(speed).min() > 0.9


@pytest.mark.parametrize("hz", [25, 125, 500])
def test_rest_ends_at_once_and_begins_slowly(hz: int) -> None:
    """The tracker's rate does not matter."""
    speed = np.concatenate([np.zeros(hz), np.full(hz, 0.3), np.zeros(hz)])
    stillness = rest_of(speed, hz)
    assert stillness[hz - 1] == 1.0
    assert stillness[hz + round(0.12 * hz)] < 0.1
    assert stillness[2 * hz + round(0.1 * hz)] < 0.1
    assert 0.3 < stillness[2 * hz + round(0.4 * hz)] < 0.8
    assert stillness[-1] > 0.9
