"""Compiles what a daemon compiles at its first start, in a process beside the tests that compile
nothing. The others wait for it: each test of a daemon would else compile in a process of its own,
and time out where several do.
"""

from __future__ import annotations

from service.process import one_blas_thread  # noqa: F401

# isort: split
import fcntl
import functools
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from service.contract.requests import ViaPoint
from service.core import warm_up
from service.daemon.skill_worker import SkillWorker, skill_of
from service.settings.config import Settings, robot_description
from support.arms import cell_of
from support.paths import RECORDINGS, ROOT

LOCKS = "THIRDHAND_COMPILING", "THIRDHAND_COMPILING_SIX"  # name files that are locked until it is compiled


def is_needed() -> bool:
    """Whether the checkout is fresh to this Python."""
    version = f"py{sys.version_info.major}{sys.version_info.minor}"
    return not any((Path(warm_up.__file__).parent / "__pycache__").glob(f"*.{version}.nbi"))


def begun() -> subprocess.Popen[bytes]:
    """The process, for which whoever is started from here can wait."""
    held = []
    for lock in LOCKS:
        descriptor, os.environ[lock] = tempfile.mkstemp(prefix="thirdhand-compiling-")
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        held.append(descriptor)
    paths = os.pathsep.join(map(str, (ROOT, ROOT / "tests")))
    command = [sys.executable, "-m", __name__, *map(str, held)]
    process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": paths}, pass_fds=held)
    for descriptor in held:
        os.close(descriptor)  # what keeps the locks is the process
    return process


def end(process: subprocess.Popen[bytes]) -> None:
    """Ends the process, whether it is done or not."""
    process.terminate()
    process.wait()
    for lock in LOCKS:
        Path(os.environ.pop(lock)).unlink()


@functools.cache
def wait(*, six: bool) -> None:
    """Until the process, if there is one, has compiled for seven joints, or also for six."""
    lock = LOCKS[six]
    if lock in os.environ:
        with open(os.environ[lock], "rb") as held:
            fcntl.flock(held, fcntl.LOCK_SH)


def main(first: int) -> None:
    """Compiles; the lock of this descriptor is let go when it is done for seven joints."""
    place = ViaPoint(name="here", left=(0.6, -0.2, 0.3), right=(0.9, 0.3, 0.1), tool=(0.6, -0.2, 0.4))
    skill_worker = SkillWorker()
    for name in ("soldering.npz", "experiments/as-paper.npz"):
        loaded = skill_worker.load(RECORDINGS / name, timeout_s=120.0)
        for one in (loaded, skill_worker.compute(skill_of, loaded.file, (place,), 0.05, timeout_s=120.0)):
            warm_up.warm_up(Settings(), one, urdf=robot_description(Settings()))
    os.close(first)
    six = cell_of("ur5")
    warm_up.warm_up(six, loaded, urdf=robot_description(six))
    skill_worker.close()


if __name__ == "__main__":
    main(int(sys.argv[1]))
