"""A forked command: its loaded modules, and the steps that make it like a started process."""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import atexit
import contextlib
import importlib
import json
import os
import pkgutil
import runpy
import signal
import socket
import sys
import threading
import traceback

import thirdhand.cli
from thirdhand.core.warm_up import warm_up
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings, robot_description

MAX_REQUEST_BYTES = 1 << 18

for _found in pkgutil.iter_modules(thirdhand.cli.__path__):
    importlib.import_module(f"thirdhand.cli.{_found.name}")
for _module in ("thirdhand.daemon.daemon", "thirdhand.scribe.scribe", "thirdhand_sim.network"):
    importlib.import_module(_module)
warm_up(Settings(), shipped_skill().for_loop(), urdf=robot_description(Settings()))


def run(channel: socket.socket) -> None:
    """Run the requested command in this process, and end it with the command's exit code."""
    message, streams, _, _ = socket.recv_fds(channel, MAX_REQUEST_BYTES, 3)
    request = json.loads(message)
    channel.close()
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, 0)  # the server has a lower priority
    if request["session"]:
        os.setsid()
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    sys.argv = request["arguments"]
    sys.stdin = open(0, closefd=False, encoding="utf-8")  # noqa: SIM115
    buffering = 1 if os.isatty(1) else -1
    sys.stdout = open(1, "w", closefd=False, encoding="utf-8", buffering=buffering)  # noqa: SIM115
    errors = "backslashreplace"
    sys.stderr = open(2, "w", closefd=False, encoding="utf-8", errors=errors, buffering=1)  # noqa: SIM115
    code = _exit_code(request["module"])
    with contextlib.suppress(BaseException):
        threading._shutdown()  # type: ignore[attr-defined]  # noqa: SLF001  # as the interpreter's end does
        atexit._run_exitfuncs()  # noqa: SLF001
        sys.stdout.flush()
    os._exit(code)


def _exit_code(module: str) -> int:
    """The exit code of a module that is run as a program."""
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as ended:
        if isinstance(ended.code, str):
            print(ended.code, file=sys.stderr)
            return 1
        return int(ended.code or 0) & 0xFF
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0
