"""Rivals on left-out takes: the simplest predictions, Gaussian processes with and without a memory,
and an HMM over the samples of all demonstrations.

A rival with given via-points predicts in the mean scene: hands are mapped to it, and the tool back,
by the displacements of the via-points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from thirdhand.core.skill.skill import Skill
from thirdhand.workbench.learning.baselines import linear
from thirdhand_sim.lab.people.left_out import JUDGED_HZ, LeftOut
from thirdhand_sim.lab.results import Array
from thirdhand_sim.lab.rivals.gaussian_process import by_folds
from thirdhand_sim.lab.rivals.method import Law, Learn, Observed, Predicted

MOVES_MPS = 0.08  # a hand that moves faster begins the task
MEMORY_S = (0.25, 0.5, 1.0, 2.0)  # times before the present at which past hands are inputs
HMM_STATES = 6000
CORRELATED = 0.2  # weight of an observation in the HMM, as consecutive ones are correlated
RESTARTS = 1e-4  # probability, at each sample, that the hands are anywhere in any demonstration
DERIVATIVE_STEP_S = 0.01  # step of the numerical derivative by which velocities are carried
OFF_PLACE_M = 0.02  # within this distance of a via-point, its own displacement dominates


def carried(points: Array, here: Array, there: Array) -> Array:
    """Points (T, 3) moved by the displacements of places (K, 3) from `here` to `there`, weighted by
    distance (Shepard's interpolation).
    """
    weights = 1.0 / (cdist(points, here, "sqeuclidean") + OFF_PLACE_M**2) ** 2
    return np.asarray(points + weights / weights.sum(axis=1, keepdims=True) @ (there - here))


def scene_of(take: LeftOut) -> Array:
    """A take's places (3, K, 3) [m] of left hand, right hand and tool, by name."""
    named = sorted(take.demonstration.via_points, key=lambda point: point.name)
    return np.array([[p.left for p in named], [p.right for p in named], [p.tool for p in named]])


def in_mean_scene(take: LeftOut, mean: Array | None) -> LeftOut:
    """A take carried to the mean scene (3, K, 3), if there is one."""
    if mean is None:
        return take
    scene = scene_of(take)

    def of_both(x: Array) -> Array:
        return np.hstack([carried(x[:, 3 * i : 3 * i + 3], scene[i], mean[i]) for i in (0, 1)])

    hands = of_both(take.hands)
    velocities = (
        of_both(take.hands + DERIVATIVE_STEP_S * take.velocities) - hands
    ) / DERIVATIVE_STEP_S
    return take._replace(
        hands=hands, velocities=velocities, tool=carried(take.tool, scene[2], mean[2])
    )


def past(seen: Observed | LeftOut) -> Array:
    """Hands at the times of MEMORY_S before now, relative to now: (T, 6 M) [m]."""
    now = np.arange(len(seen.hands))
    return np.hstack(
        [seen.hands[np.maximum(0, now - round(s * JUDGED_HZ))] - seen.hands for s in MEMORY_S]
    )


def clock(seen: Observed | LeftOut) -> Array:
    """The time [s] since a hand first moved faster than MOVES_MPS, (T, 1); 0 before."""
    speeds = np.linalg.norm(seen.velocities.reshape(len(seen.times), 2, 3), axis=2).max(axis=1)
    begins = (
        seen.times[int(np.argmax(speeds > MOVES_MPS))] if (speeds > MOVES_MPS).any() else np.inf
    )
    return np.asarray(np.maximum(seen.times - begins, 0.0)[:, None])


def left_out_by(
    learn: Learn, shown: Sequence[LeftOut], asked: Sequence[LeftOut], *, told: bool
) -> list[Predicted]:
    """Predictions of takes by a rival that learns from others, with the via-points or without."""
    mean = np.mean([scene_of(take) for take in shown], axis=0) if told else None
    model = learn([in_mean_scene(take, mean) for take in shown])
    out = []
    for take in asked:
        placed = model.place(None)
        assert not isinstance(placed, Skill)
        prediction = placed.predict(in_mean_scene(take, mean).seen)
        back = (
            prediction.mean
            if mean is None
            else carried(prediction.mean, mean[2], scene_of(take)[2])
        )
        out.append(prediction._replace(mean=back))
    return out


def mean_of_all(shown: Sequence[LeftOut]) -> Law:
    """The mean position of the tool."""
    mean = np.concatenate([take.tool for take in shown]).mean(axis=0)
    return Law(lambda seen: Predicted(np.tile(mean, (len(seen.hands), 1))))


def same_time(shown: Sequence[LeftOut]) -> Law:
    """The mean tool after the same elapsed time; after the end of a take, its last one."""

    def predict(seen: Observed) -> Predicted:
        tools = [
            take.tool[np.minimum(np.arange(len(seen.times)), len(take.tool) - 1)] for take in shown
        ]
        return Predicted(np.mean(tools, axis=0))

    return Law(predict)


def linear_in_hands(shown: Sequence[LeftOut]) -> Law:
    """The linear function of the hands that fits best."""
    hands, tool = (
        np.concatenate(parts)
        for parts in zip(*((take.hands, take.tool) for take in shown), strict=True)
    )
    return Law(lambda seen: Predicted(linear(hands, tool, seen.hands)))


def neighbours(shown: Sequence[LeftOut]) -> Law:
    """The mean of the tools at the nearest hands of each take, weighted by distance."""
    trees = [cKDTree(take.hands) for take in shown]

    def predict(seen: Observed) -> Predicted:
        nearest = [tree.query(seen.hands) for tree in trees]
        weights = np.array([1.0 / (distance_m + OFF_PLACE_M) ** 4 for distance_m, _ in nearest])
        tools = np.array(
            [take.tool[index] for take, (_, index) in zip(shown, nearest, strict=True)]
        )
        return Predicted(np.einsum("kt,kti->ti", weights / weights.sum(axis=0), tools))

    return Law(predict)


def hmm(shown: Sequence[LeftOut]) -> Law:
    """The mean of the tools, weighted by the probability that the hands are at each sample of each
    demonstration. The state proceeds along one demonstration at about its pace, or restarts
    anywhere.
    """
    total = sum(len(take.tool) for take in shown)
    step = max(1, -(-total // HMM_STATES))
    thin = [(take.hands[::step], take.velocities[::step], take.tool[::step]) for take in shown]
    hands, velocities, tool = (np.concatenate(parts) for parts in zip(*thin, strict=True))
    counts = [len(part) for part, *_ in thin]
    last = np.cumsum(counts) - 1
    owner = np.repeat(np.arange(len(thin)), counts)
    place, pace = (_scatter(x, owner) for x in (hands, velocities))
    features = np.hstack([hands / place, velocities / pace])
    starts = np.concatenate([[0], last[:-1] + 1])
    onward = 0.6 / step
    further = 0.2 / step
    ends_next = np.isin(np.arange(len(owner)), starts)
    ends_second = ends_next | np.isin(np.arange(len(owner)), starts + 1)

    def predict(seen: Observed) -> Predicted:
        rows = np.hstack([seen.hands / place, seen.velocities / pace])
        log = -0.5 * CORRELATED * cdist(rows, features, "sqeuclidean")
        belief = np.full(len(owner), 0.1 / len(owner))
        belief[starts] += 0.9 / len(starts)
        means = []
        covariances = []
        for row in log:
            belief = belief * np.exp(row - row.max())
            belief /= belief.sum()
            mean = belief @ tool
            means.append(mean)
            covariances.append(
                (tool - mean).T @ (belief[:, None] * (tool - mean)) + 1e-4 * np.eye(3)
            )
            first = np.roll(belief, 1)
            second = np.roll(belief, 2)
            first[ends_next] = 0.0
            second[ends_second] = 0.0
            stays = (1.0 - onward - further) * belief
            stays[last] = belief[last]
            belief = (1.0 - RESTARTS) * (
                stays + onward * first + further * second
            ) + RESTARTS / len(owner)
        return Predicted(np.array(means), np.array(covariances))

    return Law(predict)


def _scatter(x: Array, owner: NDArray[np.int_]) -> float:
    """Rms distance, on each axis, of samples (N, D) from the nearest ones of other takes."""
    distances_m = []
    for number in np.unique(owner):
        mine = x[owner == number]
        distances_m.append(cKDTree(x[owner != number]).query(mine[:: max(1, len(mine) // 100)])[0])
    return max(float(np.sqrt(np.mean(np.concatenate(distances_m) ** 2) / x.shape[1])), 1e-3)


RIVALS: dict[str, Learn] = {
    "mean": mean_of_all,
    "same elapsed time": same_time,
    "linear": linear_in_hands,
    "nearest neighbours": neighbours,
    "Gaussian process": by_folds(lambda seen: [seen.hands]),
    "with velocities": by_folds(lambda seen: [seen.hands, seen.velocities]),
    "with 2 s of memory": by_folds(lambda seen: [seen.hands, past(seen)]),
    "memory and clock": by_folds(lambda seen: [seen.hands, past(seen), clock(seen)]),
    "HMM over demonstrations": hmm,
}
