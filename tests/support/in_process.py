"""Sessions in process: the core, driven tick by tick by the bench or by hands alone,
faster than real time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import msgspec
import numpy as np

from service.core.controller import Controller, run
from service.core.frame import Event, Frame, Tick
from service.settings.config import Settings
from sim.closed_loop import hand_event, joints_event
from sim.script import HandScript
from support.wam import JOINT_NAMES

ASSUMED = msgspec.structs.replace(Settings(), arm=msgspec.structs.replace(Settings().arm, source="assumed"))
LEFT, RIGHT = (0.98, -0.32, 0.06), (0.98, 0.32, 0.06)  # where the hands rest [m]


def hand(side: str, position: tuple[float, float, float], stamp_ns: int) -> Event:
    """A hand's sample as an event."""
    return hand_event(side, position, stamp_ns)


def arm(joints: tuple[float, ...], stamp_ns: int, velocities: tuple[float, ...] = (0.0,) * 7) -> Event:
    """The arm's sample as an event."""
    return joints_event(JOINT_NAMES, joints, velocities, stamp_ns)


def ticks_of(
    script: HandScript, *, wait_s: float = 1.5, tail_s: float = 0.5, period_s: float = 0.002, every: int = 5
) -> Iterator[Tick]:
    """Ticks with the script's hands, which first rest at their start for a while."""
    for k in range(round((wait_s + script.duration_s + tail_s) / period_s)):
        t = max(0.0, k * period_s - wait_s)
        poses = [tuple(pose[:3].tolist()) for pose in script.sample(t)] if k % every == 0 else []
        yield Tick(k, tuple(hand(side, pose, 1 + k) for side, pose in zip(("left", "right"), poses, strict=False)))


def resting(
    first: int, count: int, extra: Callable[[int], tuple[Event, ...]] = lambda k: (), *, every: int = 5
) -> list[Tick]:
    """Ticks with both hands resting at their start."""
    return [
        Tick(k, (*((hand("left", LEFT, k + 1), hand("right", RIGHT, k + 1)) if k % every == 0 else ()), *extra(k)))
        for k in range(first, first + count)
    ]


def frames(controller: Controller, ticks: Iterator[Tick] | list[Tick]) -> np.ndarray:
    """The frames (T,) of a controller that steps through ticks."""
    out: list[Frame] = []
    run(controller, ticks, [lambda _, frame: out.append(frame)])
    return np.array(out)
