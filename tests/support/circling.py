"""Takes of a tool that circles with the hands: a linear function of them plus a small lift."""

from __future__ import annotations

import numpy as np

from thirdhand.skills.demonstration import Demonstration

RATE_HZ = 50
LASTS_S = 12.0
RADIUS_M = 0.12
GOES = np.array(
    [
        [0.6, 0.2, 0.0, 0.4, -0.2, 0.0],
        [-0.2, 0.6, 0.0, 0.2, 0.4, 0.0],
        [0.0, 0.0, 0.5, 0.0, 0.0, 0.5],
    ]
)
"""By how much the tool goes with the hands."""


def circling(seed: int, *, apart_m: float = 0.1, noise_m: float = 0.001) -> Demonstration:
    """A take by a person of this seed: both hands circle about a centre that differs by about
    `apart_m` between takes. The tool circles between the hands, and is lifted twice a round by 1
    cm. The tracker has white noise with standard deviation `noise_m` on each axis.
    """
    random = np.random.default_rng(seed)
    t = np.arange(0.0, LASTS_S, 1.0 / RATE_HZ)
    angle = 2 * np.pi * (0.25 + 0.02 * random.normal()) * t + random.uniform(0, 2 * np.pi)
    radius = RADIUS_M * (1 + 0.08 * random.normal())
    centre = [0.5, 0.0, 0.3] + apart_m * random.normal(size=3)
    hands = []
    for side, late in ((0.2, 0.0), (-0.2, 0.4)):
        circle = radius * np.stack(
            [np.cos(angle + late), np.sin(angle + late), np.zeros_like(t)], axis=1
        )
        sway = np.stack([np.sin(0.7 * t + phase) for phase in random.uniform(0, 6, 3)], axis=1)
        hands.append(centre + [0.0, side, 0.0] + circle + 0.01 * sway)
    tool = np.hstack(hands) @ GOES.T + [0.0, 0.0, 0.1] + 0.005 * random.normal(size=3)
    tool[:, 2] += 0.01 * np.sin(2 * angle)
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    poses = [
        np.hstack([positions + noise_m * random.normal(size=positions.shape), turn])
        for positions in (*hands, tool)
    ]
    return Demonstration(np.round(1e9 * t).astype(np.int64), *poses)
