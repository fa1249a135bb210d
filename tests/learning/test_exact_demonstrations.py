"""Synthetic demonstrations without noise teach a skill whose gate a tracker's noise does not
trip.
"""

from __future__ import annotations

import numpy as np

from support.circling import circling
from support.skills import at_rest, figures_of
from thirdhand.contract.requests import ViaPoint
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.gate import FLOOR_M
from thirdhand.workbench.learning.learn import learn

NOISE_M = 0.002  # standard deviation of a usual tracker
VIA_POINTS = tuple(
    ViaPoint(name, (x, 0.2, 0.2), (x, -0.2, 0.2), (x, 0.0, 0.4))
    for name, x in (("near", 0.4), ("far", 0.7))
)


def along_a_line(number: int) -> Demonstration:
    """Hands that pass exactly through the via-points at varying speed, and a tool that moves with
    them.
    """
    t = np.arange(0.0, 6.0, 0.02)
    share = np.clip((t - 1.0) / (1.5 + 0.4 * number), 0.0, 1.0)[:, None]
    ways = (
        np.array(point)
        for point in zip(*((p.left, p.right, p.tool) for p in VIA_POINTS), strict=True)
    )
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    poses = [np.hstack([begin + share * (end - begin), turn]) for begin, end in ways]
    return Demonstration(np.round(1e9 * t).astype(np.int64), *poses, via_points=VIA_POINTS)


def test_gate_is_above_noise() -> None:
    """The skill is one of a task between via-points."""
    skill = learn([along_a_line(number) for number in range(3)])
    assert skill.threshold >= FLOOR_M
    random = np.random.default_rng(1)
    hands = along_a_line(0).hands[::10].reshape(-1, 2, 3)
    noisy = [at_rest(skill, pair + NOISE_M * random.normal(size=(2, 3))).gate_m for pair in hands]
    assert max(noisy) < skill.threshold
    warnings = figures_of(skill).warnings
    assert any("less noise than any tracker" in warning for warning in warnings)


def test_covariance_is_above_noise() -> None:
    takes = [
        take._replace(tool=(take.left + take.right) / 2)
        for take in (circling(seed, noise_m=0.0) for seed in range(4))
    ]
    figures = figures_of(learn(takes, points=80))
    assert figures.all.error_mm < 1.0 < figures.all.predicted_mm
    assert figures.gate_mm > 1.0
    text = "; ".join(figures.warnings)
    assert "less noise than any tracker" in text
    assert "a simpler prediction is better" not in text
