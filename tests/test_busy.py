"""A test that fails on a busy machine is run again, and counted separately if it then passes."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.cell_commands import python
from support.paths import ROOT

TESTS = """
import pathlib
import time

def spin():
    end_s = time.process_time() + 0.2
    while time.process_time() < end_s:
        pass

def test_fails_at_first(mark=pathlib.Path("mark")):
    spin()
    is_second = mark.exists()
    mark.touch()
    assert is_second, "too late"

def test_fails_always():
    spin()
    assert False, "wrong"
"""


@contextlib.contextmanager
def busy_processor() -> Iterator[int]:
    """A processor that four other processes keep busy."""
    (processor, *_) = os.sched_getaffinity(0)
    code = f"import os; os.sched_setaffinity(0, {{{processor}}})\nwhile True: pass"
    hogs = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(4)]
    try:
        yield processor
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="processes cannot be pinned here")
def test_failure_on_a_busy_processor_must_repeat(tmp_path: Path) -> None:
    """A single failure there does not count."""
    (tmp_path / "test_both.py").write_text(TESTS)
    with busy_processor() as processor:
        options = [
            "-p",
            "support.busy",
            "-p",
            "no:cacheprovider",
            "--rootdir",
            str(tmp_path),
            str(tmp_path),
        ]
        code = (
            f"import os, pytest, sys; os.sched_setaffinity(0, {{{processor}}}); "
            f"sys.exit(pytest.main({options!r}))"
        )
        environment = os.environ | {"PYTHONPATH": str(ROOT / "tests")}
        done = python(code, cwd=tmp_path, env=environment)
    assert done.returncode == 1
    assert "1 failed, 1 busy in" in done.stdout
    assert "FAILED test_both.py::test_fails_always - AssertionError: wrong" in done.stdout
    assert "run twice, as its process waited for a processor" in done.stdout
