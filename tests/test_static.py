"""What is checked without running anything: lint, format, types."""

from __future__ import annotations

import subprocess
import sys

import pytest

from support.paths import ROOT


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(["ruff", "check", "."], marks=pytest.mark.quick),
        pytest.param(["ruff", "format", "--check", "."], marks=pytest.mark.quick),
        ["mypy"],
    ],
    ids=["lint", "format", "types"],
)
def test_static_checks_find_nothing(command: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", *command], capture_output=True, text=True, timeout=300, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stdout + done.stderr
