"""Detection of the stretches of recorded tracks that the daemon would reject or hold for.

The daemon's own intake processes the samples of a take, each in the tick of its stamp. A take also
shows the samples after that tick: a track that jumps away and returns is wrong in between, whatever
the duration.

1. The samples of a track are divided into runs, at steps that no hand can make and at which the
   intake begins or ends to reject samples or restarts its filter.
2. Run B can follow run A if a hand can move from A's last to B's first sample in the time between;
   or if A continues with B once a glitch, up to three samples at the end of A and at the begin of
   B, is left out.
3. The sequence of runs that can follow each other and has the most samples is retained.
4. `track_offsets` finds the parts of it that are displaced by a few centimetres.

A pose that is repeated bit by bit before a leap shows that the tracker had lost the hand.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from thirdhand.contract.messages import BASE, PoseStamped
from thirdhand.contract.records import Cause
from thirdhand.core.frame import Vector, blank, state_layout
from thirdhand.core.intake.stage import Intake
from thirdhand.core.tuning import TUNING
from thirdhand.settings.config import HandSettings, Settings
from thirdhand.workbench.takes.track import Track
from thirdhand.workbench.takes.track_offsets import STEP_M, displaced

# `track_offsets` explains ranges and measured sensitivities.
# [m/s²] A step with more acceleration is a leap. Range 70 to 200: larger values miss jumps that
# last to the end of a take, smaller ones remove fast motion.
MAX_HAND_MPS2 = 100.0  # missed 0.5, 0.3, 1.2 %; removed 0.03, 0.31, 0.03 %
UNSAMPLED_MPS = 2.0  # a hand moves at most this fast between two pieces of its track
# [s] A shorter piece between two bad stretches is left out with them. Range 0.1 to 0.5.
LEAST_PIECE_S = 0.3  # good time left out beside bad stretches 1.4, 1.4, 1.9 %

# Numbers of samples at the end of a run and at the begin of the next one that may be a glitch, from
# few to many; and the least number of others of each run.
TRIMMED = sorted(itertools.product(range(4), repeat=2), key=sum)[1:]
LEAST_CONTINUED = 4

Mask = NDArray[np.bool_]


class Distrust(StrEnum):
    """The reasons why a sample of a take is not trusted, in words; empty for trusted samples."""

    NONE = ""
    JUMPED = "a motion that no hand can make"
    SWAPPED = "at the position of the other hand"
    LOST = "one pose repeated bit by bit, by a tracker that has lost the hand"
    UNSEEN = "not seen"
    REPEATED = "repeated stamps"
    OLDER = "stamps older than those before"
    AHEAD = "stamps ahead of their time"


class Stretch(NamedTuple):
    """A stretch of a track without trusted samples: the stamps [ns] of the samples before and after
    it, and the reason.
    """

    name: str
    begin_ns: int
    end_ns: int
    why: Distrust

    def text(self, start_ns: int) -> str:
        """A message on the stretch, in seconds after the start of the take."""
        return (
            f"{self.name} {(self.begin_ns - start_ns) / 1e9:.2f} to "
            f"{(self.end_ns - start_ns) / 1e9:.2f} s: {self.why}"
        )


class Checked(NamedTuple):
    """A track without its rejected samples, and the stretches that are too long to be interpolated.

    `start_ns` and `end_ns` [ns] are the first and last stamp, and `poses` the number of poses,
    before samples were rejected; `rejected` counts those that the daemon's rules reject.
    """

    track: Track
    stretches: tuple[Stretch, ...]
    start_ns: int
    end_ns: int
    poses: int
    rejected: int

    @property
    def seen_share(self) -> float:
        """Share of the time in which the hand or tool is seen, 0 to 1."""
        unseen_ns = sum(stretch.end_ns - stretch.begin_ns for stretch in self.stretches)
        return 1.0 - unseen_ns / max(self.end_ns - self.start_ns, 1)

    @property
    def remark(self) -> str:
        """A remark on the numbers of samples that are left out; empty if there are none."""
        left_out = self.poses - len(self.track.poses)
        rejected = self.rejected
        if not left_out:
            return ""
        by_rules = f"; the rules of the daemon reject {rejected}" if rejected else ""
        return f"{self.track.name}: {left_out} of {self.poses} poses are left out{by_rules}"


def checked(tracks: Sequence[Track], settings: Settings, *, longest_s: float) -> list[Checked]:
    """The checked tracks of one or both hands, or of the tool, in frame `base`, with growing
    stamps.

    Stretches without trusted samples are listed if they last longer than `longest_s` [s].
    """
    out = []
    for track, verdict in zip(tracks, _intake_verdicts(tracks, settings), strict=True):
        why = _lost(track, verdict, settings.hands)
        is_kept = _kept(track, why, verdict.restarts, settings.hands)
        first = int(track.stamps_ns[0])
        last = int(track.stamps_ns[-1])
        stretches = _stretches(track, is_kept, why, longest_s)
        pose_count = int(np.isfinite(track.poses[:, 0]).sum())
        rejected = sum(bool(reason) for reason in verdict.why)
        out.append(Checked(track.at(is_kept), stretches, first, last, pose_count, rejected))
    return out


def in_base_frame(settings: Settings) -> Settings:
    """The settings for hands that are in frame `base` already."""
    hands = HandSettings()
    mapped = {name: getattr(hands, name) for name in ("frame", "unit", "axes", "base_from_tracker")}
    return msgspec.structs.replace(
        settings, hands=msgspec.structs.replace(settings.hands, **mapped)
    )


def sound(track: Track) -> Track:
    """The track with NaN for poses that are not finite or whose quaternion is not a rotation. A
    track without any rotation is assumed to have the identity.
    """
    poses = track.poses.copy()
    with np.errstate(all="ignore"):
        is_turned = np.abs(np.linalg.norm(poses[:, 3:], axis=1) - 1) <= 0.01
    if not is_turned.any():
        poses[:, 3:] = (0.0, 0.0, 0.0, 1.0)
        is_turned[:] = True
    poses[~(is_turned & np.isfinite(poses).all(axis=1))] = np.nan
    return track._replace(poses=poses)


class _Verdict(NamedTuple):
    """The intake's decision on each sample (N,) of a track: the reason of its rejection, and a mask
    of the samples with which the filter restarted.
    """

    why: list[Distrust]
    restarts: Mask


def _intake_verdicts(tracks: Sequence[Track], settings: Settings) -> list[_Verdict]:
    """The decisions on each track, as `left` or `right` hand of one intake, in order of stamps."""
    settings = in_base_frame(settings)
    intake = Intake(settings)
    state = blank(state_layout(len(settings.joints.names)))
    intake.begin(state)
    state["tick"] = 0
    out = [
        _Verdict([Distrust.NONE] * len(track.poses), np.zeros(len(track.poses), bool))
        for track in tracks
    ]
    # the intake takes a stamp of 0 for no stamp
    start_ns = min(int(track.stamps_ns[0]) for track in tracks) - 1
    merged = sorted(
        (int(ns) - start_ns, side, i)
        for side, track in enumerate(tracks)
        for i, ns in enumerate(track.stamps_ns)
    )
    rows = [track.poses.tolist() for track in tracks]
    ticked = 0
    period_ns = 1e9 * settings.period_s
    for stamp_ns, side, i in merged:
        tick = round(stamp_ns / period_ns)
        intake.advance(state, tick - ticked)
        ticked = tick
        rejected = intake.rejected[side].copy()
        row = rows[side][i]
        intake.take_hand(state, side, PoseStamped(stamp_ns, BASE, tuple(row[:3]), tuple(row[3:])))
        causes = np.flatnonzero(intake.rejected[side] - rejected)
        if len(causes):
            out[side].why[i] = Distrust.__members__.get(Cause(causes[0]).name, Distrust.UNSEEN)
        else:
            out[side].restarts[i] = bool(state["kept_restarts"][side, state["kept_newest"][side]])
    return out


def _lost(track: Track, verdict: _Verdict, hands: HandSettings) -> list[Distrust]:
    """The reasons of `verdict`, with `LOST` for the samples of a tracker that repeated its last
    pose.

    Most repeated poses of a synthetic track, which has no noise, are rests from which it continues.
    In such a track, repeated poses are not rejected.
    """
    why = list(verdict.why)
    poses = track.poses
    seconds = (track.stamps_ns - track.stamps_ns[:1]) / 1e9
    changes = np.flatnonzero((np.diff(poses, axis=0) != 0).any(axis=1)) + 1
    bounds = np.concatenate([[0], changes, [len(poses)]])
    is_long = seconds[bounds[1:] - 1] - seconds[bounds[:-1]] >= hands.stale_ms / 1000
    repeats = [(int(bounds[i]), int(bounds[i + 1])) for i in np.flatnonzero(is_long)]
    lost = [repeat for repeat in repeats if _is_lost(poses, seconds, *repeat)]
    for begin, end in lost if 2 * len(lost) >= len(repeats) else ():
        around = slice(max(begin - 1, 0), begin + 1)
        came_by_leap = _leaps(poses[around, :3], np.diff(seconds[around])).any()
        first = begin if came_by_leap else begin + 1
        why[first:end] = [Distrust.LOST] * (end - first)
    return why


def _is_lost(poses: Vector, seconds: Vector, begin: int, end: int) -> bool:
    """True if the track leaps after a pose that is repeated from index `begin` to `end`."""
    if end + 1 >= len(poses):
        return False
    speed = _distance(poses, end, end + 1) / float(seconds[end + 1] - seconds[end])
    return _distance(poses, end, end - 1) > STEP_M + 2.0 * speed * float(
        seconds[end] - seconds[end - 1]
    )


def _distance(poses: Vector, a: int, b: int) -> float:
    return float(np.linalg.norm(poses[a, :3] - poses[b, :3]))


def _kept(track: Track, why: Sequence[Distrust], restarts: Mask, hands: HandSettings) -> Mask:
    """A mask (N,) of the samples in the sequence of runs that has the most of them."""
    in_runs = (Distrust.NONE, Distrust.JUMPED, Distrust.SWAPPED)
    usable = np.array([i for i, reason in enumerate(why) if reason in in_runs], np.intp)
    mask = np.zeros(len(why), bool)
    if not len(usable):
        return mask
    seconds = (track.stamps_ns[usable] - track.stamps_ns[usable[0]]) / 1e9
    positions_m = track.poses[usable, :3]
    pauses = np.diff(seconds)
    accepted = np.array([not why[i] for i in usable.tolist()])
    doubted = (accepted[1:] != accepted[:-1]) | restarts[usable[1:]]
    is_leap = doubted & _leaps(positions_m, pauses)
    is_pause = (pauses > hands.stale_ms / 1000) | (np.diff(usable) > 1)
    bounds = np.concatenate([[0], np.flatnonzero(is_leap | is_pause) + 1, [len(usable)]])
    begins = bounds[:-1]
    ends = bounds[1:] - 1
    counts = (ends - begins + 1).astype(np.float64)
    total = counts.copy()
    before = [(-1, 0, 0)] * len(begins)
    for run in range(1, len(begins)):
        distances_m = np.linalg.norm(positions_m[begins[run]] - positions_m[ends[:run]], axis=1)
        possible = distances_m <= TUNING.intake.jump_m + UNSAMPLED_MPS * (
            seconds[begins[run]] - seconds[ends[:run]]
        )
        possible[-1] &= not is_leap[ends[run - 1]]
        links = {(int(i), 0, 0): total[i] for i in np.flatnonzero(possible)}
        if not possible[-1]:
            links |= {
                (run - 1, last, first): total[run - 1] - last - first
                for last, first in TRIMMED
                if _continues(
                    positions_m, seconds, int(ends[run - 1]) - last, int(begins[run]) + first
                )
                and min(counts[run - 1] - last, counts[run] - first) >= LEAST_CONTINUED
            }
        if links:
            before[run] = max(links, key=links.__getitem__)
            total[run] += links[before[run]]
    run = int(np.argmax(total))
    dropped = 0
    while run >= 0:
        previous, last, first = before[run]
        mask[usable[begins[run] + first : ends[run] + 1 - dropped]] = True
        run = previous
        dropped = last
    rows = np.flatnonzero(mask)
    times_s = (track.stamps_ns[rows] - track.stamps_ns[0]) / 1e9
    mask[rows[displaced(times_s, track.poses[rows, :3])]] = False
    return mask


def _continues(at: Vector, seconds: Vector, last: int, first: int) -> bool:
    """True if the track comes within a jump of `first`, as it moves at index `last`."""
    velocity = (at[last] - at[last - 1]) / (seconds[last] - seconds[last - 1])
    expected = at[last] + velocity * (seconds[first] - seconds[last])
    return bool(np.linalg.norm(at[first] - expected) <= TUNING.intake.jump_m)


def _leaps(at: Vector, pauses: Vector) -> Mask:
    """A mask (N - 1,) of the steps between positions (N, 3) [m] that no hand can make in the pauses
    (N - 1,) [s]: the daemon rejects them as jumps, and they need too much acceleration at both
    ends.
    """
    steps = np.diff(at, axis=0)
    distances_m = np.linalg.norm(steps, axis=1)
    turns = (
        np.linalg.norm(np.diff(steps, axis=0), axis=1) / np.maximum(pauses[1:], pauses[:-1]) ** 2
    )
    acceleration = np.minimum(np.concatenate([[np.inf], turns]), np.concatenate([turns, [np.inf]]))
    is_leap: Mask = (distances_m > TUNING.intake.jump_m + TUNING.intake.jump_speed_mps * pauses) & (
        acceleration > MAX_HAND_MPS2
    )
    return is_leap


def _stretches(
    track: Track, kept: Mask, why: Sequence[Distrust], longest_s: float
) -> tuple[Stretch, ...]:
    """The stretches between retained samples that last longer than `longest_s` [s], and those
    before the first and after the last retained sample.
    """
    rows = np.flatnonzero(kept)
    out = list[Stretch]()
    if not len(rows):
        reason = Counter(why).most_common(1)[0][0]
        return (Stretch(track.name, int(track.stamps_ns[0]), int(track.stamps_ns[-1]), reason),)
    ends = np.concatenate([[0], rows, [len(kept) - 1]])
    usual_ns = float(np.median(np.diff(track.stamps_ns)))
    long = np.flatnonzero(np.diff(track.stamps_ns[ends]) > round(1e9 * longest_s))
    for a, b in zip(ends[long].tolist(), ends[long + 1].tolist(), strict=True):
        between = Counter(why[i] or Distrust.JUMPED for i in range(a, b + 1) if not kept[i])
        is_sampled = sum(between.values()) * usual_ns > 0.5 * (
            track.stamps_ns[b] - track.stamps_ns[a]
        )
        reason = between.most_common(1)[0][0] if is_sampled else Distrust.UNSEEN
        out.append(Stretch(track.name, int(track.stamps_ns[a]), int(track.stamps_ns[b]), reason))
    return tuple(out)
