"""`thirdhand serve --prepare`: compilation of what a daemon needs, before its first start."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from thirdhand.cli.serve import settings_of, skill_path
from thirdhand.process.progress import progress
from thirdhand.settings.config import Settings


def prepare(args: argparse.Namespace) -> int:
    """Compile and cache the functions of a cell; exit code 0. Raises SkillError."""
    settings = settings_of(args)
    print(compiled_for(settings, skill_path(settings, args)), flush=True)
    return 0


def compiled_for(settings: Settings, skill: Path) -> str:
    """Compile for a cell with the skill in a file; what was done, in words. Raises SkillError."""
    begun_s = time.monotonic()
    joints = len(settings.joints.names)
    compiled: set[str] = set()
    with progress(
        f"compiling for an arm with {joints} joints, a minute or more", unit="functions"
    ) as show:
        from thirdhand.daemon.compilation import compile_cell  # slow imports
        from thirdhand.daemon.skill_worker import skill_of

        def report(function: str, is_ready: bool) -> None:
            compiled.update([function] * is_ready)
            show(len(compiled))

        skill_of(skill)  # raises what is wrong with it
        compile_cell(settings, skill, report)
    return (
        f"{joints} joints: {len(compiled)} functions compiled in {time.monotonic() - begun_s:.0f} s"
    )
