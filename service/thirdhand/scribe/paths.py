"""The paths of a cell's recordings: names of new ones, and deletion of old ones beyond the
limits.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

from thirdhand.recordings.mcap_reader import Messages
from thirdhand.settings.config import Settings

MB = 1e6


def existing_folder(folder: Path) -> Path:
    """The folder, or the nearest path above it that exists."""
    return next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())


def stem_of(cell: str) -> str:
    """The begin of the names of a cell's files; other cells with slashes may have the same."""
    return cell.replace("/", "-")


def named_after(cell: str, folder: Path) -> list[Path]:
    """The files in a folder that have names of this cell's recordings, oldest first. Raises
    OSError.
    """
    names = re.compile(re.escape(stem_of(cell)) + r"-\d{8}T\d{6}Z(-2)*")
    # iterdir reports a folder that cannot be read
    paths = sorted(folder.iterdir()) if folder.exists() else []
    return [path for path in paths if path.suffix == ".mcap" and names.fullmatch(path.stem)]


def _ages_s(changed: list[float], longest_gap_s: float) -> list[float]:
    """The ages [s] of files from the times of their last changes, oldest first. A gap between two
    of them, or after the last, counts as at most `longest_gap_s`, because the clock may have been
    set meanwhile. No file is older than the time since its change, unless that is in the future.
    """
    now_s = time.time()
    gaps = [
        min(max(0.0, end - begin), longest_gap_s)
        for begin, end in itertools.pairwise([*changed, now_s])
    ]
    ages_s = list(itertools.accumulate(gaps[::-1]))[::-1]
    since_s = [now_s - change for change in changed]
    return [
        age if since < 0.0 else min(age, since) for age, since in zip(ages_s, since_s, strict=True)
    ]


class RecordingPaths:
    """The paths of successive recordings.

    In `folder` they are `<cell>-<UTC time>.mcap`, which sort by time. Without a folder they are
    `recording`, with a number from the second on.
    """

    def __init__(
        self, settings: Settings, folder: str | None, recording: str | None, *, attempt: int = 1
    ) -> None:
        self._settings = settings
        self._folder = None if folder is None else Path(folder)
        self._explicit = None if recording is None else Path(recording)
        self._number = attempt
        self._newest = datetime.min.replace(tzinfo=UTC)
        self._own: dict[str, bool] = {}  # True for this cell's recordings, by stem
        # Growth before each file takes an older one's place; None: without end, or not known yet.
        self.keep_mb_left: float | None = None

    def next(self) -> Path | None:
        """Path of the next recording; None if none is written."""
        path = self._explicit
        if self._folder is None:
            while path is not None:
                number = self._number
                self._number = self._number + 1
                numbered = path if number == 1 else path.with_stem(f"{path.stem}-{number}")
                if number == 1 or not numbered.exists():
                    return numbered
            return None
        stamp = max(datetime.now(UTC).replace(microsecond=0), self._newest + timedelta(seconds=1))
        while (
            path := self._folder / f"{stem_of(self._settings.cell)}-{stamp:%Y%m%dT%H%M%SZ}.mcap"
        ).exists():
            stamp += timedelta(seconds=1)
        self._newest = stamp
        return path

    def prune(self, writing: Path | None) -> list[Path]:
        """Delete the oldest recordings beyond the limits, except the one being written, and return
        their paths.
        """
        files = self._settings.files
        recordings = self._recordings() if files.keep_mb or files.keep_hours else []
        total = sum(size for _, size, _ in recordings)
        longest_gap_s = files.keep_hours * 1800 + files.segment_minutes * 60
        ages_s = _ages_s([changed for *_, changed in recordings], longest_gap_s)
        removed: list[Path] = []
        for (path, size, _), age_s in zip(recordings, ages_s, strict=True):
            if path != writing and self._is_beyond(age_s, total):
                with contextlib.suppress(OSError):
                    path.unlink()
                    total -= size
                    removed.append(path)
        is_limited = files.keep_mb and self._folder is not None
        self.keep_mb_left = max(0.0, files.keep_mb - total / MB) if is_limited else None
        return removed

    def _is_beyond(self, age_s: float, total: int) -> bool:
        """True if a recording of this age [s] is too old, or all `total` bytes are too many."""
        files = self._settings.files
        too_old = files.keep_hours and age_s > files.keep_hours * 3600
        too_much = files.keep_mb and total > files.keep_mb * MB
        return bool(too_old or too_much)

    def _recordings(self) -> list[tuple[Path, int, float]]:
        """This cell's recordings in order, with size [bytes] and time of change [s]."""
        recordings = []
        for path in [] if self._folder is None else named_after(self._settings.cell, self._folder):
            if self._is_own(path):
                with contextlib.suppress(OSError):
                    about = path.stat()
                    recordings.append((path, about.st_size, about.st_mtime))
        return recordings

    def _is_own(self, path: Path) -> bool:
        """True if a recording is this cell's."""
        if path.stem not in self._own:
            messages = Messages(path)
            with contextlib.suppress(OSError):
                next(iter(messages), None)
            cell = messages.metadata.get("thirdhand", {}).get("cell", self._settings.cell)
            self._own[path.stem] = cell == self._settings.cell
        return self._own[path.stem]
