"""How much a hand rests: what it does for tremor, departure, arrival and a turn on the way."""

from __future__ import annotations

import numpy as np
import pytest

from service.core.frame import Vector
from service.core.intake.hand_estimator import stillness_of

HZ = 125


def rest_of(along: Vector, hz: int = HZ) -> Vector:
    """The rest (T,) of a left hand that moves so (T,) [m/s] along x; the right one does not."""
    velocities = np.zeros((len(along), 6))
    velocities[:, 0] = along
    found = stillness_of(velocities, 1.0 / hz)
    np.testing.assert_array_equal(found[:, 1], 1.0)
    return found[:, 0]


@pytest.mark.parametrize("tremor_m", [0.0005, 0.0012])
def test_a_hand_that_trembles_rests(tremor_m: float) -> None:
    t = np.arange(0.0, 3.0, 1.0 / HZ)
    for hz in (8.0, 9.3, 12.0):
        speed = 2 * np.pi * hz * np.sqrt(2) * tremor_m * np.cos(2 * np.pi * hz * t)
        assert rest_of(speed).min() > 0.9


@pytest.mark.parametrize("hz", [25, 125, 500])
def test_rest_is_left_at_once_and_comes_slowly_at_any_rate(hz: int) -> None:
    speed = np.concatenate([np.zeros(hz), np.full(hz, 0.3), np.zeros(hz)])
    found = rest_of(speed, hz)
    assert found[hz - 1] == 1.0
    assert found[hz + round(0.12 * hz)] < 0.1
    assert found[2 * hz + round(0.1 * hz)] < 0.1
    assert 0.3 < found[2 * hz + round(0.4 * hz)] < 0.8
    assert found[-1] > 0.9


def test_a_turn_on_the_way_is_no_rest() -> None:
    t = np.arange(0.0, 2.0, 1.0 / HZ)
    speed = 0.2 * np.clip((1.0 - t) / 0.15, -1.0, 1.0)  # turns within 0.3 s
    assert rest_of(speed)[HZ // 2 :].max() < 0.5


def test_a_hand_that_is_carried_slowly_is_on_its_way() -> None:
    assert rest_of(np.full(2 * HZ, 0.08))[-1] < 0.01
    assert rest_of(np.full(2 * HZ, 0.015))[-1] > 0.98
