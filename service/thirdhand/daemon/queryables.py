"""Clients' requests, which wait in queues, are answered on other threads than Zenoh's, and have an
effect through the loop's inbox.
"""

from __future__ import annotations

import functools
import queue
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import msgspec
import zenoh

from thirdhand.client import ENCODINGS
from thirdhand.contract import channels
from thirdhand.contract.requests import HoldRequest, List, Reply, RequestError, encode_json
from thirdhand.daemon import supervised_thread
from thirdhand.daemon.answers import Answer, Answers, OrderRequest, StatusRequest
from thirdhand.daemon.cell_state import CellState
from thirdhand.daemon.clock import run_beside_real_time
from thirdhand.daemon.request_inbox import ADOPTION_TIMEOUT_S
from thirdhand.skills.skill_file import SkillError

MAX_WAITING_REQUESTS = 16
MAX_WAITING_ORDERS = 1024  # more than for other requests, because one tick takes all waiting orders
MAX_LIST_BYTES = 100  # a longer request is not a `list`
TEXT = zenoh.Encoding.TEXT_PLAIN
ORDER_KEYS = ("hold", "resume", "reset", "begin")
TOGETHER = (*ORDER_KEYS, "status")  # all waiting requests on one of these keys get the same answer
COMPUTED = "teaching"  # name of the queue of requests for which the skill worker computes


class Received(NamedTuple):
    """A query on a key, the number of holds that were received until then, and its arrival
    (time.monotonic() [s]).
    """

    suffix: str
    query: zenoh.Query
    holds: int
    received_s: float


class RequestQueue:
    """A bounded queue of requests with a thread that answers them.

    `answer` is called with all waiting requests on one of TOGETHER, and with other requests one by
    one.
    """

    def __init__(
        self, name: str, answer: Callable[[list[Received]], None], failed: Callable[[str], None]
    ) -> None:
        self._name = name
        self._answer = answer
        self._max_together = MAX_WAITING_ORDERS if name in TOGETHER else 1
        self._max_waiting = max(self._max_together, MAX_WAITING_REQUESTS)
        self._waiting: queue.Queue[Received | None] = queue.Queue(self._max_waiting)
        self._thread = supervised_thread.start(f"thread of {name} requests", self._serve, failed)

    def enqueue(self, request: Received) -> None:
        """Add a request, or refuse it if the queue is full. Never waits."""
        try:
            self._waiting.put_nowait(request)
        except queue.Full:
            with request.query:
                refusal = (
                    f"busy: {self._max_waiting} {self._name} requests are waiting; try again later"
                )
                request.query.reply_err(refusal.encode(), encoding=TEXT)

    def close(self) -> None:
        """Answer the waiting requests and end the thread."""
        self._waiting.put(None)
        self._thread.join(ADOPTION_TIMEOUT_S + 1)

    def _serve(self) -> None:
        run_beside_real_time()
        while True:
            taken = [self._waiting.get()]
            while len(taken) < self._max_together and not self._waiting.empty():
                taken.append(self._waiting.get())
            self._answer([item for item in taken if item is not None])
            if taken[-1] is None:
                return
            taken.clear()  # a client's query ends with its last reference


class Queryables:
    """The queryables of one cell, which answer from `open` on.

    Each key of TOGETHER has its own queue, and the requests for which the skill worker computes
    have one, so that no kind waits for another. `list` is answered at once. A request that changes
    something is answered once a status with the change has been published.
    """

    def __init__(self, cell: CellState, answers: Answers) -> None:
        self._cell = cell
        self._answers = answers
        self._queues = {
            name: RequestQueue(name, self._reply_together, cell.fail)
            for name in (*TOGETHER, COMPUTED)
        }
        self._queryables: list[zenoh.Queryable[None]] = []

    def open(self, session: zenoh.Session) -> None:
        """Answer requests from now on."""
        self._queryables = [
            self._declare(session, channel.key)
            for channel in channels.CHANNELS
            if channel.queryable
        ]

    def _declare(self, session: zenoh.Session, suffix: str) -> zenoh.Queryable[None]:
        def receive(query: zenoh.Query) -> None:
            try:
                run_beside_real_time()  # on a thread of Zenoh, which may be another one each time
                inbox = self._cell.inbox
                inbox.holds_received += suffix == "hold"
                request = Received(suffix, query, inbox.holds_received, time.monotonic())
                if _is_list(request):
                    self._reply_together([request])
                else:
                    self._queues[suffix if suffix in TOGETHER else COMPUTED].enqueue(request)
            except Exception as error:
                self._cell.fail(f"receiving {suffix} requests failed: {error!r}")

        return session.declare_queryable(channels.key(self._cell.settings.cell, suffix), receive)

    def close(self) -> None:
        """Answer the waiting requests and end all threads."""
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]
        for waiting in self._queues.values():
            waiting.close()

    def _reply_together(self, requests: Sequence[Received]) -> None:
        """Reply to requests that wait together; equal ones pass through the loop once."""
        answer_once = functools.cache(self._answers.answer)
        for request in requests:
            self._reply(request, answer_once)

    def _reply(self, received: Received, answer: Callable[[Any], Answer]) -> None:
        suffix = received.suffix
        query = received.query
        key = channels.key(self._cell.settings.cell, suffix)
        # The query's end shows the client that there are no more replies.
        with query, self._answers.skill_worker.due(received.received_s):
            try:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                request, remark = _understood(received, key, payload)
                reply = answer(request)
                if isinstance(reply, RequestError):
                    raise reply
                if isinstance(reply, Reply):
                    reply = encode_json(
                        msgspec.structs.replace(reply, note=remark) if remark else reply
                    )
                changes = not isinstance(request, List | StatusRequest)
                if changes:
                    answer(StatusRequest(published=True))
            except Exception as error:  # a request that fails must not end the thread
                is_refused = isinstance(error, RequestError | SkillError)
                self._cell.note(
                    f"{suffix} refused: {error}" if is_refused else f"{suffix} failed: {error!r}"
                )
                text = str(error) if is_refused else f"{type(error).__name__}: {error}"
                query.reply_err(text.encode(), encoding=TEXT)
            else:
                if changes:
                    self._cell.note(f"{suffix} {payload.decode(errors='replace') or '{}'}")
                query.reply(key, reply, encoding=ENCODINGS["json"])


def _understood(received: Received, key: str, payload: bytes) -> tuple[Any, str]:
    """The request in the payload of a query for this key, and a remark on what was not understood.

    A hold that is not understood is one without a name, because a stop is always obeyed. Raises
    RequestError for other requests.
    """
    suffix = received.suffix
    if suffix == "status":
        return StatusRequest(), ""
    expression = str(received.query.key_expr)
    if expression != key:
        raise RequestError(f"{expression} matches several cells; the key {key} needed")
    remark = ""
    try:
        if len(payload) > channels.LARGEST_REQUEST:
            raise RequestError(
                f"a request of {len(payload)} bytes, at most {channels.LARGEST_REQUEST} accepted"
            )
        request = channels.BY_KEY[suffix].codec.decode(payload)
    except RequestError as error:
        if suffix != "hold":
            raise
        request = HoldRequest()
        remark = f"the arm holds, but the request was not understood: {error}"
    if suffix in ORDER_KEYS:
        request = OrderRequest(
            suffix, getattr(request, "by", ""), received.holds if suffix == "resume" else 0
        )
    return request, remark


def _is_list(received: Received) -> bool:
    payload = received.query.payload
    if received.suffix != "via_points" or payload is None or len(payload) > MAX_LIST_BYTES:
        return False
    try:
        return isinstance(channels.BY_KEY[received.suffix].codec.decode(payload.to_bytes()), List)
    except RequestError:
        return False
