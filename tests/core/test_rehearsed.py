"""After `rehearse`, nothing is left for a loop to compile: in a process of its own, for a compiled
function remembers what it has been compiled for.
"""

from __future__ import annotations

import subprocess
import sys

from tests_paths import RECORDINGS

SCRIPT = """
import sys
from service import one_blas_thread
from numba.core.dispatcher import Dispatcher
from service.config import Settings, robot_description
from kmp import compiled_query
from service.core import (
    capsules, frame, hand_estimator, intake, inverse_kinematics, least_squares, limiter, separation, setpoint, skill,
    stops, workspace,
)
from service.core.rehearsal import rehearse
from service.cli.main import main
from service.cli.usage import shipped

MODULES = (
    compiled_query, capsules, frame, hand_estimator, intake, inverse_kinematics, least_squares, limiter, separation,
    setpoint, skill, stops, workspace,
)

def compiled():
    return {
        name: len(f.signatures) for module in MODULES for name, f in vars(module).items() if isinstance(f, Dispatcher)
    }

nothing = compiled()
rehearse(Settings(), shipped(), urdf=robot_description(Settings()))
before = compiled()
assert before != nothing and set(nothing.values()) == {0}, nothing
assert main(["replay", sys.argv[1]]) in (0, None)
assert compiled() == before, (before, compiled())
"""


def test_a_rehearsal_leaves_nothing_to_compile() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(RECORDINGS / "golden.mcap")],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "identical" in done.stdout
