"""Find the stretches of recorded tracks that the daemon would reject or hold for.

The daemon's own intake takes the samples of a take, each in the tick of its stamp. In addition to
what the intake rejects at that moment, a take shows what follows: a track that has jumped away and
comes back is wrong in between, however long it stayed there.

1. The samples of a track are divided into runs: where the intake begins or ceases to reject them,
   or believed a jump in the end, and the step is one that it rejects.
2. A run can follow one before the last if a hand can move from the last sample of that to its own
   first sample in the time between.
3. The sequence of runs that can follow each other and holds the most samples is kept.
4. What of it is displaced by a few centimetres for a while is found by `track_offsets`.

A pose that is repeated bit by bit, and from which the track then leaps, is that of a tracker that
has lost the hand.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.contract.messages import BASE, PoseStamped
from service.contract.records import Cause, Reason
from service.core.frame import Vector, as_array, blank, state_layout
from service.core.intake.stage import Intake
from service.core.intake.step import is_contested
from service.core.intake.tuning import AGREE_MPS, CONTESTED_MEMORY_S, CONTESTED_OFF_SHARE, SCATTER_OFF_M
from service.files.track import Track
from service.files.track_offsets import STEP_M, displaced
from service.settings.config import HandSettings, Settings

# Range, effect and measured sensitivity as in `track_offsets`.
# [m/s²], 70 to 200: more misses jumps that last to the end of a take, less removes fast motion
MAX_HAND_MPS2 = 100.0  # missed 0.5, 0.3, 1.2 %; removed 0.03, 0.31, 0.03 %
# [s], 0.1 to 0.5: pieces between two stretches that are shorter are left out with them
LEAST_PIECE_S = 0.3  # good time left out beside bad stretches 1.4, 1.4, 1.9 %

Mask = NDArray[np.bool_]

MOVED_AWAY, SWAPPED, LOST, CONTESTED, UNSEEN = (
    "no motion that a hand could make",
    "where the other hand was",
    "one pose repeated, bit by bit, by a tracker that has lost the hand",
    "reported by two sources",
    "not seen",
)
CAUSES = {
    Cause.REPEATED: "stamps that were there before",
    Cause.OLDER: "stamps older than those before",
    Cause.AHEAD: "stamps ahead of their time",
    Cause.JUMPED: MOVED_AWAY,
    Cause.SWAPPED: SWAPPED,
}


class Stretch(NamedTuple):
    """A stretch of a track without trusted samples: the stamps [ns] of the samples before and
    behind it, and the reason.
    """

    name: str
    begin_ns: int
    end_ns: int
    why: str

    def text(self, start_ns: int) -> str:
        """The stretch in words, in seconds after the start of the take."""
        return (
            f"{self.name} {(self.begin_ns - start_ns) / 1e9:.2f} to {(self.end_ns - start_ns) / 1e9:.2f} s: {self.why}"
        )


class Checked(NamedTuple):
    """A track without the samples that were rejected, and the stretches without samples that are
    too long to be bridged; the stamps [ns] of the first and last sample, and the number of poses,
    before anything was rejected.
    """

    track: Track
    stretches: tuple[Stretch, ...]
    start_ns: int
    end_ns: int
    poses: int

    @property
    def seen_share(self) -> float:
        """The share of the time in which the hand or tool is seen, 0 to 1."""
        unseen_ns = sum(one.end_ns - one.begin_ns for one in self.stretches)
        return 1.0 - unseen_ns / max(self.end_ns - self.start_ns, 1)

    @property
    def remark(self) -> str:
        """In words, how many samples were rejected; empty: none."""
        rejected = self.poses - len(self.track.poses)
        return f"{self.track.name}: {rejected} of {self.poses} poses are rejected by the rules of the daemon" * (
            rejected > 0
        )


def checked(tracks: Sequence[Track], settings: Settings, *, longest_s: float) -> list[Checked]:
    """Tracks of one hand or of both, or of the tool, in frame `base`, with stamps that grow.

    A stretch without trusted samples is named where it lasts longer than `longest_s` [s].
    """
    out = []
    for track, verdict in zip(tracks, _intake_verdicts(tracks, settings), strict=True):
        why = _lost(track, verdict, settings.hands)
        kept = _kept(track, why, verdict.restarts, settings.hands)
        first, last = int(track.stamps_ns[0]), int(track.stamps_ns[-1])
        stretches = _stretches(track, kept, why, longest_s)
        some = int(np.isfinite(track.poses[:, 0]).sum())
        out.append(Checked(track.at(kept), stretches, first, last, some))
    return out


def sound(track: Track) -> Track:
    """The track with NaN for poses that are not finite or not turned by a rotation; one of which no
    orientation is a rotation is taken to be unturned.
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
    """The intake's answer to each sample (N,) of a track: why it was rejected, empty: it was not;
    and whether the filter began anew with it.
    """

    why: list[str]
    restarts: Mask


def _intake_verdicts(tracks: Sequence[Track], settings: Settings) -> list[_Verdict]:
    """Each track as `left` or `right` hand of one intake, in the order of the stamps."""
    hands = msgspec.structs.replace(settings.hands, frame=BASE, unit="m", base_from_tracker=(0, 0, 0, 0, 0, 0, 1))
    settings = msgspec.structs.replace(settings, hands=hands)
    intake, state = Intake(settings), blank(state_layout(len(settings.joints.names)))
    intake.begin(state)
    state["tick"] = 0
    out = [_Verdict([""] * len(track.poses), np.zeros(len(track.poses), bool)) for track in tracks]
    start_ns = min(int(track.stamps_ns[0]) for track in tracks) - 1  # a stamp of 0 is that of no sample
    merged = sorted(
        (int(ns) - start_ns, side, i) for side, track in enumerate(tracks) for i, ns in enumerate(track.stamps_ns)
    )
    rows = [track.poses.tolist() for track in tracks]
    disputed_ns: tuple[list[int], ...] = tuple([] for _ in tracks)
    ticked, period_ns = 0, 1e9 * settings.period_s
    for stamp_ns, side, i in merged:
        tick = round(stamp_ns / period_ns)
        intake.advance(state, tick - ticked)
        ticked, rejected, row = tick, intake.rejected[side].copy(), rows[side][i]
        intake.take_hand(state, side, PoseStamped(stamp_ns, BASE, tuple(row[:3]), tuple(row[3:])))
        causes = np.flatnonzero(intake.rejected[side] - rejected)
        if len(causes):
            out[side].why[i] = CAUSES.get(Cause(causes[0]), UNSEEN)
        else:
            out[side].restarts[i] = bool(state["kept_restarts"][side, state["kept_newest"][side]])
        is_disputed = bool(is_contested(as_array(state), bool(state["reason"] == Reason.TWO_SOURCES)))
        state["reason"] = Reason.TWO_SOURCES if is_disputed else Reason.NONE
        for one in range(len(tracks)) if is_disputed else ():
            if state["contested"][one] > CONTESTED_OFF_SHARE or state["noise_variance"][one] > SCATTER_OFF_M**2:
                disputed_ns[one].append(stamp_ns + start_ns)
    for track, verdict, times in zip(tracks, out, disputed_ns, strict=True):
        mask = _is_before(track.stamps_ns, np.array(times, np.int64), round(1e9 * CONTESTED_MEMORY_S))
        for i in np.flatnonzero(mask).tolist():
            verdict.why[i] = CONTESTED
    return out


def _is_before(stamps: NDArray[np.int64], times: NDArray[np.int64], most_ns: int) -> Mask:
    """True for each stamp (N,) that one of these times follows within `most_ns`."""
    if not len(times):
        return np.zeros(len(stamps), bool)
    following = np.searchsorted(times, stamps)
    return np.asarray((following < len(times)) & (times[np.minimum(following, len(times) - 1)] - stamps <= most_ns))


def _lost(track: Track, verdict: _Verdict, hands: HandSettings) -> list[str]:
    """The reasons of `verdict`, and of the samples of a tracker that repeated the last pose.

    A track that mostly rests on one pose, bit by bit, and goes on from there, has no noise: it was
    made, and tells nothing of a tracker that is lost.
    """
    why, poses, seconds = list(verdict.why), track.poses, (track.stamps_ns - track.stamps_ns[:1]) / 1e9
    changes = np.flatnonzero((np.diff(poses, axis=0) != 0).any(axis=1)) + 1
    bounds = np.concatenate([[0], changes, [len(poses)]])
    is_long = seconds[bounds[1:] - 1] - seconds[bounds[:-1]] >= hands.stale_ms / 1000
    repeats = [(int(bounds[i]), int(bounds[i + 1])) for i in np.flatnonzero(is_long)]
    lost = [one for one in repeats if _is_lost(poses, seconds, *one)]
    for begin, end in lost if 2 * len(lost) >= len(repeats) else ():
        around = slice(max(begin - 1, 0), begin + 1)
        came_by_leap = _leaps(poses[around, :3], np.diff(seconds[around]), hands).any()
        first = begin if came_by_leap else begin + 1
        why[first:end] = [LOST] * (end - first)
    return why


def _is_lost(poses: Vector, seconds: Vector, begin: int, end: int) -> bool:
    """True for a pose, repeated from `begin` to `end`, from which the track goes on elsewhere."""
    if end + 1 >= len(poses):
        return False
    speed = _distance(poses, end, end + 1) / float(seconds[end + 1] - seconds[end])
    return _distance(poses, end, end - 1) > STEP_M + 2.0 * speed * float(seconds[end] - seconds[end - 1])


def _distance(poses: Vector, a: int, b: int) -> float:
    return float(np.linalg.norm(poses[a, :3] - poses[b, :3]))


def _kept(track: Track, why: Sequence[str], restarts: Mask, hands: HandSettings) -> Mask:
    """A mask (N,) of the samples in the sequence of runs that holds the most of them."""
    usable = np.array([i for i, one in enumerate(why) if one in ("", MOVED_AWAY, SWAPPED)], np.intp)
    mask = np.zeros(len(why), bool)
    if not len(usable):
        return mask
    seconds = (track.stamps_ns[usable] - track.stamps_ns[usable[0]]) / 1e9
    at, pauses = track.poses[usable, :3], np.diff(seconds)
    accepted = np.array([not why[i] for i in usable.tolist()])
    doubted = (accepted[1:] != accepted[:-1]) | restarts[usable[1:]]
    is_leap = doubted & _leaps(at, pauses, hands)
    is_pause = (pauses > hands.stale_ms / 1000) | (np.diff(usable) > 1)
    bounds = np.concatenate([[0], np.flatnonzero(is_leap | is_pause) + 1, [len(usable)]])
    begins, ends = bounds[:-1], bounds[1:] - 1
    total = (ends - begins + 1).astype(np.float64)
    before = [-1] * len(begins)
    for run in range(1, len(begins)):
        off = np.linalg.norm(at[begins[run]] - at[ends[:run]], axis=1)
        possible = off <= hands.jump + AGREE_MPS * (seconds[begins[run]] - seconds[ends[:run]])
        possible[-1] &= not is_leap[ends[run - 1]]
        if possible.any():
            before[run] = int(np.argmax(np.where(possible, total[:run], -1.0)))
            total[run] += total[before[run]]
    last = int(np.argmax(total))
    while last >= 0:
        mask[usable[begins[last] : ends[last] + 1]] = True
        last = before[last]
    rows = np.flatnonzero(mask)
    shown = (track.stamps_ns[rows] - track.stamps_ns[0]) / 1e9
    mask[rows[displaced(shown, track.poses[rows, :3])]] = False
    return mask


def _leaps(at: Vector, pauses: Vector, hands: HandSettings) -> Mask:
    """True where no hand can move from one position (N, 3) [m] to the next in the time given [s]:
    it is a jump for the daemon, and takes too much acceleration at both.
    """
    steps = np.diff(at, axis=0)
    off = np.linalg.norm(steps, axis=1)
    turns = np.linalg.norm(np.diff(steps, axis=0), axis=1) / np.maximum(pauses[1:], pauses[:-1]) ** 2
    acceleration = np.minimum(np.concatenate([[np.inf], turns]), np.concatenate([turns, [np.inf]]))
    is_too_hard: Mask = (off > hands.jump + hands.jump_speed * pauses) & (acceleration > MAX_HAND_MPS2)
    return is_too_hard


def _stretches(track: Track, kept: Mask, why: Sequence[str], longest_s: float) -> tuple[Stretch, ...]:
    """The stretches between kept samples that last too long, also before the first and behind the
    last of them.
    """
    rows, out = np.flatnonzero(kept), list[Stretch]()
    if not len(rows):
        reason = Counter(why).most_common(1)[0][0]
        return (Stretch(track.name, int(track.stamps_ns[0]), int(track.stamps_ns[-1]), reason),)
    ends, usual_ns = np.concatenate([[0], rows, [len(kept) - 1]]), float(np.median(np.diff(track.stamps_ns)))
    long = np.flatnonzero(np.diff(track.stamps_ns[ends]) > round(1e9 * longest_s))
    for a, b in zip(ends[long].tolist(), ends[long + 1].tolist(), strict=True):
        between = Counter(why[i] or MOVED_AWAY for i in range(a, b + 1) if not kept[i])
        is_sampled = sum(between.values()) * usual_ns > 0.5 * (track.stamps_ns[b] - track.stamps_ns[a])
        reason = between.most_common(1)[0][0] if is_sampled else UNSEEN
        out.append(Stretch(track.name, int(track.stamps_ns[a]), int(track.stamps_ns[b]), reason))
    return tuple(out)
