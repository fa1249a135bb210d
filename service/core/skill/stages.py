"""Stages of a task, each from one via-point to the next: how far along it the hands are, in which
one (a filtered belief, which tells visits of a place apart), and where the tool should be then.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from kmp.kernel_row import add_weighted
from service.core.frame import Record, Records, Vector
from service.core.geometry import ROUND_TO, round_to
from service.core.skill.model import COVARIANCE_ROUND_TO, MOTION_ROUND_TO
from service.core.skill.tuning import (
    AMBIGUOUS_M,
    CALM_MPS,
    DIRECTION_SPEED_MPS,
    DIRECTION_WEIGHT,
    ERROR_WIDTH,
    FIRST_SAMPLE_WEIGHT,
    FIRST_STAGE_ODDS,
    FULL_SEGMENT_M,
    LEAST_SEGMENT_SHARE,
    LEAST_STAGE_PROBABILITY,
    LEAST_STD_M,
    MAX_SQUARED_DEVIATION,
    MAX_TARGET_MPS2,
    MOTION_STEP_S,
    OTHER_STAGE_ERROR_WEIGHT,
    PULL_SHARPNESS_PER_M2,
    REST_SHARPNESS,
    RESTLESS_WEIGHT,
    SAMPLE_CORRELATION_S,
    SEGMENT_END_M,
    SEGMENT_MIDDLE_M,
    STAGE_ASTRAY_PER_S,
    STAGE_BACK_PER_S,
    STAGE_CYCLE_PER_S,
    STAGE_END_M,
    STAGE_FORWARD_PER_S,
    WITH_HAND_POWER,
)

MOST_STAGES = 64  # that a state has room for
STAYS, NONE, LEFT, RIGHT = 0.0, -1, 0, 1  # a hand's way squared that does not move; what the tool goes with
OUTPUTS = 4  # how far along the tool is, and its offset
# One stage, in compiled loops: its ends, for the left and the right hand and the tool.
STAGE = np.dtype(
    [
        ("begins", np.float64, (2, 3)),  # [m] where each hand is at its begin,
        ("way", np.float64, (2, 3)),  # [m] and how it goes to its end
        ("square", np.float64, (2,)),  # [m²] of the way; STAYS
        ("off", np.float64, (2,)),  # [m] how far each hand is off that way, root mean square
        ("tool", np.float64, (3,)),  # [m] where the tool is at its begin,
        ("tool_way", np.float64, (3,)),  # [m] and how it goes
        ("follow", np.int64, (2,)),  # the hand that the tool goes with, at its begin and at its end
    ]
)
# What is of one size in all stages, in compiled loops.
PLACED = np.dtype(
    [
        ("scale", np.float64),  # of the kernel exp(-scale |difference|²)
        ("likeness", np.float64),  # what a centre of another stage counts
        ("std", np.float64),  # [m] how sure the via-points' positions are, of each axis
        ("prior", np.float64, (OUTPUTS,)),  # far from all data
    ]
)
# What is known of the hands, in compiled loops: see `model.Seen`.
SEEN = np.dtype(
    [
        ("moving", np.float64, (3, 6)),
        ("now", np.float64, (3, 6)),
        ("stillness", np.float64, (2,)),
        ("period_s", np.float64),
    ]
)


@compiled
def on_way(hand: Vector, stage: Record, side: int) -> tuple[float, float]:
    """How far along its way in a stage a hand (3,) is, 0 to 1, and how far off it [m].

    A hand that stays is there.
    """
    begins, way, square = stage["begins"][side], stage["way"][side], stage["square"][side]
    along = 0.0
    if square > STAYS:
        for i in range(3):
            along += (hand[i] - begins[i]) * way[i]
        along = min(max(along / square, 0.0), 1.0)
    off = 0.0
    for i in range(3):
        off += (hand[i] - begins[i] - along * way[i]) ** 2
    return along if square > STAYS else 1.0, math.sqrt(off)


@compiled
def along_way(hand: Vector, still: float, stage: Record, side: int) -> float:
    """As `on_way`, of a hand (3,) that is so still, 0 to 1: one that rests near an end is there."""
    along, _ = on_way(hand, stage, side)
    square = stage["square"][side]
    if square <= STAYS:
        return along
    long = math.sqrt(square)
    size = min(max(long / FULL_SEGMENT_M, LEAST_SEGMENT_SHARE), 1.0)
    near = min(
        max((SEGMENT_MIDDLE_M - min(along, 1.0 - along) * long / size) / (SEGMENT_MIDDLE_M - SEGMENT_END_M), 0.0), 1.0
    )
    power = 1.0 + (REST_SHARPNESS - 1.0) * near * still
    one, other = along**power, (1.0 - along) ** power
    return float(one / (one + other))


@compiled
def along_both(hands: Vector, still: Vector, stage: Record) -> tuple[float, float]:
    """How far along a stage both hands (6,) are, that are so still (2,)."""
    return along_way(hands[:3], still[0], stage, 0), along_way(hands[3:], still[1], stage, 1)


@compiled
def _near(hands: Vector, stage: Record) -> float:
    """How near (0 to 1) both hands (6,) are to where a stage begins."""
    square = 0.0
    for side in range(2):
        for i in range(3):
            square += (hands[3 * side + i] - stage["begins"][side, i]) ** 2
    return math.exp(-0.5 * square / STAGE_END_M**2)


@compiled
def _likely(moving: Vector, stage: Record) -> float:
    """The logarithm of how probable hands are in a stage that move so (3, 6)."""
    out = 0.0
    for side in range(2):
        here = slice(3 * side, 3 * side + 3)
        _, off = on_way(moving[0, here], stage, side)
        out -= 0.5 * min((off / stage["off"][side]) ** 2, MAX_SQUARED_DEVIATION)
        square, speed, along = stage["square"][side], 0.0, 0.0
        for i in range(3):
            speed += moving[1, 3 * side + i] ** 2
            along += moving[1, 3 * side + i] * stage["way"][side, i]
        goes = along / math.sqrt(square) if square > STAYS else -RESTLESS_WEIGHT * math.sqrt(speed)
        out += DIRECTION_WEIGHT * math.tanh(goes / DIRECTION_SPEED_MPS)
    return out


@compiled
def recognise(belief: Vector, moving: Vector, period_s: float, stages: Records) -> None:
    """The belief (K or more,) in each of K stages, a period later, of hands that move so (3, 6).

    A forward filter of a hidden Markov model (Rabiner 1989). One of zeros begins anew.
    """
    count, hands = len(stages), moving[0]
    total, share = 0.0, min(period_s / SAMPLE_CORRELATION_S, 1.0)
    for k in range(count):
        total += belief[k]
    if total <= 0.0:
        share = FIRST_SAMPLE_WEIGHT
        for k in range(count):
            belief[k] = (FIRST_STAGE_ODDS if k == 0 else 1.0) / (count - 1 + FIRST_STAGE_ODDS)
    elif count > 1:
        before = belief[0]
        for k in range(count - 1):
            near = _near(hands, stages[k + 1])
            on = min(STAGE_FORWARD_PER_S * period_s * near, 0.5) * before
            back = min(STAGE_BACK_PER_S * period_s * near, 0.5) * belief[k + 1]
            before = belief[k + 1]
            belief[k] += back - on
            belief[k + 1] += on - back
        again = min(STAGE_CYCLE_PER_S * period_s * _near(hands, stages[0]), 0.5) * belief[count - 1]
        belief[count - 1] -= again
        belief[0] += again
        for k in range(count):
            belief[k] += STAGE_ASTRAY_PER_S * period_s * (1.0 / count - belief[k])
    told = np.empty(count)
    for k in range(count):
        told[k] = _likely(moving, stages[k])
    most = told.max()
    total = 0.0
    for k in range(count):
        belief[k] *= math.exp((told[k] - most) * share)
        total += belief[k]
    for k in range(count):
        belief[k] = round(belief[k] / total * ROUND_TO) / ROUND_TO


@compiled
def off_all(hands: Vector, stages: Records) -> float:
    """How far the farther of both hands (6,) is off its ways in all stages, rounded [m]."""
    farther = 0.0
    for side in range(2):
        nearest = math.inf
        for k in range(len(stages)):
            nearest = min(nearest, on_way(hands[3 * side : 3 * side + 3], stages[k], side)[1])
        farther = max(farther, nearest)
    return float(np.rint(farther * MOTION_ROUND_TO) / MOTION_ROUND_TO)


@compiled
def add_followed(hands: Vector, share: float, stage: Record, out: Vector) -> None:
    """Adds to `out` (3,) by how much the tool goes with hands (6,), where it is so far along."""
    follow = stage["follow"]
    power = 1 if follow[0] == follow[1] else WITH_HAND_POWER
    for end in range(2):
        side = follow[end]
        if side >= 0:
            goes = (share if end else 1.0 - share) ** power
            for i in range(3):
                out[i] += goes * (hands[3 * side + i] - stage["begins"][side, i] - end * stage["way"][side, i])


@compiled
def _tool_in(
    hands: Vector, still: Vector, k: int, stages: Records, size: Record, rows: Vector, pulls: Vector, out: Vector
) -> None:
    """The tool into `out` (3,) in one stage: equation (8) of Huang et al. 2019, and back."""
    stage, found = stages[k], np.empty(OUTPUTS)
    one, other = along_both(hands, still, stage)
    found[:] = size["prior"]
    for r in range(len(rows)):
        value = math.exp(-size["scale"] * ((one - rows[r, 0]) ** 2 + (other - rows[r, 1]) ** 2))
        if rows[r, 2] != k:
            value *= size["likeness"]
        for o in range(OUTPUTS):
            found[o] += value * rows[r, 3 + o]
    share = found[0]
    for i in range(3):
        out[i] = stage["tool"][i] + share * stage["tool_way"][i] + found[1 + i]
    add_followed(hands, min(max(share, 0.0), 1.0), stage, out)
    if len(pulls):
        add_weighted(hands, pulls, PULL_SHARPNESS_PER_M2, out)


@compiled
def tools_at(
    hands: Vector,
    still: Vector,
    belief: Vector,
    stages: Records,
    sizes: Records,
    rows: Vector,
    pulls: Vector,
    out: Vector,
) -> None:
    """The tools into `out` (K, 3) in the stages that are believed in."""
    for k in range(len(stages)):
        if belief[k] >= LEAST_STAGE_PROBABILITY:
            _tool_in(hands, still, k, stages, sizes[0], rows, pulls, out[k])


@compiled
def expected(belief: Vector, tools: Vector, out: Vector) -> None:
    """The mean of the tools (K, 3) in all stages into `out` (3,)."""
    total = 0.0
    out[:] = 0.0
    for k in range(len(tools)):
        if belief[k] >= LEAST_STAGE_PROBABILITY:
            total += belief[k]
            for i in range(3):
                out[i] += belief[k] * tools[k, i]
    for i in range(3):
        out[i] /= total


@compiled
def _torn(belief: Vector, tools: Vector) -> float:
    """How probable stages are whose tool (K, 3) is elsewhere than in the most probable one."""
    most = 0
    for k in range(len(tools)):
        if belief[k] > belief[most]:
            most = k
    out = 0.0
    for k in range(len(tools)):
        if belief[k] >= LEAST_STAGE_PROBABILITY and k != most:
            square = 0.0
            for i in range(3):
                square += (tools[k, i] - tools[most, i]) ** 2
            if square > AMBIGUOUS_M**2:
                out += belief[k]
    return out


@compiled
def _around(moving: Vector, out: Vector) -> None:
    """Hands that move so (3, 6) a step ago, now and a step ahead, into `out` (3, 6). One that only
    trembles stays.
    """
    for side in range(2):
        square = 0.0
        for i in range(3 * side, 3 * side + 3):
            square += moving[1, i] * moving[1, i]
        goes = 1.0 - math.exp(-((math.sqrt(square) / CALM_MPS) ** 4))
        for i in range(3 * side, 3 * side + 3):
            step, bend = MOTION_STEP_S * goes * moving[1, i], 0.5 * MOTION_STEP_S**2 * goes * moving[2, i]
            out[0, i], out[1, i], out[2, i] = moving[0, i] - step + bend, moving[0, i], moving[0, i] + step + bend


@compiled
def scatter(
    hands: Vector,
    still: Vector,
    belief: Vector,
    stages: Records,
    tools: Vector,
    errors: Vector,
    std: float,
    out: Vector,
) -> None:
    """The mean square (3, 3) of errors near there, what the stages' tools (K, 3) differ by, and
    what via-points are off by.
    """
    out[:] = 0.0
    mean, weights, in_all = np.empty(3), np.empty(len(errors)), 0.0
    expected(belief, tools, mean)
    for k in range(len(stages)):
        if belief[k] < LEAST_STAGE_PROBABILITY:
            continue
        in_all += belief[k]
        one, other = along_both(hands, still, stages[k])
        total = 1e-9
        for m in range(len(errors)):
            square = (one - errors[m, 0]) ** 2 + (other - errors[m, 1]) ** 2
            weights[m] = math.exp(-0.5 * square / ERROR_WIDTH**2) * (
                1.0 if errors[m, 2] == k else OTHER_STAGE_ERROR_WEIGHT
            )
            total += weights[m]
        for i in range(3):
            for j in range(i, 3):
                found = (tools[k, i] - mean[i]) * (tools[k, j] - mean[j])
                for m in range(len(errors)):
                    found += weights[m] * errors[m, 3 + i] * errors[m, 3 + j] / total
                out[i, j] += belief[k] * found
    for i in range(3):
        for j in range(i, 3):
            out[i, j] /= in_all
            out[j, i] = out[i, j]
        out[i, i] += std**2 + LEAST_STD_M**2


@compiled
def predicted(
    seen: Records,
    belief: Vector,
    stages: Records,
    sizes: Records,
    rows: Vector,
    pulls: Vector,
    errors: Vector,
    out: Vector,
) -> tuple[float, float]:
    """Brings the belief up to date; tool, velocity, acceleration and covariance, rounded, into
    `out` (6, 3), the last none without errors; what the gate compares [m], and how torn it is.

    Velocity and acceleration are by differences along the hands' motion.
    """
    one, hands, steps = seen[0], np.empty((3, 6)), np.empty((3, 3))
    still, tools = one["stillness"], np.empty((3, len(stages), 3))
    if one["period_s"] > 0.0:
        recognise(belief, one["now"], one["period_s"], stages)
    _around(one["moving"], hands)
    for n in range(3):
        tools_at(hands[n], still, belief, stages, sizes, rows, pulls, tools[n])
        expected(belief, tools[n], steps[n])
    for i in range(3):
        bend = (steps[2, i] - 2.0 * steps[1, i] + steps[0, i]) / MOTION_STEP_S**2
        out[0, i] = steps[1, i]
        out[1, i] = (steps[2, i] - steps[0, i]) / (2.0 * MOTION_STEP_S)
        out[2, i] = min(max(bend, -MAX_TARGET_MPS2), MAX_TARGET_MPS2)
    out[3:] = 0.0
    if len(errors):
        scatter(hands[1], still, belief, stages, tools[1], errors, sizes[0]["std"], out[3:])
    round_to(out[:3], MOTION_ROUND_TO)
    round_to(out[3:], COVARIANCE_ROUND_TO)
    return off_all(one["now"][0], stages), _torn(belief, tools[1])
