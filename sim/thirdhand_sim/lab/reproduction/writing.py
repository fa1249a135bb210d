"""Handwritten letters as demonstrations: a kinematic model of handwriting with human variability,
and letters recorded by others.

The model: a pen passes through the targets of a letter on a smooth curve, at a speed that falls
with the curvature's cube root (the two-thirds power law: Lacquaniti, Terzuolo, Viviani 1983) and
rises from and falls to rest at the ends. Repetitions vary in each target, in the whole letter's
size, slant and position, and in the tempo along it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from thirdhand_sim.lab.results import Array, ExperimentError

DURATION_S = 2.0
LETTER_SAMPLES = 200
TIMES = np.linspace(0.0, DURATION_S, LETTER_SAMPLES)
DEMONSTRATED_LETTERS = 5

# Targets of the pen [cm], in the order of writing.
TARGETS: dict[str, list[tuple[float, float]]] = {
    "B": [
        (-4, -8),
        (-4, 0),
        (-4, 8),
        (1, 7.5),
        (3, 4.5),
        (1, 1.2),
        (-3, 0.3),
        (1.5, -0.6),
        (4, -4),
        (1.5, -7.4),
        (-4, -8),
    ],
    "C": [(5, 5.5), (2, 8), (-2.5, 6.5), (-5, 0), (-2.5, -6.5), (2, -8), (5.2, -5.5)],
    "D": [(-4, -8), (-4, 0), (-4, 8), (1.5, 7), (5, 0), (1.5, -7), (-4, -8)],
    "G": [(5, 5.5), (1.5, 8), (-3, 6), (-5, 0), (-3, -6), (1.5, -8), (5, -5), (5, -0.5), (1, -0.5)],
    "J": [(-2, 8), (2.5, 8), (3.4, 3), (3.2, -4), (0.5, -8), (-3, -6.5), (-4, -3.5)],
    "R": [
        (-4, -8),
        (-4, 0),
        (-4, 8),
        (1, 7.5),
        (3.2, 4.2),
        (1, 0.8),
        (-3, 0.2),
        (0.5, -3),
        (5, -8),
    ],
    "S": [
        (4.5, 6),
        (1, 8),
        (-3.5, 6.3),
        (-3.2, 2.4),
        (0.5, 0),
        (4, -3),
        (3, -7),
        (-1, -8),
        (-4.8, -5.8),
    ],
    "W": [
        (-7, 8),
        (-5.2, 0),
        (-3.5, -8),
        (-1.6, -1),
        (0, 5),
        (1.6, -1),
        (3.5, -8),
        (5.2, 0),
        (7, 8),
    ],
}
TARGET_STD_CM = 0.35
PLACE_STD_CM = 0.3
SIZE_STD = 0.04
SLANT_STD = 0.04
TEMPO_STD = 0.05
SMALLEST_CURVATURE = 0.05  # [1/cm] below this curvature the pen's speed is constant
STARTING_SHARE = 0.12  # share of the path on which the pen accelerates


def write(letter: str, *, count: int = DEMONSTRATED_LETTERS, seed: int) -> Array:
    """Demonstrations (count, 200, 2) [cm] of a letter at even times, 0 to 2 s, from the model."""
    random = np.random.default_rng([seed, ord(letter)])
    return np.stack(
        [_written(np.array(TARGETS[letter], dtype=np.float64), random) for _ in range(count)]
    )


def _written(targets: Array, random: np.random.Generator) -> Array:
    targets = targets + TARGET_STD_CM * random.standard_normal(targets.shape)
    slant = np.array([[1.0, SLANT_STD * random.standard_normal()], [0.0, 1.0]])
    targets = (
        1 + SIZE_STD * random.standard_normal()
    ) * targets @ slant.T + PLACE_STD_CM * random.standard_normal(2)
    chords = np.concatenate(
        [[0.0], np.cumsum(np.sqrt(np.linalg.norm(np.diff(targets, axis=0), axis=1)))]
    )
    spline = CubicSpline(chords / chords[-1], targets)
    u = np.linspace(0.0, 1.0, 2001)
    d = spline(u, 1)
    dd = spline(u, 2)
    rate = np.linalg.norm(d, axis=1)
    curvature = np.abs(d[:, 0] * dd[:, 1] - d[:, 1] * dd[:, 0]) / rate**3
    travel_cm = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(u))])
    share = travel_cm / travel_cm[-1]
    ends = np.sqrt(np.minimum(1.0, (np.minimum(share, 1 - share) + 0.002) / STARTING_SHARE))
    speed = ends * np.maximum(curvature, SMALLEST_CURVATURE) ** (-1 / 3)
    times = np.concatenate(
        [[0.0], np.cumsum(np.diff(travel_cm) * (1 / speed[1:] + 1 / speed[:-1]) / 2)]
    )
    knots = np.linspace(0.0, 1.0, 6)
    warp = np.cumsum(np.concatenate([[0.0], np.exp(TEMPO_STD * random.standard_normal(5))]))
    warped_s = PchipInterpolator(knots, warp / warp[-1])(times / times[-1]) * DURATION_S
    return np.asarray(spline(np.interp(TIMES, warped_s, u)))


def recorded(folder: Path, *, count: int = DEMONSTRATED_LETTERS) -> dict[str, Array]:
    """The letters in a folder, each (count, 200, 2) [cm], even in time from 0 to 2 s:

    X.npz with demo00, demo01, ... Raises ExperimentError.
    """
    files = sorted(folder.glob("?.npz"))
    if not files:
        raise ExperimentError(
            f"No letters in {folder}: files X.npz with arrays demo00, demo01, ... (T, 2) [cm] are "
            "needed."
        )
    letters = {}
    for file in files:
        with np.load(file, allow_pickle=False) as arrays:
            names = sorted(name for name in arrays.files if name.startswith("demo"))[:count]
            if len(names) < count:
                raise ExperimentError(
                    f"{file} holds {len(names)} demonstrations; {count} are needed."
                )
            letters[file.stem] = np.stack(
                [_resampled(np.asarray(arrays[name], dtype=np.float64)) for name in names]
            )
    return letters


def _resampled(points: Array) -> Array:
    times = np.linspace(0.0, DURATION_S, len(points))
    return np.stack([np.interp(TIMES, times, points[:, axis]) for axis in range(2)], axis=1)
