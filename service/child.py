"""A child process with a socket to it, and bytes handed over as memory that both map, uncopied."""

from __future__ import annotations

import contextlib
import mmap
import os
import select
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

_LENGTH = struct.Struct("<Q")
_ALIGNED = 64  # bytes: so that arrays can stay where they arrive


class Child(NamedTuple):
    """A running child and our end of the socket; the descriptor of its end is its only argument."""

    process: subprocess.Popen[bytes]
    socket: socket.socket


def python(*arguments: str) -> tuple[list[str], dict[str, str]]:
    """Command line and environment of a Python that finds these packages in any directory."""
    root = str(Path(__file__).parents[1])
    path = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
    return [sys.executable, "-P", *arguments], os.environ | {"PYTHONPATH": path}


def start(module: str, kind: socket.SocketKind) -> Child:
    """Starts `python -m module DESCRIPTOR`.

    A terminal's Ctrl-C is not for it: it ends when its socket closes.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, kind)
    command, environment = python("-m", module, str(theirs.fileno()))
    with theirs:
        process = subprocess.Popen(
            command,
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,
        )
    return Child(process, ours)


def end_with_parent(grace_s: float = 0.0) -> None:
    """For the child: ends it `grace_s` [s] after its parent ended, whatever it does then.

    Most end before, with their socket. The kernel's own signal for it (PR_SET_PDEATHSIG) goes by
    the thread that started the child, which may end long before its process.
    """

    def wait(parent: int) -> None:
        select.select([parent], [], [])
        time.sleep(grace_s)
        os._exit(1)

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
