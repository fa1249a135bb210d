"""The daemon's end of the scribe, the process that writes the recording and feeds the viewer.

The loop makes one non-blocking send a tick over a socket pair that keeps message boundaries. What
does not fit waits here, in a queue of some seconds; a slow or dead scribe does not delay the loop.
A tick that the queue has no room for is counted as lost, and the next one that fits carries state
and skill, so that a replay continues behind the gap. A scribe that is dead or hangs is replaced;
one that is slow is not. What was sent to a dead one and not reported as on disk is lost.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from service.core.frame import Outputs, Record, Tick
from service.process import child
from service.scribe.protocol import LARGEST_MESSAGE, ScribeReport, ScribeSetup, pack, pack_note
from service.settings.config import Settings

BUFFER_BYTES = 4 * 1024 * 1024  # some seconds of ticks
_SO_SNDBUFFORCE = 32  # of Linux; Python does not name it
READY_TIMEOUT_S = 30.0  # without progress, for a scribe to begin
RESTART_S = 1.0
NOT_RECORDED = "ticks are not recorded"
SILENT_S = 5.0  # a scribe reports twice a second
CLOSE_S = 45.0  # less than `thirdhand demo` waits for the daemon's end
QUEUED_S = 10.0  # of ticks, that wait for a scribe that begins or falls behind
CATCH_UP = 8  # ticks sent in the time of one


class Scribe:
    """Starts the scribe process, and sends it ticks and notes.

    `send` and `skip` are for the loop, `start`, `supervise`, `status` and `close` for one other
    thread, `note` and `keep` for any.

    In `folder` it writes `<cell>-<UTC time>.mcap` and `.rrd`, one after another; `recording` and
    `rrd` are explicit paths. Without any of these and without `live_port` no process is started.
    One that hangs for `silent_s` [s], or for `ready_s` before it has begun, is replaced.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        folder: Path | None = None,
        recording: Path | None = None,
        rrd: Path | None = None,
        live_port: int | None = None,
        restart_s: float = RESTART_S,
        silent_s: float = SILENT_S,
        ready_s: float = READY_TIMEOUT_S,
    ) -> None:
        self._settings = settings
        self._restart_s, self._silent_s, self._ready_s = restart_s, silent_s, ready_s
        self._folder, self._recording, self._rrd, self._live_port = folder, recording, rrd, live_port
        self._wanted = any(value is not None for value in (folder, recording, rrd, live_port))
        # of the child that ticks are sent to; None once that is dead
        self._socket: socket.socket | None = None
        self._child: child.Child | None = None
        self._progress: child.Progress | None = None
        self._listens = False  # whether the child has reported
        self._queue: deque[tuple[bytes, list[bytes]]] = deque()  # messages, and the skills sent along; for the loop
        self._most = round(QUEUED_S * settings.rate_hz)
        self._send_all, self._overflows = True, False
        self._gap = self._lost = self._sent = self._restarts = 0
        self._since_state = 0
        self._buried = self._unmarked = 0  # ticks lost with dead scribes; those of them that no recording marks
        self._sent_before = 0  # to dead scribes
        self._started = 0.0
        self._memory: dict[int, tuple[bytes, int]] = {}
        self._report = ScribeReport()
        self._errors: deque[str] = deque(maxlen=5)

    def start(self, *, skill: bytes, state: Record | None) -> None:
        """Starts the process; ticks may be sent at once. Never waits."""
        if self._wanted:
            self._send_all = state is None
            self._spawn(skill, state)

    def ready(self, timeout_s: float) -> bool:
        """True once the process has begun to work; waits for it for at most `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while not self._listens and self._child is not None and time.monotonic() < deadline:
            self._listen()
            if self._child.poll() is not None:
                break
            time.sleep(0.01)
        return self._listens

    def keep(self, skill: bytes) -> int:
        """The descriptor of a memory file with the skill, ready to be sent.

        Preparing takes 1 ms a megabyte: call it on another thread before the loop adopts a skill.
        """
        known = self._memory.get(id(skill))
        if known is None:
            fd = child.in_memory(skill)
            known = self._memory.setdefault(id(skill), (skill, fd))
            if known[1] != fd:
                os.close(fd)
            elif len(self._memory) > 4:
                os.close(self._memory.pop(next(iter(self._memory)))[1])
        return known[1]

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
        """Sends a tick, and what it published by key.

        Never waits; a tick that cannot be sent is counted. `state` is called once a second, and
        after a loss.
        """
        if not self._wanted:
            return
        if self._overflows or len(self._queue) >= self._most:
            self._drain()
            self._overflows = bool(self._queue) or not self._most  # one gap rather than many
            if self._overflows:
                self.skip()
                return
        send_all = self._send_all
        self._since_state += 1
        with_state = send_all or self._since_state >= self._settings.rate_hz
        after = state() if with_state else None
        message = pack(tick, frame, timing, state=after, lost=self._gap, with_skill=send_all, outputs=outputs)
        skills = [event.payload for event in tick.inbox if event.kind == "skill"]
        self._queue.append((message, [*skills, skill] if send_all else skills))
        self._gap, self._send_all = 0, False
        if with_state:
            self._since_state = 0
        self._drain()

    def _drain(self) -> None:
        """Sends messages that wait, as many as the socket takes and CATCH_UP at most."""
        target = self._socket
        for _ in range(CATCH_UP):
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
            except OSError:  # it is dead: the next one begins with the next tick
                self._send_all = True
                if self._socket is target:
                    self._socket = None
                return
            self._queue.popleft()
            self._sent += 1

    def skip(self) -> None:
        """Counts a tick that cannot be sent as lost; for the loop."""
        if not self._wanted:
            return
        self._gap += 1
        self._lost += 1
        self._send_all = True

    def note(self, key: str, text: str, time_ns: int) -> None:
        """Sends a text for the recording, under `<cell>/<key>`; the viewer shows those under
        `requests` and `log`. Never waits.
        """
        target = self._socket
        if target is not None:
            with contextlib.suppress(OSError):
                target.send(pack_note(key, text, time_ns))

    def supervise(self) -> None:
        """Reads the process's reports, and replaces it if it is dead or hangs, with new files. To
        be called ten times a second.
        """
        if self._child is None or self._progress is None:
            return
        self._listen()
        code = self._child.poll()
        if code is None:
            limit_s = self._silent_s if self._listens else self._ready_s
            if self._progress.is_hung(limit_s):
                self._progress.report()
                self._errors.append(f"the scribe made no progress for {limit_s:g} s and is replaced")
                self._child.kill()
            return
        self._socket = None
        if time.monotonic() - self._started >= self._restart_s:
            self._errors.append(f"the scribe ended with code {code}")
            self._bury()
            self._child.socket.close()
            self._restarts += 1
            self._send_all = True
            self._spawn(None, None)

    def _bury(self) -> None:
        """Counts the ticks that were sent to a dead process and are not on disk."""
        self._listen()
        last = self._report
        unreported = max(0, self._sent - self._sent_before - last.kept - last.lost)
        self._buried += last.lost + unreported
        self._unmarked = last.unmarked + unreported + (0 if self._listens else self._unmarked)
        self._sent_before, self._report, self._listens = self._sent, ScribeReport(), False

    def status(self) -> dict[str, Any]:
        """The process's status: alive, its state (`off`, `starting`, `recording`, `drawing` where
        no recording is wanted, `interrupted` where none can be written), ticks sent and lost,
        restarts, where it writes, the latest errors.
        """
        alive = self._listens and self._child is not None and self._child.poll() is None
        report = self._report
        return {
            "alive": alive,
            "state": report.state if alive else "starting" if self._child is not None else "off",
            "pid": None if self._child is None else self._child.pid,
            "sent": self._sent,
            "lost": self._lost + self._buried + report.lost,
            "restarts": self._restarts,
            "recording": report.recording,
            "rrd": report.rrd,
            "live": report.live,
            "errors": list(self._errors),
            "free_mb": report.free_mb,
            "mb_per_hour": report.mb_per_hour,
            "keep_mb_left": report.keep_mb_left,
        }

    def close(self, timeout_s: float = CLOSE_S) -> str:
        """What the recordings lack, in words (empty: nothing), once the process has written all
        that was sent and closed its files; it is killed if it hangs, or if that takes longer than
        `timeout_s` [s].
        """
        running, progress = self._child, self._progress
        if running is not None and progress is not None:
            progress.report()
            running.send_signal(signal.SIGCONT)  # where it was stopped
            end, is_told = time.monotonic() + timeout_s, False
            while running.poll() is None:
                self._drain()
                if not is_told and not self._queue:
                    is_told = True
                    with contextlib.suppress(OSError):
                        running.socket.shutdown(socket.SHUT_WR)  # also where a forked process still holds this end
                if time.monotonic() > end or progress.is_hung(self._ready_s):
                    self._errors.append("the scribe was not done in time: its last data are lost")
                    running.kill()
                    running.wait(timeout_s)
                    break
                time.sleep(0.005)
            self._listen()
            last, self._socket = self._report, None
            self._bury()
            self._report = msgspec.structs.replace(last, lost=0)
            self._child = None
            running.socket.close()
            for _, fd in self._memory.values():
                os.close(fd)
            self._memory = {}
            self._lost, self._queue, self._most = self._lost + len(self._queue), deque(), 0
        lost = self._lost + self._buried if self._folder is not None or self._recording is not None else 0
        return f"{lost} of {self._sent + self._lost} {NOT_RECORDED}" if lost else ""

    def _spawn(self, skill: bytes | None, state: Record | None) -> None:
        """Starts a process, and sends it its setup."""
        folder, recording, rrd = (
            None if path is None else str(path.absolute()) for path in (self._folder, self._recording, self._rrd)
        )
        begin = None if state is None else state.tobytes()
        places = folder, recording, rrd, self._live_port
        setup = ScribeSetup(self._settings, begin, *places, self._restarts + 1, self._unmarked)
        self._child = child.start("scribe", "service.scribe.process", socket.SOCK_SEQPACKET)
        self._progress, self._started = child.Progress(self._child), time.monotonic()
        ours = self._child.socket
        ours.setblocking(False)
        try:
            ours.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, BUFFER_BYTES)
        except PermissionError:  # then it is cut to what the system allows
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        with contextlib.suppress(OSError):
            if skill is None:
                ours.send(msgspec.json.encode(setup))
            else:
                socket.send_fds(ours, [msgspec.json.encode(setup)], [self.keep(skill)])
        self._socket = ours

    def _listen(self) -> None:
        """Reads the reports that have come."""
        if self._child is None or self._progress is None or not self._child.has_begun():
            return
        with contextlib.suppress(OSError):
            while data := self._child.socket.recv(LARGEST_MESSAGE, socket.MSG_DONTWAIT):
                self._report = msgspec.json.decode(data, type=ScribeReport)
                self._progress.report()
                self._errors.extend(self._report.errors)
                self._listens = True
