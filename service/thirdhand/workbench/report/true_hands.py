"""The true motion of a recording's hands, estimated afterwards from the samples before and after
each moment, and what its samples add to it: noise, tremor and untrusted samples.

Samples that the daemon's rules reject, or that later samples contradict (`files.track_check`), are
left out. A smoothing spline f through the others x_i minimises

    sum of w_i |x_i - f(t_i)|² + lambda integral of |f''|² dt,   lambda = 1 / (interval ω⁴)

whose response is one half at the frequency ω / 2 pi. It has no lag. Weights w_i of samples far from
f are reduced.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline, make_smoothing_spline
from scipy.signal import welch

from thirdhand.contract.messages import BASE, PoseStamped
from thirdhand.contract.records import SIDES
from thirdhand.core.frame import Event, Tick, Vector
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.settings.config import Settings
from thirdhand.workbench.takes.demonstration_reader import in_base
from thirdhand.workbench.takes.track import Track
from thirdhand.workbench.takes.track_check import checked, sound

HALF_RESPONSE_HZ = 6.0  # the response of the true motion is one half here: faster motion is tremor or noise
HALF_RESPONSE_RATE_SHARE = 1 / 8  # for trackers with a low rate: at this share of the rate
REWEIGHTINGS = 3
FAR_RESIDUALS = 3.0  # weights are reduced for residuals above this multiple of the median one
FAR_LEAST_M = 1e-3  # smaller residuals keep their weight
LONGEST_GAP_S = 0.25  # within longer gaps between trusted samples the true motion is not known
LEAST_HAND_SAMPLES = 20
TREMOR_RANGE_HZ = (4.0, 12.0)
SPECTRUM_S = 2.0  # length of a spectrum's segments
SHOULDERS_HZ = (1.25, 2.5)  # the spectrum without the tremor is interpolated from both sides at this distance
TREMOR_RATIO = 3.0  # a tremor has a peak this many times above the rest of the spectrum
TREMOR_HALF_WIDTH_HZ = 1.0
DELAY_SPREAD_S = 0.3  # stamps with a larger spread of delays are ignored: times of arrival are used
EARLIEST_STAMP_NS = 10**12


class Tremor(NamedTuple):
    """Frequency and amplitude of a tremor."""

    rate_hz: float
    amplitude_mm: float


class TrueHand(NamedTuple):
    """The trusted samples (M, 3) [m] of one hand in frame `base`, their times (M,) [s] since tick 0
    and orientations (M, 4), and the true path. `untrusted` samples were left out.
    """

    times: Vector
    samples: Vector
    orientations: Vector
    path: BSpline
    untrusted: int

    @property
    def rate_hz(self) -> float:
        """The tracker's median rate."""
        return float(1.0 / np.median(np.diff(self.times)))

    @property
    def noise_mm(self) -> float:
        """Standard deviation of the noise on each axis, from third differences: white noise of
        variance v gives them 20 v. The median is not moved by outliers.
        """
        third = np.diff(self.samples, n=3, axis=0)
        return 1000 * 1.4826 * float(np.median(np.abs(third))) / math.sqrt(20.0)

    def at(self, times: Vector) -> Vector:
        """True positions (T, 3) [m] at times (T,) [s]; NaN where they are not known."""
        after = np.searchsorted(self.times, times)
        inside = (after > 0) & (after < len(self.times))
        after = np.clip(after, 1, len(self.times) - 1)
        known = inside & (self.times[after] - self.times[after - 1] <= LONGEST_GAP_S)
        return np.where(known[:, None], self.path(times), np.nan)

    def spectrum(self) -> tuple[Vector, Vector]:
        """Frequencies (F,) [Hz] and power spectral density (F,) [m²/Hz] of the samples, all axes
        together; empty if they are too few.
        """
        rate_hz = self.rate_hz
        grid = np.arange(self.times[0], self.times[-1], 1.0 / rate_hz)
        length = round(SPECTRUM_S * rate_hz)
        if len(grid) < 3 * length:
            return np.empty(0), np.empty(0)
        even = np.stack([np.interp(grid, self.times, axis) for axis in self.samples.T], axis=1)
        hz, density = welch(even, rate_hz, "hann", length, axis=0)
        return hz, density.sum(axis=1)

    def tremor(self) -> Tremor | None:
        """The strongest tremor in TREMOR_RANGE_HZ; None without one, or with too few samples."""
        hz, density = self.spectrum()
        if not len(hz):
            return None
        log_hz, log_density = np.log(np.maximum(hz, hz[1])), np.log(np.maximum(density, 1e-30))
        rest = np.full(len(hz), np.nan)
        band = np.flatnonzero((hz >= TREMOR_RANGE_HZ[0]) & (hz <= min(TREMOR_RANGE_HZ[1], hz[-1] - SHOULDERS_HZ[0])))
        for i in band.tolist():
            away = np.abs(hz - hz[i])
            beside = (away >= SHOULDERS_HZ[0]) & (away <= SHOULDERS_HZ[1])
            slope, level = np.polyfit(log_hz[beside] - log_hz[i], log_density[beside], 1)
            rest[i] = math.exp(level if math.isfinite(slope) else log_density[beside].mean())
        ratio = np.where(np.isnan(rest), 0.0, density / rest)
        most = int(np.argmax(ratio))
        if ratio[most] < TREMOR_RATIO:
            return None
        peak = np.abs(hz - hz[most]) <= TREMOR_HALF_WIDTH_HZ
        excess = np.where(peak, np.maximum(density - rest[most], 0.0), 0.0)
        rate_hz = float(excess @ hz / excess.sum())
        return Tremor(rate_hz, 1000 * math.sqrt(2.0 * float(excess.sum()) * float(hz[1])))


def true_hands(ticks: Sequence[Tick], settings: Settings, *, origin: str) -> dict[str, TrueHand]:
    """The true motion of each hand with samples in `ticks`, mapped to `base` by the settings.

    Raises RecordingError if there is none, or if its samples are in an unknown frame.
    """
    tracks = [_track(side, ticks, settings.period_s) for side in SIDES]
    tracks, _ = in_base(origin, [sound(track) for track in tracks if len(track.poses) >= LEAST_HAND_SAMPLES], settings)
    if not tracks:
        raise RecordingError(f"{origin} has no {LEAST_HAND_SAMPLES} samples of one hand: nothing can be tuned to it")
    found = {}
    for track, one in zip(tracks, checked(tracks, settings, longest_s=LONGEST_GAP_S), strict=True):
        times, samples = one.track.stamps_ns / 1e9, one.track.poses[:, :3]
        if len(times) >= LEAST_HAND_SAMPLES:
            untrusted = len(track.poses) - len(times)
            found[track.name.removeprefix("hands/")] = TrueHand(
                times, samples, one.track.poses[:, 3:], smoothing_spline(times, samples), untrusted
            )
    if not found:
        raise RecordingError(f"{origin}: of {len(tracks[0].poses)} samples of a hand, too few can be trusted")
    return found


def smoothing_spline(times: Vector, samples: Vector) -> BSpline:
    """The spline through samples (M, 3) at growing times (M,) [s]; see the module."""
    interval_s = float(np.median(np.diff(times)))
    omega = 2.0 * math.pi * min(HALF_RESPONSE_HZ, HALF_RESPONSE_RATE_SHARE / interval_s)
    weights = np.ones(len(times))
    for _ in range(REWEIGHTINGS):
        path = make_smoothing_spline(times, samples, weights, lam=1.0 / (interval_s * omega**4))
        residuals = np.linalg.norm(samples - path(times), axis=1)
        far_m = max(FAR_RESIDUALS * float(np.median(residuals)), FAR_LEAST_M)
        weights = np.minimum(1.0, (far_m / np.maximum(residuals, 1e-9)) ** 2)
    return path


def with_true_hands(ticks: Iterable[Tick], hands: Mapping[str, TrueHand], period_s: float) -> Iterator[Tick]:
    """The same ticks, in which each has a sample of each hand's true position, in frame `base`."""
    ticks = list(ticks)
    times = np.array([tick.index for tick in ticks]) * period_s
    sides = []
    for side, hand in hands.items():
        newest = np.clip(np.searchsorted(hand.times, times) - 1, 0, len(hand.times) - 1)
        sides.append((f"hands/{side}", hand.at(times).tolist(), hand.orientations[newest].tolist()))
    for i, tick in enumerate(ticks):
        stamp_ns = EARLIEST_STAMP_NS + round(1e9 * times[i])
        inbox = [event for event in tick.inbox if not event.kind.startswith("hands/")]
        for kind, positions, orientations in sides:
            if math.isfinite(positions[i][0]):
                pose = PoseStamped(stamp_ns, BASE, tuple(positions[i]), tuple(orientations[i]))
                inbox.append(Event(kind, b"", pose))
        yield Tick(tick.index, tuple(inbox))


def _track(side: str, ticks: Iterable[Tick], period_s: float) -> Track:
    """The samples of one hand, of its most frequent frame, with growing stamps [ns] since tick 0.

    A sample's stamp is moved to the clock of the ticks by the least delay from stamp to arrival.
    """
    poses: list[PoseStamped] = []
    arrived: list[float] = []
    for tick in ticks:
        for event in tick.inbox:
            if event.kind == f"hands/{side}":
                poses.append(event.value)
                arrived.append(tick.index * period_s)
    frames = [pose.frame_id for pose in poses]
    frame = max(set(frames), key=frames.count, default=BASE)
    kept = [i for i, one in enumerate(frames) if one == frame]
    came = np.array([arrived[i] for i in kept])
    stamped = np.array([poses[i].stamp_ns for i in kept], np.int64)
    times = came
    if kept and stamped.min() > 0:
        since_first = (stamped - stamped[0]) / 1e9
        delays = came - since_first
        least, most = np.percentile(delays, (1, 95))
        times = since_first + least if most - least < DELAY_SPREAD_S else came
    stamps, first = np.unique(np.round(1e9 * times).astype(np.int64), return_index=True)
    rows = np.array([(*poses[i].position, *poses[i].orientation) for i in kept]).reshape(-1, 7)
    return Track(f"hands/{side}", side, stamps, stamps, rows[first], frame)
