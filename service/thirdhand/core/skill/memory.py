"""Memory of the hands: their past positions and their filtered orientation, each by a cascade of
first-order filters (a gamma memory; de Vries and Principe 1992).

Filter k of K follows the filter before it, with the time constant τ; the first one follows the
input x:

    τ dm_1/dt = x - m_1,   τ dm_k/dt = m_(k-1) - m_k

So m_k is about x at k τ ago, smoothed, and its derivatives are known without differences.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import exp
from thirdhand.core.frame import Records, Struct, Vector
from thirdhand.core.numerics import MEMORY_STEP_S
from thirdhand.core.skill import TURNS
from thirdhand.core.skill.model import Seen
from thirdhand.core.skill.tuning import (
    MEMORY_LAG_S,
    MEMORY_LONGEST_STEP_S,
    TURN_LAG_S,
    TURN_WEIGHT_M,
)


@compiled
def _follow(now: float, share: float, rows: Vector) -> None:
    """Update a cascade m (K,), `rows`, by the input x, `now`, from the first filter to the last:
    m_1 = m_1 + share (x - m_1), then m_k = m_k + share (m_(k-1) - m_k).
    """
    for row in range(len(rows)):
        rows[row] += share * (now - rows[row])
        now = rows[row]


@compiled
def remember(state: Struct, period_s: float, lag_s: float, turn_lag_s: float) -> None:
    """Update the memory of both hands' positions, with the time constant `lag_s`, and of their
    orientations, with `turn_lag_s`: share = 1 - exp(-elapsed time / time constant).

    For positions, the elapsed time is at most MEMORY_LONGEST_STEP_S. A hand's first sample is taken
    into all filters at once.
    """
    for side in range(2):
        if state.hand_ticks[side] < 0:
            continue
        share = turn_share = 1.0
        if state.memory_ticks[side] >= 0:
            passed_s = (state.tick - state.memory_ticks[side]) * period_s
            share = 1.0 - exp(-min(passed_s, MEMORY_LONGEST_STEP_S) / lag_s) if lag_s > 0.0 else 1.0
            turn_share = 1.0 - exp(-passed_s / turn_lag_s)
        state.memory_ticks[side] = state.tick
        for i in range(3):
            _follow(state.hands[side, 0, i], share, state.memory[:, side, i])
        for i in range(9):
            _follow(state.hand_turns[side, i], turn_share, state.turns[:, side, i])


@compiled
def moving_features(moving: Vector, memory: Vector, turns: Vector, out: Vector) -> None:
    """Inputs of the primitive with their velocity and acceleration, written to `out` (3, (1 + K) D
    or more): positions x (D), offsets m_k - x of each row of the `memory` (K, D), and the last row
    of `turns` (TURNS, E) times TURN_WEIGHT_M if `out` has E columns more.

    `moving` (3, D) is position, velocity and acceleration of the hands. Derivatives are those of
    the cascades, e.g. dm_k/dt = (m_(k-1) - m_k) / MEMORY_LAG_S.
    """
    width = moving.shape[1]
    for i in range(width):
        out[0, i] = moving[0, i]
        out[1, i] = moving[1, i]
        out[2, i] = moving[2, i]
        position = moving[0, i]
        velocity = moving[1, i]
        acceleration = moving[2, i]
        for row in range(len(memory)):
            value = memory[row, i]
            acceleration = (velocity - (position - value) / MEMORY_LAG_S) / MEMORY_LAG_S
            velocity = (position - value) / MEMORY_LAG_S
            position = value
            column = (row + 1) * width + i
            out[0, column] = value - moving[0, i]
            out[1, column] = velocity - moving[1, i]
            out[2, column] = acceleration - moving[2, i]
    first = (1 + len(memory)) * width
    for i in range(turns.shape[1] if out.shape[1] - first >= turns.shape[1] else 0):
        before = turns[-3, i]
        between = turns[-2, i]
        last = turns[-1, i]
        out[0, first + i] = TURN_WEIGHT_M * last
        out[1, first + i] = TURN_WEIGHT_M * (between - last) / TURN_LAG_S
        out[2, first + i] = TURN_WEIGHT_M * (before - 2.0 * between + last) / TURN_LAG_S**2


def turn_lag_s(late_s: float) -> float:
    """Time constant [s] of the filters of the hands' orientations, so that they are `late_s` late,
    or as late as smoothing needs.
    """
    return max(late_s / TURNS, TURN_LAG_S)


@compiled
def turning(turns: Vector, lag_s: float, out: Vector) -> None:
    """Filtered rotation matrices with their rate [1/s] and acceleration [1/s²], written to `out`
    (3, E), from the rows of their filters (TURNS, E) with the time constant `lag_s`.
    """
    for i in range(out.shape[1]):
        before = turns[-3, i]
        between = turns[-2, i]
        last = turns[-1, i]
        out[0, i] = last
        out[1, i] = (between - last) / lag_s
        out[2, i] = (before - 2.0 * between + last) / lag_s**2


@compiled
def delayed(moving: Vector, memory: Vector, late_s: float, out: Vector) -> None:
    """Motion of the hands `late_s` ago, written to `out` (3, D), from their motion (3, D) now.

    It is the last row of the `memory` (K, D), whose time constant is `late_s` / K, with its
    derivatives. A negative `late_s` extrapolates: x - late_s v, with velocity and acceleration
    unchanged.
    """
    lag_s = late_s / len(memory)
    out[:] = moving
    for i in range(moving.shape[1]):
        if late_s <= 0.0:
            out[0, i] -= late_s * moving[1, i]
            continue
        for row in range(len(memory)):
            out[2, i] = (out[1, i] - (out[0, i] - memory[row, i]) / lag_s) / lag_s
            out[1, i] = (out[0, i] - memory[row, i]) / lag_s
            out[0, i] = memory[row, i]


@compiled
def recall(states: Records, rules: Records, seen: Seen) -> bool:
    """Update the memory of the hands, and write to `seen` what a skill predicts from: the motion
    `now` and that `late_s` ago, memory and stillness. Column group n is that of the hand
    `sides`[n].

    Returns true if a hand has a new sample in this tick, or if the state has no covariance yet.
    """
    state = states[0]
    rule = rules[0]
    now = seen.now
    remember(state, rule.period_s, rule.lag_s, rule.turn_lag_s)
    for n in range(2):
        side = rule.sides[n]
        seen.stillness[n] = state.hand_stillness[side]
        now[:, 3 * n : 3 * n + 3] = state.hands[side]
        seen.past[:, 3 * n : 3 * n + 3] = state.memory[:, side]
        seen.turns[:, 9 * n : 9 * n + 9] = state.turns[:, side]
    if rule.late_s == 0.0:
        seen.moving[:] = now
    else:
        delayed(now, seen.past, rule.late_s, seen.moving)
    has_sample = state.hand_ticks[0] == state.tick or state.hand_ticks[1] == state.tick
    return bool(has_sample or state.covariance[0, 0] == 0.0)


@compiled
def _filtered(values: Vector, share: float, steps: int, out: Vector) -> None:
    """Rows of the cascade along values (T, D), written to `out` (T, K, D); each interval between
    two values is interpolated linearly in some `steps`.
    """
    rows = np.zeros(out.shape[1:])
    for t in range(len(values)):
        for step in range(steps):
            for i in range(values.shape[1]):
                now = values[t, i]
                if t:
                    now = values[t - 1, i] + (step + 1) / steps * (values[t, i] - values[t - 1, i])
                _follow(now, share if t else 1.0, rows[:, i])
        out[t] = rows


def along(values: Vector, period_s: float, lag_s: float, rows: int) -> Vector:
    """Rows (T, K, D) of a cascade of K = `rows` filters with the time constant `lag_s` along values
    (T, D).
    """
    out = np.empty((len(values), rows, values.shape[1]))
    steps = max(1, math.ceil(period_s / MEMORY_STEP_S))
    _filtered(np.ascontiguousarray(values), 1.0 - exp(-period_s / steps / lag_s), steps, out)
    return out


def features(hands: Vector, period_s: float, order: int, turns: Vector | None = None) -> Vector:
    """Inputs of the primitive along a demonstration, (T, (1 + K) D + E) [m]: positions of the hands
    (T, D), offsets of the K = `order` rows of their memory, and their filtered rotation matrices
    (T, E) times TURN_WEIGHT_M, if given.
    """
    parts = [
        hands,
        (along(hands, period_s, MEMORY_LAG_S, order) - hands[:, None]).reshape(len(hands), -1),
    ]
    if turns is not None:
        parts.append(TURN_WEIGHT_M * along(turns, period_s, TURN_LAG_S, TURNS)[:, -1])
    return np.hstack(parts)
