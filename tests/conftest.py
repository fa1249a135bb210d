"""What several tests share; and that those of the bench are skipped where it is not installed."""

from __future__ import annotations

from service import one_blas_thread  # noqa: F401

# isort: split
import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from service.config import Settings, robot_description
from service.contract.requests import ViaPoint
from service.core import warm_up
from service.core.skill.skill import Skill
from service.daemon.skill_worker import SkillWorker
from service.learning.skill_file import decoded
from support import tiers, vulkan
from support.paths import RECORDINGS, ROOT


class _NoBench:
    """Finds no PyBullet, which has no wheels for some Pythons, and skips who asks for it."""

    @staticmethod
    def find_spec(name: str, *_: Any) -> None:
        if name == "pybullet":
            pytest.skip("PyBullet is not installed: no bench", allow_module_level=True)


if importlib.util.find_spec("pybullet") is None:
    sys.meta_path.insert(0, _NoBench)  # type: ignore[arg-type]


BEGAN_S = time.monotonic()
for name in ("CONNECT", "CELL", "CERTIFICATE", "ZENOH_CONFIG"):
    os.environ.pop(f"THIRDHAND_{name}", None)
os.environ["XDG_CONFIG_HOME"] = os.devnull  # no client file of whoever runs the tests


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--seconds-left`, for what is run as long as there is time."""
    parser.addoption("--seconds-left", type=float, metavar="S", help="leave out what has not begun after so long")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks what is quick and what is research, and puts the files that take longest first."""
    tests = ROOT / "tests"
    where = {item: str(item.path.relative_to(tests)) + "::" + item.nodeid.split("::", 1)[-1] for item in items}
    for item, test in where.items():
        for marker in tiers.markers(test, timed=item.get_closest_marker("timed") is not None):
            item.add_marker(marker)
    items.sort(key=lambda item: tiers.begins(where[item]))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leaves out a test for which no time is left, and says so."""
    left_s = item.config.getoption("--seconds-left")
    if left_s is not None and time.monotonic() - BEGAN_S > left_s:
        pytest.skip(f"left out: not begun within {left_s:g} s")


def pytest_configure(config: pytest.Config) -> None:
    """In a checkout fresh to this Python, compiles what a daemon compiles at its first start.

    Each test of a daemon would else do so in a process of its own, and time out where several do.
    Files are begun in the order of the tests, not the one with the most tests first.
    """
    config.option.loadscopereorder = False
    version = f"py{sys.version_info.major}{sys.version_info.minor}"
    compiled = any((Path(warm_up.__file__).parent / "__pycache__").glob(f"*.{version}.nbi"))
    if compiled or hasattr(config, "workerinput"):
        return
    place = ViaPoint(name="here", left=(0.6, -0.2, 0.3), right=(0.9, 0.3, 0.1), tool=(0.6, -0.2, 0.4))
    skill_worker = SkillWorker()
    for name in ("soldering.npz", "experiments/as-paper.npz"):
        loaded = skill_worker.load(RECORDINGS / name, timeout_s=120.0)
        for one in (loaded, skill_worker.adapt(loaded, [place], tolerance=0.05, timeout_s=120.0)):
            warm_up.warm_up(Settings(), one, urdf=robot_description(Settings()))
    skill_worker.close()


@pytest.fixture(scope="session")
def skill() -> Skill:
    """The shipped soldering skill, without places."""
    path = RECORDINGS / "soldering.npz"
    return decoded(path.read_bytes(), origin=str(path))


@pytest.fixture(scope="session")
def drawing() -> None:
    """That the viewer can draw without a screen: whoever asks for it is skipped where it cannot.

    Asked in a process of its own, as a driver brings libraries of its own.
    """
    if sys.platform == "linux":
        found = subprocess.run([sys.executable, vulkan.__file__], capture_output=True, text=True, check=False)
        if found.stdout.strip() in {"", "0"}:
            pytest.skip("drawing without a screen needs a Vulkan driver: on Debian, apt install mesa-vulkan-drivers")
