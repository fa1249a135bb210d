"""Segments of a task, each between two successive via-points: the share of the segment that the
hands have covered, the belief in each segment, and the tool's position with its covariance.

In a segment, each hand moves along a path from its first via-point to its second one. The belief
is filtered over time, so it distinguishes several visits to the same via-point.

Symbols: hand h (3,) [m]; its first via-point b (3,), path w (3,) [m] and root-mean-square
distance from that path σ [m] (`begins`, `way` and `off` of SEGMENT); belief p_k in segment k of K.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import exp, tanh
from kmp.loops.kernel_row import add_weighted
from kmp.loops.mean import add_table
from thirdhand.core.frame import Record, Records, Vector
from thirdhand.core.numerics import MOTION_STEP_S, UNPRIMED_DECIDED
from thirdhand.core.skill.memory import turning
from thirdhand.core.skill.model import COVARIANCE_ROUND_TO, MOTION_ROUND_TO, Seen
from thirdhand.core.skill.tuning import (
    AMBIGUOUS_M,
    CALM_MPS,
    DIRECTION_SPEED_MPS,
    ERROR_SCALE,
    ERROR_SEGMENT_DISTANCE,
    FIRST_SEGMENT_ODDS,
    FULL_PATH_M,
    LEAST_SEGMENT_PROBABILITY,
    LEAST_STD_M,
    MAX_SQUARED_DEVIATION,
    MAX_TARGET_MPS2,
    PATH_END_M,
    PATH_MIDDLE_M,
    PULL_SHARPNESS_PER_M2,
    REST_SHARPNESS,
    SAMPLE_CORRELATION_S,
    SEGMENT_ASTRAY_PER_S,
    SEGMENT_CHANGE_PER_S,
    SEGMENT_CYCLE_PER_S,
    SEGMENT_DISTANCE,
    SEGMENT_END_M,
    SUPPORT_MASS,
    UNSURE_M,
    WITH_HAND_POWER,
)
from thirdhand.core.vectors import dot, norm, round_to, rounded, squared_distance

MOST_SEGMENTS = 64  # segments for which the state has room
STAYS = 0.0  # `square` of a hand that rests
# the hand that the tool follows, or that leads
NONE = -1
LEFT = 0
RIGHT = 1
OUTPUTS = 4  # outputs of the primitive: the tool's share of its path, and its offset x y z [m]
# One segment as compiled functions read it: paths of the left and the right hand and of the tool.
SEGMENT = np.dtype(
    [
        ("begins", np.float64, (2, 3)),  # [m] each hand's first via-point
        # [m] each hand's path, from the first via-point to the second one
        ("way", np.float64, (2, 3)),
        # [m²] squared length of the path; STAYS for a hand that rests
        ("square", np.float64, (2,)),
        ("off", np.float64, (2,)),  # [m] each hand's distance from its path, root mean square
        ("tool", np.float64, (3,)),  # [m] the tool's first via-point
        ("tool_way", np.float64, (3,)),  # [m] the tool's path
        ("leads", np.int64),  # hand whose share alone counts in this segment; NONE: both count
        # hand that the tool follows at the begin and at the end of the segment
        ("follow", np.int64, (2,)),
        ("levers", np.float64, (2, 3)),  # [m] the tool there, in the frame of that hand
        ("turned", np.int64),  # 1: the tool turns with the hands that it follows, by these levers
        # [m²] covariance of the tool's via-points at begin and end; 0: known
        ("scatter", np.float64, (2, 3, 3)),
        # first row of the pulls of this segment alone, and the row after the last one
        ("pulled", np.int64, (2,)),
        ("sharpness", np.float64),  # [1/m²] sharpness of these pulls
    ]
)
# Numbers that hold in all segments, as compiled functions read them.
PLACED = np.dtype(
    [
        ("scale", np.float64),  # scale of the kernel exp(-scale |difference|²)
        ("std", np.float64),  # [m] standard deviation of the via-points on each axis
        # as an input, a second in the segment counts as this share of it; 0: no clock
        ("clock_weight", np.float64),
        # [m] standard deviation of the tool where nothing was shown; 0: as at the nearest data
        ("unknown_std", np.float64),
        ("prior", np.float64, (OUTPUTS,)),  # the primitive's outputs far from all data
        ("pulls", np.int64),  # number of pulls that act in all segments; they are the first rows
    ]
)


@compiled
def on_way(hand: Vector, segment: Record, side: int) -> tuple[float, float]:
    """Share λ, 0 to 1, of its path that a hand h (3,) has covered, and its distance d [m] from
    the path:

        λ = clip((h - b)·w / |w|², 0, 1),   d = |h - b - λ w|

    A hand that rests in this segment (w = 0) has covered the whole path: the share is 1.
    """
    begins = segment["begins"][side]
    path = segment["way"][side]
    square = segment["square"][side]
    along = 0.0
    if square > STAYS:
        for i in range(3):
            along += (hand[i] - begins[i]) * path[i]
        along = min(max(along / square, 0.0), 1.0)
    square_sum = 0.0
    for i in range(3):
        square_sum += (hand[i] - begins[i] - along * path[i]) ** 2
    return along if square > STAYS else 1.0, math.sqrt(square_sum)


@compiled
def along_way(hand: Vector, still: float, segment: Record, side: int) -> float:
    """Share of its path that a hand (3,) with the stillness s has covered, attracted to the ends
    while the hand rests.

    With λ of `on_way` and the distance r = min(λ, 1 - λ) max(|w|, FULL_PATH_M) from the nearer
    end, on a path that is stretched to FULL_PATH_M if it is shorter:

        near = clip((PATH_MIDDLE_M - r) / (PATH_MIDDLE_M - PATH_END_M), 0, 1)
        n = 1 + (REST_SHARPNESS - 1) near s,   share = λⁿ / (λⁿ + (1 - λ)ⁿ)
    """
    along, _ = on_way(hand, segment, side)
    square = segment["square"][side]
    if square <= STAYS:
        return along
    from_end = min(along, 1.0 - along) * max(math.sqrt(square), FULL_PATH_M)
    near = min(max((PATH_MIDDLE_M - from_end) / (PATH_MIDDLE_M - PATH_END_M), 0.0), 1.0)
    power = 1.0 + (REST_SHARPNESS - 1.0) * near * still
    covered = along**power
    other = (1.0 - along) ** power
    return float(covered / (covered + other))


@compiled
def along_both(hands: Vector, still: Vector, segment: Record) -> tuple[float, float]:
    """Shares of the segment, by `along_way`, of both hands (6 or more,) with the stillness (2,). If
    one hand leads the segment, its share counts for both.
    """
    left = along_way(hands[:3], still[0], segment, 0)
    right = along_way(hands[3:6], still[1], segment, 1)
    if segment["leads"] == LEFT:
        right = left
    elif segment["leads"] == RIGHT:
        left = right
    return left, right


@compiled
def _near(hands: Vector, segment: Record) -> float:
    """Proximity, 0 to 1, of both hands to the begin of a segment: exp(-½ Σ |h - b|² /
    SEGMENT_END_M²), summed over the hands.
    """
    square = 0.0
    for side in range(2):
        for i in range(3):
            square += (hands[3 * side + i] - segment["begins"][side, i]) ** 2
    return exp(-0.5 * square / SEGMENT_END_M**2)


@compiled
def _likely(moving: Vector, segment: Record) -> float:
    """Evidence of the hands' motion (3, 6) for a segment, used as its log likelihood, summed over
    both hands. It has no term of σ, so that no segment is preferred for its accuracy alone:

        -½ min(d² / σ², MAX_SQUARED_DEVIATION) + tanh(u / DIRECTION_SPEED_MPS)

    d is the distance of `on_way`. u is the speed along the path, v·w / |w|; for a hand that
    rests in this segment, u = -|v|.
    """
    out = 0.0
    for side in range(2):
        columns = slice(3 * side, 3 * side + 3)
        _, distance_m = on_way(moving[0, columns], segment, side)
        out -= 0.5 * min((distance_m / segment["off"][side]) ** 2, MAX_SQUARED_DEVIATION)
        length = segment["square"][side]
        velocity = moving[1, columns]
        goes = (
            dot(velocity, segment["way"][side]) / math.sqrt(length)
            if length > STAYS
            else -norm(velocity)
        )
        out += tanh(goes / DIRECTION_SPEED_MPS)
    return out


@compiled
def recognise(
    belief: Vector, moving: Vector, period_s: float, segments: Records, first_odds: float
) -> None:
    """Update the belief (K or more,) in K segments by the hands' motion (3, 6), one period Δ later,
    in place.

    This is the forward filter of a hidden Markov model (Rabiner 1989). Transitions, with n_k =
    `_near` of segment k, each moving at most half of a probability:

        k to k + 1:      SEGMENT_CHANGE_PER_S Δ n_(k+1) p_k
        k + 1 to k:      SEGMENT_CHANGE_PER_S Δ n_(k+1) p_(k+1)
        last to first:   SEGMENT_CYCLE_PER_S Δ n_0 p_(K-1)
        to all segments:   p_k = p_k + SEGMENT_ASTRAY_PER_S Δ (1 / K - p_k)

    Evidence, with the log likelihoods L_k of `_likely`: p_k ∝ p_k exp(c L_k), where c = min(Δ /
    SAMPLE_CORRELATION_S, 1), as successive samples are correlated.

    A belief of zeros starts anew: the first segment is `first_odds` times as probable as any other,
    and c = 1.
    """
    count = len(segments)
    hands = moving[0]
    total = 0.0
    share = min(period_s / SAMPLE_CORRELATION_S, 1.0)
    for k in range(count):
        total += belief[k]

    # a new belief, or the transitions
    if total <= 0.0:
        share = 1.0
        for k in range(count):
            belief[k] = (first_odds if k == 0 else 1.0) / (count - 1 + first_odds)
    elif count > 1:
        before = belief[0]
        for k in range(count - 1):
            change = min(SEGMENT_CHANGE_PER_S * period_s * _near(hands, segments[k + 1]), 0.5)
            forward = change * before
            backward = change * belief[k + 1]
            before = belief[k + 1]
            belief[k] += backward - forward
            belief[k + 1] += forward - backward
        restart = (
            min(SEGMENT_CYCLE_PER_S * period_s * _near(hands, segments[0]), 0.5) * belief[count - 1]
        )
        belief[count - 1] -= restart
        belief[0] += restart
        for k in range(count):
            belief[k] += SEGMENT_ASTRAY_PER_S * period_s * (1.0 / count - belief[k])

    # the evidence
    likelihood = np.empty(count)
    for k in range(count):
        likelihood[k] = _likely(moving, segments[k])
    most = likelihood.max()
    total = 0.0
    for k in range(count):
        belief[k] *= exp((likelihood[k] - most) * share)
        total += belief[k]
    for k in range(count):
        belief[k] = rounded(belief[k] / total)


@compiled
def off_all(hands: Vector, segments: Records) -> float:
    """Distance [m] of the hands (6,) from the task: for each hand the distance from the nearest of
    its paths in all segments, then the larger one of both hands. Rounded to MOTION_ROUND_TO.
    """
    farther = 0.0
    for side in range(2):
        nearest = math.inf
        for k in range(len(segments)):
            nearest = min(nearest, on_way(hands[3 * side : 3 * side + 3], segments[k], side)[1])
        farther = max(farther, nearest)
    return rounded(farther, MOTION_ROUND_TO)


@compiled
def add_followed(hands: Vector, share: float, segment: Record, out: Vector) -> None:
    """Add to `out` (3,) the offset with which the tool follows the hands (6 or 24,), at a `share` s
    of a segment:

        out = out + (1 - s)ⁿ (h_0 - q_0) + sⁿ (h_1 - q_1)

    h_0 is the hand that the tool follows at the segment's begin and q_0 that hand's via-point
    there; h_1 and q_1 are the same at its end. n = 1 if it is one hand, else WITH_HAND_POWER. An
    end at which the tool follows no hand adds nothing.

    If the tool turns with the hands, and their rotation matrices R are known (the last 18 of 24
    numbers), it is at the lever l in the frame of the hand, wherever the tool's via-point t is:

        h - q + R l - (t - q) = h + R l - t   in place of   h - q
    """
    follow = segment["follow"]
    power = 1 if follow[0] == follow[1] else WITH_HAND_POWER
    turns = segment["turned"] == 1 and len(hands) > 6
    for end in range(2):
        side = follow[end]
        if side >= 0:
            goes = (share if end else 1.0 - share) ** power
            for i in range(3):
                if turns:
                    offset = hands[3 * side + i] - segment["tool"][i] - end * segment["tool_way"][i]
                    for j in range(3):
                        offset += hands[6 + 9 * side + 3 * i + j] * segment["levers"][end, j]
                    out[i] += goes * offset
                else:
                    out[i] += goes * (
                        hands[3 * side + i]
                        - segment["begins"][side, i]
                        - end * segment["way"][side, i]
                    )


@compiled
def _tool_of(
    hands: Vector, share: float, offset: Vector, segment: Record, size: Record, pulls: Vector
) -> Vector:
    """Tool position (3,) [m] for hands (6 or 24,) when the tool has covered a `share` s of a
    segment, with an `offset` δ (3,) [m]:

        tool = t + s u + δ

    t and u are the tool's first via-point and its path. Added are the hands that the tool
    follows (`add_followed`) and the `pulls` (X, 9) of other via-points, those that act in all
    segments and those of this segment (`via_points.pulls_through`).
    """
    out: Vector = segment["tool"] + share * segment["tool_way"] + offset
    add_followed(hands, min(max(share, 0.0), 1.0), segment, out)
    if len(pulls):
        add_weighted(hands[:6], pulls[: size["pulls"]], PULL_SHARPNESS_PER_M2, out)
        add_weighted(
            hands[:6], pulls[segment["pulled"][0] : segment["pulled"][1]], segment["sharpness"], out
        )
    return out


@compiled
def tools_at(
    hands: Vector,
    tempos: Vector,
    belief: Vector,
    segments: Records,
    sizes: Records,
    centres: Vector,
    pulls: Vector,
    out: Vector,
) -> None:
    """Tool positions [m] for hands (M, 6 or 24) with the `tempos` (M, 3) in all segments with at
    least LEAST_SEGMENT_PROBABILITY, written to `out` (M, K, 3). Those in other segments are left as
    they are. The last 18 of 24 numbers are the hands' rotation matrices. A tempo is the stillness
    of both hands, and the clock [s] of the segment.

    The inputs x (2 + K + 1,) are the hands' shares of the segment, SEGMENT_DISTANCE at the
    segment's number, and the clock times `clock_weight`. The primitive gives the tool's share s and
    its offset δ (3,) [m] by equation (8) of Huang et al. 2019, over its `centres` c_r with the
    weights W_r (4,), a table as in `kmp.loops.mean`:

        (s, δ) = prior + Σ_r exp(-scale |x - c_r|²) W_r
    """
    size = sizes[0]
    count = len(segments)
    padded = centres.shape[1]
    x = np.empty(3 + count)
    outputs = np.empty(OUTPUTS)
    values = np.empty(padded)  # this and `room`: space for `add_table`
    room = np.empty(padded)
    for k in range(count):
        if belief[k] >= LEAST_SEGMENT_PROBABILITY:
            x[:] = 0.0
            x[2 + k] = SEGMENT_DISTANCE
            for m in range(len(hands)):
                x[0], x[1] = along_both(hands[m], tempos[m], segments[k])
                x[2 + count] = size["clock_weight"] * tempos[m, 2]
                outputs[:] = size["prior"]
                add_table(x, centres, size["scale"], values, room, outputs)
                out[m, k] = _tool_of(hands[m], outputs[0], outputs[1:], segments[k], size, pulls)


@compiled
def expected(belief: Vector, tools: Vector, out: Vector) -> None:
    """Mean of the tool positions t_k (K, 3), written to `out` (3,): Σ p_k t_k / Σ p_k, over the
    segments with at least LEAST_SEGMENT_PROBABILITY.
    """
    total = 0.0
    out[:] = 0.0
    for k in range(len(tools)):
        if belief[k] >= LEAST_SEGMENT_PROBABILITY:
            total += belief[k]
            for i in range(3):
                out[i] += belief[k] * tools[k, i]
    for i in range(3):
        out[i] /= total


@compiled
def _ambiguity(belief: Vector, tools: Vector) -> float:
    """Probability that the tool belongs elsewhere: the sum of p_k over the segments whose tool
    position (K, 3) is more than AMBIGUOUS_M from that of the most probable segment.

    Segments below LEAST_SEGMENT_PROBABILITY are left out.
    """
    most = belief[: len(tools)].argmax()
    out = 0.0
    for k in range(len(tools)):
        if belief[k] < LEAST_SEGMENT_PROBABILITY or k == most:
            continue
        if squared_distance(tools[k], tools[most]) > AMBIGUOUS_M**2:
            out += belief[k]
    return out


@compiled
def _around(moving: Vector, out: Vector) -> None:
    """Hands' positions one step h = MOTION_STEP_S ago, now and one step ahead, written to the first
    columns of `out` (3, 6 or more), for the hands' motion (3, 6):

        x - h g v + ½ h² g a,   x,   x + h g v + ½ h² g a,   g = 1 - exp(-(|v| / CALM_MPS)⁴)

    g makes a hand stay that only trembles.
    """
    for side in range(2):
        square = 0.0
        for i in range(3 * side, 3 * side + 3):
            square += moving[1, i] * moving[1, i]
        goes = 1.0 - exp(-((math.sqrt(square) / CALM_MPS) ** 4))
        for i in range(3 * side, 3 * side + 3):
            step = MOTION_STEP_S * goes * moving[1, i]
            curved = 0.5 * MOTION_STEP_S**2 * goes * moving[2, i]
            out[0, i] = moving[0, i] - step + curved
            out[1, i] = moving[0, i]
            out[2, i] = moving[0, i] + step + curved


@compiled
def _turned_around(turning: Vector, out: Vector) -> None:
    """Entries of the hands' rotation matrices at the three times of `_around`, written to the last
    columns of `out` (3, 24), for these matrices with their rate and acceleration (3, 18).
    """
    for n in range(3):
        step = (n - 1) * MOTION_STEP_S
        for i in range(turning.shape[1]):
            out[n, 6 + i] = turning[0, i] + step * turning[1, i] + 0.5 * step**2 * turning[2, i]


@compiled
def _tool_share(tool: Vector, segment: Record) -> float:
    """Share, 0 to 1, of its path that a tool (3,) has covered; 1 on a path without length."""
    along = 0.0
    square = 0.0
    for i in range(3):
        along += (tool[i] - segment["tool"][i]) * segment["tool_way"][i]
        square += segment["tool_way"][i] ** 2
    return min(max(along / square, 0.0), 1.0) if square > 0.0 else 1.0


@compiled
def scatter(
    hands: Vector,
    still: Vector,
    belief: Vector,
    segments: Records,
    tools: Vector,
    errors: Vector,
    size: Record,
    out: Vector,
) -> None:
    """Covariance C (3, 3) [m²] of the expected tool position, written to `out`:

        C = Σ_k p_k ((t_k - t)(t_k - t)ᵀ + E_k + P_k) / Σ_k p_k + (std² + LEAST_STD_M²) I
        E_k = (ν σ² I + Σ_m g_km e_m e_mᵀ) / (ν + Σ_m g_km),   ν = SUPPORT_MASS
        g_km = exp(-ERROR_SCALE |x_k - x_m|²)

    t_k are the segments' tool positions (K, 3) with the mean t; x_k (2 + K,) are the hands' shares
    of segment k, and ERROR_SEGMENT_DISTANCE at the segment's number. `errors` is the table of x_m
    with the products of the tool's errors e_m in held-out demonstrations (`support.error_table`).
    Away from all of them, E_k grows to σ², σ = `unknown_std`; if σ is 0, ν is 0. `std` [m] is the
    standard deviation of the via-points.

    P_k = (1 - s)² P_0 + s² P_1 for the tool's share s of its path, with the covariances P_0 and
    P_1 of the via-points at its ends in the demonstrations; 0 for a via-point of this scene.

    Segments below LEAST_SEGMENT_PROBABILITY are left out.
    """
    mass = SUPPORT_MASS if size["unknown_std"] > 0.0 else 0.0
    out[:] = 0.0
    mean = np.empty(3)
    in_all = 0.0
    count = len(segments)
    padded = errors.shape[1]
    x = np.empty(2 + count)
    near = np.empty(1 + out.size)
    values = np.empty(padded)
    room = np.empty(padded)
    expected(belief, tools, mean)
    for k in range(count):
        if belief[k] < LEAST_SEGMENT_PROBABILITY:
            continue
        in_all += belief[k]

        # the errors near x_k: their weights and their products
        x[:] = near[:] = 0.0
        x[0], x[1] = along_both(hands, still, segments[k])
        x[2 + k] = ERROR_SEGMENT_DISTANCE
        add_table(x, errors, ERROR_SCALE, values, room, near)
        total = 1e-9 + mass + near[0]

        share = _tool_share(tools[k], segments[k]) if mass else 0.0
        for i in range(3):
            for j in range(i, 3):
                covariance = (tools[k, i] - mean[i]) * (tools[k, j] - mean[j]) + near[
                    1 + 3 * i + j
                ] / total
                if mass:
                    covariance += mass * size["unknown_std"] ** 2 / total if i == j else 0.0
                    begin = segments[k]["scatter"][0, i, j]
                    end = segments[k]["scatter"][1, i, j]
                    covariance += (1.0 - share) ** 2 * begin + share**2 * end
                out[i, j] += belief[k] * covariance

    for i in range(3):
        for j in range(i, 3):
            out[i, j] /= in_all
            out[j, i] = out[i, j]
        out[i, i] += size["std"] ** 2 + LEAST_STD_M**2


@compiled
def elsewhere(
    now: Vector,
    still: Vector,
    period_s: float,
    belief: Vector,
    unprimed: Vector,
    segments: Records,
    sizes: Records,
    centres: Vector,
) -> float:
    """Probability that the task did not begin at its first segment, and the tool belongs more than
    UNSURE_M from where the most probable segment k has it:

        Σ_j q_j [|t_j - t_k| > UNSURE_M]

    q (K or more,), `unprimed`, is the belief by the hands' motion (3, 6) alone, for which no
    segment is the first; it is updated in place. Once it agrees with the `belief`, the evidence has
    decided and UNPRIMED_DECIDED replaces its first number. The clock of each segment is at its
    begin here, and a tool does not turn.
    """
    if unprimed[0] == UNPRIMED_DECIDED:
        return 0.0
    recognise(unprimed, now, period_s, segments, 1.0)
    count = len(segments)
    difference = 0.0
    for k in range(count):
        difference = max(difference, abs(unprimed[k] - belief[k]))
    if difference < LEAST_SEGMENT_PROBABILITY:
        unprimed[0] = UNPRIMED_DECIDED
        return 0.0

    most = belief[:count].argmax()
    # the tools of segment k and of all that are probable without a first segment
    either = np.empty(count)
    tools = np.empty((1, count, 3))
    tempos = np.zeros((1, 3))
    tempos[0, :2] = still
    for k in range(count):
        either[k] = max(unprimed[k], 1.0 if k == most else 0.0)
    tools_at(now[:1], tempos, either, segments, sizes, centres, np.empty((0, 9)), tools)
    out = 0.0
    for k in range(count):
        if (
            unprimed[k] >= LEAST_SEGMENT_PROBABILITY
            and squared_distance(tools[0, k], tools[0, most]) > UNSURE_M**2
        ):
            out += unprimed[k]
    return out


@compiled
def predicted(
    seen: Seen,
    turned: bool,
    segments: Records,
    sizes: Records,
    centres: Vector,
    pulls: Vector,
    errors: Vector,
    out: Vector,
) -> tuple[float, float]:
    """Prediction of the tool for the hands `seen`: the belief is updated in place by their motion
    `now`, `period_s` after its last update, and the tool is predicted for the motion `moving`, with
    their orientation if the tool is `turned` with them and it is known.

    Written to `out` (6, 3), rounded: position, velocity, acceleration, and the covariance (3, 3) of
    `scatter`, which is zero without `errors`. With the expected positions t_-, t_0, t_+ at the
    three times of `_around`, h = MOTION_STEP_S apart, at which the clock is t ± h r + ½ h² dr/dt:

        velocity = (t_+ - t_-) / (2 h)
        acceleration = clip((t_+ - 2 t_0 + t_-) / h², ±MAX_TARGET_MPS2)

    Returns the distance [m] of the hands from the task (`off_all`), which the gate compares with
    the threshold, and the probability that the tool belongs elsewhere (`_ambiguity`).
    """
    belief = seen.belief
    clock = seen.clock
    steps = np.empty((3, 3))
    tempos = np.empty((3, 3))
    entries = seen.turns.shape[1] if turned and len(seen.turns) else 0
    hands = np.empty((3, 6 + entries))
    tools = np.empty((3, len(segments), 3))
    if seen.period_s > 0.0:
        recognise(belief, seen.now, seen.period_s, segments, FIRST_SEGMENT_ODDS)

    # hands and tempo at three times, and the tool there
    _around(seen.moving, hands)
    if entries:
        rates = np.empty((3, entries))
        turning(seen.turns, seen.turn_lag_s, rates)
        _turned_around(rates, hands)
    for n in range(3):
        ahead_s = (n - 1) * MOTION_STEP_S
        tempos[n, :2] = seen.stillness
        tempos[n, 2] = clock[0] + ahead_s * clock[1] + 0.5 * ahead_s**2 * clock[2]
    tools_at(hands, tempos, belief, segments, sizes, centres, pulls, tools)
    for n in range(3):
        expected(belief, tools[n], steps[n])

    for i in range(3):
        acceleration = (steps[2, i] - 2.0 * steps[1, i] + steps[0, i]) / MOTION_STEP_S**2
        out[0, i] = steps[1, i]
        out[1, i] = (steps[2, i] - steps[0, i]) / (2.0 * MOTION_STEP_S)
        out[2, i] = min(max(acceleration, -MAX_TARGET_MPS2), MAX_TARGET_MPS2)
    out[3:] = 0.0
    if errors.size:
        scatter(hands[1], tempos[1], belief, segments, tools[1], errors, sizes[0], out[3:])
    round_to(out[:3], MOTION_ROUND_TO)
    round_to(out[3:], COVARIANCE_ROUND_TO)
    return off_all(seen.now[0], segments), _ambiguity(belief, tools[1])
