"""What there is to be remembered of hands: where they were in the last seconds, as a gamma memory
has it (de Vries and Principe 1992), a row of filters each of which follows the one before.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.frame import Records, Vector

LAG_S = 0.5  # of each: with twice as much or half, recorded partners are predicted no better
STEP_S = 0.004  # of the filters along a demonstration: as fine as the service's own periods
LONGEST_S = 0.1  # that passes from one step to the next: while a hand is not seen, nothing is forgotten


@compiled
def _follow(now: float, share: float, rows: Vector) -> None:
    """Each of a row of filters (K,) goes a share of its way to the one before, the first to now."""
    for row in range(len(rows)):
        rows[row] += share * (now - rows[row])
        now = rows[row]


@compiled
def remember(states: Records, period_s: float) -> None:
    """Hands as they are now enter the memory; of those that come first, it is full."""
    state = states[0]
    for side in range(2):
        if state.hand_ticks[side] < 0:
            continue
        share = 1.0
        if state.memory_ticks[side] >= 0:
            passed_s = (state.tick - state.memory_ticks[side]) * period_s
            share = 1.0 - math.exp(-min(passed_s, LONGEST_S) / LAG_S)
        state.memory_ticks[side] = state.tick
        for i in range(3):
            _follow(state.hands[side, 0, i], share, state.memory[:, side, i])


@compiled
def moving_features(moving: Vector, memory: Vector, out: Vector) -> None:
    """Positions, and how far behind them the rows (K, D) of a memory are, of hands that move so
    (3, D): with velocity and acceleration into `out` (3, (1 + K) D).
    """
    width = moving.shape[1]
    for i in range(width):
        out[0, i], out[1, i], out[2, i] = moving[0, i], moving[1, i], moving[2, i]
        at, rate, bend = moving[0, i], moving[1, i], moving[2, i]
        for row in range(len(memory)):
            value = memory[row, i]
            bend = (rate - (at - value) / LAG_S) / LAG_S
            rate = (at - value) / LAG_S
            at = value
            column = (row + 1) * width + i
            out[0, column] = value - moving[0, i]
            out[1, column] = rate - moving[1, i]
            out[2, column] = bend - moving[2, i]


@compiled
def _remembered(hands: Vector, period_s: float, order: int, steps: int, out: Vector) -> None:
    share, width = 1.0 - math.exp(-period_s / steps / LAG_S), hands.shape[1]
    memory = np.zeros((order, width))
    for t in range(len(hands)):
        for step in range(steps):
            for i in range(width):
                now = hands[t, i]
                if t:
                    now = hands[t - 1, i] + (step + 1) / steps * (hands[t, i] - hands[t - 1, i])
                _follow(now, share if t else 1.0, memory[:, i])
        for i in range(width):
            out[t, i] = hands[t, i]
            for row in range(order):
                out[t, (row + 1) * width + i] = memory[row, i] - hands[t, i]


def features(hands: Vector, period_s: float, order: int) -> Vector:
    """Positions of hands (T, D) [m], and how far behind them `order` rows of their memory are, (T,
    (1 + order) D) [m].
    """
    out = np.empty((len(hands), (1 + order) * hands.shape[1]))
    _remembered(np.ascontiguousarray(hands), period_s, order, max(1, math.ceil(period_s / STEP_S)), out)
    return out
