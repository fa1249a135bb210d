"""Compiles what a daemon compiles at its first start, in a process beside the tests that compile
nothing. The others wait for it: each test of a daemon would else compile in a process of its own,
and time out where several do.
"""

from __future__ import annotations

from service import one_blas_thread  # noqa: F401

# isort: split
import fcntl
import functools
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from service.config import Settings, robot_description
from service.contract.requests import ViaPoint
from service.core import warm_up
from service.daemon.skill_worker import SkillWorker
from support.paths import RECORDINGS, ROOT

LOCK = "THIRDHAND_COMPILING"  # names a file that is locked for as long as the process runs


def is_needed() -> bool:
    """Whether the checkout is fresh to this Python."""
    version = f"py{sys.version_info.major}{sys.version_info.minor}"
    return not any((Path(warm_up.__file__).parent / "__pycache__").glob(f"*.{version}.nbi"))


def begun() -> subprocess.Popen[bytes]:
    """The process, for which whoever is started from here can wait."""
    descriptor, os.environ[LOCK] = tempfile.mkstemp(prefix="thirdhand-compiling-")
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    paths = os.pathsep.join(map(str, (ROOT, ROOT / "tests")))
    process = subprocess.Popen(
        [sys.executable, "-m", __name__], env=os.environ | {"PYTHONPATH": paths}, pass_fds=[descriptor]
    )
    os.close(descriptor)  # what keeps the lock is the process
    return process


def end(process: subprocess.Popen[bytes]) -> None:
    """Ends the process, whether it is done or not."""
    process.terminate()
    process.wait()
    Path(os.environ.pop(LOCK)).unlink()


@functools.cache
def wait() -> None:
    """Until the process is done, if there is one."""
    if LOCK in os.environ:
        with open(os.environ[LOCK], "rb") as held:
            fcntl.flock(held, fcntl.LOCK_SH)


def main() -> None:
    place = ViaPoint(name="here", left=(0.6, -0.2, 0.3), right=(0.9, 0.3, 0.1), tool=(0.6, -0.2, 0.4))
    skill_worker = SkillWorker()
    for name in ("soldering.npz", "experiments/as-paper.npz"):
        loaded = skill_worker.load(RECORDINGS / name, timeout_s=120.0)
        for one in (loaded, skill_worker.adapt(loaded, [place], tolerance=0.05, timeout_s=120.0)):
            warm_up.warm_up(Settings(), one, urdf=robot_description(Settings()))
    skill_worker.close()


if __name__ == "__main__":
    main()
