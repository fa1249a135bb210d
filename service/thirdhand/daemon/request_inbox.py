"""Requests on their way into a tick, and the names of those who hold the arm."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future

from thirdhand.contract.records import Mode
from thirdhand.contract.requests import RequestError
from thirdhand.core.frame import Event, Frame, Record, order

ADOPTION_TIMEOUT_S = 2.0  # the loop must take a request within this time
MAX_HOLDERS = 64  # names that hold the arm at once

Check = Callable[[Record], None]
"""Raises RequestError if a request is refused in the state before the tick that takes it."""


def accept(state: Record) -> None:
    """Accept a request in any state."""


class PendingRequest:
    """The events of a request that waits for the loop, and the frame of the tick that takes them.

    Either one tick takes all events, or the requesting thread withdraws them, never both.
    """

    def __init__(self, events: tuple[Event, ...], check: Check) -> None:
        self._events = events
        self._check = check
        self._refusal: RequestError | None = None
        self._frame: Future[Frame] = Future()
        self.mode_before = Mode.HOLD  # mode before the tick that took the request

    def taken(self, state: Record) -> tuple[Event, ...] | None:
        """The events for the tick after this state; None if they were withdrawn. For the loop.

        A request that is refused has no events, except for a hold, because a stop is always obeyed.
        """
        if not self._frame.set_running_or_notify_cancel():
            return None
        self.mode_before = Mode(int(state["mode"]))
        try:
            self._check(state)
        except RequestError as refusal:
            self._refusal = refusal
            return tuple(event for event in self._events if event.kind == "hold")
        return self._events

    def answer(self, frame: Frame | None) -> None:
        """Answer with the refusal, or the frame of the tick; None: it failed. For the loop."""
        if self._refusal is not None:
            self._frame.set_exception(self._refusal)
        elif frame is None:
            self._frame.set_exception(
                RequestError("the loop failed in the tick that took the request: see the status")
            )
        else:
            self._frame.set_result(frame)

    def wait(self) -> Frame:
        """The frame of the tick that took the request. Raises RequestError if it is refused, or if
        no tick takes it in time; it is then withdrawn.
        """
        try:
            return self._frame.result(ADOPTION_TIMEOUT_S)
        except TimeoutError:
            if self._frame.cancel():
                raise RequestError(
                    "the loop did not take the request: it is starting, ending or stalled; try "
                    "again"
                ) from None
            return self._frame.result()


class RequestInbox:
    """The requests that wait for a tick. `take` and `answer` are for the loop, which alone changes
    the names of those who hold the arm.

    A hold by hand guiding needs no name: it is in the state that the loop passes.
    """

    def __init__(self) -> None:
        self._waiting: deque[PendingRequest] = deque()
        self._taken: list[PendingRequest] = []
        # names of those whose hold is in force; empty for one without a name
        self._holders: set[str] = set()
        # counted by the thread that receives holds, before the loop takes them
        self.holds_received = 0

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def send(self, *events: Event, check: Check = accept) -> PendingRequest:
        """A request for the next tick, with all of these events."""
        pending = PendingRequest(events, check)
        self._waiting.append(pending)
        return pending

    def order(self, kind: str, by: str = "", holds: int = 0) -> PendingRequest:
        """An order for the next tick, `by` the one of this name, received after so many `holds`."""
        return self.send(order(kind), check=functools.partial(self._check, kind, by, holds))

    def take(self, state: Record) -> list[Event]:
        """The events of all waiting requests, for a tick after this state."""
        if not state["operator_hold"]:
            self._holders.clear()  # the tick that took a hold failed
        events: list[Event] = []
        while self._waiting:
            pending = self._waiting.popleft()
            if (taken := pending.taken(state)) is not None:
                self._taken.append(pending)
                events += taken
        return events

    def answer(self, frame: Frame | None) -> None:
        """Answer the requests that the newest tick took, with its frame; None: the tick failed."""
        if self._taken and frame is None:
            self._holders.add("")  # a resume may have had no effect
        while self._taken:
            self._taken.pop().answer(frame)

    def _check(self, kind: str, by: str, holds: int, state: Record) -> None:
        """Add a name for a hold, and remove all names for a resume.

        Raises RequestError for more than MAX_HOLDERS names, and for a resume that came before a
        hold, while the arm is led by hand, or by a name that does not hold the arm alone.
        """
        if kind == "hold":
            if by and by not in self._holders and len(self._holders - {""}) >= MAX_HOLDERS:
                raise RequestError(
                    f"$.by: {by!r} given, but {MAX_HOLDERS} others hold the arm; it holds until a "
                    "resume without `by`"
                )
            self._holders.add(by)
        elif kind == "resume":
            self._check_resume(by, holds, state)
            self._holders.clear()

    def _check_resume(self, by: str, holds: int, state: Record) -> None:
        """Raise RequestError for a resume that must not end the hold."""
        if holds < self.holds_received:
            raise RequestError("a hold was received after this resume; resume again to end it")
        if state["guided_tick"] == state["tick"] > 0:
            raise RequestError(
                "the arm is led by hand, which no resume ends; end hand guiding, then resume"
            )
        was_led = state["operator_hold"] and state["guided_tick"] >= max(state["held_tick"], 1)
        if by and (was_led or self._holders != {by}):
            reason = (
                "somebody else holds the arm too"
                if by in self._holders
                else f"{by!r} does not hold the arm"
            )
            raise RequestError(
                f"$.by: {reason}; a resume without `by` needed, which ends all holds"
            )
