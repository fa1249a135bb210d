"""Replay: run the core on one recording, or on several that follow each other, and compare each
frame with the recorded one.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from thirdhand.contract import channels
from thirdhand.core.controller import Controller, outgoing, run
from thirdhand.core.frame import Event, Frame, Outputs, Record, Tick, differences, encode
from thirdhand.recordings.mcap_file import RecordingError, machine
from thirdhand.recordings.recording import Recorder, Recording
from thirdhand.recordings.steps import Gap, Step, checksum
from thirdhand.settings.whole_file import whole
from thirdhand.skills.skill_file import SkillError, StoredSkill, decoded

# what the last bits of a result depend on
MACHINE = ("cpu", "features", "libc", "kernel", "numpy", "blas")
REPLAY_TOLERANCE = 1e-5  # [m, rad] other versions of a library may differ by this
POSITION_FIELDS = ("hands", "target", "setpoint", "tool", "joints")


@dataclass
class ReplayGap(Gap):
    """A gap of a recording, and the tick from whose state the replay continued."""

    resumed: int | None = None

    def __str__(self) -> str:
        if self.resumed is None:
            return f"{super().__str__()}; nothing after it is compared"
        return f"{super().__str__()}; the replay continues after tick {self.resumed}"


@dataclass
class Replay:
    """The result of a replay: numbers of compared and of identical frames, the first and the
    largest differences, and the missing ticks.
    """

    ticks: int = 0
    identical: int = 0
    missing: list[ReplayGap] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    truncated: bool = False
    joined: int = 0  # recordings that continue the one before without a gap
    first_difference: str = ""
    largest: dict[str, float] = field(default_factory=dict)
    # stages whose constants are not those of the recording
    differing: set[str] = field(default_factory=set)
    recorded_on: str = ""  # the machine of the recording
    here: str = ""  # this machine

    @property
    def exact(self) -> bool:
        """True if nothing is missing and every frame is identical, bit for bit."""
        complete = not (self.missing or self.faults or self.truncated)
        return self.ticks > 0 and self.identical == self.ticks and complete

    @property
    def within_tolerance(self) -> bool:
        """True if all recorded positions are within 10 µm and 10 µrad."""
        return self.ticks > 0 and all(
            self.largest.get(name, 0.0) <= REPLAY_TOLERANCE for name in POSITION_FIELDS
        )

    def passes(self, *, exact: bool) -> bool:
        """True if the replay is exact, or within tolerance where that suffices."""
        return self.exact or (self.within_tolerance and not exact)

    def count(self, tick: int, different: Mapping[str, float], *, is_same: bool) -> None:
        """Count a tick with its differences, by field."""
        self.ticks += 1
        self.identical += is_same
        if not is_same and not self.first_difference:
            fields = ", ".join(f"{name} by {value:.3g}" for name, value in different.items())
            self.first_difference = f"first difference at tick {tick}: {fields or 'its checksum'}"
        for name, value in different.items():
            size = value if np.isfinite(value) else np.inf
            self.largest[name] = max(self.largest.get(name, 0.0), size)

    def text(self) -> str:
        """The result for people to read."""
        lines = [f"{self.ticks} ticks, {self.identical} frames identical"]
        if self.joined:
            lines.append(f"{self.joined + 1} recordings join without a gap")
        lines += [*map(str, self.missing), *self.faults]
        if not self.ticks:
            lines.append("nothing was compared: the recording has no state to start from")
        if self.first_difference:
            lines.append(self.first_difference)
            largest = ", ".join(
                f"{name} {value:.3g}" for name, value in sorted(self.largest.items())
            )
            lines.append(
                "largest differences: "
                f"{largest or 'none in the frames that are recorded completely'}"
            )
            if self.differing:
                lines.append(
                    f"the constants of {', '.join(sorted(self.differing))} are not those of the "
                    "recording"
                )
            if self.recorded_on != self.here:
                lines.append(f"recorded on {self.recorded_on}; this is {self.here}")
        return "\n".join(lines)


def replay(
    first: Path | str,
    *more: Path | str,
    after: int | None = None,
    progress: Callable[[int], None] | None = None,
    output: Path | None = None,
) -> Replay:
    """Run the core on a recording, and on those that follow it, and compare every frame.

    The new frames of a single recording without gaps can be written to `output`.

    The replay starts from the first state or, with `after`, from the first state at or after that
    tick, and again from the state after each gap. Two recordings join without a gap if the second
    begins with the last state of the first. Raises RecordingError.
    """
    recordings = [Recording.open(path).require_whole() for path in (first, *more)]
    if output is not None and (more or output.resolve() == Path(first).resolve()):
        raise RecordingError(
            f"--output {output}: a file other than the recording, and a single recording, needed"
        )
    result = Replay(recorded_on=_named(recordings[0].metadata), here=_named(machine()))
    before: Step | None = None
    with threadpool_limits(1), whole(output) if output else contextlib.nullcontext() as part:
        for i, recording in enumerate(recordings):
            before = _Comparison(recording, result, after, before, i > 0, progress, part).compared()
            result.faults += recording.unreported(
                result.missing, last=None if before is None else before.tick
            )
            result.truncated = result.truncated or recording.truncated
    return result


class _Skills:
    """The skills by digest in the part of a recording that was read."""

    def __init__(self, recording: Recording) -> None:
        self._found: dict[bytes, StoredSkill] = {}
        self.decoded(recording.skill)

    def decoded(self, data: bytes) -> StoredSkill:
        """The skill in the bytes of its file, always the same object. Raises SkillError."""
        skill = decoded(data, origin="the recording")
        return self._found.setdefault(skill.digest, skill)

    def events(self, step: Step) -> tuple[Event, ...]:
        """The events of a step as input of the core. Raises RecordingError."""
        if step.skill:
            self.decoded(step.skill)
        return tuple(self._event(kind, payload) for kind, payload in step.events)

    def in_force(self, start: Step) -> StoredSkill | None:
        """The skill in force after a step with a state; None if it was not read."""
        assert start.state is not None
        return self._found.get(start.state["skill"].tobytes())

    def _event(self, kind: str, payload: bytes) -> Event:
        channel = channels.BY_KEY[kind]
        try:
            if kind == "skill":
                return Event(kind, payload, self.decoded(payload))
            return Event(
                kind, payload, channel.codec.decode(payload) if channel.direction == "in" else None
            )
        except SkillError as error:
            raise RecordingError(f"an event of kind {kind!r} is not readable: {error}") from None


@dataclass
class _Comparison:
    """The comparison of a recording, in which each part between gaps has its own controller."""

    recording: Recording
    result: Replay
    after: int | None  # the first state is at this tick or later; None: any
    last: Step | None  # the last step that was read
    follows: bool  # True if another recording precedes this one
    progress: Callable[[int], None] | None
    output: Path | None
    recorder: Recorder | None = None
    gap_at: Step | None = None

    def __post_init__(self) -> None:
        self._skills = _Skills(self.recording)
        self._steps = self.recording.steps(whole=False)

    def _anew(
        self, skill: StoredSkill, start: Step
    ) -> contextlib.AbstractContextManager[Recorder | None]:
        """A context with the recorder of the new frames; None if they are not recorded."""
        if self.output is None:
            return contextlib.nullcontext()
        if self.result.missing:
            raise RecordingError(f"--output cannot be written: {self.result.missing[-1]}")
        settings = self.recording.settings
        urdf = self.recording.urdf
        return Recorder(
            self.output, settings=settings, skill=skill.file, state=start.state, urdf=urdf
        )

    def compared(self) -> Step | None:
        """Compare all steps and return the last one."""
        start = next(self._steps, None)
        if start is not None and not self._begins(start):
            start = self._next_start(start)
        while start is not None:
            skill = self._skills.in_force(start)
            assert skill is not None
            self._controller = Controller(
                self.recording.settings, skill, start.state, urdf=self.recording.urdf
            )
            self.last = start
            self.gap_at = None
            for stage, digest in self._controller.constants.items():
                if self.recording.metadata.get(f"constants of {stage}", digest) != digest:
                    self.result.differing.add(stage)
            with self._anew(skill, start) as self.recorder:
                run(self._controller, self._ticks(), [self.compare])
            start = None if self.gap_at is None else self._next_start(self.gap_at)
        return self.last

    def _begins(self, start: Step) -> bool:
        """True if the replay can start from the first step; notes the ticks missing before it."""
        before = self.last
        result = self.result
        self._skills.events(start)
        joins = (
            before is not None
            and None not in (before.state, start.state)
            and start.frame is None
            and encode(before.state) == encode(start.state)  # type: ignore[arg-type]
        )
        if joins:
            result.joined += 1
        elif self.follows or start.lost or start.damage:
            why = (
                ""
                if start.lost
                else start.damage or f"{self.recording.path.name} does not continue the one before"
            )
            self._note(start, why)
        return start.state is not None and self.after is None and self._resumes(start)

    def _note(self, step: Step, why: str) -> None:
        before = None if self.last is None else self.last.tick
        self.result.missing.append(ReplayGap(before, step.tick, step.lost, why))

    def _resumes(self, step: Step) -> bool:
        """True if a controller can continue from the state of a step."""
        skill = self._skills.in_force(step)
        for gap in reversed(self.result.missing):
            if gap.resumed is not None:
                break
            if skill is None and "skill" not in gap.why:
                gap.why += "; the skill then in force is not recorded"
            gap.resumed = None if skill is None else step.tick
        return skill is not None

    def _next_start(self, step: Step | None) -> Step | None:
        """The first step, from `step` on, from whose state a controller can continue."""
        while step is not None:
            self._skills.events(step)
            self.last = step
            is_due = self.after is None or step.tick >= self.after
            if step.state is not None and is_due and self._resumes(step):
                return step
            step = next(self._steps, None)
            if step is not None and (step.lost or step.damage):
                self._note(step, step.damage)
        return None

    def _ticks(self) -> Iterator[Tick]:
        """The ticks up to the next gap. Raises RecordingError."""
        for step in self._steps:
            assert self.last is not None
            if step.tick <= self.last.tick:
                raise RecordingError(
                    f"{self.recording.path}: tick {step.tick} comes after tick {self.last.tick}; "
                    "growing ticks needed"
                )
            if step.lost or step.damage:
                self._note(step, step.damage)
                self.gap_at = step
                return
            events = self._skills.events(step)
            self.last = step
            yield Tick(step.tick, events, step.time_ns)

    def compare(self, tick: Tick, frame: Frame) -> None:
        """Compare the newest tick's frame, and the state after it, with the recorded ones."""
        step = self.last
        assert step is not None
        state = self._state_after(step)
        different = _all_differences(step, frame, state)
        outputs = outgoing(frame, step.time_ns, self.recording.settings.joints.names)
        is_same = not different and self._matches_checksums(step, frame, outputs, state)
        if self.recorder:
            self.recorder.write(
                tick, frame, time_ns=step.time_ns, timing=step.timing, state=state, outputs=outputs
            )

        self.result.count(tick.index, different, is_same=is_same)
        if self.progress is not None and self.result.ticks % 1000 == 0:
            self.progress(self.result.ticks)

    def _state_after(self, step: Step) -> Record | None:
        """The controller's state, if the recording has the state after this step or its sum."""
        has_sum = self.recording.checksums and step.frame is not None
        return self._controller.state if step.state is not None or has_sum else None

    def _matches_checksums(
        self, step: Step, frame: Frame, outputs: Outputs, state: Record | None
    ) -> bool:
        """True unless a recorded checksum differs from that of this frame."""
        checksums = self.recording.checksums
        if checksums and checksums.get(step.tick) != checksum(frame, outputs, state):
            return False
        return step.checksum in (None, checksum(frame))


def _all_differences(step: Step, frame: Frame, state: Record | None) -> dict[str, float]:
    """The largest differences from the recorded frame, and from the recorded state, by field."""
    different = {} if step.frame is None else differences(step.frame, frame)
    if step.state is not None and state is not None:
        different |= {
            f"state.{name}": value for name, value in differences(step.state, state).items()
        }
    return different


def ticks(recording: Recording) -> Iterator[Tick]:
    """The ticks of a recording as input of the core."""
    skills = _Skills(recording)
    for step in recording.steps(outputs=False):
        yield Tick(step.tick, skills.events(step), step.time_ns)


def _named(metadata: dict[str, str]) -> str:
    return (
        ", ".join(f"{name} {metadata[name]}" for name in MACHINE if name in metadata)
        or "an unnamed machine"
    )
