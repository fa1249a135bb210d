"""Demonstrations for tests of kmp: over time, over two inputs, over two hands in space."""

import numpy as np


def driven_by_hands(seed=0, count=4):
    """Two inputs on a long path; only the first one matters, the second one jitters."""
    random = np.random.default_rng(seed)
    demonstrations = []
    for _ in range(count):
        t = np.linspace(0, 1, 80)
        s = np.stack([t + 0.01 * random.normal(size=80), 0.3 * random.normal(size=80)], axis=1)
        xi = np.stack([np.sin(5 * s[:, 0]), np.cos(4 * s[:, 0])], axis=1)
        demonstrations.append((s, xi + 0.01 * random.normal(size=(80, 2))))
    return demonstrations


def over_time(velocity=False):
    random = np.random.default_rng(0)
    t = np.linspace(0, 2, 80)
    paths = [
        np.stack([np.sin(3 * t), np.cos(2 * t)], axis=1) + 0.03 * random.normal(size=2)
        for _ in range(3)
    ]
    return [
        (t[:, None], np.hstack([p, np.gradient(p, t, axis=0)]) if velocity else p) for p in paths
    ]


def two_hands(seed, demonstrations=6, offset=0.0):
    """Demonstrations: both hands' positions (100, 6) along a curve, a tool (100, 2) that moves with
    them, with an offset in each demonstration.
    """
    random = np.random.default_rng(seed)
    t = np.linspace(0, 1, 100)[:, None]
    phases = random.uniform(0, 2 * np.pi, (3, 6))
    sizes = random.uniform(0.3, 1.0, (3, 6))
    directions = random.normal(size=(6, 6)) / 2
    turns = random.uniform(0, 6, 6)
    weights = random.normal(size=(6, 2))
    takes = []
    for _ in range(demonstrations):
        shifts = phases + 0.15 * random.normal(size=(3, 6))
        hands = sum(sizes[k] / (k + 1) * np.sin((k + 1) * np.pi * t + shifts[k]) for k in range(3))
        takes.append(
            (hands, np.sin(hands @ directions.T + turns) @ weights + offset * random.normal(size=2))
        )
    return takes


def off(mean, wanted):
    """The root mean square error divided by the deviation of the wanted values."""
    return np.sqrt(np.mean((mean - wanted) ** 2)) / wanted.std()
