"""A recording as the loop writes it, and reading of a drawing."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from support.wam import FRAME, JOINT_NAMES, STATE
from thirdhand.contract import cdr, messages
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.controller import outgoing
from thirdhand.core.frame import TIMING, Event, Record, Tick, blank
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.recording import Recorder, Recording
from thirdhand.recordings.replay import ticks as ticks_in
from thirdhand.recordings.steps import Step
from thirdhand.scribe.scribe import Scribe
from thirdhand.settings.config import WAM, Settings
from thirdhand.skills.skill_file import with_file
from thirdhand.viewer.stream import Viewer

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 2_000_000
SKILL = bytes(range(256)) * 40
TEXT = "TextLog:text"
CELL = Settings(cell="hall/bench-1")


def vise_taught(skill: Skill) -> bytes:
    """The file of a skill with a via-point at a vise, which is a ball of 3 cm."""
    vise = ViaPoint(
        "vise", (0.62, -0.28, 0.3), (0.98, 0.32, 0.06), (0.54, -0.28, 0.38), radius=0.03
    )
    return with_file(replace(skill, via_points=(vise,))).file


def at_ns(tick: int) -> int:
    """The time of a tick [ns]."""
    return START_NS + tick * PERIOD_NS


def pose(stamp_ns: int, x: float) -> bytes:
    """A hand's pose as CDR."""
    return cdr.encode_pose(
        messages.PoseStamped(stamp_ns, "base", (x, 0.1, 0.2), (0.0, 0.0, 0.0, 1.0))
    )


def state_after(tick: int) -> Record:
    """A state that differs from those after other ticks."""
    state = blank(STATE)
    state["tick"] = tick
    state["measured"] = tick / 7
    return state


def ticks(count: int, *, first: int = 0) -> Iterator[tuple[Tick, Record, Record]]:
    """Ticks with every kind of event, plausible frames of an arm that moves, and timings."""
    random = np.random.default_rng(first)
    for i in range(first, first + count):
        frame = blank(FRAME)
        timing = blank(TIMING)
        angle = i / 500.0
        hands = (0.7 + 0.1 * np.sin(angle), 0.5 - 0.1 * np.cos(angle))
        frame["tick"] = i
        frame["hand_stamp_ns"] = at_ns(i) - 1_000_000
        frame["hands"] = [[hands[0], -0.25, 0.2], [hands[1], 0.25, 0.2]]
        frame["target"] = frame["setpoint"] = frame["tool"] = [
            0.5 + 0.1 * np.sin(angle),
            0.1 * np.cos(angle),
            0.4,
        ]
        frame["covariance"] = np.diag([4e-4, 1e-4, 2e-4])
        frame["orientation"] = [0.0, 0.9238795325112867, 0.0, 0.3826834323650898]
        frame["joints"] = (
            np.array([0, 0.2, 0, 2.2, 0, -0.1, 0])
            + 0.2 * np.sin(angle + np.arange(7))
            + random.normal(0, 1e-6, 7)
        )
        frame["joint_velocities"] = 0.2 * np.cos(angle + np.arange(7))
        frame["hand_ages"] = [i % 3, i % 2] if i >= 10 else -1
        frame["mode"], frame["reason"], frame["commanded"] = (
            (1, 0, 1) if i >= 10 else (0, 1, i >= 5)
        )
        timing["tick"] = i
        timing["time_ns"] = at_ns(i)
        timing["latency_us"] = 800 + i % 7
        timing["work_us"] = 180 + i % 11
        inbox = []
        if i >= 10:
            inbox += [
                Event("hands/left", pose(at_ns(i), hands[0]), None),
                Event("hands/right", pose(at_ns(i), hands[1]), None),
            ]
        if i % 4 == 0:
            joints = messages.JointState(at_ns(i), JOINT_NAMES, tuple(frame["joints"].tolist()), ())
            inbox.append(Event("joints/state", cdr.encode_joints(joints), None))
            inbox.append(Event("clutch", cdr.encode_bool(i % 2 == 0), None))
            inbox.append(Event("joints/guided", cdr.encode_bool(i % 8 == 0), None))
            wish = messages.JointState(at_ns(i), (messages.GRIPPER,), (0.5,), ())
            inbox.append(Event("gripper/wish", cdr.encode_joints(wish), None))
            wished = messages.PoseWithCovarianceStamped(
                at_ns(i), messages.BASE, (0.5, 0.0, 0.4), (0.0, 0.0, 0.0, 1.0), (0.0,) * 36
            )
            inbox.append(Event("tool/wish", cdr.encode_pose_with_covariance(wished), None))
        if i % 100 == 50:
            inbox += [
                Event(kind, cdr.encode_string("{}"), None)
                for kind in ("fault", "reset", "hold", "resume", "hold", "way", "segment", "begin")
            ]
            inbox.insert(1, Event("skill", random.bytes(2000), None))
        yield Tick(i, tuple(inbox)), frame, timing


def write(
    path: Path, count: int = 300, *, settings: Settings = CELL
) -> list[tuple[Tick, Record, Record]]:
    """Write a recording with an initial state and a state every hundred ticks; returns its
    content.
    """
    entries = list(ticks(count))
    with Recorder(path, settings=settings, skill=SKILL, state=state_after(-1)) as recorder:
        for tick, frame, timing in entries:
            state = state_after(tick.index) if tick.index % 100 == 99 else None
            time_ns = at_ns(tick.index)
            outputs = outgoing(frame, time_ns, settings.joints.names)
            recorder.write(
                tick, frame, time_ns=time_ns, timing=timing, state=state, outputs=outputs
            )
            if tick.index % 50 == 0:
                recorder.flush()
                recorder.note("status", f"tick {tick.index}", at_ns(tick.index))
    return entries


def tell(
    one: Scribe, count: int, *, first: int = 0, skill: bytes = SKILL
) -> list[tuple[Tick, Record, Record]]:
    """Send ticks to the scribe as the loop does; returns them."""
    entries = list(ticks(count, first=first))
    for tick, frame, timing in entries:
        one.send(
            tick, frame, timing, state=lambda index=tick.index: state_after(index), skill=skill
        )
    return entries


def drawn(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The rows of every entity in a Rerun file."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for chunk in rr.chunk.RrdReader(path).stream():
        rows.setdefault(chunk.entity_path, []).extend(chunk.to_record_batch().to_pylist())
    return rows


def viewed(
    path: Path,
    count: int,
    change: Callable[[Viewer, int, Record], Any] = lambda *_: (),
    *,
    skill: bytes | None = None,
) -> dict[str, list[dict[str, Any]]]:
    """The rows of a drawing of the shipped arm in this number of ticks. Before each tick is drawn,
    `change` is called with viewer, tick and frame; it returns the tick's events or None.
    """
    viewer = Viewer(urdf=WAM, settings=Settings(), rrd=path, skill=skill)
    for tick, frame, timing in ticks(count):
        viewer.add(frame, at_ns(tick.index), timing, change(viewer, tick.index, frame) or ())
    viewer.close()
    return drawn(path)


def drawn_ticks(path: Path, curve: str) -> list[int]:
    """The ticks of a curve in a Rerun file, in order, without the rows that break it after a
    gap.
    """
    ticks: list[int] = []
    for chunk in rr.chunk.RrdReader(path).stream():
        rows = chunk.to_record_batch()
        if chunk.entity_path == curve and "tick" in rows.schema.names:
            drawn = zip(rows["tick"].to_pylist(), rows["Scalars:scalars"].to_pylist(), strict=True)
            ticks += [tick for tick, scalars in drawn if np.isfinite(scalars).all()]
    return ticks


def frames_of(path: Path) -> np.ndarray:
    """The recorded frames of a recording."""
    return np.array([step.frame for step in Recording.open(path).steps() if step.frame is not None])


def values(rows: list[dict[str, Any]], column: str) -> list[Any]:
    """The logged values of a column, in order."""
    return [row[column] for row in rows if row.get(column) is not None]


def views(container: Any) -> Iterator[Any]:
    """The views in a part of a blueprint, and in its parts."""
    for part in getattr(container, "contents", []):
        if hasattr(part, "origin"):
            yield part
        else:
            yield from views(part)


@contextlib.contextmanager
def copied(
    old: Recording, path: Path, *, whole: bool = True, **more: Any
) -> Iterator[tuple[Recorder, Iterator[tuple[Tick, Step]]]]:
    """A recorder of another recording with the same start, and the ticks and steps to write."""
    start, *steps = old.steps(whole=whole)
    common: dict[str, Any] = {"settings": old.settings, "skill": old.skill, "state": start.state}
    with Recorder(path, **common, **more) as recorder:
        yield recorder, zip(ticks_in(old), steps, strict=True)


def thin(whole: Path, path: Path, *, spoilt: int | None = None) -> Path:
    """A thin copy of a whole recording; the target of one tick may be changed."""
    old = Recording.open(whole)
    with copied(old, path, urdf=old.urdf, thin=True) as (recorder, steps):
        for tick, step in steps:
            assert step.frame is not None
            frame = step.frame.copy()
            frame["target"] += 1e-12 * (tick.index == spoilt)
            recorder.write(tick, frame, time_ns=step.time_ns, state=step.state, timing=step.timing)
    return path
