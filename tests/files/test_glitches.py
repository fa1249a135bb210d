"""A tracker's glitch costs only its own samples, none before or after it."""

from __future__ import annotations

import numpy as np
import pytest

from thirdhand.contract.messages import BASE
from thirdhand.settings.config import Settings
from thirdhand.workbench.takes.track import Track
from thirdhand.workbench.takes.track_check import checked

RATE_HZ = 25
LASTS_S = 12.0


def track(seed: int) -> Track:
    """A hand that reaches back and forth with rests, and a tracker's noise."""
    random = np.random.default_rng(seed)
    seconds = np.arange(0.0, LASTS_S, 1.0 / RATE_HZ)
    share = np.clip((np.abs((seconds % 6.0) - 3.0) - 1.0) / 1.0, 0.0, 1.0)[:, None]
    poses = np.zeros((len(seconds), 7))
    poses[:, :3] = (0.6, 0.1, 0.2) + share**3 * (10 - 15 * share + 6 * share**2) * np.array(
        (0.2, -0.1, 0.15)
    )
    poses[:, :3] += random.normal(0.0, 0.002, (len(seconds), 3))
    poses[:, 6] = 1.0
    stamps_ns = np.round(1e9 * (1.0 + seconds)).astype(np.int64)
    return Track("hands/left", "hands/left", stamps_ns, stamps_ns, poses, BASE)


@pytest.mark.parametrize(
    ("length", "far_m"), [(1, 0.03), (1, 0.16), (2, 0.05), (2, 0.16), (3, 0.05)]
)
def test_one_to_three_samples_that_are_off_cost_no_others(length: int, far_m: float) -> None:
    for seed in range(8):
        whole = track(seed)
        random = np.random.default_rng([seed, length])
        poses = whole.poses.copy()
        direction = random.normal(size=3)
        begin = int(random.integers(20, len(poses) - 40))
        rows = slice(begin, begin + length)
        poses[rows, :3] += (
            far_m * direction / np.linalg.norm(direction) * np.linspace(0.5, 1.0, length)[:, None]
        )
        (result,) = checked([whole._replace(poses=poses)], Settings(), longest_s=0.25)
        assert result.poses - len(result.track.poses) <= length + 1
        assert not result.stretches
        assert result.rejected <= length + 1
