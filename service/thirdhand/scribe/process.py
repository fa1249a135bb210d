"""The scribe's process: it writes the messages from a socket into recordings, and feeds
the live view.

It ends when the other side of the socket closes or dies, after writing everything received. It
cannot outlive its daemon for long: the daemon's death continues a stopped scribe, and an alarm ends
a scribe that hangs. A living daemon replaces a scribe that hangs.

Recording does not wait for the live view: Rerun is imported on the view's own thread.
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

from thirdhand.contract.explain import in_words
from thirdhand.contract.images import decode_image
from thirdhand.core.frame import state_layout
from thirdhand.process import child
from thirdhand.process.pages import release_start_memory, share_one_heap
from thirdhand.scribe.paths import RecordingPaths
from thirdhand.scribe.protocol import (
    MAX_PACKET_BYTES,
    ImageArrival,
    Note,
    ScribeReport,
    ScribeSetup,
    TickMessage,
    unpack,
)
from thirdhand.scribe.segments import Segments
from thirdhand.settings.config import urdf_path

if TYPE_CHECKING:
    from thirdhand.viewer.stream import Viewer

# a recording that is behind has an ordinary weight, so that an arm's driver does not wait for it
CATCH_UP_NICE = 0
# with more messages the socket fills, then the queue of the loop, and then ticks are lost
MAX_WAITING = 10_000
FLUSH_S = 0.5  # a kill loses at most this time of a recording
LIVE_END_S = 8.0  # a live view that does not end within this time is abandoned
# with more frames and images waiting for the live view, new ones are left out
MAX_WAITING_FRAMES = 2500
BEHIND_MESSAGES = 500  # while more messages wait to be recorded, nothing is drawn
MAX_CLOSING_S = 60  # a process that does not end within these whole seconds is killed
# Rerun's log on standard error: plain text, and no warnings of a slow viewer, for which frames are
# left out. Arrow's own allocator would keep unused memory.
LIBRARY_OPTIONS = {
    "RUST_LOG": "warn,re_quota_channel=error",
    "NO_COLOR": "1",
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}
SOCKET_POLL_S = 0.02  # polling, because to wake a blocked reader costs the sender 25 µs per tick


class LiveView:
    """A thread that makes and feeds a live view, so that slow viewers do not delay the recording.

    Frames and images for which the thread is too slow are left out until it has drawn all that
    wait. Log, skills and changes of mode or reason are always drawn. Set `is_paused` while the
    recording is behind; nothing is drawn then.
    """

    def __init__(self, make: Callable[[], Viewer]) -> None:
        # the address; empty while the view starts, None once it has failed
        self.url: str | None = ""
        self.problems: list[str] = []
        self.left_out = 0  # number of frames and images
        self.is_paused = True
        self._waiting: deque[Callable[[Viewer], object]] = deque()
        self._outcome = (-1, -1)  # mode and reason of the newest frame
        # number of frames and images that were left out last, and are not in the log yet
        self._gap = 0
        self._overflows = False
        self._ended = threading.Event()
        self._thread = threading.Thread(
            target=self._draw, args=(make,), name="live view", daemon=True
        )
        self._thread.start()

    def put(self, act: Callable[[Viewer], object]) -> None:
        """Queue what is always drawn."""
        if self._thread.is_alive():
            self._waiting.append(act)

    def add(self, received: TickMessage) -> None:
        """Queue a tick, which is left out if too many wait, unless it changes mode or reason."""
        frame = received.frame
        time_ns = int(received.timing["time_ns"])
        events = [(event.kind, event.payload) for event in received.tick.inbox]
        outcome = int(frame["mode"]), int(frame["reason"])
        is_changed = outcome != self._outcome
        self._outcome = outcome
        if not is_changed and self._is_left_out():
            for kind, payload in events:
                if kind == "skill":
                    self.put(lambda viewer, skill=payload: viewer.learn(skill))  # type: ignore[misc]
            return
        if self._gap:
            text = (
                f"{self._gap} frames and images before tick {received.tick.index} are left out: "
                "too slow to draw"
            )
            self._gap = 0
            self.put(lambda viewer: viewer.gap(text, time_ns))
        self.put(lambda viewer: viewer.add(frame, time_ns, received.timing, events))

    def image(self, image: ImageArrival) -> None:
        """Queue an image, which is left out if too many entries wait."""
        if not self._is_left_out():
            self.put(
                lambda viewer: viewer.image(image.key, decode_image(image.data), image.time_ns)
            )

    def _is_left_out(self) -> bool:
        """True if there is no room for a frame or image, which is counted."""
        self._overflows = len(self._waiting) > (0 if self._overflows else MAX_WAITING_FRAMES)
        self._gap += self._overflows
        self.left_out += self._overflows
        return self._overflows

    def _draw(self, make: Callable[[], Viewer]) -> None:
        self._wait()
        try:
            viewer = make()
            self.url = viewer.url
            gc.collect()
            release_start_memory()
            while not (self._ended.wait(SOCKET_POLL_S) and not self._waiting):
                while self._waiting:
                    self._wait()
                    self._waiting.popleft()(viewer)
            viewer.close()
        except Exception as error:  # the recording continues without a live view
            self.problems.append(f"the live view ended: {in_words(error)}")
            self.url = None
        self._waiting.clear()

    def _wait(self) -> None:
        while self.is_paused and not self._ended.wait(SOCKET_POLL_S):
            pass

    def close(self) -> None:
        """End the live view within LIVE_END_S."""
        self._ended.set()
        self._thread.join(LIVE_END_S)


class ScribeProcess:
    """Writer of the messages that the process receives, which passes them to the live view too.

    A failure is reported and ends only the part that failed.
    """

    def __init__(self, setup: ScribeSetup, skill: bytes | None, source: socket.socket) -> None:
        self._source = source
        self._joints = len(setup.settings.joints.names)
        self._has_wishes = setup.settings.skill.has_wishes
        self._errors: list[str] = []
        self._live: LiveView | None = None
        self._reported_left_out = 0
        self._reported_kept = 0
        self._is_behind = True  # at the start, with the higher weight
        if setup.live_port is not None:
            self._live = LiveView(lambda: _viewer(setup, skill))
        paths = RecordingPaths(setup.settings, setup.folder, setup.recording, attempt=setup.attempt)
        self._segments = Segments(
            setup.settings,
            paths,
            say=self._errors.append,
            unmarked=setup.unmarked,
            constants=setup.constants,
        )
        state = (
            None
            if setup.state is None
            else np.frombuffer(
                setup.state, state_layout(self._joints, has_wishes=self._has_wishes)
            )[0]
        )
        self._segments.begin(skill, state)
        self.report()

    def report(self) -> None:
        """Send a report: new errors, paths of files, and the number of ticks on disk."""
        live = self._live
        if live is not None:
            while live.problems:
                self._errors.append(live.problems.pop(0))
            if live.left_out > 2 * self._reported_left_out:
                self._reported_left_out = live.left_out
                self._errors.append(
                    f"the live view is too slow: {live.left_out} frames and images were left out"
                )
        segments = self._segments
        report = ScribeReport(
            state=segments.state,
            recording=None if segments.path is None else str(segments.path),
            live=None if live is None else live.url,
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
            self._reported_kept = report.kept

    def take(self, message: bytes, skills: list[bytes]) -> None:
        """Write one message, and pass it to the live view. Ticks that are on disk with it are
        reported at once, because unreported ones count as lost if this process dies.
        """
        received = unpack(message, skills, joints=self._joints, has_wishes=self._has_wishes)
        live = self._live
        if isinstance(received, Note):
            key = received.key
            text = received.text
            noted_ns = received.time_ns
            self._segments.note(key, text, noted_ns)
            if key != "status" and live is not None:
                live.put(lambda viewer: viewer.note(key, text, noted_ns))
            return
        if isinstance(received, ImageArrival):
            self._segments.image(received.key, received.data, received.time_ns)
            if live is not None:
                live.image(received)
            return
        missing = self._segments.write(received)
        if self._segments.kept != self._reported_kept:
            self.report()
        if live is None:
            return
        if missing:
            time_ns = int(received.timing["time_ns"])
            gap = f"{missing} ticks before tick {received.tick.index} are not recorded"
            live.put(lambda viewer: viewer.gap(gap, time_ns))
        if (skill := received.skill) is not None:
            live.put(lambda viewer: viewer.learn(skill))
        live.add(received)

    def catch_up(self, waiting: int) -> None:
        """Pause the live view and raise the process's weight while the recording is behind."""
        # it is behind above BEHIND_MESSAGES, until a tenth of that
        if waiting <= BEHIND_MESSAGES / 10 if self._is_behind else waiting > BEHIND_MESSAGES:
            self._is_behind = not self._is_behind
            _run_with(CATCH_UP_NICE if self._is_behind else child.CHILD_NICE)
            if self._live is not None:
                self._live.is_paused = self._is_behind

    def flush(self) -> None:
        """Pass the recorded data to the operating system and report it."""
        self._segments.flush()
        self.report()

    def close(self) -> None:
        """End the recording and the live view."""
        self._segments.close()
        self.report()
        if self._live is not None:
            self._live.close()
        self.report()


def _run_with(nice: int) -> None:
    """Set the weight of this thread, and of the session of all children."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)
        Path("/proc/self/autogroup").write_text(str(nice))


def _viewer(setup: ScribeSetup, skill: bytes | None) -> Viewer:
    from thirdhand.viewer.stream import Viewer  # its import takes half a second and starts threads

    return Viewer(
        urdf=urdf_path(setup.settings),
        live_port=setup.live_port,
        settings=setup.settings,
        skill=skill,
    )


def _receive(source: socket.socket, buffer: bytearray) -> tuple[bytes, list[bytes]]:
    """The next message and the files sent with it; an empty message if the other side closed."""
    while True:
        try:
            size, ancillary, _, _ = source.recvmsg_into(
                [buffer], socket.CMSG_SPACE(16 * 4), socket.MSG_DONTWAIT
            )
            break
        except BlockingIOError:
            time.sleep(SOCKET_POLL_S)
    files = [bytes(child.from_memory(fd)[0]) for fd in child.descriptors(ancillary)]
    return bytes(memoryview(buffer)[:size]), files


def _work(source: socket.socket) -> None:
    """Write what a second thread reads from the socket, until that is closed and all is written."""
    buffer = bytearray(MAX_PACKET_BYTES)
    first, skills = _receive(source, buffer)
    setup = msgspec.json.decode(first, type=ScribeSetup)
    waiting: deque[tuple[bytes, list[bytes]]] = deque()
    ended = threading.Event()

    def read() -> None:
        # an ordinary weight: it needs little time, and its queue shows the backlog
        with contextlib.suppress(OSError):
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
        if now - flushed > FLUSH_S:
            scribe.flush()
            flushed = now
    scribe.close()


def run(source: socket.socket) -> None:
    """Record and show the received messages until the other side closes."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # it ends with its socket, after writing everything
    share_one_heap()
    for name, value in LIBRARY_OPTIONS.items():
        os.environ.setdefault(name, value)
    child.end_with_parent(MAX_CLOSING_S)
    _run_with(CATCH_UP_NICE)
    _work(source)
