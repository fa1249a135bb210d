"""The script of all checks: each part runs, whatever failed before, and the end names the failed
parts.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from support.paths import ROOT

PARTS = ("the README's tests", "thorough", "timed", "a newer Python")


def checkout(folder: Path, *, readme: str, python: str) -> dict[str, str]:
    """A checkout whose README has this test command and whose Python interpreters are this shell
    script; and the environment for its checks.
    """
    (folder / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "run", folder / ".ci" / "run")
    (folder / "README.md").write_text(
        f"# A\n\n<!-- test -->\n```sh\n{readme}\n```\n", encoding="utf-8"
    )
    newer = "pythons/versions/3.13.1/bin"
    for path in (
        ".venv/bin/python",
        f"{newer}/python",
        *(f".venv-newer/bin/{name}" for name in ("pip", "thirdhand")),
    ):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(
            f'#!/bin/sh\necho "$0 $*" >> "{folder}/calls"\n{python}\n', encoding="utf-8"
        )
        (folder / path).chmod(0o755)
    shutil.copy(folder / ".venv/bin/python", folder / ".venv-newer/bin/python")
    (folder / newer / "python3.13").symlink_to("python")
    return {"PATH": f"{folder / newer}:{os.environ['PATH']}", "PYENV_ROOT": str(folder / "pythons")}


def checked(folder: Path, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """A run of the script in a checkout."""
    command = ["bash", ".ci/run"]
    return subprocess.run(
        command,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize(
    ("readme", "python", "failed"),
    [
        ("true", "exit 0", ()),
        ("echo wrong; exit 3", "exit 0", PARTS[:1]),
        ("true", 'case "$*" in *"-m thorough and"*) exit 1;; esac', PARTS[1:2]),
        ("true", 'case "$*" in *"-m timed"*) exit 1;; esac', PARTS[2:3]),
        ("true", 'case "$*" in demo*) exit 1;; esac', PARTS[3:]),
        ("false", "exit 1", PARTS),
    ],
)
def test_every_part_runs_and_the_end_names_those_that_failed(
    readme: str, python: str, failed: tuple[str, ...], tmp_path: Path
) -> None:
    done = checked(tmp_path, checkout(tmp_path, readme=readme, python=python))
    assert done.returncode == (1 if failed else 0), done.stderr
    for part in PARTS:
        assert f"== {part}\n" in done.stdout
        assert f"\n{part}: " in done.stdout
    assert [
        line.removeprefix("failed: ") for line in done.stderr.splitlines() if "failed: " in line
    ] == list(failed)
    calls = (tmp_path / "calls").read_text(encoding="utf-8")
    assert ("replay --exact recordings/golden.mcap" in calls) == (
        "a newer Python" not in failed or "demo" in python
    )


def test_a_part_that_cannot_run_has_failed(tmp_path: Path) -> None:
    # this Python cannot make environments
    environment = checkout(tmp_path, readme="true", python='[ "$1" != -c ]')
    (tmp_path / "README.md").write_text("# A\n", encoding="utf-8")
    done = checked(tmp_path, environment)
    assert done.returncode == 1
    assert "README.md has no test command" in done.stderr
