"""Clients' requests, validated on other threads and executed through the loop's inbox."""

from __future__ import annotations

import functools
import queue
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import msgspec
import numpy as np
import zenoh

from thirdhand.client import ENCODINGS
from thirdhand.contract import channels
from thirdhand.contract.explain import in_words
from thirdhand.contract.incidents import word
from thirdhand.contract.records import Mode
from thirdhand.contract.requests import (
    Add,
    Clear,
    Correct,
    Correction,
    HoldRequest,
    List,
    Nothing,
    Remove,
    Reply,
    RequestError,
    SegmentRequest,
    SkillRequest,
    UndoCorrection,
    ViaPoint,
    encode_json,
)
from thirdhand.core.frame import Event, Frame, order
from thirdhand.daemon import supervised_thread
from thirdhand.daemon.clock import run_beside_real_time
from thirdhand.daemon.correcting import Corrections, Moment, check_same_hold, held_since
from thirdhand.daemon.request_inbox import ADOPTION_TIMEOUT_S, Check, RequestInbox, accept
from thirdhand.daemon.saved_via_points import SavedViaPoints
from thirdhand.daemon.skill_worker import SkillWorker, has_posture_of
from thirdhand.daemon.status import outcome
from thirdhand.settings.config import Settings
from thirdhand.skills.corrections import (
    LEAST_CORRECTION_M,
    Effect,
    correction_at,
    newest_correction,
    off_m,
    offer_of,
    segment_of,
)
from thirdhand.skills.reach import accepted, beyond_m, out_of_reach
from thirdhand.skills.skill_file import SkillError, StoredSkill
from thirdhand.skills.via_points import in_force, points_made_of, warnings_of

# limit of via-points that are not the task's, with the points of their neighbourhoods
MAX_VIA_POINTS = 400
MAX_WAITING_REQUESTS = 16
MAX_WAITING_ORDERS = 1024  # more than for other requests, because one tick takes all waiting orders
MAX_LIST_BYTES = 100  # a longer request is not a `list`
TEXT = zenoh.Encoding.TEXT_PLAIN
ORDER_KEYS = ("hold", "resume", "reset")
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


# executes hold, resume or reset, by the one of a name
Order = Callable[[str, str], Reply | RequestError]


class Requested(Protocol):
    """A function that makes a status newer than its call, and publishes it if `published`."""

    def __call__(self, *, published: bool) -> bytes: ...


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
        self._most, self._together = (
            (MAX_WAITING_ORDERS, MAX_WAITING_ORDERS)
            if name in TOGETHER
            else (MAX_WAITING_REQUESTS, 1)
        )
        self._waiting: queue.Queue[Received | None] = queue.Queue(self._most)
        self._thread = supervised_thread.start(f"thread of {name} requests", self._serve, failed)

    def enqueue(self, request: Received) -> None:
        """Add a request, or refuse it if the queue is full. Never waits."""
        try:
            self._waiting.put_nowait(request)
        except queue.Full:
            with request.query:
                refusal = f"busy: {self._most} {self._name} requests are waiting; try again later"
                request.query.reply_err(refusal.encode(), encoding=TEXT)

    def close(self) -> None:
        """Answer the waiting requests and end the thread."""
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
            taken.clear()  # a client's query ends with its last reference


def _understood(suffix: str, expression: str, key: str, payload: bytes) -> tuple[object, str]:
    """The request in a payload, sent to a key expression, and a remark on what was not understood.

    A hold that is not understood is one without a name, because a stop is always obeyed. Raises
    RequestError for other requests.
    """
    if expression != key:
        raise RequestError(f"{expression} matches several cells; the key {key} needed")
    try:
        if len(payload) > channels.LARGEST_REQUEST:
            raise RequestError(
                f"a request of {len(payload)} bytes, at most {channels.LARGEST_REQUEST} accepted"
            )
        return channels.BY_KEY[suffix].codec.decode(payload), ""
    except RequestError as error:
        if suffix != "hold":
            raise
        return HoldRequest(), f"the arm holds, but the request was not understood: {error}"


class Queryables:
    """The queryables of one cell, which answer from `open` on.

    Each key of TOGETHER has its own queue, and the requests for which the skill worker computes
    have one, so that no kind waits for another. `list` is answered at once. A request that changed
    something is answered after a status that shows the change was published.
    """

    def __init__(
        self,
        settings: Settings,
        skill: StoredSkill,
        *,
        skill_worker: SkillWorker,
        skills: Path,
        status: Requested,
        moment: Callable[[], Moment],
        note: Callable[[str], None],
        keep: Callable[[bytes], object],
        failed: Callable[[str], None],
    ) -> None:
        self.inbox = RequestInbox()
        self._settings = settings
        # The skill in force and one that the loop adopts next, each with its via-points, by digest.
        self._adoptable = {skill.digest: (skill, in_force(skill))}
        self._skill_worker = skill_worker
        self._beyond_m = functools.partial(skill_worker.compute, beyond_m)
        self._skills = skills
        self._status = status
        self._moment = moment
        self._corrections = Corrections(settings, moment)
        self._note = note
        self._keep = keep
        self._failed = failed
        self._saved = SavedViaPoints(settings, self._beyond_m)
        self._queues = {
            name: RequestQueue(name, self._reply_together, failed) for name in (*TOGETHER, COMPUTED)
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
        local = threading.local()  # Zenoh has a thread for each queryable

        def receive(query: zenoh.Query) -> None:
            try:
                if not hasattr(local, "is_prioritised"):
                    local.is_prioritised = True
                    run_beside_real_time()
                self.inbox.holds_received += suffix == "hold"
                request = Received(suffix, query, self.inbox.holds_received, time.monotonic())
                if self._is_list(suffix, query):
                    self._reply_together([request])
                else:
                    self._queues[suffix if suffix in TOGETHER else COMPUTED].enqueue(request)
            except Exception as error:
                self._failed(f"receiving {suffix} requests failed: {error!r}")

        return session.declare_queryable(channels.key(self._settings.cell, suffix), receive)

    def close(self) -> None:
        """Answer the waiting requests and end all threads."""
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]
        for waiting in self._queues.values():
            waiting.close()

    @staticmethod
    def _is_list(suffix: str, query: zenoh.Query) -> bool:
        if suffix != "via_points" or query.payload is None or len(query.payload) > MAX_LIST_BYTES:
            return False
        try:
            return isinstance(channels.BY_KEY[suffix].codec.decode(query.payload.to_bytes()), List)
        except RequestError:
            return False

    def _reply_together(self, requests: Sequence[Received]) -> None:
        """Reply to requests that wait together; equal orders pass through the loop once."""
        order_once = functools.cache(self._order)
        status_once = functools.cache(self._status)
        for request in requests:
            # Resumes that a hold separates are different orders.
            order = functools.partial(
                order_once, request.holds if request.suffix == "resume" else 0
            )
            self._reply(request, order, status_once)

    def _reply(self, received: Received, order: Order, status: Requested) -> None:
        suffix = received.suffix
        query = received.query
        key = channels.key(self._settings.cell, suffix)
        # The query's end shows the client that there are no more replies.
        with query, self._skill_worker.due(received.received_s):
            try:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                if suffix == "status":
                    answer = status(published=False)
                    changes = False
                else:
                    request, remark = _understood(suffix, str(query.key_expr), key, payload)
                    reply = self._answer(suffix, request, order)
                    answer = encode_json(
                        msgspec.structs.replace(reply, note=remark) if remark else reply
                    )
                    changes = not isinstance(request, List)
                if changes:
                    status(published=True)
            except (RequestError, SkillError) as error:
                self._note(f"{suffix} refused: {error}")
                query.reply_err(str(error).encode(), encoding=TEXT)
            except Exception as error:  # a request that fails must not end the thread
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
            case SegmentRequest(name):
                return self._set_segment(name)
            case List():
                frame, state = self._moment()
                return Reply(int(frame["tick"]), self._adoptable[state["skill"].tobytes()][1])
            case Add() | Remove() | Clear():
                return self._teach(request)
            case Correct():
                return self._correct(request)
            case UndoCorrection():
                return self._undo_correction()
            case Nothing() | HoldRequest():
                if isinstance(reply := order(suffix, getattr(request, "by", "")), RequestError):
                    raise reply
                return reply
        raise RequestError(f"requests on {suffix} are not supported")

    def _order(self, holds: int, suffix: str, by: str) -> Reply | RequestError:
        """The reply to hold, resume or reset with the resulting mode, or the error."""
        pending = self.inbox.order(suffix, by, holds)
        try:
            frame = pending.wait()
        except RequestError as error:
            return error
        reply = _in_force_since(frame)
        note = ""
        if suffix == "reset" and pending.mode_before is not Mode.FAULT:
            note = "there was no fault: nothing was reset"
        elif suffix == "resume" and pending.mode_before is Mode.FOLLOW:
            note = "there was no hold to end"
        elif suffix == "resume" and reply.mode == word(Mode.FAULT):
            note = "resume does not end a fault, reset does"
        return msgspec.structs.replace(reply, note=note)

    def _set_segment(self, name: str) -> Reply:
        if name not in (names := self._skill.model.names):
            listing = ", ".join(names) or "none, as the skill was not learned between via-points"
            raise RequestError(f"$.name: no via-point {name!r} of the task. There are: {listing}")
        return _in_force_since(self.inbox.send(order("segment", name)).wait())

    @property
    def _skill(self) -> StoredSkill:
        """The skill in force, which is that of the loop's state."""
        return self._adoptable[self._moment()[1]["skill"].tobytes()][0]

    def file(self, digest: bytes) -> bytes:
        """The file of the skill in force, which has this digest."""
        return self._adoptable[digest][0].file

    def _adopt(
        self,
        skill: StoredSkill,
        *events: Event,
        check: Check = accept,
        is_loaded: bool = False,
        remark: str = "",
    ) -> Reply:
        """Have the loop adopt a skill and take `events` in one tick, and save its via-points.

        Raises RequestError for a loaded skill of which the arm does not reach most tool positions.
        """
        distances_m = self._beyond_m(self._settings, skill.tool_positions)
        finding = out_of_reach(skill, distances_m, self._settings)
        if is_loaded and finding.is_refused:
            raise RequestError(finding.text)
        self._keep(skill.file)
        before = self._skill
        points = in_force(skill)
        self._adoptable = {
            before.digest: self._adoptable[before.digest],
            skill.digest: (skill, points),
        }
        adoption = Event("skill", skill.file, skill.for_loop())
        try:
            # written first, because via-points that cannot be saved are not adopted
            with self._saved.replacing(skill):
                frame = self.inbox.send(adoption, *events, check=check).wait()
        except OSError as error:  # the skill is in force already
            unsaved = f"the via-points end at a restart: they cannot be saved ({in_words(error)})"
            remark = f"{remark} {unsaved}".strip()
        risk = f"residual risk {skill.residual_risk}" if is_loaded and skill.residual_risk else ""
        remarks = filter(None, (remark, risk, finding.text))
        return Reply(int(frame["tick"]), points, (*remarks, *warnings_of(before, skill)))

    def _load(self, name: str) -> Reply:
        folder = self._skills.resolve()
        files = [
            path
            for path in sorted(folder.glob("*.npz"))
            if path.is_file() and path.resolve().parent == folder
        ]
        paths = {path.stem: path for path in files}  # links to files elsewhere are ignored
        path = paths.get(name.removesuffix(".npz"))
        if path is None:
            names = ", ".join(paths) or "none"
            raise RequestError(
                f"$.name: no skill {name!r} in the skill folder; its skills: {names}"
            )
        skill = self._skill_worker.load(path)
        remark = ""
        skill.check_accepted()
        if saved := self._saved.read(skill):
            points, tolerance = saved
            skill = self._skill_worker.adapt(skill, points, tolerance=tolerance)
            remark = self._saved.remark
        return self._adopt(skill, is_loaded=True, remark=remark)

    def _teach(self, request: Add | Remove | Clear) -> Reply:
        points = {point.name: point for point in self._skill.via_points}
        tolerance = self._skill.tolerance
        match request:
            case Clear():
                points = {}
            case Remove(names):
                for i, name in enumerate(names):
                    if name in names[:i]:
                        raise RequestError(
                            f"$.names[{i}]: {name!r} given twice; each name once needed"
                        )
                    if name not in points:
                        listing = ", ".join(points) or "none"
                        raise RequestError(
                            f"$.names[{i}]: no via-point {name!r}; in force: {listing}"
                        )
                points = {name: point for name, point in points.items() if name not in names}
            case Add(added, tolerance):
                self._check(added)
                points |= {point.name: point for point in added}
        return self._adopt(
            self._skill_worker.adapt(self._skill, tuple(points.values()), tolerance=tolerance)
        )

    def _correct(self, request: Correct) -> Reply:
        """Correct the tool for the hands of the operator's hold."""
        led = self._corrections.led(request, self._skill)
        skill = self._skill
        correcting = correction_at(skill, led.hands, led.segment, led.tool, led.orientation)
        point = correcting.point
        moved_m = off_m(skill, correcting)
        if moved_m < LEAST_CORRECTION_M and not request.turned:
            raise RequestError(
                f"the tool is {1000 * moved_m:.0f} mm from where the skill has it for these hands; "
                f"{1000 * LEAST_CORRECTION_M:.0f} mm or more needed for a correction"
            )
        gate_m = float(skill.model.gates_m(skill.conducting(led.hands))[0])
        if gate_m > skill.threshold:
            raise RequestError(
                f"{skill.model.measure} is {gate_m:.3f} m at these hands; at most "
                f"{skill.threshold:.3f} m accepted, as the arm holds there whatever is corrected. "
                "Demonstrate this"
            )
        self._check([point], "$.tool")
        orientation = skill.orientation if led.orientation is None else np.array(led.orientation)
        hands = skill.conducting(led.hands).reshape(2, 3)
        posture = self._settings, led.joints, led.tool, orientation, hands
        if not self._skill_worker.compute(has_posture_of, *posture):
            raise RequestError(
                f"$.tool: {list(point.tool)}: no posture of the arm has the tool there and keeps "
                "clear of these hands, of things and of itself"
            )
        after, effect = self._skill_worker.correct(skill, correcting.among(skill.via_points), point)
        # A hand that led the arm may have looked like another segment.
        has_segment = request.hands == "held" and led.segment >= 0
        segments = [order("segment", skill.model.names[led.segment])] if has_segment else []
        reply = self._adopt(
            after, *segments, check=functools.partial(check_same_hold, led.held_tick)
        )
        self._corrections.replaced[point] = correcting.replaced
        return self._of_correction(reply, point, effect, undone=False)

    def _undo_correction(self) -> Reply:
        """Undo the last correction, with what it replaced."""
        held_tick = held_since(self._moment()[1])
        if (point := newest_correction(self._skill.via_points)) is None:
            raise RequestError("no correction is in force")
        remaining = tuple(via_point for via_point in self._skill.via_points if via_point != point)
        points = (*remaining, *self._corrections.replaced.get(point, ()))
        after, effect = self._skill_worker.correct(self._skill, points, point)
        reply = self._adopt(after, check=functools.partial(check_same_hold, held_tick))
        return self._of_correction(reply, point, effect, undone=True)

    def _of_correction(
        self, reply: Reply, point: ViaPoint, effect: Effect, *, undone: bool
    ) -> Reply:
        segment = segment_of(self._skill, point)
        sizes = (round(effect.moved_m, 4), round(effect.reach_m, 3))
        correction = Correction(point.name, *sizes, segment, point.corrections, undone=undone)
        return msgspec.structs.replace(reply, correction=correction, note=offer_of(self._skill))

    def _check(self, added: Sequence[ViaPoint], at: str = "") -> None:
        """Raise RequestError for too many via-points, for those outside the skill's workspace, and
        for segments that the skill does not have. `at` is the position of the tool in the request.
        """
        all_of_them = {point.name: point for point in (*self._skill.via_points, *added)}
        total = points_made_of(
            [all_of_them[name] for name in all_of_them.keys() - set(self._skill.model.names)]
        )
        if total > MAX_VIA_POINTS:
            raise RequestError(
                f"$.points: {total} via-points beside the task's, where one with a radius counts "
                f"as 13; at most {MAX_VIA_POINTS} accepted"
            )
        low, high = self._skill.workspace
        distances_m = self._beyond_m(self._settings, np.array([point.tool for point in added]))
        for i, (point, distance_m) in enumerate(zip(added, distances_m.tolist(), strict=True)):
            prefix = f"{at or f'$.points[{i}].tool'}: {list(point.tool)}"
            if point.segment not in (None, *(begins := self._skill.model.names[:-1])):
                listing = ", ".join(begins) or "none"
                raise RequestError(
                    f"$.points[{i}].segment: no segment begins at {point.segment!r}; segments "
                    f"begin at: {listing}"
                )
            if not ((low <= point.tool) & (point.tool <= high)).all():
                corners = " to ".join(
                    f"({', '.join(f'{v:.2f}' for v in corner)})" for corner in (low, high)
                )
                raise RequestError(f"{prefix} outside the skill's workspace, {corners} m accepted")
            if distance_m > 0.0:
                raise RequestError(
                    f"{prefix} out of the arm's reach by {distance_m:.3f} m: "
                    f"{accepted(self._settings)}"
                )


def _in_force_since(frame: Frame) -> Reply:
    """The reply with the tick, mode and reason of a frame."""
    mode, reason = outcome(frame)
    return Reply(int(frame["tick"]), mode=word(mode), reason=word(reason))
