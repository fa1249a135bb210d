"""The skill worker: another process that computes for requests, and looks for ways out, so that the
control process need not.

A skill is returned as a small pickle with its arrays in shared memory, so that the control process
copies and solves nothing. What it computes with it imports when it is first asked, so that a start
costs nothing.
"""

from __future__ import annotations

from service import one_blas_thread  # noqa: F401

# isort: split
import os
import pickle
import select
import signal
import socket
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from service import child

if __name__ == "__main__":
    select.select([int(sys.argv[1])], [], [])

# isort: split
from service.config import Settings, robot_description
from service.contract.requests import ViaPoint
from service.core.frame import Vector
from service.core.way_out import WayOut
from service.learning.skill_file import SkillError, StoredSkill, decoded
from service.learning.via_points import MAX_GAIN, adapted

TIMEOUT_S, FIRST_S = 8.0, 25.0  # shorter than a client waits; the first answer comes after its imports


class SkillWorker:
    """Another process that loads and adapts skills.

    Methods may be called from any thread; it works on one request at a time.
    """

    def __init__(self, *, max_gain: float = MAX_GAIN) -> None:
        self._max_gain = max_gain
        self._busy = threading.Lock()
        self._child: child.Child | None = None
        self._first_s = FIRST_S  # that an answer of this child is waited for at least

    def start(self) -> None:
        """Starts the process, where it is not there."""
        if self._child is None or self._child.process.poll() is not None:
            self._end()
            self._child, self._first_s = child.start("service.daemon.skill_worker", socket.SOCK_STREAM), FIRST_S

    def load(self, path: Path, *, timeout_s: float = TIMEOUT_S) -> StoredSkill:
        """The skill in a file. Raises SkillError, also after `timeout_s` [s]."""
        loaded: StoredSkill = self._ask(timeout_s, path)
        return loaded

    def adapt(
        self, skill: StoredSkill, via_points: Sequence[ViaPoint], *, tolerance: float, timeout_s: float = TIMEOUT_S
    ) -> StoredSkill:
        """The skill that goes through these via-points and no others.

        Raises SkillError, also after `timeout_s` [s].
        """
        made: StoredSkill = self._ask(timeout_s, skill.file, tuple(via_points), tolerance, self._max_gain)
        return made

    def way_out(self, settings: Settings, *arguments: Vector, timeout_s: float = TIMEOUT_S) -> list[Vector]:
        """As `WayOut.find` of the cell. Raises SkillError, also after `timeout_s` [s]."""
        found: list[Vector] = self._ask(timeout_s, settings, *arguments)
        return found

    def close(self) -> None:
        """Ends the process, also while it works."""
        if (running := self._child) is not None:
            running.process.kill()
        with self._busy:
            self._end()

    def _end(self) -> None:
        if self._child is not None:
            self._child.socket.close()
            self._child.process.kill()
            self._child.process.wait()
            self._child = None

    def _ask(self, timeout_s: float, *request: Any) -> Any:
        with self._busy:
            self.start()
            assert self._child is not None
            timeout_s = max(timeout_s, self._first_s)
            try:
                self._child.socket.settimeout(timeout_s)
                _send(self._child.socket, pickle.dumps(request))
                answer, self._first_s = _receive(self._child.socket), 0.0
            except TimeoutError:
                self._end()
                raise SkillError(
                    f"the skill worker did not answer within {timeout_s:g} s; nothing was changed"
                ) from None
            except (OSError, EOFError):
                self._end()
                raise SkillError("the skill worker ended while it worked; nothing was changed, try again") from None
        if isinstance(answer, str):
            raise SkillError(answer)
        return answer


def _send(channel: socket.socket, *parts: Any) -> None:
    """Sends one message: its parts in shared memory, only the descriptor through the socket."""
    fd = child.in_memory(*parts)
    try:
        socket.send_fds(channel, [b"\0"], [fd])
    finally:
        os.close(fd)


def _receive(channel: socket.socket) -> Any:
    """One message, its arrays left in the shared memory that it came in."""
    _, descriptors, _, _ = socket.recv_fds(channel, 1, 1)
    if not descriptors:
        raise EOFError
    value, *buffers = child.from_memory(descriptors[0])
    return pickle.loads(value, buffers=buffers)


def _work(*request: Any) -> StoredSkill | list[Vector]:
    """What one request asks for."""
    if isinstance(request[0], Settings):
        settings, *arguments = request
        return WayOut(settings, robot_description(settings)).find(*arguments)
    return skill_of(*request)


def skill_of(
    source: Path | bytes, via_points: Sequence[ViaPoint] = (), tolerance: float = 0.0, max_gain: float = MAX_GAIN
) -> StoredSkill:
    """The skill in a file, or the one in force (the bytes of its file) through these via-points.

    Raises SkillError.
    """
    if isinstance(source, bytes):
        skill = adapted(
            decoded(source, origin="the skill in force"), via_points, tolerance=tolerance, max_gain=max_gain
        )
    else:
        try:
            skill = decoded(source.read_bytes(), origin=str(source))
        except OSError as error:
            raise SkillError(f"cannot read skill {source}: {error.strerror}") from None
    hands = skill.hands[0].reshape(2, 3)
    skill.predict(hands, 0 * hands, 0 * hands)  # what is computed once is computed here
    return skill


def _main(descriptor: int) -> None:
    """The child: one request after the other until the other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    child.end_with_parent()
    os.nice(10)
    with socket.socket(fileno=descriptor) as channel:
        while True:
            try:
                request = _receive(channel)
            except (EOFError, OSError):
                return
            buffers: list[pickle.PickleBuffer] = []
            try:
                answer: StoredSkill | list[Vector] | str = _work(*request)
            except Exception as error:  # any failure is an answer to the client
                answer = str(error) if isinstance(error, SkillError) else f"{type(error).__name__}: {error}"
            skill = pickle.dumps(answer, protocol=5, buffer_callback=buffers.append)
            try:
                _send(channel, skill, *(b.raw() for b in buffers))
            except BrokenPipeError:
                return


if __name__ == "__main__":
    _main(int(sys.argv[1]))
