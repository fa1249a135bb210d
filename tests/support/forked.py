"""Commands that tests start, forked from a process that has loaded their imports.

`python -m thirdhand ...` and `python -m thirdhand_sim ...` cost two seconds of imports and
rehearsal. `Popen` takes the place of `subprocess.Popen`, also in the service's own code. The
process is a child of the one that starts it, with pipes, environment, folder and signals of its
own. Other processes are started as usual: other programs, environments that imports read, and
commands of tests of the start.

The standard library's fork server gives a child neither pipes nor an environment, and its children
are not children of this process, so they could neither be awaited nor distinguished from others.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from typing import Any

from thirdhand.process.child import ForkServer

MODULE = "tests.support.forked_command"
STARTED = ("-m thirdhand", "-m thirdhand_sim")
READ_AT_IMPORT = ("NUMBA_", "PYTHON", "OPENBLAS_", "LD_", "MUJOCO_", "HOME", "XDG_CACHE_HOME")
BEGIN_POLL_S = 1.0

_environment = dict(os.environ)
_server = ForkServer()
RealPopen = subprocess.Popen


class Popen(RealPopen):  # type: ignore[type-arg]
    """`subprocess.Popen` whose commands of the service are forked."""

    def _execute_child(self, args, executable, preexec_fn, *more) -> None:  # type: ignore[no-untyped-def]
        (
            _,
            pass_fds,
            cwd,
            env,
            _,
            _,
            shell,
            stdin,
            stdin_end,
            stdout_end,
            stdout,
            stderr_end,
            stderr,
            *tail,
        ) = more
        module = None if executable or preexec_fn or pass_fds or shell else _module_of(args)
        environment = dict(os.environ if env is None else env)
        session, group = tail[-2:]
        if module is None or group > 0 or _is_read_at_import(environment):
            super()._execute_child(args, executable, preexec_fn, *more)  # type: ignore[misc]
            return
        streams = [
            fd if stream == -1 else stream for fd, stream in enumerate((stdin, stdout, stderr))
        ]
        command = list(map(os.fspath, args))
        request = {
            "module": module,
            "arguments": command[command.index(module) :],
            "folder": os.fspath(cwd or os.getcwd()),
            "environment": environment,
            "session": session,
        }
        child = _server.start("python", MODULE, socket.SOCK_SEQPACKET)
        socket.send_fds(child.socket, [json.dumps(request).encode()], streams)
        while not child.has_begun(BEGIN_POLL_S):
            if child.returncode is not None:
                raise ChildProcessError(
                    "the fork server of the tests has ended; its output says why"
                )
        child.socket.close()
        self.pid = child.pid
        self._child_created = True
        self._close_pipe_fds(stdin, stdin_end, stdout_end, stdout, stderr_end, stderr)  # type: ignore[attr-defined]


def _module_of(args: Any) -> str | None:
    """The module that a command line of this Python runs, if it is one that can be forked."""
    if isinstance(args, (str, bytes)) or args[0] != sys.executable:
        return None
    words = [word for word in map(str, args[1:]) if word != "-P"]
    return words[1] if " ".join(words[:2]) in STARTED else None


def _is_read_at_import(environment: dict[str, str]) -> bool:
    """True if an environment differs from this process's first one in variables that imports
    read.
    """
    changed = {name for name, _ in environment.items() ^ _environment.items()}
    return any(name.startswith(READ_AT_IMPORT) for name in changed)


def use(is_on: bool) -> None:
    """Fork the commands of the service from now on, or start each of them."""
    subprocess.Popen = Popen if is_on else RealPopen  # type: ignore[misc]


def close() -> None:
    """End the server, if it was started."""
    _server.close()
