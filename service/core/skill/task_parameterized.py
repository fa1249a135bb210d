"""How far hands have come between the places of a task: the inputs of a skill that holds wherever
the places are, and the way back from what it says to a tool.

A hand becomes its shares of the places it goes between (barycentric coordinates of the point of
their triangle that is nearest to it); so does the tool, with a deviation from them. A hand that
rests near a place belongs to it; one that moves, or waits far from all, is on its way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from kmp import KMP
from kmp.compiled import compiled
from service.core.intake.stillness import STILL
from service.core.record import Vector
from service.core.skill.places import Indices, Layout, Task
from service.core.skill.via_points import NEAR as NEAR_TAUGHT

SHARPNESS = 4.0  # power of the shares of a hand that rests
AT_M, AWAY_M = 0.12, 0.17  # as near to a place or nearer, and not at all as far: one that rests between places waits
ALMOST = 1e-4  # share that every place has, so that none is of an undefined power
FOLLOWED = 4  # power of the share of a place with which the tool goes with the hand there
FLAT = 1e-6  # [m²] what a triangle's edges are taken to be longer by, as it may be none
NEAR = 0.25  # width, in shares, of what is near to a moment when scatter is looked up
LEAST_STD_M = 0.003
STEP_S = 0.02  # of differences along the hands' motion
CALM_MPS = 0.2  # a slower hand trembles: its velocity says nothing of where the tool will be
LARGEST_MPS2 = 3.0  # of a target's acceleration


class Moving(NamedTuple):
    """What comes of one moment: tool (3,) [m], its velocity and acceleration, covariance (3, 3)
    [m²], and how far hands are off their places [m], the farther one.
    """

    mean: Vector
    velocity: Vector
    acceleration: Vector
    covariance: Vector | None
    off: float


@dataclass(frozen=True, eq=False)
class Placed:
    """A skill among places, as its compiled loops take it. R centres, F inputs, N places, M errors.

    weights: (R, N + 2), of the tool's shares of all places but the first, then of its deviation.
    seen, errors: (M, F), (M, 3) inputs at which the tool was off by so much [m]. taught, pulls:
    (X, 6), (X, 3) [m] hands around which the tool is moved besides, see `taught.bent`.
    """

    task: Task
    layout: Layout
    scale: float  # of a kernel exp(-scale |difference|²)
    centres: Vector
    weights: Vector
    prior: Vector
    seen: Vector
    errors: Vector
    taught: Vector
    pulls: Vector

    @classmethod
    def of(
        cls,
        task: Task,
        layout: Layout,
        primitive: KMP | None = None,
        seen: Vector | None = None,
        errors: Vector | None = None,
    ) -> Placed:
        """A KMP of shares among places, and its errors; without those it knows inputs alone.

        All arrays are copies: what came from elsewhere may be read-only, for which loops would be
        compiled once more, while they run.
        """
        if primitive is None:
            scale, centres, weights, prior = (
                1.0,
                np.empty((0, task.width)),
                np.empty((0, len(task.names) + 2)),
                np.zeros(len(task.names) + 2),
            )
        else:
            scale = float(primitive.kernel.coordinates(1)[0])
            centres = primitive.centres
            weights = primitive.weights.reshape(-1, primitive.outputs)
            prior = primitive.prior_mean
        return cls(
            Task(task.names, *(np.array(part, order="C") for part in task[1:])),
            Layout(np.array(layout.hands, order="C"), np.array(layout.tool, order="C"), layout.std),
            scale,
            np.array(centres, order="C"),
            np.array(weights, order="C"),
            np.array(prior, order="C"),
            np.empty((0, task.width)) if seen is None else np.array(seen, order="C"),
            np.empty((0, 3)) if errors is None else np.array(errors, order="C"),
            np.empty((0, 6)),
            np.empty((0, 3)),
        )

    def through(self, taught: Vector, pulls: Vector) -> Placed:
        """The same, that is moved around some hands."""
        return replace(self, taught=np.array(taught, order="C"), pulls=np.array(pulls, order="C"))

    def inputs(self, hands: Vector, rest: Vector | None = None) -> tuple[Vector, Vector]:
        """Inputs (T, F) of hands (T, 6) that rest so much (T, 2), or wholly, and how far each hand
        (T, 2) is off its places [m].
        """
        out, off = np.empty((len(hands), self.task.width)), np.empty((len(hands), 2))
        for hand, some, row, away in zip(hands, _resting(hands, rest), out, off, strict=True):
            _inputs(hand, some, self.layout.hands, self.task.inputs, row, away)
        return out, off

    def moving_inputs(self, hands: Vector, velocities: Vector, rest: Vector) -> tuple[Vector, Vector]:
        """The inputs (F,) of hands (6,) that move so, and the inputs' velocity (F,) [1/s], by
        differences along their motion.
        """
        found = np.empty((2, self.task.width))
        _moving_inputs(hands, velocities, rest, self.layout.hands, self.task.inputs, found)
        return found[0], found[1]

    def mean(self, hands: Vector, rest: Vector | None = None) -> Vector:
        """The tool (T, 3) [m] for hands (T, 6) that rest so much (T, 2), or wholly."""
        out = np.empty((len(hands), 3))
        for hand, some, row in zip(hands, _resting(hands, rest), out, strict=True):
            _tool(*(hand, some, *self._arrays, row, np.empty(2)))
        return out

    def corners_of_hands(self) -> Vector:
        """Hands (P, 6) [m] at every pair of their places."""
        counts = (self.task.inputs >= 0).sum(axis=1)
        left, right = self.layout.hands[0, : counts[0]], self.layout.hands[1, : counts[1]]
        return np.array([[*one, *other] for one in left for other in right])

    def covariance(self, inputs: Vector) -> Vector:
        """(3, 3) [m²] at inputs (F,): the scatter of errors near there, and that of the places."""
        out = np.empty((3, 3))
        _scatter(inputs, self.seen, self.errors, self.layout.std, out)
        return out

    def moving(
        self, hands: Vector, velocities: Vector, accelerations: Vector, rest: Vector, *, covariance: bool
    ) -> Moving:
        """The tool for hands (6,) that move and rest (2,) so, by differences along their motion.
        One that only trembles moves nothing.
        """
        motion, scatter = np.empty((3, 3)), np.empty((3, 3))
        known = (*self._arrays, self.seen, self.errors, self.layout.std)
        off = _moving(*(hands, velocities, accelerations, rest, *known, covariance, motion, scatter))
        return Moving(motion[0], motion[1], motion[2], scatter if covariance else None, off)

    @cached_property
    def _arrays(self) -> tuple[Any, ...]:
        """What `_tool` needs besides hands."""
        task, layout = self.task, self.layout
        at = (layout.hands, layout.tool, task.inputs, task.corners, task.follow)
        return (*at, self.scale, self.centres, self.weights, self.prior, self.taught, self.pulls)


def _resting(hands: Vector, rest: Vector | None) -> Vector:
    return np.tile(STILL, (len(hands), 1)) if rest is None else rest


def with_hands(hands: Vector, shares: Vector, task: Task, layout: Layout) -> Vector:
    """By how much the tool goes with the hands (T, 6), (T, 3) [m], where it has these shares (T, N)
    of its places.
    """
    out = np.zeros((len(hands), 3))
    for hand, share, row in zip(hands, shares, out, strict=True):
        _add_followed(hand, share, layout.hands, task.corners, task.follow, row)
    return out


@compiled
def barycentric_weights(point: Vector, corners: Vector, count: int, out: Vector) -> float:
    """Barycentric coordinates (3,), at least 0 and 1 in sum, of the point between `count` corners
    that is nearest to a point; its distance.
    """
    out[:] = 0.0
    if count == 3:
        ab, ac, ap = corners[1] - corners[0], corners[2] - corners[0], point - corners[0]
        aa, bb, both = (ab * ab).sum() + FLAT, (ac * ac).sum() + FLAT, (ab * ac).sum()
        one, other = (ab * ap).sum(), (ac * ap).sum()
        determinant = aa * bb - both * both
        second, third = (bb * one - both * other) / determinant, (aa * other - both * one) / determinant
        if second >= 0.0 and third >= 0.0 and second + third <= 1.0:
            out[0], out[1], out[2] = 1.0 - second - third, second, third
            return math.sqrt(((point - out[0] * corners[0] - second * corners[1] - third * corners[2]) ** 2).sum())
    least = math.inf
    for i in range(count):
        for j in range(i + 1 if i + 1 < count else i, count):
            way, off = corners[j] - corners[i], point - corners[i]
            along = min(max((off * way).sum() / ((way * way).sum() + FLAT), 0.0), 1.0)
            square = ((off - along * way) ** 2).sum()
            if square < least and (count == 1 or i != j):
                least = square
                out[:] = 0.0
                out[i] = 1.0 - along
                out[j] += along
    return math.sqrt(least)


@compiled
def _inputs(hands: Vector, rest: Vector, corners: Vector, inputs: Indices, out: Vector, off: Vector) -> None:
    """The shares of both hands (6,) into `out` (F,), how far each is off into `off` (2,)."""
    out[:] = 0.0
    share = np.empty(3)
    for side in range(2):
        count = 0
        while count < 3 and inputs[side, count] >= 0:
            count += 1
        first = 3 * side
        off[side] = barycentric_weights(hands[first : first + 3], corners[side], count, share)
        nearest = math.inf
        for i in range(count):
            nearest = min(nearest, ((hands[first : first + 3] - corners[side, i]) ** 2).sum())
        near = min(max((AWAY_M - math.sqrt(nearest)) / (AWAY_M - AT_M), 0.0), 1.0)
        power = 1.0 + (SHARPNESS - 1.0) * near * rest[side]
        total = 0.0
        for i in range(count):
            share[i] = (share[i] + ALMOST) ** power
            total += share[i]
        for i in range(count):
            out[inputs[side, i]] += share[i] / total


@compiled
def _moving_inputs(
    hands: Vector, velocities: Vector, rest: Vector, corners: Vector, inputs: Indices, out: Vector
) -> None:
    """The shares of both hands (6,) that move so, and their velocity, into `out` (2, F)."""
    ahead, off = np.empty(out.shape[1]), np.empty(2)
    _inputs(hands - STEP_S * velocities, rest, corners, inputs, out[1], off)
    _inputs(hands + STEP_S * velocities, rest, corners, inputs, ahead, off)
    for i in range(len(ahead)):
        out[1, i] = (ahead[i] - out[1, i]) / (2.0 * STEP_S)
    _inputs(hands, rest, corners, inputs, out[0], off)


@compiled
def _add_followed(hands: Vector, shares: Vector, corners: Vector, at: Indices, follow: Indices, out: Vector) -> None:
    """Adds to `out` (3,) by how much the tool goes with the hands, for its shares (N,)."""
    for place in range(len(follow)):
        side = follow[place]
        if side >= 0:
            off = hands[3 * side : 3 * side + 3] - corners[side, at[place, side]]
            out += min(max(shares[place], 0.0), 1.0) ** FOLLOWED * off


@compiled
def _tool(
    hands: Vector,
    rest: Vector,
    corners: Vector,
    places: Vector,
    inputs: Indices,
    at: Indices,
    follow: Indices,
    scale: float,
    centres: Vector,
    weights: Vector,
    prior: Vector,
    taught: Vector,
    pulls: Vector,
    out: Vector,
    off: Vector,
) -> None:
    """The tool into `out` (3,): equation (8) of Huang et al. 2019 of the shares, and back."""
    width, count = centres.shape[1], len(places)
    query, shares, found = np.empty(width), np.empty(count), prior.copy()
    _inputs(hands, rest, corners, inputs, query, off)
    for r in range(len(centres)):
        square = 0.0
        for i in range(width):
            square += (query[i] - centres[r, i]) ** 2
        value = math.exp(-scale * square)
        for i in range(len(found)):
            found[i] += value * weights[r, i]
    shares[0] = 1.0
    for place in range(1, count):
        shares[place] = found[place - 1]
        shares[0] -= found[place - 1]
    for i in range(3):
        out[i] = found[count - 1 + i]
        for place in range(count):
            out[i] += shares[place] * places[place, i]
    _add_followed(hands, shares, corners, at, follow, out)
    for x in range(len(taught)):
        square = 0.0
        for i in range(6):
            square += (hands[i] - taught[x, i]) ** 2
        value = math.exp(-NEAR_TAUGHT * square)
        for i in range(3):
            out[i] += value * pulls[x, i]


@compiled
def _moving(
    hands: Vector,
    velocities: Vector,
    accelerations: Vector,
    rest: Vector,
    corners: Vector,
    places: Vector,
    inputs: Indices,
    at: Indices,
    follow: Indices,
    scale: float,
    centres: Vector,
    weights: Vector,
    prior: Vector,
    taught: Vector,
    pulls: Vector,
    seen: Vector,
    errors: Vector,
    std: float,
    wanted: bool,
    motion: Vector,
    scatter: Vector,
) -> float:
    """Tool, velocity and acceleration into `motion` (3, 3), the covariance, if it is wanted, into
    `scatter` (3, 3); how far the farther hand is off its places [m].
    """
    step, bend, tools, off = np.empty(6), np.empty(6), np.empty((3, 3)), np.empty(2)
    for side in range(2):
        part = slice(3 * side, 3 * side + 3)
        speed = math.sqrt((velocities[part] ** 2).sum())
        goes = 1.0 - math.exp(-((speed / CALM_MPS) ** 4))
        step[part] = STEP_S * goes * velocities[part]
        bend[part] = 0.5 * STEP_S**2 * goes * accelerations[part]
    for k in (0, 2, 1):
        way = k - 1.0
        where = hands + way * step + abs(way) * bend
        _tool(
            where, rest, corners, places, inputs, at, follow, scale, centres, weights, prior, taught, pulls,
            tools[k], off,
        )  # fmt: skip
    for i in range(3):
        bent = (tools[2, i] - 2.0 * tools[1, i] + tools[0, i]) / STEP_S**2
        motion[0, i] = tools[1, i]
        motion[1, i] = (tools[2, i] - tools[0, i]) / (2.0 * STEP_S)
        motion[2, i] = min(max(bent, -LARGEST_MPS2), LARGEST_MPS2)
    if wanted:
        query = np.empty(centres.shape[1])
        _inputs(hands, rest, corners, inputs, query, off)
        _scatter(query, seen, errors, std, scatter)
    return float(max(off[0], off[1]))


@compiled
def _scatter(query: Vector, seen: Vector, errors: Vector, std: float, out: Vector) -> None:
    """The mean square (3, 3) of errors (M, 3) at inputs (M, F), weighted by how near those are."""
    squares, least = np.empty(len(seen)), math.inf
    for m in range(len(seen)):
        squares[m] = 0.0
        for i in range(len(query)):
            squares[m] += (query[i] - seen[m, i]) ** 2
        least = min(least, squares[m])
    out[:] = 0.0
    total = 0.0
    for m in range(len(seen)):
        weight = math.exp(-0.5 * (squares[m] - least) / NEAR**2)
        total += weight
        for i in range(3):
            for j in range(3):
                out[i, j] += weight * errors[m, i] * errors[m, j]
    for i in range(3):
        for j in range(3):
            out[i, j] /= total
        out[i, i] += std**2 + LEAST_STD_M**2
