"""Starts the probes of `service.timing.probe`; finds a daemon's processes."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import psutil

from service.contract.explain import ExplainedError

PROBE = [sys.executable, "-m", "service.timing.probe"]
TIMEOUT_S = 900.0


class BenchError(ExplainedError):
    """A measurement failed; the message says why."""


def probe(kind: str, *arguments: object) -> dict[str, Any]:
    """The result of one of the probes. Raises BenchError."""
    command = [*PROBE, kind, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    if done.returncode != 0:
        raise BenchError(f"{kind} could not be measured: {done.stderr.strip()[-500:]}")
    result: dict[str, Any] = json.loads(done.stdout)
    return result


@contextlib.contextmanager
def echo() -> Iterator[str]:
    """The endpoint at which an echo listens, while the context lasts."""
    with subprocess.Popen([*PROBE, "echo"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        try:
            yield process.stdout.readline().strip()
        finally:
            process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10)
            process.kill()


def family(pid: int) -> dict[str, psutil.Process]:
    """A daemon's process and its children, by kind."""
    found = {"daemon": psutil.Process(pid)}
    found |= {child.name(): child for child in found["daemon"].children()}
    return found
