"""The scribe's own process: takes messages from a socket, writes the recordings, feeds the viewer.

It ends when the other side of the socket is closed or dead, with everything written that it was
told. It cannot stay behind: the death of its daemon wakes it where it was stopped, and where it
hangs, an alarm that it no longer puts off ends it.
"""

from __future__ import annotations

from service import one_blas_thread  # noqa: F401

# isort: split
import contextlib
import ctypes
import os
import signal
import socket
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from service import child
from service.config import urdf_path
from service.core.frame import state_layout
from service.recording.paths import Places
from service.recording.protocol import LARGEST_MESSAGE, Report, Task, unpack, unpack_note
from service.recording.segments import Segments

if TYPE_CHECKING:
    from service.viewer.stream import Viewer

QUEUED = 10_000  # messages; then the socket fills, and then the loop counts losses
FLUSH_S = 0.5  # what a kill can lose
DRAW_FLUSH_S = 2.0
DRAW_END_S = 8.0
DRAW_QUEUED = 5000  # ticks
HUNG_S, END_S = 30, 20  # whole seconds without a turn of the main thread, and for ending; then it is killed
_PR_SET_PDEATHSIG = 1  # of Linux; Python does not name it
# What Rerun's own program says on standard error, in plain letters: not that a viewer reads slowly,
# which is the viewer's matter, as batches that it does not take are dropped.
RERUN_SAYS = {"RUST_LOG": "warn,re_quota_channel=error", "NO_COLOR": "1"}
POLL_S = 0.02  # asleep in between, so that the sender has nobody to wake: that would cost it 25 µs a tick


class DrawingThread:
    """The viewer on a thread of its own: where it falls behind or hangs, on a full disk say, the
    recording does not.
    """

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer
        self.dropped = 0
        self._wanted_file: Path | None = None
        self._waiting: deque[Callable[[], None] | Path] = deque()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._draw, name="drawing", daemon=True)
        self._thread.start()

    @property
    def rrd(self) -> str | None:
        """The file drawn into, or about to be."""
        return self.viewer.rrd if self._wanted_file is None else str(self._wanted_file)

    def put(self, act: Callable[[], None]) -> None:
        """Has something drawn, later; the oldest that waits too long is dropped."""
        self._waiting.append(act)
        if len(self._waiting) > DRAW_QUEUED:
            oldest = self._waiting.popleft()
            if isinstance(oldest, Path) and self._waiting:  # the next file: what is drawn into it goes instead
                self._waiting.popleft()
                self._waiting.appendleft(oldest)
            self.dropped += 1

    def draw_into(self, rrd: Path) -> None:
        """Has the file end, and what is put from now on go into another."""
        self._wanted_file = rrd
        self._waiting.append(rrd)

    def _draw(self) -> None:
        flushed = time.monotonic()
        while not (self._ended.wait(POLL_S) and not self._waiting):
            while self._waiting:
                next_ = self._waiting.popleft()
                if isinstance(next_, Path):
                    self.viewer.draw_into(next_)
                    if self._wanted_file is next_:
                        self._wanted_file = None
                else:
                    next_()
            if time.monotonic() - flushed > DRAW_FLUSH_S:
                self.viewer.flush()
                flushed = time.monotonic()
        self.viewer.close()

    def close(self) -> None:
        """Ends the file and the live view, if that is possible in time."""
        self._ended.set()
        self._thread.join(DRAW_END_S)


class ScribeProcess:
    """What the process does with what it is told.

    A failure ends what it happened in, is reported, and spares the rest.
    """

    def __init__(self, task: Task, skill: bytes | None, source: socket.socket) -> None:
        self._source = source
        self._joints = len(task.settings.joints.names)
        self._errors: list[str] = []
        self._drawing: DrawingThread | None = None
        self._said_dropped = self._said_kept = 0
        drawn = task.rrd is not None or (task.folder is not None and task.settings.files.rerun)
        if drawn or task.live_port is not None:
            from service.viewer.stream import Viewer  # half a second that a scribe without viewer need not spend

            urdf = urdf_path(task.settings)
            viewer = Viewer(urdf=urdf, live_port=task.live_port, settings=task.settings, skill=skill)
            self._drawing = DrawingThread(viewer)
        places = Places(task.settings, task.folder, task.recording, task.rrd, attempt=task.attempt)
        self._segments = Segments(task.settings, places, say=self._errors.append, draw=self._draw_into)
        state = None if task.state is None else np.frombuffer(task.state, state_layout(self._joints))[0]
        self._segments.begin(skill, state)
        self.report()

    def _draw_into(self, rrd: Path) -> None:
        assert self._drawing is not None
        self._drawing.draw_into(rrd)

    def report(self) -> None:
        """Says what went wrong, where things are written, and how much is."""
        viewer = None if self._drawing is None else self._drawing.viewer
        while viewer is not None and viewer.problems:
            self._errors.append(viewer.problems.pop(0))
        if self._drawing is not None and self._drawing.dropped > 2 * self._said_dropped:
            self._said_dropped = self._drawing.dropped
            self._errors.append(f"the drawing cannot keep up: {self._said_dropped} of its entries dropped")
        segments = self._segments
        self._said_kept = segments.kept
        report = Report(
            state=segments.state,
            recording=None if segments.path is None else str(segments.path),
            rrd=None if self._drawing is None else self._drawing.rrd,
            live=None if viewer is None else viewer.url,
            kept=segments.kept,
            lost=segments.lost,
            unmarked=segments.unmarked,
            errors=tuple(self._errors),
            free_mb=segments.free_mb(),
        )
        with contextlib.suppress(OSError):
            self._source.send(msgspec.json.encode(report), socket.MSG_DONTWAIT)
            self._errors.clear()

    def report_kept(self) -> None:
        """Says how much is on disk, if that is more by now: what is not said counts as lost with a
        process that is killed.
        """
        if self._segments.kept != self._said_kept:
            self.report()

    def take(self, message: bytes, skills: list[bytes]) -> None:
        """Writes and draws one message."""
        if (note := unpack_note(message)) is not None:
            key, text, time_ns = note
            self._segments.note(key, text, time_ns)
            if key != "status" and self._drawing is not None:
                viewer = self._drawing.viewer
                self._drawing.put(lambda: viewer.note(key, text, time_ns))
            return
        told = unpack(message, skills, joints=self._joints)
        time_ns = int(told.timing["time_ns"])
        if missing := self._segments.write(told):
            self._show(f"{missing} ticks before tick {told.tick.index} are not recorded", "WARN", time_ns)
        if self._drawing is not None:
            viewer, events = self._drawing.viewer, [(event.kind, event.payload) for event in told.tick.inbox]
            if (skill := told.skill) is not None:
                self._drawing.put(lambda: viewer.learn(skill))
            self._drawing.put(lambda: viewer.add(told.frame, time_ns, told.timing, events))

    def _show(self, text: str, level: str, time_ns: int) -> None:
        if self._drawing is not None:
            viewer = self._drawing.viewer
            self._drawing.put(lambda: viewer.log(text, level, time_ns))

    def flush(self) -> None:
        """Hands what was recorded to the system, and says so."""
        self._segments.flush()
        self.report()

    def close(self) -> None:
        """Ends the files."""
        self._segments.close()
        self.report()
        if self._drawing is not None:
            self._drawing.close()
        self.report()


def _receive(source: socket.socket, buffer: bytearray) -> tuple[bytes, list[bytes]]:
    """The next message and the files that came along; no bytes: the other side is gone."""
    while True:
        try:
            size, ancillary, _, _ = source.recvmsg_into([buffer], socket.CMSG_SPACE(16 * 4), socket.MSG_DONTWAIT)
            break
        except BlockingIOError:
            time.sleep(POLL_S)
    files = [bytes(child.from_memory(fd)[0]) for fd in child.descriptors(ancillary)]
    return bytes(memoryview(buffer)[:size]), files


def _work(source: socket.socket) -> None:
    """Writes what comes until the other side is gone."""
    buffer = bytearray(LARGEST_MESSAGE)
    first, skills = _receive(source, buffer)
    task = msgspec.json.decode(first, type=Task)
    waiting: deque[tuple[bytes, list[bytes]]] = deque()
    ended = threading.Event()

    def read() -> None:
        try:
            while (received := _receive(source, buffer))[0]:
                waiting.append(received)
                while len(waiting) >= QUEUED:
                    time.sleep(POLL_S)
        except ConnectionError:
            pass  # as good as its end
        finally:
            ended.set()  # whatever happened: without a reader there is nothing to wait for

    scribe = ScribeProcess(task, skills[0] if skills else None, source)
    threading.Thread(target=read, name="socket", daemon=True).start()
    flushed = time.monotonic()
    over = False
    while not over:
        over = ended.wait(0.05) and not waiting
        if not ended.is_set():
            signal.alarm(HUNG_S)
        now = time.monotonic()
        while waiting and time.monotonic() - now < FLUSH_S / 2:
            scribe.take(*waiting.popleft())
        scribe.report_kept()
        if now - flushed > FLUSH_S:
            scribe.flush()
            flushed = now
    signal.alarm(END_S)
    scribe.close()


def main() -> None:
    """Serves the socket whose descriptor is the only argument."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # it ends when the socket does, with all that was told
    for name, value in RERUN_SAYS.items():
        os.environ.setdefault(name, value)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(HUNG_S)
    # Its daemon's death makes it go on where it was stopped, and then it sees the socket's end. The
    # signal comes also when only the thread that started it ends: so it must be a harmless one.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGCONT), 0, 0, 0)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.nice(5)
    code = 1
    try:
        with socket.socket(fileno=int(sys.argv[1])) as source:
            _work(source)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)  # without waiting for a drawing that hangs


if __name__ == "__main__":
    main()
