"""Learning of a task with named via-points: a KMP from the share of a stage that each hand has
covered to the share that the tool covers, with the teacher's delay and the errors of held-out
demonstrations.

A stage lies between two via-points. Which one it is, the skill estimates by the belief b (K,) over
the K stages, the forward filter of a hidden Markov model with transition rates A and likelihoods l,
see `service.core.skill.stages.recognise`:

    b(t) ~ l(t) ∘ (I + dt A)ᵀ b(t - dt)

Held-out predictions use the belief that the filter has along the take, and the delayed hands.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import numpy as np

from kmp import KMP, GaussianKernel, Gaussians, ViaPointMissed
from kmp.criteria.cross_validation import held_out_residuals, rms
from service.core.frame import Vector
from service.core.skill import ORDER
from service.core.skill.memory import along
from service.core.skill.staged import Placed, StagedKMP, Unknown
from service.core.skill.stages import MOST_STAGES, NONE, OUTPUTS, STAYS
from service.core.skill.task import Indices, NamedViaPoints, Task
from service.core.skill.tuning import STAGE_DISTANCE, STAGE_DISTANCE_BESIDE
from service.learning.demonstration import Demonstration, lag
from service.learning.division import NEAR, Encoded, along_all, ordered, recognised, task_of, via_points_never_reached
from service.learning.gate import CEILING_M, FLOOR_M, every_few, gate_between, nonsense
from service.learning.methods.held_out import held_out_takes
from service.learning.methods.inputs import POSITIONS, refit
from service.learning.records import Delay, Fitted, HeldOut, Options, Progress, Take, persons_of
from service.learning.regions import blocks_of, unknown_std

SAMPLES_LEARNED = 600  # samples of all demonstrations that are learned from
LEAST_SAMPLES = 10  # samples of a demonstration that are learned from
ERRORS_RETAINED = 600  # errors of all demonstrations that the skill keeps
LEAST_OFF_M = 0.03  # hands deviate from their segments by at least this distance, also where few takes show it
LEAST_SEEN_S = 0.4  # a corner counts as demonstrated if hands were near it for this time
CORNERS = ((1.0, 0.0), (0.0, 1.0))  # one hand is at the end of its segment, the other still at the start
SEEN_SHARES = (0.5, 1.0)  # the tool waits at these shares of the way to a corner that was demonstrated
UNSEEN_SHARES = (0.15, 0.3, 0.45)  # the same for a corner that no demonstration has
KNOWN_STD = 1e-3  # standard deviation of the tool's share where it is known
HOLD_SHARE = 0.005  # share of the time that the gate may hold: hands that start elsewhere approach, and are followed
MOST_DELAY_S = 0.6  # a teacher's delay is at most this long
WITHOUT_PLACES = "without places"  # in a skill's figures
PRIOR = np.array([0.5, 0.0, 0.0, 0.0])  # outputs far from all samples: half of the way, no offset


class Hyperparameters(NamedTuple):
    """The hyper-parameters of a task's KMP."""

    ell: float  # of the kernel, whose inputs are shares
    noise: float  # variance of a sample / variance of the kernel


ELLS, NOISES = (4.0, 2.0, 8.0, 16.0), (0.1, 0.03, 0.3)  # candidates


class Samples(NamedTuple):
    """The samples that are learned from: inputs (N, 2 + K), outputs (N, OUTPUTS), and the numbers
    (N,) of their demonstrations.
    """

    encoded: Sequence[Encoded]
    inputs: Vector
    outputs: Vector
    owner: Indices

    @classmethod
    def of(cls, encoded: Sequence[Encoded]) -> Self:
        """The samples of demonstrations."""
        count = len(encoded[0].stages)
        each = [one.rows(max(LEAST_SAMPLES, SAMPLES_LEARNED // len(encoded))) for one in encoded]
        shares, labels, outputs = (
            np.concatenate([values[rows] for values, rows in zip(column, each, strict=True)])
            for column in zip(*((one.along, one.labels, one.wanted) for one in encoded), strict=True)
        )
        owner = np.repeat(np.arange(len(encoded)), [len(rows) for rows in each])
        return cls(encoded, inputs_of(shares, labels, count), outputs, owner)

    def best(self) -> Hyperparameters:
        """The hyper-parameters with the least error of held-out demonstrations, if each segment of
        the tool had the mean length.
        """
        lengths = [np.linalg.norm(one.stages["tool_way"], axis=1).mean() for one in self.encoded]
        squares = ((self.inputs[:, None] - self.inputs) ** 2).sum(axis=2)
        errors_m = {}
        for ell in ELLS:
            residuals = held_out_residuals(
                np.exp(-ell * squares), np.array(NOISES), self.owner, lambda _: self.outputs - PRIOR
            )
            for noise, missed in zip(NOISES, residuals, strict=True):
                errors_m[Hyperparameters(ell, noise)] = rms(missed[:, 1:] + missed[:, :1] * float(np.mean(lengths)))
        return min(errors_m, key=errors_m.__getitem__)

    def fitted(self, parameters: Hyperparameters, without: Sequence[int] = ()) -> KMP:
        """The KMP of all demonstrations but these, adapted to where the tool is known to be."""
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
        at, shares = self._known([one for i, one in enumerate(self.encoded) if i not in without])
        wanted = np.column_stack([shares, np.zeros((len(at), OUTPUTS - 1))])
        known = Gaussians(wanted, np.tile(KNOWN_STD**2 * np.eye(OUTPUTS), (len(at), 1, 1)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ViaPointMissed)
            return primitive.adapt(at, known, tolerance=0.0)

    @staticmethod
    def _known(shown: Sequence[Encoded]) -> tuple[Vector, Vector]:
        """Inputs (V, 2 + K) at which the tool's share (V,) is known.

        The share is 1 at the end of a stage and 0 at its start. At a corner it is 0 or 1 if the
        tool usually was at that end, and 0 if no demonstration has the corner.
        """
        squares = shown[0].stages["square"]
        both = np.flatnonzero((squares > STAYS).all(axis=1)).tolist()
        known: list[tuple[float, float, int, float]] = [(1.0, 1.0, k, 1.0) for k in range(len(squares))]
        known += [(*np.where(squares[k] > STAYS, 0.0, 1.0), k, 0.0) for k in np.flatnonzero(squares.any(axis=1))]
        for corner in CORNERS:
            is_unseen = _seen(shown, corner, both)[0] < LEAST_SEEN_S
            for k in both:
                lasts_s, shares = _seen(shown, corner, [k])
                usual = 0.0 if is_unseen else float(np.median(shares)) if lasts_s >= LEAST_SEEN_S else 0.5
                if usual < NEAR:
                    waits = UNSEEN_SHARES if is_unseen else SEEN_SHARES
                    known += [(share * corner[0], share * corner[1], k, 0.0) for share in waits]
                elif usual > 1.0 - NEAR:
                    known.append((*corner, k, 1.0))
        found = np.array(known)
        return inputs_of(found[:, :2], found[:, 2].astype(np.int64), len(squares)), found[:, 3]


def _seen(shown: Sequence[Encoded], corner: tuple[float, float], stages: Sequence[int]) -> tuple[float, Vector]:
    """The time [s] that hands were near a corner of these stages, and the tool's shares then."""
    rows = [one.near(corner, stages) for one in shown]
    lasts_s = sum(float(its.sum()) * one.period_s for one, its in zip(shown, rows, strict=True))
    return lasts_s, np.concatenate([one.wanted[its, 0] for one, its in zip(shown, rows, strict=True)])


def inputs_of(shares: Vector, labels: Indices, count: int) -> Vector:
    """The inputs (T, 2 + K) for shares (T, 2) of both hands in the stages (T,) of K."""
    return np.hstack([shares, STAGE_DISTANCE * np.eye(count)[labels]])


def delay_of(demonstrations: Sequence[Demonstration]) -> tuple[Delay, list[float]]:
    """The teacher's delay, the median over the demonstrations, and the delay [s] in each."""
    each_s = [min(max(lag(one) * one.period_s, 0.0), MOST_DELAY_S) for one in demonstrations]
    return Delay(float(np.median(each_s)), float(np.std(each_s))), each_s


class _Prediction(NamedTuple):
    """A take's mean prediction without its block: the delayed hands (T, 6) [m], the belief
    (T, MOST_STAGES), errors (T, 3) [m], and inputs (T, 2 + K) of primitives beside the position's.
    """

    hands: Vector
    belief: Vector
    errors: Vector
    inputs: Vector

    @classmethod
    def of(cls, one: Encoded, placed: Placed, delay_s: float) -> Self:
        belief = np.zeros((len(one.tool), MOST_STAGES))
        recognised(one.moving, one.period_s, placed.stages, belief)
        hands = one.moving[:, 0]
        if delay_s > 0.0:
            hands = np.ascontiguousarray(along(hands, one.period_s, delay_s / ORDER, ORDER)[:, -1])
        errors = one.tool - placed.mean(hands, belief, one.stillness)
        found = np.empty((len(hands), 4))
        along_all(hands, one.stillness, belief.argmax(axis=1), placed.stages, found)
        beside = STAGE_DISTANCE_BESIDE * belief[:, : len(one.stages)]
        return cls(hands, belief, errors, np.hstack([found[:, :2], beside]))

    def retained(self, count: int) -> Vector:
        """Errors (M, 6) at about `count` samples: shares (2,), stage, and error (3,) [m]."""
        rows = np.linspace(0, len(self.inputs) - 1, min(count, len(self.inputs))).round().astype(int)
        stages = self.inputs[rows, 2:].argmax(axis=1)
        return np.column_stack([self.inputs[rows, :2], stages, self.errors[rows]])


@dataclass(frozen=True)
class Staged:
    """The method with its options, for a task."""

    options: Options
    task: Task

    removes_lag: ClassVar[bool] = False

    @classmethod
    def of(cls, demonstrations: Sequence[Demonstration], options: Options) -> Self | None:
        """The method, if all demonstrations name the same via-points and no option rules it out."""
        if options.components is not None or options.ell is not None:
            return None
        task, _ = task_of(demonstrations)
        return None if task is None else cls(options, task)

    def fit(self, takes: Sequence[Take], progress: Progress) -> Fitted:
        """The model of the task, its gate on the hands' distance from their segments, and its
        predictions of held-out takes.

        Raises SkillError if the tool never came near a via-point.
        """
        demonstrations, names = [take.demonstration for take in takes], [take.name for take in takes]
        remarks = via_points_never_reached(self.task, demonstrations, names)
        progress(f"learning between the via-points {', '.join(self.task.names)}")
        delay, each_s = delay_of(demonstrations)
        encoded = [Encoded.of(self.task, *one) for one in zip(demonstrations, each_s, strict=True)]
        samples, off, blocks = Samples.of(encoded), _off_m(encoded), blocks_of(persons_of(takes))
        parameters = samples.best()
        predictions: dict[int, _Prediction] = {}
        for block in blocks:
            progress(f"holding out demonstrations {', '.join(names[h] for h in block)}")
            primitive = samples.fitted(parameters, block if len(blocks) > 1 else ())
            for h in block:
                placed = Placed.of(self.task, encoded[h].at, off, primitive, np.empty((0, 6)))
                predictions[h] = _Prediction.of(encoded[h], placed, delay.mean_s)
        errors = [predictions[h].retained(ERRORS_RETAINED // len(takes)) for h in range(len(takes))]
        unknown = Unknown(unknown_std(takes), _scatters(self.task, encoded))
        known = unknown._replace(scatters=np.zeros_like(unknown.scatters))  # the places of held-out takes are given
        progress(f"learning from all {len(takes)}")
        model = StagedKMP(
            samples.fitted(parameters),
            self.task,
            self._nominal(takes),
            off,
            np.concatenate(errors),
            delay.mean_s,
            unknown=unknown,
        )
        held_out: dict[int, HeldOut] = {}
        wrong: dict[int, list[Vector]] = {}
        for block in blocks:
            others = np.concatenate([one for h, one in enumerate(errors) if h not in block] or errors)
            for h in block:
                placed = Placed.of(self.task, encoded[h].at, off, model.primitive, others, known)
                held_out[h] = _held_out(takes[h], encoded[h], placed, predictions[h])
                wrong[h] = [placed.gates_m(moved) for moved in nonsense(every_few(encoded[h].moving[:, 0]))]
        in_order = [held_out[h] for h in range(len(takes))]
        kinds = [np.concatenate(kind) for kind in zip(*(wrong[h] for h in range(len(takes))), strict=True)]
        reached = np.concatenate([one.gate_m for one in in_order])
        gate = gate_between(reached, kinds, ceiling=CEILING_M, floor=FLOOR_M, hold_share=HOLD_SHARE)
        baselines = {WITHOUT_PLACES: self._without_places(takes, progress)}
        return Fitted(model, in_order, gate, delay, baselines=baselines, remarks=remarks)

    def _nominal(self, takes: Sequence[Take]) -> NamedViaPoints:
        """The mean via-points of the takes."""
        places = (list(ordered(take.demonstration.places, self.task.names)) for take in takes)
        return NamedViaPoints(self.task.names, np.mean([NamedViaPoints.of(one).at for one in places], axis=0))

    def _without_places(self, takes: Sequence[Take], progress: Progress) -> list[Vector]:
        """The errors (T, 3) [m] of held-out takes as functions of the hands' positions."""
        progress("learning without the via-points, for comparison")
        inputs = [take.hands for take in takes]
        fit = refit(POSITIONS, takes, inputs, self.options.points, None)
        return [one.errors for one in held_out_takes(takes, inputs, fit, progress)]


def _scatters(task: Task, encoded: Sequence[Encoded]) -> Vector:
    """The covariances (N, 3, 3) [m²] of the tool at each via-point over the demonstrations; of its
    offset from the hand, where it follows one.
    """
    at = np.array([one.at.at[[one.at.names.index(name) for name in task.names]] for one in encoded])
    for n, side in enumerate(task.follow.tolist()):
        if side != NONE:
            at[:, n, 6:] -= at[:, n, 3 * side : 3 * side + 3]
    off = at[:, :, 6:] - at[:, :, 6:].mean(axis=0)
    return np.asarray(np.einsum("dni,dnj->nij", off, off) / max(len(encoded) - 1, 1))


def _off_m(encoded: Sequence[Encoded]) -> Vector:
    """The distances (K, 2) [m] of the hands from their segments, root mean square, in each stage;
    in all stages where no demonstration has this one.
    """
    labels, off = np.concatenate([one.labels for one in encoded]), np.concatenate([one.off for one in encoded])
    by_stage = [off[labels == k] if (labels == k).any() else off for k in range(len(encoded[0].stages))]
    return np.array([np.maximum(np.sqrt((one**2).mean(axis=0)), LEAST_OFF_M) for one in by_stage])


def _held_out(take: Take, one: Encoded, placed: Placed, found: _Prediction) -> HeldOut:
    """The record of a take with the covariance from other blocks' errors, in `placed`."""
    hands, rows = one.moving[:, 0], zip(found.hands, found.belief, one.stillness, strict=True)
    return HeldOut(
        take,
        found.errors,
        np.array([placed.covariance(*row) for row in rows]),
        placed.gates_m(hands),
        found.inputs,
        known=np.hstack([hands, found.inputs[:, 2:]]),
        belief=found.belief[:, : len(one.stages)],
    )
