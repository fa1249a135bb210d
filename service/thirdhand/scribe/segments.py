"""Writing of the scribe's ticks into one recording after another.

A recording that is large or old enough ends at a tick with a known state. The next begins with that
state, so that no tick is missing between them. After a failure the recording is left as it is, and
the next one begins as soon as possible; it marks the number of ticks that were lost meanwhile.
"""

from __future__ import annotations

import contextlib
import errno
import shutil
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

from thirdhand.core.frame import Record
from thirdhand.recordings.recording import Recorder
from thirdhand.scribe.paths import MB, RecordingPaths, existing_folder
from thirdhand.scribe.protocol import TickMessage
from thirdhand.settings.config import Settings

REOPEN_S = 1.0  # interval of attempts to begin a recording
SAMPLE_S = 5.0  # interval at which sizes of files are noted
GROWTH_S = 600.0  # growth is measured over at most this time
MIN_GROWTH_S = 10.0  # growth is unknown before this time
MIN_FREE_BYTES = 1_000_000  # a full disk is used again once it has space for some seconds of ticks
PRUNE_S = 5.0  # interval at which old recordings are deleted


class Segments:
    """Writer of ticks and notes. `say` is called once with the message of each failure.

    `kept` counts the received ticks on disk, `lost` the lost ones, and `unmarked` the lost ones
    that no recording on disk marks yet, including those of earlier scribes.
    """

    def __init__(
        self,
        settings: Settings,
        paths: RecordingPaths,
        *,
        say: Callable[[str], None],
        unmarked: int = 0,
        constants: Mapping[str, str] | None = None,
    ) -> None:
        self._constants = constants
        self._settings = settings
        self._paths = paths
        self._say = say
        self._recorder: Recorder | None = None
        self._wanted = True  # False if only a live view is required
        self._skill: bytes | None = None
        self._complete: Path | None = None  # the last recording, once it was closed
        self._kept = self.lost = 0
        self._unmarked = unmarked
        # lost ticks marked in this recording; those marks not on disk yet
        self._marked = self._marked_pending = 0
        self._began = self._tried = self._pruned = -1e9
        self._full = self._moved = False  # the disk is full; the file is no longer at its path
        self._failure: object = None  # cause of the last reported failure
        self._written = 0  # [bytes] in files that have ended
        # time [s], total [bytes]
        self._sizes: deque[tuple[float, int]] = deque(maxlen=round(GROWTH_S / SAMPLE_S))

    @property
    def kept(self) -> int:
        """Number of ticks on disk."""
        return self._kept + (self._recorder.kept if self._recorder is not None else 0)

    @property
    def unmarked(self) -> int:
        """Number of lost ticks that no recording on disk marks yet."""
        return self._unmarked + self._marked_pending

    @property
    def path(self) -> Path | None:
        """The recording being written, or the last complete one."""
        return self._complete if self._recorder is None else self._recorder.path

    @property
    def state(self) -> Literal["starting", "recording", "interrupted", "drawing"]:
        """`starting` before there is a skill; `drawing` without a recording."""
        if self._skill is None or not self._wanted:
            return "starting" if self._skill is None else "drawing"
        return "interrupted" if self._recorder is None else "recording"

    def begin(self, skill: bytes | None, state: Record | None) -> None:
        """Begin with a skill and a state; without them, begin with the first that are received."""
        self._skill = skill
        if skill is not None:
            self._recorder = self._opened(state)

    def _opened(self, state: Record | None) -> Recorder | None:
        """A new recording; None if it cannot be begun, or none is required."""
        self._tried = time.monotonic()
        path = self._paths.next()
        self._wanted = path is not None
        recorder = None if path is None else self._recorder_at(path, state)
        if recorder is not None:
            self._marked = self._marked_pending = 0
            self._began = self._tried
            self._moved = False
        return recorder

    def _recorder_at(self, path: Path, state: Record | None) -> Recorder | None:
        assert self._skill is not None
        try:
            if self._full and shutil.disk_usage(existing_folder(path.parent)).free < MIN_FREE_BYTES:
                return None
            settings = self._settings
            skill = self._skill
            now_ns = time.time_ns()
            constants = self._constants
            return Recorder(
                path,
                settings=settings,
                skill=skill,
                state=state,
                constants=constants,
                time_ns=now_ns,
                thin=True,
            )
        except OSError as error:
            self._failed(path, error)
            _discard(path)
            return None

    def free_mb(self) -> float | None:
        """Free space on the disk of the recording [MB]; None without a recording."""
        with contextlib.suppress(OSError):
            return (
                None
                if self.path is None
                else round(shutil.disk_usage(existing_folder(self.path.parent)).free / 1e6)
            )
        return None

    def mb_per_hour(self) -> float | None:
        """Recent growth of recordings [MB/h]; None if it is not known yet."""
        if not self._sizes:
            return None
        begin_s, begin = self._sizes[0]
        now_s = time.monotonic()
        if now_s - begin_s < MIN_GROWTH_S:
            return None
        return round((self._written + self._size() - begin) / MB * 3600 / (now_s - begin_s), 1)

    @property
    def keep_mb_left(self) -> float | None:
        """Growth until each file takes an older one's place [MB]; None without a limit."""
        left = self._paths.keep_mb_left
        return None if left is None else round(left)

    def _size(self) -> int:
        """Bytes in the file being written."""
        return 0 if self._recorder is None else self._recorder.size

    def _failed(self, path: Path, error: OSError) -> None:
        self._full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        cause = error.errno or str(error)
        if cause != self._failure:
            self._failure = cause
            self._say(
                f"recording to {path} failed: {error.strerror or error}; it continues once this is "
                "repaired"
            )

    def write(self, received: TickMessage) -> int:
        """Write a tick, and return the number of lost ticks before it that are marked with it."""
        events = reversed(received.tick.inbox)
        adopted = next((event.payload for event in events if event.kind == "skill"), self._skill)
        self._skill = received.skill or adopted
        now = time.monotonic()
        if self._recorder is None and self._may_begin(received, now):
            self._recorder = self._opened(None)
        if self._recorder is None:
            return self._skip(received.lost)

        missing = received.lost + self._unmarked
        self._marked += missing
        self._marked_pending += missing
        self._unmarked = 0
        is_last = received.state is not None and self._due(now)
        self._safely(lambda recorder: _write_tick(recorder, received, missing, is_last))
        if self._recorder is None:
            return missing
        if not self._recorder.pending:
            self._marked_pending = 0
        if is_last and received.state is not None:
            self._next(received.state)
        return missing

    def _may_begin(self, received: TickMessage, now: float) -> bool:
        """True if a recording can begin with this tick, and was not tried lately."""
        can_begin = received.state is not None and self._skill is not None
        return can_begin and self._wanted and now - self._tried > REOPEN_S

    def _skip(self, lost: int) -> int:
        """Count a tick that is not recorded after `lost` ones, and return the number of those that
        need no mark.
        """
        if self._wanted:
            self.lost += 1
            self._unmarked += 1 + lost
            return 0
        self._kept += 1  # only a live view is required
        return lost

    def _due(self, now: float) -> bool:
        files = self._settings.files
        return (
            self._size() > files.segment_mb * MB
            or self._moved
            or now - self._began > files.segment_minutes * 60
        )

    def _next(self, state: Record) -> None:
        """Continue in a new recording, which begins with the old one's last state, or in the old
        one if none can be begun.
        """
        self._safely(Recorder.flush)
        new = None if self._recorder is None else self._opened(state)
        if new is not None:
            self._end()
            self._recorder = new

    def _end(self) -> None:
        """End the recording in progress."""
        self._safely(Recorder.close)
        if self._recorder is not None:
            self._kept += self._recorder.kept
            self._written += self._recorder.size
            self._recorder = None

    def _safely(self, act: Callable[[Recorder], None]) -> None:
        """Act on the recording; after an error it ends, and its pending ticks are lost."""
        recorder = self._recorder
        if recorder is None:
            return
        try:
            act(recorder)
        except OSError as error:
            self._failed(recorder.path, error)
            self._leave(recorder, recorder.pending, self._marked_pending if recorder.pending else 0)

    def _leave(self, recorder: Recorder, lost: int, unmarked: int) -> None:
        """Abandon a recording of which `lost` ticks, and the marks of `unmarked` earlier ones, are
        not on disk.
        """
        recorder.abandon()
        self._written += recorder.size
        self._recorder = None
        self._kept += recorder.kept + recorder.pending - lost
        self.lost += lost
        self._unmarked += lost + unmarked
        self._marked_pending = 0
        self._tried = time.monotonic() if self._full else -1e9
        if not recorder.kept:
            _discard(recorder.path)

    def note(self, key: str, text: str, time_ns: int) -> None:
        """Write a text under `<cell>/<key>`."""
        self._safely(lambda recorder: recorder.note(key, text, time_ns))

    def image(self, key: str, data: bytes, time_ns: int) -> None:
        """Write an image, the CDR bytes of a CompressedImage, under a whole key."""
        self._safely(lambda recorder: recorder.image(key, data, time_ns))

    def flush(self) -> None:
        """Pass the written data to the operating system, check that the file is at its path,
        and delete the oldest recordings every PRUNE_S.
        """
        self._safely(Recorder.flush)
        self._check_file()
        if not self._sizes or time.monotonic() - self._sizes[-1][0] > SAMPLE_S:
            self._sizes.append((time.monotonic(), self._written + self._size()))
        if time.monotonic() - self._pruned > PRUNE_S:
            self._pruned = time.monotonic()
            with contextlib.suppress(OSError):
                self._paths.prune(self.path)

    def _check_file(self) -> None:
        recorder = self._recorder
        if recorder is None:
            return
        self._marked_pending = 0
        if recorder.kept:
            if self._failure is not None:
                self._say(
                    f"recording continues in {recorder.path}; {self.lost} ticks are lost in all"
                )
            self._full = False
            self._failure = None
        lost_name = recorder.lost_name()
        if lost_name == "removed":
            self._say(
                f"recording {recorder.path} was removed while it was written; the next one begins"
            )
            self._leave(recorder, recorder.kept + recorder.pending, self._marked)
        elif lost_name and not self._moved:
            self._moved = True
            self._say(
                f"recording {recorder.path} was moved while it was written; the next one begins"
            )

    def close(self) -> None:
        """End the recording."""
        self.flush()
        path = self.path
        self._end()
        self._complete = path if self._failure is None else None


def _write_tick(recorder: Recorder, received: TickMessage, missing: int, is_last: bool) -> None:
    time_ns = int(received.timing["time_ns"])
    recorder.write(
        received.tick,
        received.frame,
        time_ns=time_ns,
        timing=received.timing,
        state=received.state,
        skill=received.skill,
        lost=missing,
        outputs=received.outputs,
        last=is_last,
    )
    if missing:
        recorder.note(
            "log", f"{missing} ticks before tick {received.tick.index} are not recorded", time_ns
        )


def _discard(path: Path) -> None:
    """Delete a recording without a tick."""
    if path.is_file():
        with contextlib.suppress(OSError):
            path.unlink()
