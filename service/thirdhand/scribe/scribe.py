"""The daemon's end of the scribe, the process that writes the recording and feeds the live view.

The loop makes one non-blocking send per tick over a socket pair that keeps message boundaries.
Messages that do not fit wait in a queue of some seconds, so a slow or dead scribe does not delay
the loop. A tick that does not fit into the queue is counted as lost, and the next one that fits
carries state and skill, so that a replay continues after the gap. A scribe that is dead or hangs is
replaced; a slow one is not. Ticks that were sent to a dead scribe and not reported as on disk are
lost.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from thirdhand.core.frame import Outputs, Record, Tick
from thirdhand.process import child
from thirdhand.scribe.protocol import (
    MAX_PACKET_BYTES,
    ScribeReport,
    ScribeSetup,
    pack,
    pack_image,
    pack_note,
)
from thirdhand.settings.config import Settings

BUFFER_BYTES = 4 * 1024 * 1024  # the socket holds some seconds of ticks
_SO_SNDBUFFORCE = 32  # Linux defines it, Python does not
READY_TIMEOUT_S = 30.0  # a starting scribe without progress for this time is replaced
RESTART_S = 1.0  # minimum interval of starts
NOT_RECORDED = "ticks are not recorded"
# a scribe that reports twice a second hangs if it made no progress for this time
HUNG_AFTER_S = 5.0
CLOSE_TIMEOUT_S = 45.0  # less than `thirdhand demo` waits for the daemon's end
MAX_QUEUED_S = 10.0  # the queue holds this time of ticks for a scribe that starts or is behind
REPORTED = ("recording", "free_mb", "mb_per_hour", "keep_mb_left")  # of a report, in the status
MAX_SENDS_PER_TICK = 8  # waiting ticks are sent faster than new ones arrive


class Scribe:
    """The owner of the scribe process, which sends it ticks and notes.

    `send` and `skip` are for the loop, `start`, `supervise`, `image`, `status` and `close` for one
    other thread, `note` and `keep` for any thread.

    In `folder` the process writes `<cell>-<UTC time>.mcap`, one after another; `recording` is an
    explicit path. Without any of these and without `live_port` no process is started. A process
    that hangs for `silent_s` [s], or for `ready_s` [s] at its start, is replaced.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        folder: Path | None = None,
        recording: Path | None = None,
        live_port: int | None = None,
        restart_s: float = RESTART_S,
        silent_s: float = HUNG_AFTER_S,
        ready_s: float = READY_TIMEOUT_S,
    ) -> None:
        self._settings = settings
        self._restart_s = restart_s
        self._silent_s = silent_s
        self._ready_s = ready_s
        self._folder = folder
        self._recording = recording
        self._live_port = live_port
        self._wanted = any(value is not None for value in (folder, recording, live_port))
        # socket to the child; None once the child is dead
        self._socket: socket.socket | None = None
        self._child: child.Child | None = None
        self._progress: child.Progress | None = None
        self._listens = False  # True once the child has reported
        # messages with the skills to send; for the loop
        self._queue: deque[tuple[bytes, list[bytes]]] = deque()
        self._most = round(MAX_QUEUED_S * settings.rate_hz)  # messages in the queue; 0 once closed
        self._send_all = True  # the next message has state and skill
        self._overflows = False  # ticks are skipped until the queue is empty
        # ticks lost since the newest message, lost in all, sent; processes after the first
        self._gap = self._lost = self._sent = self._restarts = 0
        self._since_state = 0  # ticks since the newest message with a state
        # ticks lost with dead scribes, and those that no recording marks
        self._lost_before = self._unmarked = 0
        self._sent_before = 0  # ticks sent to dead scribes
        self._started = 0.0
        self._constants: dict[str, str] = {}
        # skills with the descriptors of their memory files, by `id`
        self._memory: dict[int, tuple[bytes, int]] = {}
        self._report = ScribeReport()
        self.newest_recording: str | None = None  # the path, also while no recording can be written
        self._errors: deque[str] = deque(maxlen=5)

    def start(
        self, *, skill: bytes, state: Record | None, constants: Mapping[str, str] | None = None
    ) -> None:
        """Start the process; ticks may be sent at once. Never waits. Recordings hold these digests
        of the core's `constants`.
        """
        self._constants = dict(constants or {})
        if self._wanted:
            self._send_all = state is None
            self._spawn(skill, state)

    def ready(self, timeout_s: float) -> bool:
        """True once the process works; waits for it for at most `timeout_s` [s]."""
        deadline = time.monotonic() + timeout_s
        while not self._listens and self._child is not None and time.monotonic() < deadline:
            self._listen()
            if self._child.poll() is not None:
                break
            time.sleep(0.01)
        return self._listens

    def keep(self, skill: bytes) -> int:
        """The descriptor of a memory file with the skill, ready to be sent.

        It takes 1 ms per megabyte: call it on another thread before the loop adopts a skill.
        """
        entry = self._memory.get(id(skill))
        if entry is None:
            fd = child.in_memory(skill)
            entry = self._memory.setdefault(id(skill), (skill, fd))
            if entry[1] != fd:
                os.close(fd)
            elif len(self._memory) > 4:
                os.close(self._memory.pop(next(iter(self._memory)))[1])
        return entry[1]

    def send(
        self,
        tick: Tick,
        frame: Record,
        timing: Record,
        *,
        state: Callable[[], Record],
        skill: bytes,
        outputs: Outputs = (),
    ) -> None:
        """Send a tick and its published messages by key.

        Never waits; a tick that cannot be sent is counted. `state` is called once a second and
        after a loss.
        """
        if not self._wanted:
            return
        if self._overflows or len(self._queue) >= self._most:
            self._drain()
            # ends when the queue is empty: one long gap
            self._overflows = bool(self._queue) or not self._most
            if self._overflows:
                self.skip()
                return
        send_all = self._send_all
        self._since_state += 1
        with_state = send_all or self._since_state >= self._settings.rate_hz
        after = state() if with_state else None
        message = pack(
            tick, frame, timing, state=after, lost=self._gap, with_skill=send_all, outputs=outputs
        )
        skills = [event.payload for event in tick.inbox if event.kind == "skill"]
        self._queue.append((message, [*skills, skill] if send_all else skills))
        self._gap = 0
        self._send_all = False
        if with_state:
            self._since_state = 0
        self._drain()

    def _drain(self) -> None:
        """Send waiting messages until the socket is full, but at most MAX_SENDS_PER_TICK."""
        target = self._socket
        for _ in range(MAX_SENDS_PER_TICK):
            if target is None or not self._queue:
                return
            message, skills = self._queue[0]
            try:
                if skills:
                    socket.send_fds(target, [message], [self.keep(data) for data in skills])
                else:
                    target.send(message)
            except BlockingIOError:
                return
            except OSError:  # the process is dead; the next one begins with the next tick
                self._send_all = True
                if self._socket is target:
                    self._socket = None
                return
            self._queue.popleft()
            self._sent += 1

    def skip(self) -> None:
        """Count a tick that cannot be sent as lost; for the loop."""
        if not self._wanted:
            return
        self._gap += 1
        self._lost += 1
        self._send_all = True

    def note(self, key: str, text: str, time_ns: int) -> None:
        """Send a text for the recording, under `<cell>/<key>`; the viewer shows `requests` and
        `log`. Never waits.
        """
        target = self._socket
        if target is not None:
            with contextlib.suppress(OSError):
                target.send(pack_note(key, text, time_ns))

    def image(self, key: str, data: bytes, time_ns: int) -> None:
        """Send an image, the CDR bytes of a CompressedImage, for recording and viewer. Never waits;
        an image that does not fit is left out.
        """
        target = self._socket
        if target is not None:
            fd = child.in_memory(data)
            with contextlib.suppress(OSError):
                socket.send_fds(target, [pack_image(key, time_ns)], [fd], socket.MSG_DONTWAIT)
            os.close(fd)

    def supervise(self) -> None:
        """Read the process's reports, and replace a process that is dead or hangs. Call it ten
        times a second.
        """
        if self._child is None or self._progress is None:
            return
        self._listen()
        code = self._child.poll()
        if code is None:
            limit_s = self._silent_s if self._listens else self._ready_s
            if self._progress.is_hung(limit_s):
                self._progress.report()
                self._errors.append(
                    f"the scribe made no progress for {limit_s:g} s, so it is replaced"
                )
                self._child.kill()
            return
        self._socket = None
        if time.monotonic() - self._started >= self._restart_s:
            self._errors.append(f"the scribe ended with code {code}")
            self._count_lost()
            self._child.socket.close()
            self._restarts += 1
            self._send_all = True
            self._spawn(None, None)

    def _count_lost(self) -> None:
        """Count the ticks that were sent to a dead process and are not on disk."""
        self._listen()
        last = self._report
        unreported = max(0, self._sent - self._sent_before - last.kept - last.lost)
        self._lost_before += last.lost + unreported
        self._unmarked = last.unmarked + unreported + (0 if self._listens else self._unmarked)
        self._sent_before = self._sent
        self._report = ScribeReport()
        self._listens = False

    def status(self) -> dict[str, Any]:
        """The process's status: alive, its state (`off`, `starting`, `recording`, `drawing` without
        a recording, `interrupted` if no recording can be written), ticks sent and lost, restarts,
        paths of files, and the latest errors.
        """
        alive = self._listens and self._child is not None and self._child.poll() is None
        report = self._report
        without_report = "off" if self._child is None else "starting"
        live = None
        if self._live_port is not None:
            live = report.live if alive else ""  # empty: it is starting
        return {
            "alive": alive,
            "state": report.state if alive else without_report,
            "pid": None if self._child is None else self._child.pid,
            "sent": self._sent,
            "lost": self._lost + self._lost_before + report.lost,
            "restarts": self._restarts,
            "errors": list(self._errors),
            **{name: getattr(report, name) for name in REPORTED},
            "live": live,
        }

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> str:
        """Let the process write everything and close its files, and return a message on ticks that
        are not recorded (empty: none). It is killed if it hangs, or after `timeout_s` [s].
        """
        running = self._child
        progress = self._progress
        if running is not None and progress is not None:
            progress.report()
            running.send_signal(signal.SIGCONT)  # it may have been stopped
            self._await_end(running, progress, timeout_s)
            self._listen()
            last = self._report
            self._socket = None
            self._count_lost()
            self._report = msgspec.structs.replace(last, lost=0)
            self._child = None
            running.socket.close()
            self._release()
        is_recorded = self._folder is not None or self._recording is not None
        lost = self._lost + self._lost_before if is_recorded else 0
        return f"{lost} of {self._sent + self._lost} {NOT_RECORDED}" if lost else ""

    def _await_end(self, running: child.Child, progress: child.Progress, timeout_s: float) -> None:
        """Send what is queued, and wait until the process has ended. It is killed if it hangs, or
        after `timeout_s` [s].
        """
        end_s = time.monotonic() + timeout_s
        is_shut = False
        while running.poll() is None:
            self._listen()  # else reports fill the socket, and the last one is left out
            self._drain()
            if not is_shut and not self._queue:
                is_shut = True
                with contextlib.suppress(OSError):
                    # a forked process may still hold this end
                    running.socket.shutdown(socket.SHUT_WR)
            if time.monotonic() > end_s or progress.is_hung(self._ready_s):
                self._errors.append("the scribe did not end in time: its last data are lost")
                running.kill()
                running.wait(timeout_s)
                break
            time.sleep(0.005)

    def _release(self) -> None:
        """Close the memory of the skills, and count the ticks that are still queued as lost."""
        for _, fd in self._memory.values():
            os.close(fd)
        self._memory = {}
        self._lost = self._lost + len(self._queue)
        self._queue = deque()
        self._most = 0

    def _spawn(self, skill: bytes | None, state: Record | None) -> None:
        """Start a process and send it its setup."""
        folder, recording = (
            None if path is None else str(path.absolute())
            for path in (self._folder, self._recording)
        )
        begin = None if state is None else state.tobytes()
        places = folder, recording, self._live_port
        setup = ScribeSetup(
            self._settings, begin, *places, self._restarts + 1, self._unmarked, self._constants
        )
        self._child = child.start("scribe", "thirdhand.scribe.process", socket.SOCK_SEQPACKET)
        self._progress = child.Progress(self._child)
        self._started = time.monotonic()
        ours = self._child.socket
        ours.setblocking(False)
        try:
            ours.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, BUFFER_BYTES)
        except PermissionError:  # the size is limited by the system
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        with contextlib.suppress(OSError):
            if skill is None:
                ours.send(msgspec.json.encode(setup))
            else:
                socket.send_fds(ours, [msgspec.json.encode(setup)], [self.keep(skill)])
        self._socket = ours

    def _listen(self) -> None:
        """Read the reports that have arrived."""
        if self._child is None or self._progress is None or not self._child.has_begun():
            return
        with contextlib.suppress(OSError):
            while data := self._child.socket.recv(MAX_PACKET_BYTES, socket.MSG_DONTWAIT):
                self._report = msgspec.json.decode(data, type=ScribeReport)
                self.newest_recording = self._report.recording or self.newest_recording
                self._progress.report()
                self._errors.extend(self._report.errors)
                self._listens = True
