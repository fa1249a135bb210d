"""A recording as columns: what its ticks decided, how long they took, and what else happened, for
looking at the whole of it.
"""

from __future__ import annotations

import itertools
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from service.contract import cdr
from service.contract.messages import WireError, in_order
from service.contract.records import Mode, Reason
from service.core.frame import TIMING, Record, Records, Vector, frame_layout
from service.core.skill.skill import Skill
from service.learning.skill_file import SkillError, decoded
from service.recording.recording import Recording
from service.recording.steps import Gap, Step

KEPT = (
    *("tick", "hands", "hand_velocities", "target", "deviation", "setpoint", "setpoint_velocity", "tool", "joints"),
    *("joint_velocities", "joint_accelerations", "hand_distance", "hand_limit", "hand_ages", "rejected"),
    *("mode", "reason", "flags", "commanded"),
)
BLOCK = 4096  # ticks that are held whole
REMEMBERED_S = 1.0  # of joint states before a fault
ORDERS = ("hold", "resume", "reset", "fault")


class Order(NamedTuple):
    """Something that was asked for, or that failed, at a tick: its kind and its text."""

    tick: int
    kind: str
    text: str


class InForce(NamedTuple):
    """A skill, and the tick from which it was in force."""

    tick: int
    skill: Skill


class Measured(NamedTuple):
    """What the arm told of its joints at a tick: (J,) [rad] and [rad/s]."""

    tick: int
    positions: Vector
    velocities: Vector


@dataclass
class Columns:
    """A recording, tick by tick.

    `frames` (T,) has the fields `KEPT`, `timing` (M,) those of a Timing; `measured` is what the arm
    told in the second before the tick of each fault, `silent_since` the tick when it told anything
    last before each tick from which on it was not ready.
    """

    recording: Recording
    frames: Records = field(default_factory=lambda: np.empty(0, TIMING))
    timing: Records = field(default_factory=lambda: np.empty(0, TIMING))
    start_ns: int = 0  # the system clock's time of the first tick
    gaps: list[str] = field(default_factory=list)
    breaks: list[int] = field(default_factory=list)  # rows of `frames` before which some are missing
    orders: list[Order] = field(default_factory=list)
    skills: list[InForce] = field(default_factory=list)
    measured: dict[int, list[Measured]] = field(default_factory=dict)
    silent_since: dict[int, int] = field(default_factory=dict)
    samples: Counter[str] = field(default_factory=Counter)  # that came, by kind
    remarks: list[str] = field(default_factory=list)  # on what could not be read

    @property
    def period_s(self) -> float:
        """Duration of a tick [s]."""
        return self.recording.settings.period_s

    def seconds(self, tick: int) -> float:
        """Time of a tick since the first that is there [s]."""
        return (tick - int(self.frames["tick"][0])) * self.period_s if len(self.frames) else 0.0

    @property
    def times(self) -> Vector:
        """Time of each tick (T,) since the first [s]."""
        since: Vector = (self.frames["tick"] - self.frames["tick"][:1]) * self.period_s
        return since


def read(recording: Recording, *, progress: Callable[[int], None] = lambda ticks: None) -> Columns:
    """The columns of a recording. Raises RecordingError on what is not understood."""
    return _Reading(recording, progress).columns()


class _Reading:
    """One pass over the steps of a recording."""

    def __init__(self, recording: Recording, progress: Callable[[int], None]) -> None:
        self._recording, self._progress = recording, progress
        self._found = Columns(recording)
        joints = recording.settings.joints
        self._names, self._layout = joints.names, frame_layout(len(joints.names))
        self._remembered = round(REMEMBERED_S / recording.settings.period_s)
        self._heard: deque[tuple[int, bytes]] = deque()
        self._heard_at: int | None = None  # the tick of the newest
        self._in_fault = self._not_ready = False

    def columns(self) -> Columns:
        """What is found."""
        found, last, gaps = self._found, None, list[Gap]()
        blocks: list[Records] = []
        block: list[Record] = []
        timing: list[Record] = []
        self._skill(self._recording.skill, 0)
        for step in self._recording.steps():
            if step.lost or step.damage:
                gaps.append(Gap(last, step.tick, step.lost, step.damage))
            last = step.tick
            if step.frame is None:
                continue
            if not found.start_ns:
                found.start_ns = step.time_ns
            self._events(step)
            self._watch(step.frame)
            if step.lost or step.damage:
                found.breaks.append(BLOCK * len(blocks) + len(block))
            block.append(step.frame)
            if step.timing is not None:
                timing.append(step.timing)
            if len(block) == BLOCK:
                blocks.append(self._kept(block))
                block.clear()
                self._progress(BLOCK * len(blocks))
        found.frames = np.concatenate([*blocks, self._kept(block)])
        found.timing = np.array(timing, TIMING)
        found.gaps = [*map(str, gaps), *self._recording.unreported(gaps, last=last)]
        if found.skills and len(found.frames):
            found.skills[0] = found.skills[0]._replace(tick=int(found.frames["tick"][0]))
        return found

    def _kept(self, block: list[Record]) -> Records:
        kept: Records = repack_fields(np.array(block, self._layout)[list(KEPT)])
        return kept

    def _events(self, step: Step) -> None:
        """Counts what came, and keeps what is told later."""
        found = self._found
        if step.skill:
            self._skill(step.skill, step.tick)
        for kind, payload in step.events:
            found.samples[kind] += 1
            if kind == "joints/state":
                self._heard.append((step.tick, payload))
                self._heard_at = step.tick
            elif kind == "skill":
                self._skill(payload, step.tick)
            elif kind in ORDERS:
                found.orders.append(Order(step.tick, kind, cdr.decode_string(payload)))
        while self._heard and self._heard[0][0] < step.tick - self._remembered:
            self._heard.popleft()

    def _skill(self, file: bytes, tick: int) -> None:
        try:
            skill = decoded(file, origin=self._recording.path.name, recorded=True)
        except SkillError as error:
            self._found.remarks.append(f"a skill is not understood, its places are not told: {error}")
            return
        if not self._found.skills or skill.digest != self._found.skills[-1].skill.digest:
            self._found.skills.append(InForce(tick, skill))

    def _watch(self, frame: Record) -> None:
        """Keeps what the arm told before a fault, and when it fell silent."""
        fault = int(frame["mode"]) == Mode.FAULT
        if fault and not self._in_fault:
            self._found.measured[int(frame["tick"])] = list(self._states())
        self._in_fault = fault
        not_ready = int(frame["reason"]) == Reason.ARM_NOT_READY
        if not_ready and not self._not_ready and self._heard_at is not None:
            self._found.silent_since[int(frame["tick"])] = self._heard_at
        self._not_ready = not_ready

    def _states(self) -> list[Measured]:
        """What the arm told lately, in the order of the settings; what is not understood is left
        out, as the service does.
        """
        out = []
        for tick, payload in self._heard:
            try:
                position, velocity = in_order(cdr.decode_joints(payload), self._names)
            except WireError:
                continue
            out.append(Measured(tick, np.array(position), np.array(velocity)))
        return out


def runs(values: NDArray[Any]) -> list[tuple[int, int]]:
    """Begin and end (behind the last) of each run of equal values in a row."""
    if not len(values):
        return []
    edges = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist(), len(values)]
    return list(itertools.pairwise(edges))
