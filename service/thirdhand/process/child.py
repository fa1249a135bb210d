"""Child processes, each with a socket to it, and bytes shared with them in memory.

Children are forked from one process, the fork server. It imports the modules that they need and
does nothing else, so a child that was killed is replaced in the time of a fork. The fork server has
one thread; the children themselves import the libraries that start threads.
"""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import atexit
import contextlib
import ctypes
import gc
import importlib
import logging
import mmap
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from thirdhand.process.pages import release_start_memory

_PART_LENGTH = struct.Struct("<Q")
_PID = struct.Struct("<i")
ENDED_POLL_S = 0.5  # interval at which a process is looked for, where the kernel does not report it
_ALIGNED = 64  # [bytes] parts begin at multiples of this, so that arrays are used without a copy
# Linux defines them, Python does not
_PR_SET_PDEATHSIG = 1
_PR_SET_NAME = 15
_PR_SET_CHILD_SUBREAPER = 36
CHILD_NICE = 5  # children yield to the control process
CHILD_POLL_S = 0.01
MAX_REQUEST_BYTES = 4096  # a request to the fork server is a few names
NOT_STARTED = 255  # the exit code of a child whose fork server ended before it forked the child


class Child:
    """A child process and this end of the socket to it.

    Messages that are sent before the process exists wait in the socket. Methods may be called from
    any thread.
    """

    def __init__(self, own: socket.socket, server: subprocess.Popen[bytes]) -> None:
        self.socket = own
        self.pid: int | None = None
        self.returncode: int | None = None
        self._server = server
        self._lock = threading.Lock()

    def has_begun(self, timeout_s: float = 0.0) -> bool:
        """True once the process exists or has existed; waits for it for at most `timeout_s`."""
        with self._lock:
            if self.pid is None and self.returncode is None:
                poll = select.poll()  # select() knows no descriptor above 1023
                poll.register(self.socket, select.POLLIN)
                if poll.poll(1000 * timeout_s):
                    received = b""
                    with contextlib.suppress(OSError):
                        received = self.socket.recv(_PID.size)
                    if received:
                        (self.pid,) = _PID.unpack(received)
                    else:
                        self.returncode = NOT_STARTED
            return self.pid is not None

    def poll(self) -> int | None:
        """The exit code once the process has ended, negative where a signal ended it; else None."""
        if self.has_begun():
            with self._lock:
                if self.returncode is None and self.pid is not None:
                    try:
                        ended, status = os.waitpid(self.pid, os.WNOHANG)
                        self.returncode = os.waitstatus_to_exitcode(status) if ended else None
                    except ChildProcessError:
                        self.returncode = NOT_STARTED
        return self.returncode

    def wait(self, timeout_s: float = float("inf")) -> bool:
        """True if the process ends within `timeout_s` [s]."""
        end = time.monotonic() + timeout_s
        while self.poll() is None:
            if time.monotonic() > end:
                return False
            time.sleep(CHILD_POLL_S)
        return True

    def send_signal(self, number: int) -> None:
        """Send a signal to the process, or to the fork server if that has not forked it yet."""
        if self.poll() is None:
            with self._lock, contextlib.suppress(ProcessLookupError):
                if self.pid is None:
                    self._server.send_signal(number)
                elif self.returncode is None:
                    os.kill(self.pid, number)

    def kill(self) -> None:
        """End the process at once."""
        self.send_signal(signal.SIGKILL)

    @property
    def working_pid(self) -> int:
        """The process itself, or the fork server if that has not forked it yet."""
        return self._server.pid if self.pid is None else self.pid


class Progress:
    """Distinguish a child that hangs from one that is slow.

    A child hangs if it did nothing for `limit_s` [s] without waiting for processor or disk, or if
    it used `limit_s` [s] of processor time without a report. Only its main thread is measured. Call
    `is_hung` several times within `limit_s`.
    """

    def __init__(self, child: Child) -> None:
        self._child = child
        self.report()

    def report(self) -> None:
        """Note that the child has reported something."""
        self._pid = self._child.working_pid
        _, self._used_s = _activity(self._pid)
        self._reported_s = self._used_s
        self._moved_s = time.monotonic()

    def is_hung(self, limit_s: float, *, busy_s: float | None = None) -> bool:
        """True if the child makes no progress; `busy_s` replaces the limit of processor time."""
        if self._child.working_pid != self._pid:  # the child was forked after the last report
            self.report()
        state, used_s = _activity(self._pid)
        now_s = time.monotonic()
        if used_s != self._used_s or state in "RD":
            self._used_s = used_s
            self._moved_s = now_s
        return now_s - self._moved_s > limit_s or used_s - self._reported_s > (busy_s or limit_s)


def _activity(pid: int) -> tuple[str, float]:
    """State of a process's main thread as one letter, and the processor time it has used [s]."""
    try:
        fields = Path(f"/proc/{pid}/task/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return "", 0.0
    state, *numbers = fields.rpartition(")")[2].split()
    return state, (int(numbers[10]) + int(numbers[11])) / os.sysconf("SC_CLK_TCK")


class ForkServer:
    """This process's end of a fork server, which starts at the first request."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._modules: dict[str, None] = {}  # ordered by their first request

    def start(self, name: str, module: str, kind: socket.SocketKind) -> Child:
        """A child that calls `run(socket)` of a module. Never waits.

        The operating system lists it under the first 15 characters of `name`. A terminal's Ctrl-C
        does not reach it: it must end when its socket closes.
        """
        parent_end, theirs = socket.socketpair(socket.AF_UNIX, kind)
        with theirs:
            return Child(parent_end, self.request(module, name, descriptors=[theirs.fileno()]))

    def request(
        self, module: str, *more: str, descriptors: Iterable[int] = ()
    ) -> subprocess.Popen[bytes]:
        """Have the server import a module and, with a descriptor, fork a child that runs it."""
        with self._lock:
            self._modules[module] = None
            if self._process is None or self._process.poll() is not None:
                self._begin()
            try:
                return self._send(module, *more, descriptors=descriptors)
            except OSError:  # it has ended just now
                self._begin()
                return self._send(module, *more, descriptors=descriptors)

    def _send(self, *words: str, descriptors: Iterable[int] = ()) -> subprocess.Popen[bytes]:
        assert self._process is not None
        assert self._control is not None
        socket.send_fds(self._control, ["\0".join(words).encode()], list(descriptors))
        return self._process

    def _begin(self) -> None:
        self._end()
        # A child is forked twice; this process adopts it when its parent ends.
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = python("-m", "thirdhand.process.child", str(theirs.fileno()))
        with theirs:
            self._process = subprocess.Popen(
                command,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )
        for module in self._modules:
            self._send(module)

    def _end(self) -> None:
        if self._control is not None:
            self._control.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._process = None

    def close(self) -> None:
        """End the fork server; its children continue."""
        with self._lock:
            self._end()


_server = ForkServer()
end_server = _server.close
atexit.register(end_server)


def python(*arguments: str) -> list[str]:
    """Command line of this Python, which imports nothing from the present directory."""
    return [sys.executable, "-P", *arguments]


def preload(module: str) -> None:
    """Have this process's fork server import a module, so that a child that runs it starts at once.
    Never waits.
    """
    _server.request(module)


def start(name: str, module: str, kind: socket.SocketKind) -> Child:
    """A child of this process's fork server; see `ForkServer.start`."""
    return _server.start(name, module, kind)


def _serve(control: socket.socket) -> None:
    """The fork server: imports modules and forks children until the other end closes."""
    _continue_with_parent()
    _set_name("fork server")
    gc.disable()  # imports leave no garbage
    logging.getLogger("kmp").setLevel(logging.ERROR)  # the parent's log says what is compiled
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.nice(CHILD_NICE)
    while True:
        request, descriptors, _, _ = socket.recv_fds(control, MAX_REQUEST_BYTES, 1)
        if not request:
            return
        name, *more = request.decode().split("\0")
        module = importlib.import_module(name)
        if descriptors:
            release_start_memory()
            gc.freeze()  # children share the memory pages that they do not write to
            with socket.socket(fileno=descriptors[0]) as channel:
                try:
                    between = os.fork()
                except OSError:
                    # No process or memory is left: the socket closes, which the caller sees.
                    traceback.print_exc()
                    continue
                if between == 0:
                    control.close()
                    _fork_again(more[0], module, channel)
                os.waitpid(between, 0)


def _fork_again(name: str, module: Any, channel: socket.socket) -> None:
    """Fork the child's child, which runs the module and is adopted when this process ends."""
    code = 1
    try:
        between = os.getpid()
        if os.fork() == 0:
            while os.getppid() == between:
                time.sleep(0.0005)
            _set_name(name)
            gc.enable()
            channel.send(_PID.pack(os.getpid()))
            module.run(channel)
        code = 0
    except BrokenPipeError:  # the process that started it has ended
        pass
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def _set_name(name: str) -> None:
    """Set the name under which the operating system lists this process."""
    ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode(), 0, 0, 0)


def _continue_with_parent() -> None:
    """Have the kernel continue this process, if it was stopped, when its parent ends.

    The kernel also sends the signal when only the thread that started this process ends, so the
    signal must be harmless.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGCONT), 0, 0, 0)


def end_with_parent(grace_s: float = 0.0) -> None:
    """End this child `grace_s` [s] after its parent, also if it is stopped or busy.

    Most children end earlier, with their socket. The kernel's own signal (PR_SET_PDEATHSIG) cannot
    end them: it depends on the thread that started the child, which may end long before its
    process.
    """

    def end() -> None:
        time.sleep(grace_s)
        os._exit(1)

    _continue_with_parent()
    with contextlib.suppress(ProcessLookupError):  # it has just ended: the closed socket suffices
        when_ended(os.getppid(), end)


def when_ended(pid: int, then: Callable[[], object]) -> None:
    """Call `then` in a thread once a process has ended. Raises ProcessLookupError."""
    with contextlib.suppress(PermissionError):
        os.kill(pid, 0)
    process = -1
    with contextlib.suppress(OSError, AttributeError):  # a kernel before 5.3, or another system
        process = os.pidfd_open(pid)

    def wait() -> None:
        if process >= 0:
            select.select([process], [], [])
        else:
            with contextlib.suppress(ProcessLookupError):
                while True:
                    time.sleep(ENDED_POLL_S)
                    with contextlib.suppress(PermissionError):
                        os.kill(pid, 0)
        then()

    threading.Thread(target=wait, name="ends", daemon=True).start()


def in_memory(*parts: Any) -> int:
    """The descriptor of a file in memory with these parts, any objects with a buffer, in order."""
    fd = os.memfd_create("thirdhand")
    with open(fd, "wb", closefd=False) as file:
        for view in (memoryview(part).cast("B") for part in parts):
            file.write(_PART_LENGTH.pack(len(view)))
            file.write(bytes(-file.tell() % _ALIGNED))
            file.write(view)
            file.write(bytes(-file.tell() % _ALIGNED))
    return fd


def from_memory(fd: int) -> list[memoryview]:
    """The parts that `in_memory` wrote, without a copy. The descriptor is closed.

    Raises EOFError for a damaged file.
    """
    try:
        size = os.fstat(fd).st_size
        # map pages now, not at the first access in the loop
        populate = getattr(mmap, "MAP_POPULATE", 0)
        view = memoryview(
            mmap.mmap(fd, size, flags=mmap.MAP_SHARED | populate, prot=mmap.PROT_READ)
        )
    finally:
        os.close(fd)
    parts = []
    offset = 0
    while offset < size:
        (length,) = _PART_LENGTH.unpack_from(view, offset)
        offset += _ALIGNED
        if offset + length > size:
            raise EOFError("a part reaches beyond the end of the file")
        parts.append(view[offset : offset + length])
        offset += length + -length % _ALIGNED
    return parts


def descriptors(ancillary: Iterable[tuple[int, int, bytes]]) -> list[int]:
    """The descriptors in the ancillary data of `recvmsg`."""
    fds: list[int] = []
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
            fds += [fd for (fd,) in struct.iter_unpack("=i", data)]
    return fds


if __name__ == "__main__":
    with socket.socket(fileno=int(sys.argv[1])) as _control:
        _serve(_control)
