"""People made of recorded hands: their reaches warped to the paths of a scene, and their tracker's
noise. Only for choosing parameters.

Recordings are `.npz` files with `time_s` (T,), `left` and `right` (T, 3) [m].
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfiltfilt

from thirdhand_sim.lab.people.moving_hands import hands_in
from thirdhand_sim.lab.results import Array, ExperimentError
from thirdhand_sim.people import Person, TrackerModel, person
from thirdhand_sim.sessions import SHAPE_STEPS

# a reach lies between slow moments, and is at least this long
RECORDED_SLOW_MPS = 0.05
LEAST_REACH_M = 0.06
MOST_UNEVEN = 5.0  # largest ratio of a reach's highest speed to its mean speed
FIRST_NUMBER = 100  # first seed of their other habits; no modelled person has these seeds


def recorded_people(folder: Path) -> list[Person]:
    """One person for each recording of a folder that has reaches. Raises ExperimentError."""
    files = sorted(folder.glob("*.npz"))
    people = [
        one
        for number, path in enumerate(files)
        if (one := _of_file(path, FIRST_NUMBER + number)) is not None
    ]
    if not people:
        raise ExperimentError(
            f"no recorded hands in {folder}: .npz files with time_s, left and right needed"
        )
    return people


def _of_file(path: Path, number: int) -> Person | None:
    t, hands, cut_hz = hands_in(path)
    rate = 1 / float(np.mean(np.diff(t)))
    sos = butter(4, cut_hz, fs=rate, output="sos")
    smooth = np.asarray(sosfiltfilt(sos, hands, axis=0))
    reaches = [reach for side in (0, 3) for reach in _reaches(smooth[:, side : side + 3], rate)]
    if not reaches:
        return None
    tracker = TrackerModel(rate_hz=rate, residual=hands - smooth, dropouts_hz=0.05)
    return person("tuning", number)._replace(
        name=f"recorded {number}", tracker=tracker, shapes=reaches
    )


def _reaches(x: Array, rate_hz: float) -> list[tuple[Array, Array]]:
    """Reaches in a hand's path (T, 3) [m]: covered shares (M,) of the straight line along x, and
    deviations from it (M, 3) per metre.
    """
    speed = np.linalg.norm(np.gradient(x, 1 / rate_hz, axis=0), axis=1)
    moving = np.flatnonzero(
        np.diff(np.concatenate([[0], (speed > RECORDED_SLOW_MPS).astype(int), [0]]))
    )
    out = []
    for begin, end in moving.reshape(-1, 2):
        part = x[begin:end]
        chord = part[-1] - part[0]
        length = float(np.linalg.norm(chord))
        if length < LEAST_REACH_M:
            continue
        along = chord / length
        side = np.cross([0.0, 0.0, 1.0], along)
        side /= max(float(np.linalg.norm(side)), 1e-9)
        u = np.linspace(0, len(part) - 1, SHAPE_STEPS)
        local = (part - part[0]) @ np.stack([along, side, np.cross(along, side)], axis=1) / length
        local = np.stack([np.interp(u, np.arange(len(part)), column) for column in local.T], axis=1)
        eased = np.linspace(0, 1, SHAPE_STEPS)
        # recorded parts begin and end at SLOW_MPS, not at 0
        eased = eased**3 * (10 - 15 * eased + 6 * eased * eased)
        local = np.stack(
            [np.interp(eased, np.linspace(0, 1, SHAPE_STEPS), column) for column in local.T], axis=1
        )
        if (
            np.abs(np.gradient(local[:, 0])).max() * SHAPE_STEPS <= MOST_UNEVEN
            and np.abs(local).max() < 1.2
        ):
            out.append((local[:, 0], local * (0.0, 1.0, 1.0)))
    return out
