"""Requests of clients: validated and answered on their own threads, carried out by the loop through
its inbox.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from service.config import Settings
from service.contract import channels
from service.contract.requests import (
    Add,
    Clear,
    List,
    Nothing,
    Remove,
    Reply,
    RequestError,
    SkillRequest,
    Status,
    ViaPoint,
    encode_json,
)
from service.core.frame import Event, order
from service.core.skill import Skill
from service.core.workspace import is_reachable
from service.learning.skill_file import SkillError
from service.learning.via_points import in_force, points_made_of
from service.shell.clock import run_beside_real_time
from service.shell.saved_via_points import SavedViaPoints
from service.shell.workshop import Workshop

ADOPTION_TIMEOUT_S = 2.0
MOST_POINTS = 400  # that all via-points come to, with their neighbours
LARGEST_REQUEST = 256 * 1024  # bytes
SLOW = ("via_points", "skill")  # what is computed before it is answered


class Pending:
    """An event on its way into the loop, and the tick that took it.

    Either the loop takes it or its asker gives it up, never both.
    """

    def __init__(self, event: Event) -> None:
        self._event = event
        self._tick = -1
        self._claim = threading.Lock()
        self._taken = threading.Event()

    def claimed(self, tick: int) -> Event | None:
        """The event, consumed by this tick, or None where it was given up. Called by the loop."""
        if not self._claim.acquire(blocking=False):
            return None
        self._tick = tick
        self._taken.set()
        return self._event

    def wait(self) -> int:
        """The tick that consumed it.

        Raises RequestError where the loop does not; then it never will.
        """
        if not self._taken.wait(ADOPTION_TIMEOUT_S):
            if self._claim.acquire(blocking=False):
                raise RequestError("the control loop did not take the request: it is ending or stalled")
            self._taken.wait()
        return self._tick


class Requests:
    """The queryables of one cell. Two threads: one for what is answered at once, one for what the
    workshop computes, so that `hold` never waits behind teaching.
    """

    def __init__(
        self,
        session: zenoh.Session,
        settings: Settings,
        skill: Skill,
        *,
        workshop: Workshop,
        skills: Path,
        status: Callable[[], Status],
        note: Callable[[str], None],
        keep: Callable[[bytes], object],
    ) -> None:
        self.inbox: deque[Pending] = deque()
        self._settings = settings
        self._skill = skill
        self._workshop = workshop
        self._skills = skills
        self._status = status
        self._note = note
        self._keep = keep
        self._saved = SavedViaPoints(settings)
        self._quick: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._slow: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._queryables = [self._declare(session, channel.key) for channel in channels.CHANNELS if channel.queryable]
        self._threads = [
            threading.Thread(target=self._serve, args=(source,), name="requests", daemon=True)
            for source in (self._quick, self._slow)
        ]
        for thread in self._threads:
            thread.start()

    def _declare(self, session: zenoh.Session, suffix: str) -> zenoh.Queryable[None]:
        def enqueue(query: zenoh.Query) -> None:
            self._quick.put((suffix, query))

        return session.declare_queryable(channels.key(self._settings.cell, suffix), enqueue)

    def close(self) -> None:
        """Ends both threads; requests still waiting are answered first."""
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]
        for source, thread in zip((self._quick, self._slow), self._threads, strict=True):
            source.put(None)
            thread.join(ADOPTION_TIMEOUT_S + 1)

    def _serve(self, source: queue.SimpleQueue[Any]) -> None:
        run_beside_real_time()
        while (item := source.get()) is not None:
            suffix, query = item
            try:
                if source is self._quick and suffix in SLOW and not self._is_list(query):
                    self._slow.put(item)
                    continue
                with query:  # its end tells the asker that no more replies come
                    self._reply(suffix, query)
            except Exception as error:  # no request may end the thread that answers all others
                self._note(f"{suffix} could not be answered: {error!r}")
            item = query = None

    def _is_list(self, query: zenoh.Query) -> bool:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        try:
            return len(payload) < 100 and isinstance(channels.BY_KEY["via_points"].codec.decode(payload), List)
        except RequestError:
            return False

    def _reply(self, suffix: str, query: zenoh.Query) -> None:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        key = channels.key(self._settings.cell, suffix)
        try:
            if str(query.key_expr) != key and suffix != "status":
                raise RequestError(f"{query.key_expr} asks many at once; {key} by its own name needed")
            if len(payload) > LARGEST_REQUEST:
                raise RequestError(f"a request of {len(payload)} bytes, at most {LARGEST_REQUEST} accepted")
            answer = encode_json(self._answer(suffix, payload))
        except (RequestError, SkillError) as error:
            self._note(f"{suffix} refused: {error}")
            query.reply_err(str(error).encode())
        except Exception as error:  # one request that fails must not end all others
            self._note(f"{suffix} failed: {error!r}")
            query.reply_err(f"{type(error).__name__}: {error}".encode())
        else:
            if suffix != "status":
                self._note(f"{suffix} {payload.decode(errors='replace') or '{}'}")
            query.reply(key, answer)

    def _answer(self, suffix: str, payload: bytes) -> Reply | Status:
        if suffix == "status":
            return self._status()
        request = channels.BY_KEY[suffix].codec.decode(payload)
        match request:
            case SkillRequest(name):
                return self._load(name)
            case List():
                return Reply(self._status().tick, in_force(self._skill))
            case Add() | Remove() | Clear():
                return self._teach(request)
            case Nothing():
                return Reply(self._through_the_loop(order(suffix)))
        raise RequestError(f"nothing is done with a request on {suffix}")

    def _through_the_loop(self, event: Event) -> int:
        pending = Pending(event)
        self.inbox.append(pending)
        return pending.wait()

    def _adopt(self, skill: Skill) -> Reply:
        self._keep(skill.file)
        draft = self._saved.draft(skill)  # what cannot be saved is not taught
        try:
            tick = self._through_the_loop(Event("skill", skill.file, skill))
            draft.replace(self._saved.path)
        finally:
            draft.unlink(missing_ok=True)
        self._skill = skill
        return Reply(tick, in_force(skill))

    def _load(self, name: str) -> Reply:
        path = self._skills / (name if name.endswith(".npz") else f"{name}.npz")
        if not path.is_file():
            there = ", ".join(sorted(p.stem for p in self._skills.glob("*.npz"))) or "none"
            raise RequestError(f"$.name: no skill {name!r} in the skill folder. There are: {there}")
        skill = self._workshop.load(path)
        if (
            skill.learned_from == self._skill.learned_from and self._skill.via_points
        ):  # what was taught goes with what was learned
            skill = self._workshop.adapt(skill, self._skill.via_points, tolerance=self._skill.tolerance)
        return self._adopt(skill)

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
                        there = ", ".join(points) or "none"
                        raise RequestError(f"$.names[{i}]: no via-point {name!r}. There are: {there}")
                points = {name: point for name, point in points.items() if name not in names}
            case Add(added, tolerance):
                self._check(added)
                points |= {point.name: point for point in added}
        return self._adopt(self._workshop.adapt(self._skill, tuple(points.values()), tolerance=tolerance))

    def _check(self, added: Sequence[ViaPoint]) -> None:
        """Raises RequestError for names given twice and for via-points that no target may reach."""
        names = [point.name for point in added]
        total = points_made_of(list({point.name: point for point in (*self._skill.via_points, *added)}.values()))
        if total > MOST_POINTS:
            raise RequestError(
                f"$.points: {total} via-points in all, 13 for each with a radius; at most {MOST_POINTS} accepted"
            )
        low, high = self._skill.workspace
        reach = self._settings.reach
        for i, point in enumerate(added):
            if point.name in names[:i]:
                raise RequestError(f"$.points[{i}].name: {point.name!r} given twice, names once each needed")
            at, given = np.array(point.tool), f"$.points[{i}].tool: {list(point.tool)}"
            if not ((low <= at) & (at <= high)).all():
                corners = " to ".join(f"({', '.join(f'{v:.2f}' for v in corner)})" for corner in (low, high))
                raise RequestError(f"{given} outside the skill's box, {corners} m accepted")
            if not is_reachable(at, reach):
                raise RequestError(
                    f"{given} out of the arm's reach, {reach.inner} to {reach.outer} m from the shoulder, "
                    f"x ≥ {reach.min_x} m and z ≥ {reach.min_z} m accepted"
                )
