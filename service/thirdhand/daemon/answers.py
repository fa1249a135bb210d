"""The answers to the requests of one cell, each by a method of its own."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from thirdhand.contract.explain import in_words
from thirdhand.contract.incidents import word
from thirdhand.contract.messages import Vector3
from thirdhand.contract.records import Mode
from thirdhand.contract.requests import (
    Add,
    Clear,
    Correct,
    Correction,
    List,
    Remove,
    Reply,
    RequestError,
    SegmentRequest,
    SkillRequest,
    UndoCorrection,
    ViaPoint,
)
from thirdhand.core.frame import Event, Frame, Record, order
from thirdhand.core.skill.task_clock import is_requested
from thirdhand.daemon.cell_state import CellState
from thirdhand.daemon.correcting import Corrections, check_same_hold, held_since
from thirdhand.daemon.request_inbox import Check
from thirdhand.daemon.saved_via_points import SavedViaPoints
from thirdhand.daemon.skill_worker import SkillWorker, has_posture_of
from thirdhand.daemon.status import outcome
from thirdhand.skills.corrections import (
    LEAST_CORRECTION_M,
    correction_at,
    newest_correction,
    off_m,
    offer_of,
    segment_of,
)
from thirdhand.skills.no_skill import leads_alone
from thirdhand.skills.reach import accepted, beyond_m, out_of_reach
from thirdhand.skills.skill_file import StoredSkill
from thirdhand.skills.via_points import (
    are_still,
    in_force,
    points_made_of,
    warnings_of,
    with_points,
)

# limit of via-points that are not the task's, with the points of their neighbourhoods
MAX_VIA_POINTS = 400
TEACHING = (Add, Remove, Clear, SkillRequest, Correct, UndoCorrection)


class OrderRequest(NamedTuple):
    """A hold, resume, reset or begin, `by` the one of this name. `holds`, the number of holds
    received before a resume, distinguishes resumes before and after a hold.
    """

    kind: str
    by: str = ""
    holds: int = 0


class StatusRequest(NamedTuple):
    """A request for a status that is newer than the request; if `published`, subscribers get it."""

    published: bool = False


Answer = Reply | RequestError | bytes


class Answers:
    """The answers to the requests of one cell. Each waits until the request is in force."""

    def __init__(self, cell: CellState, skill_worker: SkillWorker, skills: Path) -> None:
        """`skills` is the folder from which clients load skills."""
        self.skill_worker = skill_worker
        self._cell = cell
        self._skills = skills
        self._beyond_m = functools.partial(skill_worker.compute, beyond_m)
        self._corrections = Corrections(cell)
        self._in_force = functools.lru_cache(2)(in_force)
        self._in_force(cell.skill)  # before a client asks for the list
        self._saved = SavedViaPoints(cell.settings, self._beyond_m)
        self._teaching = threading.Lock()  # one change of the skill at a time
        self._answered_by: dict[type, Callable[[Any], Answer]] = {
            StatusRequest: self._status,
            OrderRequest: self._order,
            List: self._list,
            Add: self._add,
            Remove: self._remove,
            Clear: self._clear,
            SkillRequest: self._load,
            SegmentRequest: self._set_segment,
            Correct: self._correct,
            UndoCorrection: self._undo_correction,
        }

    def answer(self, request: Any) -> Answer:
        """The reply to a request; a status is in bytes. The error of an order is returned, that of
        other requests raised: RequestError or SkillError.
        """
        if isinstance(request, (*TEACHING, SegmentRequest)) and leads_alone(self._cell.settings):
            raise RequestError(
                "this cell has no skill: it follows the wishes on tool/wish, by `[skill] source`; "
                "with `[skill] blend = true` a skill leads too"
            )
        with self._teaching if isinstance(request, TEACHING) else contextlib.nullcontext():
            return self._answered_by[type(request)](request)

    def begin_at(self, skill: StoredSkill, points: Sequence[ViaPoint]) -> None:
        """Begin the task with these via-points of it, which are not kept over a restart. Raises
        RequestError, also if the hands move or another skill is in force by now, and SkillError.
        """
        with self._teaching:
            if self._cell.skill is not skill:
                raise RequestError("another skill is in force")
            self._check(points)
            after = self.skill_worker.adapt(
                skill, with_points(skill, points), tolerance=skill.tolerance
            )
            check = functools.partial(_check_still, skill)
            self._adopt(after, order("begin"), check=check, is_saved=False)

    def _status(self, request: StatusRequest) -> bytes:
        return self._cell.newest_status.requested(published=request.published)

    def _order(self, request: OrderRequest) -> Reply | RequestError:
        """The reply to an order with the resulting mode, or the error."""
        pending = self._cell.inbox.order(*request)
        try:
            frame = pending.wait()
        except RequestError as error:
            return error
        reply = _in_force_since(frame)
        note = ""
        if request.kind == "reset" and pending.mode_before is not Mode.FAULT:
            note = "there was no fault: nothing was reset"
        elif request.kind == "resume" and pending.mode_before is Mode.FOLLOW:
            note = "there was no hold to end"
        elif request.kind == "resume" and reply.mode == word(Mode.FAULT):
            note = "resume does not end a fault, reset does"
        elif request.kind == "begin" and leads_alone(self._cell.settings):
            note = "the cell has no skill whose task could begin: it follows wishes"
        elif request.kind == "begin" and not is_requested(self._cell.skill.model.clock):
            note = "the skill needs no request: its task begins as the hands move"
        return msgspec.structs.replace(reply, note=note)

    def _set_segment(self, request: SegmentRequest) -> Reply:
        names = self._cell.skill.model.names
        if request.name not in names:
            listing = ", ".join(names) or "none, as the skill was not learned between via-points"
            raise RequestError(
                f"$.name: no via-point {request.name!r} of the task. There are: {listing}"
            )
        return _in_force_since(self._cell.inbox.send(order("segment", request.name)).wait())

    def _list(self, _: List) -> Reply:
        frame, state = self._cell.moment()
        return Reply(
            int(frame["tick"]), self._in_force(self._cell.adoptable[state["skill"].tobytes()])
        )

    def _add(self, request: Add) -> Reply:
        self._check(request.points)
        return self._teach(with_points(self._cell.skill, request.points), request.tolerance)

    def _remove(self, request: Remove) -> Reply:
        points = {point.name: point for point in self._cell.skill.via_points}
        for i, name in enumerate(request.names):
            if name in request.names[:i]:
                raise RequestError(f"$.names[{i}]: {name!r} given twice; each name once needed")
            if name not in points:
                listing = ", ".join(points) or "none"
                raise RequestError(f"$.names[{i}]: no via-point {name!r}; in force: {listing}")
        return self._teach(point for point in points.values() if point.name not in request.names)

    def _clear(self, _: Clear) -> Reply:
        return self._teach(())

    def _teach(self, points: Iterable[ViaPoint], tolerance: float | None = None) -> Reply:
        """Adapt the skill to these via-points and no others; by default with its own tolerance."""
        skill = self._cell.skill
        tolerance = skill.tolerance if tolerance is None else tolerance
        return self._adopt(self.skill_worker.adapt(skill, tuple(points), tolerance=tolerance))

    def _load(self, request: SkillRequest) -> Reply:
        folder = self._skills.resolve()
        files = (path for path in sorted(folder.glob("*.npz")) if path.is_file())
        # no links to other folders
        by_name = {path.stem: path for path in files if path.resolve().parent == folder}
        path = by_name.get(request.name.removesuffix(".npz"))
        if path is None:
            names = ", ".join(by_name) or "none"
            raise RequestError(
                f"$.name: no skill {request.name!r} in the skill folder; its skills: {names}"
            )
        skill = self.skill_worker.load(path)
        skill.check_accepted()
        remark = ""
        if saved := self._saved.read(skill):
            remark = self._saved.remark
            points, tolerance = saved
            skill = self.skill_worker.adapt(skill, points, tolerance=tolerance)
        return self._adopt(skill, is_loaded=True, remark=remark)

    def _correct(self, request: Correct) -> Reply:
        """Correct the tool for the hands of the operator's hold."""
        skill = self._cell.skill
        led = self._corrections.led(request)
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
        posture = self._cell.settings, led.joints, led.tool, orientation, hands
        if not self.skill_worker.compute(has_posture_of, *posture):
            raise RequestError(
                f"$.tool: {list(point.tool)}: no posture of the arm has the tool there and keeps "
                "clear of these hands, of things and of itself"
            )
        # A hand that led the arm may have looked like another segment.
        has_segment = request.hands == "held" and led.segment >= 0
        segments = [order("segment", skill.model.names[led.segment])] if has_segment else []
        reply = self._adopt_at(point, correcting.among(skill.via_points), led.held_tick, *segments)
        self._corrections.replaced[point] = correcting.replaced
        return reply

    def _undo_correction(self, _: UndoCorrection) -> Reply:
        """Undo the last correction, with what it replaced."""
        held_tick = held_since(self._cell.moment()[1])
        skill = self._cell.skill
        if (point := newest_correction(skill.via_points)) is None:
            raise RequestError("no correction is in force")
        others = (via_point for via_point in skill.via_points if via_point != point)
        points = (*others, *self._corrections.replaced.get(point, ()))
        return self._adopt_at(point, points, held_tick, undone=True)

    def _adopt_at(
        self,
        point: ViaPoint,
        via_points: Sequence[ViaPoint],
        held_tick: int,
        *events: Event,
        undone: bool = False,
    ) -> Reply:
        """Adopt the skill with these via-points and no others, and reply with what that changes at
        a correction, unless the hold that began at this tick has ended.
        """
        after, effect = self.skill_worker.correct(self._cell.skill, via_points, point)
        reply = self._adopt(after, *events, held_tick=held_tick)
        sizes = round(effect.moved_m, 4), round(effect.reach_m, 3)
        segment = segment_of(self._cell.skill, point)
        correction = Correction(point.name, *sizes, segment, point.corrections, undone=undone)
        return msgspec.structs.replace(
            reply, correction=correction, note=offer_of(self._cell.skill)
        )

    def _check(self, added: Sequence[ViaPoint], at: str = "") -> None:
        """Raise RequestError for too many via-points, for those outside the skill's workspace, and
        for segments that the skill does not have. `at` is the position of the tool in the request.
        """
        skill = self._cell.skill
        points = with_points(skill, added)
        total = points_made_of([point for point in points if point.name not in skill.model.names])
        if total > MAX_VIA_POINTS:
            raise RequestError(
                f"$.points: {total} via-points beside the task's, where one with a radius counts "
                f"as 13; at most {MAX_VIA_POINTS} accepted"
            )
        settings = self._cell.settings
        distances_m = self._beyond_m(settings, np.array([point.tool for point in added]))
        for i, (point, distance_m) in enumerate(zip(added, distances_m.tolist(), strict=True)):
            position = f"{at or f'$.points[{i}].tool'}: {list(point.tool)}"
            _check_segment(skill, point.segment, f"$.points[{i}].segment")
            _check_workspace(skill, point.tool, position)
            if distance_m > 0.0:
                raise RequestError(
                    f"{position} out of the arm's reach by {distance_m:.3f} m: {accepted(settings)}"
                )

    def _adopt(
        self,
        skill: StoredSkill,
        *events: Event,
        held_tick: int | None = None,
        check: Check | None = None,
        is_loaded: bool = False,
        is_saved: bool = True,
        remark: str = "",
    ) -> Reply:
        """Have the loop adopt a skill and take `events` in one tick, and save its via-points; if
        `held_tick` is given, only in the hold that began at this tick.

        Raises RequestError for a loaded skill of which the arm does not reach most tool positions.
        """
        cell = self._cell
        distances_m = self._beyond_m(cell.settings, skill.tool_positions)
        finding = out_of_reach(skill, distances_m, cell.settings)
        if is_loaded and finding.is_refused:
            raise RequestError(finding.text)
        cell.scribe.keep(skill.file)
        before = cell.skill
        points = self._in_force(skill)
        cell.adoptable = {before.digest: before, skill.digest: skill}
        check = check or functools.partial(check_same_hold, held_tick)
        adoption = Event("skill", skill.file, skill.for_loop())
        try:
            # written first, because via-points that cannot be saved are not adopted
            with self._saved.replacing(skill) if is_saved else contextlib.nullcontext():
                frame = cell.inbox.send(adoption, *events, check=check).wait()
        except OSError as error:  # the skill is in force already
            unsaved = f"the via-points end at a restart: they cannot be saved ({in_words(error)})"
            remark = f"{remark} {unsaved}".strip()
        risk = f"residual risk {skill.residual_risk}" if is_loaded and skill.residual_risk else ""
        remarks = filter(None, (remark, risk, finding.text))
        return Reply(int(frame["tick"]), points, (*remarks, *warnings_of(before, skill)))


def _check_still(skill: StoredSkill, state: Record) -> None:
    """Raise RequestError if the hands move."""
    if not are_still(skill, state):
        raise RequestError("the hands have moved meanwhile")


def _check_segment(skill: StoredSkill, segment: str | None, path: str) -> None:
    """Raise RequestError if no segment of the skill begins at this via-point; None: any segment."""
    begins = skill.model.names[:-1]
    if segment not in (None, *begins):
        raise RequestError(
            f"{path}: no segment begins at {segment!r}; segments begin at: "
            f"{', '.join(begins) or 'none'}"
        )


def _check_workspace(skill: StoredSkill, tool: Vector3, position: str) -> None:
    """Raise RequestError for a position of the tool [m] outside the skill's workspace."""
    low, high = skill.workspace
    if not ((low <= tool) & (tool <= high)).all():
        corners = " to ".join(
            f"({', '.join(f'{v:.2f}' for v in corner)})" for corner in (low, high)
        )
        raise RequestError(f"{position} outside the skill's workspace, {corners} m accepted")


def _in_force_since(frame: Frame) -> Reply:
    """The reply with the tick, mode and reason of a frame."""
    mode, reason = outcome(frame)
    return Reply(int(frame["tick"]), mode=word(mode), reason=word(reason))
