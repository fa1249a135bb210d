"""A recording as columns: decisions and durations of its ticks, requests, skills and statuses."""

from __future__ import annotations

import contextlib
import itertools
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from thirdhand.contract import cdr
from thirdhand.contract.incidents import ORDERS
from thirdhand.contract.joint_states import measured
from thirdhand.contract.messages import WireError
from thirdhand.contract.printable import printable, printable_values
from thirdhand.contract.records import Mode
from thirdhand.contract.requests import Source
from thirdhand.core.frame import TIMING, Record, Records, Vector, frame_layout
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.recording import DECISIONS, Recording
from thirdhand.recordings.steps import Gap, Step
from thirdhand.skills.skill_file import SkillError, decoded

MOTION = (
    "setpoint",
    "setpoint_velocity",
    "setpoint_acceleration",
    "tool",
    "joints",
    "joint_velocities",
    "joint_accelerations",
)
KEPT = (
    "tick",
    "hands",
    "hand_velocities",
    "target",
    "gate_m",
    *MOTION,
    "hand_distance",
    "hand_limit",
    "hand_ages",
    "stale_ticks",
    "rejected",
    "mode",
    "reason",
    "flags",
    "commanded",
    "segment",
    "segment_belief",
    "error_probability",
    "closure",
)
BLOCK = 4096  # ticks whose whole frames are held in memory


class Order(NamedTuple):
    """A request of the operator, or a failure of the service, at a tick: its kind and its text."""

    tick: int
    kind: str
    text: str


class InForce(NamedTuple):
    """A skill, and the first tick at which it was in force."""

    tick: int
    skill: Skill


class Said(msgspec.Struct, frozen=True):
    """Mode, reason and inputs that a status reported at its tick."""

    tick: int
    mode: str
    reason: str
    because: str = ""
    remedy: str = ""
    sources: dict[str, Source] = {}
    streams: dict[str, Source] = {}


@dataclass
class Columns:
    """A recording, tick by tick.

    `frames` (T,) has the fields `KEPT`, `timing` (M,) those of a Timing. Frames that the recording
    leaves out are interpolated.
    """

    recording: Recording
    frames: Records = field(default_factory=lambda: np.empty(0, TIMING))
    timing: Records = field(default_factory=lambda: np.empty(0, TIMING))
    # of all ticks with a decision
    ticks: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    # their system clock's times
    times_ns: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    gaps: list[str] = field(default_factory=list)
    # rows of `frames` before which some are missing
    breaks: list[int] = field(default_factory=list)
    orders: list[Order] = field(default_factory=list)
    skills: list[InForce] = field(default_factory=list)
    statuses: list[Said] = field(default_factory=list)
    # measured joints by the last tick before
    stops: dict[int, list[Any]] = field(default_factory=dict)
    samples: Counter[str] = field(default_factory=Counter)  # events by kind
    remarks: list[str] = field(default_factory=list)  # sentences on unreadable parts

    @property
    def start_ns(self) -> int:
        """The system clock's time of the first tick; 0 without one."""
        return int(self.times_ns[0]) if len(self.times_ns) else 0

    @property
    def period_s(self) -> float:
        """Duration of a tick [s]."""
        return self.recording.settings.period_s

    def seconds(self, tick: int) -> float:
        """Time of a tick since the first recorded one [s]."""
        return (tick - int(self.frames["tick"][0])) * self.period_s if len(self.frames) else 0.0

    @property
    def stale_ticks(self) -> Records:
        """Age from which each hand is stale (T, 2); `stale_ms` where it was not recorded."""
        settings = self.recording.settings
        ticks: Records = np.maximum(
            self.frames["stale_ticks"], settings.ticks_in(settings.hands.stale_ms / 1000)
        )
        return ticks

    @property
    def times(self) -> Vector:
        """Time of each tick (T,) since the first [s]."""
        since: Vector = (self.frames["tick"] - self.frames["tick"][:1]) * self.period_s
        return since


class _TickReading:
    """The ticks of a recording that were read, with whole frames of the newest BLOCK alone."""

    def __init__(self, recording: Recording) -> None:
        self.columns = Columns(recording)
        self.gaps = list[Gap]()
        self.newest_tick: int | None = None
        self.ticks: list[int] = []  # of all frames, recorded or left out
        self._times_ns: list[int] = []
        self._timing: list[Record] = []
        self._layout = frame_layout(len(recording.settings.joints.names))
        self._blocks: list[Records] = []
        self._block: list[Record] = []
        self._mode = Mode.HOLD
        self._followed_tick = -(1 << 62)  # newest tick in which the arm followed

    def add(self, step: Step) -> bool:
        """Add a step; False for a step that has only a state, and no time."""
        is_after_gap = bool(step.lost or step.damage)
        if is_after_gap:
            self.gaps.append(Gap(self.newest_tick, step.tick, step.lost, step.damage))
        self.newest_tick = step.tick
        if step.frame is None and step.checksum is None:
            return False
        if step.frame is not None:
            self._mode = step.frame["mode"]
        if self._mode == Mode.FOLLOW:
            self._followed_tick = step.tick
        _take_events(self.columns, step, self._followed_tick)
        if is_after_gap:
            self.columns.breaks.append(len(self.ticks))
        self.ticks.append(step.tick)
        self._times_ns.append(step.time_ns)
        self._keep(step)
        return True

    def _keep(self, step: Step) -> None:
        """Keep the frame and the timing of a step, if they were recorded."""
        if step.frame is not None:
            self._block.append(step.frame)
        if step.timing is not None:
            self._timing.append(step.timing)
        if len(self._block) == BLOCK:
            self._end_block()

    def _end_block(self) -> None:
        self._blocks.append(repack_fields(np.array(self._block, self._layout)[list(KEPT)]))
        self._block.clear()

    def end(self) -> None:
        """Give the columns all that was read."""
        self._end_block()
        columns = self.columns
        columns.frames = np.concatenate(self._blocks)
        columns.timing = np.array(self._timing, TIMING)
        columns.ticks = np.array(self.ticks, np.int64)
        columns.times_ns = np.array(self._times_ns, np.int64)
        _fill(columns, columns.ticks)


def read(recording: Recording, *, progress: Callable[[int], None] = lambda ticks: None) -> Columns:
    """The columns of a recording. Raises RecordingError if it cannot be read."""
    reading = _TickReading(recording)
    columns = reading.columns
    _take_skill(columns, recording.skill, 0)
    for step in recording.steps():
        if reading.add(step) and len(reading.ticks) % BLOCK == 0:
            progress(len(reading.ticks))
    reading.end()
    for _, text, _ in recording.notes("status"):
        with contextlib.suppress(msgspec.MsgspecError):  # of another version
            columns.statuses.append(
                msgspec.convert(printable_values(msgspec.json.decode(text)), Said)
            )
    columns.gaps = [
        *map(str, reading.gaps),
        *recording.unreported(reading.gaps, last=reading.newest_tick),
    ]
    if columns.skills and len(columns.frames):
        columns.skills[0] = columns.skills[0]._replace(tick=int(columns.frames["tick"][0]))
    return columns


def _fill(found: Columns, ticks: NDArray[np.int64]) -> None:
    """Give `frames` a row for each of the ticks, whose frames may be left out of the recording.

    Such a row has the newest frame's decisions, as frames that change a decision are recorded. The
    arm's motion is interpolated up to the next frame, and other numbers if that decides the same;
    the hands' ages advance.
    """
    frames = found.frames
    parts = np.zeros(len(ticks), np.int64)
    if len(frames) == len(ticks) or not len(frames):
        return
    parts[found.breaks] = 1
    parts = np.cumsum(parts)
    part_of = parts[np.searchsorted(ticks, frames["tick"])]
    row = np.searchsorted(frames["tick"], ticks, side="right") - 1
    # after damage, those before the next frame are unknown
    is_known = (row >= 0) & (part_of[row] == parts)
    found.breaks = (np.flatnonzero(np.diff(parts[is_known])) + 1).tolist()
    ticks = ticks[is_known]
    row = row[is_known]
    after = np.minimum(row + 1, len(frames) - 1)
    begin = frames["tick"][row]
    end = frames["tick"][after]
    motion = np.where(
        part_of[row] == part_of[after], (ticks - begin) / np.maximum(end - begin, 1), 0.0
    )
    alike = np.all([frames[name][row] == frames[name][after] for name in DECISIONS], axis=0)
    found.frames = frames[row]
    for name in KEPT:
        if frames.dtype[name].base.kind == "f":
            values = frames[name][row]
            to = frames[name][after]
            share = motion if name in MOTION else motion * alike
            found.frames[name] += share.reshape(-1, *(1,) * (values.ndim - 1)) * (to - values)
    found.frames["hand_ages"] = _ages_between(
        frames["hand_ages"][row],
        np.where(part_of[row] == part_of[after], end - ticks, 0)[:, None],
        frames["hand_ages"][after],
        (ticks - begin)[:, None],
    )
    found.frames["tick"] = ticks


def _ages_between(ages: Any, until: Any, later_ages: Any, elapsed: Any) -> Any:
    """Ages (T, 2) [ticks] of the hands' newest samples, `elapsed` ticks after a frame with `ages`
    and `until` ticks before one with `later_ages`; -1: none yet.

    Of the samples between the two frames, only the last one is known.
    """
    by_later = later_ages - until
    by_earlier = np.where(ages < 0, -1, ages + elapsed)
    return np.where((later_ages >= 0) & (until > 0) & (by_later >= 0), by_later, by_earlier)


def _take_events(found: Columns, step: Step, followed: int) -> None:
    """Count the events of a step; keep its requests, its skills, and the joints during a stop."""
    settings = found.recording.settings
    is_stopping = 0 < step.tick - followed <= settings.rate_hz  # for 1 s
    if step.skill:
        _take_skill(found, step.skill, step.tick)
    for kind, payload in step.events:
        found.samples[kind] += 1
        if kind == "skill":
            _take_skill(found, payload, step.tick)
        elif kind in ORDERS or kind == "fault":
            found.orders.append(Order(step.tick, kind, printable(cdr.decode_string(payload))))
        elif kind == "joints/state" and is_stopping:
            with contextlib.suppress(WireError):
                joints, _ = measured(cdr.decode_joints(payload), settings.joints.names)
                if np.isfinite(joints).all():
                    found.stops.setdefault(followed, []).append(joints)


def _take_skill(found: Columns, file: bytes, tick: int) -> None:
    try:
        skill = decoded(file, origin=found.recording.path.name)
    except SkillError as error:
        found.remarks.append(f"a skill cannot be read, so its via-points are not listed: {error}")
        return
    if not found.skills or skill.digest != found.skills[-1].skill.digest:
        found.skills.append(InForce(tick, skill))


def runs(values: NDArray[Any]) -> list[tuple[int, int]]:
    """Begin and end (exclusive) of each run of equal successive values."""
    if not len(values):
        return []
    edges = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist(), len(values)]
    return list(itertools.pairwise(edges))
