"""The state of one cell that its loop shares with the threads beside it."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque

from thirdhand.client import endpoints
from thirdhand.contract.records import Reason
from thirdhand.core.frame import Event, Frame, Record, blank, frame_layout, order
from thirdhand.core.separation import FARTHEST_REPORTED_M
from thirdhand.daemon.cell_streams import CellStreams
from thirdhand.daemon.clock import Deadlines, Granted, TickTimes
from thirdhand.daemon.input_monitor import InputMonitor
from thirdhand.daemon.rehearsed_controller import RehearsedController
from thirdhand.daemon.request_inbox import RequestInbox
from thirdhand.daemon.start import Startup
from thirdhand.scribe.scribe import Scribe
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import StoredSkill

log = logging.getLogger("thirdhand")
MAX_NOTES_PER_S = 100
MOMENT_TRIES = 10  # attempts to read a frame and the state of the same tick
# after this time without a new status, a request is answered with the last one
STATUS_TIMEOUT_S = 2.0


class NewestStatus:
    """The status in bytes. One thread makes it: `wait`, `begin`, make it, publish it, `end`.

    Other threads get a status that was begun after their request.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._begun = self._made = self._wanted = 0  # numbers of statuses
        self._is_published = self._is_over = False
        self._payload = b""

    def requested(self, *, published: bool = False) -> bytes:
        """A status that was begun after this call; if `published`, subscribers get it too."""
        with self._changed:
            number = self._wanted = self._begun + 1
            self._is_published |= published
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._made >= number or self._is_over, STATUS_TIMEOUT_S)
            return self._payload

    def wait(self, timeout_s: float) -> None:
        """Return once a status is requested, or after `timeout_s` [s]."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._wanted > self._begun or self._is_over, max(0.0, timeout_s)
            )

    def begin(self) -> bool:
        """Begin a status; True if a request needs it to be published."""
        with self._changed:
            self._begun += 1
            is_published = self._is_published
            self._is_published = False
            return is_published

    def end(self, payload: bytes) -> None:
        """End the status that was begun, with its bytes."""
        with self._changed:
            self._payload = payload
            self._made = self._begun
            self._changed.notify_all()

    def close(self) -> None:
        """End the making of statuses; requests are answered with the last one."""
        with self._changed:
            self._is_over = True
            self._changed.notify_all()


class CellState:
    """The controller of one cell and its newest frame, the skills in force, what arrives for the
    loop and waits for it, its times, and the notes and failures of the service.

    The loop alone uses `core`, sets `frame`, and uses `receive` of the streams.
    """

    def __init__(
        self, settings: Settings, skill: StoredSkill, scribe: Scribe, start: Startup
    ) -> None:
        self.settings = settings
        self.scribe = scribe
        self.start = start
        self.endpoints = endpoints(start.session) if settings.network.listen else ()
        start.lock.announce(self.endpoints)
        self.core = RehearsedController(settings, skill.for_loop())
        self.controller = self.core.controller
        self.clock = Deadlines(settings.rate_hz)
        self.times = TickTimes(settings.rate_hz)
        self.granted = Granted(realtime=False, memory_locked=False, awake=False)

        # Before the first tick, the arm is not ready and nobody was seen.
        self.frame: Frame = blank(frame_layout(len(settings.joints.names)))
        self.frame["tick"] = self.frame["hand_ages"] = -1
        self.frame["reason"] = Reason.ARM_NOT_READY
        self.frame["hand_distance"] = FARTHEST_REPORTED_M
        self.frame["hand_limit"] = self.controller.max_part_speed

        # The skill in force and one that the loop adopts next, by digest.
        self.adoptable = {skill.digest: skill}

        # The monitor of the inputs judges what the streams count.
        self.inputs = InputMonitor(settings)
        self.streams = CellStreams(
            start.session, settings, arrivals=self.inputs.arrivals, failed=self.fail
        )

        # The requests of clients and the events of the service itself wait for the loop.
        self.inbox = RequestInbox()
        self.own: deque[Event] = deque()
        self.stop = threading.Event()  # set once the loop is to stop the arm and end
        self.ended = threading.Event()  # set once the loop has ended

        self.newest_status = NewestStatus()
        self.failure = ""  # message of the service's last failure
        self._notes = (0, 0)  # time [s] and the number of notes in this second

    def moment(self) -> tuple[Frame, Record]:
        """The newest frame, and the state after it."""
        # during a tick, the frame and the state are of different ticks
        for _ in range(MOMENT_TRIES):
            frame = self.frame
            state = self.controller.state
            if frame["tick"] == state["tick"]:
                break
            time.sleep(0.2 * self.settings.period_s)
        return frame, state

    @property
    def skill(self) -> StoredSkill:
        """The skill in force, which is that of the loop's state."""
        return self.adoptable[self.moment()[1]["skill"].tobytes()]

    @property
    def file(self) -> bytes:
        """The file of the skill in force, without waiting for the end of a tick."""
        return self.adoptable[self.controller.skill.digest].file

    def note(self, text: str) -> None:
        """Write a line to log and recording; lines beyond MAX_NOTES_PER_S are only counted."""
        noted_s, count = self._notes
        second = int(time.monotonic())
        if second != noted_s:
            if count > MAX_NOTES_PER_S:
                self._say(
                    f"{count - MAX_NOTES_PER_S} more requests within a second were not logged"
                )
            count = 0
        self._notes = (second, count + 1)
        if count < MAX_NOTES_PER_S:
            self._say(text)

    def note_beside(self, text: str) -> None:
        """Note a message of work beside the loop, unless the daemon, and thus this work, ends."""
        if not self.stop.is_set():
            self.note(text)

    def fail(self, what: str) -> None:
        """Report a failure of the service; the next tick enters the mode `fault`."""
        self.failure = what
        self.own.append(order("fault", what))
        self._say(what)

    def _say(self, text: str) -> None:
        log.info(text)
        self.scribe.note("requests", text, self.clock.stamp_ns)
