"""Environment, order and fixtures of all tests."""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from support import forked, tiers
from support.paths import RECORDINGS, ROOT
from thirdhand.client import open_session
from thirdhand.core.skill.skill import Skill
from thirdhand.process.child import python
from thirdhand.recordings.replay import replay
from thirdhand.skills.skill_file import decoded
from thirdhand.viewer import vulkan

for name in ("CONNECT", "CELL", "CERTIFICATE", "ZENOH_CONFIG"):
    os.environ.pop(f"THIRDHAND_{name}", None)
os.environ["XDG_CONFIG_HOME"] = os.devnull  # the user's own client file is ignored
# a cell that names no folder has its lock apart from the user's, and from those of other workers
STATE = tempfile.TemporaryDirectory(prefix="thirdhand-tests-")
os.environ["XDG_STATE_HOME"] = STATE.name
# without bytecode, each of a thousand processes would compile its imports
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# a shell's `&` ignores SIGINT, and child processes inherit that
signal.signal(signal.SIGINT, signal.default_int_handler)

pytest_plugins = ["support.busy"]
PREPARING = pytest.StashKey[subprocess.Popen[bytes]]()


PREPARE = """
from thirdhand.cli.prepare import compiled_for
from thirdhand.recordings.shipped import SHIPPED_SKILL, cell_of, recordings
for arm in ("wam", "ur5"):
    print(compiled_for(cell_of(arm), recordings() / SHIPPED_SKILL), flush=True)
"""


def pytest_configure(config: pytest.Config) -> None:
    """Start compiling the functions that the tests call, while tests are collected; if all are
    cached, this takes 2 s.

    Files run in the order of the tests, not in that of their number of tests.
    """
    config.option.loadscopereorder = False
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Instantly(config), "instantly")
        process = subprocess.Popen(python("-c", PREPARE), stdout=subprocess.DEVNULL)
        config.stash[PREPARING] = process
        config.add_cleanup(process.kill)
    config.add_cleanup(forked.close)


class _Instantly:
    """Prints a failure when it happens, so that an interrupted run shows what failed."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config

    @pytest.hookimpl(trylast=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Print a failure with what the test printed and logged."""
        from support import busy  # after pytest has loaded it as a plug-in

        terminal = self._config.pluginmanager.get_plugin("terminalreporter")
        if terminal is not None and report.failed:
            terminal.write("\n")
            terminal.section(f"{report.nodeid} failed in {report.when}", sep="_")
            terminal._outrep_summary(report)  # noqa: SLF001  # as at the end of the run
        elif terminal is not None and (words := busy.note(report)) and report.when == "call":
            terminal.write("\n")
            terminal.write_line(f"{report.nodeid} failed: {words}")

    def pytest_sessionfinish(self) -> None:
        """Print only the names of failures at the end."""
        self._config.option.tbstyle = "no"


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> None:
    """Start no test before everything is compiled; workers wait for the main process."""
    preparing = session.config.stash.get(PREPARING, None)
    if preparing is not None and preparing.wait() != 0:
        pytest.exit("compilation failed; its output is above", returncode=1)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import only files with such tests if only timed or only quick tests are requested."""
    mark = config.option.markexpr
    if collection_path.suffix != ".py" or mark not in {"timed", "quick"}:
        return None
    is_wanted = f"mark.{mark}" in collection_path.read_text(encoding="utf-8")
    return None if is_wanted or (mark == "quick" and tiers.is_quick_file(collection_path)) else True


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark quick and thorough tests, and run first the files that take longest."""
    begun: set[str] = set()
    for item in items:
        test = item.nodeid.partition("[")[0]
        if item.get_closest_marker("one_case") and test in begun:
            item.add_marker("thorough")
        begun.add(test)
        has_tier = any(item.get_closest_marker(tier) for tier in ("thorough", "timed"))
        if not has_tier and tiers.is_quick_file(item.path):
            item.add_marker("quick")
    items.sort(key=lambda item: tiers.order(_file(item)))


def _file(item: pytest.Item) -> str:
    """The path of a test's file within tests/."""
    return str(item.path.relative_to(ROOT / "tests"))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Fork the commands of a test, unless it is about their start or their timing."""
    forked.use(_file(item) not in tiers.REAL_STARTS)


@pytest.fixture(scope="session")
def skill() -> Skill:
    """The shipped soldering skill, without via-points."""
    path = RECORDINGS / "soldering.npz"
    return decoded(path.read_bytes(), origin=str(path))


@pytest.fixture(scope="module")
def listener() -> Iterator[zenoh.Session]:
    """A session that listens in the daemon's place, at a port that the system chose."""
    with open_session(listen=["tcp/127.0.0.1:0"]) as session:
        yield session


@pytest.fixture(scope="session")
def golden(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """The golden session with a frame for each tick, made by a replay. A lock lets one worker make
    it for all.
    """
    folder = tmp_path_factory.mktemp("whole")
    whole = (folder if worker_id == "master" else folder.parent.parent) / "golden.mcap"
    if not whole.exists():
        assert replay(RECORDINGS / "golden.mcap", output=folder / "replayed.mcap").within_tolerance
        (folder / "replayed.mcap").replace(whole)
    return whole


@pytest.fixture(scope="session")
def drawing() -> None:
    """Skip the test where the viewer cannot draw without a screen."""
    if not vulkan.is_there():
        pytest.skip(
            "drawing without a screen needs a Vulkan driver: on Debian, apt install "
            "mesa-vulkan-drivers"
        )
