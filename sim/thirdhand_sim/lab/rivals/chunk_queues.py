"""Queues between a policy that answers in chunks and an arm, as rivals of the wishes in `seams`.

A chunk is a list of positions with the times at which they are due. All queues know these times,
so that none has to estimate a delay; they differ in what they do where chunks overlap. Behind each,
the inverse kinematics and Ruckig on the joints at the cell's limits move the arm.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from ruckig import InputParameter, Ruckig, Synchronization, Trajectory

from thirdhand.core.arm.stage import ArmStage
from thirdhand.settings.config import Settings, robot_description
from thirdhand_sim.lab.people.moving_hands import PERIOD_S
from thirdhand_sim.lab.results import Array

# of the inverse kinematics
MOST_STEPS = 40
SOLVED_M = 1e-4


class Chunk(NamedTuple):
    """Positions (H, 3) [m] that a policy wants, and when they are due (H,) [s]."""

    due_s: Array
    positions: Array

    def at(self, now_s: float) -> Array:
        """The position at a time, on straight lines; before and after the chunk it rests."""
        return np.array([np.interp(now_s, self.due_s, axis) for axis in self.positions.T])


class Queue(Protocol):
    """What the tool is to do, from the chunks that have arrived."""

    def take(self, chunk: Chunk, now_s: float) -> None:
        """Take a chunk that arrives now."""

    def wanted(self, now_s: float) -> Array | None:
        """The position (3,) [m] for now; None before the first chunk."""


class Averaged:
    """The newest chunk, averaged with the one before where they overlap; a `share` of 1 replaces
    it (the queue of LeRobot's asynchronous client, and its `aggregate_fn`).
    """

    def __init__(self, share: float) -> None:
        self._share = share
        self._chunk: Chunk | None = None

    def take(self, chunk: Chunk, now_s: float) -> None:
        before = self._chunk
        if before is not None and self._share < 1.0:
            old = np.array([before.at(due_s) for due_s in chunk.due_s])
            overlaps = (chunk.due_s <= before.due_s[-1])[:, None]
            mixed = (1.0 - self._share) * old + self._share * chunk.positions
            chunk = Chunk(chunk.due_s, np.where(overlaps, mixed, chunk.positions))
        self._chunk = chunk

    def wanted(self, now_s: float) -> Array | None:
        return None if self._chunk is None else self._chunk.at(now_s)


class Ensemble:
    """The mean of all chunks that have a position for now, with weights exp(-m i), i = 0 for the
    oldest (Zhao and others, RSS 2023); after the end of all, the newest one rests.
    """

    def __init__(self, m: float) -> None:
        self._m = m
        self._chunks: list[Chunk] = []

    def take(self, chunk: Chunk, now_s: float) -> None:
        self._chunks = [kept for kept in self._chunks if kept.due_s[-1] >= now_s] + [chunk]

    def wanted(self, now_s: float) -> Array | None:
        if not self._chunks:
            return None
        known = [chunk for chunk in self._chunks if now_s <= chunk.due_s[-1]] or self._chunks[-1:]
        weights = np.exp(-self._m * np.arange(len(known)))
        positions = np.array([chunk.at(now_s) for chunk in known])
        return np.asarray(weights @ positions / weights.sum())


class Aligned:
    """The newest chunk, shifted to where the command was when it came; the shift fades out evenly
    within `fade_s`.
    """

    def __init__(self, fade_s: float) -> None:
        self._fade_s = fade_s
        self._chunk: Chunk | None = None
        self._shift = np.zeros(3)
        self._since_s = -math.inf

    def take(self, chunk: Chunk, now_s: float) -> None:
        before = self.wanted(now_s)
        self._chunk = chunk
        self._since_s = now_s
        if before is not None:
            self._shift = before - chunk.at(now_s)

    def wanted(self, now_s: float) -> Array | None:
        if self._chunk is None:
            return None
        stays = max(1.0 - (now_s - self._since_s) / self._fade_s, 0.0)
        return self._chunk.at(now_s) + stays * self._shift


class QueuedArm:
    """An arm behind a queue, tick by tick."""

    def __init__(self, queue: Queue, settings: Settings, orientation: Array) -> None:
        self._queue = queue
        self._arm = ArmStage(settings, robot_description(settings))
        self._orientation = orientation
        self._reference = np.array(settings.arm.posture)
        size = len(self._reference)
        self._solver = Ruckig(size, PERIOD_S)
        question = InputParameter(size)
        joints = settings.joints
        question.synchronization = Synchronization.No
        question.max_velocity = list(joints.velocity)
        question.max_acceleration = list(joints.acceleration)
        question.max_jerk = list(joints.jerk)
        question.target_velocity = question.target_acceleration = [0.0] * size
        self._question = question
        self._profile = Trajectory(size)
        self._joints = np.stack([self._reference, *np.zeros((2, size))])

    @property
    def tool(self) -> Array:
        """The tool's position (3,) [m]."""
        return np.array(self._arm.at(self._joints[0]).position)

    def take(self, chunk: Chunk, now_s: float) -> None:
        """Take a chunk that arrives now."""
        self._queue.take(chunk, now_s)

    def step(self, now_s: float) -> Array:
        """Move for one period. Returns the joints' motion (3, J)."""
        wanted = self._queue.wanted(now_s)
        if wanted is not None:
            self._solve(wanted)
        question = self._question
        question.current_position, question.current_velocity, question.current_acceleration = (
            self._joints.tolist()
        )
        question.target_position = self._reference.tolist()
        self._solver.calculate(question, self._profile)
        self._joints = np.array(self._profile.at_time(PERIOD_S))
        return self._joints

    def _solve(self, wanted: Array) -> None:
        """Solve the inverse kinematics for a position, without the limits of joints' speeds."""
        for _ in range(MOST_STEPS):
            if np.linalg.norm(self._arm.at(self._reference).position - wanted) < SOLVED_M:
                return
            solution = self._arm.step(self._reference, wanted, np.zeros(3), self._orientation)
            self._reference = self._reference + PERIOD_S * solution.velocity


QUEUES: dict[str, tuple[Callable[[float], Queue], tuple[float, ...]]] = {
    "replaced": (Averaged, (1.0,)),
    "weighted average": (Averaged, (0.3, 0.5, 0.7)),
    "temporal ensemble": (Ensemble, (-0.5, -0.1, 0.01, 0.1, 0.5)),
    "aligned and faded": (Aligned, (0.1, 0.2, 0.4, 0.8, 1.6)),
}
"""Rivals: their queue, by a number, and the numbers that are tried."""
