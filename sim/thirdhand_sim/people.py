"""Modelled people at the soldering bench: their habits, their trackers, and the places of things.

Each person depends only on a number. There are disjoint groups of people: for demonstrations, for
tuning of parameters, for tests, and for synthetic tasks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from thirdhand_sim.scene import RIGHT_FROM_OBJECT, TOOL_FROM_OBJECT
from thirdhand_sim.script import Array

Group: TypeAlias = Literal["demonstrations", "tuning", "test", "made"]
GROUP_SEEDS = {"demonstrations": 1, "tuning": 2, "test": 3, "made": 4}
PROJECT_SEED = 2024
LEAST_DWELL_S = 0.9
MOST_DWELL_S = 1.8
LONGEST_LEAD_S = 2.0
# standard deviation per axis of a hand in the air, at the board, at the iron
HABITS_M = (0.020, 0.008, 0.008)


class Places(NamedTuple):
    """The true or perceived positions of things [m], (3,) each, with the error `std_m`, 3-D rms."""

    left_start: Array
    right_start: Array
    handover: Array
    glass: Array
    board: Array
    iron: Array
    robot_start: Array
    std_m: float = 0.0

    @property
    def right_final(self) -> Array:
        """Final position of the right hand with the iron (3,) [m]."""
        return self.board + RIGHT_FROM_OBJECT

    @property
    def carry(self) -> Array:
        """Position of the tool that holds the glass (3,) [m]."""
        return self.board + TOOL_FROM_OBJECT

    def perceived(self, sigma_m: float, random: np.random.Generator) -> Places:
        """The perceived places with errors of `sigma_m` (3-D rms), except the robot's own place."""
        errors_m = sigma_m / np.sqrt(3.0) * random.standard_normal((6, 3))
        left_start, right_start, handover, glass, board, iron = np.array(self[:6]) + errors_m
        return Places(
            left_start, right_start, handover, glass, board, iron, self.robot_start, sigma_m
        )


class TrackerModel(NamedTuple):
    """A model of a tracker: its rate, noise per axis, and rates of jumps and dropouts."""

    rate_hz: float = 100.0
    noise_m: float = 0.0005
    jumps_hz: float = 0.0
    dropouts_hz: float = 0.0
    residual: Array | None = None  # (M, 6) [m] recorded noise, used instead of `noise_m`


class Person(NamedTuple):
    """A person's habits. Lengths in metres, (6,) or (2, 3) for the left and then the right hand."""

    name: str
    start: Array  # (2, 3) offset of the hands' start from the nominal start
    reach: Array  # (3, 3) constant offset of the hands at handover, board and iron
    scatter: float  # standard deviation of these offsets per axis
    bows: Array  # (2, 2, 3) bows of the two legs of each hand
    speed: float
    skew: float
    correction: float  # share of a path that a second, slower motion covers
    lead_s: float  # lead of the right hand
    dwells: tuple[float, float]  # [s] shortest and longest rest of hands at a place
    haste: float  # duration of the right hand's motion to the iron / that of the left hand's motion
    sway: float  # rms of a waiting hand's sway per axis
    strays: float  # probability that a waiting hand makes another motion
    tremor: float
    tracker: TrackerModel
    mistakes: float = 0.25  # probability of a mistake in a session
    shapes: Sequence[
        tuple[Array, Array]
    ] = ()  # recorded reaches along x: shares (M,), deviations (M, 3) per metre


def person(group: Group, number: int) -> Person:
    """One of a group's people."""
    random = np.random.default_rng([PROJECT_SEED, GROUP_SEEDS[group], number])
    rate = (30.0, 60.0, 120.0)[number % 3]
    bow = random.standard_normal((2, 2, 3))
    bow[..., 2] += 0.7
    bow *= random.uniform(0.0, 0.10, (2, 2, 1)) / np.linalg.norm(bow, axis=2, keepdims=True)
    bow[..., 2] = np.abs(bow[..., 2])  # paths are bowed upward
    return Person(
        name=f"{group} {number + 1}",
        start=np.clip(0.04 * random.standard_normal((2, 3)), -0.1, 0.1) * (1.0, 1.0, 0.5)
        + (0.0, 0.0, 0.01),
        reach=random.standard_normal((3, 3)) * np.array(HABITS_M)[:, None],
        scatter=float(random.uniform(0.005, 0.012)),
        bows=bow,
        speed=float(2 ** random.uniform(-0.6, 0.5)),
        skew=float(random.uniform(-0.35, 0.35)),
        correction=float(random.uniform(0.0, 0.12)),
        lead_s=float(random.uniform(-LONGEST_LEAD_S, LONGEST_LEAD_S)),
        dwells=(LEAST_DWELL_S, MOST_DWELL_S),
        haste=float(random.uniform(0.4, 1.0)),
        sway=float(random.uniform(0.001, 0.004)),
        strays=float(random.uniform(0.0, 0.6)),
        tremor=float(random.uniform(0.0003, 0.0012)),
        tracker=TrackerModel(
            rate,
            float(random.uniform(0.001, 0.003)),
            float(random.uniform(0, 0.4)),
            float(random.uniform(0, 0.1)),
        ),
    )


PLAIN_PERSON = Person(
    name="plain",
    start=np.zeros((2, 3)),
    reach=np.zeros((3, 3)),
    scatter=0.008,
    bows=np.zeros((2, 2, 3)),
    speed=1.0,
    skew=0.0,
    correction=0.0,
    lead_s=0.0,
    dwells=(0.6, 0.6),
    haste=1.0,
    sway=0.0015,
    strays=0.0,
    tremor=0.0005,
    tracker=TrackerModel(),
    mistakes=0.0,
)
