"""The skill worker: a process that loads and adapts skills and searches for ways out, so that the
control process does not have to compute for requests.

It returns a skill as a small pickle with its arrays in shared memory, so that the control process
neither copies nor solves anything.
"""

from __future__ import annotations

import contextlib
import math
import os
import pickle
import select
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from thirdhand.contract.requests import ANSWER_TIMEOUT_S, ToolLimits, ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.core.tool_limits import limits_of_task, path_of
from thirdhand.core.way_out import WayOut
from thirdhand.process import child
from thirdhand.settings.config import Settings, robot_description
from thirdhand.skills.corrections import Effect, corrected
from thirdhand.skills.skill_file import SkillError, StoredSkill, decoded, skill_in
from thirdhand.skills.via_points import adapted

MODULE = "thirdhand.daemon.skill_worker"
# 5 s of the answer's time are left for the tick that takes the request, and for the status
WORK_TIMEOUT_S = ANSWER_TIMEOUT_S - 5.0
HUNG_S = 5.0  # the process hangs if it makes no progress for this time
WORKER_POLL_S = 0.1
BUSY = "the skill worker was busy with earlier requests; nothing was changed, try again"
STILL_STARTING = (
    "the skill worker is still starting, as the machine is busy; nothing was changed, try again"
)
Computed = TypeVar("Computed")


class SkillWorker:
    """The control process's end of the skill worker.

    Methods may be called from any thread; the worker processes one request at a time. Their time
    counts from the call, or within `due` from the arrival of what a client requested.
    """

    def __init__(self) -> None:
        self._busy = threading.Lock()
        self._due = threading.local()
        self._child: child.Child | None = None

    def start(self) -> child.Child:
        """The process, which is started if it does not run. Never waits."""
        if self._child is None or self._child.poll() is not None:
            self._end()
            self._child = child.start("skill worker", MODULE, socket.SOCK_STREAM)
        return self._child

    @contextlib.contextmanager
    def due(self, received_s: float) -> Iterator[None]:
        """A context in which all calls of this thread together end within WORK_TIMEOUT_S after
        `received_s` (time.monotonic() [s]).
        """
        self._due.end_s = received_s + WORK_TIMEOUT_S
        try:
            yield
        finally:
            del self._due.end_s

    def load(self, path: Path, *, timeout_s: float = WORK_TIMEOUT_S) -> StoredSkill:
        """The skill in a file. Raises SkillError, also after `timeout_s` [s]."""
        return self.compute(skill_of, path, timeout_s=timeout_s)

    def adapt(
        self, skill: StoredSkill, via_points: Sequence[ViaPoint], *, tolerance: float
    ) -> StoredSkill:
        """The skill with these via-points and no others. Raises SkillError."""
        return self.compute(skill_of, skill.file, tuple(via_points), tolerance)

    def correct(
        self, skill: StoredSkill, via_points: Sequence[ViaPoint], at: ViaPoint
    ) -> tuple[StoredSkill, Effect]:
        """The skill with these via-points and no others, and what that changes at the correction
        `at`. Raises SkillError.
        """
        return self.compute(corrected_skill_of, skill.file, tuple(via_points), at)

    def compute(
        self, work: Callable[..., Computed], *arguments: Any, timeout_s: float = WORK_TIMEOUT_S
    ) -> Computed:
        """The value of `work(*arguments)` in the worker, for a function of a module. Raises
        SkillError, also after `timeout_s` [s], the wait for earlier calls included.
        """
        end_s = min(time.monotonic() + timeout_s, getattr(self._due, "end_s", math.inf))
        if not self._busy.acquire(timeout=max(0.0, end_s - time.monotonic())):
            raise SkillError(BUSY)
        try:
            answer: Computed | str = self._answer(pickle.dumps((work, *arguments)), end_s)
        except TimeoutError as error:
            self._end()
            raise SkillError(f"the skill worker {error}; nothing was changed") from None
        except (OSError, EOFError):
            self._end()
            raise SkillError(
                "the skill worker ended while it worked; nothing was changed, try again"
            ) from None
        finally:
            self._busy.release()
        if isinstance(answer, str):
            raise SkillError(answer)
        return answer

    def _answer(self, request: bytes, end_s: float) -> Any:
        """The worker's answer to a request. Raises SkillError, TimeoutError after `end_s`
        (time.monotonic() [s]), and OSError or EOFError if the process ends.
        """
        working = self.start()
        progress = child.Progress(working)
        while not working.has_begun(WORKER_POLL_S):
            if working.returncode is not None or progress.is_hung(WORK_TIMEOUT_S):
                working.kill()
                raise EOFError
            if time.monotonic() > end_s:  # its imports continue for the next request
                raise SkillError(STILL_STARTING)

        _send(working.socket, request)
        poll = select.poll()
        poll.register(working.socket, select.POLLIN)
        while not poll.poll(1000 * WORKER_POLL_S):
            if progress.is_hung(HUNG_S, busy_s=math.inf):
                raise TimeoutError(f"made no progress for {HUNG_S:g} s")
            if time.monotonic() > end_s:
                raise TimeoutError("did not answer in time")
        return _receive(working.socket)

    def close(self) -> None:
        """End the process, also while it works."""
        if (running := self._child) is not None and running.has_begun():
            running.kill()
        with self._busy:
            self._end()

    def _end(self) -> None:
        if self._child is not None:
            self._child.socket.close()
            if self._child.pid is not None:  # else it ends at its start, with the closed socket
                self._child.kill()
                self._child.wait()
            self._child = None


def _send(channel: socket.socket, *parts: Any) -> None:
    """Send one message: the parts in shared memory, and its descriptor through the socket."""
    fd = child.in_memory(*parts)
    try:
        socket.send_fds(channel, [b"\0"], [fd])
    finally:
        os.close(fd)


def _receive(channel: socket.socket) -> Any:
    """Receive one message, whose arrays remain in its shared memory."""
    _, descriptors, _, _ = socket.recv_fds(channel, 1, 1)
    if not descriptors:
        raise EOFError
    value, *buffers = child.from_memory(descriptors[0])
    return pickle.loads(value, buffers=buffers)


def way_out_of(settings: Settings, *arguments: Vector) -> list[Vector]:
    """The result of `WayOut.find` for the cell."""
    return WayOut(settings, robot_description(settings)).find(*arguments)


def has_posture_of(settings: Settings, *arguments: Vector) -> bool:
    """The result of `WayOut.has_posture` for the cell."""
    return WayOut(settings, robot_description(settings)).has_posture(*arguments)


def tool_limits_of(settings: Settings, file: bytes) -> dict[str, ToolLimits]:
    """The result of `limits_of_task` for the cell and the skill in this file."""
    skill = decoded(file, origin="the skill in force")
    return limits_of_task(settings, robot_description(settings), path_of(skill), skill.orientation)


def skill_of(
    source: Path | bytes, via_points: Sequence[ViaPoint] = (), tolerance: float = 0.0
) -> StoredSkill:
    """The skill in a file, or the skill in force (the bytes of its file) with these via-points.

    Raises SkillError.
    """
    if isinstance(source, bytes):
        skill = adapted(
            decoded(source, origin="the skill in force"), via_points, tolerance=tolerance
        )
    else:
        skill = skill_in(source)
    return prepared(skill)


def corrected_skill_of(
    source: bytes, via_points: Sequence[ViaPoint], at: ViaPoint
) -> tuple[StoredSkill, Effect]:
    """The skill in force (the bytes of its file) with these via-points, and what they change at the
    correction `at`. Raises SkillError.
    """
    skill, effect = corrected(decoded(source, origin="the skill in force"), via_points, at)
    return prepared(skill), effect


def prepared(skill: StoredSkill) -> StoredSkill:
    """A skill that has computed and cached everything that is computed once."""
    hands = skill.hands[0].reshape(2, 3)
    skill.predict(hands, 0 * hands, 0 * hands)
    _ = skill.tool_positions
    return skill


def run(channel: socket.socket) -> None:
    """Process requests in the child until the other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    child.end_with_parent()
    while True:
        try:
            work, *arguments = _receive(channel)
        except (EOFError, OSError):
            return
        buffers: list[pickle.PickleBuffer] = []
        try:
            answer = work(*arguments)
        except Exception as error:  # the client gets any failure as an answer
            answer = (
                str(error) if isinstance(error, SkillError) else f"{type(error).__name__}: {error}"
            )
        data = pickle.dumps(answer, protocol=5, buffer_callback=buffers.append)
        try:
            _send(channel, data, *(b.raw() for b in buffers))
        except BrokenPipeError:
            return
