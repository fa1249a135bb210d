"""The thread beside a cell's loop, which publishes the status and supervises the scribe."""

from __future__ import annotations

import logging
import os
import time
from collections import deque
from importlib.metadata import version
from typing import Any

from thirdhand.contract.explain import in_words
from thirdhand.contract.incidents import Condition, in_brief, in_full, what_to_do
from thirdhand.contract.records import Reason
from thirdhand.contract.requests import Percentiles, Source, Status, encode_json
from thirdhand.core.frame import Frame, Record, order
from thirdhand.daemon.answers import Answers
from thirdhand.daemon.cell_state import CellState
from thirdhand.daemon.clock import SystemClock
from thirdhand.daemon.machine import BUSY_WINDOW_S, Machine, resident_mb
from thirdhand.daemon.own_answers import OwnAnswers
from thirdhand.daemon.saved_segment import SavedSegment
from thirdhand.daemon.side_streams import side_streams
from thirdhand.daemon.skill_work import SkillWork
from thirdhand.daemon.status import ArmLag, CellStatus, MeasuredArm, outcome
from thirdhand.settings.config import robot_description

log = logging.getLogger("thirdhand")
STATUS_S = 0.1  # interval of published statuses
MIN_STATUS_INTERVAL_S = 0.02  # a flood of requests must not take the interpreter from the loop


class StatusThread:
    """The work of one thread: it publishes the status, logs changes, and supervises the scribe."""

    def __init__(self, cell: CellState, answers: Answers) -> None:
        settings = cell.settings
        self._cell = cell

        # What the status reports beside the newest frame.
        self._arm_lag = ArmLag(settings.period_s)
        self._measured_arm = MeasuredArm(settings, robot_description(settings))
        self._machine = Machine()
        self._version = version("thirdhand")
        self._skill_work = SkillWork(cell, answers)

        # What is supervised.
        self._side_streams = side_streams(
            cell.start.session, settings, cell.scribe, cell.inputs.arrivals
        )
        self._system_clock = SystemClock()
        self.own_answers = OwnAnswers(cell)

        # A task continues where an earlier run has reached it.
        self._saved_segment = SavedSegment(settings)
        if reached := self._saved_segment.read(cell.controller.skill):
            cell.own.append(order("segment", reached))
            log.info(
                "the task continues at via-point %s, which an earlier run had reached", reached
            )

        self._logged_mode: tuple[str, str] | None = None
        self._logged_errors: deque[str] = deque(maxlen=50)

    def run(self) -> None:
        """Publish the status, log changes, and supervise the scribe ten times a second, until the
        loop has ended. A status is also published after a request that changed it.
        """
        cell = self._cell
        due_s = time.monotonic()
        while not cell.ended.is_set():
            cell.newest_status.wait(due_s - time.monotonic())
            is_due = time.monotonic() >= due_s
            status = self._publish(is_due)
            if is_due:
                due_s = time.monotonic() + STATUS_S
                self._supervise()
            else:
                cell.ended.wait(MIN_STATUS_INTERVAL_S)
            self._log(status)

    def _publish(self, is_due: bool) -> Status:
        """Make the status, which answers the requests that wait for it. Publish it if a request
        needs that; publish and record it if it is due.
        """
        cell = self._cell
        is_published = cell.newest_status.begin() or is_due
        skill = cell.controller.skill
        status = self._status()
        cell.clock.between_ticks()
        payload = encode_json(status)
        if is_published:
            cell.streams.publish("status", payload)

        # While a skill is adopted, the segment may be that of either skill.
        try:
            if cell.controller.skill is skill:
                self._saved_segment.keep(skill, status.segment, status.segment_belief)
        except OSError as error:
            self._warn(f"the segment of the task cannot be saved for a restart: {in_words(error)}")

        cell.newest_status.end(payload)
        if not self.own_answers.is_deaf():
            cell.start.systemd.progressed(status.tick)
        cell.clock.between_ticks()
        if is_due:
            cell.scribe.note("status", payload.decode(), cell.clock.stamp_ns)
        return status

    def _supervise(self) -> None:
        """Supervise the arm, the side streams, the system clock and the scribe."""
        cell = self._cell
        self._skill_work.find_way()
        self._skill_work.begin_where_hands_rest()
        cell.streams.show(cell.frame, cell.controller.state)

        now_ns = cell.clock.stamp_ns  # a recording has one time, which never goes back
        for stream in self._side_streams:
            stream.poll(now_ns)

        if set_by := self._system_clock.set_by():
            text = f"the system clock was set{in_full(set_by, what_to_do(Condition.CLOCK_SET))}"
            log.warning("%s", text)
            cell.scribe.note("log", text, now_ns)

        try:
            cell.scribe.supervise()
        except OSError as error:  # a lack of descriptors or memory may be temporary
            self._warn(f"the scribe cannot be supervised: {in_words(error)}")

    def _warn(self, error: str) -> None:
        """Log an error that was not logged lately."""
        if error not in self._logged_errors:
            self._logged_errors.append(error)
            log.warning("%s", error)

    def _log(self, status: Status) -> None:
        """Log errors of the scribe, news of the inputs, and a change of the mode."""
        cell = self._cell
        for error in status.scribe["errors"]:
            self._warn(error)
        for line in cell.inputs.news(status.inputs, time.monotonic()):
            log.warning("%s", line)

        mode = status.mode, status.reason
        if status.tick >= 0 and not cell.stop.is_set() and mode != self._logged_mode:
            self._logged_mode = mode
            log.info(
                "%s at tick %d%s",
                in_brief(*mode),
                status.tick,
                in_full(status.because, status.remedy),
            )
            cell.start.systemd.notify(f"STATUS={in_brief(*mode)}")

    def _status(self) -> Status:
        """The present status, made in parts between ticks."""
        cell = self._cell
        clock = cell.clock
        now_s = time.monotonic()
        clock.between_ticks()
        frame, state = cell.moment()
        sources = self._sources(state, now_s)
        streams = cell.inputs.streams(now_s)
        clock.between_ticks()
        inside = self._measured_arm.inside(state)
        self._arm_lag.note(frame, state)
        self._update_machine(frame, now_s)

        moment = CellStatus(
            frame,
            cell.controller,
            state,
            sources,
            cell.settings,
            failure=cell.failure,
            inside=inside,
            busy=self._machine.at_stop,
            clutch=cell.inputs.clutch(state),
            late_s=self._arm_lag.late_s() if frame["reason"] == Reason.ARM_ERROR else 0.0,
            streams=streams,
        )
        return moment.status(
            **self._percentiles(),
            **self._processes(),
            received={key: arrivals.count for key, arrivals in cell.inputs.arrivals.items()},
            command_heard=cell.streams.is_followed,
            busy=self._machine.at_stop or self._machine.now,
            endpoints=cell.endpoints,
            version=self._version,
            tool_measured_m=self._measured_arm.position(state),
            tool_limits=self._skill_work.tool_limits(),
        )

    def _sources(self, state: Record, now_s: float) -> dict[str, Source]:
        """Hands and arm at this moment, by name; a tick may pass between any two."""
        cell = self._cell
        sources = {}
        for name, source in cell.inputs.update(cell.controller, state, now_s):
            sources[name] = source
            cell.clock.between_ticks()
        return sources

    def _update_machine(self, frame: Frame, now_s: float) -> None:
        """Judge by the newest ticks if the machine is busy."""
        cell = self._cell
        window_ticks = round(BUSY_WINDOW_S * cell.settings.rate_hz)
        self._machine.update(
            now_s,
            tick=int(frame["tick"]),
            missed=cell.clock.missed,
            late_ms=cell.times.windows["lateness_us"].largest(window_ticks) / 1e3,
            outcome=outcome(frame),
        )

    def _processes(self) -> dict[str, Any]:
        """The fields on the loop and the scribe."""
        cell = self._cell
        scribe = cell.scribe.status()
        return {
            "time_ns": time.time_ns(),
            "rate_hz": cell.clock.rate_hz(),
            "missed": cell.clock.missed,
            **cell.granted._asdict(),
            "scribe": scribe,
            "memory_mb": resident_mb(daemon=os.getpid(), scribe=scribe["pid"]),
        }

    def _percentiles(self) -> dict[str, Percentiles]:
        """Percentiles of lateness, work and latency, by field; a tick may pass between any two."""
        clock = self._cell.clock
        percentiles = {}
        for name, window in self._cell.times.windows.items():
            clock.between_ticks()
            percentiles[name] = window.percentiles()
        clock.between_ticks()
        return percentiles
