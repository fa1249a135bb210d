"""Jumps of a tracker are found in synthetic hands whose truth is known; quick motion is kept."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from thirdhand_sim.lab.people.tracker_jumps import repair
from thirdhand_sim.lab.results import Array

WAY = np.array([0.6, 0.64, 0.48])
# rate, noise [m]
TRACKERS = {
    "24 Hz": (24.0, 0.0002),
    "30 Hz": (30.0, 0.002),
    "120 Hz": (120.0, 0.0003),
}
Position = Callable[[Array], Array]


def eased(u: Array) -> Array:
    """A minimum-jerk reach of length 1 within u from 0 to 1."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u**3 * (10 - 15 * u + 6 * u * u))


def reach(length_m: float, speed_mps: float) -> Position:
    return lambda t: length_m * eased(t * speed_mps / (1.875 * length_m))


def out_and_back(length_m: float, speed_mps: float) -> Position:
    lasts_s = 1.875 * length_m / speed_mps
    return lambda t: length_m * (eased(t / lasts_s) - eased(t / lasts_s - 1))


PATHS: dict[str, Position] = {
    "rest": np.zeros_like,
    "reach at 1 m/s": reach(0.5, 1.0),
    "reach at 2 m/s": reach(0.5, 2.0),
    "short reach at 2 m/s": reach(0.2, 2.0),
    "out and back at 2 m/s": out_and_back(0.3, 2.0),
    "flick": out_and_back(0.05, 1.0),
    "tremor": lambda t: 0.002 * np.sin(2 * np.pi * 8 * t),
    "shaking": lambda t: 0.02 * (1 - np.cos(2 * np.pi * 4 * np.clip(t, 0, 1))),
}


def hands(path: Position, tracker: str, seed: int) -> tuple[Array, Array, Array]:
    """Times, the true hands, and the samples of a tracker that makes no mistake. The right hand
    rests 0.3 m beside the left one.
    """
    rate_hz, noise_m = TRACKERS[tracker]
    random = np.random.default_rng(seed)
    t = np.arange(-0.45, 0.9, 1 / rate_hz) + random.uniform(0, 1 / rate_hz)
    true = np.hstack([path(t)[:, None] * WAY, np.tile([0.0, -0.3, 0.0], (len(t), 1))])
    return t, true, true + noise_m * random.standard_normal(true.shape)


def off_mm(found: Array, true: Array) -> float:
    """The largest distance of a hand from its truth."""
    return 1000 * float(np.linalg.norm((found - true).reshape(-1, 2, 3), axis=2).max())


@pytest.mark.parametrize("tracker", TRACKERS)
@pytest.mark.parametrize("name", PATHS)
@pytest.mark.one_case
def test_quick_true_motion_is_not_touched(name: str, tracker: str) -> None:
    for seed in range(2):
        t, _, tracked = hands(PATHS[name], tracker, seed)
        repaired = repair(t, tracked)
        assert not repaired.wrong.any()
        assert not repaired.exchanged.any()
        np.testing.assert_array_equal(repaired.hands, tracked)


@pytest.mark.parametrize("tracker", TRACKERS)
@pytest.mark.parametrize("name", ["rest", "reach at 1 m/s", "reach at 2 m/s"])
@pytest.mark.parametrize(
    "offsets_mm", [(60,), (68, 80), (70, 70, 70), (70, 70, 70, 70, 70), (150, -60, 90)]
)
@pytest.mark.one_case
def test_jumps_are_taken_out_of_the_truth(
    name: str, tracker: str, offsets_mm: tuple[int, ...]
) -> None:
    for seed, begin_s in enumerate((-0.1, 0.2)):
        t, true, tracked = hands(PATHS[name], tracker, seed)
        begin = int(np.searchsorted(t, begin_s))
        clean_mm = off_mm(tracked, true)
        run = slice(begin, begin + len(offsets_mm))
        tracked[run, :3] += np.array(offsets_mm)[:, None] / 1000 * np.array([0.0, -0.8, 0.6])
        repaired = repair(t, tracked)
        wrong = np.zeros((len(t), 2), bool)
        wrong[run, 0] = True
        np.testing.assert_array_equal(repaired.wrong, wrong)
        # An unseen quarter of a second of a reach at 2 m/s is reconstructed to 14 mm.
        assert off_mm(repaired.hands, true) < clean_mm + (
            14 if t[run][-1] - t[run][0] > 0.12 else 5
        )


@pytest.mark.parametrize("tracker", TRACKERS)
@pytest.mark.parametrize("samples", [1, 3, 5, 15])
def test_exchanged_hands_are_put_right(samples: int, tracker: str) -> None:
    t, true, tracked = hands(PATHS["reach at 2 m/s"], tracker, seed=5)
    begin = int(np.searchsorted(t, 0.1))
    clean_mm = off_mm(tracked, true)
    run = slice(begin, begin + samples)
    tracked[run] = np.roll(tracked[run], 3, axis=1)
    repaired = repair(t, tracked)
    assert np.flatnonzero(repaired.exchanged).tolist() == list(range(len(t)))[run]
    assert not repaired.wrong.any()
    assert off_mm(repaired.hands, true) == pytest.approx(clean_mm)
