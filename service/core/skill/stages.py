"""Stages of a task, each between two successive via-points: the share of the stage that the hands
have covered, the belief in each stage, and the tool's position with its covariance.

In a stage, each hand moves along a segment from its first via-point to its second one. The belief
is filtered over time, so it distinguishes several visits to the same via-point.

Symbols: hand h (3,) [m]; its first via-point b (3,), segment w (3,) [m] and root-mean-square
distance from that segment σ [m] (`begins`, `way` and `off` of STAGE); belief p_k in stage k of K.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from kmp.loops.kernel_row import add_weighted
from service.core.frame import Record, Records, Vector
from service.core.geometry import ROUND_TO, round_to
from service.core.numerics import MOTION_STEP_S
from service.core.skill.model import COVARIANCE_ROUND_TO, MOTION_ROUND_TO
from service.core.skill.tuning import (
    AMBIGUOUS_M,
    CALM_MPS,
    DIRECTION_SPEED_MPS,
    ERROR_WIDTH,
    FIRST_STAGE_ODDS,
    FULL_SEGMENT_M,
    LEAST_STAGE_PROBABILITY,
    LEAST_STD_M,
    MAX_SQUARED_DEVIATION,
    MAX_TARGET_MPS2,
    OTHER_STAGE_ERROR_WEIGHT,
    PULL_SHARPNESS_PER_M2,
    REST_SHARPNESS,
    SAMPLE_CORRELATION_S,
    SEGMENT_END_M,
    SEGMENT_MIDDLE_M,
    STAGE_ASTRAY_PER_S,
    STAGE_CHANGE_PER_S,
    STAGE_CYCLE_PER_S,
    STAGE_END_M,
    WITH_HAND_POWER,
)
from service.core.vectors import dot, norm, squared_distance

MOST_STAGES = 64  # stages for which the state has room
STAYS, NONE, LEFT, RIGHT = 0.0, -1, 0, 1  # `square` of a hand that rests; the hand that the tool follows
OUTPUTS = 4  # outputs of the primitive: the tool's share of its segment, and its offset x y z [m]
# One stage as compiled functions read it: segments of the left and the right hand and of the tool.
STAGE = np.dtype(
    [
        ("begins", np.float64, (2, 3)),  # [m] each hand's first via-point
        ("way", np.float64, (2, 3)),  # [m] each hand's segment, from the first via-point to the second one
        ("square", np.float64, (2,)),  # [m²] squared length of the segment; STAYS for a hand that rests
        ("off", np.float64, (2,)),  # [m] each hand's distance from its segment, root mean square
        ("tool", np.float64, (3,)),  # [m] the tool's first via-point
        ("tool_way", np.float64, (3,)),  # [m] the tool's segment
        ("follow", np.int64, (2,)),  # hand that the tool follows at the begin and at the end of the stage
        ("pulled", np.int64, (2,)),  # first row of the pulls of this stage alone, and the row after the last one
        ("sharpness", np.float64),  # [1/m²] sharpness of these pulls
    ]
)
# Numbers that hold in all stages, as compiled functions read them.
PLACED = np.dtype(
    [
        ("scale", np.float64),  # scale of the kernel exp(-scale |difference|²)
        ("likeness", np.float64),  # factor of the kernel for a centre of another stage
        ("std", np.float64),  # [m] standard deviation of the via-points on each axis
        ("prior", np.float64, (OUTPUTS,)),  # the primitive's outputs far from all data
        ("pulls", np.int64),  # number of pulls that act in all stages; they are the first rows
    ]
)
# The hands' motion as compiled functions read it: see `model.Seen`.
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
    """Share λ, 0 to 1, of its segment that a hand h (3,) has covered, and its distance d [m] from
    the segment:

        λ = clip((h - b)·w / |w|², 0, 1),   d = |h - b - λ w|

    A hand that rests in this stage (w = 0) has covered the whole segment: the share is 1.
    """
    begins, segment, square = stage["begins"][side], stage["way"][side], stage["square"][side]
    along = 0.0
    if square > STAYS:
        for i in range(3):
            along += (hand[i] - begins[i]) * segment[i]
        along = min(max(along / square, 0.0), 1.0)
    off = 0.0
    for i in range(3):
        off += (hand[i] - begins[i] - along * segment[i]) ** 2
    return along if square > STAYS else 1.0, math.sqrt(off)


@compiled
def along_way(hand: Vector, still: float, stage: Record, side: int) -> float:
    """Share of its segment that a hand (3,) with the stillness s has covered, attracted to the ends
    while the hand rests.

    With λ of `on_way` and the distance r = min(λ, 1 - λ) max(|w|, FULL_SEGMENT_M) from the nearer
    end, on a segment that is stretched to FULL_SEGMENT_M if it is shorter:

        near = clip((SEGMENT_MIDDLE_M - r) / (SEGMENT_MIDDLE_M - SEGMENT_END_M), 0, 1)
        n = 1 + (REST_SHARPNESS - 1) near s,   share = λⁿ / (λⁿ + (1 - λ)ⁿ)
    """
    along, _ = on_way(hand, stage, side)
    square = stage["square"][side]
    if square <= STAYS:
        return along
    from_end = min(along, 1.0 - along) * max(math.sqrt(square), FULL_SEGMENT_M)
    near = min(max((SEGMENT_MIDDLE_M - from_end) / (SEGMENT_MIDDLE_M - SEGMENT_END_M), 0.0), 1.0)
    power = 1.0 + (REST_SHARPNESS - 1.0) * near * still
    one, other = along**power, (1.0 - along) ** power
    return float(one / (one + other))


@compiled
def along_both(hands: Vector, still: Vector, stage: Record) -> tuple[float, float]:
    """Shares of the stage, by `along_way`, of both hands (6,) with the stillness (2,)."""
    return along_way(hands[:3], still[0], stage, 0), along_way(hands[3:], still[1], stage, 1)


@compiled
def _near(hands: Vector, stage: Record) -> float:
    """Proximity, 0 to 1, of both hands to the begin of a stage: exp(-½ Σ |h - b|² / STAGE_END_M²),
    summed over the hands.
    """
    square = 0.0
    for side in range(2):
        for i in range(3):
            square += (hands[3 * side + i] - stage["begins"][side, i]) ** 2
    return math.exp(-0.5 * square / STAGE_END_M**2)


@compiled
def _likely(moving: Vector, stage: Record) -> float:
    """Evidence of the hands' motion (3, 6) for a stage, used as its log likelihood, summed over
    both hands. It has no term of σ, so that no stage is preferred for its accuracy alone:

        -½ min(d² / σ², MAX_SQUARED_DEVIATION) + tanh(u / DIRECTION_SPEED_MPS)

    d is the distance of `on_way`. u is the speed along the segment, v·w / |w|; for a hand that
    rests in this stage, u = -|v|.
    """
    out = 0.0
    for side in range(2):
        here = slice(3 * side, 3 * side + 3)
        _, off = on_way(moving[0, here], stage, side)
        out -= 0.5 * min((off / stage["off"][side]) ** 2, MAX_SQUARED_DEVIATION)
        length, velocity = stage["square"][side], moving[1, here]
        goes = dot(velocity, stage["way"][side]) / math.sqrt(length) if length > STAYS else -norm(velocity)
        out += math.tanh(goes / DIRECTION_SPEED_MPS)
    return out


@compiled
def recognise(belief: Vector, moving: Vector, period_s: float, stages: Records) -> None:
    """Update the belief (K or more,) in K stages by the hands' motion (3, 6), one period Δ later,
    in place.

    This is the forward filter of a hidden Markov model (Rabiner 1989). Transitions, with n_k =
    `_near` of stage k, each moving at most half of a probability:

        k to k + 1:      STAGE_CHANGE_PER_S Δ n_(k+1) p_k
        k + 1 to k:      STAGE_CHANGE_PER_S Δ n_(k+1) p_(k+1)
        last to first:   STAGE_CYCLE_PER_S Δ n_0 p_(K-1)
        to all stages:   p_k = p_k + STAGE_ASTRAY_PER_S Δ (1 / K - p_k)

    Evidence, with the log likelihoods L_k of `_likely`: p_k ∝ p_k exp(c L_k), where c = min(Δ /
    SAMPLE_CORRELATION_S, 1), as successive samples are correlated.

    A belief of zeros starts anew: the first stage is FIRST_STAGE_ODDS times as probable as any
    other, and c = 1.
    """
    count, hands = len(stages), moving[0]
    total, share = 0.0, min(period_s / SAMPLE_CORRELATION_S, 1.0)
    for k in range(count):
        total += belief[k]
    if total <= 0.0:
        share = 1.0
        for k in range(count):
            belief[k] = (FIRST_STAGE_ODDS if k == 0 else 1.0) / (count - 1 + FIRST_STAGE_ODDS)
    elif count > 1:
        before = belief[0]
        for k in range(count - 1):
            change = min(STAGE_CHANGE_PER_S * period_s * _near(hands, stages[k + 1]), 0.5)
            forward, backward = change * before, change * belief[k + 1]
            before = belief[k + 1]
            belief[k] += backward - forward
            belief[k + 1] += forward - backward
        restart = min(STAGE_CYCLE_PER_S * period_s * _near(hands, stages[0]), 0.5) * belief[count - 1]
        belief[count - 1] -= restart
        belief[0] += restart
        for k in range(count):
            belief[k] += STAGE_ASTRAY_PER_S * period_s * (1.0 / count - belief[k])
    likelihood = np.empty(count)
    for k in range(count):
        likelihood[k] = _likely(moving, stages[k])
    most = likelihood.max()
    total = 0.0
    for k in range(count):
        belief[k] *= math.exp((likelihood[k] - most) * share)
        total += belief[k]
    for k in range(count):
        belief[k] = round(belief[k] / total * ROUND_TO) / ROUND_TO


@compiled
def off_all(hands: Vector, stages: Records) -> float:
    """Distance [m] of the hands (6,) from the task: for each hand the distance from the nearest of
    its segments in all stages, then the larger one of both hands. Rounded to MOTION_ROUND_TO.
    """
    farther = 0.0
    for side in range(2):
        nearest = math.inf
        for k in range(len(stages)):
            nearest = min(nearest, on_way(hands[3 * side : 3 * side + 3], stages[k], side)[1])
        farther = max(farther, nearest)
    return float(np.rint(farther * MOTION_ROUND_TO) / MOTION_ROUND_TO)


@compiled
def add_followed(hands: Vector, share: float, stage: Record, out: Vector) -> None:
    """Add to `out` (3,) the offset with which the tool follows the hands (6,), at a `share` s of a
    stage:

        out = out + (1 - s)ⁿ (h_0 - q_0) + sⁿ (h_1 - q_1)

    h_0 is the hand that the tool follows at the stage's begin and q_0 that hand's via-point there;
    h_1 and q_1 are the same at its end. n = 1 if it is one hand, else WITH_HAND_POWER. An end at
    which the tool follows no hand adds nothing.
    """
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
    """Tool position in stage k for hands (6,) with the stillness (2,), written to `out` (3,) [m].

    With the hands' shares x (2,) of the stage, the primitive gives the tool's share s and its
    offset δ (3,) [m] by equation (8) of Huang et al. 2019, over its R centres c_r with the weights
    W_r (4,):

        (s, δ) = prior + Σ_r g_r exp(-scale |x - c_r|²) W_r,   g_r = 1 in stage k, else `likeness`
        tool = t + s u + δ

    t and u are the tool's first via-point and its segment. Added are the hands that the tool
    follows (`add_followed`) and the `pulls` (X, 9) of other via-points, those that act in all
    stages and those of stage k (`via_points.pulls_through`).
    """
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
        add_weighted(hands, pulls[: size["pulls"]], PULL_SHARPNESS_PER_M2, out)
        add_weighted(hands, pulls[stage["pulled"][0] : stage["pulled"][1]], stage["sharpness"], out)


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
    """Tool positions in all stages with at least LEAST_STAGE_PROBABILITY, by `_tool_in`, written to
    `out` (K, 3). The rows of other stages are left as they are.
    """
    for k in range(len(stages)):
        if belief[k] >= LEAST_STAGE_PROBABILITY:
            _tool_in(hands, still, k, stages, sizes[0], rows, pulls, out[k])


@compiled
def expected(belief: Vector, tools: Vector, out: Vector) -> None:
    """Mean of the tool positions t_k (K, 3), written to `out` (3,): Σ p_k t_k / Σ p_k, over the
    stages with at least LEAST_STAGE_PROBABILITY.
    """
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
def _ambiguity(belief: Vector, tools: Vector) -> float:
    """Probability that the tool belongs elsewhere: the sum of p_k over the stages whose tool
    position (K, 3) is more than AMBIGUOUS_M from that of the most probable stage.

    Stages below LEAST_STAGE_PROBABILITY are left out.
    """
    most = 0
    for k in range(len(tools)):
        if belief[k] > belief[most]:
            most = k
    out = 0.0
    for k in range(len(tools)):
        if belief[k] < LEAST_STAGE_PROBABILITY or k == most:
            continue
        if squared_distance(tools[k], tools[most]) > AMBIGUOUS_M**2:
            out += belief[k]
    return out


@compiled
def _around(moving: Vector, out: Vector) -> None:
    """Hands' positions one step h = MOTION_STEP_S ago, now and one step ahead, written to `out` (3,
    6), for the hands' motion (3, 6):

        x - h g v + ½ h² g a,   x,   x + h g v + ½ h² g a,   g = 1 - exp(-(|v| / CALM_MPS)⁴)

    g makes a hand stay that only trembles.
    """
    for side in range(2):
        square = 0.0
        for i in range(3 * side, 3 * side + 3):
            square += moving[1, i] * moving[1, i]
        goes = 1.0 - math.exp(-((math.sqrt(square) / CALM_MPS) ** 4))
        for i in range(3 * side, 3 * side + 3):
            step, curved = MOTION_STEP_S * goes * moving[1, i], 0.5 * MOTION_STEP_S**2 * goes * moving[2, i]
            out[0, i], out[1, i], out[2, i] = moving[0, i] - step + curved, moving[0, i], moving[0, i] + step + curved


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
    """Covariance C (3, 3) [m²] of the expected tool position, written to `out`:

        C = Σ_k p_k ((t_k - t)(t_k - t)ᵀ + E_k) / Σ_k p_k + (std² + LEAST_STD_M²) I
        E_k = Σ_m g_km e_m e_mᵀ / Σ_m g_km
        g_km = exp(-½ |x_k - x_m|² / ERROR_WIDTH²), times OTHER_STAGE_ERROR_WEIGHT in another stage

    t_k are the stages' tool positions (K, 3) with the mean t; x_k are the hands' shares (2,) of
    stage k. `errors` (M, 6) are rows of x_m (2), stage and the tool's error e_m (3) [m] in held-out
    demonstrations. `std` [m] is the standard deviation of the via-points. Stages below
    LEAST_STAGE_PROBABILITY are left out.
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
    """Prediction of the tool for `seen` (1,) of SEEN: the belief is updated in place by the hands'
    motion `now`, `period_s` after its last update, and the tool is predicted for the motion
    `moving`.

    Written to `out` (6, 3), rounded: position, velocity, acceleration, and the covariance (3, 3) of
    `scatter`, which is zero without `errors`. With the expected positions t_-, t_0, t_+ at the
    three times of `_around`, h = MOTION_STEP_S apart:

        velocity = (t_+ - t_-) / (2 h)
        acceleration = clip((t_+ - 2 t_0 + t_-) / h², ±MAX_TARGET_MPS2)

    Returns the distance [m] of the hands from the task (`off_all`), which the gate compares with
    the threshold, and the probability that the tool belongs elsewhere (`_ambiguity`).
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
        acceleration = (steps[2, i] - 2.0 * steps[1, i] + steps[0, i]) / MOTION_STEP_S**2
        out[0, i] = steps[1, i]
        out[1, i] = (steps[2, i] - steps[0, i]) / (2.0 * MOTION_STEP_S)
        out[2, i] = min(max(acceleration, -MAX_TARGET_MPS2), MAX_TARGET_MPS2)
    out[3:] = 0.0
    if len(errors):
        scatter(hands[1], still, belief, stages, tools[1], errors, sizes[0]["std"], out[3:])
    round_to(out[:3], MOTION_ROUND_TO)
    round_to(out[3:], COVARIANCE_ROUND_TO)
    return off_all(one["now"][0], stages), _ambiguity(belief, tools[1])
