"""What is checked without running anything: lint, format, types, import contracts, and that
documentation says what the code says.
"""

from __future__ import annotations

import subprocess
import sys

import pytest
from tests_paths import ROOT

from service.contract.channels import CHANNELS


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
    done = subprocess.run(
        [sys.executable, "-m", *command], capture_output=True, text=True, timeout=300, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_readmes_table_of_the_wire_is_the_table_of_channels() -> None:
    said = [line for line in (ROOT / "README.md").read_text().splitlines() if line.startswith("| `<cell>/")]
    rows = [
        f"| `<cell>/{channel.key}` | `{channel.codec.type}` | "
        f"{channel.direction}{'' if channel.direction == 'request' else f', {channel.rate}'} | {channel.about} |"
        for channel in CHANNELS
        if channel.direction != "recording"
    ]
    assert said == rows
