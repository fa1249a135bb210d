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

from service.files.mcap_reader import Messages
from service.settings.config import Settings

MB = 1e6


def existing_folder(folder: Path) -> Path:
    """The folder, or the nearest path above it that exists."""
    return next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())


def stem_of(cell: str) -> str:
    """The begin of the names of a cell's files; other cells with slashes may have the same."""
    return cell.replace("/", "-")


def named_after(cell: str, folder: Path, suffix: str) -> list[Path]:
    """The files of a kind in a folder that have names of this cell's recordings, oldest first.
    Raises OSError.
    """
    names = re.compile(re.escape(stem_of(cell)) + r"-\d{8}T\d{6}Z(-2)*")
    found = sorted(folder.iterdir()) if folder.exists() else []  # iterdir reports a folder that cannot be read
    return [path for path in found if path.suffix == suffix and names.fullmatch(path.stem)]


def _ages_s(changed: list[float], longest_gap_s: float) -> list[float]:
    """The ages [s] of files from the times of their last changes, oldest first. A gap between two
    of them, or after the last, counts as at most `longest_gap_s`, because the clock may have been
    set meanwhile. No file is older than the time since its change, unless that is in the future.
    """
    now_s = time.time()
    gaps = [min(max(0.0, end - begin), longest_gap_s) for begin, end in itertools.pairwise([*changed, now_s])]
    ages_s = list(itertools.accumulate(gaps[::-1]))[::-1]
    since_s = [now_s - change for change in changed]
    return [age if since < 0.0 else min(age, since) for age, since in zip(ages_s, since_s, strict=True)]


class RecordingPaths:
    """The paths of successive recordings.

    In `folder` they are `<cell>-<UTC time>.mcap` and `.rrd`, which sort by time. Without a folder
    they are `recording` and `rrd`, with a number from the second on.
    """

    def __init__(
        self, settings: Settings, folder: str | None, recording: str | None, rrd: str | None, *, attempt: int = 1
    ) -> None:
        self._settings = settings
        self._folder = None if folder is None else Path(folder)
        self._explicit = [None if path is None else Path(path) for path in (recording, rrd)]
        self._number = attempt
        self._newest = datetime.min.replace(tzinfo=UTC)
        self._own: dict[str, bool] = {}  # True for this cell's recordings, by stem
        # Growth before each file takes an older one's place; None: without end, or not known yet.
        self.keep_mb_left: float | None = None

    def next(self) -> tuple[Path | None, Path | None]:
        """Paths of the next recording and of its drawing; None for those not written."""
        if self._folder is None:
            while True:
                number, self._number = self._number, self._number + 1
                recording, rrd = (
                    path and (path if number == 1 else path.with_stem(f"{path.stem}-{number}"))
                    for path in self._explicit
                )
                if number == 1 or not any(path is not None and path.exists() for path in (recording, rrd)):
                    return recording, rrd
        at = max(datetime.now(UTC).replace(microsecond=0), self._newest + timedelta(seconds=1))
        while any(path.exists() for path in self._named(at)):
            at += timedelta(seconds=1)
        self._newest = at
        recording, rrd = self._named(at)
        return recording, rrd if self._settings.files.rerun else None

    def _named(self, at: datetime) -> tuple[Path, Path]:
        assert self._folder is not None
        stem = f"{stem_of(self._settings.cell)}-{at:%Y%m%dT%H%M%SZ}"
        return self._folder / f"{stem}.mcap", self._folder / f"{stem}.rrd"

    def prune(self, writing: Path | None) -> list[Path]:
        """Delete the oldest recordings and drawings beyond the limits of each, except those being
        written, and return their paths.
        """
        files = self._settings.files
        lefts: list[float | None] = []
        removed: list[Path] = []
        for suffix, keep_mb, keep_hours in (
            (".mcap", files.keep_mb, files.keep_hours),
            (".rrd", files.rerun_keep_mb, files.rerun_keep_hours),
        ):
            found = self._found(suffix) if self._folder is not None and (keep_mb or keep_hours) else []
            total = sum(size for _, size, _ in found)
            longest_gap_s = keep_hours * 1800 + files.segment_minutes * 60
            ages_s = _ages_s([changed for *_, changed in found], longest_gap_s)
            for (path, size, _), age_s in zip(found, ages_s, strict=True):
                too_old = keep_hours and age_s > keep_hours * 3600
                too_much = keep_mb and total > keep_mb * MB
                if (too_old or too_much) and (writing is None or path.stem != writing.stem):
                    with contextlib.suppress(OSError):
                        path.unlink()
                        total -= size
                        removed.append(path)
            if suffix == ".mcap" or files.rerun:
                lefts.append(max(0.0, keep_mb - total / MB) if keep_mb and self._folder is not None else None)
        self.keep_mb_left = sum(left for left in lefts if left is not None) if None not in lefts else None
        return removed

    def _found(self, suffix: str) -> list[tuple[Path, int, float]]:
        """This cell's files of a kind in order, with size [bytes] and time of change [s]."""
        assert self._folder is not None
        found = []
        for path in named_after(self._settings.cell, self._folder, suffix):
            if self._is_own(path):
                with contextlib.suppress(OSError):
                    about = path.stat()
                    found.append((path, about.st_size, about.st_mtime))
        return found

    def _is_own(self, path: Path) -> bool:
        """True if a recording, or the recording of a drawing, is this cell's."""
        if path.stem not in self._own:
            messages = Messages(path.with_suffix(".mcap"))
            with contextlib.suppress(OSError):
                next(iter(messages), None)
            cell = messages.metadata.get("thirdhand", {}).get("cell", self._settings.cell)
            self._own[path.stem] = cell == self._settings.cell
        return self._own[path.stem]
