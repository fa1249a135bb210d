"""The workshop process: whatever computes for a request, so that the control process never does.

A skill comes back as a small pickle and its arrays in shared memory: taking it over costs the control process no copying and no solving.
"""

from __future__ import annotations

import mmap
import os
import pickle
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from service.skill import Skill, SkillError
from service.wire import ViaPoint

_HEADER = struct.Struct("<IQ")  # number of parts, bytes in all
_PART = struct.Struct("<Q")
TIMEOUT_S = 8.0  # shorter than a client waits


class Workshop:
    """Another process that makes skills. Methods may be called from any thread; one request is worked on at a time."""

    def __init__(self) -> None:
        self._busy = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None

    def load(self, path: Path, places: Sequence[ViaPoint] | None = None, *, tolerance: float = 0.05) -> Skill:
        """The skill in a file, adapted to places where some are given. Raises SkillError."""
        return self._ask("load", path, places, tolerance)

    def adapt(self, skill: Skill, places: Sequence[ViaPoint], *, tolerance: float) -> Skill:
        """The skill that goes through these places and no others. Raises SkillError."""
        return self._ask("adapt", skill.to_bytes(), tuple(places), tolerance)

    def close(self) -> None:
        """Ends the process, also while it works."""
        if self._child is not None:
            self._child.kill()
        with self._busy:
            self._end()

    def _end(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._child is not None:
            self._child.kill()
            self._child.wait()
            self._child = None

    def _ask(self, *request: Any) -> Skill:
        with self._busy:
            if self._child is None or self._child.poll() is not None:
                self._end()
                self._start()
            assert self._socket is not None
            try:
                _send(self._socket, [pickle.dumps(request)])
                answer = _receive(self._socket)
            except TimeoutError:
                self._end()
                raise SkillError(f"the workshop process did not answer within {TIMEOUT_S:g} s; nothing was changed") from None
            except (OSError, EOFError):
                self._end()
                raise SkillError("the workshop process ended while it worked; nothing was changed, try again") from None
        if isinstance(answer, Skill):
            return answer
        raise SkillError(answer)

    def _start(self) -> None:
        mine, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        with theirs:
            root = str(Path(__file__).parents[1])
            path = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
            threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
            command = [sys.executable, "-P", "-m", "service.workshop", str(theirs.fileno())]
            self._child = subprocess.Popen(command, pass_fds=[theirs.fileno()], env=os.environ | threads | {"PYTHONPATH": path})
        mine.settimeout(TIMEOUT_S)
        self._socket = mine


def _send(channel: socket.socket, parts: Sequence[Any]) -> None:
    """One message: its parts go into shared memory, only the descriptor through the socket."""
    views = [memoryview(part).cast("B") for part in parts]
    total = sum(map(len, views))
    shared = os.memfd_create("thirdhand")
    try:
        with open(shared, "wb", closefd=False) as file:
            for view in views:
                file.write(_PART.pack(len(view)))
                file.write(view)
                file.write(bytes(-len(view) % 64))
        socket.send_fds(channel, [_HEADER.pack(len(views), total)], [shared])
    finally:
        os.close(shared)


def _receive(channel: socket.socket) -> Any:
    """One message, its arrays left in the shared memory that it came in."""
    header, descriptors, _, _ = socket.recv_fds(channel, _HEADER.size, 1)
    if len(header) < _HEADER.size or not descriptors:
        raise EOFError
    count, _ = _HEADER.unpack(header)
    try:
        memory = mmap.mmap(descriptors[0], 0, flags=mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0), prot=mmap.PROT_READ)
    finally:
        os.close(descriptors[0])
    view, at, parts = memoryview(memory), 0, []
    for _ in range(count):
        (length,) = _PART.unpack_from(view, at)
        at += _PART.size
        parts.append(view[at : at + length])
        at += length + -length % 64
    return pickle.loads(parts[0], buffers=parts[1:])


def _work(kind: str, source: Any, places: Sequence[ViaPoint] | None, tolerance: float) -> Skill:
    if kind == "load":
        try:
            data = Path(source).read_bytes()
        except OSError as error:
            raise SkillError(f"cannot read skill {source}: {error.strerror}") from None
        skill = Skill.from_bytes(data, origin=str(source))
    else:
        skill = Skill.from_bytes(source, origin="the skill in force")
    if places is not None:
        skill = skill.adapted(places, tolerance=tolerance)
    skill.primitive.predict(skill.primitive.inputs[:1])  # what is computed once is computed here
    skill.primitive.jacobian(skill.primitive.inputs[0])
    skill.digest  # noqa: B018
    return skill


def _main(descriptor: int) -> None:
    """The child: one request after the other until the other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(10)
    with socket.socket(fileno=descriptor) as channel:
        while True:
            try:
                request = _receive(channel)
            except (EOFError, OSError):
                return
            buffers: list[pickle.PickleBuffer] = []
            try:
                answer: Skill | str = _work(*request)
            except Exception as error:  # the asker is told, whatever it was
                answer = str(error) if isinstance(error, SkillError) else f"{type(error).__name__}: {error}"
            _send(channel, [pickle.dumps(answer, protocol=5, buffer_callback=buffers.append), *(b.raw() for b in buffers)])


if __name__ == "__main__":
    _main(int(sys.argv[1]))
