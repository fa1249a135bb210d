"""Sessions of modelled people: the motions of their hands in a scene, the samples of a tracker, and
the tool as led by a teacher who knows the scene. Each depends only on its numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from thirdhand_sim.people import (
    GROUP_SEEDS,
    LONGEST_LEAD_S,
    PLAIN_PERSON,
    PROJECT_SEED,
    Group,
    Person,
    Places,
    person,
)
from thirdhand_sim.scene import MOST_MOVED, TOOL_FROM_HAND, Scene
from thirdhand_sim.script import TOOL_ARCS, Array

REST_S = 1.0  # rest before the first motion
LAST_S = 1.6  # rest after the last motion
PHASES_S = (3.0, 3.5, 3.0)  # durations of the motions at a speed of 1
MIN_HAND_HEIGHT_M = 0.03  # least height above the table
SHAPE_STEPS = 200  # length of the table of a path's shape
TEACHERS_SCATTER_M = 0.005  # standard deviation of the teacher's places per axis
TEACHERS_LAG_S = 0.1  # longest delay of the teacher
SESSION_EVENTS = ("handover", "glass", "soldering")
MISTAKES = ("board first", "handover again", "iron again", "solder again", "right to the board")
BREAKING = (
    "hands stop 24 mm off",
    "hands start 15 cm elsewhere",
    "paths bowed by 10 cm",
    "right hand 2 s early",
    "iron 10 cm elsewhere",
)


class Leg(NamedTuple):
    """A motion of one hand: its ends (3,) [m], tables of the covered share of the path (M,) and of
    the deviation from a straight line (M, 3) [m], and the progress of the task at its ends.
    """

    begin_s: float
    lasts_s: float
    start: Array
    end: Array
    share: Array
    deviation: Array
    progress: tuple[float, float]

    @property
    def end_s(self) -> float:
        """End of the motion [s]."""
        return self.begin_s + self.lasts_s


@dataclass(frozen=True, eq=False)
class Session:
    """One run: the motions of a person's hands in a scene, and its true and perceived places."""

    person: Person
    number: int
    places: Places  # true places
    told: Places  # perceived places
    legs: tuple[tuple[Leg, ...], tuple[Leg, ...]]
    # [s] times in which the tool must be at each of SESSION_EVENTS
    windows: tuple[tuple[float, float], ...]
    lasts_s: float
    seed: tuple[int, ...]
    mistake: str = ""

    def hands(self, times: Array) -> Array:
        """True positions of both hands (T, 6) [m]."""
        return np.hstack([along(self.legs[side], times)[0] for side in (0, 1)]) + sum(
            restless(self.person, self.seed, times)
        )

    def progress(self, times: Array) -> Array:
        """Progress of the task by each hand (T, 2): 0 at the start, 1 and 2 at the ends of the
        legs.
        """
        return np.stack([along(self.legs[side], times)[1] for side in (0, 1)], axis=1)

    def tool(self, times: Array, *, off: Array | None = None) -> Array:
        """The tool's positions (T, 3) [m], led by a teacher who knows the scene and the progress of
        the hands.

        It moves to the left hand while that reaches for the board, fetches the glass while the left
        hand takes the board away, and brings the glass while the right hand brings the iron. `off`
        (4, 3) [m] moves the ends.
        """
        left, right = self.progress(times).T
        handed = self.legs[0][self._leg_to_handover()].end + TOOL_FROM_HAND
        ends = np.array([self.places.robot_start, handed, self.places.glass, self.places.carry])
        ends = ends if off is None else ends + off
        shares = np.clip(np.stack([left, left - 1.0, right - 1.0], axis=1), 0.0, 1.0)
        bumps = (4.0 * shares * (1.0 - shares)) ** 2
        with_hand = (shares[:, :1] - shares[:, 1:2]) * restless(self.person, self.seed, times)[0][
            :, :3
        ]
        return np.asarray(
            ends[0] + shares @ np.diff(ends, axis=0) + bumps @ np.array(TOOL_ARCS) + with_hand
        )

    def samples(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """The tracked samples of the left and the right hand: times (M,) [s], positions (M, 3)
        [m].
        """
        tracker = self.person.tracker
        random = np.random.default_rng([*self.seed, 1])
        stamps = np.arange(0.0, self.lasts_s, 1.0 / tracker.rate_hz)
        positions = self.hands(stamps)
        if tracker.residual is None:
            positions = positions + tracker.noise_m * random.standard_normal(positions.shape)
        else:
            begin = int(random.integers(len(tracker.residual)))
            positions = (
                positions
                + tracker.residual[(begin + np.arange(len(stamps))) % len(tracker.residual)]
            )
        keep = np.ones((len(stamps), 2), bool)
        for side in (0, 1):
            part = slice(3 * side, 3 * side + 3)
            for index in np.flatnonzero(
                random.random(len(stamps)) < tracker.jumps_hz / tracker.rate_hz
            ):
                positions[index : index + int(random.integers(1, 3)), part] += (
                    0.04 * random.standard_normal(3)
                )
            for index in np.flatnonzero(
                random.random(len(stamps)) < tracker.dropouts_hz / tracker.rate_hz
            ):
                keep[index : index + int(0.1 * 10 ** random.random() * tracker.rate_hz), side] = (
                    False
                )
        return (stamps[keep[:, 0]], positions[keep[:, 0], :3]), (
            stamps[keep[:, 1]],
            positions[keep[:, 1], 3:],
        )

    def _leg_to_handover(self) -> int:
        return max(i for i, leg in enumerate(self.legs[0]) if leg.progress[1] == 1.0)


def along(legs: Sequence[Leg], times: Array) -> tuple[Array, Array]:
    """Positions (T, 3) [m] of a hand on these legs, and the progress of the task (T,)."""
    x = np.tile(legs[0].start, (len(times), 1))
    progress = np.full(len(times), float(legs[0].progress[0]))
    for leg in legs:
        on = times >= leg.begin_s
        u = np.clip((times[on] - leg.begin_s) / leg.lasts_s, 0.0, 1.0)
        grid = np.linspace(0.0, 1.0, len(leg.share))
        share = np.interp(u, grid, leg.share)
        deviation = np.stack([np.interp(u, grid, column) for column in leg.deviation.T], axis=1)
        x[on] = leg.start + share[:, None] * (leg.end - leg.start) + deviation
        done = np.clip(share, 0.0, 1.0)
        progress[on] = leg.progress[0] + done * (leg.progress[1] - leg.progress[0])
    return x, progress


def restless(who: Person, seed: Sequence[int], times: Array) -> tuple[Array, Array]:
    """Sway and tremor of both hands, (T, 6) [m] each."""
    random = np.random.default_rng([*seed, 2])

    def waves(rms: float, low: float, high: float) -> Array:
        hz = random.uniform(low, high, (4, 1, 6))
        phases = random.uniform(0, 2 * np.pi, (4, 1, 6))
        return np.asarray(
            rms * np.sqrt(0.5) * np.sin(2 * np.pi * hz * times[:, None] + phases).sum(axis=0)
        )

    return waves(who.sway, 0.1, 0.5), waves(who.tremor, 8.0, 10.0)


def session(
    who: Person, number: int, *, group: Group, sigma_m: float = 0.0, moved_m: float = MOST_MOVED
) -> Session:
    """A person's run in a scene whose things are up to `moved_m` away from their nominal places and
    are perceived with an error of `sigma_m` (3-D rms).
    """
    seed = (
        PROJECT_SEED,
        GROUP_SEEDS[group],
        int("".join(c for c in who.name if c.isdigit()) or 0),
        number + 1,
    )
    random = np.random.default_rng(seed)
    scene = Scene()
    usual = (scene.handover, scene.glass, scene.soldering, scene.iron)
    handover, glass, board, iron = (_moved(np.array(place), moved_m, random) for place in usual)
    left, right = np.array([scene.left_start, scene.right_start]) + who.start
    places = Places(left, right, handover, glass, board, iron, np.array(scene.robot_start))
    mistake = str(random.choice(MISTAKES)) if random.random() < who.mistakes else ""
    lead = float(
        np.clip(who.lead_s + 0.3 * random.standard_normal(), -LONGEST_LEAD_S, LONGEST_LEAD_S)
    )
    perceived = places.perceived(sigma_m, random)
    return played(who._replace(lead_s=lead), number, places, perceived, seed=seed, mistake=mistake)


def played(
    who: Person,
    number: int,
    places: Places,
    told: Places,
    *,
    seed: tuple[int, ...],
    mistake: str = "",
) -> Session:
    """A person's run with these places, and with one of MISTAKES or none."""
    random = np.random.default_rng([*seed, 3])
    scatter = who.scatter * random.standard_normal((2, 3, 3))
    at_handover, at_board, at_iron = who.reach
    left = (
        np.array([places.left_start, places.handover + at_handover, places.board + at_board])
        + scatter[0]
    )
    right = (
        np.array([places.right_start, places.iron + at_iron, places.right_final + at_iron])
        + scatter[1]
    )
    left[:, 2] = np.maximum(left[:, 2], MIN_HAND_HEIGHT_M)
    right[:, 2] = np.maximum(right[:, 2], MIN_HAND_HEIGHT_M)
    lasts = np.array(PHASES_S) / who.speed * random.uniform(0.85, 1.15, 3)
    dwell = random.uniform(*who.dwells, 2)
    hands: tuple[list[Leg], list[Leg]] = ([], [])

    def go(
        side: int,
        at: float,
        lasts_s: float,
        ends: Array,
        progress: tuple[float, float],
        *,
        leg: int | None = None,
    ) -> float:
        share, deviation = shape(who, ends, None if leg is None else who.bows[side, leg], random)
        hands[side].append(Leg(at, lasts_s, ends[0], ends[1], share, deviation, progress))
        return at + lasts_s

    def there_and_back(
        side: int, at: float, here: Array, there: Array, progress: tuple[float, float]
    ) -> float:
        lasts_s = 0.9 + 2.0 * float(np.linalg.norm(there - here))
        at = go(side, at, lasts_s, np.array([here, there]), progress)
        return go(side, at + 0.1, lasts_s, np.array([there, here]), progress[::-1])

    start_s = REST_S
    if mistake == "board first":
        start_s = (
            there_and_back(0, start_s, left[0], left[0] + 0.7 * (left[2] - left[0]), (0.0, 0.0))
            + 0.2
        )
    if mistake == "right to the board":
        there_and_back(1, start_s, right[0], right[0] + 0.7 * (right[2] - right[0]), (0.0, 0.0))
        start_s += 1.0  # the left hand waits for the right one
    elif random.random() < who.strays:
        stray = right[0] + random.uniform(-0.1, 0.1, 3) * (1.0, 1.0, 0.3)
        there_and_back(1, start_s + random.uniform(0.0, lasts[0]), right[0], stray, (0.0, 0.0))
    handover_s = go(0, start_s, lasts[0], left[:2], (0.0, 1.0), leg=0)
    if mistake == "handover again":
        handover_s = there_and_back(
            0, handover_s + 0.5, left[1], left[1] + 0.6 * (left[0] - left[1]), (1.0, 0.4)
        )
    taken = handover_s + dwell[0]
    brought = go(0, taken, lasts[1], left[1:], (1.0, 2.0), leg=1)
    begin = max([taken - who.lead_s, *(leg.end_s + 0.1 for leg in hands[1])])
    fetched = go(1, begin, who.haste * lasts[1], right[:2], (0.0, 1.0), leg=0)
    if mistake == "iron again":
        fetched = there_and_back(1, fetched + 0.3, right[1], right[0], (1.0, 0.0))
    leaves = max(brought, fetched) + dwell[1]
    soldered = go(1, leaves, lasts[2], right[1:], (1.0, 2.0), leg=1)
    if mistake == "solder again":
        soldered = there_and_back(
            1, soldered + 0.8, right[2], right[2] + 0.5 * (right[1] - right[2]), (2.0, 1.5)
        )
    end = soldered + LAST_S
    windows = ((handover_s, taken), (max(brought, fetched), leaves), (soldered, end))
    return Session(
        who,
        number,
        places,
        told,
        (tuple(hands[0]), tuple(hands[1])),
        windows,
        end,
        seed,
        mistake,
    )


class SessionDemonstration(NamedTuple):
    """A demonstration: times (T,) [s], tracked hands (T, 6) [m], tool (T, 3) [m], and the perceived
    places.
    """

    times: Array
    hands: Array
    tool: Array
    places: Places


def demonstration(run: Session, *, rate_hz: float = 25.0) -> SessionDemonstration:
    """The demonstration of a run in which a teacher leads the tool with a small delay and an error
    of some millimetres.
    """
    random = np.random.default_rng([*run.seed, 4])
    lag = TEACHERS_LAG_S * random.random()
    scatter_m = TEACHERS_SCATTER_M * random.standard_normal((4, 3))
    times = np.arange(0.2, run.lasts_s - 0.05, 1.0 / rate_hz)
    hands = [
        np.interp(times, stamps, column)
        for stamps, positions in run.samples()
        for column in positions.T
    ]
    return SessionDemonstration(
        times, np.stack(hands, axis=1), run.tool(times - lag, off=scatter_m), run.told
    )


def demonstrations(people: int, *, sigma_m: float = 0.005) -> list[SessionDemonstration]:
    """Two demonstrations of each person, with things in their nominal places and with things moved
    by up to 10 cm. There are no mistakes, because a person repeats a failed demonstration.
    """
    careful = [person("demonstrations", number)._replace(mistakes=0.0) for number in range(people)]
    return [
        demonstration(
            session(subject, number, group="demonstrations", sigma_m=sigma_m, moved_m=moved)
        )
        for subject in careful
        for number, moved in enumerate((0.0, 0.10))
    ]


def breaking(kind: str, number: int, *, group: Group) -> Session:
    """A run that differs from the demonstrations by one of BREAKING, with exactly perceived places.

    The hands are those of the bench: synchronous, straight, at an even speed, with a good tracker.
    If the iron is elsewhere, the perceived places do not show it: only the hands move there.
    """
    seed = (PROJECT_SEED, GROUP_SEEDS[group], 1000 + BREAKING.index(kind), number)
    random = np.random.default_rng(seed)
    scene = Scene()
    subject = PLAIN_PERSON
    usual = (scene.handover, scene.glass, scene.soldering)
    handover, glass, board = (_moved(np.array(place), MOST_MOVED, random) for place in usual)
    starts = np.array(scene.left_start), np.array(scene.right_start)
    perceived = places = Places(
        *starts, handover, glass, board, np.array(scene.iron), np.array(scene.robot_start)
    )
    if kind == BREAKING[0]:
        subject = subject._replace(scatter=0.024)
    elif kind == BREAKING[1]:
        left, right = (_away(start, 0.15, random) for start in starts)
        places = perceived._replace(left_start=left, right_start=right)
    elif kind == BREAKING[2]:
        bows = random.standard_normal((2, 2, 3))
        bows[..., 2] = np.abs(bows[..., 2])
        subject = subject._replace(bows=0.10 * bows / np.linalg.norm(bows, axis=2, keepdims=True))
    elif kind == BREAKING[3]:
        subject = subject._replace(lead_s=2.0)
    else:
        places = perceived._replace(iron=_away(perceived.iron, 0.10, random))
    return played(subject, number, places, perceived, seed=seed)


def _moved(place: Array, most_m: float, random: np.random.Generator) -> Array:
    """A random place in a ball around a place, and high enough above the table."""
    while True:
        step = random.uniform(-1.0, 1.0, 3)
        if np.linalg.norm(step) < 0.999 and place[2] + most_m * step[2] >= 0.05:
            return np.asarray(place + most_m * step)


def _away(place: Array, distance_m: float, random: np.random.Generator) -> Array:
    """A random place at a distance from a place, and above the table."""
    while True:
        direction = random.standard_normal(3) * (1.0, 1.0, 0.5)
        candidate = place + distance_m * direction / np.linalg.norm(direction)
        if candidate[2] >= MIN_HAND_HEIGHT_M:
            return np.asarray(candidate)


def shape(
    who: Person, ends: Array, bow: Array | None, random: np.random.Generator
) -> tuple[Array, Array]:
    """The tables of a leg between ends (2, 3) [m]: shares of the path (M,), deviations (M, 3)
    [m].
    """
    chord = ends[1] - ends[0]
    length = float(np.linalg.norm(chord))
    if who.shapes and bow is not None:
        share, profile = who.shapes[int(random.integers(len(who.shapes)))]
        deviation = length * profile @ _turn_from_x(chord / length).T
        return share, deviation * min(1.0, 0.12 / max(float(np.abs(deviation).max()), 1e-9))
    u = np.linspace(0.0, 1.0, SHAPE_STEPS)
    u = u + who.skew * u * (1.0 - u)
    share = (1.0 - who.correction) * _minimum_jerk(u) + who.correction * _minimum_jerk(
        np.clip((u - 0.6) / 0.4, 0, 1)
    )
    if bow is None:
        return share, np.zeros((SHAPE_STEPS, 3))
    across = bow - (bow @ chord) / length**2 * chord
    across *= (
        np.linalg.norm(bow) / max(float(np.linalg.norm(across)), 1e-9) * random.uniform(0.8, 1.2)
    )
    return share, (64.0 * (u * (1.0 - u)) ** 3)[:, None] * across


def _minimum_jerk(u: Array) -> Array:
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u * u))


def _turn_from_x(way: Array) -> Array:
    """A rotation (3, 3) from x to a unit vector, with the smallest tilt of the vertical axis."""
    up = np.array([0.0, 0.0, 1.0]) if abs(way[2]) < 0.95 else np.array([0.0, 1.0, 0.0])
    side = np.cross(up, way)
    side /= np.linalg.norm(side)
    return np.stack([way, side, np.cross(way, side)], axis=1)
