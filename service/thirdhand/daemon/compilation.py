"""Compilation of the functions of a cell by two processes: of its loop, its requests, and the
commands beside it. The compiler's memory, 600 MB, ends with them.
"""

from __future__ import annotations

import contextlib
import pickle
import selectors
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba.core import event

from thirdhand.arms.playback import Playback
from thirdhand.core.warm_up import rehearse_intake, rehearse_motion, warm_up
from thirdhand.daemon.skill_worker import has_posture_of, skill_of
from thirdhand.process import child
from thirdhand.process.priority import ahead_of_others
from thirdhand.settings.config import Settings, robot_description
from thirdhand.skills import rehearsal
from thirdhand.skills.reach import beyond_m

MAX_WORK_BYTES = 65536
BEGIN_POLL_S = 1.0
COMPILED = "is compiled"


class NotCompiledError(BaseException):
    """A function is not in the cache; no handler of unreadable files may catch this."""


class Compilations(event.Listener):  # type: ignore[misc]
    """Calls one function where a compilation begins and another where it ends, with the function's
    name, `package.module.function`.
    """

    def __init__(self, begun: Callable[[str], object], ended: Callable[[str], object]) -> None:
        self._begun = begun
        self._ended = ended

    def on_start(self, event: event.Event) -> None:
        """A compilation begins."""
        self._begun(_name(event))

    def on_end(self, event: event.Event) -> None:
        """A compilation ends."""
        self._ended(_name(event))


def _name(event: event.Event) -> str:
    function = event.data["dispatcher"].py_func
    return f"{function.__module__}.{function.__name__}"


def compile_cell(settings: Settings, skill: Path, report: Callable[[str, bool], object]) -> None:
    """Compile what a cell calls with the skill in a file, and wait for it.

    `report(function, is_ready)` is called where a compilation begins and where it ends. If a
    process fails, what it has not compiled is compiled at its first call.
    """
    compilers = [child.start("compiler", __name__, socket.SOCK_SEQPACKET) for _ in range(2)]
    with selectors.DefaultSelector() as selector:
        for is_first, compiler in zip((True, False), compilers, strict=True):
            while not compiler.has_begun(BEGIN_POLL_S) and compiler.returncode is None:
                pass
            with contextlib.suppress(OSError):  # it has ended
                compiler.socket.send(pickle.dumps((settings, skill, is_first)))
            selector.register(compiler.socket, selectors.EVENT_READ, compiler)
        while selector.get_map():
            for key, _ in selector.select():
                message = _received(key.data.socket)
                if message:
                    name, _, state = message.partition(" ")
                    report(name, state == COMPILED)
                else:
                    selector.unregister(key.fileobj)
    for compiler in compilers:
        compiler.wait()
        compiler.socket.close()


def _received(channel: socket.socket) -> str:
    """The next message of a process; empty once it has ended."""
    try:
        return channel.recv(MAX_WORK_BYTES).decode()
    except OSError:
        return ""


def run(channel: socket.socket) -> None:
    """Compile in a child: the first compiles the intake, the second the motion of the arm, which
    each take a third of the time; then the first compiles the rest of the loop, and the second what
    is called beside it.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    child.end_with_parent()
    settings, skill, is_first = pickle.loads(channel.recv(MAX_WORK_BYTES))
    urdf = robot_description(settings)

    def send(*words: str) -> None:
        channel.send(" ".join(words).encode())

    listener = Compilations(
        lambda name: send(name, "is being compiled"), lambda name: send(name, COMPILED)
    )
    with event.install_listener("numba:compile", listener), ahead_of_others():
        if is_first:
            rehearse_intake(settings)
            warm_up(settings, skill_of(skill).for_loop(), urdf=urdf)
        else:
            rehearse_motion(settings, urdf)
            rehearsal.rehearse()
            _rehearse_beside(settings, skill)


def _rehearse_beside(settings: Settings, path: Path) -> None:
    """Call what the start, requests and an arm's driver call and the loop does not."""
    skill = skill_of(path)
    posture = np.array(settings.arm.posture)
    has_posture_of(
        settings, posture, skill.tool_positions[0], skill.orientation, skill.hands[0].reshape(2, 3)
    )
    beyond_m(settings, skill.tool_positions[:1])
    Playback(settings.joints, posture, period_s=settings.period_s)
