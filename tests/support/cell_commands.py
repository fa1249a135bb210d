"""Commands that are refused, commands that run beside a test, and programs in Python."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

from support.cell import told
from support.paths import ROOT


def assert_refused(code: int, words: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Assert exit code and words on standard error of a command; returns its standard output."""
    done = told(*arguments)
    assert (done.returncode, words in done.stderr) == (code, True), done.stderr
    return done


def succeeded(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Assert that a command succeeds; returns its standard output."""
    done = told(*arguments)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@contextlib.contextmanager
def started(*arguments: str, within_s: float = 300, **more: Any) -> Iterator[subprocess.Popen[str]]:
    """A `thirdhand` command as a process with pipes, killed at the end of the context or after a
    time.
    """
    command = [sys.executable, "-m", "thirdhand", *arguments]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen(command, **({"text": True, "cwd": ROOT} | pipes | more)) as process:
        timer = threading.Timer(within_s, process.kill)
        timer.start()
        try:
            yield process
        finally:
            timer.cancel()
            process.kill()


def python(code: str, *arguments: str, **more: Any) -> subprocess.CompletedProcess[str]:
    """A program in Python, run to its end."""
    command = [sys.executable, "-c", code, *arguments]
    more = {"capture_output": True, "text": True, "timeout": 60, "cwd": ROOT} | more
    return subprocess.run(command, check=False, **more)
