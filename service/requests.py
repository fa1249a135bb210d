"""Requests of clients: validated and answered on their own threads, carried out by the loop through its inbox."""

from __future__ import annotations

import json
import os
import queue
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zenoh

from service import wire
from service.arm import Arm
from service.clock import run_beside_real_time
from service.config import Settings
from service.frame import Event
from service.skill import Skill, SkillError
from service.workshop import Workshop

ADOPTION_TIMEOUT_S = 2.0
MOST_POINTS = 400  # via-points of all places
LARGEST_REQUEST = 256 * 1024  # bytes
IMMEDIATE = ("hold", "resume", "reset")


class Pending:
    """An event on its way into the loop, and the tick that took it. Either the loop takes it or its asker gives it up, never both."""

    def __init__(self, event: Event) -> None:
        self._event = event
        self._tick = -1
        self._claim = threading.Lock()
        self._taken = threading.Event()

    def taken(self, tick: int) -> Event | None:
        """The event, consumed by this tick, or None where it was given up. Called by the loop."""
        if not self._claim.acquire(blocking=False):
            return None
        self._tick = tick
        self._taken.set()
        return self._event

    def wait(self) -> int:
        """The tick that consumed it. Raises RequestError where the loop does not; then it never will."""
        if not self._taken.wait(ADOPTION_TIMEOUT_S):
            if self._claim.acquire(blocking=False):
                raise wire.RequestError("the control loop did not take the request: it is ending or stalled")
            self._taken.wait()
        return self._tick


class PlacesFile:
    """The taught places on disk, so that they survive a restart; written atomically."""

    def __init__(self, settings: Settings) -> None:
        self.path = Path(settings.files.state).expanduser() / settings.cell / "places.json"

    def read(self, skill: Skill) -> tuple[tuple[wire.ViaPoint, ...], float] | None:
        """Places and tolerance taught to this skill, or None. Raises SkillError where the file is damaged."""
        try:
            content = self.path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise SkillError(f"cannot read taught places {self.path}: {error.strerror}") from None
        try:
            saved = json.loads(content)
            request = wire.decode_request(json.dumps({"op": "add", **saved["request"]}).encode(), wire.Add) if saved["request"] else None
            if saved["learned_from"] != skill.learned_from:
                return None
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise SkillError(f"{self.path} does not hold taught places ({error})") from None
        return (request.points, request.tolerance) if request else ((), skill.tolerance)

    def write(self, skill: Skill) -> None:
        """Puts the places of this skill into the file. Raises SkillError."""
        self.draft(skill).replace(self.path)

    def draft(self, skill: Skill) -> Path:
        """A new file beside, whole and on disk, that is to replace the old one. Raises SkillError."""
        request = {"points": msgspec.to_builtins(skill.places), "tolerance": skill.tolerance} if skill.places else None
        content = json.dumps({"skill": skill.name, "learned_from": skill.learned_from, "request": request}, indent=1)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile("w", dir=self.path.parent, suffix=".new", delete=False) as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise SkillError(f"cannot save taught places in {self.path.parent}: {error.strerror}") from None
        return Path(file.name)


class Requests:
    """The queryables of one cell. Holding never waits behind teaching: each has its own thread."""

    def __init__(
        self,
        session: zenoh.Session,
        settings: Settings,
        skill: Skill,
        *,
        workshop: Workshop,
        skills: Path,
        status: Callable[[], wire.Status],
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
        self._arm = Arm(settings)
        self._places = PlacesFile(settings)
        self._quick: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._slow: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._queryables = [self._declare(session, suffix) for suffix in (*IMMEDIATE, "status", "via_points", "skill")]
        self._threads = [threading.Thread(target=self._serve, args=(source,), name="requests", daemon=True) for source in (self._quick, self._slow)]
        for thread in self._threads:
            thread.start()

    def _declare(self, session: zenoh.Session, suffix: str) -> zenoh.Queryable[None]:
        def enqueue(query: zenoh.Query) -> None:
            self._quick.put((suffix, query))

        return session.declare_queryable(wire.key(self._settings.cell, suffix), enqueue)

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
            if source is self._quick and suffix in ("via_points", "skill") and not self._is_list(query):
                self._slow.put(item)
                continue
            with query:  # its end tells the asker that no more replies come
                try:
                    self._reply(suffix, query)
                except zenoh.ZError as error:
                    self._note(f"{suffix} could not be answered: {error}")
            item = query = None

    def _is_list(self, query: zenoh.Query) -> bool:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        try:
            return len(payload) < 100 and isinstance(wire.decode_request(payload, wire.ViaPointsRequest), wire.List)
        except wire.RequestError:
            return False

    def _reply(self, suffix: str, query: zenoh.Query) -> None:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        key = wire.key(self._settings.cell, suffix)
        try:
            if str(query.key_expr) != key and suffix != "status":
                raise wire.RequestError(f"{query.key_expr} asks many at once; {key} by its own name needed")
            if len(payload) > LARGEST_REQUEST:
                raise wire.RequestError(f"a request of {len(payload)} bytes, at most {LARGEST_REQUEST} accepted")
            answer = wire.encode_json(self._answer(suffix, payload))
        except (wire.RequestError, SkillError) as error:
            self._note(f"{suffix} refused: {error}")
            query.reply_err(str(error).encode())
        except Exception as error:  # one request that fails must not end all others
            self._note(f"{suffix} failed: {error!r}")
            query.reply_err(f"{type(error).__name__}: {error}".encode())
        else:
            if suffix != "status":
                self._note(f"{suffix} {payload.decode(errors='replace') or '{}'}")
            query.reply(key, answer)

    def _answer(self, suffix: str, payload: bytes) -> wire.Reply | wire.Status:
        if suffix == "status":
            return self._status()
        if suffix in IMMEDIATE:
            wire.decode_request(payload, wire.Nothing)
            return wire.Reply(self._through_the_loop(Event(suffix, wire.encode_string("{}"), None)))
        if suffix == "skill":
            return self._load(wire.decode_request(payload, wire.SkillRequest).name)
        return self._teach(wire.decode_request(payload, wire.ViaPointsRequest))

    def _through_the_loop(self, event: Event) -> int:
        pending = Pending(event)
        self.inbox.append(pending)
        return pending.wait()

    def _adopt(self, skill: Skill) -> wire.Reply:
        self._keep(skill.to_bytes())
        draft = self._places.draft(skill)  # what cannot be saved is not taught
        try:
            tick = self._through_the_loop(Event("skill", skill.to_bytes(), skill))
            draft.replace(self._places.path)
        finally:
            draft.unlink(missing_ok=True)
        self._skill = skill
        return wire.Reply(tick, skill.taught())

    def _load(self, name: str) -> wire.Reply:
        path = self._skills / (name if name.endswith(".npz") else f"{name}.npz")
        if not path.is_file():
            there = ", ".join(sorted(p.stem for p in self._skills.glob("*.npz"))) or "none"
            raise wire.RequestError(f"$.name: no skill {name!r} in the skill folder. There are: {there}")
        skill = self._workshop.load(path)
        if skill.learned_from == self._skill.learned_from and self._skill.places:  # what was taught goes with what was learned
            skill = self._workshop.adapt(skill, self._skill.places, tolerance=self._skill.tolerance)
        return self._adopt(skill)

    def _teach(self, request: wire.ViaPointsRequest) -> wire.Reply:
        places = {place.name: place for place in self._skill.places}
        tolerance = self._skill.tolerance
        match request:
            case wire.List():
                return wire.Reply(self._status().tick, self._skill.taught())
            case wire.Clear():
                places = {}
            case wire.Remove(names):
                for i, name in enumerate(names):
                    if name in names[:i]:
                        raise wire.RequestError(f"$.names[{i}]: {name!r} given twice, names once each needed")
                    if name not in places:
                        raise wire.RequestError(f"$.names[{i}]: no place {name!r}. There are: {', '.join(places) or 'none'}")
                places = {name: place for name, place in places.items() if name not in names}
            case wire.Add(points, tolerance):
                self._check(points)
                places |= {point.name: point for point in points}
        return self._adopt(self._workshop.adapt(self._skill, tuple(places.values()), tolerance=tolerance))

    def _check(self, points: Sequence[wire.ViaPoint]) -> None:
        """Raises RequestError for names given twice and for places that no target may reach."""
        names = [point.name for point in points]
        count = sum(13 if place.radius else 1 for place in {p.name: p for p in (*self._skill.places, *points)}.values())
        if count > MOST_POINTS:
            raise wire.RequestError(f"$.points: {count} via-points in all, 13 for each place with a radius; at most {MOST_POINTS} accepted")
        for i, point in enumerate(points):
            if point.name in names[:i]:
                raise wire.RequestError(f"$.points[{i}].name: {point.name!r} given twice, names once each needed")
            at = np.array(point.tool)
            if not np.array_equal(self._skill.clamp(at), at):
                low, high = (", ".join(f"{v:.2f}" for v in corner) for corner in self._skill.box)
                raise wire.RequestError(f"$.points[{i}].tool: {list(point.tool)} outside the skill's box, ({low}) to ({high}) m accepted")
            if self._arm.clamp(at, np.zeros(3), np.zeros(3))[3]:
                reach = self._settings.reach
                raise wire.RequestError(
                    f"$.points[{i}].tool: {list(point.tool)} out of the arm's reach, {reach.inner} to {reach.outer} m from the shoulder, "
                    f"x ≥ {reach.min_x} m and z ≥ {reach.min_z} m accepted"
                )
