"""What several tests share."""

from __future__ import annotations

from service.process import one_blas_thread  # noqa: F401

# isort: split
import os
from pathlib import Path

import pytest

from service.core.skill.skill import Skill
from service.files.replay import replay
from service.learning.skill_file import decoded
from service.viewer import vulkan
from support import compiling, tiers
from support.paths import RECORDINGS, ROOT

for name in ("CONNECT", "CELL", "CERTIFICATE", "ZENOH_CONFIG"):
    os.environ.pop(f"THIRDHAND_{name}", None)
os.environ["XDG_CONFIG_HOME"] = os.devnull  # no client file of whoever runs the tests


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
    """Wait until the functions that the test calls are compiled."""
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
    """Skip the test where the viewer cannot draw without a screen."""
    if not vulkan.is_there():
        pytest.skip("drawing without a screen needs a Vulkan driver: on Debian, apt install mesa-vulkan-drivers")
