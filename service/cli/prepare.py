"""`thirdhand prepare`: compilation of what a daemon needs, before its first start."""

from __future__ import annotations

import argparse
import time

from service.files.shipped import SHIPPED_SKILL, cell_of, skills_folder
from service.process.progress import progress
from service.settings.config import robot_description


def prepare(args: argparse.Namespace) -> int:
    """Compile and cache the functions of a cell's loop; exit code 0. Raises SkillError."""
    begun_s, settings = time.monotonic(), cell_of(str(args.config or "wam"))
    with progress("compiling, for some minutes on a new machine", unit="skills"):
        from service.core.warm_up import warm_up  # slow imports
        from service.daemon.daemon import load_skill

        path = args.skill or skills_folder(settings) / SHIPPED_SKILL
        warm_up(settings, load_skill(path, settings).for_loop(), urdf=robot_description(settings))
    print(f"compiled for an arm with {len(settings.joints.names)} joints in {time.monotonic() - begun_s:.0f} s")
    return 0
