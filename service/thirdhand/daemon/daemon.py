"""The daemon: it fills the controller's inbox from Zenoh, and publishes and records each frame."""

from __future__ import annotations

import contextlib
import gc
import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from thirdhand.contract import cdr
from thirdhand.contract.explain import ExplainedError
from thirdhand.contract.messages import Attachment
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Event, Tick, order
from thirdhand.core.limiter.stage import Limiter
from thirdhand.core.warm_up import warm_up
from thirdhand.daemon import supervised_thread
from thirdhand.daemon.answers import Answers
from thirdhand.daemon.cell_state import CellState
from thirdhand.daemon.clock import (
    PREPARE_NS,
    SPIN_NS,
    Deadlines,
    ask_for_real_time,
    run_beside_real_time,
)
from thirdhand.daemon.compilation import NotCompiledError, compile_cell
from thirdhand.daemon.queryables import Queryables
from thirdhand.daemon.rehearsed_controller import DecidedTick
from thirdhand.daemon.saved_via_points import SavedViaPoints
from thirdhand.daemon.skill_worker import SkillWorker, skill_of
from thirdhand.daemon.start import Startup
from thirdhand.daemon.status_thread import StatusThread
from thirdhand.process.pages import release_start_memory
from thirdhand.process.priority import ahead_of_others
from thirdhand.recordings.shipped import SHIPPED_SKILL, recordings
from thirdhand.scribe.scribe import Scribe
from thirdhand.settings.config import Settings, robot_description
from thirdhand.skills.no_skill import leads_alone, no_skill, stand_in
from thirdhand.skills.reach import beyond_m, out_of_reach
from thirdhand.skills.skill_file import SkillError, StoredSkill

log = logging.getLogger("thirdhand")
REST_TIMEOUT_S = 3.0  # the arm must come to rest within this time after a request to stop
# the rest position is repeated for this time, because some controllers extrapolate the last command
RESTS_S = 0.1
FIRST_TICK_S = 0.01  # interval at which the first tick is waited for


Announce = Callable[[Sequence[str]], None]
"""Called with the endpoints of a daemon that answers requests."""


class LoopError(ExplainedError, RuntimeError):
    """The control loop failed twice in a row, so that it cannot even stop the arm."""


class Daemon:
    """One cell's loop, and the threads and processes around it.

    `serve` runs until the cell's `stop` is set, then stops the arm and closes everything.
    """

    def __init__(self, cell: CellState, skill_worker: SkillWorker, skills: Path) -> None:
        """`skills` is the folder from which clients load skills."""
        self._cell = cell
        self._received: list[Event] = []  # the messages for the next tick that came before it
        self._tick_is_open = False  # from its deadline until it is recorded
        self._failed_at: int | None = None  # tick of the loop's last failure

        # Threads beside the loop make the status and answer requests.
        answers = Answers(cell, skill_worker, skills)
        self._status_thread = StatusThread(cell, answers)
        self._queryables = Queryables(cell, answers)
        self._is_open = False  # True once requests are answered

    def serve(self, announce: Announce) -> str:
        """Run until `stop` is set, close everything, and return a message on ticks that were not
        recorded (empty: none). `announce` is called at the loop's first tick, once requests are
        answered.
        """
        cell = self._cell
        reporter = supervised_thread.start(
            "status thread", lambda: self._report(announce), cell.fail
        )
        try:
            cell.scribe.start(
                skill=cell.file, state=cell.controller.state, constants=cell.controller.constants
            )
            cell.granted = ask_for_real_time(awake=cell.settings.loop.awake)
            cell.clock = Deadlines(
                cell.settings.rate_hz, spin_ns=SPIN_NS if cell.granted.realtime else 0
            )
            supervised_thread.supervised(
                "control loop", self._run, self._fail_in_the_loop, pause_s=0.0
            )
        finally:
            self._brake()
            missing = self._close(reporter)
        return missing

    def _close(self, reporter: threading.Thread) -> str:
        """End the threads, close everything, and return a message on ticks that were not recorded
        (empty: none).
        """
        cell = self._cell
        cell.ended.set()
        cell.start.systemd.notify("STOPPING=1", "STATUS=closing its files")
        gc.unfreeze()
        cell.newest_status.close()
        self._status_thread.own_answers.close()
        reporter.join(2)
        self._queryables.close()
        cell.streams.close()
        cell.start.session.close()  # type: ignore[no-untyped-call]
        missing = cell.scribe.close()

        recording = cell.scribe.newest_recording
        recording_text = (
            f"its newest recording is {recording}" if recording else "it recorded nothing"
        )
        log.info("ended: the daemon of cell %s; %s", cell.settings.cell, recording_text)
        if missing:
            log.warning("%s", missing)
        return missing

    def _fail_in_the_loop(self, what: str) -> None:
        """Have the loop stop the arm. Raises LoopError if there was no tick since the last
        failure.
        """
        cell = self._cell
        if self._tick_is_open:  # else it failed before the deadline, so that no tick is lost
            cell.scribe.skip()
            self._tick_is_open = False
        cell.inbox.answer(None)
        self._received = []  # one of them may be the cause
        tick = int(cell.frame["tick"])
        if tick == self._failed_at:
            raise LoopError(f"{what}, and again in the next tick: the arm gets no more commands")
        self._failed_at = tick
        cell.fail(what)

    def _brake(self) -> None:
        """Command the stop that follows the newest frame, tick by tick, and repeat the last command
        in case messages are lost.
        """
        cell = self._cell
        settings = cell.settings
        frame = cell.frame
        clock = cell.clock
        limiter = Limiter(settings.joints, settings.period_s)
        q, dq, ddq = (
            frame[name].copy() for name in ("joints", "joint_velocities", "joint_accelerations")
        )
        index = int(frame["tick"])
        stamp_ns = clock.stamp_ns
        resting = 0
        while frame["commanded"] and resting < RESTS_S * settings.rate_hz:
            deadline, _ = clock.wait()
            if dq.any():
                q, dq, ddq, _ = limiter.stop(q, dq, ddq)
                index = deadline
                stamp_ns = clock.stamp_ns
            else:
                resting += 1
            attachment = cdr.encode_attachment(Attachment(index, time.time_ns(), 0))
            command = cdr.encode_command(stamp_ns, settings.joints.names, q.tolist(), dq.tolist())
            cell.streams.publish("joints/command", command, attachment)

    # --- the loop: every line below costs each tick ---

    def _run(self) -> None:
        cell = self._cell
        for tick in self._ticks():
            self._publish(cell.core.decide(tick, cell.times.lap))
            self._tick_is_open = False

    def _ticks(self) -> Iterator[Tick]:
        """A tick at each deadline, with what arrived until then. After `stop`, each tick orders a
        hold; the last one is that in which the arm rests.
        """
        cell = self._cell
        requests = cell.inbox
        stop_by: float | None = None
        # A period of 1 ms has no time to prepare the next tick.
        has_time = cell.clock.period_ns >= 2 * PREPARE_NS
        prepare = self._rehearse if has_time and cell.settings.loop.prepare else None
        while True:
            index, late_ns = cell.clock.wait(prepare)
            self._tick_is_open = True
            cell.times.begin(late_ns)
            if cell.stop.is_set():
                if stop_by is None:
                    stop_by = time.monotonic() + REST_TIMEOUT_S
                elif not cell.frame["joint_velocities"].any():
                    return
                elif time.monotonic() > stop_by:
                    log.error(
                        "the arm did not come to rest within %g s; it gets no more commands",
                        REST_TIMEOUT_S,
                    )
                    return

            inbox = cell.streams.receive(self._received)
            self._received = []
            if requests:
                inbox += requests.take(cell.controller.state)
            while cell.own:
                inbox.append(cell.own.popleft())
            if stop_by is not None:
                inbox.append(order("hold"))  # last, so that no other request overrides it
            yield Tick(index, tuple(inbox), cell.clock.stamp_ns)
            requests.answer(cell.frame)  # the frame of this tick

    def _rehearse(self, index: int, time_ns: int) -> None:
        """Read the messages that have come for the next tick, and rehearse it with them and the
        service's own events.
        """
        cell = self._cell
        self._received = cell.streams.receive(self._received)
        cell.times.begin(0)
        inbox = (*self._received, *cell.own)
        cell.core.rehearse(Tick(index, inbox, time_ns), cell.times.lap)

    def _publish(self, decided: DecidedTick) -> None:
        """Publish and record what a tick decided."""
        cell = self._cell
        tick, frame, outputs = decided
        attachment = cdr.encode_attachment(
            Attachment(tick.index, time.time_ns(), int(frame["hand_stamp_ns"]))
        )
        for key, payload in outputs:
            cell.streams.publish(key, payload, attachment)
        timing = cell.times.end(frame, cell.clock)
        cell.core.settle()
        cell.frame = frame
        cell.scribe.send(
            tick,
            frame,
            timing,
            state=lambda: cell.controller.state,
            skill=cell.file,
            outputs=outputs,
        )

    # --- beside the loop ---

    def _report(self, announce: Announce) -> None:
        """Answer requests from the loop's first tick on, and publish the status until the end."""
        run_beside_real_time()
        cell = self._cell
        start = cell.start
        while not self._is_open and not cell.ended.wait(FIRST_TICK_S):
            if cell.frame["tick"] >= 0:
                self._is_open = True
                start.over()
                log.info("started in %s", start.duration)
                self._queryables.open(start.session)
                announce(cell.endpoints)
                start.systemd.notify("READY=1")
                if start.systemd.ping_every_s and cell.endpoints:
                    supervised_thread.start(
                        "thread of own requests", self._status_thread.own_answers.ask, cell.note
                    )
        self._status_thread.run()


def load_skill(path: Path, settings: Settings) -> StoredSkill:
    """The skill in a file, with the via-points that were taught to it before; a stand-in where
    wishes lead alone.

    Raises SkillError, also if the arm does not reach most of the skill's tool positions, or if
    nobody accepted the skill's residual risk.
    """
    if leads_alone(settings):
        return no_skill() if path == recordings() / SHIPPED_SKILL else stand_in(path)
    skill = skill_of(path)
    saved = SavedViaPoints(settings)
    skill.check_accepted()
    if skill.residual_risk:
        log.warning("residual risk of skill %r, %s", skill.name, skill.residual_risk)

    def adapt(points: tuple[ViaPoint, ...], tolerance: float) -> StoredSkill:
        if points == skill.via_points:
            return skill
        adapted = skill_of(skill.file, points, tolerance)
        names = ", ".join(point.name for point in points) or "none, the skill's own were removed"
        log.info(
            "via-points of an earlier run are in force (%d): %s. They are saved in %s; `thirdhand "
            "via-points remove NAME` removes one, `thirdhand via-points clear` removes all",
            len(points),
            names,
            saved.path(skill),
        )
        return adapted

    restored = saved.restored(skill, adapt, skill)
    finding = out_of_reach(restored, beyond_m(settings, restored.tool_positions), settings)
    if finding.is_refused:
        raise SkillError(finding.text)
    if finding.text:
        log.warning("%s", finding.text)
    return restored


def rehearsed(settings: Settings, skill_path: Path, start: Startup) -> StoredSkill:
    """The skill in a file, and all that the loop calls with it loaded. Raises SkillError."""
    start.stage("skill")
    stored = load_skill(skill_path, settings)
    start.stage("rehearsal")
    skill = stored.for_loop()
    urdf = robot_description(settings)
    warm_up(settings, skill, urdf=urdf)
    release_start_memory()  # what only imports used: 150 MB
    # maps again what the loop calls, before its memory is locked
    warm_up(settings, skill, urdf=urdf)
    return stored


def serve(
    settings: Settings,
    skill_path: Path,
    *,
    skills: Path,
    scribe: Scribe,
    start: Startup,
    announce: Announce,
    hold: bool = False,
) -> str:
    """Run a daemon, and return a message on ticks that were not recorded (empty: none).

    With `hold`, it begins in an operator's hold. Once it is ready, SIGINT, SIGTERM and SIGHUP stop
    it. Raises SkillError before it starts, and LoopError if the control loop cannot continue.
    """
    with contextlib.closing(SkillWorker()) as skill_worker:
        skill_worker.start()  # before the loop, which the start of a process would delay
        with ahead_of_others():
            try:
                with start.counting(may_compile=False):
                    skill = rehearsed(settings, skill_path, start)
            except NotCompiledError:
                start.stage("compilation")
                compile_cell(settings, skill_path, start.note)
                with start.counting(may_compile=True):
                    skill = rehearsed(settings, skill_path, start)
        start.stage("loop")
        cell = CellState(settings, skill, scribe, start)
        if hold:
            cell.inbox.order("hold")  # until an operator's `resume`
        daemon = Daemon(cell, skill_worker, skills)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda *_: cell.stop.set())
        return daemon.serve(announce)
