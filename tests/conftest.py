"""What several tests share."""

from __future__ import annotations

from service import one_blas_thread  # noqa: F401

# isort: split
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from service.core.skill.skill import Skill
from service.learning.skill_file import decoded
from service.recording.replay import replay
from support import compiling, tiers, vulkan
from support.paths import RECORDINGS, ROOT

BEGAN_S = time.monotonic()
for name in ("CONNECT", "CELL", "CERTIFICATE", "ZENOH_CONFIG"):
    os.environ.pop(f"THIRDHAND_{name}", None)
os.environ["XDG_CONFIG_HOME"] = os.devnull  # no client file of whoever runs the tests


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--seconds-left`, for what is run as long as there is time."""
    parser.addoption("--seconds-left", type=float, metavar="S", help="leave out what has not begun after so long")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Where only what is timed is asked for, what holds none of it is not imported."""
    only_timed = config.option.markexpr.startswith("timed") and collection_path.suffix == ".py"
    return True if only_timed and "mark.timed" not in collection_path.read_text(encoding="utf-8") else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks what is quick and what is research, and puts first what needs nothing compiled, then
    the files that take longest.
    """
    for item in items:
        for marker in tiers.markers(_where(item), timed=item.get_closest_marker("timed") is not None):
            item.add_marker(marker)
    items.sort(key=lambda item: tiers.begins(_where(item)))


def _where(item: pytest.Item) -> str:
    """The test as `tiers` names it."""
    return str(item.path.relative_to(ROOT / "tests")) + "::" + item.nodeid.split("::", 1)[-1]


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leaves out a test for which no time is left, and says so; else waits for what is compiled."""
    left_s = item.config.getoption("--seconds-left")
    if left_s is not None and time.monotonic() - BEGAN_S > left_s:
        pytest.skip(f"left out: not begun within {left_s:g} s")
    if not tiers.is_among(_where(item), tiers.UNCOMPILED):
        compiling.wait(six="ur5" in item.nodeid)


def pytest_configure(config: pytest.Config) -> None:
    """Begins to compile in a checkout fresh to this Python, once for all workers.

    Files are begun in the order of the tests, not the one with the most tests first.
    """
    config.option.loadscopereorder = False
    if not hasattr(config, "workerinput") and compiling.is_needed():
        process = compiling.begun()
        config.add_cleanup(lambda: compiling.end(process))


@pytest.fixture(scope="session")
def skill() -> Skill:
    """The shipped soldering skill, without places."""
    path = RECORDINGS / "soldering.npz"
    return decoded(path.read_bytes(), origin=str(path))


@pytest.fixture(scope="session")
def golden(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """The golden session with a frame for each tick: made by a replay, once for all workers if
    none begins before another has ended.
    """
    own = tmp_path_factory.mktemp("whole")
    whole = (own if worker_id == "master" else own.parent.parent) / "golden.mcap"
    if not whole.exists():
        assert replay(RECORDINGS / "golden.mcap", output=own / "replayed.mcap").within_tolerance
        (own / "replayed.mcap").replace(whole)
    return whole


@pytest.fixture(scope="session")
def drawing() -> None:
    """That the viewer can draw without a screen: whoever asks for it is skipped where it cannot.

    Asked in a process of its own, as a driver brings libraries of its own.
    """
    if sys.platform == "linux":
        found = subprocess.run([sys.executable, vulkan.__file__], capture_output=True, text=True, check=False)
        if found.stdout.strip() in {"", "0"}:
            pytest.skip("drawing without a screen needs a Vulkan driver: on Debian, apt install mesa-vulkan-drivers")
