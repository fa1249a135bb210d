"""What a skill is compared with on takes that are left out: the simplest predictions, a Gaussian
process without and with what was before, and an HMM that finds where in which demonstration it is.

All are given the hands as the core estimates them. One that is told the places of a scene sees
hands, and says the tool, in the mean scene: carried there and back by the places' displacements.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from service.learning.baselines import linear
from sim.experiments.people.left_out import JUDGED_HZ, LeftOut, Predicted
from sim.experiments.results import Array

MEMORY_S = (0.25, 0.5, 1.0, 2.0)  # before now
PROCESS_SAMPLES, FOLDS = 400, 4
LENGTHS, OTHERS, NOISES = (0.15, 0.3, 0.6, 1.2), (1.0, 0.3, 3.0), (0.01, 0.1, 1.0)  # of the inputs' median distance
HMM_STATES = 6000
CORRELATED = 0.2  # by which an HMM trusts a sample, as the next is off alike
RESTARTS = 1e-4  # how probable it is, at each sample, that hands are anywhere in any demonstration
STEP_S = 0.01  # over which velocities are carried
OFF_PLACE_M = 0.02  # nearer to a place nothing but its own displacement counts


class Rows(NamedTuple):
    """Takes' samples: times (T,) [s], hands (T, 6) [m], velocities (T, 6) [m/s], where the hands
    were before beside where they are (T, 6 M) [m], tool (T, 3) [m].
    """

    times: Array
    hands: Array
    velocities: Array
    past: Array
    tool: Array


Predict: TypeAlias = Callable[[Rows], Predicted]
Learn: TypeAlias = Callable[[Sequence[Rows]], Predict]


def carried(points: Array, here: Array, there: Array) -> Array:
    """Points (T, 3) by the displacements of places (K, 3) from here to there: those of the nearest
    places count most (Shepard's interpolation).
    """
    weights = 1.0 / (cdist(points, here, "sqeuclidean") + OFF_PLACE_M**2) ** 2
    return np.asarray(points + weights / weights.sum(axis=1, keepdims=True) @ (there - here))


def scene_of(take: LeftOut) -> Array:
    """A take's places (3, K, 3) [m] of left hand, right hand and tool, by name."""
    named = sorted(take.demonstration.places, key=lambda point: point.name)
    return np.array([[p.left for p in named], [p.right for p in named], [p.tool for p in named]])


def rows_of(take: LeftOut, mean: Array | None) -> Rows:
    """A take's samples, in the mean scene (3, K, 3) if there is one."""
    hands, velocities, tool = take.hands, take.velocities, take.tool
    if mean is not None:
        scene = scene_of(take)

        def of_both(x: Array) -> Array:
            return np.hstack([carried(x[:, 3 * i : 3 * i + 3], scene[i], mean[i]) for i in (0, 1)])

        moved = of_both(hands)
        velocities = (of_both(hands + STEP_S * velocities) - moved) / STEP_S
        hands, tool = moved, carried(tool, scene[2], mean[2])
    now = np.arange(len(hands))
    past = [hands[np.maximum(0, now - round(s * JUDGED_HZ))] - hands for s in MEMORY_S]
    return Rows(take.times, hands, velocities, np.hstack(past), tool)


def left_out_by(learn: Learn, shown: Sequence[LeftOut], asked: Sequence[LeftOut], *, told: bool) -> list[Predicted]:
    """What a rival, which is shown some takes, predicts of others."""
    mean = np.mean([scene_of(take) for take in shown], axis=0) if told else None
    predict = learn([rows_of(take, mean) for take in shown])
    out = []
    for take in asked:
        said = predict(rows_of(take, mean))
        back = said.mean if mean is None else carried(said.mean, mean[2], scene_of(take)[2])
        out.append(said._replace(mean=back))
    return out


def _together(shown: Sequence[Rows]) -> Rows:
    return Rows(*(np.concatenate(parts) for parts in zip(*shown, strict=True)))


def mean_of_all(shown: Sequence[Rows]) -> Predict:
    """The tool's mean."""
    mean = _together(shown).tool.mean(axis=0)
    return lambda asked: Predicted(np.tile(mean, (len(asked.hands), 1)))


def same_time(shown: Sequence[Rows]) -> Predict:
    """The mean of where the tool was after as much time; after its take's end, where it ended."""

    def predict(asked: Rows) -> Predicted:
        at = [one.tool[np.minimum(np.arange(len(asked.times)), len(one.tool) - 1)] for one in shown]
        return Predicted(np.mean(at, axis=0))

    return predict


def linear_in_hands(shown: Sequence[Rows]) -> Predict:
    """The linear function of the hands that fits best."""
    known = _together(shown)
    return lambda asked: Predicted(linear(known.hands, known.tool, asked.hands))


def neighbours(shown: Sequence[Rows]) -> Predict:
    """The mean of the tools where hands were nearest in each take, the nearer the more."""
    trees = [cKDTree(one.hands) for one in shown]

    def predict(asked: Rows) -> Predicted:
        found = [tree.query(asked.hands) for tree in trees]
        weights = np.array([1.0 / (off + OFF_PLACE_M) ** 4 for off, _ in found])
        tools = np.array([one.tool[at] for one, (_, at) in zip(shown, found, strict=True)])
        return Predicted(np.einsum("kt,kti->ti", weights / weights.sum(axis=0), tools))

    return predict


def process(inputs: Callable[[Rows], list[Array]]) -> Learn:
    """A Gaussian process whose length for each group of inputs and noise predict shown takes best
    from the others; its variance is scaled to the errors there.
    """

    def learn(shown: Sequence[Rows]) -> Predict:
        each = max(2, PROCESS_SAMPLES // len(shown))
        thin = [Rows(*(x[_spread(len(x), each)] for x in one)) for one in shown]
        some = _together(thin)
        groups = inputs(some)
        squares = [cdist(x, x, "sqeuclidean") for x in groups]
        usual = [max(float(np.median(d)), 1e-6) for d in squares]
        out = np.repeat(np.arange(len(thin)) % FOLDS, [len(one.tool) for one in thin])
        tried = []
        for length, other, noise in itertools.product(LENGTHS, OTHERS if len(groups) > 1 else OTHERS[:1], NOISES):
            lengths = length**2 * np.array(usual) * [1.0, *[other**2] * (len(groups) - 1)]
            known = np.exp(-0.5 * np.sum([d / square for d, square in zip(squares, lengths, strict=True)], axis=0))
            errors, variances = [], []
            for fold in np.unique(out):
                rest, held = out != fold, out == fold
                said, left = _solved(known[np.ix_(rest, rest)], some.tool[rest], noise)(known[np.ix_(held, rest)])
                errors.append(np.sum((some.tool[held] - said) ** 2, axis=1))
                variances.append(left)
            off, left = np.concatenate(errors), np.concatenate(variances)
            tried.append((float(off.mean()), lengths, noise, float(np.mean(off / left)) / 3.0))
        _, lengths, noise, scale = min(tried, key=lambda one: one[0])

        def kernel(a: list[Array], b: list[Array]) -> Array:
            apart = [cdist(x, y, "sqeuclidean") / square for x, y, square in zip(a, b, lengths, strict=True)]
            return np.asarray(np.exp(-0.5 * np.sum(apart, axis=0)))

        solved = _solved(kernel(groups, groups), some.tool, noise)

        def predict(asked: Rows) -> Predicted:
            said, left = solved(kernel(inputs(asked), groups))
            return Predicted(said, np.maximum(scale * left, 1e-6)[:, None, None] * np.eye(3))

        return predict

    return learn


def _solved(known: Array, tool: Array, noise: float) -> Callable[[Array], tuple[Array, Array]]:
    """A process of unit variance whose data's kernel (N, N) and outputs (N, 3) are given: from rows
    of the kernel (M, N) to means (M, 3) and variances (M,).
    """
    root, centre = cho_factor(known + noise * np.eye(len(known)), lower=True), tool.mean(axis=0)
    weights = cho_solve(root, tool - centre)
    return lambda rows: (rows @ weights + centre, 1.0 + noise - np.sum(rows * cho_solve(root, rows.T).T, axis=1))


def hmm(shown: Sequence[Rows]) -> Predict:
    """The mean of the tools by how probable it is that the hands are at each sample of each
    demonstration, found on line: they go on in one at about its pace, or are anywhere.
    """
    total = sum(len(one.tool) for one in shown)
    step = max(1, -(-total // HMM_STATES))
    thin = [Rows(*(x[::step] for x in one)) for one in shown]
    known, last = _together(thin), np.cumsum([len(one.tool) for one in thin]) - 1
    owner = np.repeat(np.arange(len(thin)), [len(one.tool) for one in thin])
    place, pace = (_scatter(x, owner) for x in (known.hands, known.velocities))
    features = np.hstack([known.hands / place, known.velocities / pace])
    starts = np.concatenate([[0], last[:-1] + 1])
    onward, further = 0.6 / step, 0.2 / step
    ends_next = np.isin(np.arange(len(owner)), starts)
    ends_second = ends_next | np.isin(np.arange(len(owner)), starts + 1)

    def predict(asked: Rows) -> Predicted:
        log = (
            -0.5
            * CORRELATED
            * cdist(np.hstack([asked.hands / place, asked.velocities / pace]), features, "sqeuclidean")
        )
        belief = np.full(len(owner), 0.1 / len(owner))
        belief[starts] += 0.9 / len(starts)
        means, covariances = [], []
        for row in log:
            belief = belief * np.exp(row - row.max())
            belief /= belief.sum()
            mean = belief @ known.tool
            means.append(mean)
            covariances.append((known.tool - mean).T @ (belief[:, None] * (known.tool - mean)) + 1e-4 * np.eye(3))
            first, second = np.roll(belief, 1), np.roll(belief, 2)
            first[ends_next], second[ends_second] = 0.0, 0.0
            stays = (1.0 - onward - further) * belief
            stays[last] = belief[last]
            belief = (1.0 - RESTARTS) * (stays + onward * first + further * second) + RESTARTS / len(owner)
        return Predicted(np.array(means), np.array(covariances))

    return predict


def _scatter(x: Array, owner: NDArray[np.int_]) -> float:
    """How far, on each axis, samples (N, D) are from the nearest ones of other takes: rms."""
    off = []
    for one in np.unique(owner):
        mine = x[owner == one]
        off.append(cKDTree(x[owner != one]).query(mine[:: max(1, len(mine) // 100)])[0])
    return max(float(np.sqrt(np.mean(np.concatenate(off) ** 2) / x.shape[1])), 1e-3)


def _spread(count: int, each: int) -> Array:
    return np.unique(np.linspace(0, count - 1, each).round().astype(int))


RIVALS: dict[str, Learn] = {
    "mean": mean_of_all,
    "same elapsed time": same_time,
    "linear": linear_in_hands,
    "nearest neighbours": neighbours,
    "Gaussian process": process(lambda rows: [rows.hands]),
    "with velocities": process(lambda rows: [rows.hands, rows.velocities]),
    "with 2 s of memory": process(lambda rows: [rows.hands, rows.past]),
    "HMM over demonstrations": hmm,
}
