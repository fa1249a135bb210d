"""Moving hands for `motion`: recorded ones, modelled ones, sudden stops, and the bench's reaches.

Recordings are `.npz` files with `time_s` or `t` (T,) [s], `left` and `right` (T, 3) [m], NaN where
a hand was not seen; a hand that was never seen rests. Files whose names differ only after the last
underscore are of one person. Recorded hands are moved into the skill's region; their truth is the
recording without the tracker's jumps, low-pass filtered to frequencies of a wrist.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from thirdhand.contract.explain import in_words
from thirdhand_sim.lab.people.tracker_jumps import noise_std_m, repair
from thirdhand_sim.lab.results import Array, ExperimentError
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

PERIOD_S = 0.002
# a tracker below 60 Hz is a camera, and is noisier
NOISY_HZ = 60.0
CUT_HZ = 6.0
NOISY_CUT_HZ = 2.5
PRECISE_M = 0.0004  # [m] noise (standard deviation) of motion capture is below this
# frame base from a camera's axes: x right, y down
CAMERA_AXES = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MOST_SPEED = 1.0  # [m/s] faster motion (99th percentile of a hand's speed) is scaled down
# speed [m/s] before a sudden stop, and duration of the stop [s]
STOP_SPEED = 0.31
STOP_S = 0.08
MOST_LATE_S = 0.06  # largest delay of a wireless tracker's samples
# one hand is not seen at these shares of a recording, for 0.1 to 0.5 s
UNSEEN_AT = (0.3, 0.7)
UNSEEN_S = (0.1, 0.5)
# largest amplitude [m], largest speed of the oscillation [m/s], speed of the drift [m/s]
SMALL_KINDS = {
    "3 mm in a drift of 0.1 m/s": (0.003, math.inf, 0.1),
    "2 mm at rest": (0.002, math.inf, 0.0),
    "20 mm, at most 0.4 m/s": (0.02, 0.4, 0.0),
}
SLOW_S = 3.5  # duration of a slow motion
SLOW_BEGINS_S = 1.0
SLOW_RISE_S = 0.1
# duration, duration of the judged end, duration of the rise at the begin
SMALL_S = 3.5
SMALL_JUDGED_S = 2.0
SMALL_RISE_S = 0.5


@dataclass(frozen=True)
class Moving:
    """One sequence: the truth at 500 Hz (N, 6), and a tracker's stamps (M,) [s] and samples (M, 6),
    both hands [m].
    """

    name: str
    group: str
    truth: Array
    stamps: Array
    samples: Array
    stop_s: float = math.nan  # begin of a sudden stop [s]
    late: Array | None = None  # (M, 2) [s] delay of each hand's samples; inf: they never arrive
    jumping: Array | None = None  # (N, 6) [m] the truth with the tracker's jumps, if there are any
    tracker: str = ""  # kind of tracker of a recording

    @property
    def person(self) -> str:
        """The name of the person."""
        return self.name.rsplit("_", 1)[0]


def recorded(folder: Path, middle: Array) -> list[Moving]:
    """Each recording of a folder in the groups: clean, as recorded, at 30 Hz, clean but late, and
    clean with one hand out of sight twice. Raises ExperimentError.
    """
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise ExperimentError(
            f"no recorded hands in {folder}: .npz files with time_s, left and right needed"
        )
    return [
        sequence for number, path in enumerate(files) for sequence in _of_file(path, middle, number)
    ]


def hands_in(path: Path) -> tuple[Array, Array, float]:
    """A recording: times (T,) [s], both hands (T, 6) [m] in base axes, and the cut-off frequency
    [Hz] of its noise. Raises ExperimentError.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            t = np.asarray(data["t" if "t" in data else "time_s"], np.float64)
            left, right = (
                _seen(t, np.asarray(data[name], np.float64)) for name in ("left", "right")
            )
    except (KeyError, ValueError, OSError) as error:
        raise ExperimentError(
            f"{path}: not a recording of hands: {in_words(error, named=False)}"
        ) from None
    is_camera = 1 / float(np.mean(np.diff(t))) < NOISY_HZ
    axes = CAMERA_AXES if is_camera else np.eye(3)
    return t, np.hstack([left @ axes.T, right @ axes.T]), NOISY_CUT_HZ if is_camera else CUT_HZ


def _of_file(path: Path, middle: Array, number: int) -> list[Moving]:
    t, hands, cut_hz = hands_in(path)
    t = t - t[0]
    rate = 1 / float(np.mean(np.diff(t)))
    repaired = repair(t, hands).hands
    middle_of_hands = np.median(repaired, axis=0)
    hands = hands - middle_of_hands
    repaired = repaired - middle_of_hands
    truth = _smooth(repaired, rate, cut_hz)
    speed = np.linalg.norm(np.gradient(truth.reshape(-1, 2, 3), 1 / rate, axis=0), axis=2).max(
        axis=1
    )
    scale = min(1.0, MOST_SPEED / float(np.percentile(speed, 99)), 0.3 / float(np.abs(truth).max()))
    ticks = np.arange(0.0, t[-1], PERIOD_S)
    spline = CubicSpline(t, middle + scale * truth)
    fine = spline(ticks)
    jumping = CubicSpline(t, middle + scale * _smooth(hands, rate, cut_hz))(ticks)
    name = path.stem
    tracker = tracker_kind(rate, hands)
    random = np.random.default_rng(number)

    def seen(group: str, rate_hz: float, noise: float) -> Moving:
        stamps = np.arange(0.0, t[-1] - PERIOD_S, 1 / rate_hz)
        samples = spline(stamps) + noise * random.standard_normal((len(stamps), 6))
        return Moving(name, group, fine, stamps, samples, tracker=tracker)

    clean = seen("clean", 100, 0.0005)
    return [
        clean,
        Moving(name, "recorded", fine, t, middle + scale * hands, jumping=jumping, tracker=tracker),
        seen("30 Hz, 2 mm", 30, 0.002),
        replace(clean, group="late", late=random.uniform(0.0, MOST_LATE_S, (len(clean.stamps), 2))),
        replace(clean, group="unseen", late=_unseen(clean.stamps, random)),
    ]


def tracker_kind(rate_hz: float, hands: Array) -> str:
    """The kind of the tracker that recorded hands (T, 6) [m]: precise ones are motion capture, slow
    and noisy ones cameras.
    """
    noise_m = max(noise_std_m(hands[:, :3]), noise_std_m(hands[:, 3:]))
    if noise_m < PRECISE_M:
        return "motion capture"
    return "camera" if rate_hz <= NOISY_HZ else "other"


def _unseen(stamps: Array, random: np.random.Generator) -> Array:
    """Delays (M, 2) of samples; those of one hand are missing twice."""
    late = np.zeros((len(stamps), 2))
    for share in UNSEEN_AT:
        begin = stamps[-1] * (share + random.uniform(-0.1, 0.1))
        away = (stamps >= begin) & (stamps < begin + random.uniform(*UNSEEN_S))
        late[away, random.integers(2)] = np.inf
    return late


def _seen(t: Array, hand: Array) -> Array:
    """A hand's path (T, 3), straight where it was not seen; at rest if it was never seen."""
    is_seen = np.isfinite(hand).all(axis=1)
    if not is_seen.any():
        return np.zeros_like(hand)
    return np.stack([np.interp(t, t[is_seen], column[is_seen]) for column in hand.T], axis=1)


def _smooth(x: Array, rate_hz: float, cut_hz: float) -> Array:
    sos = butter(4, cut_hz, fs=rate_hz, output="sos")
    return np.asarray(
        sosfiltfilt(sos, x, axis=0, padlen=min(len(x) - 1, int(3 * rate_hz / cut_hz)))
    )


def modelled(middle: Array, *, numbers: Sequence[int], seconds: float) -> list[Moving]:
    """People modelled after the recordings, seen by the trackers of the groups of `recorded`."""
    out = []
    for number in numbers:
        truth = person(number, middle, seconds)
        times = np.arange(len(truth)) * PERIOD_S
        spline = CubicSpline(times, truth)
        for group, rate_hz, noise, spoilt in (
            ("clean", 100, 0.0005, False),
            ("recorded", 30, 0.002, True),
            ("30 Hz, 2 mm", 30, 0.002, False),
            (
                "60 - 240 Hz, 0.3 - 5 mm",
                (60, 120, 240)[number % 3],
                (0.001, 0.0003, 0.005)[number % 3],
                True,
            ),
        ):
            random = np.random.default_rng([number, rate_hz])
            stamps = np.arange(0.0, times[-1], 1 / rate_hz)
            samples = spline(stamps) + noise * random.standard_normal((len(stamps), 6))
            if spoilt:
                stamps, samples = _spoilt(stamps, samples, rate_hz, random)
            out.append(Moving(f"person {number + 1}", group, truth, stamps, samples))
    return out


def person(seed: int, middle: Array, seconds: float) -> Array:
    """Overlapping reaches with rests and reversals, and sway: both hands (N, 6) [m]."""
    random = np.random.default_rng(seed)
    t = np.arange(round(seconds / PERIOD_S)) * PERIOD_S
    x = np.zeros((len(t), 6))
    for hand in (0, 3):
        start_s = 0.5
        position_m = np.zeros(3)
        before = np.zeros(3)
        while start_s < seconds - 1.5:
            goal = (
                before
                if random.random() < 0.2
                else random.uniform(-0.08, 0.08, 3) * (1.0, 1.0, 0.6)
            )
            before = position_m
            reach_m = goal - position_m
            position_m = goal
            lasts = random.uniform(0.4, 0.8) + 3.5 * float(np.linalg.norm(reach_m))
            u = np.clip((t - start_s) / lasts, 0.0, 1.0)
            x[:, hand : hand + 3] += reach_m * (u**3 * (10 - 15 * u + 6 * u * u))[:, None]
            start_s += lasts * random.uniform(0.7, 1.0) + (
                random.exponential(0.6) if random.random() < 0.5 else 0.0
            )
    sway = sosfiltfilt(
        butter(2, 1.2, fs=1 / PERIOD_S, output="sos"), random.standard_normal((len(t), 6)), axis=0
    )
    return np.asarray(middle + x + 0.004 * sway / sway.std(axis=0))


def _spoilt(
    stamps: Array, samples: Array, rate_hz: float, random: np.random.Generator
) -> tuple[Array, Array]:
    """Stamps and samples with outliers of some centimetres, and dropouts of 30 to 90 ms."""
    samples = samples.copy()
    keep = np.ones(len(stamps), bool)
    for hand in (0, 3):
        hit = random.random(len(stamps)) < 0.002
        samples[hit, hand : hand + 3] += 0.05 * random.standard_normal((int(hit.sum()), 3))
    for begin in np.flatnonzero(random.random(len(stamps)) < 0.03 / rate_hz):
        keep[begin : begin + int(random.uniform(0.03, 0.09) * rate_hz)] = False
    return stamps[keep], samples[keep]


def _tracked(truth: Array, stamps: Array, noise: float, random: np.random.Generator) -> Array:
    """Samples (M, 6) [m] of a truth (N, 6) with the noise of a tracker."""
    t = np.arange(len(truth)) * PERIOD_S
    samples = np.stack([np.interp(stamps, t, column) for column in truth.T], axis=1)
    return samples + noise * random.standard_normal(samples.shape)


def stops(
    middle: Array,
    *,
    numbers: Sequence[int],
    rate_hz: float = 100,
    noise: float = 0.0005,
    group: str = "sudden stops",
) -> list[Moving]:
    """One hand moves evenly at 0.31 m/s, stops within 80 ms, and rests."""
    out = []
    for number in numbers:
        random = np.random.default_rng([number, 7])
        direction = np.zeros(6)
        direction[3 * (number % 2) : 3 * (number % 2) + 3] = random.standard_normal(3) * (
            1.0,
            1.0,
            0.5,
        )
        direction /= np.linalg.norm(direction)
        t = np.arange(round(2.1 / PERIOD_S)) * PERIOD_S
        stop_s = 1.15 + 0.15 * random.random()
        up = np.clip((t - 0.5) / 0.3, 0.0, 1.0)
        down = np.clip((t - stop_s) / STOP_S, 0.0, 1.0)
        travel_m = (
            np.cumsum(STOP_SPEED * up**2 * (3 - 2 * up) * (1 - down**2 * (3 - 2 * down))) * PERIOD_S
        )
        end = middle + random.uniform(-0.05, 0.05, 6) * (1.0, 1.0, 0.5, 1.0, 1.0, 0.3)
        truth = end + direction * (travel_m - travel_m[-1])[:, None]
        stamps = np.arange(random.uniform(0.0, 0.01), t[-1], 1 / rate_hz)
        samples = _tracked(truth, stamps, noise, random)
        out.append(Moving(f"stop {number + 1}", group, truth, stamps, samples, stop_s))
    return out


def reaches(*, seeds: Sequence[int]) -> list[Moving]:
    """The bench's minimum-jerk hands, with its tremor and noise."""
    out = []
    for seed in seeds:
        script = HandScript(Scene(), seed=seed)
        times = np.arange(round(script.duration_s / PERIOD_S)) * PERIOD_S
        truth = np.array(
            [np.concatenate([hand.position for hand in script.truth(t)]) for t in times]
        )
        stamps = np.arange(0.0, script.duration_s - 0.01, 0.01)
        samples = np.array(
            [np.concatenate([pose[:3] for pose in script.sample(t)]) for t in stamps]
        )
        out.append(Moving(f"scene {seed}", "minimum jerk", truth, stamps, samples))
    return out


def small_motion(middle: Array, kind: str, rate_hz: float, number: int) -> Moving:
    """A hand that trembles or waves at a frequency, at rest or in a steady drift."""
    amplitude_m, wave_mps, drift_mps = SMALL_KINDS[kind]
    amplitude_m = min(amplitude_m, wave_mps / (2 * math.pi * rate_hz))
    random = np.random.default_rng([number, 8])
    directions = random.standard_normal((2, 3)) * (1.0, 1.0, 0.5)
    shake, drift = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    t = np.arange(round(SMALL_S / PERIOD_S)) * PERIOD_S
    rise = np.clip(t / SMALL_RISE_S, 0.0, 1.0)
    rise = rise**2 * (3 - 2 * rise)
    travel_m = np.cumsum(drift_mps * rise) * PERIOD_S
    motion_m = (travel_m - travel_m[-1] / 2)[:, None] * drift + (
        amplitude_m * rise * np.sin(2 * np.pi * rate_hz * t)
    )[:, None] * shake
    truth = np.tile(middle, (len(t), 1))
    truth[:, 3 * (number % 2) : 3 * (number % 2) + 3] += motion_m
    stamps = np.arange(0.0, t[-1], 0.01)
    samples = _tracked(truth, stamps, 0.0005, random)
    return Moving(f"{kind}, {rate_hz:g} Hz", "small motion", truth, stamps, samples)


def slow(middle: Array, speed_mps: float, rate_hz: float, noise: float, number: int) -> Moving:
    """One hand rests for SLOW_BEGINS_S, then moves at a constant speed."""
    random = np.random.default_rng([number, 11])
    direction = random.standard_normal(3) * (1.0, 1.0, 0.5)
    direction /= np.linalg.norm(direction)
    t = np.arange(round(SLOW_S / PERIOD_S)) * PERIOD_S
    rise = np.clip((t - SLOW_BEGINS_S) / SLOW_RISE_S, 0.0, 1.0)
    travel_m = np.cumsum(speed_mps * rise) * PERIOD_S
    side = 3 * (number % 2)
    truth = np.tile(middle, (len(t), 1))
    truth[:, side : side + 3] += (travel_m - travel_m[-1] / 2)[:, None] * direction
    stamps = np.arange(random.uniform(0.0, 0.01), t[-1], 1 / rate_hz)
    samples = _tracked(truth, stamps, noise, random)
    return Moving(f"slow {number + 1}", "slow", truth, stamps, samples)
