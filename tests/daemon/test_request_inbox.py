"""The holders of the arm follow from the ticks that the core completes, whether a request is
withdrawn, late, taken with others, or taken by a tick that fails.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.in_process import Loop
from thirdhand.contract import cdr
from thirdhand.contract.records import Mode
from thirdhand.contract.requests import RequestError
from thirdhand.core.frame import Event
from thirdhand.core.skill.skill import Skill
from thirdhand.daemon import request_inbox
from thirdhand.daemon.request_inbox import MAX_HOLDERS, PendingRequest, RequestInbox
from thirdhand.settings.config import Settings

LED, NOT_LED = (Event("joints/guided", cdr.encode_bool(led), led) for led in (True, False))
BY_HAND = "by hand"
RARELY = st.sampled_from((*6 * (False,), True))
ORDERS = st.tuples(
    st.sampled_from(("hold", "resume")), st.sampled_from(("", "a", "b", "a", "b")), RARELY
)
TICKS = st.lists(st.tuples(st.lists(ORDERS, max_size=2), RARELY, RARELY), min_size=15, max_size=30)


class Cell(Loop):
    """The core and the inbox of its requests."""

    def __init__(self, skill: Skill) -> None:
        super().__init__(Settings(), skill)
        self.inbox = RequestInbox()
        self.tick()

    def tick(self, *events: Event, fails: bool = False) -> None:
        """One tick with these events and the waiting requests."""
        taken = self.inbox.take(self.controller.state)
        self.inbox.answer(None if fails else self.step(*events, *taken))

    def ask(self, kind: str, by: str = "") -> str:
        """The refusal of an order; empty if it was carried out."""
        pending = self.inbox.order(kind, by)
        self.tick()
        return refusal(pending)

    @property
    def is_held(self) -> bool:
        return bool(self.controller.state["operator_hold"])


def refusal(pending: PendingRequest) -> str:
    """The words in which a request is refused; empty if it was carried out."""
    try:
        pending.wait()
    except RequestError as error:
        return str(error)
    return ""


@pytest.fixture(scope="module")
def opened(skill: Skill) -> Callable[[], Cell]:
    return lambda: Cell(skill)


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Requests that no tick has taken are withdrawn at once."""
    monkeypatch.setattr(request_inbox, "ADOPTION_TIMEOUT_S", 0.0)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(ticks=TICKS)
def test_a_resume_ends_what_it_may_end_and_a_hold_is_obeyed(
    opened: Callable[[], Cell], ticks: list[tuple[list[tuple[str, str, bool]], bool, bool]]
) -> None:
    cell = opened()
    holders: set[str] = set()  # the holders by the ticks of the core
    is_led = has_failed = False
    for orders, leads, fails in ticks:
        requests = []
        for kind, by, is_withdrawn in orders:
            pending = cell.inbox.order(kind, by)
            if is_withdrawn:
                assert "did not take" in refusal(pending)
            else:
                requests.append((kind, by, pending))
        cell.tick(LED if leads else NOT_LED, fails=fails)
        for kind, by, pending in requests:
            is_refused = bool(refusal(pending))
            if fails:
                assert is_refused
            elif kind == "hold":
                holders.add(by)
            else:
                may_end = not is_led and (not by or holders == {by})
                assert is_refused != may_end or (is_refused and has_failed)
                holders = holders if is_refused else set()
        has_failed = (has_failed or fails) and bool(holders)  # the tick's effect is unknown
        if not fails:
            is_led = leads
            holders |= {BY_HAND} if is_led else set()
        assert cell.is_held == bool(holders)


def test_a_request_that_no_tick_completed_changes_no_name(opened: Callable[[], Cell]) -> None:
    cell = opened()
    cell.ask("hold", "alice")
    assert "did not take" in refusal(cell.inbox.order("hold", "bob"))
    assert not cell.ask("resume", "alice")
    cell.ask("hold", "alice")
    cell.inbox.order("resume", "alice")
    cell.tick(fails=True)
    cell.ask("hold", "bob")
    assert "somebody else holds the arm too" in cell.ask("resume", "bob")


def test_the_name_beyond_the_last_is_refused_and_its_hold_obeyed(
    opened: Callable[[], Cell],
) -> None:
    cell = opened()
    assert not any(cell.ask("hold", by) for by in ("", *map(str, range(MAX_HOLDERS)), "0"))
    assert "'64' given, but 64 others hold the arm; it holds until a resume without" in cell.ask(
        "hold", "64"
    )
    assert cell.steps[-1][0].inbox[-1].kind == "hold"
    assert "'64' does not hold the arm" in cell.ask("resume", "64")
    assert not cell.ask("resume")
    assert not cell.is_held


def test_no_resume_ends_the_hold_of_one_who_leads_the_arm(opened: Callable[[], Cell]) -> None:
    cell = opened()
    cell.run(500)
    cell.ask("hold", "alice")
    cell.tick(LED)
    for by in ("", "alice"):
        assert cell.ask("resume", by).startswith("the arm is led by hand, which no resume ends")
    cell.tick(NOT_LED)
    cell.run(200)
    assert "somebody else holds the arm too" in cell.ask("resume", "alice")
    assert cell.frames[-1]["mode"] == Mode.HOLD
    assert not cell.ask("resume")
    assert cell.frames[-1]["mode"] == Mode.FOLLOW


def test_a_resume_does_not_end_a_hold_that_was_received_after_it(
    opened: Callable[[], Cell],
) -> None:
    cell = opened()
    cell.ask("hold")
    resume = cell.inbox.order("resume", holds=cell.inbox.holds_received)
    cell.inbox.holds_received += 1
    cell.tick()
    assert refusal(resume) == "a hold was received after this resume; resume again to end it"
    assert cell.is_held
