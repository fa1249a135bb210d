"""The lag that `thirdhand doctor` measures, on simulated servos whose lag is known."""

from __future__ import annotations

import numpy as np
import pytest

from thirdhand.cli.arm_lag import Lag, lag

NAMES = ("a", "b", "c")
SERVOS = ("delay", "servo")
LAGS_MS = (0, 20, 50, 100)
PERIOD_S = 0.002


def followed(commanded: np.ndarray, lag_s: float) -> np.ndarray:
    """The joints (N, J) of a critically damped servo without velocity feedforward, kv / kp = lag:
    acceleration = kp (command - position) - kv velocity.
    """
    if not lag_s:
        return commanded.copy()
    kp = 4.0 / lag_s**2
    kv = 4.0 / lag_s
    measured = np.empty_like(commanded)
    velocity = np.zeros(commanded.shape[1])
    position = commanded[0].copy()
    for i, target in enumerate(commanded):
        measured[i] = position
        velocity += PERIOD_S * (kp * (target - position) - kv * velocity)
        position += PERIOD_S * velocity
    return measured


def simulated(
    servo: str, lag_s: float, *, state_hz: float = 500.0, noise_rad: float = 0.0, seed: int = 0
) -> Lag | None:
    """The lag that is measured in 3 s of joints on smooth paths, behind a pure delay or a servo."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 5.0, PERIOD_S)
    commanded = np.zeros((len(times), len(NAMES)))
    for frequency_hz in (0.2, 0.35, 0.6):
        commanded += rng.uniform(-0.3, 0.3, 3) * np.sin(
            2 * np.pi * frequency_hz * times[:, None] + rng.uniform(0, 6, 3)
        )
    if servo == "delay":
        measured = np.column_stack(
            [np.interp(times - lag_s, times, column) for column in commanded.T]
        )
    else:
        measured = followed(commanded, lag_s)
    measured += np.array([0.02, -0.01, 0.0])  # constant errors caused by gravity
    window = times >= 2.0
    every = round(1 / (state_hz * PERIOD_S))

    def arrived(
        values: np.ndarray, step: int, noise_rad: float
    ) -> dict[str, list[tuple[float, float]]]:
        stamps_s = times[window][::step] + rng.uniform(0, 0.0015, len(times[window][::step]))
        noisy = values[window][::step] + rng.normal(0, noise_rad, (len(stamps_s), 3))
        return {
            name: list(zip(stamps_s.tolist(), noisy[:, i].tolist(), strict=True))
            for i, name in enumerate(NAMES)
        }

    return lag(arrived(commanded, 1, 0.0), arrived(measured, every, noise_rad))


@pytest.mark.parametrize("lag_ms", LAGS_MS)
@pytest.mark.parametrize("servo", SERVOS)
@pytest.mark.parametrize(
    ("state_hz", "noise_rad"), [(500, 0.0), (500, 0.001), (50, 0.001), (100, 0.003)]
)
@pytest.mark.one_case
def test_the_lag_of_a_servo_is_measured(
    servo: str, lag_ms: int, state_hz: float, noise_rad: float
) -> None:
    """Within 1 ms; a servo is late by up to 2 % less than its constant at these frequencies."""
    errors_ms = []
    for seed in range(3):
        estimate = simulated(
            servo, lag_ms / 1000, state_hz=state_hz, noise_rad=noise_rad, seed=seed
        )
        assert estimate is not None
        errors_ms.append(1000 * estimate.lag_s - lag_ms)
    assert max(errors_ms) < 1.0
    assert min(errors_ms) > -1.0 - (0.02 * lag_ms if servo == "servo" else 0.0)


def test_a_continuous_joint_may_wrap() -> None:
    times = np.arange(0.0, 4.0, PERIOD_S)
    path = 3.0 + 0.4 * np.sin(2 * times)
    late = 3.0 + 0.4 * np.sin(2 * (times - 0.05))
    wrapped = (late + np.pi) % (2 * np.pi) - np.pi
    pairs = [list(zip(times.tolist(), values.tolist(), strict=True)) for values in (path, wrapped)]
    estimate = lag({"a": pairs[0]}, {"a": pairs[1]})
    assert estimate is not None
    assert estimate.lag_s == pytest.approx(0.05, abs=0.001)
