"""The closed loop in process, faster than real time: the service's core and loop, driven tick by
tick with the bench.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.contract.records import Mode
from service.core.controller import Controller, run
from service.core.frame import Frame, Tick
from service.core.skill.skill import Skill
from service.learning.demonstration import Demonstration
from service.settings.config import Settings, robot_description
from sim.bench import Bench, TaskEvents
from sim.closed_loop import ClosedLoop
from sim.experiments.catalogue import SHIPPED, Stream
from sim.scene import Scene
from sim.script import Array, HandScript
from sim.teach import demonstrate
from sim.world import World

TREMOR_M, NOISE_M = 0.0015, 0.0005  # of the hands and of the tracker, each axis


@dataclass
class Rehearsed:
    """One run: how its events went, and what was seen at each tick, if that was kept.

    Arrays over T ticks.
    """

    events: TaskEvents
    held_s: float  # how long the service did not follow while the hands moved
    frames: NDArray[np.void] = field(default_factory=lambda: np.empty(0, np.void))
    time_s: Array = field(default_factory=lambda: np.empty(0))  # of the script; 0 before it begins
    hands: Array = field(default_factory=lambda: np.empty((0, 2, 3)))  # as they are, without noise [m]
    joints: Array = field(default_factory=lambda: np.empty((0, 2, 0)))  # as measured [rad, rad/s]
    tool: Array = field(default_factory=lambda: np.empty((0, 3)))  # as measured in the simulation [m]
    axis: Array = field(default_factory=lambda: np.empty((0, 3)))  # the tool's +z, as measured

    @property
    def errors_mm(self) -> tuple[float, float, float]:
        """Of handover, grasp and carry."""
        return tuple(getattr(self.events, name).error_mm for name in TaskEvents.__struct_fields__)


def rehearse(
    script: HandScript,
    skill_for: Callable[[Bench], Skill],
    *,
    rate_hz: int | None = None,
    settings: Settings | None = None,
    world: type[World] | None = None,
    keep: bool = False,
    look: Callable[[Bench], None] = lambda bench: None,
) -> Rehearsed:
    """One run of a script through core and physics.

    `settings` name the arm and the rate (or else the shipped cell's), unless `rate_hz` is another;
    `world` is the physics, or else the first installed. `look` is shown the bench after each tick;
    `keep` keeps what was seen.
    """
    settings = settings or Settings()
    settings = msgspec.structs.replace(settings, rate_hz=rate_hz or settings.rate_hz)
    frames: list[Frame] = []
    times: list[float] = []
    hands: list[Array] = []
    joints: list[tuple[tuple[float, ...], ...]] = []
    tool: list[tuple[float, ...]] = []
    axes: list[tuple[float, float, float]] = []
    held = 0
    with Bench(script, settings=settings, world=world) as bench:

        def tap(_: Tick, frame: Frame) -> None:
            nonlocal held
            held += bool(bench.time_s > 0 and frame["mode"] != Mode.FOLLOW)
            if keep:
                seen = bench.observe()
                frames.append(frame)
                times.append(bench.time_s)
                hands.append(np.stack([seen.hands.left.position, seen.hands.right.position]))
                joints.append((seen.joints, seen.joint_velocities))
                tool.append(seen.tool.position)
                x, y, z, w = seen.tool.orientation
                axes.append((2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)))
            look(bench)

        loop = ClosedLoop(bench)
        run(Controller(settings, skill_for(bench), urdf=robot_description(settings)), loop.ticks(), [loop.follow, tap])
        result = Rehearsed(bench.events(), held * settings.period_s)
    if keep:
        result.frames, result.time_s, result.hands, result.tool = (
            np.array(frames),
            np.array(times),
            np.array(hands),
            np.array(tool),
        )
        result.axis, result.joints = np.array(axes), np.array(joints)
    return result


def demonstrated(stream: Stream = SHIPPED) -> list[Demonstration]:
    """Demonstrations of the nominal scene, 100 Hz."""
    return [demonstrate(Scene(), seed=1000 * stream.seed + n, begin_s=60 * n) for n in stream.numbers]
