"""Segments: the hands' progress along a segment, and the filtered belief in the present one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from support.paths import RECORDINGS
from thirdhand.core.controller import start_state
from thirdhand.core.frame import structured
from thirdhand.core.skill.memory import along, delayed
from thirdhand.core.skill.segments import MOST_SEGMENTS, SEGMENT, along_way, recognise
from thirdhand.core.skill.skill import Skill
from thirdhand.core.skill.stage import SkillStage
from thirdhand.core.skill.tuning import FIRST_SEGMENT_ODDS
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import decoded

PERIOD_S = 0.01


@pytest.fixture
def there_and_back() -> np.ndarray:
    """The left hand moves to B and back to A, twice; the right hand rests."""
    segments = structured(4, SEGMENT)
    for k in range(4):
        sign = 1.0 if k % 2 == 0 else -1.0
        segments["begins"][k, 0] = (0.5 if k % 2 == 0 else 0.9, 0.0, 0.1)
        segments["way"][k, 0] = (0.4 * sign, 0.0, 0.0)
        segments["begins"][k, 1] = (0.8, 0.3, 0.1)
    segments["square"] = (segments["way"] ** 2).sum(axis=2)
    segments["off"] = 0.03
    segments["follow"] = -1
    return segments


def motion(x: np.ndarray) -> np.ndarray:
    """Hands (T, 3, 6); the left hand has these positions along x."""
    out = np.zeros((len(x), 3, 6))
    out[:, 0] = (0.0, 0.0, 0.1, 0.8, 0.3, 0.1)
    out[:, 0, 0] = x
    out[:, 1, 0] = np.gradient(x, PERIOD_S)
    return out


def legs(*ends: float) -> np.ndarray:
    """Each leg lasts a second, and a second of rest follows it."""
    smooth = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 100))
    parts = [np.full(100, ends[0])]
    for begin, end in itertools.pairwise(ends):
        parts += [begin + (end - begin) * smooth, np.full(100, end)]
    return np.concatenate(parts)


def beliefs(segments: np.ndarray, x: np.ndarray) -> np.ndarray:
    belief = np.zeros(MOST_SEGMENTS)
    out = []
    for moving in motion(x):
        recognise(belief, moving, PERIOD_S, segments, FIRST_SEGMENT_ODDS)
        out.append(belief.copy())
    return np.array(out)


def test_past_tells_visits_apart(there_and_back: np.ndarray) -> None:
    """The past distinguishes repeated visits of a place."""
    history = beliefs(there_and_back, legs(0.5, 0.9, 0.5, 0.9, 0.5))
    assert np.abs(history.sum(axis=1) - 1.0).max() < 1e-6
    for leg in range(4):
        half = 100 + 200 * leg + 50
        assert history[half].argmax() == leg
        assert history[half, leg] > 0.8
    ends = history[-1]
    assert ends[3] > 0.7


def test_wrong_belief_recovers_in_a_second(there_and_back: np.ndarray) -> None:
    """The hands' positions distinguish segments with other paths; a wrong belief is forgotten."""
    segments = there_and_back.copy()
    segments["begins"][3, 0] = (0.5, 0.4, 0.1)
    segments["way"][3, 0] = (0.4, 0.0, 0.0)
    belief = np.zeros(MOST_SEGMENTS)
    belief[0] = 1.0
    for moving in motion(np.full(100, 0.7)):
        moving[0, 1] = 0.4
        recognise(belief, moving, PERIOD_S, segments, FIRST_SEGMENT_ODDS)
    assert belief[3] > 0.8


def test_resting_hand_near_an_end_is_there(there_and_back: np.ndarray) -> None:
    """A moving hand near an end has not reached it."""
    segment = there_and_back[0]
    near = np.array([0.54, 0.02, 0.1])
    half = np.array([0.7, 0.0, 0.1])
    assert along_way(near, 1.0, segment, 0) < 0.01
    assert along_way(near, 0.0, segment, 0) == pytest.approx(0.1)
    assert (
        along_way(half, 1.0, segment, 0) == along_way(half, 0.0, segment, 0) == pytest.approx(0.5)
    )
    assert along_way(half, 0.0, segment, 1) == 1.0  # the right hand rests


def test_hands_are_delayed_as_learned() -> None:
    """Hands are delayed as in learning, or predicted ahead."""
    times = np.arange(0.0, 4.0, PERIOD_S)
    hands = np.tile(0.2 * np.sin(times)[:, None], (1, 6))
    rows = along(hands, PERIOD_S, 0.3 / 4, 4)
    out = np.empty((3, 6))
    index = 350
    moving = np.stack([hands[index], np.gradient(hands, PERIOD_S, axis=0)[index], -hands[index]])
    behind = np.ascontiguousarray(rows[index])
    delayed(moving, behind, 0.3, out)
    time_s = times[index] - 0.3
    np.testing.assert_allclose(
        out[:, 0], [0.2 * np.sin(time_s), 0.2 * np.cos(time_s), -0.2 * np.sin(time_s)], atol=0.01
    )
    delayed(moving, behind, -0.1, out)
    assert out[0, 0] == pytest.approx(0.2 * np.sin(times[index] + 0.1), abs=0.002)


def test_segment_is_set_kept_and_reset() -> None:
    """The segment is set by request, kept during a hold, and reset by another task."""
    settings = Settings()
    skill = shipped_skill()
    segment = SkillStage(settings, skill)
    state = start_state(settings, skill)
    segment.set_segment(state, "glass")
    assert state["segment_belief"].argmax() == skill.model.names.index("glass")
    segment.set_segment(state, "nowhere")
    assert state["segment_belief"].argmax() == skill.model.names.index("glass")
    segment.adopt(state, skill)
    assert state["segment_belief"].max() == 1.0
    plain = segment_less(skill)
    segment.adopt(state, plain)
    assert not state["segment_belief"].any()


def segment_less(skill: Skill) -> Skill:
    """Another skill, which has no segments."""
    return decoded((RECORDINGS / "experiments/as-paper.npz").read_bytes(), origin="as-paper.npz")
