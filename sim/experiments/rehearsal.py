"""The closed loop in process, faster than real time: the service's core and its own loop, driven tick by tick with the PyBullet bench."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import msgspec
import numpy as np
from numpy.typing import NDArray

from service import wire
from service.commands import SHIPPED_SKILL, recordings
from service.config import Settings
from service.controller import Controller, run
from service.frame import FRAME, Event, Frame, Mode, Tick
from service.skill import Demonstrated, Skill
from sim.bench import Bench, Events
from sim.hands import Array, HandScript
from sim.live import SETTLE_S, STILL_S
from sim.scene import Scene
from sim.teach import demonstrations

HANDS_HZ = 100
TOLERANCE_M = 0.05
TREMOR_M, NOISE_M = 0.0015, 0.0005  # of the hands and of the tracker, each axis


@dataclass
class Rehearsed:
    """One run: how its events went, and what was seen at each tick, if that was kept. Arrays over T ticks."""

    events: Events
    held_s: float  # how long the service did not follow while the hands moved
    frames: NDArray[np.void] = field(default_factory=lambda: np.empty(0, FRAME))
    time_s: Array = field(default_factory=lambda: np.empty(0))  # of the script; 0 before it begins
    hands: Array = field(default_factory=lambda: np.empty((0, 2, 3)))  # as they are, without noise [m]
    tool: Array = field(default_factory=lambda: np.empty((0, 3)))  # as measured in the simulation [m]
    axis: Array = field(default_factory=lambda: np.empty((0, 3)))  # the tool's +z, as measured

    @property
    def errors_mm(self) -> tuple[float, float, float]:
        """Of handover, grasp and carry."""
        return tuple(getattr(self.events, name).error_mm for name in Events.__struct_fields__)


def rehearse(
    script: HandScript,
    skill_for: Callable[[Bench], Skill],
    *,
    rate_hz: int = 500,
    keep: bool = False,
    look: Callable[[Bench], None] = lambda bench: None,
    more: Callable[[Frame], tuple[Event, ...]] = lambda frame: (),
) -> Rehearsed:
    """One run of a script through core and physics. `look` is shown the bench after each tick; `keep` keeps what was seen.

    `more` makes further events of the newest frame, as often as hands are seen.
    """
    settings = msgspec.structs.replace(Settings(), rate_hz=rate_hz)
    frames: list[Frame] = []
    times: list[float] = []
    hands: list[Array] = []
    tool: list[tuple[float, ...]] = []
    axes: list[tuple[float, float, float]] = []
    held = 0
    with Bench(script, rate_hz=rate_hz) as bench:

        def tap(_: Tick, frame: Frame) -> None:
            nonlocal held
            newest[:] = [frame]
            held += bool(bench.time_s > 0 and frame["mode"] != Mode.FOLLOW)
            if keep:
                seen = bench.observe()
                frames.append(frame)
                times.append(bench.time_s)
                hands.append(np.stack([seen.hands.left.position, seen.hands.right.position]))
                tool.append(seen.tool.position)
                x, y, z, w = seen.tool.orientation
                axes.append((2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)))
            look(bench)

        newest: list[Frame] = []
        run(Controller(settings, skill_for(bench)), _ticks(bench, newest, more), [tap])
        result = Rehearsed(bench.events(), held * settings.period_s)
    if keep:
        result.frames, result.time_s, result.hands, result.tool = np.array(frames), np.array(times), np.array(hands), np.array(tool)
        result.axis = np.array(axes)
    return result


def _ticks(bench: Bench, newest: list[Frame], more: Callable[[Frame], tuple[Event, ...]]) -> Iterator[Tick]:
    """What the bench's hands and arm say, tick by tick, while it follows the newest frame: as on the network."""
    rate_hz = round(1 / bench.period_s)
    every, begun = rate_hz // HANDS_HZ, False
    while not bench.finished:
        waited_s = bench.tick * bench.period_s
        if not begun and waited_s >= SETTLE_S[0] and (waited_s >= SETTLE_S[1] or bench.still_s >= STILL_S):
            bench.begin()
            begun = True
        frame = newest[0] if newest else None
        if frame is not None and frame["commanded"]:
            seen = bench.step(tuple(frame["joints"].tolist()), tuple(frame["joint_velocities"].tolist()))
        else:
            seen = bench.step()
        inbox: list[Event] = []
        stamp_ns = bench.tick * round(bench.period_s * 1e9)
        if bench.tick % every == 0:
            for side, pose in zip(("left", "right"), bench.script.sample(bench.time_s), strict=True):
                x, y, z, *orientation = pose.tolist()
                inbox.append(Event(f"hands/{side}", b"", wire.PoseStamped(stamp_ns, wire.BASE, (x, y, z), tuple(orientation))))
            if frame is not None:
                inbox += more(frame)
            inbox.append(Event("joints/state", b"", wire.JointState(stamp_ns, wire.JOINT_NAMES, seen.joints, seen.joint_velocities)))
        yield Tick(bench.tick, tuple(inbox))


def shipped() -> Skill:
    """The skill that the service runs unless told otherwise."""
    path = recordings() / SHIPPED_SKILL
    return Skill.from_bytes(path.read_bytes(), origin=str(path))


def demonstrated(count: int, *, seed: int = 1) -> list[Demonstrated]:
    """Demonstrations of the nominal scene, 100 Hz; the first five of seed 1 are the shipped ones."""
    return [Demonstrated(np.hstack([d.left[:, :3], d.right[:, :3]]), d.tool, 0.01) for d in demonstrations(Scene(), count=count, seed=seed)]
