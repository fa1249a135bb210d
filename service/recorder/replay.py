"""Replay: the core run on a recording, compared frame by frame with what it decided then."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from service.contract import channels
from service.contract.messages import WireError
from service.core.controller import Controller, run
from service.core.frame import Event, Frame, Tick, differences
from service.core.skill import Skill
from service.learning.skill_file import SkillError, decoded
from service.recorder.mcap_file import RecordingError, machine
from service.recorder.recording import Recording, Step

TOLERANCE = 1e-5  # [m, rad] between machines, where the last bits differ
POSITIONS = ("hands", "target", "setpoint", "tool", "joints")


@dataclass
class Replay:
    """What came of it: how many frames were compared and are identical, and where and how far
    others differ.
    """

    ticks: int = 0
    identical: int = 0
    gaps: int = 0
    truncated: bool = False
    first_difference: str = ""
    largest: dict[str, float] = field(default_factory=dict)
    recorded_on: str = ""
    here: str = ""

    @property
    def exact(self) -> bool:
        """Whether every frame up to the regular end is identical, bit for bit."""
        return self.ticks > 0 and self.identical == self.ticks and not self.truncated

    @property
    def within_tolerance(self) -> bool:
        """Whether no position differs by more than 10 µm or 10 µrad."""
        return self.ticks > 0 and all(self.largest.get(name, 0.0) <= TOLERANCE for name in POSITIONS)

    def text(self) -> str:
        """The result for people to read."""
        lines = [f"{self.ticks} ticks, {self.identical} frames identical"]
        if self.gaps:
            lines.append(f"{self.gaps} gaps in the recording; continued from the state after each")
        if self.truncated:
            lines.append("the recording ends early, at a cut or at damage: what follows was not compared")
        if not self.ticks:
            lines.append("nothing to compare: the recording holds no state to start from")
        if self.first_difference:
            lines.append(self.first_difference)
            lines.append(
                "largest differences: "
                + ", ".join(f"{name} {value:.3g}" for name, value in sorted(self.largest.items()))
            )
            if self.recorded_on != self.here:
                lines.append(f"recorded on {self.recorded_on}; this is {self.here}")
        return "\n".join(lines)


def replay(path: Path | str, *, after: int | None = None, progress: Callable[[int], None] | None = None) -> Replay:
    """Runs the core on a recording and compares every frame. Raises RecordingError.

    It starts from the recording's first state or, with `after`, from the first one at or after that
    tick, and anew from the state that follows each gap.
    """
    recording = Recording.open(path)
    result = Replay(recorded_on=_named(recording.metadata), here=_named(machine()))
    skills = _Skills(recording)
    steps = recording.steps()
    with threadpool_limits(1):
        start = _next_start(steps, skills, after)
        while start is not None:
            segment = _Segment(recording, start, steps, skills, result=result, progress=progress)
            run(segment.controller, segment.ticks(), [segment.compare])
            result.gaps += segment.end is not None
            start = segment.end
            if start is not None and start.state is None:
                start = _next_start(steps, skills, after)
    result.truncated = recording.truncated
    return result


class _Skills:
    """The skills of a recording, by their digests, as far as it has been read."""

    def __init__(self, recording: Recording) -> None:
        self._found: dict[bytes, Skill] = {}
        self._newest = self.decoded(recording.skill)

    def decoded(self, data: bytes) -> Skill:
        """The skill in the bytes of its file, once for all times that it is met.

        Raises SkillError.
        """
        skill = decoded(data, origin="the recording")
        return self._found.setdefault(skill.digest, skill)

    def events(self, step: Step) -> tuple[Event, ...]:
        """The events of a step, as the core takes them. Raises RecordingError."""
        if step.skill:
            self._newest = self.decoded(step.skill)
        return tuple(self._event(kind, payload) for kind, payload in step.events)

    def in_force(self, start: Step) -> Skill:
        """The skill in force after a step with a state."""
        assert start.state is not None
        return self._found.get(start.state["skill"].tobytes(), self._newest)

    def _event(self, kind: str, payload: bytes) -> Event:
        channel = channels.BY_KEY[kind]
        try:
            if kind == "skill":
                return Event(kind, payload, self.decoded(payload))
            return Event(kind, payload, channel.codec.decode(payload) if channel.direction == "in" else None)
        except (WireError, SkillError) as error:
            raise RecordingError(f"an event of kind {kind!r} is not understood: {error}") from None


class _Segment:
    """A recording from a state up to its end or the next gap, and the controller that goes on from
    that state.
    """

    def __init__(
        self,
        recording: Recording,
        start: Step,
        steps: Iterator[Step],
        skills: _Skills,
        *,
        result: Replay,
        progress: Callable[[int], None] | None,
    ) -> None:
        self._path, self._steps, self._skills, self._result, self._progress = (
            recording.path,
            steps,
            skills,
            result,
            progress,
        )
        skill = skills.in_force(start)
        self.controller = Controller(recording.settings, skill, start.state, urdf=recording.urdf)
        self._step = start
        self.end: Step | None = None  # the step behind the gap

    def ticks(self) -> Iterator[Tick]:
        """The segment's ticks. Raises RecordingError."""
        for step in self._steps:
            events = self._skills.events(step)
            if step.tick <= self._step.tick:
                raise RecordingError(
                    f"{self._path}: tick {step.tick} comes after tick {self._step.tick}; growing ticks needed"
                )
            if step.lost:
                self.end = step
                return
            self._step = step
            yield Tick(step.tick, events)

    def compare(self, tick: Tick, frame: Frame) -> None:
        """Holds the frame of the newest tick, and the state after it, against what was recorded."""
        step, result = self._step, self._result
        assert step.frame is not None
        unlike = differences(step.frame, frame)
        if step.state is not None:
            after = differences(step.state, self.controller.state)
            unlike |= {f"state.{name}": value for name, value in after.items()}
        result.ticks += 1
        result.identical += not unlike
        if unlike and not result.first_difference:
            what = ", ".join(f"{name} by {value:.3g}" for name, value in unlike.items())
            result.first_difference = f"first difference at tick {tick.index}: {what}"
        for name, value in unlike.items():
            result.largest[name] = max(result.largest.get(name, 0.0), value if np.isfinite(value) else np.inf)
        if self._progress is not None and result.ticks % 1000 == 0:
            self._progress(result.ticks)


def _next_start(steps: Iterator[Step], skills: _Skills, after: int | None) -> Step | None:
    """The next step from whose state a replay can go on."""
    for step in steps:
        skills.events(step)
        if step.state is not None and (after is None or step.tick >= after):
            return step
    return None


def ticks(recording: Recording) -> Iterator[Tick]:
    """The ticks of a recording, as the core takes them."""
    skills = _Skills(recording)
    for step in recording.steps(outputs=False):
        yield Tick(step.tick, skills.events(step))


def _named(metadata: dict[str, str]) -> str:
    return (
        ", ".join(f"{name} {metadata[name]}" for name in ("cpu", "numpy", "blas") if name in metadata)
        or "an unnamed machine"
    )
