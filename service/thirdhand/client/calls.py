"""Requests to a running daemon as calls, and their replies as the contract's types."""

from __future__ import annotations

import reprlib
import time
from collections.abc import Iterable
from typing import Any, Literal, TypeVar

import msgspec
import zenoh

from thirdhand.client.presence import is_connected, living, why_silent
from thirdhand.client.replies import decoded
from thirdhand.client.session import (
    RETRY_S,
    RefusedError,
    StartingError,
    UncertainError,
    UnreachableError,
    check_open,
    tried,
)
from thirdhand.contract import channels, requests
from thirdhand.contract.explain import in_file
from thirdhand.contract.messages import Vector3
from thirdhand.contract.printable import printable_lines
from thirdhand.contract.requests import ANSWER_TIMEOUT_S, Reply, Status, ViaPoint, ViaPointInForce

ALIVE_QUERIES = 5
OLD_REPLY = " A Zenoh storage answered with an old reply, but no daemon of this cell is alive."
QUERIES = 2  # queries within the time of one request, if it may be repeated
# a connection that broke returns within this time, unless the network or the daemon is down
RECONNECTED_S = 2.0
REQUESTS = tuple(channel.key for channel in channels.CHANNELS if channel.queryable)
LIST = requests.encode_json(requests.List())
Answer = TypeVar("Answer")


class Client:
    """Requests to a running daemon as calls.

    Each raises RefusedError with the daemon's message, UnreachableError if no daemon answers within
    `timeout_s` [s], or its subclass StartingError while the daemon starts. Old replies from a Zenoh
    storage are ignored: only those of a live daemon are returned.

    A request waits up to 2 s for a connection that broke to return. If it breaks before the answer
    arrives, `status`, `via_points` and `hold` are requested again. Other requests are not, and
    raise UncertainError, a subclass of UnreachableError: they may have been carried out.
    """

    def __init__(
        self,
        session: zenoh.Session,
        cell: str = "thirdhand",
        *,
        timeout_s: float = ANSWER_TIMEOUT_S,
    ) -> None:
        self._session = session
        self._cell = cell
        self._timeout_s = timeout_s
        # Zenoh sessions of daemons of the cell, also of those that ended
        self._daemons: set[str] = set()

    def hold(self, by: str = "") -> Reply:
        """Stop the arm, which then holds; returns once that is in force. `by` names its holder."""
        return self._typed("hold", {"by": by} if by else None, Reply)

    def resume(self, by: str = "") -> Reply:
        """End an operator's hold; returns once that is in force. Without a name, it ends the holds
        of all; with a name, it is refused while anybody else holds. Refused while the arm is led by
        hand.
        """
        return self._typed("resume", {"by": by} if by else None, Reply)

    def reset(self) -> Reply:
        """End a fault; returns once that is in force."""
        return self._typed("reset", None, Reply)

    def begin(self) -> Reply:
        """Begin the task, for a skill whose takes a request began; returns once in force."""
        return self._typed("begin", None, Reply)

    def set_segment(self, name: str) -> Reply:
        """Report that the task has reached this via-point; returns once that is in force."""
        return self._typed("segment", requests.SegmentRequest(name), Reply)

    def status(self) -> Status:
        """The daemon's status."""
        return self._typed("status", None, Status)

    def via_points(self) -> tuple[ViaPointInForce, ...]:
        """The via-points in force, each with the distance [m] by which the skill misses it."""
        return self._typed("via_points", requests.List(), Reply).points or ()

    def add(self, points: Iterable[ViaPoint], *, tolerance: float = requests.TOLERANCE_M) -> Reply:
        """Teach via-points, all or nothing; returns once they are in force.

        They replace learned points of the skill that are nearer than `tolerance` [m].
        """
        return self._typed("via_points", requests.Add(_via_points(points), tolerance), Reply)

    def remove(self, *names: str) -> Reply:
        """Remove via-points by name, all or nothing; returns once that is in force."""
        return self._typed("via_points", requests.Remove(names), Reply)

    def clear(self) -> Reply:
        """Remove all via-points; returns once that is in force."""
        return self._typed("via_points", requests.Clear(), Reply)

    def correct(
        self,
        tool: Vector3 | None = None,
        *,
        hands: Literal["held", "now"] = "held",
        turned: bool = False,
    ) -> Reply:
        """Correct the tool in a hold: it belongs at `tool` [m], None: where the arm was led by
        hand. Returns once that is in force.

        The correction belongs to the `hands` at which the hold began (`held`), or to those of this
        moment (`now`). If `turned`, the orientation of the led tool is corrected too.
        """
        return self._typed("correct", requests.Correct(tool, hands, turned), Reply)

    def undo_correction(self) -> Reply:
        """Undo the last correction, in a hold; returns once that is in force."""
        return self._typed("correct", requests.UndoCorrection(), Reply)

    def load_skill(self, name: str) -> Reply:
        """Load a file of the daemon's skill folder; returns once it is in force."""
        return self._typed("skill", requests.SkillRequest(name), Reply)

    def ask(self, suffix: str, request: Any = None) -> dict[str, Any]:
        """The reply to one request as received; `request` is anything that JSON can encode."""
        if suffix not in REQUESTS:
            raise ValueError(f"request {suffix!r} given; one of {', '.join(REQUESTS)} accepted")
        answer: dict[str, Any] = decoded(self._answer(suffix, request), dict)
        return answer

    def wait_until_ready(
        self, *, timeout_s: float | None = 15.0, silent: bool | None = None
    ) -> Status:
        """The status, once a daemon of this cell is ready.

        It waits for `timeout_s` [s], and longer while the daemon's start makes progress; None:
        until Ctrl-C. Unless `silent`, one message on standard error reports the waiting. By
        default, `silent` is True if there is a timeout.
        """
        return tried(self.status, timeout_s, silent=silent)

    def _typed(self, suffix: str, request: Any, kind: type[Answer]) -> Answer:
        answer = self._answer(suffix, request)
        try:
            return decoded(answer, kind)
        except RefusedError as error:
            raise RefusedError(f"the answer on {self._key(suffix)} is {error}") from None

    def _answer(self, suffix: str, request: Any) -> bytes:
        payload = _encoded(request)
        acts = _acts(suffix, payload)
        # a second hold changes nothing, and a lost one must not remain so
        may_repeat = not acts or suffix == "hold"
        queries_left = QUERIES if may_repeat else 1  # a query, or its answer, may be lost
        query_s = self._timeout_s / queries_left
        end_s = time.monotonic() + min(RECONNECTED_S, self._timeout_s)
        is_sent = False
        while True:
            check_open(self._session)
            is_sent |= is_connected(self._session)
            answer, is_stored = self._asked(suffix, payload, query_s)
            if answer is not None:
                return answer
            queries_left -= 1
            if self._is_absent():
                raise self._silence(suffix, OLD_REPLY * is_stored)
            is_over = queries_left <= 0 and time.monotonic() > end_s
            if is_over or (is_sent and not may_repeat):
                raise self._silence(suffix, may_have_acted=is_sent and acts)

    def _silence(
        self, suffix: str, remark: str = "", *, may_have_acted: bool = False
    ) -> UnreachableError:
        """The error for a request without an answer."""
        silent = f"nobody answers on {self._key(suffix)}: {why_silent(self._session, self._cell)}"
        if may_have_acted:
            return UncertainError(
                f"{silent}. The request may have been carried out: the status shows it"
            )
        return UnreachableError(silent + remark)

    def _asked(self, suffix: str, payload: bytes, timeout_s: float) -> tuple[bytes | None, bool]:
        """The answer of a live daemon to one query, None if there is none; True if a storage
        answered.
        """
        is_stored = False
        for reply in self._session.get(
            self._key(suffix),
            payload=payload,
            encoding=zenoh.Encoding.APPLICATION_JSON,
            # With other targets Zenoh may query only a storage that declares itself complete.
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
        ):
            text = (
                ""
                if reply.err is None
                else printable_lines(reply.err.payload.to_bytes().decode(errors="replace"))
            )
            if text == "Timeout":
                continue
            if text.startswith(requests.STARTING):
                raise StartingError(f"cell {self._cell} is {text}")
            if reply.replier_id is None or not self._is_daemon(str(reply.replier_id.zid)):
                is_stored = True
                continue
            if reply.ok is None:
                raise RefusedError(text or "no reason given")
            return reply.ok.payload.to_bytes(), is_stored
        return None, is_stored

    def _is_absent(self) -> bool:
        """True if the session is connected, and no daemon of the cell is seen for a while. A
        connection that just broke still seems to exist for a moment.
        """
        for _ in range(ALIVE_QUERIES):
            time.sleep(RETRY_S)
            if not is_connected(self._session) or living(self._session, self._cell):
                return False
        return True

    def _is_daemon(self, zid: str) -> bool:
        """True if a daemon of the cell has, or had, the Zenoh session of this identity.

        Tokens may be missing for a moment while other sessions join or leave, so the query is
        repeated up to ALIVE_QUERIES times.
        """
        for attempt in range(ALIVE_QUERIES):
            if zid in self._daemons:
                return True
            time.sleep(RETRY_S * (attempt > 0))
            self._daemons |= living(self._session, self._cell, timeout_s=self._timeout_s)
        return zid in self._daemons

    def _key(self, suffix: str) -> str:
        return channels.key(self._cell, suffix)


def via_point(fields: dict[str, Any]) -> ViaPoint:
    """A via-point from its fields, with numbers and arrays of NumPy too. Raises RefusedError."""
    point: ViaPoint
    try:
        point = requests.decode_request(_encoded(fields), ViaPoint)
    except requests.RequestError as error:
        raise RefusedError(in_file(str(error))) from None
    return point


def _via_points(points: Any) -> tuple[ViaPoint, ...]:
    """The via-points that were given. Raises ValueError."""
    given = tuple(points) if isinstance(points, Iterable) else (None,)
    if not all(isinstance(point, ViaPoint) for point in given):
        raise ValueError(f"points: {reprlib.repr(points)} given; a list of ViaPoints needed")
    return given


def _plain(value: Any) -> Any:
    """A number or an array of NumPy as Python's own; else a text, which is refused in its place."""
    return value.tolist() if hasattr(value, "tolist") else reprlib.repr(value)


def _encoded(request: Any) -> bytes:
    """A request in JSON. Raises RefusedError if it is too large."""
    payload = msgspec.json.encode({} if request is None else request, enc_hook=_plain)
    if len(payload) > channels.LARGEST_REQUEST:
        raise RefusedError(
            f"a request of {len(payload)} bytes, at most {channels.LARGEST_REQUEST} accepted"
        )
    return payload


def _acts(suffix: str, payload: bytes) -> bool:
    """True for a request that may change something."""
    return suffix != "status" and payload != LIST
