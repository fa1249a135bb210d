"""Demonstrations of a letter by hand, which the scripts of the gallery share."""

import numpy as np
from scipy.interpolate import CubicSpline

PEN_CM = [(4, 6), (0, 8), (-4, 5), (0, 0), (4, -4), (0, -8), (-4, -6)]  # along the letter S
TIMES = np.linspace(0, 2, 100)[:, None]  # (T, 1) [s]


def demonstrations(count=5):
    """The letter S, written `count` times: pairs of times (T, 1) [s] and positions (T, 2) [cm]."""
    random = np.random.default_rng(0)
    scatter_cm = 0.5 * random.normal(size=(count, len(PEN_CM), 2))
    paths = [CubicSpline(np.linspace(0, 2, len(PEN_CM)), PEN_CM + shift) for shift in scatter_cm]
    return [(TIMES, path(TIMES[:, 0])) for path in paths]
