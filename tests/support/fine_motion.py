"""Takes of a hand that moves by a centimetre and of a tool that moves farther."""

from __future__ import annotations

import math

import numpy as np

from thirdhand.skills.demonstration import Demonstration

# amplitude of the left hand's motion, and the tool's motion as a multiple of it
FINE_M = 0.015
TIMES = 8.0


def fine(seed: int, noise_m: float, way: float = 1.0, *, turned: bool = False) -> Demonstration:
    """A take of the left hand moving by 15 mm, and the tool by 12 cm in the same, the opposite or,
    if `turned`, a perpendicular direction.
    """
    random = np.random.default_rng(seed)
    t = np.arange(0.0, 10.0, 0.02)
    going = 0.5 * np.sin(2 * np.pi * 0.3 * t + random.uniform(0, 6))
    along = np.eye(3)[:1] * going[:, None]
    straight = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    places = (
        [0.5, 0.2, 0.3] + FINE_M * along,
        [0.5, -0.2, 0.3] + 0.0 * along,
        [0.5, 0.0, 0.4] + way * TIMES * FINE_M * along,
    )
    poses = [
        np.hstack([positions + noise_m * random.normal(size=positions.shape), straight])
        for positions in places
    ]
    if turned:
        half = way * math.pi / 4 * going
        poses[2][:, 5] = np.sin(half)
        poses[2][:, 6] = np.cos(half)
    return Demonstration(np.round(1e9 * t).astype(np.int64), *poses)
