"""Learning of a task: a KMP from how far along a stage the hands are to how far the tool is, and
how it errs in demonstrations that were left out.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from kmp import KMP, GaussianKernel, Gaussians, ViaPointMissed
from service.core.frame import Vector
from service.core.skill import ORDER
from service.core.skill.memory import along
from service.core.skill.model import Model
from service.core.skill.staged import Placed, StagedKMP
from service.core.skill.stages import MOST_STAGES, OUTPUTS, STAYS
from service.core.skill.task import Indices, NamedViaPoints, Task
from service.core.skill.tuning import STAGE_DISTANCE, STAGE_DISTANCE_BESIDE
from service.learning.choice import rms
from service.learning.demonstration import Demonstration, lag
from service.learning.division import NEAR, Encoded, along_all, ordered, recognised
from service.learning.gate import CEILING_M, FLOOR_M, Gate, gate_between, nonsense
from service.learning.judgement import HeldOut

SAMPLES_LEARNED = 600  # of all demonstrations together, about
ERRORS_KEPT = 600  # the same
LEAST_OFF_M = 0.03  # as people do, where few demonstrations tell it
LEAST_SEEN_S = 0.4  # so long one hand was there and the other not yet
CORNERS = ((1.0, 0.0), (0.0, 1.0))  # one hand is at its end, the other still at its begin
SEEN, UNSEEN = (0.5, 1.0), (0.15, 0.3, 0.45)  # shares of the way there, where the tool is said to stay
KNOWN_STD = 1e-3  # of how far along the tool is, where both hands are at an end
FALSE_HOLDS = 0.005  # share of the time the gate may hold: hands that start elsewhere come nearer, and are followed
MOST_DELAY_S = 0.6  # of a teacher


class Parameters(NamedTuple):
    """What a task's KMP is fitted with."""

    ell: float  # of the kernel, whose inputs are shares of the way
    noise: float  # a sample's variance over the kernel's


CANDIDATES = [Parameters(ell, noise) for ell in (4.0, 2.0, 8.0, 16.0) for noise in (0.1, 0.03, 0.3)]


class Samples(NamedTuple):
    """What is learned: demonstrations, inputs (N, 2 + K), outputs (N, OUTPUTS), and whose they are
    (N,).
    """

    encoded: Sequence[Encoded]
    inputs: Vector
    outputs: Vector
    owner: Indices

    @staticmethod
    def of(encoded: Sequence[Encoded]) -> Samples:
        """Those of demonstrations."""
        count = len(encoded[0].stages)
        each = [one.rows(max(10, SAMPLES_LEARNED // len(encoded))) for one in encoded]
        along = np.concatenate([one.along[rows] for one, rows in zip(encoded, each, strict=True)])
        labels = np.concatenate([one.labels[rows] for one, rows in zip(encoded, each, strict=True)])
        outputs = np.concatenate([one.wanted[rows] for one, rows in zip(encoded, each, strict=True)])
        owner = np.repeat(np.arange(len(encoded)), [len(rows) for rows in each])
        return Samples(encoded, inputs_of(along, labels, count, STAGE_DISTANCE), outputs, owner)

    def residuals(self, parameters: Parameters) -> Vector:
        """By how much the others miss each demonstration's samples, by block inverses (Rasmussen
        and Williams 2006, section 5.4.2).
        """
        squares = ((self.inputs[:, None] - self.inputs) ** 2).sum(axis=2)
        inverse = np.linalg.inv(np.exp(-parameters.ell * squares) + parameters.noise * np.eye(len(self.inputs)))
        weighted, out = inverse @ (self.outputs - PRIOR), np.zeros_like(self.outputs)
        for h in np.unique(self.owner):
            mine = self.owner == h
            out[mine] = np.linalg.solve(inverse[np.ix_(mine, mine)], weighted[mine])
        return out

    def missed_m(self, parameters: Parameters) -> float:
        """How far demonstrations are missed by the others [m], each way taken as of mean length."""
        missed = self.residuals(parameters)
        ways = [np.linalg.norm(one.stages["tool_way"], axis=1).mean() for one in self.encoded]
        return rms(missed[:, 1:] + missed[:, :1] * float(np.mean(ways)))

    def fitted(self, parameters: Parameters, without: Sequence[int] = ()) -> KMP:
        """The KMP, which has the tool at the end of a stage where both hands are there."""
        kept = ~np.isin(self.owner, without)
        covariance = np.tile(parameters.noise * np.eye(OUTPUTS), (int(kept.sum()), 1, 1))
        primitive = KMP.fit(
            self.inputs[kept],
            Gaussians(self.outputs[kept], covariance),
            kernel=GaussianKernel(parameters.ell),
            lambda_mean=1.0,
            prior_mean=PRIOR,
            representation="dense",
        )
        at, shares = self._known(without)
        wanted = np.column_stack([shares, np.zeros((len(at), OUTPUTS - 1))])
        known = Gaussians(wanted, np.tile(KNOWN_STD**2 * np.eye(OUTPUTS), (len(at), 1, 1)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ViaPointMissed)
            return primitive.adapt(at, known, tolerance=0.0)

    def _known(self, without: Sequence[int]) -> tuple[Vector, Vector]:
        """Where the tool is known to be, inputs (V, 2 + K), and how far along (V,): at the ends of
        a stage; and where one hand was at its end for long, the other still at its begin. The tool
        stays on the way to where nobody ever was so.
        """
        shown = [one for i, one in enumerate(self.encoded) if i not in without]
        squares = shown[0].stages["square"]
        both = np.flatnonzero((squares > STAYS).all(axis=1)).tolist()
        known: list[tuple[float, float, int, float]] = [(1.0, 1.0, k, 1.0) for k in range(len(squares))]
        known += [(*np.where(squares[k] > STAYS, 0.0, 1.0), k, 0.0) for k in np.flatnonzero(squares.any(axis=1))]
        for corner in CORNERS:
            nobody = _seen(shown, corner, both)[0] < LEAST_SEEN_S
            for k in both:
                lasts_s, shares = _seen(shown, corner, [k])
                usual = 0.0 if nobody else float(np.median(shares)) if lasts_s >= LEAST_SEEN_S else 0.5
                if usual < NEAR:
                    known += [(half * corner[0], half * corner[1], k, 0.0) for half in (UNSEEN if nobody else SEEN)]
                elif usual > 1.0 - NEAR:
                    known.append((*corner, k, 1.0))
        found = np.array(known)
        return inputs_of(found[:, :2], found[:, 2].astype(np.int64), len(shown[0].stages), STAGE_DISTANCE), found[:, 3]


def _seen(shown: Sequence[Encoded], corner: tuple[float, float], stages: Sequence[int]) -> tuple[float, Vector]:
    """How long [s] hands were so far along one of these stages, about, and how far the tool was."""
    rows = [one.near(corner, stages) for one in shown]
    lasts_s = sum(float(its.sum()) * one.period_s for one, its in zip(shown, rows, strict=True))
    return lasts_s, np.concatenate([one.wanted[its, 0] for one, its in zip(shown, rows, strict=True)])


PRIOR = np.array([0.5, 0.0, 0.0, 0.0])  # of the outputs, far from all samples


def inputs_of(along: Vector, labels: Indices, count: int, apart: float) -> Vector:
    """Inputs (T, 2 + K): how far along hands (T, 2) are, and the stages (T,) of K, so far apart."""
    return np.hstack([along, apart * np.eye(count)[labels]])


class Delay(NamedTuple):
    """How late a teacher was [s], and its standard deviation over the demonstrations."""

    mean_s: float
    std_s: float


class Learned(NamedTuple):
    """What demonstrations tell: a model, what was predicted of each when it was left out, the gate,
    the inputs (T, I) of the primitives along each, and what the tool is a function of (T, D) [m].
    """

    model: Model
    held_out: list[HeldOut]
    gate: Gate
    inputs: list[Vector]
    known: list[Vector]
    delay: Delay | None = None  # of the teacher, where it is learned
    beliefs: Sequence[Vector] = ()  # (T, K) in each of K stages along each demonstration


def delay_of(demonstrations: Sequence[Demonstration]) -> tuple[Delay, list[float]]:
    """The teacher's delay, and that in each demonstration [s]."""
    each = [min(max(lag(one) * one.period_s, 0.0), MOST_DELAY_S) for one in demonstrations]
    return Delay(float(np.median(each)), float(np.std(each))), each


def learned(
    task: Task,
    demonstrations: Sequence[Demonstration],
    blocks: Sequence[Sequence[int]],
    progress: Callable[[str], None],
) -> Learned:
    """What demonstrations tell of their task; what is left out is so in blocks."""
    progress("dividing demonstrations into stages")
    delay, each_s = delay_of(demonstrations)
    encoded = [Encoded.of(task, *one) for one in zip(demonstrations, each_s, strict=True)]
    samples, stages = Samples.of(encoded), encoded[0].stages
    parameters = min(CANDIDATES, key=samples.missed_m)
    labels, off = np.concatenate([one.labels for one in encoded]), np.concatenate([one.off for one in encoded])
    scatter = [off[labels == k] if (labels == k).any() else off for k in range(len(stages))]
    off = np.array([np.maximum(np.sqrt((one**2).mean(axis=0)), LEAST_OFF_M) for one in scatter])
    at = np.mean([NamedViaPoints.of(list(ordered(one.places, task.names))).at for one in demonstrations], axis=0)
    nominal = NamedViaPoints(task.names, at)
    errors, inputs, beliefs, lates = [], [], [], []
    of_block = {i: block for block in blocks for i in block}
    without = [samples.fitted(parameters, block if len(blocks) > 1 else ()) for block in blocks]
    for h, one in enumerate(encoded):
        progress(f"holding out demonstration {h + 1} of {len(encoded)}")
        primitive = next(found for found, block in zip(without, blocks, strict=True) if h in block)
        placed = Placed.of(task, one.at, off, primitive, np.empty((0, 6)))
        belief = np.zeros((len(one.tool), MOST_STAGES))
        recognised(one.moving, one.period_s, placed.stages, belief)
        late = _late(one, delay.mean_s)
        errors.append(one.tool - placed.mean(late, belief, one.stillness))
        most = belief.argmax(axis=1)
        found = np.empty((len(late), 4))
        along_all(late, one.stillness, most, placed.stages, found)
        inputs.append(np.hstack([found[:, :2], STAGE_DISTANCE_BESIDE * belief[:, : len(stages)]]))
        beliefs.append(belief)
        lates.append(late)
    kept = [_kept(*one, ERRORS_KEPT // len(encoded)) for one in zip(inputs, errors, strict=True)]
    progress(f"learning from all {len(encoded)}")
    model = StagedKMP(samples.fitted(parameters), task, nominal, off, np.concatenate(kept), delay.mean_s)
    held_out, there = [], []
    for h, one in enumerate(encoded):
        others = np.concatenate([found for i, found in enumerate(kept) if i not in of_block[h]] or kept)
        placed = Placed.of(task, one.at, off, model.primitive, others)
        covariance = np.array(
            [placed.covariance(*row) for row in zip(lates[h], beliefs[h], one.stillness, strict=True)]
        )
        held_out.append(HeldOut(errors[h], covariance, placed.gates_m(one.moving[:, 0])))
        there.append(placed)
    known = [np.hstack([one.moving[:, 0], x[:, 2:]]) for one, x in zip(encoded, inputs, strict=True)]
    return Learned(
        model,
        held_out,
        _gate(encoded, there, held_out),
        inputs,
        known,
        delay,
        [one[:, : len(stages)] for one in beliefs],
    )


def _late(one: Encoded, late_s: float) -> Vector:
    """Hands (T, 6) as the loop delays them."""
    if late_s <= 0.0:
        return one.moving[:, 0]
    return np.ascontiguousarray(along(one.moving[:, 0], one.period_s, late_s / ORDER, ORDER)[:, -1])


def _kept(inputs: Vector, errors: Vector, count: int) -> Vector:
    """Errors (M, 6) at some of a demonstration's samples: how far along hands were, the stage."""
    rows = np.linspace(0, len(inputs) - 1, min(count, len(inputs))).round().astype(int)
    return np.column_stack([inputs[rows, :2], inputs[rows, 2:].argmax(axis=1), errors[rows]])


def _gate(encoded: Sequence[Encoded], placed: Sequence[Placed], held_out: Sequence[HeldOut]) -> Gate:
    """The gate on how far a hand is off its ways."""
    wrong = []
    for one, there in zip(encoded, placed, strict=True):
        hands = one.moving[:, 0]
        wrong.append([there.gates_m(moved) for moved in nonsense(hands[:: max(1, len(hands) // 50)])])
    reached = np.concatenate([one.gate_m for one in held_out])
    kinds = [np.concatenate(kind) for kind in zip(*wrong, strict=True)]
    return gate_between(reached, kinds, ceiling=CEILING_M, floor=FLOOR_M, false=FALSE_HOLDS)
