"""Clients' requests: validated on other threads, carried out through the loop's inbox."""

from __future__ import annotations

import functools
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Protocol

import numpy as np
import zenoh

from service.client import ENCODINGS
from service.contract import channels
from service.contract.incidents import word
from service.contract.records import Mode
from service.contract.requests import (
    Add,
    Clear,
    List,
    Nothing,
    Remove,
    Reply,
    RequestError,
    SkillRequest,
    StageRequest,
    ViaPoint,
    encode_json,
)
from service.core.frame import Event, Frame, order
from service.daemon import supervised_thread
from service.daemon.clock import run_beside_real_time
from service.daemon.saved_via_points import SavedViaPoints
from service.daemon.skill_worker import SkillWorker
from service.daemon.status import outcome
from service.learning.reach import accepted, out_of_reach
from service.learning.skill_file import SkillError, StoredSkill
from service.learning.via_points import in_force, points_made_of, warnings_of
from service.settings.config import Settings

ADOPTION_TIMEOUT_S = 2.0
POLL_S = 0.001  # while waiting for the tick that took a request
MOST_POINTS = 400  # of all via-points that are not the task's, with the points of their neighbourhoods
MOST_WAITING = 16  # requests in a queue ...
MOST_ORDERS = 1024  # ... of orders, of which one tick takes all
LONGEST_LIST = 100  # bytes
TEXT = zenoh.Encoding.TEXT_PLAIN
ORDERS = ("hold", "resume", "reset")
TOGETHER = (*ORDERS, "status")  # one answer is that of all that wait
COMPUTED = "teaching"  # the queue of requests for which the skill worker computes


Order = Callable[[str], Reply | RequestError]  # carries out hold, resume or reset


class Requested(Protocol):
    """Makes a status that is newer than its call, and publishes it where that is wanted."""

    def __call__(self, *, published: bool) -> bytes: ...


class PendingEvent:
    """An event on its way into the loop, and the tick that took it.

    Either the loop takes it or the requesting thread withdraws it, never both.
    """

    def __init__(self, event: Event) -> None:
        self._event = event
        self._tick: Future[int] = Future()

    def claimed(self, tick: int) -> Event | None:
        """The event, consumed by this tick, or None where it was withdrawn. Called by the loop."""
        if not self._tick.set_running_or_notify_cancel():
            return None
        self._tick.set_result(tick)
        return self._event

    def wait(self) -> int:
        """The tick that consumed it. Raises RequestError where none does, nor ever will."""
        try:
            return self._tick.result(ADOPTION_TIMEOUT_S)
        except TimeoutError:
            if self._tick.cancel():
                raise RequestError("the loop did not take the request: it is starting, ending or stalled") from None
            return self._tick.result()


class RequestQueue:
    """Requests that wait for a thread of their own; one beyond `most` is refused.

    `answer` takes those of TOGETHER as many as wait, and other requests one by one.
    """

    def __init__(
        self, name: str, answer: Callable[[list[tuple[str, zenoh.Query]]], None], failed: Callable[[str], None]
    ) -> None:
        self._name, self._answer = name, answer
        self._most, self._together = (MOST_ORDERS, MOST_ORDERS) if name in TOGETHER else (MOST_WAITING, 1)
        self._waiting: queue.Queue[tuple[str, zenoh.Query] | None] = queue.Queue(self._most)
        self._thread = supervised_thread.start(f"thread of {name} requests", self._serve, failed)

    def enqueue(self, suffix: str, query: zenoh.Query) -> None:
        """Never waits."""
        try:
            self._waiting.put_nowait((suffix, query))
        except queue.Full:
            with query:
                refusal = f"busy: {self._most} {self._name} requests wait already; try again later"
                query.reply_err(refusal.encode(), encoding=TEXT)

    def close(self) -> None:
        """Ends the thread; waiting requests are answered first."""
        self._waiting.put(None)
        self._thread.join(ADOPTION_TIMEOUT_S + 1)

    def _serve(self) -> None:
        run_beside_real_time()
        ended = False
        while not ended:
            taken = [self._waiting.get()]
            while len(taken) < self._together and not self._waiting.empty():
                taken.append(self._waiting.get())
            ended = taken[-1] is None
            self._answer([item for item in taken if item is not None])
            taken.clear()  # a client's query ends once its last reference is gone


class Queryables:
    """The queryables of one cell, which answer once they are open.

    Each of TOGETHER has a queue of its own, and the requests for which the skill worker computes
    have one: no kind waits behind another. The via-points in force are listed at once. `status` is
    to return a status that is newer than its call; a request that changed something is answered
    once a status that shows it is published.
    """

    def __init__(
        self,
        settings: Settings,
        skill: StoredSkill,
        *,
        skill_worker: SkillWorker,
        skills: Path,
        status: Requested,
        frame: Callable[[], Frame],
        note: Callable[[str], None],
        keep: Callable[[bytes], object],
        failed: Callable[[str], None],
    ) -> None:
        self.inbox: deque[PendingEvent] = deque()
        self._settings = settings
        self._skill, self._in_force = skill, in_force(skill)
        self._skill_worker = skill_worker
        self._skills = skills
        self._status = status
        self._frame = frame
        self._note = note
        self._keep = keep
        self._failed = failed
        self._saved = SavedViaPoints(settings, skill_worker.beyond_m)
        self._queues = {name: RequestQueue(name, self._reply_together, failed) for name in (*TOGETHER, COMPUTED)}
        self._queryables: list[zenoh.Queryable[None]] = []

    def open(self, session: zenoh.Session) -> None:
        """Answers requests from now on."""
        self._queryables = [self._declare(session, channel.key) for channel in channels.CHANNELS if channel.queryable]

    def _declare(self, session: zenoh.Session, suffix: str) -> zenoh.Queryable[None]:
        local = threading.local()  # Zenoh calls from a thread of its own for each queryable

        def receive(query: zenoh.Query) -> None:
            try:
                if not hasattr(local, "is_prioritised"):
                    local.is_prioritised = True
                    run_beside_real_time()
                if self._is_list(suffix, query):
                    self._reply(suffix, query, self._order, self._status)
                else:
                    self._queues[suffix if suffix in TOGETHER else COMPUTED].enqueue(suffix, query)
            except Exception as error:
                self._failed(f"receiving {suffix} requests failed: {error!r}")

        return session.declare_queryable(channels.key(self._settings.cell, suffix), receive)

    def close(self) -> None:
        """Ends all threads; requests still waiting are answered first."""
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]
        for waiting in self._queues.values():
            waiting.close()

    @staticmethod
    def _is_list(suffix: str, query: zenoh.Query) -> bool:
        if suffix != "via_points" or query.payload is None or len(query.payload) > LONGEST_LIST:
            return False
        try:
            return isinstance(channels.BY_KEY[suffix].codec.decode(query.payload.to_bytes()), List)
        except RequestError:
            return False

    def _reply_together(self, asked: Sequence[tuple[str, zenoh.Query]]) -> None:
        """Replies to requests once a status shows what they changed; equal orders go through the
        loop once.
        """
        order_once, status_once = functools.cache(self._order), functools.cache(self._status)
        for suffix, query in asked:
            self._reply(suffix, query, order_once, status_once)

    def _reply(self, suffix: str, query: zenoh.Query, order: Order, status: Requested) -> None:
        key = channels.key(self._settings.cell, suffix)
        with query:  # its end tells the client that no more replies come
            try:
                if str(query.key_expr) != key and suffix != "status":
                    raise RequestError(f"{query.key_expr} asks many at once; {key} by its own name needed")
                payload = b"" if query.payload is None else query.payload.to_bytes()
                if (size := len(payload)) > channels.LARGEST_REQUEST:
                    raise RequestError(f"a request of {size} bytes, at most {channels.LARGEST_REQUEST} accepted")
                if suffix == "status":
                    answer, changes = status(published=False), False
                else:
                    request = channels.BY_KEY[suffix].codec.decode(payload)
                    answer, changes = encode_json(self._answer(suffix, request, order)), not isinstance(request, List)
                if changes:
                    status(published=True)
            except (RequestError, SkillError) as error:
                self._note(f"{suffix} refused: {error}")
                query.reply_err(str(error).encode(), encoding=TEXT)
            except Exception as error:  # one request that fails must not end the thread
                self._note(f"{suffix} failed: {error!r}")
                query.reply_err(f"{type(error).__name__}: {error}".encode(), encoding=TEXT)
            else:
                if changes:
                    self._note(f"{suffix} {payload.decode(errors='replace') or '{}'}")
                query.reply(key, answer, encoding=ENCODINGS["json"])

    def _answer(self, suffix: str, request: object, order: Order) -> Reply:
        match request:
            case SkillRequest(name):
                return self._load(name)
            case StageRequest(name):
                return self._set_stage(name)
            case List():
                return Reply(int(self._frame()["tick"]), self._in_force)
            case Add() | Remove() | Clear():
                return self._teach(request)
            case Nothing():
                if isinstance(reply := order(suffix), RequestError):
                    raise reply
                return reply
        raise RequestError(f"nothing is done with a request on {suffix}")

    def _order(self, suffix: str) -> Reply | RequestError:
        """The reply to hold, resume or reset, with the mode that resulted, or why there is none."""
        before, _ = outcome(self._frame())
        try:
            tick = self._through_the_loop(order(suffix))
        except RequestError as error:
            return error
        mode, reason = outcome(self._frame())
        note = ""
        if suffix == "reset" and before is not Mode.FAULT:
            note = "there was no fault: nothing was reset"
        elif suffix == "resume" and before is Mode.FOLLOW:
            note = "there was no hold to end"
        elif suffix == "resume" and mode is Mode.FAULT:
            note = "a fault is ended by reset, not by resume"
        return Reply(tick, mode=word(mode), reason=word(reason), note=note)

    def _set_stage(self, name: str) -> Reply:
        if name not in (names := self._skill.model.names):
            known = ", ".join(names) or "none, as the skill was not learned between via-points"
            raise RequestError(f"$.name: no via-point {name!r} of the task. There are: {known}")
        tick = self._through_the_loop(order("stage", name))
        mode, reason = outcome(self._frame())
        return Reply(tick, mode=word(mode), reason=word(reason))

    def _through_the_loop(self, event: Event) -> int:
        """The tick that took an event, once that has decided."""
        pending = PendingEvent(event)
        self.inbox.append(pending)
        tick, end = pending.wait(), time.monotonic() + ADOPTION_TIMEOUT_S
        while int(self._frame()["tick"]) < tick and time.monotonic() < end:
            time.sleep(POLL_S)
        return tick

    def _adopt(self, skill: StoredSkill, *, is_loaded: bool = False) -> Reply:
        """Raises RequestError for a loaded skill most of whose places the arm does not reach."""
        distances_m = self._skill_worker.beyond_m(self._settings, skill.tool_positions)
        found = out_of_reach(skill, distances_m, self._settings)
        if is_loaded and found.is_refused:
            raise RequestError(found.text)
        self._keep(skill.file)
        draft = self._saved.draft(skill)  # first: what cannot be saved is not taught
        try:
            tick = self._through_the_loop(Event("skill", skill.file, skill.for_loop()))
            draft.replace(self._saved.path(skill))
        finally:
            draft.unlink(missing_ok=True)
        before, self._skill, self._in_force = self._skill, skill, in_force(skill)
        warnings = warnings_of(before, skill)
        return Reply(tick, self._in_force, (found.text, *warnings) if found.text else warnings)

    def _load(self, name: str) -> Reply:
        folder = self._skills.resolve()
        files = [path for path in sorted(folder.glob("*.npz")) if path.is_file() and path.resolve().parent == folder]
        found = {path.stem: path for path in files}  # without links to files elsewhere
        path = found.get(name.removesuffix(".npz"))
        if path is None:
            names = ", ".join(found) or "none"
            raise RequestError(f"$.name: no skill {name!r} in the skill folder. There are: {names}")
        skill = self._skill_worker.load(path)
        if saved := self._saved.read(skill):  # its via-points were taught before
            points, tolerance = saved
            skill = self._skill_worker.adapt(skill, points, tolerance=tolerance)
        return self._adopt(skill, is_loaded=True)

    def _teach(self, request: Add | Remove | Clear) -> Reply:
        points = {point.name: point for point in self._skill.via_points}
        tolerance = self._skill.tolerance
        match request:
            case Clear():
                points = {}
            case Remove(names):
                for i, name in enumerate(names):
                    if name in names[:i]:
                        raise RequestError(f"$.names[{i}]: {name!r} given twice, names once each needed")
                    if name not in points:
                        known = ", ".join(points) or "none"
                        raise RequestError(f"$.names[{i}]: no via-point {name!r}. There are: {known}")
                points = {name: point for name, point in points.items() if name not in names}
            case Add(added, tolerance):
                self._check(added)
                points |= {point.name: point for point in added}
        return self._adopt(self._skill_worker.adapt(self._skill, tuple(points.values()), tolerance=tolerance))

    def _check(self, added: Sequence[ViaPoint]) -> None:
        """Raises RequestError for too many via-points, and for those out of reach."""
        all_of_them = {point.name: point for point in (*self._skill.via_points, *added)}
        total = points_made_of([all_of_them[name] for name in all_of_them.keys() - set(self._skill.model.names)])
        if total > MOST_POINTS:
            raise RequestError(
                f"$.points: {total} via-points beside the task's, 13 each with a radius; at most {MOST_POINTS} accepted"
            )
        low, high = self._skill.workspace
        beyond_m = self._skill_worker.beyond_m(self._settings, np.array([point.tool for point in added]))
        for i, (point, distance_m) in enumerate(zip(added, beyond_m, strict=True)):
            at, given = np.array(point.tool), f"$.points[{i}].tool: {list(point.tool)}"
            if not ((low <= at) & (at <= high)).all():
                corners = " to ".join(f"({', '.join(f'{v:.2f}' for v in corner)})" for corner in (low, high))
                raise RequestError(f"{given} outside the skill's box, {corners} m accepted")
            if distance_m > 0.0:
                raise RequestError(f"{given} out of the arm's reach by {distance_m:.3f} m: {accepted(self._settings)}")
