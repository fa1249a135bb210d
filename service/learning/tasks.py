"""Learning of a task: what demonstrations that name its via-points tell of it.

A KMP from the hands' barycentric weights to the tool's, and how it errs in demonstrations that were
left out.
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
from service.core.frame import Vector
from service.core.intake.hand_estimator import stillness_of
from service.core.skill.model import Model
from service.core.skill.task import LEFT, MOST_CORNERS, NONE, RIGHT, Indices, NamedViaPoints, Task, TaskParameters
from service.core.skill.task_parameterized import TaskInstance, TaskParameterized
from service.learning.choice import rms
from service.learning.demonstration import Demonstration
from service.learning.gate import CEILING_M, FLOOR_M, Gate, gate_between, nonsense
from service.learning.judgement import HeldOut
from service.learning.skill_file import SkillError

SAMPLES_LEARNED = 30  # of a demonstration, at most
ERRORS_KEPT = 40  # of a demonstration, at most
SMOOTHED_S = 0.28  # width of the window over the hands in demonstrations
SAME_M = 0.05  # positions of a hand that are no farther apart, in any demonstration, are one
HAND_THERE = 0.9  # weight from which on a hand is at a via-point
TOOL_THERE = 0.85  # the same of the tool, in the median
LEAST_SAMPLES_S = 0.4  # both hands must have been so long at a pair of positions for it to be known
UNSEEN = (0.15, 0.3, 0.45)  # shares of the way to a pair that nobody was at, where the tool stays
KNOWN_STD = 1e-4  # of the weight at a known pair
FALSE_HOLDS = 0.005  # share of the time the gate may hold: hands that start elsewhere come nearer, and are followed
BETTER = 0.98  # other parameters must have less than this share of the usual ones' error
FAR_M = 0.10  # a via-point that the tool never came so near is given wrong
FOLLOW = {"none": NONE, "left": LEFT, "right": RIGHT}


class Parameters(NamedTuple):
    """What a task's KMP is fitted with."""

    ell: float  # of the kernel, whose inputs are weights
    deviation: float  # of a demonstration's sample, in weights and metres


USUAL = Parameters(4.0, 0.05)
OTHERS = [
    tried for ell in (0.5, 1.0, 2.0, 4.0, 8.0) for d in (0.05, 0.15, 0.4) if (tried := Parameters(ell, d)) != USUAL
]


@dataclass(frozen=True, eq=False)
class Encoded:
    """A demonstration (T samples) in weights: the hands' (T, F), the tool's (T, N), and what is
    learned of them at some rows.
    """

    parameters: TaskParameters
    hands: Vector
    stillness: Vector  # (T, 2) of each hand
    tool: Vector
    inputs: Vector
    gate_m: Vector  # (T,) [m] of the farther hand from its via-points
    weights: Vector
    rows: Vector
    wanted: Vector  # (T, N + 2)
    period_s: float

    @staticmethod
    def of(task: Task, demonstration: Demonstration, hands: Vector, tool: Vector) -> Encoded:
        """The demonstration whose hands (T, 6) and tool (T, 3) are in phase."""
        period_s = demonstration.period_s
        hands = _smoothed(hands, round(SMOOTHED_S / period_s))
        stillness = stillness_of(np.gradient(hands, period_s, axis=0), period_s)
        parameters = task.parameters(NamedViaPoints.of(demonstration.places))
        instance = TaskInstance.of(task, parameters)
        inputs, gate_m = instance.inputs(hands, stillness)
        weights = _along(tool, parameters.tool)
        offset = tool - weights @ parameters.tool - instance.followed(hands, weights)
        steps = np.linalg.norm(np.diff(np.hstack([inputs, 3.0 * tool]), axis=0), axis=1) + 0.05 * period_s
        way = np.concatenate([[0.0], np.cumsum(steps)])
        rows = np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], SAMPLES_LEARNED)).clip(0, len(way) - 1))
        wanted = np.hstack([weights[:, 1:], offset])
        return Encoded(parameters, hands, stillness, tool, inputs, gate_m, weights, rows, wanted, period_s)


def task_of(demonstrations: Sequence[Demonstration]) -> Task | str:
    """The task of demonstrations, or why there is none, empty where no via-points are named."""
    named = [tuple(point.name for point in one.places) for one in demonstrations]
    if not any(named):
        return ""
    if len(set(map(frozenset, named))) > 1:
        return "not all demonstrations name the same via-points, so it is learned where the hands are, not between them"
    names = named[0]
    if len(names) < 2:
        return "two named via-points are the least to learn between"
    at = np.array([[[*p.left, *p.right] for p in _ordered(one.places, names)] for one in demonstrations])
    corners = np.stack([_corners(at[:, :, :3]), _corners(at[:, :, 3:])], axis=1)
    for side, word in enumerate(("left", "right")):
        if corners[:, side].max() >= MOST_CORNERS:
            return (
                f"the {word} hand has {corners[:, side].max() + 1} positions, {MOST_CORNERS} at most are learned "
                "between, so it is learned where the hands are"
            )
    inputs = np.full((2, MOST_CORNERS), -1)
    left, right = (int(corners[:, side].max()) + 1 for side in (0, 1))
    inputs[0, :left], inputs[1, :right] = np.arange(left), left + np.arange(right)
    follow = np.array([FOLLOW[p.follow] for p in _ordered(demonstrations[0].places, names)])
    return Task(names, corners, inputs, follow)


def via_points_never_reached(task: Task, demonstrations: Sequence[Demonstration], names: Sequence[str]) -> list[str]:
    """In words, which via-points the tool never came near in which demonstrations, by their names.

    Raises SkillError for one that it came near in none.
    """
    warned = []
    for named, follow in zip(task.names, task.follow.tolist(), strict=True):
        off = [float(off_via_point(one, next(_ordered(one.places, (named,))), follow).min()) for one in demonstrations]
        if min(off) > FAR_M:
            raise SkillError(
                f"via-point {named!r}: the tool never came nearer to it than {1000 * min(off):.0f} mm "
                f"({names[int(np.argmin(off))]}), {1000 * FAR_M:.0f} mm needed: is it given in metres, in frame base, "
                "where it was in these demonstrations?"
            )
        missed = [f"{name} ({1000 * m:.0f} mm)" for name, m in zip(names, off, strict=True) if m > FAR_M]
        if missed:
            warned.append(f"via-point {named!r}: the tool never came near it in {', '.join(missed)}")
    return warned


def off_via_point(demonstration: Demonstration, point: ViaPoint, follow: int) -> Vector:
    """The tool's distance (T,) from a via-point [m], there or with the hand that it follows."""
    off = demonstration.tool[:, :3] - point.tool
    out: Vector = np.linalg.norm(off, axis=1)
    if follow == NONE:
        return out
    hand = demonstration.hands[:, 3 * follow : 3 * follow + 3] - (point.left, point.right)[follow]
    return np.asarray(np.minimum(out, np.linalg.norm(off - hand, axis=1)))


def merged(task: Task, encode: Callable[[Task], list[Encoded]]) -> tuple[Task, list[Encoded], list[Vector]]:
    """The task with positions of a hand as one input, as long as that predicts demonstrations that
    are left out better; the demonstrations, encoded in that task; and their errors then, with the
    usual parameters.
    """

    def judged(task: Task) -> tuple[Task, list[Encoded], list[Vector]]:
        encoded = encode(task)
        return task, encoded, _left_out(task, encoded, USUAL)

    best = judged(task)
    while True:
        task, encoded, errors = best
        for pair in _alike(task, _known(encoded, task)):
            best = min(best, judged(_as_one(task, *pair)), key=lambda one: rms(np.concatenate(one[2])))
        if best[0] is task:
            return task, encoded, errors


def _alike(task: Task, known: dict[tuple[int, int], int]) -> list[tuple[int, int, int]]:
    """Side and two inputs, for positions of a hand that nothing shows the tool to tell apart."""
    out = []
    for side in (0, 1):
        for a, b in itertools.combinations(sorted({i for i in task.inputs[side].tolist() if i >= 0}), 2):
            at = [{pair[1 - side]: n for pair, n in known.items() if pair[side] == i} for i in (a, b)]
            if all(at[0][other] == at[1][other] for other in at[0].keys() & at[1].keys()):
                out.append((side, a, b))
    return out


def _as_one(task: Task, side: int, a: int, b: int) -> Task:
    inputs = task.inputs.copy()
    inputs[side, inputs[side] == b] = a
    _, renumbered = np.unique(inputs[inputs >= 0], return_inverse=True)
    inputs[inputs >= 0] = renumbered
    return task._replace(inputs=inputs)


def fitted(task: Task, encoded: Sequence[Encoded], parameters: Parameters = USUAL) -> KMP:
    """The KMP, with the tool at its via-point wherever both hands were found to be at theirs."""
    inputs = np.concatenate([one.inputs[one.rows] for one in encoded])
    outputs = np.concatenate([one.wanted[one.rows] for one in encoded])
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
    at, wanted = _pairs(task, _known(encoded, task))
    if not len(at):
        return primitive
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ViaPointMissed)
        known = Gaussians(wanted, np.tile(KNOWN_STD**2 * np.eye(width), (len(at), 1, 1)))
        return primitive.adapt(at, known, tolerance=0.05)


def _smoothed(hands: Vector, samples: int) -> Vector:
    window = np.hanning(samples + 2)[1:-1] if samples else np.ones(1)
    before = len(window) // 2
    padded = [np.pad(column, (before, len(window) - 1 - before), mode="edge") for column in hands.T]
    return np.stack([np.convolve(column, window / window.sum(), mode="valid") for column in padded], axis=1)


def _ordered(points: Sequence[ViaPoint], names: Sequence[str]) -> Iterator[ViaPoint]:
    by_name = {point.name: point for point in points}
    return (by_name[name] for name in names)


def _corners(at: Vector) -> Indices:
    """Which of its own positions a hand is at, (N,), for those (D, N, 3) in D demonstrations."""
    out: list[int] = []
    for i in range(at.shape[1]):
        alike = [out[j] for j in range(i) if np.linalg.norm(at[:, i] - at[:, j], axis=1).max() <= SAME_M]
        out.append(alike[0] if alike else max(out, default=-1) + 1)
    return np.array(out, np.int64)


def _along(tool: Vector, points: Vector) -> Vector:
    """Weights (T, N) of the point nearest to the tool (T, 3) on the way from point to point."""
    out, least = np.zeros((len(tool), len(points))), np.full(len(tool), np.inf)
    for i in range(len(points) - 1):
        way = points[i + 1] - points[i]
        along = np.clip((tool - points[i]) @ way / max(float(way @ way), 1e-9), 0.0, 1.0)
        off = np.sum((tool - points[i] - along[:, None] * way) ** 2, axis=1)
        nearer = off < least
        least[nearer] = off[nearer]
        out[nearer] = 0.0
        out[nearer, i], out[nearer, i + 1] = 1.0 - along[nearer], along[nearer]
    return out


def _known(encoded: Sequence[Encoded], task: Task) -> dict[tuple[int, int], int]:
    """At which via-point the tool always was while both hands were at these positions: inputs of
    the left and the right hand.
    """
    inputs = np.concatenate([one.inputs for one in encoded])
    weights = np.concatenate([one.weights for one in encoded])
    periods = np.concatenate([np.full(len(one.inputs), one.period_s) for one in encoded])
    out: dict[tuple[int, int], int] = {}
    for left in np.unique(task.inputs[0][task.inputs[0] >= 0]).tolist():
        for right in np.unique(task.inputs[1][task.inputs[1] >= 0]).tolist():
            there = (inputs[:, left] > HAND_THERE) & (inputs[:, right] > HAND_THERE)
            if periods[there].sum() >= LEAST_SAMPLES_S:
                usual = np.median(weights[there], axis=0)
                if usual.max() > TOOL_THERE:
                    out[left, right] = int(np.argmax(usual))
    return out


def _pairs(task: Task, known: dict[tuple[int, int], int]) -> tuple[Vector, Vector]:
    """Inputs (V, F) and outputs (V, N + 2) of the known pairs of positions, and of some of the way
    toward pairs at which nobody was: there the tool stays.
    """
    lefts, rights = (sorted({i for i in task.inputs[side].tolist() if i >= 0}) for side in (0, 1))
    count, at, wanted = len(task.names), [], []
    for (left, right), at_point in known.items():
        here = _corner(task, left, right)
        tool = np.append(np.eye(count)[at_point, 1:], np.zeros(3))
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
    return np.asarray(np.eye(task.width)[[left, right]].sum(axis=0))


class Learned(NamedTuple):
    """What demonstrations tell: a model, what was predicted of each when it was left out, the gate,
    and the inputs (T, I) of the primitives along each.
    """

    model: Model
    held_out: list[HeldOut]
    gate: Gate
    inputs: list[Vector]


def learned(
    task: Task,
    demonstrations: Sequence[Demonstration],
    paths: Sequence[tuple[Vector, Vector]],
    progress: Callable[[str], None],
) -> Learned:
    """What demonstrations, whose hands (T, 6) and tool (T, 3) are in phase, tell of their task."""
    pairs = list(zip(demonstrations, paths, strict=True))
    progress("which via-points make a difference")
    task, encoded, errors = merged(task, lambda of: [Encoded.of(of, one, *path) for one, path in pairs])
    parameters, least = USUAL, BETTER * rms(np.concatenate(errors))
    for i, tried in enumerate(OTHERS):
        progress(f"holding out each of {len(encoded)} demonstrations, parameters {i + 1} of {len(OTHERS)}")
        found = _left_out(task, encoded, tried)
        error = rms(np.concatenate(found))
        if error < least:
            parameters, errors, least = tried, found, error
    progress(f"learning from all {len(encoded)}")
    primitive = fitted(task, encoded, parameters)
    kept = []
    for one, some_errors in zip(encoded, errors, strict=True):
        rows = np.linspace(0, len(one.inputs) - 1, min(ERRORS_KEPT, len(one.inputs))).round().astype(int)
        kept.append(np.hstack([one.inputs[rows], some_errors[rows]]))
    held_out = []
    for i, one in enumerate(encoded):
        others = np.concatenate([*kept[:i], *kept[i + 1 :]] or kept)
        covariance = TaskInstance.of(task, one.parameters, None, others).covariances(one.inputs)
        held_out.append(HeldOut(errors[i], covariance, one.gate_m))
    at = [NamedViaPoints.of(list(_ordered(one.places, task.names))).at for one in demonstrations]
    nominal = NamedViaPoints(task.names, np.mean(at, axis=0))
    model = TaskParameterized(primitive, task, nominal, np.concatenate(kept))
    return Learned(model, held_out, _gate(task, encoded), [one.inputs for one in encoded])


def _left_out(task: Task, encoded: Sequence[Encoded], parameters: Parameters) -> list[Vector]:
    """The tool's errors (T, 3) [m] in each demonstration, predicted from the others or itself."""
    out = []
    for i, one in enumerate(encoded):
        without = fitted(task, [*encoded[:i], *encoded[i + 1 :]] or encoded, parameters)
        out.append(one.tool - TaskInstance.of(task, one.parameters, without).mean(one.hands, one.stillness))
    return out


def _gate(task: Task, encoded: Sequence[Encoded]) -> Gate:
    """The gate on how far a hand is off its via-points."""
    wrong = []
    for one in encoded:
        instance, some = TaskInstance.of(task, one.parameters), one.hands[:: max(1, len(one.hands) // 50)]
        wrong.append([instance.inputs(hands)[1] for hands in nonsense(some)])
    held_out = np.concatenate([one.gate_m for one in encoded])
    kinds = [np.concatenate(kind) for kind in zip(*wrong, strict=True)]
    return gate_between(held_out, kinds, ceiling=CEILING_M, floor=FLOOR_M, false=FALSE_HOLDS)
