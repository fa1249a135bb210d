"""Replay: the core run on a recording, compared frame by frame with what it decided then."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from service import wire
from service.controller import Controller, run
from service.frame import Event, Frame, Record, Tick, differences
from service.recording import Recording, RecordingError, Step, machine
from service.skill import Skill, SkillError

TOLERANCE = 1e-5  # [m, rad] between machines, where the last bits differ
POSITIONS = ("hands", "target", "setpoint", "tool", "joints")


@dataclass
class Replay:
    """What came of it: how many frames were compared and are identical, and where and how far others differ."""

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
    def close(self) -> bool:
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
            lines.append("largest differences: " + ", ".join(f"{name} {value:.3g}" for name, value in sorted(self.largest.items())))
            if self.recorded_on != self.here:
                lines.append(f"recorded on {self.recorded_on}; this is {self.here}")
        return "\n".join(lines)


def replay(path: Path | str, *, after: int | None = None, progress: Callable[[int], None] | None = None) -> Replay:
    """Runs the core on a recording, from its first state or, with `after`, from the first one at or after that tick. Raises RecordingError."""
    recording = Recording.open(path)
    result = Replay(recorded_on=_named(recording.metadata), here=_named(machine()))
    skills: dict[bytes, Skill] = {}
    skill = _skill(recording.skill, skills)
    with threadpool_limits(1):
        controller: Controller | None = None
        for step in recording.steps():
            events = tuple(_event(kind, payload, skills) for kind, payload in step.events)
            if controller is not None and step.tick <= controller.state["tick"]:
                raise RecordingError(f"{path}: tick {step.tick} comes after tick {int(controller.state['tick'])}; growing ticks needed")
            if step.lost:
                controller = None
                result.gaps += 1
            if controller is not None and step.frame is not None:
                _compare(result, controller, Tick(step.tick, events), step)
                if progress is not None and result.ticks % 1000 == 0:
                    progress(result.ticks)
            elif step.state is not None and (after is None or step.tick >= after):
                skill = _in_force(step.state, skills) or (_skill(step.skill, skills) if step.skill else skill)
                controller = Controller(recording.settings, skill, step.state)
            if step.skill:
                _skill(step.skill, skills)
    result.truncated = recording.truncated
    return result


def ticks(recording: Recording) -> Iterator[Tick]:
    """The ticks of a recording, as the core takes them."""
    skills: dict[bytes, Skill] = {}
    for step in recording.steps(outputs=False):
        yield Tick(step.tick, tuple(_event(kind, payload, skills) for kind, payload in step.events))


def _compare(result: Replay, controller: Controller, tick: Tick, step: Step) -> None:
    frames: list[Frame] = []
    run(controller, [tick], [lambda _, frame: frames.append(frame)])
    assert step.frame is not None
    unlike = differences(step.frame, frames[0])
    if step.state is not None:
        unlike |= {f"state.{name}": value for name, value in differences(step.state, controller.state).items()}
    result.ticks += 1
    result.identical += not unlike
    if unlike and not result.first_difference:
        what = ", ".join(f"{name} by {value:.3g}" for name, value in unlike.items())
        result.first_difference = f"first difference at tick {tick.index}: {what}"
    for name, value in unlike.items():
        result.largest[name] = max(result.largest.get(name, 0.0), value if np.isfinite(value) else np.inf)


def _event(kind: str, payload: bytes, skills: dict[bytes, Skill]) -> Event:
    try:
        if kind == "skill":
            return Event(kind, payload, _skill(payload, skills))
        return Event(kind, payload, wire.DECODERS[kind](payload) if kind in wire.DECODERS else None)
    except (wire.WireError, SkillError) as error:
        raise RecordingError(f"an event of kind {kind!r} is not understood: {error}") from None


def _skill(data: bytes, skills: dict[bytes, Skill]) -> Skill:
    skill = Skill.from_bytes(data, origin="the recording")
    return skills.setdefault(skill.digest, skill)


def _in_force(state: Record, skills: dict[bytes, Skill]) -> Skill | None:
    return skills.get(state["skill"].tobytes())


def _named(metadata: dict[str, str]) -> str:
    return ", ".join(f"{name} {metadata[name]}" for name in ("cpu", "numpy", "blas") if name in metadata) or "an unnamed machine"
