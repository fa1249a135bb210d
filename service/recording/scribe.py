"""The daemon's end of the scribe, the process that writes the recording and feeds the viewer.

The loop makes one non-blocking send a tick over a socket pair that keeps message boundaries. A slow
or dead scribe does not delay it: a message that does not fit is counted as lost, and the next one
that fits carries state and skill, so that a replay continues behind the gap. A dead or silent
scribe is replaced; what was sent to it and not reported as on disk is lost.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import subprocess
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from service import child
from service.config import Settings
from service.core.frame import Outputs, Record, Tick
from service.recording.protocol import LARGEST_MESSAGE, ScribeReport, ScribeSetup, pack, pack_note

BUFFER_BYTES = 4 * 1024 * 1024  # some seconds of ticks
_SO_SNDBUFFORCE = 32  # of Linux; Python does not name it
READY_TIMEOUT_S = 15.0  # for a scribe to listen; doubled for the next one each time it is exceeded
LONGEST_READY_S = 240.0
RESTART_S = 1.0
NOT_RECORDED = "ticks are not recorded"
SILENT_S = 5.0  # a scribe reports twice a second


class Scribe:
    """Starts the scribe process, and sends it ticks and notes.

    `send` and `skip` are for the loop, `start`, `supervise`, `status` and `close` for one other
    thread, `note` and `keep` for any.

    In `folder` it writes `<cell>-<UTC time>.mcap` and `.rrd`, one after another; `recording` and
    `rrd` are explicit paths. Without any of these and without `live_port` no process is started.
    One that has not reported for `silent_s` [s] is replaced.
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
        self._ready_s = self._first_ready_s = ready_s
        self._restart_s, self._silent_s = restart_s, silent_s
        self._folder, self._recording, self._rrd, self._live_port = folder, recording, rrd, live_port
        self._wanted = any(value is not None for value in (folder, recording, rrd, live_port))
        # of the child that ticks are sent to; the loop reads it, other threads set it
        self._socket: socket.socket | None = None
        self._child: child.Child | None = None
        self._send_all = True
        self._gap = self._lost = self._sent = self._restarts = 0
        self._since_state = self._pause = 0
        self._owed = self._marked = 0  # ticks lost with dead scribes; how many of these the loop has marked
        self._buried = self._sent_before = 0  # ticks lost with dead scribes; ticks sent before the present one
        self._started = self._heard = 0.0
        self._memory: dict[int, tuple[bytes, int]] = {}
        self._report = ScribeReport()
        self._errors: deque[str] = deque(maxlen=5)

    def start(self, *, skill: bytes, state: Record | None) -> None:
        """Starts the process and waits until it listens. Problems are listed by `status`."""
        if not self._wanted:
            return
        self._send_all = state is None
        self._child = self._spawn(skill, state)
        if not self.ready(self._ready_s):
            ended = self._child.process.poll()
            self._errors.append(
                "the scribe does not listen yet"
                if ended is None
                else f"the scribe ended with code {ended} before it listened"
            )

    def ready(self, timeout_s: float) -> bool:
        """Whether the process listens; waits for it for `timeout_s` at most."""
        deadline = time.monotonic() + timeout_s
        while self._socket is None and self._child is not None and time.monotonic() < deadline:
            self._listen(timeout_s=min(0.1, timeout_s))
            if self._child.process.poll() is not None:
                break
        return self._socket is not None

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
        target = self._socket
        if target is None or self._pause:
            self._pause = max(0, self._pause - 1)
            if self._wanted:
                self.skip()
            return
        send_all = self._send_all
        self._since_state += 1
        with_state = send_all or self._since_state >= self._settings.rate_hz
        after, owed = state() if with_state else None, self._owed
        lost = self._gap + owed - self._marked
        message = pack(tick, frame, timing, state=after, lost=lost, with_skill=send_all, outputs=outputs)
        try:
            skills = [event.payload for event in tick.inbox if event.kind == "skill"]
            if send_all:
                skills.append(skill)
            if skills:
                socket.send_fds(target, [message], [self.keep(data) for data in skills])
            else:
                target.send(message)
        except OSError:
            self.skip()
            self._pause = self._settings.rate_hz // 10  # one gap rather than many
            return
        self._sent += 1
        self._gap, self._marked = 0, owed
        if send_all:
            self._send_all = False
        if with_state:
            self._since_state = 0

    def skip(self) -> None:
        """Counts a tick that cannot be sent as lost; for the loop."""
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
        """Reads the process's reports, and replaces it if it is dead or silent, with new files. To
        be called ten times a second.
        """
        if not self._wanted or self._child is None:
            return
        self._listen(timeout_s=0.0)
        process, now = self._child.process, time.monotonic()
        if process.poll() is None:
            patience_s = self._ready_s if self._socket is None else self._silent_s
            if now - self._heard > patience_s:
                if self._socket is None:
                    self._ready_s = min(2.0 * self._ready_s, LONGEST_READY_S)
                self._heard = now
                self._errors.append(f"the scribe was silent for {patience_s:g} s and is replaced")
                process.kill()
            return
        if self._socket is not None:
            self._errors.append(f"the scribe ended with code {process.returncode}")
            self._socket = None
        if now - self._started >= self._restart_s:
            self._bury()
            self._child.socket.close()
            self._restarts += 1
            self._child = self._spawn(None, None)

    def _bury(self) -> None:
        """Counts the ticks that were sent to a dead process and are not on disk."""
        self._listen(timeout_s=0.0)
        self._socket, last = None, self._report
        unreported = max(0, self._sent - self._sent_before - last.kept - last.lost)
        self._buried += last.lost + unreported
        self._owed += last.unmarked + unreported
        self._sent_before, self._report = self._sent, ScribeReport()

    def status(self) -> dict[str, Any]:
        """The process's status: alive, its state (`off`, `starting`, `recording`, `drawing` where
        no recording is wanted, `interrupted` where none can be written), ticks sent and lost,
        restarts, where it writes, the latest errors.
        """
        alive = self._socket is not None and self._child is not None and self._child.process.poll() is None
        report = self._report
        return {
            "alive": alive,
            "state": report.state if alive else "starting" if self._child is not None else "off",
            "pid": None if self._child is None else self._child.process.pid,
            "sent": self._sent,
            "lost": self._lost + self._buried + report.lost,
            "restarts": self._restarts,
            "recording": report.recording,
            "rrd": report.rrd,
            "live": report.live,
            "errors": list(self._errors),
            "free_mb": report.free_mb,
        }

    def close(self, timeout_s: float = 20.0) -> str:
        """What the recordings lack, in words (empty: nothing), once the process has written all
        that was sent and closed its files; it is killed if that takes longer than `timeout_s` [s].
        """
        running, self._socket = self._child, None
        if running is not None:
            with contextlib.suppress(OSError):
                running.socket.shutdown(socket.SHUT_WR)  # also where a forked process still holds this end
            running.process.send_signal(signal.SIGCONT)  # where it was stopped
            try:
                running.process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                self._errors.append(f"the scribe was not done after {timeout_s:g} s: its last data are lost")
                running.process.kill()
                running.process.wait()
            self._listen(timeout_s=0.0)
            last, self._socket = self._report, None
            self._bury()
            self._report = msgspec.structs.replace(last, lost=0)
            self._child = None
            running.socket.close()
            for _, fd in self._memory.values():
                os.close(fd)
            self._memory = {}
        lost = self._lost + self._buried if self._folder is not None or self._recording is not None else 0
        return f"{lost} of {self._sent + self._lost} {NOT_RECORDED}" if lost else ""

    def _spawn(self, skill: bytes | None, state: Record | None) -> child.Child:
        """A process that was sent its setup and nothing else yet."""
        folder, recording, rrd = (
            None if path is None else str(path.absolute()) for path in (self._folder, self._recording, self._rrd)
        )
        begin = None if state is None else state.tobytes()
        setup = ScribeSetup(self._settings, begin, folder, recording, rrd, self._live_port, self._restarts + 1)
        running = child.start("service.recording.process", socket.SOCK_SEQPACKET)
        self._started = self._heard = time.monotonic()
        ours = running.socket
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
        return running

    def _listen(self, *, timeout_s: float) -> None:
        """Reads the reports that have come; a process receives ticks from its first one on."""
        assert self._child is not None
        source = self._child.socket
        poll = select.poll()  # select() knows no descriptor above 1023
        poll.register(source, select.POLLIN)
        poll.poll(1000 * timeout_s)
        with contextlib.suppress(OSError):
            while data := source.recv(LARGEST_MESSAGE):
                self._report = msgspec.json.decode(data, type=ScribeReport)
                self._heard = time.monotonic()
                self._errors.extend(self._report.errors)
                if self._socket is None:
                    self._send_all = self._send_all or self._restarts > 0
                    self._socket, self._ready_s = source, self._first_ready_s
