"""The scribe's own process: takes messages from a socket, writes the recording, feeds the viewer.

It ends when the other side of the socket is closed or dead, with everything written that it was
told.
"""

from __future__ import annotations

from service import one_blas_thread  # noqa: F401

# isort: split
import contextlib
import json
import os
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from service import child
from service.config import urdf_path
from service.core.frame import Record, state_layout
from service.recorder.protocol import LARGEST_MESSAGE, Task, unpack, unpack_note
from service.recorder.recording import Recorder

if TYPE_CHECKING:
    from service.recorder.sinks import Viewer

QUEUED = 10_000  # messages; then the socket fills, and then the loop counts losses
FLUSH_S = 0.5  # what a kill can lose
DRAW_FLUSH_S = 2.0
DRAW_END_S = 8.0
DRAW_QUEUED = 5000  # ticks
CLOSING_S = 20.0  # that it may take to write the rest when the daemon was killed
POLL_S = 0.02  # asleep in between, so that the sender has nobody to wake: that would cost it 25 µs a tick


class DrawingThread:
    """The viewer on a thread of its own: where it falls behind or hangs, on a full disk say, the
    recording does not.
    """

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer
        self.dropped = 0
        self._waiting: deque[Callable[[], None]] = deque()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._draw, name="drawing", daemon=True)
        self._thread.start()

    def put(self, act: Callable[[], None]) -> None:
        """Has something drawn, later; the oldest that waits too long is dropped."""
        self._waiting.append(act)
        if len(self._waiting) > DRAW_QUEUED:
            self._waiting.popleft()
            self.dropped += 1

    def _draw(self) -> None:
        flushed = time.monotonic()
        while not (self._ended.wait(POLL_S) and not self._waiting):
            while self._waiting:
                self._waiting.popleft()()
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
        self._task, self._source = task, source
        self._joints = len(task.settings.joints.names)
        self._recorder: Recorder | None = None
        self._record_to = task.recording
        self._drawing: DrawingThread | None = None
        self._said_dropped = 0
        if task.rrd is not None or task.live_port is not None:
            from service.recorder.sinks import Viewer  # half a second that a scribe without viewer need not spend

            rrd = None if task.rrd is None else Path(task.rrd)
            urdf = urdf_path(task.settings)
            self._drawing = DrawingThread(Viewer(urdf=urdf, rrd=rrd, live_port=task.live_port, settings=task.settings))
        if skill is not None:
            self._begin(skill, None if task.state is None else np.frombuffer(task.state, state_layout(self._joints))[0])
        self._report()

    def _tell(self, report: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):
            self._source.send(json.dumps(report).encode(), socket.MSG_DONTWAIT)

    def _report(self) -> None:
        """Says what went wrong and where things are written."""
        viewer = None if self._drawing is None else self._drawing.viewer
        while viewer is not None and viewer.problems:
            self._tell({"error": viewer.problems.pop(0)})
        self._tell({"recording": self._record_to, "rrd": viewer and viewer.rrd, "live": viewer and viewer.url})

    def _record(self, act: Callable[[], None]) -> None:
        """Does one thing for the recording, which ends at the first failure."""
        try:
            act()
        except OSError as error:
            self._tell({"error": f"recording to {self._record_to} ended: {error}"})
            recorder, self._recorder, self._record_to = self._recorder, None, None
            if recorder is not None:
                with contextlib.suppress(OSError):
                    recorder.close()
            self._report()

    def _begin(self, skill: bytes, state: Record | None) -> None:
        if self._record_to is not None:
            self._record(lambda: self._open(skill, state))

    def _open(self, skill: bytes, state: Record | None) -> None:
        self._recorder = Recorder(
            str(self._record_to), settings=self._task.settings, skill=skill, state=state, time_ns=time.time_ns()
        )

    def take(self, message: bytes, skills: list[bytes]) -> None:
        """Writes and draws one message."""
        if (note := unpack_note(message)) is not None:
            self._note(*note)
            return
        told = unpack(message, skills, joints=self._joints)
        time_ns = int(told.timing["time_ns"])
        if self._recorder is None and told.skill is not None:
            self._begin(told.skill, None)
        if told.lost:
            self._note("log", f"{told.lost} ticks before tick {told.tick.index} are not recorded", time_ns)
        recorder = self._recorder
        if recorder is not None:
            self._record(
                lambda: recorder.write(
                    told.tick,
                    told.frame,
                    time_ns=time_ns,
                    timing=told.timing,
                    state=told.state,
                    skill=told.skill,
                    lost=told.lost,
                )
            )
        if self._drawing is not None:
            viewer = self._drawing.viewer
            self._drawing.put(lambda: viewer.add(told.frame, time_ns, told.timing))

    def _note(self, key: str, text: str, time_ns: int) -> None:
        recorder = self._recorder
        if recorder is not None:
            self._record(lambda: recorder.note(key, text, time_ns))
        if self._drawing is not None and key != "status":
            viewer = self._drawing.viewer
            self._drawing.put(lambda: viewer.log(text, "WARN" if key == "log" else "INFO", time_ns))

    def flush_recording(self) -> None:
        """Hands what was recorded to the system."""
        if self._recorder is not None:
            self._record(self._recorder.flush)

    def watch_drawing(self) -> None:
        """Says what went wrong with the drawing, and how much is not in it."""
        if self._drawing is None:
            return
        if self._drawing.viewer.problems:
            self._report()
        if self._drawing.dropped > self._said_dropped:
            self._said_dropped = self._drawing.dropped
            self._tell({"error": f"the drawing cannot keep up: {self._drawing.dropped} of its entries dropped"})

    def close(self) -> None:
        """Ends both files."""
        if self._recorder is not None:
            self._record(self._recorder.close)
        if self._drawing is not None:
            self._drawing.close()
        self._report()


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
        with contextlib.suppress(ConnectionError):
            while (received := _receive(source, buffer))[0]:
                waiting.append(received)
                while len(waiting) >= QUEUED:
                    time.sleep(POLL_S)
        ended.set()

    scribe = ScribeProcess(task, skills[0] if skills else None, source)
    threading.Thread(target=read, name="socket", daemon=True).start()
    flushed = drawn = time.monotonic()
    over = False
    while not over:
        over = ended.wait(0.05) and not waiting
        now = time.monotonic()
        while waiting and time.monotonic() - now < FLUSH_S / 2:
            scribe.take(*waiting.popleft())
        if now - flushed > FLUSH_S:
            scribe.flush_recording()
            flushed = now
        if now - drawn > DRAW_FLUSH_S:
            scribe.watch_drawing()
            drawn = now
    scribe.close()


def main() -> None:
    """Serves the socket whose descriptor is the only argument."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # it ends when the socket does, with all that was told
    child.end_with_parent(CLOSING_S)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.nice(5)
    with socket.socket(fileno=int(sys.argv[1])) as source:
        _work(source)
    os._exit(0)  # without waiting for a drawing that hangs


if __name__ == "__main__":
    main()
