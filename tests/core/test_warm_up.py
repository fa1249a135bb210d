"""After `warm_up`, a loop compiles nothing. Each test has its own process, as a function stays
compiled.
"""

from __future__ import annotations

import subprocess
import sys

from support.paths import RECORDINGS

COUNTED = """
import importlib
import pkgutil
import sys
from pathlib import Path

from thirdhand.process import one_blas_thread
from numba.core.dispatcher import Dispatcher

import kmp
import thirdhand.core
from thirdhand.settings.config import Settings, robot_description
from thirdhand.core.warm_up import warm_up

LOOPED = [
    importlib.import_module(found.name)
    for package in (kmp, thirdhand.core)
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + ".")
    if not found.name.endswith("__main__")
]

def compiled():
    return {
        f"{name} of {module.__name__}": len(function.signatures)
        for module in LOOPED
        for name, function in vars(module).items()
        if isinstance(function, Dispatcher)
    }

def since(before):
    counts = compiled()
    return {name: counts[name] - before[name] for name in counts if counts[name] != before[name]}

def compiled_by(skill):
    so_far = compiled()
    warm_up(Settings(), skill, urdf=robot_description(Settings()))
    assert since(so_far)
    return compiled()
"""
REPLAYED = """
from thirdhand.command_line import main
from thirdhand.recordings.shipped import shipped_skill

before = compiled_by(shipped_skill())
assert main(["replay", sys.argv[1]]) in (0, None)
assert since(before) == {}, since(before)
"""
OF_ANOTHER_KIND = """
from thirdhand.contract.requests import ViaPoint
from thirdhand.daemon.skill_worker import skill_of

place = ViaPoint(name="here", left=(0.6, -0.2, 0.3), right=(0.9, 0.3, 0.1), tool=(0.6, -0.2, 0.4))
before = compiled_by(skill_of(Path(sys.argv[1])))
for more in ((), (place,)):
    other = skill_of(skill_of(Path(sys.argv[2])).file, more, 0.05)
    warm_up(Settings(), other.for_loop(), urdf=robot_description(Settings()))
assert since(before) == {}, since(before)
"""


def done_in_a_process(script: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", COUNTED + script, *arguments],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_warm_up_leaves_nothing_to_compile() -> None:
    assert "identical" in done_in_a_process(REPLAYED, str(RECORDINGS / "golden.mcap"))


def test_other_kind_of_skill_compiles_nothing() -> None:
    """The skill is of another kind than the shipped one."""
    done_in_a_process(
        OF_ANOTHER_KIND,
        *(str(RECORDINGS / name) for name in ("soldering.npz", "experiments/as-paper.npz")),
    )
