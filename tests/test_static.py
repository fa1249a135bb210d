"""Static checks: lint, format, types."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from support.paths import ROOT

MYPY_CACHE = Path.home() / ".cache" / "thirdhand" / "mypy"  # shared by all checkouts


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(["ruff", "check", "."], marks=pytest.mark.quick),
        pytest.param(["ruff", "format", "--check", "."], marks=pytest.mark.quick),
        ["mypy", "--cache-dir", str(MYPY_CACHE)],
    ],
    ids=["lint", "format", "types"],
)
def test_static_checks_find_nothing(command: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", *command],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stdout + done.stderr
