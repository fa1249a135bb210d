"""The memory of past hand positions: the same live as in learning, at any rate, with its
derivatives. `learn` uses it where the present hands do not determine the tool.
"""

from __future__ import annotations

import numpy as np
import pytest

from support.skills import at_rest, figures_of
from thirdhand.contract.records import Field
from thirdhand.core.skill import ORDER, TURNS
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.core.skill.memory import features, moving_features, remember, turning
from thirdhand.core.skill.tuning import MEMORY_LAG_S, TURN_LAG_S, TURN_WEIGHT_M
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import StoredSkill, decoded
from thirdhand.workbench.learning.learn import learn

FIELDS = (
    Field("tick", "int64"),
    Field("hand_ticks", "int64", (2,)),
    Field("hands", "float64", (2, 3, 3)),
    Field("memory", "float64", (ORDER, 2, 3)),
    Field("memory_ticks", "int64", (2,)),
    Field("hand_turns", "float64", (2, 9)),
    Field("turns", "float64", (TURNS, 2, 9)),
)


def motion(times: np.ndarray) -> np.ndarray:
    """Hands (3, T, 6) that move back and forth: position, velocity, acceleration."""
    rates = np.linspace(0.5, 1.5, 6)
    waves = np.sin(np.multiply.outer(times, rates)), np.cos(np.multiply.outer(times, rates))
    return np.stack([waves[0], rates * waves[1], -(rates**2) * waves[0]]) * 0.2


def remembered(hands: np.ndarray, period_s: float, unseen: range = range(0)) -> np.ndarray:
    """The memory (T, ORDER, 6) after hands (T, 6), of which those in `unseen` are missing."""
    return both_remembered(hands, np.zeros((len(hands), 18)), period_s, unseen)[0]


def both_remembered(
    hands: np.ndarray, turns: np.ndarray, period_s: float, unseen: range = range(0)
) -> tuple[np.ndarray, np.ndarray]:
    """The memory, and the filtered rows (T, TURNS, 18) of the hands' rotations `turns` (T, 18)."""
    states = np.zeros(1, [(field.name, field.type, field.shape) for field in FIELDS])
    state = states[0]
    out = []
    turned = []
    state["hand_ticks"] = state["memory_ticks"] = -1
    for tick, (pair, turn) in enumerate(zip(hands, turns, strict=True)):
        state["tick"] = tick
        if tick not in unseen:
            state["hand_ticks"] = tick
            state["hands"][:, 0] = pair.reshape(2, 3)
            state["hand_turns"] = turn.reshape(2, 9)
            remember(state, period_s, MEMORY_LAG_S, TURN_LAG_S)
        out.append(state["memory"].reshape(ORDER, 6).copy())
        turned.append(state["turns"].reshape(TURNS, 18).copy())
    return np.array(out), np.array(turned)


@pytest.mark.parametrize("rate_hz", [100, 250, 1000])
def test_memory_is_that_of_learning(rate_hz: int) -> None:
    """The service's memory is the learned one, at any rate."""
    learned = features(motion(np.arange(0.0, 6.0, 0.02))[0], 0.02, ORDER)
    live = remembered(motion(np.arange(0.0, 6.0, 1.0 / rate_hz))[0], 1.0 / rate_hz)[
        :: rate_hz // 50
    ]
    behind = learned[:, 6:].reshape(-1, ORDER, 6) + learned[:, None, :6]
    assert np.abs(live - behind).max() < 0.004


@pytest.mark.parametrize("rate_hz", [100, 250, 1000])
def test_turns_are_those_of_learning(rate_hz: int) -> None:
    """The hands' turns are filtered live as in learning, at any rate."""
    turns = np.tile(motion(np.arange(0.0, 6.0, 0.02))[0], 3)
    learned = features(turns[:, :6], 0.02, 0, turns)[:, 6:]
    live_turns = np.tile(motion(np.arange(0.0, 6.0, 1.0 / rate_hz))[0], 3)
    live = both_remembered(live_turns[:, :6], live_turns, 1.0 / rate_hz)[1][:: rate_hz // 50, -1]
    assert np.abs(TURN_WEIGHT_M * live - learned).max() < 0.0005


def test_nothing_is_forgotten_unseen() -> None:
    """Nothing is forgotten while no hand is seen."""
    hands = motion(np.arange(0.0, 8.0, 0.01))[0]
    hands[300:] = hands[299]
    memory = remembered(hands, 0.01, unseen=range(300, 700))
    np.testing.assert_array_equal(memory[699], memory[299])
    assert np.abs(memory[701] - remembered(hands, 0.01)[311]).max() < 0.002


def test_inputs_move_with_their_derivatives() -> None:
    """The inputs' velocity and acceleration equal finite differences."""
    h = 1e-3
    times = np.arange(0.0, 4.0, h)
    moving = motion(times)
    memory, turns = both_remembered(moving[0], np.tile(moving[0], 3), h)
    inputs = np.empty((len(times), 3, 6 * (1 + ORDER) + 18))
    for out, now, memory_row, turned in zip(
        inputs, moving.transpose(1, 0, 2), memory, turns, strict=True
    ):
        moving_features(np.ascontiguousarray(now), memory_row, turned, out)
    late = slice(3000, None)
    for order in (0, 1):
        slope = np.gradient(inputs[:, order], h, axis=0)[late]
        assert np.abs(slope - inputs[late, order + 1]).max() < 0.01
        assert np.abs(slope[:, -18:]).max() > 0.01
    for rows, out in zip(turns, inputs, strict=True):
        turned = np.empty((3, 18))
        turning(rows, TURN_LAG_S, turned)
        np.testing.assert_allclose(TURN_WEIGHT_M * turned, out[:, -18:], rtol=1e-12, atol=1e-12)
    assert MEMORY_LAG_S * ORDER == 2.0


def takes(count: int, *, remembers: bool) -> list[Demonstration]:
    """Hands that come to the same place from either side. The tool moves to the opposite side if it
    `remembers`, else always to the same side.
    """
    out = []
    times = np.arange(0.0, 5.0, 0.02)
    for i in range(count):
        rng = np.random.default_rng(i)
        side = (-1.0, 1.0)[i % 2]
        share = np.clip((times - 0.5 - 0.2 * rng.random()) / 1.5, 0.0, 1.0)
        progress = (share**3 * (10 - 15 * share + 6 * share**2))[:, None]
        left = (
            (0.6, -0.2, 0.2)
            + (1.0 - progress) * (0.0, 0.25 * side, 0.0)
            + rng.normal(0.0, 0.004, 3)
        )
        right = (0.7, 0.3, 0.2) + 0.0 * left
        tool = (0.5, 0.1, 0.4) + progress * np.array(
            (0.0, -0.15 * side if remembers else 0.15, 0.1)
        )
        turn = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
        poses = (
            np.hstack([positions + rng.normal(0.0, 0.0005, positions.shape), turn])
            for positions in (left, right, tool)
        )
        out.append(Demonstration((times * 1e9).astype(np.int64), *poses))
    return out


def order(skill: StoredSkill) -> int:
    assert isinstance(skill.model, HandsKMP)
    return skill.model.order


@pytest.mark.thorough
def test_learn_takes_memory_where_needed() -> None:
    """`learn` uses memory only where the hands alone do not determine the tool."""
    skill = learn(takes(8, remembers=True))
    assert order(skill) == ORDER
    assert figures_of(skill).taken.startswith("memory")
    assert order(learn(takes(8, remembers=False))) == 0
    back = decoded(skill.file, origin="again")
    hands = np.array(skill.hands[len(skill.hands) // 2]).reshape(2, 3)
    memory = np.tile(hands, (ORDER, 1, 1)) + 0.05
    positions = [at_rest(version, hands, past=memory).position for version in (skill, back)]
    np.testing.assert_array_equal(*positions)
    assert np.linalg.norm(positions[0] - at_rest(skill, hands).position) > 0.0
