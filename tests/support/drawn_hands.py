"""Two tables of small functions: motions of hands, and reports of a tracker.

A motion yields the positions of both hands (2, 3) [m], tick by tick, without end. A report turns
positions into samples of one tick. Any motion may be combined with any report.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

import numpy as np

from support.drawn_arms import ODD_NUMBERS
from thirdhand.contract.records import SIDES
from thirdhand.core.frame import Vector
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

Motion: TypeAlias = Iterator[Vector]
Sample: TypeAlias = tuple[str, Vector]  # side, position [m]

FASTEST_MPS = 1.2  # speed of a hand that chases the arm
BEHIND_M = np.array([[-0.3, -0.2, 0.4], [-0.3, 0.2, 0.4]])  # the robot's base
FAR_M = np.array([[4.99, 0.0, 0.0], [0.9, 4.9, 0.1]])  # positions up to 5 m are accepted
PHASES = np.arange(6.0).reshape(2, 3)


class Surroundings:
    """Inputs of a motion: the last commanded arm, and the demonstrated hands.

    `known` (M, 2, 3) [m]: demonstrated hands; `home` (2, 3) [m]: first position of the hands;
    `hands` (2, 3) [m]: present position; `tool` and `elbow` (3,) [m].
    """

    def __init__(
        self, random: np.random.Generator, period_s: float, known: Vector, tool: Vector
    ) -> None:
        self.random = random
        self.period_s = period_s
        self.known = known
        self.home = known[random.integers(len(known))]
        self.hands = self.home
        self.tool = tool
        self.elbow = tool

    def place(self, scatter_m: float) -> Vector:
        """A random position of both hands (2, 3) near a demonstrated one."""
        hands: Vector = self.known[self.random.integers(len(self.known))]
        return hands + self.random.normal(0.0, scatter_m, (2, 3))

    def size_m(self, least: float, most: float) -> float:
        """A random size between these, with equal probability for each order of magnitude."""
        return float(np.exp(self.random.uniform(np.log(least), np.log(most))))

    def ticks(self, seconds: float) -> int:
        """The number of ticks in a time, at least one."""
        return max(1, round(seconds / self.period_s))

    def seconds(self) -> Iterator[float]:
        """The time [s] since the start of a motion, tick by tick, without end."""
        tick = 0
        while True:
            yield tick * self.period_s
            tick += 1

    def reach(self, to: Vector, seconds: float) -> Motion:
        """A minimum-jerk motion from the present position."""
        begin = self.hands
        for u in np.linspace(0.0, 1.0, self.ticks(seconds) + 1)[1:]:
            yield begin + u**3 * (10.0 - 15.0 * u + 6.0 * u * u) * (to - begin)

    def wait(self, seconds: float) -> Motion:
        """Rest at the present position for a time."""
        hands = self.hands
        for _ in range(self.ticks(seconds)):
            yield hands


def rest(around: Surroundings) -> Motion:
    """Both hands rest at their present positions."""
    while True:
        yield around.hands


def reaches(around: Surroundings) -> Motion:
    """Both hands reach from one known position to the next, without a pause."""
    while True:
        yield from around.reach(around.place(0.02), 0.45)


def script(around: Surroundings) -> Motion:
    """The soldering task of the scripted person, again and again."""
    seed = int(around.random.integers(1000))
    speed = float(around.random.choice([0.5, 1.0, 2.0]))
    person = HandScript(Scene(), seed=seed, speed=speed)
    for t in around.seconds():
        left, right = person.sample(t % person.duration_s)
        yield np.array([left[:3], right[:3]])


def wander(around: Surroundings) -> Motion:
    """A random walk of 2 mm a tick and axis."""
    while True:
        yield around.hands + around.random.normal(0.0, 0.002, (2, 3))


def fly(around: Surroundings) -> Motion:
    """Straight motion at up to 3 m/s, reflected at the sides of a box."""
    lower = np.array([-0.5, -1.0, -0.2])
    upper = np.array([1.5, 1.0, 1.2])
    velocities = around.random.uniform(-1.7, 1.7, (2, 3))
    while True:
        goal = around.hands + velocities * around.period_s
        velocities = np.where((goal < lower) | (goal > upper), -velocities, velocities)
        yield np.clip(goal, lower, upper)


def tremble(around: Surroundings) -> Motion:
    """Oscillation by 0.5 to 100 mm at 1 to 12 Hz."""
    size_m = around.size_m(0.0005, 0.1)
    hz = around.random.uniform(1.0, 12.0)
    for t in around.seconds():
        yield around.home + size_m * np.sin(2 * np.pi * hz * t + PHASES)


def sines(around: Surroundings) -> Motion:
    """Sines of 8 cm, with a different frequency of up to 3.4 Hz on each axis."""
    hz = np.array([[0.3, 0.5, 0.8], [1.3, 2.1, 3.4]])
    for t in around.seconds():
        yield around.home + 0.08 * np.sin(2 * np.pi * t * hz)


def jitter(around: Surroundings) -> Motion:
    """White noise of 2 to 200 mm."""
    size_m = around.size_m(0.002, 0.2)
    while True:
        yield around.home + around.random.normal(0.0, size_m, (2, 3))


def alternate(around: Surroundings) -> Motion:
    """Two trackers with a difference of up to 0.5 m, which alternate."""
    offset_m = 0.5 * around.size_m(0.004, 0.5) * np.sign(around.random.normal(size=(2, 3)))
    while True:
        yield around.home + around.random.choice((-1.0, 1.0)) * offset_m


def leap(around: Surroundings) -> Motion:
    """Jumps to another known position, twice a second."""
    while True:
        hands = around.place(0.03)
        for _ in range(around.ticks(0.5)):
            yield hands


def leap_far(around: Surroundings) -> Motion:
    """Jumps of up to 3 m away and back, 0.3 s each."""
    while True:
        for offset_m in (around.random.uniform(-3.0, 3.0, (2, 3)), 0.0):
            for _ in range(around.ticks(0.3)):
                yield around.home + offset_m


def swap(around: Surroundings) -> Motion:
    """The hands change names five times a second."""
    while True:
        for hands in (around.home[::-1], around.home):
            for _ in range(around.ticks(0.2)):
                yield hands


def cross(around: Surroundings) -> Motion:
    """The hands change places within 1.5 s, one over the other, and come back."""
    left, right = around.home
    for t in around.seconds():
        u = 0.5 - 0.5 * np.cos(2 * np.pi * t / 3.0)
        yield np.array(
            [
                left + u * (right - left),
                right + u * (left - right) + (0.0, 0.0, 0.06 * np.sin(np.pi * u)),
            ]
        )


def merge(around: Surroundings) -> Motion:
    """Both hands in one moving point."""
    for t in around.seconds():
        yield np.tile(around.home[0] + 0.1 * np.sin(t + np.arange(3)), (2, 1))


def lift(around: Surroundings) -> Motion:
    """The left hand rises by 1 m within 1 s, and jumps down again."""
    for t in around.seconds():
        yield around.home + np.array([[0.0, 0.0, t % 1.0], [0.0, 0.0, 0.0]])


def leave(around: Surroundings) -> Motion:
    """Both hands move at the end of the range in which hands are accepted."""
    for t in around.seconds():
        yield FAR_M * np.cos(t)


def reach_behind(around: Surroundings) -> Motion:
    """Both hands behind the robot's base."""
    for t in around.seconds():
        yield BEHIND_M + 0.05 * np.sin(3.0 * t + PHASES)


def chase_tool(around: Surroundings) -> Motion:
    """The left hand follows the tool at up to 1.2 m/s."""
    while True:
        yield _toward(around, around.tool)


def chase_elbow(around: Surroundings) -> Motion:
    """The left hand follows the arm's elbow at up to 1.2 m/s."""
    while True:
        yield _toward(around, around.elbow)


def _toward(around: Surroundings, goal: Vector) -> Vector:
    left, right = around.hands
    delta = goal - left
    return np.array(
        [
            left
            + delta * min(1.0, FASTEST_MPS * around.period_s / max(np.linalg.norm(delta), 1e-9)),
            right,
        ]
    )


def thrust(around: Surroundings) -> Motion:
    """The right hand thrusts at the tool within 0.35 s, rests, and returns."""
    while True:
        back = around.hands
        yield from around.reach(
            np.array([back[0], around.tool + around.random.normal(0.0, 0.03, 3)]), 0.35
        )
        yield from around.wait(0.6)
        yield from around.reach(back, 0.25)


def pass_by(around: Surroundings) -> Motion:
    """The left hand passes the tool 6 cm away, at 1.2 m/s."""
    while True:
        for sign in (1.0, -1.0):
            path = np.array([0.0, sign * FASTEST_MPS, 0.0])
            right = around.hands[1]
            begin = around.tool + np.array([0.03, 0.0, 0.05]) - path
            for k in range(around.ticks(2.0)):
                yield np.array([begin + k * around.period_s * path, right])


def hold_tool(around: Surroundings) -> Motion:
    """The left hand is at the tool."""
    while True:
        yield np.array([around.tool + around.random.normal(0.0, 0.01, 3), around.hands[1]])


def poke_from_below(around: Surroundings) -> Motion:
    """The left hand moves up and down below the tool."""
    for t in around.seconds():
        below = np.array([0.0, 0.0, -0.15 + 0.1 * np.sin(6.0 * t)])
        yield np.array([around.tool + below, around.hands[1]])


MOTIONS: tuple[Callable[[Surroundings], Motion], ...] = (
    rest,
    reaches,
    reaches,
    script,
    script,
    wander,
    fly,
    tremble,
    sines,
    jitter,
    alternate,
    leap,
    leap_far,
    swap,
    cross,
    merge,
    lift,
    leave,
    reach_behind,
    chase_tool,
    chase_elbow,
    thrust,
    pass_by,
    hold_tool,
    poke_from_below,
)


def come_to_rest(around: Surroundings) -> Motion:
    """Both hands reach for a known position within 1 s, and rest there."""
    if np.linalg.norm(around.hands - around.home) > 1.0:
        around.hands = around.home
    yield from around.reach(around.place(0.0), 1.0)
    yield from rest(around)


Report: TypeAlias = Callable[[Vector, float, np.random.Generator], Sequence[Sample]]


def both(hands: Vector, seconds: float, random: np.random.Generator) -> Sequence[Sample]:
    """Both hands."""
    return list(zip(SIDES, hands, strict=True))


def none(hands: Vector, seconds: float, random: np.random.Generator) -> Sequence[Sample]:
    """Nothing."""
    return ()


def one_in_turns(hands: Vector, seconds: float, random: np.random.Generator) -> Sequence[Sample]:
    """The left and the right hand in turns, 0.7 s each."""
    side = int(seconds / 0.7) % 2
    return [(SIDES[side], hands[side])]


def dropouts(hands: Vector, seconds: float, random: np.random.Generator) -> Sequence[Sample]:
    """Nothing for 0.13 s of each 0.39 s."""
    return () if int(seconds / 0.13) % 3 == 1 else both(hands, seconds, random)


def losses(hands: Vector, seconds: float, random: np.random.Generator) -> Sequence[Sample]:
    """One sample of twenty is lost."""
    return [sample for sample in both(hands, seconds, random) if random.random() > 0.05]


def odd_numbers(hands: Vector, seconds: float, random: np.random.Generator) -> Sequence[Sample]:
    """Three samples of ten have tiny or huge numbers, or NaN."""
    return [
        (side, random.choice(ODD_NUMBERS, 3) if random.random() < 0.3 else hand)
        for side, hand in both(hands, seconds, random)
    ]


REPORTS: tuple[Report, ...] = (
    both,
    both,
    both,
    losses,
    losses,
    none,
    one_in_turns,
    dropouts,
    odd_numbers,
)
