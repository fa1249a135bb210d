"""Learning from the hands: the tool as a function of their positions or of richer inputs.

The simplest kind of inputs is chosen that predicts held-out persons as well as any. A memory also
contains the tool's delay, so hands and tool are not shifted against each other. If the kernel's ell
is given, the inputs are the positions.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from kmp import KMP
from kmp.criteria.errors import preferred
from thirdhand.contract.records import SIDES
from thirdhand.core.frame import Vector
from thirdhand.core.skill import ORDER
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.core.skill.memory import features
from thirdhand.core.skill.support import averages, stretch_of
from thirdhand.core.skill.task_clock import REQUESTED, RUNS, WAITS, TaskClock
from thirdhand.process.parallel import Workers, here
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.choice import ADVISED, is_clear, selection_of
from thirdhand.workbench.learning.cross_validation import squared_distances
from thirdhand.workbench.learning.direct_selection import DirectSelection
from thirdhand.workbench.learning.division import task_of
from thirdhand.workbench.learning.gate import CEILING_M
from thirdhand.workbench.learning.methods.clock import Tempo, clock_of, paired, remark_on
from thirdhand.workbench.learning.methods.held_out import Fit, gate_of, held_out_takes
from thirdhand.workbench.learning.methods.weights import WEIGHTS, chosen
from thirdhand.workbench.learning.records import (
    Fitted,
    Options,
    Progress,
    Take,
    Taught,
    folds_of,
    persons_of,
)
from thirdhand.workbench.learning.regions import local_errors

Key = TypeVar("Key")
# Shares of the neighbours in the mean. A quarter and three quarters err like one of these on
# recorded partners.
MIXED_SHARES = (0.0, 0.5)
MIXED = (
    "half of the tool's position is its average at the most similar moments of the demonstrations, "
    "as this predicts held-out ones better"
)
# an error is as good up to this multiple of the least error, or up to this difference from it
AS_GOOD = 1.02
AS_GOOD_M = 0.002
STEADY_M = 0.005  # nobody holds a tool much steadier, so smaller errors need not be alike
RICH_TIMES = 2  # inputs richer than positions have twice as many reference points
LEAST_TURN_RAD = math.radians(5.0)  # orientations that vary by less are no inputs
LEAST_GROUPS = 3  # the differences of fewer groups show no standard error
# hyper-parameters are chosen anew without each block of takes from this number of persons on
LEAST_PERSONS = 3


class Inputs(NamedTuple):
    """A kind of inputs: the positions of the hands, rows of their memory, and their orientation; of
    both hands, or of one that stands for both; and the clock of the task.
    """

    name: str
    order: int = 0  # rows of memory
    turned: bool = False  # true if the orientation is an input
    alone: int | None = None  # the side of the only hand
    clock: TaskClock | None = None
    neighbours: float = 0.0  # share of the neighbours in the mean

    @property
    def is_rich(self) -> bool:
        """True if there are other inputs than positions."""
        return bool(self.order or self.turned or self.is_timed)

    @property
    def is_timed(self) -> bool:
        """True if the clock is an input."""
        return self.clock is not None and self.clock.weight > 0.0

    def of(self, demonstration: Demonstration, tempo: Tempo | None = None) -> Vector:
        """The inputs (T, I) [m] of a demonstration; a clock needs the `tempo`."""
        hands = demonstration.hands
        turns = demonstration.turns if self.turned else None
        if self.alone is not None:
            hands = np.tile(hands[:, 3 * self.alone :][:, :3], 2)
            turns = None if turns is None else np.tile(turns[:, 9 * self.alone :][:, :9], 2)
        inputs = features(hands, demonstration.period_s, self.order, turns)
        if self.clock is None or not self.is_timed:
            return inputs
        assert tempo is not None
        return np.column_stack([inputs, self.clock.weight * tempo.seconds(self.clock, self.alone)])

    def model(self, primitive: KMP) -> HandsKMP:
        """The model of a primitive with these inputs."""
        return HandsKMP(primitive, self.turned, self.clock, neighbours=self.neighbours)


POSITIONS = Inputs("positions")
KINDS = (  # from simple to rich
    POSITIONS,
    Inputs("velocities", order=1),
    Inputs("orientations", turned=True),
    Inputs("memory", order=ORDER),
)
# names; the first is simpler
CLOCKS = {
    WAITS: ", and a clock that waits for resting hands",
    RUNS: ", and a clock",
}
CLOCK_BY_REQUEST = {REQUESTED: ", and a clock that a request starts"}
WEIGHTS_MPS = (0.25, 0.5, 1.0, 2.0)  # candidates for the weight of a clock
# a user may pause, so a clock must reduce the error to this share, and by AS_GOOD_M
CLOCK_ERROR_SHARE = 0.9


@dataclass(frozen=True)
class HandInputs:
    """The method with its options."""

    options: Options
    why_not_segmented: str  # empty if no demonstration names via-points

    @classmethod
    def of(cls, demonstrations: Sequence[Demonstration], options: Options) -> Self:
        """The method; it applies to all demonstrations."""
        return cls(options, "" if options.ell is not None else task_of(demonstrations)[1])

    def fit(self, taught: Taught, progress: Progress) -> Fitted:
        """The model of the chosen kind of inputs, and its predictions of held-out takes.

        If a skill is refined, the weight of the new takes is chosen with the kind.
        """
        takes = taught.new
        ell = self.options.ell
        tempos = [Tempo.of(take.demonstration) for take in taught.all]
        outcome = (
            Chosen(POSITIONS, {}, {1.0: 0.0})
            if ell is not None
            else _chosen(taught, tempos, self.options, progress)
        )
        kind = _with_memory_clock(outcome.kind, tempos)
        weight, weights = chosen(outcome.by_weight_m)
        alone = self.options._replace(spread=here)  # a worker has no workers
        used = _Used.of(kind, taught, tempos, weight, alone)
        count = len(used.takes)
        progress(f"choosing parameters over {count} demonstrations")
        fit = used.fit()
        progress(f"learning from all {count}")
        primitive = fit(None)
        inputs = used.inputs[: len(takes)]
        held_out = held_out_takes(takes, inputs, fit, progress, kind.model)
        model = kind.model(primitive)
        gate = gate_of(primitive, held_out, kind.order, CEILING_M)

        if len({take.person for take in takes}) >= LEAST_PERSONS:
            progress("calibrating the covariance")
            timed, errors = local_errors(
                takes, inputs, primitive, used.refitted, self.options.spread
            )
            model = replace(model, errors=errors)
            held_out = [
                result._replace(timed=take_errors)
                for result, take_errors in zip(held_out, timed, strict=True)
            ]
        return Fitted(
            model,
            held_out,
            gate,
            conductor=kind.alone,
            taken=kind.name,
            tried_m=outcome.tried_m,
            remarks=[
                *filter(None, [self.why_not_segmented]),
                *_remarks(outcome.kind),
                *_noise(len(takes), outcome.alike),
            ],
            weights=weights if taught.earlier else None,
        )


def _with_memory_clock(kind: Inputs, tempos: Sequence[Tempo]) -> Inputs:
    """The kind; inputs with memory and no clock get one without weight."""
    if not kind.order or kind.clock is not None:
        return kind
    return kind._replace(clock=clock_of(tempos, kind.alone, pace=RUNS)._replace(weight=0.0))


def _remarks(kind: Inputs) -> Iterator[str]:
    """Sentences on a chosen kind of inputs."""
    if kind.neighbours:
        yield MIXED
    if kind.clock is not None and kind.clock.pace == REQUESTED:
        yield remark_on(kind.clock)
    elif kind.clock is not None:
        yield (
            f"{remark_on(kind.clock)}. A rest of more than {kind.clock.home_s:.1f} s where "
            "demonstrations begin starts it anew, and one of more than "
            f"{kind.clock.rest_s:.1f} s after the task"
        )
    if kind.alone is not None:
        yield (
            f"the {SIDES[kind.alone]} hand alone predicts the tool as well: it conducts alone, "
            "and the other one makes no difference, and may be absent"
        )


def _noise(count: int, alike: int) -> Iterator[str]:
    """A sentence on `alike` other kinds of inputs of some `count` takes, if these are few."""
    if count < ADVISED and alike > 0:
        yield (
            f"with {count} demonstrations, the kind of inputs is left to chance, as the errors of "
            f"{alike + 1} kinds are alike: record at least {ADVISED}"
        )


class _Used(NamedTuple):
    """The takes that are learned from, with their inputs (T, I): first the new ones, then `earlier`
    ones of a skill that is refined.
    """

    kind: Inputs
    takes: Sequence[Take]
    inputs: Sequence[Vector]
    earlier: int
    weight: float  # of a new take
    options: Options

    @classmethod
    def of(
        cls,
        kind: Inputs,
        taught: Taught,
        tempos: Sequence[Tempo],
        weight: float,
        options: Options,
    ) -> Self:
        """The takes, without the earlier ones if the weight is infinite."""
        takes = taught.new if math.isinf(weight) else taught.all
        inputs = [
            take.hands if options.ell is not None else kind.of(take.demonstration, tempo)
            for take, tempo in zip(takes, tempos, strict=False)
        ]
        return cls(kind, takes, inputs, len(takes) - len(taught.new), weight, options)

    def fit(self) -> Fit:
        """The function that fits primitives to these takes, see `refit`."""
        return refit(
            self.kind,
            self.takes,
            self.inputs,
            self.options.points,
            self.options.ell,
            earlier=self.earlier,
            weight=self.weight,
        )

    def refitted(self, new: list[int]) -> HandsKMP:
        """The skill from the new takes of these numbers and the earlier ones, with
        hyper-parameters chosen anew.
        """
        rows = [*new, *range(len(self.takes) - self.earlier, len(self.takes))]
        subset = self._replace(
            takes=[self.takes[i] for i in rows], inputs=[self.inputs[i] for i in rows]
        )
        return self.kind.model(subset.fit()(None))


def _weighted(
    kind: Inputs,
    taught: Taught,
    tempos: Sequence[Tempo],
    weight: float,
    points: int,
    blocks: NDArray[np.intp],
) -> DirectSelection:
    """The selection of a mean of this kind of inputs with this weight of new takes, where the takes
    of a block (H,) are held out at once.
    """
    earlier = taught.earlier if math.isfinite(weight) else []
    takes = [*taught.new, *earlier]
    pairs = [
        (kind.of(take.demonstration, tempo), take.position)
        for take, tempo in zip(takes, tempos, strict=False)
    ]
    return selection_of(
        pairs, points, persons=blocks[: len(takes)], rich=True, earlier=len(earlier), factor=weight
    )


def candidates(demonstrations: Sequence[Demonstration]) -> list[Inputs]:
    """The kinds of inputs that these demonstrations have, from simple to rich."""
    turns = np.concatenate([demonstration.turns for demonstration in demonstrations])
    is_turned = bool(np.ptp(turns, axis=0).max() > math.sin(LEAST_TURN_RAD))
    kinds = [kind for kind in KINDS if is_turned or not kind.turned]
    if demonstrations[0].conducts != "both":
        return kinds
    return [
        kind._replace(name=f"{kind.name}{hand}", alone=alone)
        for kind in kinds
        for alone, hand in ((0, " of the left hand"), (1, " of the right hand"), (None, ""))
    ]


def refit(
    kind: Inputs,
    takes: Sequence[Take],
    inputs: Sequence[Vector],
    points: int,
    ell: float | None,
    *,
    earlier: int = 0,
    weight: float = 1.0,
) -> Fit:
    """The function that fits primitives to takes with inputs (T, I), with the same hyper-parameters
    whichever person is held out; ell [1/m²] is chosen with them unless it is given.

    The last `earlier` takes are of a skill that is refined; a new one has this weight against them.
    """
    is_rich = kind.is_rich
    pairs = [(take_inputs, take.position) for take_inputs, take in zip(inputs, takes, strict=True)]
    count = RICH_TIMES * points if is_rich else points
    choice = selection_of(
        pairs,
        count,
        persons=folds_of(takes, earlier),
        isotropic=is_rich,
        rich=is_rich,
        earlier=earlier,
        factor=weight,
    )
    parameters = choice.parameters(ell, may_be_linear=True)
    residuals = choice.residuals(parameters.ell, parameters.noise, parameters.ridge)
    return lambda without: choice.primitive(parameters, residuals, without=without)


class Chosen(NamedTuple):
    """A kind of inputs, the error [m] of each kind, the errors of the chosen kind with each weight,
    and the number of other kinds whose errors are not clearly larger.
    """

    kind: Inputs
    tried_m: Mapping[str, float]
    by_weight_m: Mapping[float, float]
    alike: int = 0


def _chosen(
    taught: Taught, tempos: Sequence[Tempo], options: Options, progress: Progress
) -> Chosen:
    """The simplest kind of inputs that is as good as any, each with its best weight.

    A clock is tried with positions, and with the best kinds without it. For it, the blocks of
    `paired` are held out; if a skill is refined, the new takes show the pace that counts, and are
    held out one by one.
    """
    trial = _Trial(taught, tempos, options.points, taught.folds)
    kinds = candidates([take.demonstration for take in taught.all])
    by_weight = dict[str, dict[float, Vector]]()
    for kind, errors in zip(kinds, options.spread(trial.by_weight, kinds), strict=True):
        by_weight[kind.name] = errors
        progress(f"tried {kind.name}")
    squares = {kind.name: min(by_weight[kind.name].values(), key=np.mean) for kind in kinds}
    simplest = simplest_of(kinds, squares)
    without_clock = Chosen(
        trial.mixed(simplest, by_weight[simplest.name]),
        _errors_m(squares),
        _errors_m(by_weight[simplest.name]),
        _alike(simplest, squares),
    )

    blocks = trial.folds if taught.earlier else paired(persons_of(taught.new))
    if not blocks.any():
        return without_clock
    best = min(kinds, key=lambda kind: squares[kind.name].mean())
    first = next(kind for kind in kinds if kind.alone == simplest.alone)
    bases = sorted({first, simplest, best}, key=kinds.index)
    weights = {kind: _least(by_weight[kind.name]) for kind in bases}
    timed = _timed(trial, weights, blocks, squares, options.spread, progress)
    tried_m = _errors_m(squares)
    if not timed:
        return without_clock._replace(tried_m=tried_m)
    kind = simplest_of(timed, squares)
    timed_by_weight = trial.by_weight(kind)
    return Chosen(
        trial.mixed(kind, timed_by_weight),
        tried_m,
        _errors_m(timed_by_weight),
        _alike(kind, squares),
    )


def _alike(taken: Inputs, squares: Mapping[str, Vector]) -> int:
    """The number of other kinds whose squared errors (G,) [m²] are not clearly larger."""
    least = squares[taken.name]
    return sum(not is_clear(own - least) for own in squares.values()) - 1


def _error_m(squares: Vector) -> float:
    """The error [m] of squared errors (G,) [m²]."""
    return math.sqrt(squares.mean())


def _errors_m(squares: Mapping[Key, Vector]) -> dict[Key, float]:
    return {key: _error_m(own) for key, own in squares.items()}


def _least(squares: Mapping[Key, Vector]) -> Key:
    """The key of the least squared errors (G,) [m²]."""
    return min(squares, key=lambda key: float(squares[key].mean()))


class _Trial(NamedTuple):
    """Trials of kinds of inputs by the errors of held-out takes."""

    taught: Taught
    tempos: Sequence[Tempo]
    points: int
    folds: NDArray[np.intp]  # (H,) of the takes

    def squares(self, kind: Inputs, weight: float, held_out: NDArray[np.intp]) -> Vector:
        """The squared errors (G,) [m²] of each of the blocks (H,) that are held out, with this
        weight of new takes and the better share of neighbours.
        """
        return min(self.by_share(kind, weight, held_out).values(), key=np.mean)

    def by_share(
        self, kind: Inputs, weight: float, held_out: NDArray[np.intp]
    ) -> dict[float, Vector]:
        """The squared errors (G,) [m²] of `squares`, with each share of neighbours."""
        selection = _weighted(kind, self.taught, self.tempos, weight, self.points, held_out)
        _, best = selection.best_mean(may_be_linear=True)
        residuals = selection.residuals(best.ell, best.noise, best.ridge)
        tools = selection.outputs - residuals
        squares = squared_distances(selection.inputs * stretch_of(kind.clock, selection.inputs))
        squares[selection.group[:, None] == selection.group] = np.inf  # held out
        shares, average_tools = averages(squares, selection.outputs)
        away = average_tools - shares * tools
        return {share: selection.by_group(residuals - share * away) for share in MIXED_SHARES}

    def mixed(self, kind: Inputs, by_weight: Mapping[float, Vector]) -> Inputs:
        """The kind with the better share of neighbours, for the best weight of its squared errors
        (G,) [m²] by weight.
        """
        by_share = self.by_share(kind, _least(by_weight), self.folds)
        return kind._replace(neighbours=_least(by_share))

    def by_weight(self, kind: Inputs) -> dict[float, Vector]:
        """The squared errors (G,) [m²] by weight, if the folds are held out."""
        weights = WEIGHTS if self.taught.earlier else WEIGHTS[:1]
        return {weight: self.squares(kind, weight, self.folds) for weight in weights}


def _timed(
    trial: _Trial,
    weights: Mapping[Inputs, float],
    blocks: NDArray[np.intp],
    squares: dict[str, Vector],
    spread: Workers,
    progress: Progress,
) -> list[Inputs]:
    """The kinds with each clock that predicts clearly better than all without one; the squared
    errors (G,) [m²] of all clocks are added to `squares`.
    """
    limit_m = clock_limit_m(
        min(_error_m(trial.squares(kind, weight, blocks)) for kind, weight in weights.items())
    )
    timed = list[Inputs]()
    is_begun = all(tempo.begun_s is not None for tempo in trial.tempos)
    clocks = CLOCKS | (CLOCK_BY_REQUEST if is_begun else {})
    tried = [
        (kind._replace(name=kind.name + name), pace, weights[kind])
        for kind, (pace, name) in itertools.product(weights, clocks.items())
    ]
    for weighed, least_m, errors in spread(functools.partial(_weighed, trial, blocks), tried):
        squares[weighed.name] = errors
        progress(f"tried {weighed.name}")
        if least_m < limit_m:
            timed.append(weighed)
    return timed


def _weighed(
    trial: _Trial, blocks: NDArray[np.intp], tried: tuple[Inputs, int, float]
) -> tuple[Inputs, float, Vector]:
    """A kind of inputs with a clock of this pace and the best weight, for a weight of new takes;
    the error [m] over the blocks (H,), and the squared errors (G,) [m²] of the folds.
    """
    kind, pace, weight = tried
    clock = clock_of(trial.tempos, kind.alone, pace=pace)
    weighted = [
        kind._replace(clock=clock._replace(weight=weight_mps)) for weight_mps in WEIGHTS_MPS
    ]
    errors_m = [_error_m(trial.squares(candidate, weight, blocks)) for candidate in weighted]
    weighed = preferred(weighted, errors_m, AS_GOOD * min(errors_m))
    return weighed, min(errors_m), trial.squares(weighed, weight, trial.folds)


def clock_limit_m(least_m: float) -> float:
    """The error [m] that a clock must go below, if the least one without a clock is this."""
    return min(CLOCK_ERROR_SHARE * least_m, least_m - AS_GOOD_M)


def as_good_m(least_m: float) -> float:
    """The largest error [m] that is as good as the least one."""
    return max(AS_GOOD * least_m, least_m + AS_GOOD_M)


def simplest_of(kinds: Sequence[Inputs], squares: Mapping[str, Vector]) -> Inputs:
    """The first of the kinds that is as good as the best one, by the squared errors (G,) [m²] of
    held-out groups: by its error, and within one standard error of the groups' differences. Of a
    single hand, the richest kind has to be as good, too.
    """
    best = min(kinds, key=lambda kind: squares[kind.name].mean())
    least = squares[best.name]

    def is_as_good(kind: Inputs) -> bool:
        own = squares[kind.name]
        is_close = _error_m(own) <= as_good_m(_error_m(least))
        is_alike = len(own) < LEAST_GROUPS or not is_clear(own - least)
        return is_close and (is_alike or _error_m(own) <= STEADY_M)

    for kind in kinds:
        richest = [other for other in kinds if other.alone == kind.alone][-1]
        if is_as_good(kind) and (kind.alone is None or is_as_good(richest)):
            return kind
    return best
