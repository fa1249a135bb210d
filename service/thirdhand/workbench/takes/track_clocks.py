"""Stamps of one clock for several tracks, without a restart of the clock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thirdhand.core.tuning import TUNING
from thirdhand.workbench.takes.track import Track, clock_parts

# the delays from stamp to recording of streams with one clock may differ by this
LARGEST_DELAY_S = 0.2


class OneClock(NamedTuple):
    """Tracks with stamps of one clock.

    `logged` is True if the stamps are the times of recording. `part` is the number of the part that
    is used if a clock restarts. `remark` has the reason; it is empty if the stamps are unchanged.
    """

    tracks: list[Track]
    logged: bool = False
    part: int | None = None
    remark: str = ""


def by_one_clock(tracks: Sequence[Track]) -> OneClock:
    """The tracks with the times of recording as stamps, if their stamps come from different clocks
    or a clock restarts. If these times are not usable, the longest part without a restart.
    """
    if not all(len(track.poses) for track in tracks):
        return OneClock(list(tracks))
    why = _clocks_differ(tracks)
    if why and _are_usable(tracks):
        logged = [track._replace(stamps_ns=track.logged_ns) for track in tracks]
        return OneClock(
            logged, logged=True, remark=f"{why}; the times of recording are used instead"
        )
    parts = [clock_parts(track.stamps_ns) for track in tracks]
    if max(map(len, parts)) == 1:
        return OneClock(list(tracks))
    return _longest_part(tracks, parts)


def _clocks_differ(tracks: Sequence[Track]) -> str:
    """The reason why stamps are not of one clock; empty if they may be."""
    anew = dict.fromkeys(track.name for track in tracks if not _is_steady(track))
    if anew:
        return f"the clock of {', '.join(anew)} restarts or was set"
    ahead_s = [float(np.median(track.stamps_ns - track.logged_ns)) / 1e9 for track in tracks]
    if max(ahead_s) - min(ahead_s) <= LARGEST_DELAY_S:
        return ""
    clocks = ", ".join(
        f"{track.name} by {ahead:+.3f} s" for track, ahead in zip(tracks, ahead_s, strict=True)
    )
    return f"stamps come from different clocks (relative to the recorder: {clocks})"


def _longest_part(tracks: Sequence[Track], parts: Sequence[Sequence[NDArray[np.intp]]]) -> OneClock:
    """The longest of the parts without a restart that all tracks have, or else the first part, in
    which no clock has restarted.
    """
    counts = [len(track_parts) for track_parts in parts]
    part = 0
    if len(set(counts)) == 1:
        lengths = [sum(map(len, same_part)) for same_part in zip(*parts, strict=True)]
        part = int(np.argmax(lengths))
    part_tracks = [
        track.at(track_parts[part]) for track, track_parts in zip(tracks, parts, strict=True)
    ]
    omitted = sum(len(track.stamps_ns) for track in tracks) - sum(
        len(track.stamps_ns) for track in part_tracks
    )
    whose = ", ".join(
        dict.fromkeys(track.name for track, count in zip(tracks, counts, strict=True) if count > 1)
    )
    lasts_s = max(float(np.ptp(track.stamps_ns)) for track in part_tracks) / 1e9
    remark = (
        f"the clock of {whose} restarts, and the times of recording do too: part {part + 1} of "
        f"{max(counts)} is used, which lasts {lasts_s:.1f} s; {omitted} poses are left out"
    )
    return OneClock(part_tracks, part=part, remark=remark)


def _is_steady(track: Track) -> bool:
    """True if the minimum delays from stamp to recording of all seconds agree. A hold-up delays
    samples but makes none of them faster.
    """
    if not np.ptp(track.logged_ns):
        return True
    ahead_s = (track.stamps_ns - track.logged_ns) / 1e9
    second = (
        (track.logged_ns - track.logged_ns.min()) / (1e9 * TUNING.intake.tracker_memory_s)
    ).astype(np.int64)
    fastest = np.full(int(second.max()) + 1, -np.inf)
    np.maximum.at(fastest, second, ahead_s)
    return bool(np.ptp(fastest[np.isfinite(fastest)]) <= LARGEST_DELAY_S)


def _are_usable(tracks: Sequence[Track]) -> bool:
    """True if the times of recording grow, so that they can replace the stamps."""
    return all(
        np.ptp(track.logged_ns) > 0 and len(clock_parts(track.logged_ns)) == 1 for track in tracks
    )
