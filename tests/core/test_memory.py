"""What is remembered of hands: as it was learned, whatever the rate, with its derivatives; and that
`learn` takes it where hands alone do not tell where the tool is.
"""

from __future__ import annotations

import numpy as np
import pytest

from service.contract.records import Field
from service.core.frame import blank
from service.core.skill import ORDER
from service.core.skill.hands_kmp import HandsKMP
from service.core.skill.memory import LAG_S, features, moving_features, remember
from service.learning.demonstration import Demonstration
from service.learning.learn import learn
from service.learning.skill_file import StoredSkill, decoded

FIELDS = (
    Field("tick", "int64"),
    Field("hand_ticks", "int64", (2,)),
    Field("hands", "float64", (2, 3, 3)),
    Field("memory", "float64", (ORDER, 2, 3)),
    Field("memory_ticks", "int64", (2,)),
)


def motion(times: np.ndarray) -> np.ndarray:
    """Hands (3, T, 6) that go to and fro: position, velocity, acceleration."""
    rates = np.linspace(0.5, 1.5, 6)
    waves = np.sin(np.multiply.outer(times, rates)), np.cos(np.multiply.outer(times, rates))
    return np.stack([waves[0], rates * waves[1], -(rates**2) * waves[0]]) * 0.2


def remembered(hands: np.ndarray, period_s: float, unseen: range = range(0)) -> np.ndarray:
    """The memory (T, ORDER, 6) of a state that is told hands (T, 6), but for some."""
    states = np.zeros(1, [(field.name, field.type, field.shape) for field in FIELDS])
    state, out = states[0], []
    state["hand_ticks"] = state["memory_ticks"] = -1
    for tick, both in enumerate(hands):
        state["tick"] = tick
        if tick not in unseen:
            state["hand_ticks"], state["hands"][:, 0] = tick, both.reshape(2, 3)
            remember(states, period_s)
        out.append(state["memory"].reshape(ORDER, 6).copy())
    return np.array(out)


@pytest.mark.parametrize("rate_hz", [100, 250, 1000])
def test_the_service_remembers_what_was_learned_at_any_rate(rate_hz: int) -> None:
    shown = features(motion(np.arange(0.0, 6.0, 0.02))[0], 0.02, ORDER)
    live = remembered(motion(np.arange(0.0, 6.0, 1.0 / rate_hz))[0], 1.0 / rate_hz)[:: rate_hz // 50]
    behind = shown[:, 6:].reshape(-1, ORDER, 6) + shown[:, None, :6]
    assert np.abs(live - behind).max() < 0.004


def test_hands_that_rest_are_remembered_where_they_are_and_those_that_come_first_at_once() -> None:
    rest = np.full((5, 6), 0.4)
    np.testing.assert_array_equal(remembered(rest, 0.002), np.full((5, ORDER, 6), 0.4))


def test_nothing_is_forgotten_while_no_hand_is_seen() -> None:
    hands = motion(np.arange(0.0, 8.0, 0.01))[0]
    hands[300:] = hands[299]
    gone = remembered(hands, 0.01, unseen=range(300, 700))
    np.testing.assert_array_equal(gone[699], gone[299])
    assert np.abs(gone[701] - remembered(hands, 0.01)[311]).max() < 0.002


def test_inputs_move_as_their_velocity_and_acceleration_say() -> None:
    h = 1e-3
    times = np.arange(0.0, 4.0, h)
    moving, memory = motion(times), remembered(motion(times)[0], h)
    found = np.empty((len(times), 3, 6 * (1 + ORDER)))
    for out, now, past in zip(found, moving.transpose(1, 0, 2), memory, strict=True):
        moving_features(np.ascontiguousarray(now), past, out)
    late = slice(3000, None)
    for order in (0, 1):
        slope = np.gradient(found[:, order], h, axis=0)[late]
        assert np.abs(slope - found[late, order + 1]).max() < 0.01
    assert LAG_S * ORDER == 2.0


def takes(count: int, *, remembers: bool) -> list[Demonstration]:
    """Hands that come from either side to the same place; the tool goes where they did not
    come from, or where they are.
    """
    out, times = [], np.arange(0.0, 5.0, 0.02)
    for i in range(count):
        rng, side = np.random.default_rng(i), (-1.0, 1.0)[i % 2]
        share = np.clip((times - 0.5 - 0.2 * rng.random()) / 1.5, 0.0, 1.0)
        way = (share**3 * (10 - 15 * share + 6 * share**2))[:, None]
        left = (0.6, -0.2, 0.2) + (1.0 - way) * (0.0, 0.25 * side, 0.0) + rng.normal(0.0, 0.004, 3)
        right = (0.7, 0.3, 0.2) + 0.0 * left
        tool = (0.5, 0.1, 0.4) + way * np.array((0.0, -0.15 * side if remembers else 0.15, 0.1))
        turn = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
        poses = (np.hstack([at + rng.normal(0.0, 0.0005, at.shape), turn]) for at in (left, right, tool))
        out.append(Demonstration((times * 1e9).astype(np.int64), *poses))
    return out


def order(skill: StoredSkill) -> int:
    assert isinstance(skill.model, HandsKMP)
    return skill.model.order


def test_learn_remembers_where_hands_alone_tell_too_little_and_nowhere_else() -> None:
    skill = learn(takes(8, remembers=True))
    assert order(skill) == ORDER
    assert '"without memory"' in skill.figures
    assert order(learn(takes(8, remembers=False))) == 0
    back = decoded(skill.file, origin="again")
    hands = motion(np.array([0.3]))[0].reshape(2, 3) + 0.4
    past = np.tile(hands, (ORDER, 1, 1)) + 0.05
    still = np.zeros((2, 3))
    there = [one.predict(hands, still, still, past=past).position for one in (skill, back)]
    np.testing.assert_array_equal(*there)
    assert np.linalg.norm(there[0] - skill.predict(hands, still, still).position) > 0.0


def test_a_state_of_the_controller_has_the_memory() -> None:
    from service.core.frame import state_layout

    assert blank(state_layout(7))["memory"].shape == (ORDER, 2, 3)
