"""What the tool can be a function of, where no places are named: which of it is taken is found by
leaving demonstrations out.

A memory tells how late the tool comes, too: so nothing is shifted in time here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kmp import KMP
from service.core.frame import Vector
from service.core.skill import ORDER
from service.core.skill.hands_kmp import HandsKMP
from service.core.skill.memory import features
from service.learning.choice import Choice
from service.learning.demonstration import Demonstration

Pairs = Sequence[tuple[Vector, Vector]]  # inputs (T, I) and tool (T, 3) [m] of each demonstration
Fit = Callable[[int | None], KMP]  # the primitive of all demonstrations but those left out, or of all

AS_GOOD, AS_GOOD_M = 1.02, 0.002  # times the least error, or so much more, is as good, as hands tremble by that
RICHER = 2  # times as many reference points for more inputs than positions
LEAST_TURN_RAD = math.radians(5.0)  # hands that turn less between samples tell nothing by it


class Inputs(NamedTuple):
    """What the tool may be a function of: positions of the hands, and so many rows of their memory,
    how they are turned, or one hand alone.
    """

    name: str
    order: int = 0
    turned: bool = False
    alone: int | None = None  # the side of the one hand

    def of(self, demonstration: Demonstration) -> Vector:
        """The inputs (T, I) [m] of a demonstration."""
        hands, turns = demonstration.hands, demonstration.turns if self.turned else None
        if self.alone is not None:
            hands = np.tile(hands[:, 3 * self.alone :][:, :3], 2)
            turns = None if turns is None else np.tile(turns[:, 9 * self.alone :][:, :9], 2)
        return features(hands, demonstration.period_s, self.order, turns)

    def model(self, primitive: KMP) -> HandsKMP:
        """The model of a primitive of these."""
        return HandsKMP(primitive, self.turned)

    def swapped(self, inputs: Vector) -> Vector:
        """Inputs (T, I) as if the left hand had been the right one, but for where they are."""
        out, places = inputs.copy(), 6 * (1 + self.order)
        out[:, 6:places] = inputs[:, 6:places].reshape(len(inputs), -1, 2, 3)[:, :, ::-1].reshape(len(inputs), -1)
        out[:, places:] = inputs[:, places:].reshape(len(inputs), -1, 2, 9)[:, :, ::-1].reshape(len(inputs), -1)
        return out


POSITIONS = Inputs("positions")
KINDS = (  # the simplest first
    POSITIONS,
    Inputs("velocities", order=1),
    Inputs("orientations", turned=True),
    Inputs("memory", order=ORDER),
)


class Chosen(NamedTuple):
    """What was taken, its inputs and tools, how it is fitted, and what all that were tried missed
    the tool by when left out [m].
    """

    inputs: Inputs
    pairs: Pairs
    fit: Fit
    tried: dict[str, float]


def candidates(demonstrations: Sequence[Demonstration]) -> list[Inputs]:
    """What the tool in these may be a function of, the simplest first."""
    kinds = [kind for kind in KINDS if not kind.turned or _turn(demonstrations)]
    if demonstrations[0].conducts != "both":
        return kinds
    return [
        Inputs(f"{kind.name}{of}", kind.order, kind.turned, alone)
        for kind in kinds
        for alone, of in ((0, " of the left hand"), (1, " of the right hand"), (None, ""))
    ]


def _turn(demonstrations: Sequence[Demonstration]) -> bool:
    """Whether hands are turned in any demonstration, or differently in two."""
    turns = np.concatenate([one.turns for one in demonstrations])
    return bool(np.ptp(turns, axis=0).max() > math.sin(LEAST_TURN_RAD))


def chosen(
    demonstrations: Sequence[Demonstration],
    together: NDArray[np.intp],
    points: int,
    progress: Callable[[str], None],
) -> Chosen:
    """Of all that the tool can be a function of the simplest that predicts it as well as any, in
    demonstrations that are left out `together` (H,).
    """
    kinds, tried = candidates(demonstrations), dict[str, float]()
    for kind in kinds:
        progress(f"whether {kind.name} tell where the tool is" if not kind.order else f"whether {kind.name} tells more")
        pairs = [(kind.of(one), one.tool[:, :3]) for one in demonstrations]
        tried[kind.name] = Choice.of(pairs, points, together=together, even=True).mean(may_be_linear=True)[0]
    least = min(tried.values())
    taken = next(kind for kind in kinds if tried[kind.name] <= max(AS_GOOD * least, least + AS_GOOD_M))
    pairs = [(taken.of(one), one.tool[:, :3]) for one in demonstrations]
    progress(f"choosing parameters over {len(pairs)} demonstrations")
    return Chosen(taken, pairs, fitted(taken, pairs, together, points, None), tried)


def fitted(inputs: Inputs, pairs: Pairs, together: NDArray[np.intp], points: int, ell: float | None) -> Fit:
    """How primitives of such inputs are fitted, the parameters chosen, but for `ell` where it is
    given.
    """
    plain = not (inputs.order or inputs.turned)
    count = points if plain else RICHER * points
    choice = Choice.of(pairs, count, together=together, alike=not plain, even=not plain)
    parameters = choice.parameters(ell, may_be_linear=True)
    residuals = choice.residuals(parameters.ell, parameters.noise, parameters.ridge_m)

    return lambda left_out: choice.primitive(parameters, residuals, without=left_out)
