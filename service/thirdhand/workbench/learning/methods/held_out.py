"""Held-out takes and the gate of methods whose model is one primitive over the hands' inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from kmp import KMP
from thirdhand.core.frame import Vector
from thirdhand.core.skill.hands_kmp import TURN_INPUTS, HandsKMP
from thirdhand.core.skill.model import standard_deviations
from thirdhand.skills.skill_file import HIGHEST_GATE_M
from thirdhand.workbench.learning.gate import Gate, every_few, gate_between, nonsense
from thirdhand.workbench.learning.records import HeldOut, Progress, Take, by_fold

Fit = Callable[[int | None], KMP]  # the primitive without a fold's takes, or of all
ROWS = 500  # inputs that are predicted at once, which bounds the memory


def held_out_takes(
    takes: Sequence[Take],
    inputs: Sequence[Vector],
    fit: Fit,
    progress: Progress,
    model_of: Callable[[KMP], HandsKMP] = HandsKMP,
) -> list[HeldOut]:
    """The takes, with inputs (T, I), as predicted by a model of the primitive without their fold,
    or by that of all takes if there is one fold only.
    """
    out: dict[int, HeldOut] = {}
    for fold, members, others in by_fold(takes):  # one primitive at a time: each holds its factors
        primitive = fit(fold if others else None)
        for h in members:
            progress(f"holding out demonstration {h + 1} of {len(takes)}")
            take = takes[h]
            covariance = primitive.predict(inputs[h]).covariance
            deviations = standard_deviations(covariance)
            errors = take.position - model_of(primitive).tools(inputs[h])
            out[h] = HeldOut(take, errors, covariance, deviations, inputs[h], inputs[h])
    return [out[h] for h in range(len(takes))]


def gate_of(primitive: KMP, held_out: Sequence[HeldOut], order: int, ceiling_m: float) -> Gate:
    """The gate on the primitive's standard deviation; its inputs hold `order` rows of memory."""
    inputs = np.concatenate([every_few(result.inputs) for result in held_out])
    # the inputs beyond the positions
    beyond = (swapped(inputs, order)[:, 6:], inputs[:, 6:], inputs[:, 6:])
    wrong = [
        _deviations(primitive, np.hstack([hands, tail.repeat(len(hands) // len(inputs), axis=0)]))
        for hands, tail in zip(nonsense(inputs[:, :6]), beyond, strict=True)
    ]
    return gate_between(
        np.concatenate([result.gate_m for result in held_out]),
        wrong,
        ceiling=min(ceiling_m, HIGHEST_GATE_M),
    )


def swapped(inputs: Vector, order: int) -> Vector:
    """Inputs (T, I) with the memory, of `order` rows, and the turns of left and right hand swapped;
    the hands' positions stay.
    """
    out = inputs.copy()
    turns = 6 * (1 + order)
    end = turns + (inputs.shape[1] - turns) // TURN_INPUTS * TURN_INPUTS  # a clock has no side
    for columns, width in ((slice(6, turns), 3), (slice(turns, end), 9)):
        pairs = inputs[:, columns].reshape(len(inputs), -1, 2, width)
        out[:, columns] = pairs[:, :, ::-1].reshape(len(inputs), -1)
    return out


def _deviations(primitive: KMP, inputs: Vector) -> Vector:
    """The standard deviations (M,) [m] of predictions at inputs (M, I), in blocks."""
    blocks = np.split(inputs, range(ROWS, len(inputs), ROWS))
    return np.concatenate(
        [standard_deviations(primitive.predict(block).covariance) for block in blocks]
    )
