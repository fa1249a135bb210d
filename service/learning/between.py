"""Learning between places: what demonstrations tell of a task whose places they name.

A KMP from the hands' shares of their places to the tool's, and how it errs in demonstrations that
were left out.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kmp import KMP, GaussianKernel, Gaussians, ViaPointMissed
from service.contract.requests import ViaPoint
from service.core.intake.stillness import stillness_of
from service.core.record import Vector
from service.core.skill.places import LEFT, MOST_CORNERS, NONE, RIGHT, Indices, Layout, Places, Task
from service.core.skill.skill import LearnedBetween
from service.core.skill.task_parameterized import Placed, with_hands
from service.learning.choice import rms
from service.learning.demonstration import Demonstration
from service.learning.gate import CEILING_M, Gate, between, nonsense
from service.learning.judgement import HeldOut
from service.learning.skill_file import SkillError

EACH = 30  # samples of a demonstration that are learned from, and
ERRORS_OF_EACH = 40  # that its errors are kept of
SMOOTHED_S = 0.28  # of the hands in demonstrations
SAME_M = 0.05  # places of a hand that are no farther apart, in any demonstration, are one
AT, ALIKE = 0.9, 0.85  # share from which on hands are at a place; and the tool, in the median
LEAST_SAMPLES_S = 0.4  # there, for a pair of places to be known
UNSEEN = (0.15, 0.3, 0.45)  # of the way to a pair that was not: the tool stays
TAUGHT = 1e-4  # deviation of the share at a known pair
FALSE = 0.005  # of the time may the gate hold: hands that start elsewhere come nearer, and are to be followed
BETTER = 0.98  # by which share of the error other parameters must be better than the usual ones
FAR_M = 0.10  # a place that the tool never came so near is told wrong
FOLLOW = {"none": NONE, "left": LEFT, "right": RIGHT}


class Parameters(NamedTuple):
    """What a KMP between places is fitted with."""

    ell: float  # of the kernel, whose inputs are shares
    deviation: float  # of a demonstration's sample, in shares and metres


USUAL = Parameters(4.0, 0.05)
OTHERS = [
    tried for ell in (0.5, 1.0, 2.0, 4.0, 8.0) for d in (0.05, 0.15, 0.4) if (tried := Parameters(ell, d)) != USUAL
]


@dataclass(frozen=True, eq=False)
class Told:
    """A demonstration (T samples) in shares: inputs (T, F), the tool's shares (T, N), and what is
    learned of them at some rows.
    """

    layout: Layout
    hands: Vector
    rest: Vector  # (T, 2) how much each hand rests
    tool: Vector
    inputs: Vector
    off: Vector  # (T, 2) [m] of each hand from its places
    shares: Vector
    rows: Vector
    wanted: Vector  # (T, N + 2)
    period_s: float

    @staticmethod
    def of(task: Task, demonstration: Demonstration, hands: Vector, tool: Vector) -> Told:
        """The demonstration whose hands (T, 6) and tool (T, 3) are in phase."""
        period_s = demonstration.period_s
        hands = _smoothed(hands, round(SMOOTHED_S / period_s))
        rest = stillness_of(np.gradient(hands, period_s, axis=0), period_s)
        layout = task.layout(Places.of(demonstration.places))
        inputs, off = Placed.of(task, layout).inputs(hands, rest)
        shares = _along(tool, layout.tool)
        deviation = tool - shares @ layout.tool - with_hands(hands, shares, task, layout)
        steps = np.linalg.norm(np.diff(np.hstack([inputs, 3.0 * tool]), axis=0), axis=1) + 0.05 * period_s
        way = np.concatenate([[0.0], np.cumsum(steps)])
        rows = np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], EACH)).clip(0, len(way) - 1))
        wanted = np.hstack([shares[:, 1:], deviation])
        return Told(layout, hands, rest, tool, inputs, off, shares, rows, wanted, period_s)


def task_of(demonstrations: Sequence[Demonstration]) -> Task | str:
    """The task of demonstrations that name its places; or why there is none, empty where no places
    are named.
    """
    named = [tuple(point.name for point in one.places) for one in demonstrations]
    if not any(named):
        return ""
    if len(set(map(frozenset, named))) > 1:
        return "not all demonstrations name the same places, so it is learned where the hands are, not between places"
    names = named[0]
    if len(names) < 2:
        return "two named places are the least to learn between"
    at = np.array([[[*p.left, *p.right] for p in _ordered(one.places, names)] for one in demonstrations])
    corners = np.stack([_corners(at[:, :, :3]), _corners(at[:, :, 3:])], axis=1)
    for side, word in enumerate(("left", "right")):
        if corners[:, side].max() >= MOST_CORNERS:
            return (
                f"the {word} hand has {corners[:, side].max() + 1} places, {MOST_CORNERS} at most are learned between, "
                "so it is learned where the hands are"
            )
    inputs = np.full((2, MOST_CORNERS), -1)
    left, right = (int(corners[:, side].max()) + 1 for side in (0, 1))
    inputs[0, :left], inputs[1, :right] = np.arange(left), left + np.arange(right)
    follow = np.array([FOLLOW[p.follow] for p in _ordered(demonstrations[0].places, names)])
    return Task(names, corners, inputs, follow)


def places_never_reached(task: Task, demonstrations: Sequence[Demonstration], names: Sequence[str]) -> list[str]:
    """In words, which places the tool never came near in which demonstrations, by their names.

    Raises SkillError for one that it came near in none.
    """
    warned = []
    for place, follow in zip(task.names, task.follow.tolist(), strict=True):
        off = [_nearest(one, next(_ordered(one.places, (place,))), follow) for one in demonstrations]
        if min(off) > FAR_M:
            raise SkillError(
                f"place {place!r}: the tool never came nearer to it than {1000 * min(off):.0f} mm "
                f"({names[int(np.argmin(off))]}), {1000 * FAR_M:.0f} mm needed: is it told in metres, in frame base, "
                "where it was in these demonstrations?"
            )
        missed = [f"{name} ({1000 * m:.0f} mm)" for name, m in zip(names, off, strict=True) if m > FAR_M]
        if missed:
            warned.append(f"place {place!r}: the tool never came near it in {', '.join(missed)}")
    return warned


def _nearest(demonstration: Demonstration, place: ViaPoint, follow: int) -> float:
    """The tool's least distance from a place [m], there or where it is with the hand it follows."""
    off = demonstration.tool[:, :3] - place.tool
    out = float(np.linalg.norm(off, axis=1).min())
    if follow == NONE:
        return out
    hand = demonstration.hands[:, 3 * follow : 3 * follow + 3] - (place.left, place.right)[follow]
    return min(out, float(np.linalg.norm(off - hand, axis=1).min()))


def merged(task: Task, told_of: Callable[[Task], list[Told]]) -> tuple[Task, list[Told], list[Vector]]:
    """The task with places of a hand as one input, as long as that predicts demonstrations that are
    left out better; the demonstrations, which `told_of` a task says in its inputs; and their errors
    then, with the usual parameters.
    """

    def judged(task: Task) -> tuple[Task, list[Told], list[Vector]]:
        told = told_of(task)
        return task, told, _left_out(task, told, USUAL)

    best = judged(task)
    while True:
        task, told, errors = best
        for pair in _alike(task, _known(told, task)):
            best = min(best, judged(_as_one(task, *pair)), key=lambda one: rms(np.concatenate(one[2])))
        if best[0] is task:
            return task, told, errors


def _alike(task: Task, known: dict[tuple[int, int], int]) -> list[tuple[int, int, int]]:
    """Side and two inputs, for places of a hand of which nothing shows that the tool tells them
    apart.
    """
    out = []
    for side in (0, 1):
        for a, b in itertools.combinations(sorted({i for i in task.inputs[side].tolist() if i >= 0}), 2):
            at = [{pair[1 - side]: place for pair, place in known.items() if pair[side] == i} for i in (a, b)]
            if all(at[0][other] == at[1][other] for other in at[0].keys() & at[1].keys()):
                out.append((side, a, b))
    return out


def _as_one(task: Task, side: int, a: int, b: int) -> Task:
    inputs = task.inputs.copy()
    inputs[side, inputs[side] == b] = a
    _, renumbered = np.unique(inputs[inputs >= 0], return_inverse=True)
    inputs[inputs >= 0] = renumbered
    return task._replace(inputs=inputs)


def fitted(task: Task, told: Sequence[Told], parameters: Parameters = USUAL) -> KMP:
    """The KMP, with the tool at its place wherever both hands were found to be at theirs."""
    inputs = np.concatenate([one.inputs[one.rows] for one in told])
    outputs = np.concatenate([one.wanted[one.rows] for one in told])
    width = outputs.shape[1]
    reference = Gaussians(outputs, np.tile(parameters.deviation**2 * np.eye(width), (len(inputs), 1, 1)))
    primitive = KMP.fit(
        inputs,
        reference,
        kernel=GaussianKernel(parameters.ell),
        lambda_mean=1.0,
        prior_mean=outputs.mean(axis=0),
        representation="dense",
    )
    at, wanted = _pairs(task, _known(told, task))
    if not len(at):
        return primitive
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ViaPointMissed)
        taught = Gaussians(wanted, np.tile(TAUGHT**2 * np.eye(width), (len(at), 1, 1)))
        return primitive.adapt(at, taught, tolerance=0.05)


def _smoothed(hands: Vector, samples: int) -> Vector:
    window = np.hanning(samples + 2)[1:-1] if samples else np.ones(1)
    before = len(window) // 2
    padded = [np.pad(column, (before, len(window) - 1 - before), mode="edge") for column in hands.T]
    return np.stack([np.convolve(column, window / window.sum(), mode="valid") for column in padded], axis=1)


def _ordered(places: Sequence[ViaPoint], names: Sequence[str]) -> Iterator[ViaPoint]:
    by_name = {place.name: place for place in places}
    return (by_name[name] for name in names)


def _corners(at: Vector) -> Indices:
    """Which of its own places a hand is at, (N,), for positions (D, N, 3) in D demonstrations."""
    out: list[int] = []
    for i in range(at.shape[1]):
        alike = [out[j] for j in range(i) if np.linalg.norm(at[:, i] - at[:, j], axis=1).max() <= SAME_M]
        out.append(alike[0] if alike else max(out, default=-1) + 1)
    return np.array(out, np.int64)


def _along(tool: Vector, places: Vector) -> Vector:
    """Shares (T, N) of the point nearest to the tool (T, 3) on the way from place to place."""
    out, least = np.zeros((len(tool), len(places))), np.full(len(tool), np.inf)
    for i in range(len(places) - 1):
        way = places[i + 1] - places[i]
        along = np.clip((tool - places[i]) @ way / max(float(way @ way), 1e-9), 0.0, 1.0)
        off = np.sum((tool - places[i] - along[:, None] * way) ** 2, axis=1)
        nearer = off < least
        least[nearer] = off[nearer]
        out[nearer] = 0.0
        out[nearer, i], out[nearer, i + 1] = 1.0 - along[nearer], along[nearer]
    return out


def _known(told: Sequence[Told], task: Task) -> dict[tuple[int, int], int]:
    """At which place the tool always was while both hands were at these of theirs: inputs of the
    left and the right hand.
    """
    inputs = np.concatenate([one.inputs for one in told])
    shares = np.concatenate([one.shares for one in told])
    periods = np.concatenate([np.full(len(one.inputs), one.period_s) for one in told])
    out: dict[tuple[int, int], int] = {}
    for left in np.unique(task.inputs[0][task.inputs[0] >= 0]).tolist():
        for right in np.unique(task.inputs[1][task.inputs[1] >= 0]).tolist():
            there = (inputs[:, left] > AT) & (inputs[:, right] > AT)
            if periods[there].sum() >= LEAST_SAMPLES_S:
                usual = np.median(shares[there], axis=0)
                if usual.max() > ALIKE:
                    out[left, right] = int(np.argmax(usual))
    return out


def _pairs(task: Task, known: dict[tuple[int, int], int]) -> tuple[Vector, Vector]:
    """Inputs (V, F) and outputs (V, N + 2) of the known pairs of places, and of some of the way
    toward pairs at which nobody was: there the tool stays.
    """
    lefts, rights = (sorted({i for i in task.inputs[side].tolist() if i >= 0}) for side in (0, 1))
    count, at, wanted = len(task.names), [], []
    for (left, right), place in known.items():
        here = _corner(task, left, right)
        tool = np.append(np.eye(count)[place, 1:], np.zeros(3))
        at.append(here)
        wanted.append(tool)
        beside = [(other, right) for other in lefts if other != left]
        beside += [(left, other) for other in rights if other != right]
        for pair in beside:
            if pair not in known:
                at += [(1.0 - share) * here + share * _corner(task, *pair) for share in UNSEEN]
                wanted += [tool] * len(UNSEEN)
    return np.array(at).reshape(-1, task.width), np.array(wanted).reshape(-1, count + 2)


def _corner(task: Task, left: int, right: int) -> Vector:
    out = np.zeros(task.width)
    out[[left, right]] = 1.0
    return out


class Learned(NamedTuple):
    """A task's KMP, what belongs to it, what was predicted of each demonstration when it was left
    out, and the gate.
    """

    primitive: KMP
    between: LearnedBetween
    held_out: list[HeldOut]
    gate: Gate


def learned(
    task: Task,
    demonstrations: Sequence[Demonstration],
    paths: Sequence[tuple[Vector, Vector]],
    progress: Callable[[str], None],
) -> Learned:
    """What demonstrations, whose hands (T, 6) and tool (T, 3) are in phase, tell of their task."""
    pairs = list(zip(demonstrations, paths, strict=True))
    progress("which places make a difference")
    task, told, errors = merged(task, lambda of: [Told.of(of, one, *path) for one, path in pairs])
    parameters, least = USUAL, BETTER * rms(np.concatenate(errors))
    for i, tried in enumerate(OTHERS):
        progress(f"holding out each of {len(told)} demonstrations, parameters {i + 1} of {len(OTHERS)}")
        found = _left_out(task, told, tried)
        error = rms(np.concatenate(found))
        if error < least:
            parameters, errors, least = tried, found, error
    progress(f"learning from all {len(told)}")
    primitive = fitted(task, told, parameters)
    rows = [
        np.linspace(0, len(one.inputs) - 1, min(ERRORS_OF_EACH, len(one.inputs))).round().astype(int) for one in told
    ]
    seen = [one.inputs[some] for one, some in zip(told, rows, strict=True)]
    kept = [some_errors[some] for some_errors, some in zip(errors, rows, strict=True)]
    held_out = []
    for i, one in enumerate(told):
        others = [j for j in range(len(told)) if j != i] or [0]
        judge = Placed.of(
            task, one.layout, None, np.concatenate([seen[j] for j in others]), np.concatenate([kept[j] for j in others])
        )
        covariance = np.array([judge.covariance(row) for row in one.inputs])
        held_out.append(HeldOut(errors[i], covariance, one.off.max(axis=1)))
    nominal = Places(
        task.names, np.mean([Places.of(list(_ordered(d.places, task.names))).at for d in demonstrations], axis=0)
    )
    known = LearnedBetween(task, nominal, np.concatenate(seen), np.concatenate(kept))
    return Learned(primitive, known, held_out, _gate(task, told))


def _left_out(task: Task, told: Sequence[Told], parameters: Parameters) -> list[Vector]:
    """The tool's errors (T, 3) [m] in each demonstration, as predicted from the others; of a single
    one, from itself.
    """
    out = []
    for i, one in enumerate(told):
        without = fitted(task, [*told[:i], *told[i + 1 :]] or told, parameters)
        out.append(one.tool - Placed.of(task, one.layout, without).mean(one.hands, one.rest))
    return out


def _gate(task: Task, told: Sequence[Told]) -> Gate:
    """The gate on how far a hand is off its places."""
    wrong: list[list[Vector]] = [[], [], []]
    for one in told:
        for off, hands in zip(wrong, nonsense(one.hands[:: max(1, len(one.hands) // 50)]), strict=True):
            off.append(Placed.of(task, one.layout).inputs(hands)[1].max(axis=1))
    held_out = np.concatenate([one.off.max(axis=1) for one in told])
    return between(held_out, [np.concatenate(off) for off in wrong], ceiling=CEILING_M, false=FALSE)
