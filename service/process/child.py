"""Child processes, each with a socket to it, and bytes handed over as memory that both map.

Children are forked from one process, the fork server, which imports what they need and does nothing
else: what it has imported is there for every later child. So a child that was killed is replaced in
the time of a fork. The fork server has one thread; libraries that start threads when they are
imported are left to the children.
"""

from __future__ import annotations

from service.process import one_blas_thread  # noqa: F401

# isort: split
import atexit
import contextlib
import ctypes
import gc
import importlib
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
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_LENGTH = struct.Struct("<Q")
_PID = struct.Struct("<i")
_ALIGNED = 64  # bytes: so that arrays can stay where they arrive
_PR_SET_PDEATHSIG, _PR_SET_NAME, _PR_SET_CHILD_SUBREAPER = 1, 15, 36  # of Linux; Python does not name them
NICE = 5  # of all children
POLL_S = 0.01
LONGEST_REQUEST = 4096  # bytes, to the fork server
NOT_STARTED = 255  # exit code of a child whose fork server ended before it was forked


class Child:
    """A child process and this end of the socket to it.

    What is sent before it exists waits in the socket. Methods may be called from any thread.
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
                    told = b""
                    with contextlib.suppress(OSError):
                        told = self.socket.recv(_PID.size)
                    if told:
                        (self.pid,) = _PID.unpack(told)
                    else:
                        self.returncode = NOT_STARTED
            return self.pid is not None

    def poll(self) -> int | None:
        """The exit code once the process has ended, negative where a signal ended it."""
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
            time.sleep(POLL_S)
        return True

    def send_signal(self, number: int) -> None:
        """Sends a signal to the process, or to the fork server where that has not forked it yet."""
        if self.poll() is None:
            with self._lock, contextlib.suppress(ProcessLookupError):
                if self.pid is None:
                    self._server.send_signal(number)
                elif self.returncode is None:
                    os.kill(self.pid, number)

    def kill(self) -> None:
        """Ends the process at once."""
        self.send_signal(signal.SIGKILL)

    @property
    def working_pid(self) -> int:
        """The process itself, or the fork server where that has not forked it yet."""
        return self._server.pid if self.pid is None else self.pid


class Progress:
    """Tells a child that hangs from one that is slow.

    A child hangs once it has done nothing for `limit_s` [s] without waiting for processor or disk,
    or once it has used the processor for `limit_s` [s] without a report. Only its main thread
    counts. `is_hung` is to be called several times within `limit_s`.
    """

    def __init__(self, child: Child) -> None:
        self._child = child
        self.report()

    def report(self) -> None:
        """The child has reported something."""
        self._pid = self._child.working_pid
        _, self._used_s = _activity(self._pid)
        self._reported_s, self._moved_s = self._used_s, time.monotonic()

    def is_hung(self, limit_s: float, *, busy_s: float | None = None) -> bool:
        """True if the child makes no progress; `busy_s` replaces the limit of processor time."""
        if self._child.working_pid != self._pid:  # it was forked since
            self.report()
        (state, used_s), now_s = _activity(self._pid), time.monotonic()
        if used_s != self._used_s or state in "RD":
            self._used_s, self._moved_s = used_s, now_s
        return now_s - self._moved_s > limit_s or used_s - self._reported_s > (busy_s or limit_s)


def _activity(pid: int) -> tuple[str, float]:
    """State of a process's main thread as one letter, and the processor time it has used [s]."""
    try:
        fields = Path(f"/proc/{pid}/task/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return "", 0.0
    state, *numbers = fields.rpartition(")")[2].split()
    return state, (int(numbers[10]) + int(numbers[11])) / os.sysconf("SC_CLK_TCK")


class _ForkServer:
    """This process's end of its fork server, which is started when it is first needed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._modules: dict[str, None] = {}  # in the order in which they were first wanted

    def request(self, module: str, *more: str, descriptors: Iterable[int] = ()) -> subprocess.Popen[bytes]:
        """Has a module imported, and with a descriptor a child forked that runs it."""
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
        # a child is forked twice, and adopted by this process once its parent has ended
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command, environment = python("-m", "service.process.child", str(theirs.fileno()))
        with theirs:
            self._process = subprocess.Popen(
                command,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=environment,
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
        """Ends the fork server; its children go on."""
        with self._lock:
            self._end()


_server = _ForkServer()
atexit.register(_server.close)


def python(*arguments: str) -> tuple[list[str], dict[str, str]]:
    """Command line and environment of a Python that finds these packages in any directory."""
    root = str(Path(__file__).parents[2])
    path = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
    return [sys.executable, "-P", *arguments], os.environ | {"PYTHONPATH": path}


def preload(module: str) -> None:
    """Has the fork server import a module, so that a child that runs it is there at once. Never
    waits.
    """
    _server.request(module)


def start(name: str, module: str, kind: socket.SocketKind) -> Child:
    """A child that calls `run(socket)` of a module. Never waits.

    The operating system lists it under the first 15 characters of `name`. A terminal's Ctrl-C does
    not reach it; it is to end when its socket closes.
    """
    own, theirs = socket.socketpair(socket.AF_UNIX, kind)
    with theirs:
        return Child(own, _server.request(module, name, descriptors=[theirs.fileno()]))


def _serve(control: socket.socket) -> None:
    """The fork server: imports modules and forks children until the other end closes."""
    _continue_with_parent()
    _set_name("fork server")
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.nice(NICE)
    while True:
        request, descriptors, _, _ = socket.recv_fds(control, LONGEST_REQUEST, 1)
        if not request:
            return
        name, *more = request.decode().split("\0")
        module = importlib.import_module(name)
        if descriptors:
            gc.collect()
            gc.freeze()  # children share the memory of what they leave untouched
            with socket.socket(fileno=descriptors[0]) as channel:
                try:
                    between = os.fork()
                except OSError:  # of processes or memory; who waits for the child sees its socket close
                    traceback.print_exc()
                    continue
                if between == 0:
                    control.close()
                    _fork_again(more[0], module, channel)
                os.waitpid(between, 0)


def _fork_again(name: str, module: Any, channel: socket.socket) -> None:
    """The child of the fork server, and the child's child, which is adopted when the first ends."""
    code = 1
    try:
        between = os.getpid()
        if os.fork() == 0:
            while os.getppid() == between:
                time.sleep(0.0005)
            _set_name(name)
            channel.send(_PID.pack(os.getpid()))
            module.run(channel)
        code = 0
    except BrokenPipeError:  # nobody waits for it any more
        pass
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def _set_name(name: str) -> None:
    """Sets the name under which the operating system lists this process."""
    ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode(), 0, 0, 0)


def _continue_with_parent() -> None:
    """Has the kernel continue this process, where it was stopped, when its parent ends.

    The signal also comes when only the thread ends that started this process, so it is harmless.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGCONT), 0, 0, 0)


def end_with_parent(grace_s: float = 0.0) -> None:
    """For the child: ends it `grace_s` [s] after its parent ended, whatever it does then; continues
    it then where it was stopped.

    Most end before, with their socket. The kernel's own signal for it (PR_SET_PDEATHSIG) goes by
    the thread that started the child, which may end long before its process.
    """

    def wait(parent: int) -> None:
        select.select([parent], [], [])
        time.sleep(grace_s)
        os._exit(1)

    _continue_with_parent()
    with contextlib.suppress(OSError, AttributeError):  # an older kernel: then its socket must do
        threading.Thread(target=wait, args=(os.pidfd_open(os.getppid()),), name="parent", daemon=True).start()


def in_memory(*parts: Any) -> int:
    """The descriptor of a file in memory that holds the parts (anything with a buffer) in order."""
    fd = os.memfd_create("thirdhand")
    with open(fd, "wb", closefd=False) as file:
        for view in (memoryview(part).cast("B") for part in parts):
            file.write(_LENGTH.pack(len(view)))
            file.write(bytes(-file.tell() % _ALIGNED))
            file.write(view)
            file.write(bytes(-file.tell() % _ALIGNED))
    return fd


def from_memory(fd: int) -> list[memoryview]:
    """The parts that `in_memory` wrote, where they lie; the descriptor is closed.

    Raises EOFError where it is damaged.
    """
    try:
        size = os.fstat(fd).st_size
        populate = getattr(mmap, "MAP_POPULATE", 0)  # now, not at a first touch in the loop
        view = memoryview(mmap.mmap(fd, size, flags=mmap.MAP_SHARED | populate, prot=mmap.PROT_READ))
    finally:
        os.close(fd)
    parts, at = [], 0
    while at < size:
        (length,) = _LENGTH.unpack_from(view, at)
        at += _ALIGNED
        if at + length > size:
            raise EOFError("a part ends behind the memory")
        parts.append(view[at : at + length])
        at += length + -length % _ALIGNED
    return parts


def descriptors(ancillary: Iterable[tuple[int, int, bytes]]) -> list[int]:
    """The descriptors among what came with a message of `recvmsg`."""
    found: list[int] = []
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
            found += [fd for (fd,) in struct.iter_unpack("=i", data)]
    return found


if __name__ == "__main__":
    with socket.socket(fileno=int(sys.argv[1])) as _control:
        _serve(_control)
