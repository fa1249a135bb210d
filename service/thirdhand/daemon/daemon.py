"""The daemon: it fills the controller's inbox from Zenoh, and publishes and records each frame."""

from __future__ import annotations

import gc
import logging
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from thirdhand.client import endpoints
from thirdhand.contract import cdr, channels
from thirdhand.contract.explain import ExplainedError, in_words
from thirdhand.contract.incidents import Condition, in_brief, in_full, what_to_do
from thirdhand.contract.messages import Attachment
from thirdhand.contract.records import Reason
from thirdhand.contract.requests import Status, ViaPoint, encode_json
from thirdhand.core.controller import Controller, outgoing, run
from thirdhand.core.frame import (
    STAGES,
    Event,
    Frame,
    Outputs,
    Record,
    Tick,
    blank,
    frame_layout,
    order,
    timed,
)
from thirdhand.core.separation import FARTHEST_REPORTED_M
from thirdhand.core.warm_up import warm_up
from thirdhand.daemon import supervised_thread
from thirdhand.daemon.braking import brake
from thirdhand.daemon.cell_streams import CellStreams
from thirdhand.daemon.clock import (
    PREPARE_NS,
    SPIN_NS,
    Deadlines,
    Granted,
    SystemClock,
    Window,
    ask_for_real_time,
    run_beside_real_time,
)
from thirdhand.daemon.compilation import NotCompiledError, compile_cell
from thirdhand.daemon.input_monitor import InputMonitor
from thirdhand.daemon.machine import BUSY_WINDOW_S, Machine, resident_mb
from thirdhand.daemon.newest_status import MIN_STATUS_INTERVAL_S, NewestStatus
from thirdhand.daemon.own_answers import OwnAnswers
from thirdhand.daemon.queryables import Queryables
from thirdhand.daemon.saved_segment import SavedSegment
from thirdhand.daemon.saved_via_points import SavedViaPoints
from thirdhand.daemon.side_streams import side_streams
from thirdhand.daemon.skill_worker import SkillWorker, skill_of
from thirdhand.daemon.start import Startup
from thirdhand.daemon.status import CellStatus, MeasuredArm, outcome
from thirdhand.daemon.task_limits import TaskLimits
from thirdhand.daemon.way_finder import WayFinder
from thirdhand.process.pages import release_start_memory
from thirdhand.process.priority import ahead_of_others
from thirdhand.scribe.protocol import pack
from thirdhand.scribe.scribe import Scribe
from thirdhand.settings.config import Settings, robot_description
from thirdhand.skills.reach import beyond_m, out_of_reach
from thirdhand.skills.skill_file import SkillError, StoredSkill

log = logging.getLogger("thirdhand")
REST_TIMEOUT_S = 3.0  # the arm must come to rest within this time after a request to stop
STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
STAGE_NUMBERS = {stage: number for number, stage in enumerate(STAGES)}
MAX_NOTES_PER_S = 100
STATUS_TRIES = 10  # attempts to read a frame and the state of the same tick
STATUS_S = 0.1  # interval of published statuses
FIRST_TICK_S = 0.01  # interval at which the first tick is waited for
CLOCK_SET = "the system clock was set"
MAX_LATENCY_MS = 1000.0  # a longer latency shows that the clocks differ


class LoopError(ExplainedError, RuntimeError):
    """The control loop failed twice in a row, so that it cannot even stop the arm."""


class Daemon:
    """One cell's loop, and the threads and processes around it.

    `serve` runs until `stop` is called, then stops the arm and closes everything.
    """

    def __init__(
        self,
        settings: Settings,
        stored: StoredSkill,
        *,
        skill_worker: SkillWorker,
        skills: Path,
        scribe: Scribe,
        start: Startup,
        hold: bool = False,
    ) -> None:
        skill = stored.for_loop()
        self._settings = settings
        self._scribe = scribe
        self._stop = threading.Event()
        self._ended = threading.Event()
        urdf = robot_description(settings)
        self._session = start.session
        self._controller, self._twin = (Controller(settings, skill, urdf=urdf) for _ in range(2))
        self._measured_arm = MeasuredArm(settings, urdf)
        self._frame: Frame = blank(frame_layout(len(settings.joints.names)))
        self._frame["tick"] = -1
        self._frame["reason"] = Reason.ARM_NOT_READY
        self._frame["hand_ages"] = -1
        self._frame["hand_limit"] = self._controller.max_part_speed
        self._frame["hand_distance"] = FARTHEST_REPORTED_M
        self._sources = InputMonitor(settings)
        self._machine = Machine()
        self._failure = ""  # message of the service's last failure
        self._lateness, self._work, self._latency = (
            Window(10 * settings.rate_hz) for _ in range(3)
        )
        self._granted = Granted(realtime=False, locked=False)
        self._version = version("thirdhand")
        self._own: deque[Event] = deque()  # events from the service itself: faults, ways out
        self._saved_segment = SavedSegment(settings)
        if reached := self._saved_segment.read(stored):
            self._own.append(order("segment", reached))
            log.info(
                "the task continues at via-point %s, which an earlier run had reached", reached
            )
        self._way_finder = WayFinder(settings, skill_worker, self._own.append, self._note_beside)
        self._task_limits = TaskLimits(settings, skill_worker, self._note_beside)
        self._notes = (0, 0)  # time [s] and the number of notes in this second
        self._failed_at: int | None = None
        self._late_ns = self._began_ns = 0
        self._newest = -1  # newest tick
        self._laps: list[tuple[str, int]] = []
        self._outputs: Outputs = ()  # messages published in the newest tick
        self.endpoints = endpoints(self._session) if settings.network.listen else ()
        start.lock.announce(self.endpoints)
        self._streams = CellStreams(
            self._session, settings, arrivals=self._sources.arrivals, failed=self._fail
        )
        self._side_streams = side_streams(self._session, settings, scribe, self._sources.arrivals)
        self._clock = Deadlines(settings.rate_hz)
        self._status = NewestStatus()
        self._start = start
        self._is_open = False
        is_watched = start.systemd.ping_every_s and self.endpoints
        self._own_answers = OwnAnswers(settings, self.endpoints[0]) if is_watched else None
        self._queryables = Queryables(
            settings,
            stored,
            skill_worker=skill_worker,
            skills=skills,
            status=self._status.requested,
            moment=self._moment,
            note=self.note,
            keep=scribe.keep,
            failed=self._fail,
        )
        if hold:
            self._queryables.inbox.order("hold")  # until an operator's `resume`

    def stop(self, *_: Any) -> None:
        """Request the loop to stop the arm and end. Safe in a signal handler."""
        self._stop.set()

    def note(self, text: str) -> None:
        """Write a line to log and recording; lines beyond MAX_NOTES_PER_S are only counted."""
        second = int(time.monotonic())
        if second != self._notes[0]:
            left_out = self._notes[1] - MAX_NOTES_PER_S
            self._notes = (second, 0)
            if left_out > 0:
                self._say(f"{left_out} more requests within a second were not logged")
        self._notes = (second, self._notes[1] + 1)
        if self._notes[1] <= MAX_NOTES_PER_S:
            self._say(text)

    def _note_beside(self, text: str) -> None:
        """Note what work beside the loop tells, unless the daemon, and thus this work, ends."""
        if not self._stop.is_set():
            self.note(text)

    def _say(self, text: str) -> None:
        log.info(text)
        self._scribe.note("requests", text, self._clock.stamp_ns)

    def serve(self, announce: Callable[[Daemon], None] = lambda daemon: None) -> str:
        """Run until `stop` is called, close everything, and return a message on ticks that were not
        recorded (empty: none). `announce` is called at the loop's first tick, once requests are
        answered.
        """
        reporter: threading.Thread | None = None
        try:
            self._scribe.start(
                skill=self._file, state=self._controller.state, constants=self._controller.constants
            )
            reporter = supervised_thread.start(
                "status thread", lambda: self._report(announce), self._fail
            )
            self._granted = ask_for_real_time()
            self._clock = Deadlines(
                self._settings.rate_hz, spin_ns=SPIN_NS if self._granted.realtime else 0
            )
            supervised_thread.supervised(
                "control loop", self._run, self._fail_in_the_loop, pause_s=0.0
            )
        finally:
            brake(self._settings, self._frame, self._clock, self._streams)
            self._ended.set()
            self._start.systemd.notify("STOPPING=1", "STATUS=closing its files")
            gc.unfreeze()
            self._status.close()
            if self._own_answers is not None:
                self._own_answers.close()
            if reporter is not None:
                reporter.join(2)
            self._queryables.close()
            self._streams.close()
            self._session.close()  # type: ignore[no-untyped-call]
            missing = self._scribe.close()
            recording = self._scribe.newest_recording
            recording_text = (
                f"its newest recording is {recording}" if recording else "it recorded nothing"
            )
            log.info("ended: the daemon of cell %s; %s", self._settings.cell, recording_text)
            if missing:
                log.warning("%s", missing)
        return missing

    def _fail(self, what: str) -> None:
        """Report a failure of the service; the next tick enters the mode `fault`."""
        self._failure = what
        self._own.append(order("fault", what))
        self._say(what)

    def _fail_in_the_loop(self, what: str) -> None:
        """Have the loop stop the arm. Raises LoopError if there was no tick since the last
        failure.
        """
        self._scribe.skip()
        self._queryables.inbox.answer(None)
        tick = int(self._frame["tick"])
        if tick == self._failed_at:
            raise LoopError(f"{what}, and again in the next tick: the arm gets no more commands")
        self._failed_at = tick
        self._fail(what)

    # --- the loop: every line below costs each tick ---

    def _run(self) -> None:
        run(self._controller, self._ticks(), (self._publish, self._record), self._lap)

    def _ticks(self) -> Iterator[Tick]:
        requests = self._queryables.inbox
        stop_by: float | None = None
        # A period of 1 ms has no time to prepare the next tick.
        prepare = self._warm_up if self._clock.period_ns >= 3 * PREPARE_NS else None
        while True:
            index, self._late_ns = self._clock.wait(prepare)
            self._newest = index
            self._began_ns = time.perf_counter_ns()
            self._laps = []
            if self._stop.is_set():
                if stop_by is None:
                    stop_by = time.monotonic() + REST_TIMEOUT_S
                elif not self._frame["joint_velocities"].any():
                    return
                elif time.monotonic() > stop_by:
                    log.error(
                        "the arm did not come to rest within %g s; it gets no more commands",
                        REST_TIMEOUT_S,
                    )
                    return
            inbox = self._streams.receive()
            if requests:
                inbox += requests.take(self._controller.state)
            while self._own:
                inbox.append(self._own.popleft())
            if stop_by is not None:
                inbox.append(order("hold"))  # last, so that no other request overrides it
            yield Tick(index, tuple(inbox))
            requests.answer(self._frame)  # the frame of this tick

    def _warm_up(self) -> None:
        """Run a copy of the controller on a likely next tick, from received to published bytes, so
        that code and data are in the processor's caches.
        """
        newest = tuple(self._streams.newest.values())
        for event in newest:
            channels.BY_KEY[event.kind].codec.decode(event.payload)
        self._twin.copy_from(self._controller)
        tick = Tick(self._newest + 1, newest)
        frame = self._twin.step(tick)
        stages = [0.0] * len(STAGES)
        outputs = outgoing(frame, self._clock.stamp_ns, self._settings.joints.names)
        cdr.encode_attachment(Attachment(tick.index, self._clock.stamp_ns, 0))
        timing = timed(tick.index, self._clock.stamp_ns, 0, 0.0, 0.0, 0.0, stages)
        pack(tick, frame, timing, state=None, lost=0, with_skill=False, outputs=outputs)

    def _lap(self, stage: str) -> None:
        self._laps.append((stage, time.perf_counter_ns()))

    def _publish(self, tick: Tick, frame: Frame) -> None:
        now_ns = time.time_ns()
        attachment = cdr.encode_attachment(
            Attachment(tick.index, now_ns, int(frame["hand_stamp_ns"]))
        )
        self._outputs = outgoing(frame, self._clock.stamp_ns, self._settings.joints.names)
        for key, payload in self._outputs:
            self._streams.publish(key, payload, attachment)

    def _record(self, tick: Tick, frame: Frame) -> None:
        self._frame = frame
        stages = [0.0] * len(STAGES)
        before = self._began_ns
        latency_ms = 0.0
        for stage, lap_ns in self._laps:
            stages[STAGE_NUMBERS[stage]] = (lap_ns - before) / 1e3
            before = lap_ns
        if 0 in frame["hand_ages"].tolist():
            latency_ms = (time.time_ns() - int(frame["hand_stamp_ns"])) / 1e6
            if 0 <= latency_ms < MAX_LATENCY_MS:
                self._latency.add(latency_ms)
            else:
                latency_ms = 0.0
        late_us = self._late_ns / 1e3
        work_us = (time.perf_counter_ns() - self._began_ns) / 1e3
        time_ns = self._clock.stamp_ns
        missed = self._clock.missed
        timing = timed(tick.index, time_ns, missed, late_us, work_us, 1e3 * latency_ms, stages)
        self._lateness.add(late_us)
        self._work.add(work_us)
        self._scribe.send(
            tick,
            frame,
            timing,
            state=lambda: self._controller.state,
            skill=self._file,
            outputs=self._outputs,
        )

    @property
    def _file(self) -> bytes:
        """The file of the skill in force."""
        return self._queryables.file(self._controller.skill.digest)

    # --- beside the loop ---

    def _open(self, announce: Callable[[Daemon], None]) -> None:
        """Answer requests from the loop's first tick on."""
        while not self._is_open and not self._ended.wait(FIRST_TICK_S):
            if self._frame["tick"] >= 0:
                self._is_open = True
                self._start.over()
                log.info("started in %s", self._start.duration)
                self._queryables.open(self._session)
                announce(self)
                self._start.systemd.notify("READY=1")
                if self._own_answers is not None:
                    supervised_thread.start(
                        "thread of own requests", self._own_answers.ask, self.note
                    )

    def _report(self, announce: Callable[[Daemon], None]) -> None:
        """Publish the status, log changes, and supervise the scribe ten times a second. A status is
        also published after a request that changed it.
        """
        run_beside_real_time()
        self._open(announce)
        logged_mode: tuple[str, str] | None = None
        logged_errors: deque[str] = deque(maxlen=50)
        due_s = time.monotonic()
        system_clock = SystemClock()
        while not self._ended.is_set():
            self._status.wait(due_s - time.monotonic())
            is_due = time.monotonic() >= due_s
            is_published = self._status.begin()
            skill = self._controller.skill
            status = self._status_now()
            self._clock.between_ticks()
            payload = encode_json(status)
            errors = list(status.scribe["errors"])
            if is_due or is_published:
                self._streams.publish("status", payload)
            try:
                if self._controller.skill is skill:  # else the segment may be that of either
                    self._saved_segment.keep(skill, status.segment, status.segment_belief)
            except OSError as error:
                errors.append(
                    f"the segment of the task cannot be saved for a restart: {in_words(error)}"
                )
            self._status.end(payload)
            if self._own_answers is None or not self._own_answers.is_deaf():
                self._start.systemd.progressed(status.tick)
            self._clock.between_ticks()
            if is_due:
                due_s = time.monotonic() + STATUS_S
                self._way_finder.poll(self._frame, self._controller.state)
                self._streams.show(self._frame, self._controller.state)
                now_ns = self._clock.stamp_ns  # a recording has one time, which never goes back
                self._scribe.note("status", payload.decode(), now_ns)
                for stream in self._side_streams:
                    stream.poll(now_ns)
                if set_by := system_clock.set_by():
                    text = f"{CLOCK_SET}{in_full(set_by, what_to_do(Condition.CLOCK_SET))}"
                    log.warning("%s", text)
                    self._scribe.note("log", text, now_ns)
                try:
                    self._scribe.supervise()
                except OSError as error:  # a lack of descriptors or memory may be temporary
                    errors.append(f"the scribe cannot be supervised: {in_words(error)}")
            else:
                self._ended.wait(MIN_STATUS_INTERVAL_S)
            for error_text in errors:
                if error_text not in logged_errors:
                    logged_errors.append(error_text)
                    log.warning("%s", error_text)
            for line in self._sources.news(status.inputs, time.monotonic()):
                log.warning("%s", line)
            if (
                status.tick >= 0
                and not self._stop.is_set()
                and (status.mode, status.reason) != logged_mode
            ):
                logged_mode = (status.mode, status.reason)
                log.info(
                    "%s at tick %d%s",
                    in_brief(*logged_mode),
                    status.tick,
                    in_full(status.because, status.remedy),
                )
                self._start.systemd.notify(f"STATUS={in_brief(*logged_mode)}")

    def _moment(self) -> tuple[Frame, Record]:
        """The newest frame, and the state after it."""
        # during a tick, the frame and the state are of different ticks
        for _ in range(STATUS_TRIES):
            frame = self._frame
            state = self._controller.state
            if frame["tick"] == state["tick"]:
                break
            time.sleep(0.2 * self._settings.period_s)
        return frame, state

    def _status_now(self) -> Status:
        """The present status, made in parts between ticks."""
        clock = self._clock
        now_s = time.monotonic()
        clock.between_ticks()
        frame, state = self._moment()
        sources = {}
        for name, source in self._sources.update(self._controller, state, now_s):
            sources[name] = source
            clock.between_ticks()
        streams = self._sources.streams(now_s)
        clock.between_ticks()
        inside = self._measured_arm.inside(state)
        late_ms = self._lateness.largest(round(BUSY_WINDOW_S * self._settings.rate_hz)) / 1e3
        machine = self._machine
        scribe = self._scribe.status()
        machine.update(
            now_s,
            tick=int(frame["tick"]),
            missed=clock.missed,
            late_ms=late_ms,
            outcome=outcome(frame),
        )
        memory_mb = resident_mb(daemon=os.getpid(), scribe=scribe["pid"])
        windows = {
            "lateness_us": self._lateness,
            "work_us": self._work,
            "latency_ms": self._latency,
        }
        percentiles = {}
        for name, window in windows.items():
            clock.between_ticks()
            percentiles[name] = window.percentiles()
        clock.between_ticks()
        evidence = self._failure, inside, machine.at_stop, self._sources.clutch(state), streams
        return CellStatus(
            frame, self._controller, state, sources, self._settings, *evidence
        ).status(
            time_ns=time.time_ns(),
            rate_hz=clock.rate_hz(),
            missed=clock.missed,
            realtime=self._granted.realtime,
            memory_locked=self._granted.locked,
            received={key: arrivals.count for key, arrivals in self._sources.arrivals.items()},
            **percentiles,
            scribe=scribe,
            memory_mb=memory_mb,
            command_heard=self._streams.is_followed,
            busy=machine.at_stop or machine.now,
            endpoints=self.endpoints,
            version=self._version,
            tool_measured_m=self._measured_arm.position(state),
            tool_limits=self._task_limits.of(self._file),
        )


def load_skill(path: Path, settings: Settings) -> StoredSkill:
    """The skill in a file, with the via-points that were taught to it before.

    Raises SkillError, also if the arm does not reach most of the skill's tool positions, or if
    nobody accepted the skill's residual risk.
    """
    skill = skill_of(path)
    saved = SavedViaPoints(settings)
    skill.check_accepted()
    if skill.residual_risk:
        log.warning("residual risk of skill %r, %s", skill.name, skill.residual_risk)

    def taught(points: tuple[ViaPoint, ...], tolerance: float) -> StoredSkill:
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

    restored = saved.restored(skill, taught, skill)
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
    announce: Callable[[Daemon], None],
    hold: bool = False,
) -> str:
    """Run a daemon, which if `hold` begins in an operator's hold, and return a message on ticks
    that were not recorded (empty: none).

    Once it is ready, SIGINT, SIGTERM and SIGHUP stop it. Raises SkillError before it starts, and
    LoopError if the control loop cannot continue.
    """
    skill_worker = SkillWorker()
    try:
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
        daemon = Daemon(
            settings,
            skill,
            skill_worker=skill_worker,
            skills=skills,
            scribe=scribe,
            start=start,
            hold=hold,
        )
        for number in STOPPING:
            signal.signal(number, daemon.stop)
        return daemon.serve(announce)
    finally:
        skill_worker.close()
