"""What is checked without running anything: lint, format, types, import contracts, and that documentation says what the code says."""

from __future__ import annotations

import subprocess
import sys

import pytest
from tests_paths import ROOT

from service.wire import CHANNELS


@pytest.mark.parametrize(
    "command",
    [
        ["ruff", "check", "."],
        ["ruff", "format", "--check", "."],
        ["mypy"],
    ],
    ids=["lint", "format", "types"],
)
def test_static_checks_find_nothing(command: list[str]) -> None:
    done = subprocess.run([sys.executable, "-m", *command], capture_output=True, text=True, timeout=300, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_readme_lists_every_channel_of_the_wire() -> None:
    readme = (ROOT / "README.md").read_text()
    for channel in CHANNELS:
        assert f"| `<cell>/{channel.key}` | `{channel.type}` |" in readme
        assert channel.about in readme
