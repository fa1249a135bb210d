"""Learning from the hands: the tool as a function of their positions or of richer inputs.

The simplest kind of inputs is chosen that predicts held-out persons as well as any. A memory also
contains the tool's delay, so hands and tool are not shifted against each other. If the kernel's ell
is given, the inputs are the positions, and the tool's lag is removed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from kmp.criteria.cross_validation import preferred
from service.contract.records import SIDES
from service.core.frame import Vector
from service.core.skill import ORDER
from service.core.skill.hands_kmp import HandsKMP
from service.core.skill.memory import features
from service.learning.choice import selection_of
from service.learning.demonstration import Demonstration
from service.learning.division import task_of
from service.learning.gate import CEILING_M
from service.learning.methods.held_out import Fit, gate_of, held_out_takes
from service.learning.records import Fitted, Options, Progress, Take, persons_of
from service.learning.regions import local_errors, refitted_errors

AS_GOOD, AS_GOOD_M = 1.02, 0.002  # an error up to this multiple of the least one, or this much larger, is as good
RICH_TIMES = 2  # inputs richer than positions have twice as many reference points
LEAST_TURN_RAD = math.radians(5.0)  # orientations that vary by less are no inputs
LEAST_PERSONS = 3  # hyper-parameters are chosen anew without each block of takes from this number of persons on


class Inputs(NamedTuple):
    """A kind of inputs: the positions of the hands, rows of their memory, and their orientation; of
    both hands, or of one that stands for both.
    """

    name: str
    order: int = 0  # rows of memory
    turned: bool = False  # true if the orientation is an input
    alone: int | None = None  # the side of the only hand

    def of(self, demonstration: Demonstration) -> Vector:
        """The inputs (T, I) [m] of a demonstration."""
        hands, turns = demonstration.hands, demonstration.turns if self.turned else None
        if self.alone is not None:
            hands = np.tile(hands[:, 3 * self.alone :][:, :3], 2)
            turns = None if turns is None else np.tile(turns[:, 9 * self.alone :][:, :9], 2)
        return features(hands, demonstration.period_s, self.order, turns)


POSITIONS = Inputs("positions")
KINDS = (  # from simple to rich
    POSITIONS,
    Inputs("velocities", order=1),
    Inputs("orientations", turned=True),
    Inputs("memory", order=ORDER),
)


@dataclass(frozen=True)
class HandInputs:
    """The method with its options."""

    options: Options
    why_not_staged: str  # empty if no demonstration names via-points

    @property
    def removes_lag(self) -> bool:
        """True if the kernel's ell is given."""
        return self.options.ell is not None

    @classmethod
    def of(cls, demonstrations: Sequence[Demonstration], options: Options) -> Self:
        """The method; it applies to all demonstrations."""
        return cls(options, "" if options.ell is not None else task_of(demonstrations)[1])

    def fit(self, takes: Sequence[Take], progress: Progress) -> Fitted:
        """The model of the chosen kind of inputs, and its predictions of held-out takes."""
        remarks = [self.why_not_staged] if self.why_not_staged else []
        points, ell = self.options.points, self.options.ell
        kind, tried_m = (POSITIONS, {}) if ell is not None else _chosen(takes, points, progress)
        if kind.alone is not None:
            remarks.append(
                f"the {SIDES[kind.alone]} hand alone predicts the tool as well: it conducts alone, and the other one "
                "makes no difference, and may be absent"
            )
        inputs = [take.hands if ell is not None else kind.of(take.demonstration) for take in takes]
        progress(f"choosing parameters over {len(takes)} demonstrations")
        fit = refit(kind, takes, inputs, points, ell)
        progress(f"learning from all {len(takes)}")
        primitive = fit(None)
        held_out = held_out_takes(takes, inputs, fit, progress)
        gate = gate_of(primitive, held_out, kind.order, CEILING_M)
        errors = None
        if len({take.person for take in takes}) >= LEAST_PERSONS:
            progress("calibrating the covariance")

            def refitted(kept: list[int]) -> HandsKMP:
                others = refit(kind, [takes[i] for i in kept], [inputs[i] for i in kept], points, ell)
                return HandsKMP(others(None), kind.turned)

            timed, errors = local_errors(refitted_errors(takes, inputs, refitted), inputs, takes, primitive)
            held_out = [one._replace(timed=found) for one, found in zip(held_out, timed, strict=True)]
        return Fitted(
            HandsKMP(primitive, kind.turned, errors),
            held_out,
            gate,
            conductor=kind.alone,
            taken=kind.name,
            tried_m=tried_m,
            remarks=remarks,
        )


def candidates(demonstrations: Sequence[Demonstration]) -> list[Inputs]:
    """The kinds of inputs that these demonstrations have, from simple to rich."""
    turns = np.concatenate([one.turns for one in demonstrations])
    is_turned = bool(np.ptp(turns, axis=0).max() > math.sin(LEAST_TURN_RAD))
    kinds = [kind for kind in KINDS if is_turned or not kind.turned]
    if demonstrations[0].conducts != "both":
        return kinds
    return [
        kind._replace(name=f"{kind.name}{hand}", alone=alone)
        for kind in kinds
        for alone, hand in ((0, " of the left hand"), (1, " of the right hand"), (None, ""))
    ]


def refit(kind: Inputs, takes: Sequence[Take], inputs: Sequence[Vector], points: int, ell: float | None) -> Fit:
    """The function that fits primitives to takes with inputs (T, I), with the same hyper-parameters
    whichever person is held out; ell [1/m²] is chosen with them unless it is given.
    """
    is_rich = bool(kind.order or kind.turned)
    pairs = [(known, take.position) for known, take in zip(inputs, takes, strict=True)]
    count = RICH_TIMES * points if is_rich else points
    choice = selection_of(pairs, count, persons=persons_of(takes), isotropic=is_rich, rich=is_rich)
    parameters = choice.parameters(ell, may_be_linear=True)
    residuals = choice.residuals(parameters.ell, parameters.noise, parameters.ridge)
    return lambda without: choice.primitive(parameters, residuals, without=without)


def _chosen(takes: Sequence[Take], points: int, progress: Progress) -> tuple[Inputs, dict[str, float]]:
    """The simplest kind of inputs that is as good as any, and the error [m] of each kind."""
    kinds, tried_m = candidates([take.demonstration for take in takes]), dict[str, float]()
    for kind in kinds:
        progress(f"trying {kind.name}")
        pairs = [(kind.of(take.demonstration), take.position) for take in takes]
        choice = selection_of(pairs, points, persons=persons_of(takes), rich=True)
        tried_m[kind.name] = choice.best_mean(may_be_linear=True)[0]
    least_m = min(tried_m.values())
    return preferred(kinds, list(tried_m.values()), max(AS_GOOD * least_m, least_m + AS_GOOD_M)), tried_m
