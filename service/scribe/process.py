"""The scribe's process: it reads messages from a socket, writes recordings, and feeds the viewer.

It ends when the other side of the socket closes or dies, after writing everything received. It
cannot outlive its daemon for long: the daemon's death continues a stopped scribe, and an alarm ends
a scribe that hangs. A living daemon replaces a scribe that hangs.

Recording does not wait for drawing: Rerun is imported on the drawing's own thread.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from service.contract.explain import in_words
from service.contract.images import decode_image
from service.core.frame import state_layout
from service.process import child
from service.process.pages import release_start_memory, share_one_heap
from service.scribe.paths import RecordingPaths
from service.scribe.protocol import MAX_PACKET_BYTES, ImageArrival, Note, ScribeReport, ScribeSetup, unpack
from service.scribe.segments import Segments
from service.settings.config import urdf_path

if TYPE_CHECKING:
    from service.viewer.stream import Viewer

CATCH_UP_NICE = 0  # a recording that is behind has an ordinary weight, so that an arm's driver does not wait for it
MAX_WAITING = 10_000  # with more messages the socket fills, then the queue of the loop, and then ticks are lost
FLUSH_S = 0.5  # a kill loses at most this time of a recording
DRAW_FLUSH_S = 10.0  # a kill loses at most this time of a drawing, which can be drawn again
FIRST_FLUSH_S = 5.0  # the same, at the begin of a file
DRAW_END_S = 8.0  # a drawing that does not end within this time is abandoned
MAX_WAITING_DRAWINGS = 5000  # [ticks] with more, the oldest is dropped
BEHIND_MESSAGES = 500  # while more messages wait to be recorded, nothing is drawn
MAX_CLOSING_S = 60  # a process that does not end within these whole seconds is killed
# Rerun's log on standard error: plain text, and no warnings of a slow viewer, whose batches
# are dropped, nor of files without a footer. Arrow's own allocator would keep unused memory.
LIBRARY_OPTIONS = {
    "RUST_LOG": "warn,re_quota_channel=error,re_log_encoding=error",
    "NO_COLOR": "1",
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}
SOCKET_POLL_S = 0.02  # polling, because to wake a blocked reader costs the sender 25 µs per tick


class DrawingThread:
    """A thread that makes and uses the viewer, so that a slow viewer does not delay the recording.

    Set `is_paused` while the recording is behind; nothing is drawn then.
    """

    def __init__(self, make: Callable[[], Viewer]) -> None:
        self.viewer: Viewer | None = None
        self.problems: list[str] = []
        self.dropped, self.is_paused = 0, True
        self._wanted_file: Path | None = None
        self._waiting: deque[Callable[[Viewer], object] | Path] = deque()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._draw, args=(make,), name="drawing", daemon=True)
        self._thread.start()

    @property
    def rrd(self) -> str | None:
        """The file of the present drawing, or of the next one if that is queued."""
        if self._wanted_file is None:
            return None if self.viewer is None else self.viewer.rrd
        return str(self._wanted_file)

    def put(self, act: Callable[[Viewer], object]) -> None:
        """Queue a drawing; beyond MAX_WAITING_DRAWINGS the oldest is dropped."""
        self._waiting.append(act)
        if len(self._waiting) > MAX_WAITING_DRAWINGS:
            oldest = self._waiting.popleft()
            if isinstance(oldest, Path) and self._waiting:  # keep the change of file, drop the drawing after it
                self._waiting.popleft()
                self._waiting.appendleft(oldest)
            self.dropped += 1

    def draw_into(self, rrd: Path) -> None:
        """End the file; everything queued from now on is drawn into another."""
        self._wanted_file = rrd
        self._waiting.append(rrd)

    def _draw(self, make: Callable[[], Viewer]) -> None:
        self._wait()
        try:
            viewer = self.viewer = make()
        except Exception as error:  # the recording continues without Rerun
            self.problems.append(f"nothing is drawn: {in_words(error)}")
            self._wanted_file = None
            return
        flushed, is_fresh = time.monotonic(), True
        while not (self._ended.wait(SOCKET_POLL_S) and not self._waiting):
            while self._waiting:
                self._wait()
                next_ = self._waiting.popleft()
                if isinstance(next_, Path):
                    viewer.draw_into(next_)
                    is_fresh = True
                    if self._wanted_file is next_:
                        self._wanted_file = None
                else:
                    next_(viewer)
            if time.monotonic() - flushed > (FIRST_FLUSH_S if is_fresh else DRAW_FLUSH_S):
                viewer.flush()
                flushed = time.monotonic()
                if is_fresh:  # neither what the begin of a file needed nor the end of the last one is used again
                    is_fresh = False
                    gc.collect()
                    release_start_memory()
        viewer.close()

    def _wait(self) -> None:
        while self.is_paused and not self._ended.wait(SOCKET_POLL_S):
            pass

    def close(self) -> None:
        """End the file and the live view, within DRAW_END_S."""
        self._ended.set()
        self._thread.join(DRAW_END_S)


class ScribeProcess:
    """Writer and drawer of the messages that the process receives.

    A failure is reported and ends only the part that failed.
    """

    def __init__(self, setup: ScribeSetup, skill: bytes | None, source: socket.socket) -> None:
        self._source = source
        self._joints = len(setup.settings.joints.names)
        self._errors: list[str] = []
        self._drawing: DrawingThread | None = None
        self._reported_dropped = self._reported_kept = 0
        self._is_behind = True  # at the start, with the higher weight
        is_drawn = setup.rrd is not None or (setup.folder is not None and setup.settings.files.rerun)
        if is_drawn or setup.live_port is not None:
            self._drawing = DrawingThread(lambda: _viewer(setup, skill))
        paths = RecordingPaths(setup.settings, setup.folder, setup.recording, setup.rrd, attempt=setup.attempt)
        self._segments = Segments(
            setup.settings,
            paths,
            say=self._errors.append,
            draw=self._draw_into,
            unmarked=setup.unmarked,
            constants=setup.constants,
        )
        state = None if setup.state is None else np.frombuffer(setup.state, state_layout(self._joints))[0]
        self._segments.begin(skill, state)
        self.report()

    def _draw_into(self, rrd: Path) -> None:
        assert self._drawing is not None
        self._drawing.draw_into(rrd)

    def report(self) -> None:
        """Send a report: new errors, paths of files, and the number of ticks on disk."""
        viewer = None if self._drawing is None else self._drawing.viewer
        for problems in (drawn.problems for drawn in (self._drawing, viewer) if drawn is not None):
            while problems:
                self._errors.append(problems.pop(0))
        if self._drawing is not None and self._drawing.dropped > 2 * self._reported_dropped:
            self._reported_dropped = self._drawing.dropped
            self._errors.append(f"the drawing is too slow: {self._reported_dropped} of its entries were dropped")
        segments = self._segments
        self._reported_kept = segments.kept
        report = ScribeReport(
            state=segments.state,
            recording=None if segments.path is None else str(segments.path),
            rrd=None if self._drawing is None else self._drawing.rrd,
            live=None if viewer is None else viewer.url,
            kept=segments.kept,
            lost=segments.lost,
            unmarked=segments.unmarked,
            errors=tuple(self._errors),
            free_mb=segments.free_mb(),
            mb_per_hour=segments.mb_per_hour(),
            keep_mb_left=segments.keep_mb_left,
        )
        with contextlib.suppress(OSError):
            self._source.send(msgspec.json.encode(report), socket.MSG_DONTWAIT)
            self._errors.clear()

    def report_kept(self) -> None:
        """Send a report if more ticks are on disk, because unreported ones count as lost if this
        process dies.
        """
        if self._segments.kept != self._reported_kept:
            self.report()

    def take(self, message: bytes, skills: list[bytes]) -> None:
        """Write and draw one message."""
        received, drawing = unpack(message, skills, joints=self._joints), self._drawing
        if isinstance(received, Note):
            key, text, noted_ns = received.key, received.text, received.time_ns
            self._segments.note(key, text, noted_ns)
            if key != "status" and drawing is not None:
                drawing.put(lambda viewer: viewer.note(key, text, noted_ns))
            return
        if isinstance(received, ImageArrival):
            image = received
            self._segments.image(image.key, image.data, image.time_ns)
            if drawing is not None:
                drawing.put(lambda viewer: viewer.image(image.key, decode_image(image.data), image.time_ns))
            return
        missing, time_ns = self._segments.write(received), int(received.timing["time_ns"])
        if drawing is None:
            return
        if missing:
            gap = f"{missing} ticks before tick {received.tick.index} are not recorded"
            drawing.put(lambda viewer: viewer.log(gap, "WARN", time_ns))
        if (skill := received.skill) is not None:
            drawing.put(lambda viewer: viewer.learn(skill))
        events = [(event.kind, event.payload) for event in received.tick.inbox]
        drawing.put(lambda viewer: viewer.add(received.frame, time_ns, received.timing, events))

    def catch_up(self, waiting: int) -> None:
        """Pause the drawing and raise the process's weight while the recording is behind."""
        if waiting <= BEHIND_MESSAGES / 10 if self._is_behind else waiting > BEHIND_MESSAGES:
            self._is_behind = not self._is_behind
            _run_with(CATCH_UP_NICE if self._is_behind else child.CHILD_NICE)
            if self._drawing is not None:
                self._drawing.is_paused = self._is_behind

    def flush(self) -> None:
        """Pass the recorded data to the operating system and report it."""
        self._segments.flush()
        self.report()

    def close(self) -> None:
        """End the files."""
        self._segments.close()
        self.report()
        if self._drawing is not None:
            self._drawing.close()
        self.report()


def _run_with(nice: int) -> None:
    """Set the weight of this thread, and of the session of all children."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)
        Path("/proc/self/autogroup").write_text(str(nice))


def _viewer(setup: ScribeSetup, skill: bytes | None) -> Viewer:
    from service.viewer.stream import Viewer  # its import takes half a second and starts threads

    settings = setup.settings
    return Viewer(
        urdf=urdf_path(settings),
        live_port=setup.live_port,
        settings=settings,
        skill=skill,
        mb_per_hour=settings.files.rerun_mb_per_hour,
    )


def _receive(source: socket.socket, buffer: bytearray) -> tuple[bytes, list[bytes]]:
    """The next message and the files sent with it; an empty message if the other side closed."""
    while True:
        try:
            size, ancillary, _, _ = source.recvmsg_into([buffer], socket.CMSG_SPACE(16 * 4), socket.MSG_DONTWAIT)
            break
        except BlockingIOError:
            time.sleep(SOCKET_POLL_S)
    files = [bytes(child.from_memory(fd)[0]) for fd in child.descriptors(ancillary)]
    return bytes(memoryview(buffer)[:size]), files


def _work(source: socket.socket) -> None:
    buffer = bytearray(MAX_PACKET_BYTES)
    first, skills = _receive(source, buffer)
    setup = msgspec.json.decode(first, type=ScribeSetup)
    waiting: deque[tuple[bytes, list[bytes]]] = deque()
    ended = threading.Event()

    def read() -> None:
        with contextlib.suppress(OSError):  # an ordinary weight: it needs little time, and its queue shows the backlog
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), CATCH_UP_NICE)
        try:
            while (received := _receive(source, buffer))[0]:
                waiting.append(received)
                while len(waiting) >= MAX_WAITING:
                    time.sleep(SOCKET_POLL_S)
        except ConnectionError:
            pass  # the other side died
        finally:
            signal.alarm(MAX_CLOSING_S)
            ended.set()  # after any exception too: without this reader there are no more messages

    threading.Thread(target=read, name="socket", daemon=True).start()
    scribe = ScribeProcess(setup, skills[0] if skills else None, source)
    flushed = time.monotonic()
    over = False
    while not over:
        over = ended.wait(0.05) and not waiting
        now = time.monotonic()
        scribe.catch_up(len(waiting))
        while waiting and time.monotonic() - now < FLUSH_S / 2:
            scribe.take(*waiting.popleft())
        scribe.report_kept()
        if now - flushed > FLUSH_S:
            scribe.flush()
            flushed = now
    scribe.close()


def run(source: socket.socket) -> None:
    """Write and draw the received messages until the other side closes."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # it ends with its socket, after writing everything
    share_one_heap()
    for name, value in LIBRARY_OPTIONS.items():
        os.environ.setdefault(name, value)
    child.end_with_parent(MAX_CLOSING_S)
    _run_with(CATCH_UP_NICE)
    _work(source)
