"""Compiled step of the skill: calibrate the prediction's covariance, and write what follows from it
into the state and the frame.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import acos, exp, sin_cos
from thirdhand.core.codes import AMBIGUOUS
from thirdhand.core.frame import Records, Vector
from thirdhand.core.skill.model import COVARIANCE_ROUND_TO, REGION_95
from thirdhand.core.skill.skill import is_inside
from thirdhand.core.skill.support import error_probability
from thirdhand.core.skill.tuning import AMBIGUOUS_PROBABILITY, AMBIGUOUS_S, TRAIL_S, UNSURE_M
from thirdhand.core.vectors import rounded

NO_SEGMENT = -1  # segment in a frame while it is not known
# what `conclude` returns, added
IS_AMBIGUOUS = 1
IS_OUTSIDE = 2


@compiled
def recent(position: Vector, passed_s: float, trail: Vector) -> Vector:
    """Mean velocity v (3,) [m/s] of the tool over about the last T = TRAIL_S, from a first-order
    lowpass m (3,) [m] of its positions p (3,), `trail`, which is updated in place:

        m = m + (1 - exp(-elapsed / T)) (p - m),   v = (p - m) / T
    """
    out = np.empty(3)
    share = 1.0 - exp(-passed_s / TRAIL_S)
    for i in range(3):
        trail[i] += share * (position[i] - trail[i])
        out[i] = (position[i] - trail[i]) / TRAIL_S
    return out


@compiled
def calibrate(
    covariance: Vector, velocity: Vector, scale: float, std_s: float, out: Vector
) -> float:
    """Calibrated covariance C (3, 3) [m²] of a model's covariance Σ, written rounded to `out`, and
    the largest distance [m] of its 95 % region from the mean:

        C = scale (Σ + std_s² v vᵀ),   reach = sqrt(REGION_95 λ_max(C))

    v (3,) [m/s] is the recent velocity of the tool. λ_max, the largest eigenvalue, is found in
    closed form (Smith 1961). See `Regions`.
    """
    for i in range(3):
        for j in range(3):
            variance = scale * (covariance[i, j] + std_s * std_s * velocity[i] * velocity[j])
            out[i, j] = rounded(variance, COVARIANCE_ROUND_TO)

    # the largest eigenvalue (Smith 1961)
    mean = (out[0, 0] + out[1, 1] + out[2, 2]) / 3.0
    a = out[0, 0] - mean
    b = out[1, 1] - mean
    c = out[2, 2] - mean
    d = out[0, 1]
    e = out[0, 2]
    f = out[1, 2]
    spread = math.sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
    if spread > 0.0:
        half = 0.5 * (a * b * c + 2.0 * d * e * f - a * f * f - b * e * e - c * d * d) / spread**3
        mean += 2.0 * spread * sin_cos(acos(min(max(half, -1.0), 1.0)) / 3.0)[1]
    return math.sqrt(REGION_95 * max(mean, 0.0))


@compiled
def conclude(
    states: Records,
    frames: Records,
    rules: Records,
    motion: tuple[Vector, Vector, Vector, Vector, float, float, Vector],
    turn: tuple[Vector, Vector, Vector],
    closure: float,
    off: float,
    doubt: float,
) -> int:
    """Write a prediction into the frame with its calibrated covariance, the probability of an error
    p and the most probable segment; update the skill's part of the state.

    `motion` are the first parts of a `Prediction`, `turn` its `Turn`; `off` [m] is the possible
    error because a hand is not seen, and `doubt` the probability that the task did not begin at its
    first segment. If there are no signs, those of the newest sample of a hand are kept:

        p = p_C + (1 - p_C) doubt,   p_C = error_probability(C, off² / REGION_95, signs)

    The skill is unsure if p is above its alarm, or without an alarm, if its region reaches farther
    than UNSURE_M. Returns IS_AMBIGUOUS if the segment has been ambiguous for longer than
    AMBIGUOUS_S, plus IS_OUTSIDE if the position has to be clamped.
    """
    state = states[0]
    frame = frames[0]
    rule = rules[0]
    position, velocity, acceleration, covariance, gate_m, ambiguity, signs = motion
    frame.target[:] = position
    frame.target_velocity[:] = velocity
    frame.target_acceleration[:] = acceleration
    frame.orientation[:], frame.turning[:], frame.orientation_covariance[:] = turn
    frame.gate_m = gate_m
    frame.closure = closure
    state.covariance[:] = covariance
    state.orientation_covariance[:] = turn[2]
    state.closure = closure

    passed_s = (state.tick - state.trail_tick) * rule.period_s
    state.trail_tick = state.tick
    moved = recent(position, passed_s, state.trail)
    reach_m = calibrate(covariance, moved, rule.scale, rule.std_s, frame.covariance)
    if len(signs):
        state.signs = 0.0
        for i in range(len(signs)):
            state.signs += rule.weights[2 + i] * signs[i]
    probability = error_probability(
        frame.covariance, off * off / REGION_95, state.signs, rule.weights
    )
    frame.error_probability = probability + (1.0 - probability) * doubt

    # An unsure skill remains so until the measure is below `end_share` of its limit.
    ease = rule.end_share if state.unsure else 1.0
    if rule.alarm > 0.0:
        state.unsure = frame.error_probability > ease * rule.alarm
    else:
        state.unsure = math.sqrt(reach_m * reach_m + off * off) > ease * UNSURE_M

    tell_segment(states, frames)
    if ambiguity <= AMBIGUOUS_PROBABILITY * (rule.end_share if state.reason == AMBIGUOUS else 1.0):
        state.sure_tick = state.tick
    is_ambiguous = (state.tick - state.sure_tick) * rule.period_s > AMBIGUOUS_S
    inside = is_inside(position, rule.workspace, rule.reach)
    return (IS_AMBIGUOUS if is_ambiguous else 0) + (0 if inside else IS_OUTSIDE)


@compiled
def tell_segment(states: Records, frames: Records) -> None:
    """Write the most probable segment and its probability into the frame."""
    belief = states[0].segment_belief
    frame = frames[0]
    most = belief.argmax()
    frame.segment_belief = belief[most]
    frame.segment = most if belief[most] > 0.0 else NO_SEGMENT
