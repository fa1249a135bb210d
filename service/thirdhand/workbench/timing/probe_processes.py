"""Start of the probes of `thirdhand.workbench.timing.probe`, and the processes of a daemon."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import psutil

from thirdhand.contract.explain import ExplainedError

PROBE = [sys.executable, "-m", "thirdhand.workbench.timing.probe"]
PROBE_TIMEOUT_S = 900.0


class ProbeError(ExplainedError):
    """A measurement failed; the message has the cause."""


def probe(kind: str, *arguments: object) -> dict[str, Any]:
    """Run a probe and return its result. Raises ProbeError."""
    command = [*PROBE, kind, *map(str, arguments)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S, check=False
    )
    if done.returncode != 0:
        raise ProbeError(f"{kind} could not be measured: {done.stderr.strip()[-500:]}")
    result: dict[str, Any] = json.loads(done.stdout)
    return result


@contextlib.contextmanager
def echo() -> Iterator[str]:
    """A context with a running echo; its endpoint."""
    with subprocess.Popen(
        [*PROBE, "echo"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
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
    """The processes of a daemon, `daemon` and its children, by name."""
    processes = {"daemon": psutil.Process(pid)}
    processes |= {child.name(): child for child in processes["daemon"].children()}
    return processes
