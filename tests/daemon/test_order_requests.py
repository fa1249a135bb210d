"""Requests to hold, to resume and to reset: answered with the tick that took them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from service.client import RefusedError
from service.contract import channels, requests
from service.core.frame import Event
from service.core.skill.skill import Skill
from service.daemon.queryables import PendingEvent
from service.daemon.skill_worker import SkillWorker
from service.learning.via_points import adapted
from support.request_cell import PLACES, Cell


class SlowWorkshop(SkillWorker):
    """A skill worker in this process that adapts when it is let."""

    def __init__(self) -> None:
        super().__init__()
        self.begun, self.let = threading.Event(), threading.Event()

    def adapt(
        self, skill: Skill, places: Sequence[requests.ViaPoint], *, tolerance: float, timeout_s: float = 0.0
    ) -> Skill:
        self.begun.set()
        assert self.let.wait(20)
        return adapted(skill, places, tolerance=tolerance)


@pytest.fixture
def slow() -> Iterator[SlowWorkshop]:
    running = SlowWorkshop()
    yield running
    running.close()


@pytest.mark.parametrize("suffix", ["hold", "resume", "reset"])
def test_a_plain_request_is_answered_with_the_tick_that_took_it(cell: Cell, suffix: str) -> None:
    first, second = cell.client.ask(suffix), cell.client.ask(suffix, {})
    assert 0 < first["tick"] < second["tick"]
    assert cell.kinds() == [suffix, suffix]


def test_an_empty_payload_is_an_empty_request(cell: Cell) -> None:
    (reply,) = cell.session.get(channels.key(cell.settings.cell, "hold"), timeout=10.0)
    assert reply.ok is not None
    assert cell.kinds() == ["hold"]


@pytest.mark.parametrize("suffix", ["hold", "resume", "reset"])
@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"now": True}, "$: unknown field 'now'; known are none"),
        (None, "$: null (or NaN) given; an object with its fields needed"),
        (b"hold!", "not JSON: JSON is malformed"),
    ],
)
def test_a_plain_request_with_something_in_it_is_refused(
    taught_cell: Cell, suffix: str, request_: Any, message: str
) -> None:
    assert taught_cell.refusal(suffix, request_).startswith(message)


def test_a_loop_that_does_not_take_a_request_is_told(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.daemon.queryables.ADOPTION_TIMEOUT_S", 0.05)
    cell.running = False
    with pytest.raises(RefusedError, match="the loop did not take the request: it is starting, ending or stalled"):
        cell.client.ask("hold")


def test_hold_is_answered_while_a_slow_request_runs(opened: Callable[[SkillWorker], Cell], slow: SlowWorkshop) -> None:
    cell = opened(slow)
    with ThreadPoolExecutor(1) as pool:
        teaching = pool.submit(cell.client.add, PLACES)
        assert slow.begun.wait(10)
        held = cell.client.ask("hold")
        assert cell.kinds() == ["hold"]
        assert cell.client.ask("status")["cell"] == cell.settings.cell
        slow.let.set()
        taught = teaching.result(20)
    assert cell.kinds() == ["hold", "skill"]
    assert held["tick"] < taught.tick


def test_requests_that_wait_are_answered_before_the_end(
    opened: Callable[[SkillWorker], Cell], slow: SlowWorkshop
) -> None:
    cell = opened(slow)
    with ThreadPoolExecutor(2) as pool:
        teaching = pool.submit(cell.client.add, PLACES)
        assert slow.begun.wait(10)
        closing = pool.submit(cell.close)
        slow.let.set()
        assert teaching.result(20).points
        closing.result(20)


def test_a_pending_event_tells_the_tick_that_took_it() -> None:
    event = Event("hold", b"", None)
    pending = PendingEvent(event)
    assert pending.claimed(42) is event
    assert pending.wait() == 42
