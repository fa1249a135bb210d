"""Fixtures of the daemon's tests: a skill worker, and cells that only answer requests."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh
from zenoh_ros2_sdk.session import ZenohSession

from support.request_cell import VIA_POINTS, Cell
from thirdhand.client import endpoints, open_session
from thirdhand.core.skill.skill import Skill
from thirdhand.daemon.skill_worker import SkillWorker


@pytest.fixture(scope="session")
def sessions() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """A listening session and a session connected to it."""
    with (
        open_session(listen=["tcp/127.0.0.1:0"]) as near,
        open_session(connect=endpoints(near)) as far,
    ):
        yield near, far


@pytest.fixture
def router() -> Iterator[zenoh.Session]:
    """A router that connects ROS 2 nodes with a daemon; the nodes close with it."""
    with open_session(listen=["tcp/127.0.0.1:0"], more={"mode": "router"}) as session:
        yield session
        ZenohSession.get_instance().close()


@pytest.fixture(scope="session")
def skill_worker() -> Iterator[SkillWorker]:
    running = SkillWorker()
    yield running
    running.close()


@pytest.fixture
def opened(
    sessions: tuple[zenoh.Session, zenoh.Session], skill: Skill, tmp_path: Path
) -> Iterator[Callable[[SkillWorker], Cell]]:
    """Open a cell, and close it after the test."""
    with contextlib.ExitStack() as closing:
        yield lambda skill_worker: closing.enter_context(
            contextlib.closing(Cell(*sessions, skill, skill_worker, tmp_path))
        )


@pytest.fixture
def cell(opened: Callable[[SkillWorker], Cell], skill_worker: SkillWorker) -> Cell:
    return opened(skill_worker)


@pytest.fixture(scope="module")
def taught_cell(
    sessions: tuple[zenoh.Session, zenoh.Session],
    skill_worker: SkillWorker,
    skill: Skill,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Cell]:
    """A cell with three via-points taught, for requests that change nothing."""
    with contextlib.closing(
        Cell(*sessions, skill, skill_worker, tmp_path_factory.mktemp("cell"))
    ) as cell:
        cell.client.add(VIA_POINTS)
        yield cell
