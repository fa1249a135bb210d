"""Synthetic tasks other than soldering: demonstrations of a dozen kinds of task by modelled people,
in scenes with different places in each take. Each depends only on its numbers.

A task is a list of segments with positions of both hands and of the tool. A person's hands move
from segment to segment, and a teacher leads the tool by the progress of the slower hand, with a
small delay.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from thirdhand.contract.requests import ViaPoint
from thirdhand.settings.config import Reach
from thirdhand.skills.demonstration import Demonstration
from thirdhand_sim.people import GROUP_SEEDS, PROJECT_SEED, Person, person
from thirdhand_sim.scene import TOOL_ORIENTATION
from thirdhand_sim.script import Array
from thirdhand_sim.sessions import SHAPE_STEPS, Leg, along, restless, shape

TASK_KINDS = (
    "three",
    "six",
    "twelve",
    "cyclic",
    "thrice",
    "path",
    "heading",
    "one_hand",
    "loose",
    "ahead",
    "long",
)
TAUGHT = "visits"  # the task of the tutorial, which no experiment uses
TAKE_HZ = 50
START_REST_S = 1.2  # rest before the first motion
END_REST_S = 1.6  # rest after the last motion
LEAD_S = 2.0  # in the task "ahead", the left hand is this far ahead of the right one
MOVED_M = (0.05, 0.10)  # range of the standard deviation of a scene's places; half of it vertically
PERCEIVED_M = 0.004  # error of perceived places, 3-D rms
TOOL_SCATTER_M = 0.0025  # standard deviation of the tool's places per axis
TOOL_NOISE_M = 0.0005  # noise of the measured tool per axis
HAND_OFF_M = (0.005, 0.010)  # range of a person's constant offset from a place
HAND_SCATTER_M = 0.002  # standard deviation of that offset in each axis and take
REACTION_S = (0.05, 0.35)  # range of the teacher's delay
TRACKER_NOISE_M = (0.001, 0.002)  # range of a tracker's noise in each axis, mean 1.5 mm
TURNS_RAD = (0.6, 0.15, 0.15)  # standard deviations of yaw, pitch and roll of a carried thing
GRIP_RAD = 0.03  # standard deviation of a person's grip
TURN_NOISE_RAD = 0.01  # noise of measured orientations
CARRIED_M = (-0.10, 0.0, 0.12)  # position of the tool relative to the hand that carries or leads it
CURVE_M = 0.07  # the path that the tool follows sways by this to both sides
ARC_M = 0.04  # the tool's height gain in the middle of a motion
TEACHER_SMOOTHING_S = 0.08  # standard deviation of the filter over the teacher's progress
PAUSES = 0.12  # probability that a hand pauses in a leg
STRAYS = 0.15  # probability that a hand strays before a leg
TOOL_MARGIN_M = 0.05  # the tool's places are this far inside the arm's reach
LEAST_WAY_M = 0.10  # successive places of a hand or tool are at least this far apart
HANDS_BOX = np.array(
    [[[0.55, -0.42, 0.07], [0.95, -0.02, 0.25]], [[0.55, 0.02, 0.07], [0.95, 0.42, 0.25]]]
)
CARRYING_BOX = np.array([[0.55, -0.30, 0.07], [0.70, 0.05, 0.18]])
TOOL_BOX = np.array([[0.35, -0.36, 0.15], [0.60, 0.36, 0.40]])
HAND_BOX = np.array([[0.42, -0.60, 0.04], [1.10, 0.60, 0.40]])  # limits of a hand's places
RESTS = np.array([[0.52, -0.05, 0.04], [1.00, 0.50, 0.20]])  # limits of an idle right hand's place


class MadeTake(NamedTuple):
    """A demonstration and the number of its person."""

    person: int
    demonstration: Demonstration


class Plan(NamedTuple):
    """A task: the names of its segments, the indices of their places of left hand, right hand and
    tool, and the motion of hands and tool.
    """

    names: tuple[str, ...]
    segments: Array  # (N, 3) indices of places, int
    follow: Array  # (N,) 1 where the tool moves with the left hand, else 0
    left_leads: bool = False  # True if the tool ignores the right hand
    carried: bool = False  # True if the tool is fixed to the thing that the left hand carries
    curved: int = -1  # the segment after which the left hand moves on a curve
    ahead_s: float = 0.0  # lead of the left hand
    dwells: tuple[float, float] = (0.7, 1.6)  # [s] range of the rests at places
    pauses: float = PAUSES  # probability that a hand pauses in a leg, or both hands after it


def plan(kind: str) -> Plan:
    """The task of one of TASK_KINDS. Raises ValueError for others."""
    once = {"three": 3, "six": 6, "twelve": 12, "loose": 6, "ahead": 3, "heading": 3, "long": 24}
    if kind in once:
        count = once[kind]
        names = tuple(f"segment {i + 1}" for i in range(count))
        segments = [(i, i, i) for i in range(count)]
    elif kind in ("cyclic", "thrice"):
        names = (
            "start",
            "left out",
            "work",
            "left out again",
            "work again",
            "left out a third time",
        )
        segments = [(0, 0, 0), (1, 0, 1), (2, 1, 2), (1, 0, 3), (2, 1, 4), (1, 0, 5)]
        names, segments = (names, segments) if kind == "thrice" else (names[:4], segments[:4])
    elif kind == TAUGHT:
        names = ("start", "tray", "work", "tray again", "done")
        segments = [(0, 0, 0), (1, 0, 1), (2, 1, 2), (1, 0, 3), (3, 0, 4)]
    elif kind == "path":
        names = ("start", "path begins", "path ends")
        segments = [(0, 0, 0), (1, 1, 1), (2, 1, 2)]
    elif kind == "one_hand":
        names = ("start", "fetch", "bring")
        segments = [(0, 0, 0), (1, 0, 1), (2, 0, 2)]
    else:
        raise ValueError(f"{kind!r}: no kind of synthetic task; {', '.join(TASK_KINDS)} accepted")
    follow = {"path": [0.0, 1.0, 1.0], "heading": [1.0] * 3}.get(kind, [0.0] * len(names))
    return Plan(
        names,
        np.array(segments),
        np.array(follow),
        left_leads=kind in ("path", "heading", "one_hand"),
        carried=kind == "heading",
        curved=1 if kind == "path" else -1,
        ahead_s=LEAD_S if kind == "ahead" else 0.0,
        dwells={"long": (4.5, 7.0), TAUGHT: (0.7, 1.1)}.get(kind, (0.7, 1.6)),
        pauses=0.0 if kind == TAUGHT else PAUSES,  # in the tutorial a rest ends the take
    )


class TaskScene(NamedTuple):
    """The positions of hands and tool at each segment (N, 3) [m], and yaw, pitch and roll of the
    thing that the left hand carries (N, 3) [rad].
    """

    left: Array
    right: Array
    tool: Array
    turns: Array


def takes(kind: str, *, people: Sequence[int], each: int, seed: int = 0) -> list[MadeTake]:
    """`each` demonstrations of each of these people, one every five minutes. Another `seed` gives
    another task of the same kind.

    Raises ValueError for a kind outside TASK_KINDS.
    """
    return [
        MadeTake(subject, run(kind, subject, number, seed=seed).demonstration())
        for subject in people
        for number in range(each)
    ]


def run(kind: str, who: int, number: int, *, seed: int = 0, scene: TaskScene | None = None) -> Run:
    """A person's run of a task, in a scene of its own if none is given."""
    task = plan(kind)
    key = (
        PROJECT_SEED,
        GROUP_SEEDS["made"],
        (*TASK_KINDS, TAUGHT).index(kind),
        seed,
        who,
        number + 1,
    )
    random = np.random.default_rng(key)
    habits = person("made", who)
    habits = habits._replace(tremor=0.4 * habits.tremor, lead_s=task.ahead_s or 0.2 * habits.lead_s)
    scene = scene or _moved(task, _usual(kind, seed), random)
    right_rests = _within(RESTS, random)
    if kind == "one_hand":  # the place of the idle hand carries no information
        scene = scene._replace(right=np.tile(right_rests, (len(task.names), 1)))
    order = (
        _order(len(task.names), random)
        if kind == "loose"
        else [(i, False) for i in range(len(task.names))]
    )
    return Run(
        task,
        scene,
        habits,
        who,
        tuple(segment for segment, _ in order),
        key,
        _legs(task, scene, habits, order, key),
    )


@dataclass(frozen=True, eq=False)
class Run:
    """A person's run of a task."""

    task: Plan
    scene: TaskScene
    habits: Person
    number: int
    order: tuple[int, ...]  # the segments in the order of the run
    key: tuple[int, ...]
    legs: tuple[tuple[Leg, ...], tuple[Leg, ...]]

    @property
    def lasts_s(self) -> float:
        """Duration [s]."""
        return max(legs[-1].begin_s + legs[-1].lasts_s for legs in self.legs) + END_REST_S

    def hands(self, times: Array) -> Array:
        """True positions of both hands (T, 6) [m]."""
        sway, tremor = restless(self.habits, self.key, times)
        return np.hstack([along(legs, times)[0] for legs in self.legs]) + sway + tremor

    def tool(self, times: Array) -> tuple[Array, Array]:
        """Positions of the tool (T, 3) [m] at evenly spaced times as the teacher leads it, and yaw,
        pitch and roll of the carried thing (T, 3) [rad].
        """
        random = np.random.default_rng([*self.key, 3])
        late = times - random.uniform(*REACTION_S)
        (left, by_left), (_, by_right) = (along(legs, late) for legs in self.legs)
        rate_hz = 1.0 / float(times[1] - times[0])
        progress = by_left if self.task.left_leads else np.minimum(by_left, by_right)
        progress = gaussian_filter1d(progress, TEACHER_SMOOTHING_S * rate_hz, mode="nearest")
        order = np.array(self.order)
        nodes = np.arange(len(order))

        def between(values: Array) -> Array:
            return np.stack(
                [np.interp(progress, nodes, column) for column in values[order].T], axis=1
            )

        turns = between(self.scene.turns)
        if self.task.carried:
            return left + Rotation.from_euler("ZYX", turns).apply(CARRIED_M), turns
        scatter = TOOL_SCATTER_M * random.standard_normal(self.scene.tool.shape)
        share = progress - np.floor(progress)
        arc = np.outer(ARC_M * 64.0 * (share * (1.0 - share)) ** 3, (0.0, 0.0, 1.0))
        follow = between(self.task.follow[:, None])
        hand_offset = follow * (left - between(self.scene.left))
        return between(self.scene.tool + scatter) + arc * (1.0 - follow) + hand_offset, turns

    def demonstration(self) -> Demonstration:
        """The run as measured by a tracker and the arm, with the via-points as perceived."""
        random = np.random.default_rng([*self.key, 4])
        habit = np.random.default_rng([*self.key[:2], self.number])
        steps = np.arange(int(self.lasts_s * TAKE_HZ))
        times = steps / TAKE_HZ
        count = len(steps)
        hands = self.hands(times) + habit.uniform(*TRACKER_NOISE_M) * random.standard_normal(
            (count, 6)
        )
        tool, late = self.tool(times)
        (_, by_left), _ = (along(legs, times) for legs in self.legs)
        nodes = np.arange(len(self.order))
        turns = np.stack(
            [np.interp(by_left, nodes, c) for c in self.scene.turns[list(self.order)].T], axis=1
        )
        grips = GRIP_RAD * habit.standard_normal((2, 3))
        noise = TURN_NOISE_RAD * random.standard_normal((2, count, 3))
        left = Rotation.from_euler("ZYX", turns) * Rotation.from_euler("ZYX", grips[0] + noise[0])
        right = Rotation.from_euler("ZYX", np.array([np.pi, 0.0, 0.0]) + grips[1] + noise[1])
        usual = Rotation.from_quat(TOOL_ORIENTATION)
        turned = Rotation.from_euler("ZYX", late) * usual if self.task.carried else usual
        return Demonstration(
            steps * (1_000_000_000 // TAKE_HZ) + (1 + 300 * self.key[-1]) * 1_000_000_000,
            np.hstack([hands[:, :3], _quaternions(left, count)]),
            np.hstack([hands[:, 3:], _quaternions(right, count)]),
            np.hstack(
                [
                    tool + TOOL_NOISE_M * random.standard_normal(tool.shape),
                    _quaternions(turned, count),
                ]
            ),
            via_points=self._perceived(random),
        )

    def _perceived(self, random: np.random.Generator) -> tuple[ViaPoint, ...]:
        """The via-points with errors of PERCEIVED_M, one for each position."""
        parts = []
        for part, column in zip(self.scene[:3], self.task.segments.T, strict=True):
            error_m = PERCEIVED_M / np.sqrt(3.0) * random.standard_normal((column.max() + 1, 3))
            parts.append(np.round(part + error_m[column], 6))
        rows = [
            {
                "name": name,
                **{
                    side: position.tolist()
                    for side, position in zip(("left", "right", "tool"), ends, strict=True)
                },
                "std": 0.003,
                "radius": 0.03,
                "follow": "left" if follow else "none",
            }
            for name, follow, *ends in zip(self.task.names, self.task.follow, *parts, strict=True)
        ]
        return msgspec.convert(rows, tuple[ViaPoint, ...])


def _quaternions(turned: Rotation, count: int) -> Array:
    return np.array(np.broadcast_to(turned.as_quat(), (count, 4)))


def _within(box: Array, random: np.random.Generator) -> Array:
    return np.asarray(random.uniform(*box))


def _usual(kind: str, seed: int) -> list[Array]:
    """The nominal places of left hand, right hand and tool, and orientations at the left's
    places.
    """
    task = plan(kind)
    random = np.random.default_rng(
        [PROJECT_SEED, GROUP_SEEDS["made"], TASK_KINDS.index(kind), seed]
    )
    boxes = [CARRYING_BOX if task.follow.any() else HANDS_BOX[0], HANDS_BOX[1], TOOL_BOX]
    out = []
    for box, column in zip(boxes, task.segments.T, strict=True):
        places: list[Array] = []
        # [m] least distance from all other places, and from the one before
        spacing_m = 0.16
        step_m = 0.22
        while len(places) <= column.max():
            tried = _within(box, random)
            if all(np.linalg.norm(tried - place) > spacing_m for place in places) and (
                not places or np.linalg.norm(tried - places[-1]) > step_m
            ):
                places.append(tried)
            # the distances shrink until all places fit
            spacing_m = 0.998 * spacing_m
            step_m = 0.999 * step_m
        out.append(np.array(places))
    return [*out, np.array(TURNS_RAD) * random.standard_normal((len(out[0]), 3))]


def _moved(task: Plan, usual: Sequence[Array], random: np.random.Generator) -> TaskScene:
    """A scene of the task, with each place displaced within the reach of arm and hands."""
    sigma = random.uniform(*MOVED_M) * np.array([1.0, 1.0, 0.5])

    def placed(part: int, index: int, before: Array | None) -> Array:
        for _ in range(10_000):
            tried = usual[part][index] + sigma * random.standard_normal(3)
            if before is not None and np.linalg.norm(tried - before) < LEAST_WAY_M:
                continue
            low, high = HAND_BOX if part < 2 else np.array([[-1.0] * 3, [1.0] * 3])
            carries = part == 0 and task.follow.any()
            if (
                ((tried >= low) & (tried <= high)).all()
                and (part < 2 or _reached(tried))
                and (not carries or _reached(tried + CARRIED_M))
            ):
                return np.asarray(tried)
        # the boxes above prevent this
        raise ValueError(f"no room for place {index} near {usual[part][index]}")

    parts = []
    for part in range(3):
        places: list[Array] = []
        for index in range(len(usual[part])):
            places.append(placed(part, index, places[-1] if places else None))
        parts.append(np.array(places))
    turns = usual[3] + np.array(TURNS_RAD) * random.standard_normal(usual[3].shape)
    left, right, tool = (
        positions[column] for positions, column in zip(parts, task.segments.T, strict=True)
    )
    turns = turns[task.segments[:, 0]]
    if task.carried:
        tool = left + Rotation.from_euler("ZYX", turns).apply(CARRIED_M)
    else:
        tool = np.where(task.follow[:, None] > 0, left + CARRIED_M, tool)
    return TaskScene(left, right, tool, turns)


def _reached(tool: Array) -> bool:
    reach = Reach()
    away = float(np.linalg.norm(tool - reach.centre))
    return (
        reach.inner + TOOL_MARGIN_M <= away <= reach.outer - TOOL_MARGIN_M
        and tool[0] >= reach.min_x + TOOL_MARGIN_M
        and tool[2] >= reach.min_z + TOOL_MARGIN_M
    )


def _order(count: int, random: np.random.Generator) -> list[tuple[int, bool]]:
    """The order of segments, each with True if the hands interrupt their motion to it: as taught,
    or with one segment left out, repeated or interrupted.
    """
    order = [(i, False) for i in range(count)]
    index = int(random.integers(1, count - 1))
    how = int(random.integers(4))
    if how == 1:
        order.pop(index)
    elif how == 2:
        order[index + 1 : index + 1] = [(index - 1, False), (index, False)]
    elif how == 3:
        order[index] = (index, True)
    return order


def _legs(  # noqa: C901, PLR0912 - a case for each kind
    task: Plan, scene: TaskScene, who: Person, order: Sequence[tuple[int, bool]], key: Sequence[int]
) -> tuple[tuple[Leg, ...], tuple[Leg, ...]]:
    """The legs of both hands from segment to segment; each hand waits for the other, except for the
    lead.
    """
    random = np.random.default_rng([*key, 5])
    habit = np.random.default_rng([*key[:2], key[-2], 6])
    ends = np.stack([scene.left, scene.right])
    for side, column in enumerate(task.segments[:, :2].T):
        offset_m = habit.standard_normal((len(task.names), 3))
        offset_m *= habit.uniform(*HAND_OFF_M, (len(offset_m), 1)) / np.linalg.norm(
            offset_m, axis=1, keepdims=True
        )
        ends[side] += (offset_m + HAND_SCATTER_M * random.standard_normal(offset_m.shape))[column]
    legs: tuple[list[Leg], list[Leg]] = ([], [])
    free = [0.5, 0.5]  # [s] time from which each hand may move
    ready_s = START_REST_S + max(who.lead_s, 0.0)

    def go(
        side: int,
        at: float,
        way: Array,
        progress: tuple[float, float],
        bow: Array | None,
        *,
        curve: bool = False,
    ) -> None:
        length = float(np.linalg.norm(way[1] - way[0]))
        lasts = (5.0 if curve else 0.9 + 1.6 * length) / who.speed * random.uniform(0.9, 1.1)
        share, deviation = shape(
            who, way, None if bow is None else bow * min(1.0, length / 0.4), random
        )
        if curve:
            along_way = (way[1] - way[0]) / length
            across = np.cross((0.0, 0.0, 1.0), along_way)
            deviation = deviation + CURVE_M * np.outer(np.sin(2 * np.pi * share), across)
        legs[side].append(Leg(at, lasts, way[0], way[1], share, deviation, progress))
        free[side] = at + lasts

    for i, ((a, _), (b, breaks)) in enumerate(itertools.pairwise(order)):
        if breaks:  # both hands return to their first place, and move again
            for nodes, progress in (((a, 0), (i, i)), ((0, a), (i, i))):
                for side in (0, 1):
                    if not np.array_equal(ends[side, nodes[0]], ends[side, nodes[1]]):
                        go(side, ready_s, ends[side, list(nodes)], progress, None)
                ready_s = max(*free, ready_s) + random.uniform(1.0, 2.0)
        for side in (0, 1):
            begin = max(
                free[side] + 0.1,
                ready_s - who.lead_s * (side == 0) + 0.1 * random.standard_normal(),
            )
            # the hand rests, and the other does not wait for it
            if task.segments[a, side] == task.segments[b, side]:
                start = ends[side, a]
                begin = max(free[side], begin - 0.6)
                at_once = np.linspace(0, 1, SHAPE_STEPS)
                legs[side].append(
                    Leg(begin, 0.1, start, start, at_once, np.zeros((SHAPE_STEPS, 3)), (i, i + 1))
                )
                free[side] = begin + 0.1
                continue
            start = ends[side, a]
            goal = ends[side, b]
            bow = who.bows[side, i % 2]
            if random.random() < STRAYS and not who.lead_s > 1.0:
                stray = start + random.uniform(-0.08, 0.08, 3) * (1.0, 1.0, 0.3)
                go(side, begin, np.array([start, stray]), (i, i), None)
                go(side, free[side] + 0.1, np.array([stray, start]), (i, i), None)
                begin = free[side] + 0.2
            if random.random() < task.pauses and i != task.curved:
                half = start + random.uniform(0.35, 0.65) * (goal - start)
                go(side, begin, np.array([start, half]), (i, i + 0.5), bow)
                go(
                    side,
                    free[side] + random.uniform(0.5, 1.5),
                    np.array([half, goal]),
                    (i + 0.5, i + 1),
                    bow,
                )
            else:
                go(
                    side,
                    begin,
                    np.array([start, goal]),
                    (i, i + 1),
                    bow,
                    curve=i == task.curved and side == 0,
                )
        ready_s = max(free) + random.uniform(*task.dwells)
        if random.random() < task.pauses:
            ready_s += random.uniform(1.0, 3.0)
    return tuple(legs[0]), tuple(legs[1])
