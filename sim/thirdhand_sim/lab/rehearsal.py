"""The closed loop in process, faster than real time: the service's core and loop, driven tick by
tick with the bench.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from thirdhand.contract.records import Mode
from thirdhand.core.controller import Controller, run
from thirdhand.core.frame import Frame, Tick
from thirdhand.core.skill.skill import Skill
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.settings.config import Settings, robot_description
from thirdhand.skills.demonstration import Demonstration
from thirdhand_sim.bench import Bench, TaskEvents
from thirdhand_sim.closed_loop import ClosedLoop
from thirdhand_sim.lab.catalogue import SHIPPED_TAKES, Stream
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import Array, HandScript
from thirdhand_sim.teach import demonstrate
from thirdhand_sim.world import World

# deviations of hands and tracker, each axis
TREMOR_M = 0.0015
SESSION_NOISE_M = 0.0005


@dataclass(frozen=True)
class Rehearsed:
    """The events of a run, and, if requested, arrays over its T ticks."""

    events: TaskEvents
    held_s: float  # time in which the service did not follow while the hands moved
    frames: NDArray[np.void]
    time_s: Array  # of the script; 0 before it begins
    hands: Array  # (T, 2, 3) true positions, without noise [m]
    joints: Array  # (T, 2, J) measured [rad, rad/s]
    tool: Array  # (T, 3) measured in the simulation [m]
    axis: Array  # (T, 3) the tool's measured +z

    @property
    def errors_mm(self) -> tuple[float, float, float]:
        """The errors of handover, grasp and carry [mm]."""
        return tuple(getattr(self.events, name).error_mm for name in TaskEvents.__struct_fields__)


def rehearse(
    script: HandScript,
    skill_for: Callable[[Bench], Skill],
    *,
    rate_hz: int | None = None,
    settings: Settings | None = None,
    world: type[World] | None = None,
    tuning: Tuning = TUNING,
    keep: bool = False,
    look: Callable[[Bench], None] = lambda bench: None,
) -> Rehearsed:
    """One run of a script through core and physics.

    `settings` name the arm and the rate (default: the shipped cell's); `rate_hz` overrides the
    rate; `world` is the physics (default: the first installed). `look` is called with the bench
    after each tick; `keep` requests the arrays.
    """
    settings = settings or Settings()
    settings = msgspec.structs.replace(settings, rate_hz=rate_hz or settings.rate_hz)
    rows: list[tuple[Any, ...]] = []
    held = 0
    with Bench(script, settings=settings, world=world) as bench:

        def tap(_: Tick, frame: Frame) -> None:
            nonlocal held
            held += bool(bench.time_s > 0 and frame["mode"] != Mode.FOLLOW)
            if keep:
                observation = bench.observe()
                x, y, z, w = observation.tool.orientation
                axis = (2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y))
                hands = np.stack(
                    [observation.hands.left.position, observation.hands.right.position]
                )
                joints = (observation.joints, observation.joint_velocities)
                rows.append((frame, bench.time_s, hands, joints, observation.tool.position, axis))
            look(bench)

        loop = ClosedLoop(bench)
        controller = Controller(
            settings, skill_for(bench), urdf=robot_description(settings), tuning=tuning
        )
        run(controller, loop.ticks(), [loop.follow, tap])
        arrays = [np.array(column) for column in zip(*rows, strict=True)] or [np.empty(0)] * 6
        return Rehearsed(bench.events(), held * settings.period_s, *arrays)


def demonstrated(stream: Stream = SHIPPED_TAKES) -> list[Demonstration]:
    """Demonstrations of the nominal scene at 100 Hz."""
    return [
        demonstrate(Scene(), seed=1000 * stream.seed + n, begin_s=60 * n) for n in stream.numbers
    ]
