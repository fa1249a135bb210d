"""The hands of a recording or a take as input of the core, with an arm that moves exactly as
commanded: what the core would have done with other settings.

The joint states of a recording belong to the commands of that day, so they are left out.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from thirdhand.contract.cdr import encode_pose
from thirdhand.contract.joint_states import measured
from thirdhand.contract.messages import WireError
from thirdhand.contract.records import Mode
from thirdhand.core.controller import Controller, run, start_state
from thirdhand.core.frame import (
    Event,
    Frame,
    Record,
    Records,
    Tick,
)
from thirdhand.recordings.mcap_file import RecordingError, existing
from thirdhand.recordings.mcap_reader import Messages
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.replay import ticks
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings, robot_description
from thirdhand.skills.skill_file import StoredSkill, decoded
from thirdhand.workbench.takes.demonstration_reader import hand_samples
from thirdhand.workbench.takes.pose_streams import PoseRecording

OF_THE_ARM = ("joints/state", "joints/guided", "fault", "reset", "way")  # events that other commands would change
CONTINUED = ("skill", "hold", "resume")  # events whose effect lasts to the begin of a part


@dataclass(frozen=True)
class RecordedHands:
    """Hands and requests of a recording as ticks, with its settings, skill, URDF, and state before
    the first tick. `remarks` are sentences on what is missing or assumed.
    """

    path: Path
    settings: Settings
    skill: StoredSkill
    urdf: str
    ticks: tuple[Tick, ...]
    state: Record
    remarks: tuple[str, ...] = ()

    @property
    def period_s(self) -> float:
        """Duration of a tick [s]."""
        return self.settings.period_s

    def frames(self, settings: Settings, ticks: Iterable[Tick] | None = None) -> Records:
        """The frames (T,) of the core with these settings, for the hands or other ticks."""
        controller = Controller(with_ideal_arm(settings), self.skill, self.state, urdf=self.urdf)
        return frames_of(controller, self.ticks if ticks is None else ticks)

    def check_comparable(self, other: Settings, origin: str) -> None:
        """Raise RecordingError if the arm of other settings is not that of the recording, or if
        they have another rate.
        """
        ours, theirs = self.settings.joints, other.joints
        if (ours.names, ours.every_kind) != (theirs.names, theirs.every_kind):
            given, needed = (", ".join(joints.names) for joints in (theirs, ours))
            raise RecordingError(f"{origin} is of another arm than {self.path}: joints {given} given, {needed} needed")
        if self.settings.rate_hz != other.rate_hz:
            raise RecordingError(
                f"{origin}: rate_hz = {other.rate_hz} given, {self.settings.rate_hz} needed: the ticks of {self.path} "
                "cannot be compared at another rate"
            )


def with_ideal_arm(settings: Settings) -> Settings:
    """The settings with an arm that is where it is commanded."""
    return msgspec.structs.replace(settings, arm=msgspec.structs.replace(settings.arm, source="assumed"))


def frames_of(controller: Controller, ticks: Iterable[Tick]) -> Records:
    """The controller's frames (T,) of ticks."""
    found: list[Frame] = []
    with threadpool_limits(1):
        run(controller, ticks, [lambda tick, frame: found.append(frame)])
    return np.array(found)


def recorded_hands(
    path: Path,
    *,
    settings: Settings | None = None,
    skill: StoredSkill | None = None,
    part: tuple[float, float] | None = None,
) -> RecordedHands:
    """The hands in a recording of the daemon, or in a take; only those of a `part` between two
    times [s] after the first tick.

    Settings and skill are those in the file unless others are given; the shipped ones for a take
    that has none. Raises RecordingError, SkillError.
    """
    messages = Messages(existing(path))
    next(iter(messages), None)
    if "format" in messages.metadata.get("thirdhand", {}):
        return _of_session(Recording.open(path).require_whole(), settings, skill, part)
    return _of_take(path, settings, skill, part)


def _of_session(
    recording: Recording, settings: Settings | None, skill: StoredSkill | None, part: tuple[float, float] | None
) -> RecordedHands:
    path, state = recording.path, None
    used = skill or decoded(recording.skill, origin=path.name)
    with contextlib.suppress(RecordingError):  # states of another version are not needed
        state = next((step.state for step in recording.steps(whole=False) if step.state is not None), None)
    whole = list(ticks(recording))
    remarks = tuple(recording.unreported((), last=whole[-1].index if whole else None))
    if not whole:
        raise RecordingError("; ".join(remarks) or f"{path} holds no tick")
    kept = _part(path, whole, part, recording.settings.period_s)
    posture = next(filter(None, (_measured(tick.inbox, recording.settings) for tick in kept)), None)
    if state is None or skill is not None:
        state = start_state(recording.settings, used)
    if state["mode"] == Mode.FAULT:
        state["mode"], state["arm_ready"] = Mode.HOLD, 0
    if posture and not state["arm_ready"]:
        limits = recording.settings.joints
        state["joints"][0] = np.clip(posture, limits.lower, limits.upper)
    left_out = OF_THE_ARM if skill is None else ("skill", *OF_THE_ARM)
    without = tuple(
        Tick(tick.index, tuple(event for event in tick.inbox if event.kind not in left_out)) for tick in kept
    )
    found = RecordedHands(path, recording.settings, used, recording.urdf, without, state, remarks)
    if settings is not None:
        found.check_comparable(settings, "--config")
    return found if settings is None else replace(found, settings=settings)


def _part(path: Path, whole: Sequence[Tick], part: tuple[float, float] | None, period_s: float) -> Sequence[Tick]:
    """The ticks of a part, of which the first also has the earlier events that last. Raises
    RecordingError if the part is empty.
    """
    if part is None:
        return whole
    first, last = whole[0].index, whole[-1].index
    begin, end = (first + round(limit_s / period_s) for limit_s in part)
    kept = [tick for tick in whole if begin <= tick.index <= end]
    if not kept:
        raise RecordingError(
            f"{path} lasts {(last - first) * period_s:.1f} s: a part from {part[0]:g} to {part[1]:g} s is empty"
        )
    before = (event for tick in whole if tick.index < begin for event in tick.inbox)
    lasting = tuple(event for event in before if event.kind in CONTINUED)
    return [Tick(kept[0].index, (*lasting, *kept[0].inbox)), *kept[1:]]


def _measured(inbox: Iterable[Event], settings: Settings) -> Sequence[float] | None:
    """The first posture that an arm reports in a tick; None without one."""
    for event in inbox:
        with contextlib.suppress(WireError):
            if event.kind == "joints/state":
                return measured(event.value, settings.joints.names)[0]
    return None


def _of_take(
    path: Path, settings: Settings | None, skill: StoredSkill | None, part: tuple[float, float] | None
) -> RecordedHands:
    recorded = PoseRecording(path)
    remarks = list(map(str, recorded.faults))
    if settings is None and recorded.settings is None:
        remarks.append(f"{path.name} has no settings: those of the shipped cell are used; --config gives others")
    settings = settings or recorded.settings or Settings()
    if skill is None:
        skill = shipped_skill()
        remarks.append(f"{path.name} has no skill: {skill.name}, which is shipped, is used; --skill gives another")
    inboxes: dict[int, list[Event]] = {}
    begin_ns: int | None = None
    for time_ns, side, pose in hand_samples(path, say=remarks.append):
        begin_ns = time_ns if begin_ns is None else begin_ns
        event = Event(f"hands/{side}", encode_pose(pose), pose)
        inboxes.setdefault(math.ceil((time_ns - begin_ns) / 1e9 * settings.rate_hz), []).append(event)
    whole = [Tick(i, tuple(inboxes.get(i, ()))) for i in range(max(inboxes) + 1)]
    made = tuple(_part(path, whole, part, settings.period_s))
    urdf = recorded.urdf or robot_description(settings)
    return RecordedHands(path, settings, skill, urdf, made, start_state(settings, skill), tuple(remarks))
