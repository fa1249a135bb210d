"""People made of recorded hands: their reaches warped to the ways of a scene, and their tracker's
noise as it was. For choosing parameters only.

Recordings are `.npz` files with `time_s` (T,), `left` and `right` (T, 3) [m].
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfiltfilt

from service.contract.explain import in_words
from sim.experiments.moving_hands import CAMERA_AXES, CUT_HZ, NOISY_CUT_HZ, NOISY_HZ
from sim.experiments.results import Array, ExperimentError
from sim.people import Person, TrackerModel, person
from sim.sessions import SHAPE_STEPS

SLOW_MPS, LEAST_REACH_M = 0.05, 0.06  # a reach is what lies between slow moments, and as long as this
MOST_UNEVEN = 5.0  # a reach's greatest speed over its mean one: beyond it, it is none
FIRST_NUMBER = 100  # of these people: their other habits are those of no other


def recorded_people(folder: Path) -> list[Person]:
    """One person for each recording of a folder with any reaches in it. Raises ExperimentError."""
    files = sorted(folder.glob("*.npz"))
    people = [one for number, path in enumerate(files) if (one := _of_file(path, FIRST_NUMBER + number)) is not None]
    if not people:
        raise ExperimentError(f"no recorded hands in {folder}: .npz files with time_s, left and right needed")
    return people


def _of_file(path: Path, number: int) -> Person | None:
    try:
        with np.load(path, allow_pickle=False) as data:
            t, left, right = (np.asarray(data[name], np.float64) for name in ("time_s", "left", "right"))
    except (KeyError, ValueError, OSError) as error:
        raise ExperimentError(f"{path}: not a recording of hands: {in_words(error, named=False)}") from None
    rate = 1 / float(np.mean(np.diff(t)))
    noisy = rate < NOISY_HZ
    axes = CAMERA_AXES if noisy else np.eye(3)
    hands = np.hstack([left @ axes.T, right @ axes.T])
    sos = butter(4, NOISY_CUT_HZ if noisy else CUT_HZ, fs=rate, output="sos")
    smooth = np.asarray(sosfiltfilt(sos, hands, axis=0))
    reaches = [one for side in (0, 3) for one in _reaches(smooth[:, side : side + 3], rate)]
    if not reaches:
        return None
    tracker = TrackerModel(rate_hz=rate, residual=hands - smooth, dropouts_hz=0.05)
    return person("tuning", number)._replace(name=f"recorded {number}", tracker=tracker, shapes=reaches)


def _reaches(x: Array, rate_hz: float) -> list[tuple[Array, Array]]:
    """Shares of the way (M,) and deviations from it (M, 3) a metre, with the way along x, of the
    reaches in a hand's path (T, 3) [m].
    """
    speed = np.linalg.norm(np.gradient(x, 1 / rate_hz, axis=0), axis=1)
    moving = np.flatnonzero(np.diff(np.concatenate([[0], (speed > SLOW_MPS).astype(int), [0]])))
    out = []
    for begin, end in moving.reshape(-1, 2):
        part = x[begin:end]
        way = part[-1] - part[0]
        length = float(np.linalg.norm(way))
        if length < LEAST_REACH_M:
            continue
        along = way / length
        side = np.cross([0.0, 0.0, 1.0], along)
        side /= max(float(np.linalg.norm(side)), 1e-9)
        u = np.linspace(0, len(part) - 1, SHAPE_STEPS)
        local = (part - part[0]) @ np.stack([along, side, np.cross(along, side)], axis=1) / length
        local = np.stack([np.interp(u, np.arange(len(part)), column) for column in local.T], axis=1)
        eased = np.linspace(0, 1, SHAPE_STEPS)
        eased = eased**3 * (10 - 15 * eased + 6 * eased * eased)  # recorded parts begin and end at SLOW_MPS, not at 0
        local = np.stack([np.interp(eased, np.linspace(0, 1, SHAPE_STEPS), column) for column in local.T], axis=1)
        if np.abs(np.gradient(local[:, 0])).max() * SHAPE_STEPS <= MOST_UNEVEN and np.abs(local).max() < 1.2:
            out.append((local[:, 0], local * (0.0, 1.0, 1.0)))
    return out
