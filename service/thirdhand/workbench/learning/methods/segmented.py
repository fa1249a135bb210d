"""Learning of a task with named via-points: a KMP from the share of a segment that each hand has
covered to the share that the tool covers, with the teacher's delay and the errors of held-out
demonstrations.

A segment lies between two via-points. The skill estimates the present segment by the belief b (K,)
over the K segments. This is the forward filter of a hidden Markov model with transition rates A and
likelihoods l, see `thirdhand.core.skill.segments.recognise`:

    b(t) ~ l(t) ∘ (I + dt A)ᵀ b(t - dt)

Held-out predictions use the belief that the filter has along the take, and the delayed hands.
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from kmp import KMP, GaussianKernel, Gaussians, ViaPointMissed
from kmp.criteria.errors import preferred, rms
from thirdhand.contract.records import SIDES
from thirdhand.core.frame import Vector
from thirdhand.core.skill import ORDER
from thirdhand.core.skill.memory import along
from thirdhand.core.skill.segmented import NO_ERRORS, Placed, SegmentedKMP, Unknown
from thirdhand.core.skill.segments import LEFT, MOST_SEGMENTS, NONE, OUTPUTS, RIGHT, STAYS
from thirdhand.core.skill.task import Indices, NamedViaPoints, Task
from thirdhand.core.skill.task_clock import RUNS, WAITS, TaskClock
from thirdhand.core.skill.tuning import SEGMENT_DISTANCE, SEGMENT_DISTANCE_BESIDE, TURN_WEIGHT_M
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.recognition import covered, recognised
from thirdhand.workbench.learning.choice import is_clear, rows_at, sampled, selection_of
from thirdhand.workbench.learning.cross_validation import held_out_residuals
from thirdhand.workbench.learning.division import (
    NEAR,
    Divided,
    Encoded,
    encode,
    ordered,
    task_of,
    via_points_never_reached,
)
from thirdhand.workbench.learning.gate import (
    CEILING_M,
    FLOOR_M,
    Gate,
    every_few,
    gate_between,
    nonsense,
)
from thirdhand.workbench.learning.methods.clock import (
    Tempo,
    begins_of,
    paired,
    remark_on,
    segment_clock_of,
)
from thirdhand.workbench.learning.methods.inputs import (
    AS_GOOD,
    CLOCKS,
    LEAST_TURN_RAD,
    POSITIONS,
    HandInputs,
    as_good_m,
    clock_limit_m,
)
from thirdhand.workbench.learning.methods.weights import WEIGHTS, chosen
from thirdhand.workbench.learning.records import (
    Delay,
    Fitted,
    HeldOut,
    Options,
    Progress,
    Take,
    Taught,
    Weights,
    by_fold,
    folds_of,
    persons_of,
)
from thirdhand.workbench.learning.regions import blocks_of, unknown_std

SAMPLES_LEARNED = 600  # samples of all demonstrations that are learned from
LEAST_HELD_OUT_SAMPLES = 10  # samples of a demonstration that are learned from
ERRORS_RETAINED = 600  # errors of all demonstrations that the skill keeps
# delays and inputs are compared with about this number of samples of a demonstration
SAMPLES_TRIED = 200
# lower limit of the hands' distance from a path, root mean square; few takes may show less
LEAST_OFF_M = 0.03
LEAST_SEEN_S = 0.4  # a corner counts as demonstrated if hands were near it for this time
# one hand is at the end of its path, the other still at the start
CORNERS = ((1.0, 0.0), (0.0, 1.0))
# the tool waits at these shares of the path to a corner that was demonstrated
SEEN_SHARES = (0.5, 1.0)
UNSEEN_SHARES = (0.15, 0.3, 0.45, 0.7, 1.0)  # at a corner without demonstrations
# shares of the longest clock at which the tool's share is known
KNOWN_TIMES = (0.0, 0.25, 0.5, 0.75, 1.0)
CLOCK_WEIGHTS_PER_S = (0.1, 0.2, 0.4, 0.8)  # candidates for the weight of a clock
KNOWN_STD = 1e-3  # standard deviation of the tool's share where it is known
# share of the time that the gate may hold: the tool follows hands that come from elsewhere
HOLD_SHARE = 0.005
# the new takes get a delay of their own if it reduces their error to this share
OWN_DELAY_SHARE = 0.75
DELAYS_S = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6)  # candidates for a teacher's delay
WITHOUT_VIA_POINTS = "without via-points"  # name of this baseline in a skill's figures
PRIOR = np.array([0.5, 0.0, 0.0, 0.0])  # outputs far from all samples: half of the path, no offset


class Hyperparameters(NamedTuple):
    """The hyper-parameters of a task's KMP."""

    ell: float  # of the kernel, whose inputs are shares
    noise: float  # variance of a sample / variance of the kernel
    weight: float = 1.0  # of a new take, see `weights`


# candidates
ELLS = (4.0, 2.0, 8.0, 16.0)
TRIED_NOISES = (0.1, 0.03, 0.3)


class Samples(NamedTuple):
    """The N samples that are learned from: their rows in each demonstration, inputs (N, 2 + K) or
    with a clock (N, 2 + K + 1), outputs (N, OUTPUTS), and `owner` (N,), the numbers of their
    demonstrations. The first `new` demonstrations are held out and judged.
    """

    encoded: Sequence[Encoded]
    rows: Sequence[Indices]
    inputs: Vector
    outputs: Vector
    owner: Indices
    new: int
    clock: TaskClock | None = None

    @classmethod
    def of(cls, encoded: Sequence[Encoded], new: int) -> Self:
        """The samples of demonstrations, of which the first `new` are new, without a clock."""
        count = len(encoded[0].segments)
        shares = sampled(SAMPLES_LEARNED, new, len(encoded) - new, LEAST_HELD_OUT_SAMPLES)
        sampled_rows = [
            demo.rows(take_shares) for demo, take_shares in zip(encoded, shares, strict=True)
        ]
        along, labels, outputs = (
            np.concatenate(
                [values[rows] for values, rows in zip(column, sampled_rows, strict=True)]
            )
            for column in zip(
                *((demo.along, demo.labels, demo.wanted) for demo in encoded), strict=True
            )
        )
        owner = np.repeat(np.arange(len(encoded)), [len(rows) for rows in sampled_rows])
        return cls(encoded, sampled_rows, inputs_of(along, labels, count), outputs, owner, new)

    def clocked(self, tempos: Sequence[Tempo], clock: TaskClock) -> Self:
        """The samples with a clock as the last input."""
        times = [
            tempo.in_segments(clock.rows(begins_of(demo.segments)), demo.labels)[rows]
            for tempo, demo, rows in zip(tempos, self.encoded, self.rows, strict=True)
        ]
        inputs = np.column_stack([self.inputs, clock.weight * np.concatenate(times)])
        return self._replace(inputs=inputs, clock=clock)

    def best(self, weight: float) -> Hyperparameters:
        """The hyper-parameters of this weight with the least error of held-out demonstrations."""
        errors_m = {
            Hyperparameters(ell, noise, weight): rms(errors)
            for ell in ELLS
            for noise, errors in zip(
                TRIED_NOISES, self.held_out(ell, TRIED_NOISES, weight), strict=True
            )
        }
        return min(errors_m, key=errors_m.__getitem__)

    def held_out(
        self, ell: float, noises: Sequence[float], weight: float, block_of: Indices | None = None
    ) -> Vector:
        """The tool's errors (J, N, 3) [m] at the N samples of new demonstrations, with these noises
        (J,) and this weight. Each of the H demonstrations is held out, or its whole block in
        `block_of` (H,).
        """
        squares = ((self.inputs[:, None] - self.inputs) ** 2).sum(axis=2)
        is_new = self.owner < self.new
        held_out = self.owner if block_of is None else block_of[self.owner]
        roots = np.where(is_new, 1.0, math.sqrt(weight))[:, None]
        # K + r W = W^1/2 (W^-1/2 K W^-1/2 + r I) W^1/2
        kernel = np.exp(-ell * squares) / (roots * roots.T)
        targets = (self.outputs - PRIOR) / roots
        missed = roots * held_out_residuals(kernel, np.array(noises), held_out, lambda _: targets)
        predictions = (self.outputs - missed)[:, is_new]
        errors = np.empty((*predictions.shape[:2], 3))
        for h, (demo, rows) in enumerate(
            zip(self.encoded[: self.new], self.rows[: self.new], strict=True)
        ):
            mine = self.owner[is_new] == h
            errors[:, mine] = [
                demo.tool[rows] - demo.tools(rows, outputs) for outputs in predictions[:, mine]
            ]
        return errors

    def fitted(self, parameters: Hyperparameters, without: Sequence[int] = ()) -> KMP:
        """The KMP of all demonstrations except those in `without`, adapted to where the tool is
        known to be.
        """
        is_used = ~np.isin(self.owner, without)
        weights = np.where(self.owner[is_used] < self.new, 1.0, parameters.weight)
        covariance = parameters.noise * weights[:, None, None] * np.eye(OUTPUTS)
        primitive = KMP.fit(
            self.inputs[is_used],
            Gaussians(self.outputs[is_used], covariance),
            kernel=GaussianKernel(parameters.ell),
            lambda_mean=1.0,
            prior_mean=PRIOR,
            representation="dense",
        )
        known_inputs, shares = self._known(
            [demo for i, demo in enumerate(self.encoded) if i not in without]
        )
        if self.clock is not None:
            known_inputs, shares = self._timed(known_inputs, shares, self.clock)
        means = np.column_stack([shares, np.zeros((len(known_inputs), OUTPUTS - 1))])
        known_outputs = Gaussians(
            means, np.tile(KNOWN_STD**2 * np.eye(OUTPUTS), (len(known_inputs), 1, 1))
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ViaPointMissed)
            return primitive.adapt(known_inputs, known_outputs, tolerance=0.0)

    def _timed(self, at: Vector, shares: Vector, clock: TaskClock) -> tuple[Vector, Vector]:
        """The inputs (V, 2 + K) and shares (V,) of `_known` at the times at which they are known.

        If the clock runs while the hands rest, the tool may still be moving when the hands are at
        the end of a segment. So it is known there only when the clock ends, and at the start of a
        segment only when the clock starts. All other shares are known at any time.
        """
        segments = self.encoded[0].segments[at[:, 2:].argmax(axis=1)]
        moves = (segments["square"] > STAYS) | (segments["leads"] != NONE)[:, None]
        ends = (at[:, :2] == 1.0).all(axis=1)
        begins = ((at[:, :2] == 0.0) | ~moves).all(axis=1) & moves.any(axis=1)
        timed_rows = []
        for row, share, is_end, is_begin in zip(at, shares, ends, begins, strict=True):
            is_between = not (is_end or is_begin)
            for time in KNOWN_TIMES:
                if clock.pace == WAITS or is_between or time == float(is_end):
                    timed_rows.append((row, share, time))
        rows, known_shares, times = (np.array(column) for column in zip(*timed_rows, strict=True))
        return np.column_stack([rows, clock.weight * clock.longest_s * times]), known_shares

    @staticmethod
    def _known(shown: Sequence[Encoded]) -> tuple[Vector, Vector]:
        """Inputs (V, 2 + K) at which the tool's share (V,) is known.

        The share is 1 at the end of a segment and 0 at its start. At a corner it is 0 or 1 if the
        tool usually was at that end, and 0 if no demonstration has the corner.
        """
        squares = shown[0].segments["square"]
        leads = shown[0].segments["leads"]
        moving_segments = np.flatnonzero((squares > STAYS).all(axis=1) & (leads == NONE)).tolist()
        rows: list[tuple[float, float, int, float]] = [
            (1.0, 1.0, k, 1.0) for k in range(len(squares))
        ]
        begins = np.where((squares > STAYS) | (leads != NONE)[:, None], 0.0, 1.0)
        rows += [(*begins[k], k, 0.0) for k in np.flatnonzero(squares.any(axis=1))]
        for corner in CORNERS:
            is_unseen = _seen(shown, corner, moving_segments)[0] < LEAST_SEEN_S
            for k in moving_segments:
                lasts_s, shares = _seen(shown, corner, [k])
                usual = float(np.median(shares)) if lasts_s >= LEAST_SEEN_S else 0.5
                if is_unseen:
                    usual = 0.0
                if usual < NEAR:
                    waits = UNSEEN_SHARES if is_unseen else SEEN_SHARES
                    rows += [(share * corner[0], share * corner[1], k, 0.0) for share in waits]
                elif usual > 1.0 - NEAR:
                    rows.append((*corner, k, 1.0))
        table = np.array(rows)
        return inputs_of(table[:, :2], table[:, 2].astype(np.int64), len(squares)), table[:, 3]


def _seen(
    shown: Sequence[Encoded], corner: tuple[float, float], segments: Sequence[int]
) -> tuple[float, Vector]:
    """The time [s] that hands were near a corner of these segments, and the tool's shares then."""
    rows = [demo.near(corner, segments) for demo in shown]
    lasts_s = sum(float(mask.sum()) * demo.period_s for demo, mask in zip(shown, rows, strict=True))
    return lasts_s, np.concatenate(
        [demo.wanted[mask, 0] for demo, mask in zip(shown, rows, strict=True)]
    )


def inputs_of(shares: Vector, labels: Indices, count: int) -> Vector:
    """The inputs (T, 2 + K) for shares (T, 2) of both hands in the segments (T,) of K."""
    return np.hstack([shares, SEGMENT_DISTANCE * np.eye(count)[labels]])


def leading_tasks(task: Task, shown: Sequence[Encoded]) -> dict[str, Task]:
    """Tasks in which the share of one hand alone counts, by name; none if one hand conducts anyway.
    A hand qualifies if it was ahead of the other one in the demonstrations, so that they show
    whether the tool waits, or if it is the only hand that the tool follows.
    """
    if any(demo.demonstration.conducts != "both" for demo in shown):
        return {}
    moving_segments = np.flatnonzero((shown[0].segments["square"] > STAYS).all(axis=1)).tolist()
    followed = set(task.follow.tolist()) - {NONE}
    sides = [
        side
        for side in (LEFT, RIGHT)
        if followed == {side} or _seen(shown, CORNERS[side], moving_segments)[0] >= LEAST_SEEN_S
    ]
    return {
        f"positions, shares of the {SIDES[side]} hand alone": task._replace(leads=side)
        for side in sides
    }


def turning_tasks(task: Task, demonstrations: Sequence[Demonstration]) -> dict[str, Task]:
    """Tasks in which the tool turns with hands that turn in the demonstrations, by name: with the
    hands that it follows, or with one hand that it then follows everywhere.
    """
    turns = np.concatenate([demonstration.turns for demonstration in demonstrations]).reshape(
        -1, 2, 9
    )
    sides = np.flatnonzero(np.ptp(turns, axis=0).max(axis=1) > math.sin(LEAST_TURN_RAD)).tolist()
    levers = np.zeros((len(task.names), 3))
    out: dict[str, Task] = {}
    if np.isin(task.follow, sides).any():
        out["orientation of the followed hand"] = task._replace(levers=levers)
    for side in sides:
        if (task.follow != side).any():
            everywhere = np.full_like(task.follow, side)
            out[f"orientation of the {SIDES[side]} hand"] = task._replace(
                follow=everywhere, levers=levers
            )
    return out


class _Prediction(NamedTuple):
    """A take's mean prediction, learned without its block: the delayed hands (T, 6) [m], or (T, 24)
    with their turns, the belief (T, MOST_SEGMENTS), errors (T, 3) [m], and inputs (T, 2 + K) of the
    primitives of orientation and gripper.
    """

    hands: Vector
    belief: Vector
    errors: Vector
    inputs: Vector
    tempos: Vector  # (T, 3) as in `Placed.mean`

    @classmethod
    def of(
        cls,
        one: Encoded,
        placed: Placed,
        delay_s: float,
        tempo: Tempo | None,
        clock: TaskClock | None,
        step: int,
    ) -> Self:
        """The prediction at one of every `step` samples."""
        belief = np.zeros((len(one.tool), MOST_SEGMENTS))
        recognised(one.moving, one.period_s, placed.segments, belief)
        hands = one.moving[:, 0]
        if delay_s > 0.0:
            hands = np.ascontiguousarray(along(hands, one.period_s, delay_s / ORDER, ORDER)[:, -1])
        times = np.zeros(len(hands))
        if clock is not None and tempo is not None:
            times = tempo.in_segments(clock.rows(begins_of(placed.segments)), belief.argmax(axis=1))
        hands = np.hstack([hands, one.turns(delay_s)])[::step]
        belief = belief[::step]
        tempos = np.column_stack([one.stillness, times])[::step]
        errors = one.tool[::step] - placed.mean(hands, belief, tempos)
        coverage = covered(hands, tempos[:, :2], belief.argmax(axis=1), placed.segments)
        segment_inputs = SEGMENT_DISTANCE_BESIDE * belief[:, : len(one.segments)]
        inputs = [
            coverage[:, :2],
            segment_inputs,
            *([] if clock is None else [clock.weight * tempos[:, 2:]]),
        ]
        return cls(hands, belief, errors, np.hstack(inputs), tempos)

    def retained(self, shares: Vector) -> Vector:
        """Errors (M, 6) at these shares of the time: shares (2,), segment, and error (3,) [m]."""
        rows = rows_at(shares, len(self.inputs))
        segments = self.belief[rows].argmax(axis=1)
        return np.column_stack([self.inputs[rows, :2], segments, self.errors[rows]])


class Candidate(NamedTuple):
    """A task and a teacher's delay that are tried, with the encoded demonstrations, the samples,
    the hands' distances (K, 2) [m] from their paths, and hyper-parameters.

    The delay is that of the new demonstrations, see `Samples`.
    """

    task: Task
    delay_s: float
    encoded: Sequence[Encoded]
    samples: Samples
    off: Vector
    parameters: Hyperparameters
    tempos: Sequence[Tempo] = ()  # needed with a clock

    @classmethod
    def of(
        cls,
        task: Task,
        new: Sequence[Divided],
        delay_s: float,
        earlier: Sequence[Divided] = (),
        before_s: float = 0.0,
        weight: float = 1.0,
    ) -> Self:
        """The candidate of a task with this delay. Earlier demonstrations have a delay of their
        own, `before_s`, and the new ones this weight against them.
        """
        task, encoded = encode(
            task, [*new, *earlier], [delay_s] * len(new) + [before_s] * len(earlier)
        )
        samples = Samples.of(encoded, len(new))
        return cls(task, delay_s, encoded, samples, _off_m(encoded), samples.best(weight))

    def clocked(self, tempos: Sequence[Tempo], clock: TaskClock) -> Self:
        """The candidate with a clock as the last input, and the best parameters with it."""
        samples = self.samples.clocked(tempos, clock)
        return self._replace(
            samples=samples, parameters=samples.best(self.parameters.weight), tempos=tempos
        )

    def held_out(
        self, block: Sequence[int], blocks: Sequence[Sequence[int]], step: int = 1
    ) -> dict[int, _Prediction]:
        """The predictions of a block's demonstrations at one of every `step` samples, learned
        without them, unless it is the only block.
        """
        primitive = self.samples.fitted(self.parameters, block if len(blocks) > 1 else ())
        clock = self.samples.clock
        predictions = dict[int, _Prediction]()
        for h in block:
            placed = Placed.of(self.task, self.encoded[h].at, self.off, primitive, NO_ERRORS, clock)
            tempo = None if clock is None else self.tempos[h]
            predictions[h] = _Prediction.of(
                self.encoded[h], placed, self.delay_s, tempo, clock, step
            )
        return predictions

    def squares(self, blocks: Sequence[Sequence[int]]) -> Vector:
        """The mean squared errors (H,) [m²] of the held-out demonstrations, at some samples."""
        step = 1 + max(len(demo.labels) for demo in self.encoded) // SAMPLES_TRIED
        predictions: dict[int, _Prediction] = {}
        for block in blocks:
            predictions |= self.held_out(block, blocks, step)
        return np.array([rms(predictions[h].errors) ** 2 for h in range(self.samples.new)])

    def error_m(self, blocks: Sequence[Sequence[int]]) -> float:
        """The error [m] of the held-out demonstrations, root mean square, at some samples."""
        return math.sqrt(self.squares(blocks).mean())


def with_delay(
    task: Task,
    shown: Sequence[Divided],
    blocks: Sequence[Sequence[int]],
    options: Options,
    usual_s: float | None = None,
) -> tuple[Candidate, Delay, float]:
    """The candidate with the delay of DELAYS_S that predicts held-out demonstrations best, the same
    in all of them; that delay, with the standard deviation of the best delays of the single
    demonstrations; and the error [m]. There is none unless it reduces the mean squared error by
    more than one standard error over the blocks. If `usual_s` is given, it is the delay unless
    another one predicts much better: a teacher's delay varies between takes, and there may be only
    a few. The delay of the options is taken as it is.
    """
    delays_s = DELAYS_S if options.delay_s is None else (options.delay_s,)
    tried = options.spread(functools.partial(_late, task, shown, blocks), delays_s)
    candidates, each = zip(*tried, strict=True)
    squares = np.array(each)
    best = int(squares.sum(axis=1).argmin())
    each_s = np.array(delays_s)[squares.argmin(axis=0)]
    if usual_s is not None:
        usual = delays_s.index(usual_s)
        if squares[best].sum() > OWN_DELAY_SHARE**2 * squares[usual].sum():
            best = usual
    elif not is_clear(np.array([(squares[0] - squares[best])[block].mean() for block in blocks])):
        best = 0
    return (
        candidates[best],
        Delay(delays_s[best], float(each_s.std())),
        math.sqrt(float(squares[best].mean())),
    )


def _late(
    task: Task, shown: Sequence[Divided], blocks: Sequence[Sequence[int]], late_s: float
) -> tuple[Candidate, Vector]:
    """The candidate with this delay [s], and its squared errors by block."""
    candidate = Candidate.of(task, shown, late_s)
    return candidate, candidate.squares(blocks)


@dataclass(frozen=True)
class Segmented:
    """The method with its options, for a task."""

    options: Options
    task: Task

    @classmethod
    def of(cls, demonstrations: Sequence[Demonstration], options: Options) -> Self | None:
        """The method, if all demonstrations name the same via-points and no option rules it out."""
        if options.components is not None or options.ell is not None:
            return None
        task, _ = task_of(demonstrations)
        return None if task is None else cls(options, task)

    def fit(self, taught: Taught, progress: Progress) -> Fitted:
        """The model of the task, its gate on the hands' distance from their paths, and its
        predictions of held-out takes.

        Raises SkillError if the tool never came near a via-point.
        """
        takes = taught.new
        names = [take.name for take in taught.all]
        remarks = via_points_never_reached(
            self.task, [take.demonstration for take in taught.all], names
        )
        progress(f"learning between the via-points {', '.join(self.task.names)}")
        blocks = blocks_of(persons_of(takes))
        choice = _Choice.of(self.task, taught, blocks, self.options, progress)
        weights = choice.make()
        best = choice.best
        if best.samples.clock is not None:
            remarks.append(f"{remark_on(best.samples.clock)}. It starts anew in each segment")

        by_take: dict[int, _Prediction] = {}
        for block in blocks:
            progress(f"holding out demonstrations {', '.join(names[h] for h in block)}")
            by_take |= best.held_out(block, blocks)
        predictions = [by_take[h] for h in range(len(takes))]
        without = self._without_via_points(takes, progress)
        if self.options.delay_s is None and _are_better(without, predictions, blocks):
            between, simply = (
                1000 * rms(np.concatenate(errors))
                for errors in ([prediction.errors for prediction in predictions], without)
            )
            why = (
                "it is learned where the hands are, not between its via-points, as this predicts "
                f"held-out demonstrations within {simply:.0f} mm, and that within {between:.0f} mm"
            )
            return HandInputs(self.options, why).fit(taught, progress)

        progress(f"learning from all {len(takes)}")
        shares = sampled(ERRORS_RETAINED, len(takes), 0, 1, ERRORS_RETAINED)
        errors = [
            prediction.retained(take_shares)
            for prediction, take_shares in zip(predictions, shares, strict=True)
        ]
        model = self._model(choice, takes, np.concatenate(errors))
        placements = _placements(best, model.primitive, takes, blocks, errors)
        held_out = list(map(_held_out, takes, best.encoded, placements, predictions))
        return Fitted(
            model,
            held_out,
            _gate(held_out, best.encoded, placements),
            choice.delay,
            taken=choice.name,
            tried_m=choice.tried_m if len(choice.tried_m) > 1 else {},
            baselines={WITHOUT_VIA_POINTS: without},
            remarks=remarks,
            weights=weights,
        )

    def _model(self, choice: _Choice, takes: Sequence[Take], errors: Vector) -> SegmentedKMP:
        """The skill of a choice, with held-out errors (M, 6) as in `_Prediction.retained`."""
        best = choice.best
        tempos = choice.tempos[: len(takes)]
        return SegmentedKMP(
            best.samples.fitted(best.parameters),
            best.task,
            self._nominal(takes),
            best.off,
            errors,
            choice.delay.mean_s,
            clock=best.samples.clock
            or _clock_of(best.encoded[: len(takes)], tempos, pace=RUNS)._replace(weight=0.0),
            unknown=Unknown(unknown_std(takes), _scatters(best.task, best.encoded)),
        )

    def _nominal(self, takes: Sequence[Take]) -> NamedViaPoints:
        """The mean via-points of the takes."""
        via_points = (
            list(ordered(take.demonstration.via_points, self.task.names)) for take in takes
        )
        return NamedViaPoints(
            self.task.names,
            np.mean([NamedViaPoints.of(points).at for points in via_points], axis=0),
        )

    def _without_via_points(self, takes: Sequence[Take], progress: Progress) -> list[Vector]:
        """The errors (T, 3) [m] of held-out takes as functions of the hands' positions."""
        progress("learning without the via-points, for comparison")
        pairs = [(take.hands, take.position) for take in takes]
        choice = selection_of(pairs, self.options.points, persons=folds_of(takes))
        _, best = choice.best_mean(may_be_linear=True)
        residuals = choice.residuals(best.ell, best.noise, best.ridge)
        errors = dict[int, Vector]()
        for fold, members, _ in by_fold(takes):
            primitive = choice.primitive(best, residuals, without=fold)
            for h in members:
                errors[h] = takes[h].position - primitive.mean(takes[h].hands)
        return [errors[h] for h in range(len(takes))]


@dataclass
class _Choice:
    """The choice of a task's delay, inputs, clock and weight by held-out takes: the candidate that
    is the best up to now, its delay and name, and the errors [m] of all candidates.

    If a skill is refined, tasks are judged by what all persons share, and their delay, clock and
    weight by the new takes.
    """

    taught: Taught
    new: Sequence[Divided]
    earlier: Sequence[Divided]  # of a skill that is refined
    blocks: Sequence[Sequence[int]]  # of new takes
    all_blocks: Sequence[Sequence[int]]
    usual_s: float | None  # delay of all persons; None if no skill is refined
    options: Options
    progress: Progress
    best: Candidate
    delay: Delay
    tried_m: dict[str, float]
    name: str = POSITIONS.name

    @classmethod
    def of(
        cls,
        task: Task,
        taught: Taught,
        blocks: Sequence[Sequence[int]],
        options: Options,
        progress: Progress,
    ) -> Self:
        """The choice of the delay alone."""
        new, earlier = (
            [Divided.of(task, take.demonstration) for take in takes]
            for takes in (taught.new, taught.earlier)
        )
        progress(f"choosing the delay over {len(new)} demonstrations")
        all_blocks = blocks_of(persons_of(taught.all))
        usual_s = None
        if earlier:
            usual_s = with_delay(task, [*new, *earlier], all_blocks, options)[1].mean_s
        best, delay, error_m = with_delay(task, new, blocks, options, usual_s)
        choice = cls(
            taught, new, earlier, blocks, all_blocks, usual_s, options, progress, best, delay, {}
        )
        choice.tried_m[choice.name] = (
            choice.of_everybody(task).error_m(all_blocks) if earlier else error_m
        )
        return choice

    @cached_property
    def tempos(self) -> list[Tempo]:
        """The tempos of all takes, the new ones first."""
        return [Tempo.of(take.demonstration) for take in self.taught.all]

    def of_everybody(self, task: Task) -> Candidate:
        """The candidate of a task with the demonstrations of all persons, which count alike."""
        return Candidate.of(task, [*self.new, *self.earlier], self.delay.mean_s)

    def make(self) -> Weights | None:
        """Choose the inputs, the clock and the weight; the weights' errors, or None if no skill is
        refined.
        """
        demos = self.of_everybody(self.best.task).encoded if self.earlier else self.best.encoded
        self.choose_task(leading_tasks(self.best.task, demos), as_good=lambda least_m: least_m)

        # Tasks that turn are richer: the present one is kept while it is nearly as good.
        turning = turning_tasks(self.best.task, [take.demonstration for take in self.taught.new])
        self.choose_task(turning, as_good=as_good_m)
        self.choose_clock()
        return self.choose_weight() if self.earlier else None

    def choose_task(self, tasks: Mapping[str, Task], as_good: Callable[[float], float]) -> None:
        """Choose between the present task and these by name: the first whose error [m] is as good
        as the least one, and then its delay.
        """
        errors_m = {self.name: self.tried_m[self.name]}
        for name, task in tasks.items():
            self.progress(f"trying {name}")
            errors_m[name] = self.of_everybody(task).error_m(self.all_blocks)

        self.name = preferred(
            list(errors_m), list(errors_m.values()), as_good(min(errors_m.values()))
        )
        if self.name in tasks:
            self.best, self.delay, error_m = with_delay(
                tasks[self.name], self.new, self.blocks, self.options, self.usual_s
            )
            if not self.earlier:
                errors_m[self.name] = error_m
        self.tried_m |= errors_m

    def choose_clock(self) -> None:
        """Choose a clock, if one predicts the new takes clearly better."""
        tempos = self.tempos[: len(self.new)]
        clocked = _with_clocks(self.best, self.taught, tempos, self.progress)
        if not clocked:
            return
        errors_m = {
            self.name + clock: candidate.error_m(self.blocks)
            for clock, candidate in clocked.items()
        }
        without_m = self.best.error_m(self.blocks) if self.earlier else self.tried_m[self.name]
        least_m = min(errors_m.values())
        if least_m < clock_limit_m(without_m):
            clock = preferred(list(clocked), list(errors_m.values()), AS_GOOD * least_m)
            self.best = clocked[clock]
            self.name += clock

        # Errors of new takes alone are not comparable with those of everybody.
        if not self.earlier or self.name in errors_m:
            self.tried_m |= errors_m

    def choose_weight(self) -> Weights:
        """Choose the weight of the new takes against the earlier ones; the errors of all."""
        self.progress(
            f"choosing the weight of {len(self.new)} demonstrations against {len(self.earlier)} "
            "earlier ones"
        )
        earlier_blocks = blocks_of(persons_of(self.taught.earlier))
        earlier_delay = with_delay(self.best.task, self.earlier, earlier_blocks, self.options)[1]
        weighted = {weight: self.weighted(weight, earlier_delay.mean_s) for weight in WEIGHTS}
        weight, weights = chosen(
            {weight: candidate.error_m(self.blocks) for weight, candidate in weighted.items()}
        )
        self.best = weighted[weight]
        return weights

    def weighted(self, weight: float, before_s: float) -> Candidate:
        """The best candidate with this weight of the new takes; the earlier ones have the delay
        `before_s`.
        """
        earlier = self.earlier if math.isfinite(weight) else ()
        candidate = Candidate.of(
            self.best.task, self.new, self.delay.mean_s, earlier, before_s, weight
        )
        if (clock := self.best.samples.clock) is None:
            return candidate
        return candidate.clocked(self.tempos[: len(candidate.encoded)], clock)


def _are_better(
    errors: Sequence[Vector], predictions: Sequence[_Prediction], blocks: Sequence[Sequence[int]]
) -> bool:
    """True if these errors (T, 3) [m] of the takes are clearly smaller than those of the
    predictions, which are not as good.
    """
    predicted = np.concatenate([prediction.errors for prediction in predictions])
    if rms(predicted) <= as_good_m(rms(np.concatenate(errors))):
        return False
    gains = [rms(predictions[h].errors) ** 2 - rms(errors[h]) ** 2 for h in range(len(errors))]
    by_block = np.array([np.mean([gains[h] for h in block]) for block in blocks])
    return is_clear(by_block)


def _with_clocks(
    best: Candidate, taught: Taught, tempos: Sequence[Tempo], progress: Progress
) -> dict[str, Candidate]:
    """The candidate with those clocks that may predict clearly better, by the clock's name.

    This comparison ignores where the tool is known to be, and holds out the blocks of `paired`. If
    a skill is refined, the pace of the new takes counts, and they are held out person by person.
    """
    persons = persons_of(taught.new)
    block_of = persons if taught.earlier else paired(persons)
    if not block_of.any():
        return {}

    def error_m(samples: Samples) -> float:
        return min(map(rms, samples.held_out(best.parameters.ell, TRIED_NOISES, 1.0, block_of)))

    limit_m = clock_limit_m(error_m(best.samples))
    out = dict[str, Candidate]()
    for pace, name in CLOCKS.items():
        progress(f"trying {POSITIONS.name}{name}")
        clock = _clock_of(best.encoded, tempos, pace=pace)
        tried = [clock._replace(weight=weight) for weight in CLOCK_WEIGHTS_PER_S]
        errors_m = [error_m(best.samples.clocked(tempos, tried_clock)) for tried_clock in tried]
        if min(errors_m) < limit_m:
            out[name] = best.clocked(tempos, preferred(tried, errors_m, AS_GOOD * min(errors_m)))
    return out


def _clock_of(demos: Sequence[Encoded], tempos: Sequence[Tempo], *, pace: int) -> TaskClock:
    """The clock of the segments of demonstrations with these tempos, with a weight of 1."""
    segments = [demo.segments for demo in demos]
    return segment_clock_of(tempos, segments, [demo.labels for demo in demos], pace=pace)


def _placements(
    best: Candidate,
    primitive: KMP,
    takes: Sequence[Take],
    blocks: Sequence[Sequence[int]],
    errors: Sequence[Vector],
) -> list[Placed]:
    """The skill between each held-out take's via-points, which are given, with the covariance from
    the errors (M, 6) of the other blocks.
    """
    unknown = Unknown(unknown_std(takes), np.zeros((len(best.task.names), 3, 3)))
    placements = dict[int, Placed]()
    for block in blocks:
        of_others = [take_errors for h, take_errors in enumerate(errors) if h not in block]
        others = np.concatenate(of_others or errors)
        for h in block:
            placements[h] = Placed.of(
                best.task,
                best.encoded[h].at,
                best.off,
                primitive,
                others,
                best.samples.clock,
                unknown,
            )
    return [placements[h] for h in range(len(errors))]


def _gate(
    held_out: Sequence[HeldOut], demos: Sequence[Encoded], placements: Sequence[Placed]
) -> Gate:
    """The gate between the distances of held-out hands and those of wrong ones, kind by kind."""
    wrong = [
        [placed.gates_m(hands) for hands in nonsense(every_few(demo.moving[:, 0]))]
        for demo, placed in zip(demos, placements, strict=False)
    ]
    kinds = [np.concatenate(kind) for kind in zip(*wrong, strict=True)]
    reached = np.concatenate([result.gate_m for result in held_out])
    return gate_between(reached, kinds, ceiling=CEILING_M, floor=FLOOR_M, hold_share=HOLD_SHARE)


def _scatters(task: Task, encoded: Sequence[Encoded]) -> Vector:
    """The covariances (N, 3, 3) [m²] of the tool at each via-point over the demonstrations. Where
    it follows a hand, they are those of its offset from that hand; where it also turns with the
    hand, zeros.
    """
    points_m = np.array(
        [demo.at.at[[demo.at.names.index(name) for name in task.names]] for demo in encoded]
    )
    for n, side in enumerate(task.follow.tolist()):
        if side != NONE:
            points_m[:, n, 6:] -= (
                points_m[:, n, 6:]
                if task.levers is not None
                else points_m[:, n, 3 * side : 3 * side + 3]
            )
    offsets_m = points_m[:, :, 6:] - points_m[:, :, 6:].mean(axis=0)
    return np.asarray(np.einsum("dni,dnj->nij", offsets_m, offsets_m) / max(len(encoded) - 1, 1))


def _off_m(encoded: Sequence[Encoded]) -> Vector:
    """The distances (K, 2) [m] of the hands from their paths in each segment, root mean square. A
    segment that no demonstration has gets those of all segments.
    """
    labels = np.concatenate([demo.labels for demo in encoded])
    distances_m = np.concatenate([demo.off for demo in encoded])
    by_segment = [
        distances_m[labels == k] if (labels == k).any() else distances_m
        for k in range(len(encoded[0].segments))
    ]
    return np.array(
        [np.maximum(np.sqrt((part_m**2).mean(axis=0)), LEAST_OFF_M) for part_m in by_segment]
    )


def _held_out(take: Take, one: Encoded, placed: Placed, found: _Prediction) -> HeldOut:
    """The record of a take with the covariance from other blocks' errors, in `placed`."""
    hands = one.moving[:, 0]
    rows = zip(found.hands, found.belief, found.tempos, strict=True)
    return HeldOut(
        take,
        found.errors,
        np.array([placed.covariance(*row) for row in rows]),
        placed.gates_m(hands),
        found.inputs,
        known=np.hstack([hands, TURN_WEIGHT_M * found.hands[:, 6:], found.inputs[:, 2:]]),
        belief=found.belief[:, : len(one.segments)],
    )
