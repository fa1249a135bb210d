"""The inputs of which the tool becomes a function: the simplest ones that predict it, found by
leaving out demonstrations or people.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.skills import at_rest, figures_of
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.skills.demonstration import Demonstration, persons
from thirdhand.skills.skill_file import StoredSkill
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.learning.methods.inputs import KINDS, Inputs, simplest_of
from thirdhand.workbench.learning.records import MOST_FOLDS, folds_of
from thirdhand.workbench.learning.table import table
from thirdhand.workbench.learning.takes import takes_of
from thirdhand_sim.lab.people.left_out import judged, left_out, predicted

TIMES = np.arange(0.0, 6.0, 0.04)
CARRIED = np.array([0.15, 0.0, 0.05])  # the tool in the frame of its hand
NOISE_M = 0.001


def smooth(random: np.random.Generator, size: float) -> np.ndarray:
    """Slow paths (T, 3)."""
    rates = random.uniform(0.5, 1.2, (2, 3))
    phases = random.uniform(0.0, 6.0, (2, 3))
    return size * sum(
        np.sin(np.multiply.outer(TIMES, rate) + phase)
        for rate, phase in zip(rates, phases, strict=True)
    )


def shown(seed: int, kind: str, person: str = "") -> Demonstration:
    """A take in which the tool moves with both hands, with the left hand, fixed to the left hand,
    or by the clock only.
    """
    random = np.random.default_rng(seed)
    left, right = (np.array([0.6, y, 0.3]) + smooth(random, 0.08) for y in (-0.2, 0.2))
    turned = Rotation.from_euler(
        "ZYX", smooth(random, 0.4 if kind == "carried" else 0.0) * [1.0, 0.3, 0.3]
    )
    ways = {
        "both": 0.5 * (left + right) + np.array([0.0, 0.0, 0.2]),
        "left": left + np.array([0.0, 0.1, 0.2]),
        "carried": left + turned.apply(CARRIED),
        "clock": np.array([0.5, 0.0, 0.4])
        + 0.2 * np.sin(np.multiply.outer(TIMES, [0.7, 0.9, 1.1])),
    }
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(TIMES), 1))
    turns = (turned.as_quat(), still, still)
    poses = (
        np.hstack([path + NOISE_M * random.standard_normal(path.shape), turn])
        for path, turn in zip((left, right, ways[kind]), turns, strict=True)
    )
    return Demonstration((1e9 * (1.0 + TIMES)).astype(np.int64), *poses, person=person)


@pytest.fixture(scope="module")
def carried() -> StoredSkill:
    return learn([shown(seed, "carried") for seed in range(6)], points=120)


def test_both_hands_where_both_tell() -> None:
    skill = learn([shown(seed, "both") for seed in range(5)], points=120)
    figures = figures_of(skill)
    assert skill.conductor is None
    assert figures.taken == "positions"
    names = [kind.name for kind in KINDS if not kind.turned]
    of_hands = ("", " of the left hand", " of the right hand")
    assert set(figures.tried_mm) == {f"{name}{of}" for name in names for of in of_hands}
    assert figures.tried_mm["positions"] < 0.5 * figures.tried_mm["positions of the left hand"]
    assert "positions is taken:" in table(figures)


def test_one_hand_where_it_tells_as_much() -> None:
    """The other hand has no effect, and a remark says so."""
    skill = learn([shown(seed, "left") for seed in range(5)], points=120)
    figures = figures_of(skill)
    assert skill.conductor == 0
    assert figures.taken == "positions of the left hand"
    assert any(
        "the left hand alone" in warning and "may be absent" in warning
        for warning in figures.warnings
    )
    hands = shown(9, "left").hands[40].reshape(2, 3)
    away = np.stack([hands[0], [3.0, 3.0, 3.0]])
    np.testing.assert_array_equal(at_rest(skill, hands).position, at_rest(skill, away).position)


def test_turned_hand_predicts_fixed_tool(carried: StoredSkill) -> None:
    """The hand's orientation predicts a tool that is fixed to it."""
    figures = figures_of(carried)
    assert figures.taken == "orientations of the left hand"
    assert isinstance(carried.model, HandsKMP)
    assert carried.model.turned
    takes = [left_out("", "", shown(seed, "carried")) for seed in range(20, 23)]
    by_turns, by_places = (
        np.sqrt(
            sum(judged(take, predicted(skill, take)).squares for take in takes)
            / sum(len(t.tool) for t in takes)
        )
        for skill in (
            carried,
            learn([shown(seed, "carried") for seed in range(6)], points=120, ell=8.0),
        )
    )
    assert by_turns < 0.02
    assert by_turns < 0.5 * by_places


def test_persons_are_left_out_together() -> None:
    """Takes of a person are left out together if two persons are named."""
    takes = [shown(seed, "both", person) for seed, person in enumerate(("Ada", "Ada", "Bo", "Bo"))]
    assert persons(takes) == [0, 0, 1, 1]
    assert persons([take._replace(person="Ada") for take in takes]) == [0, 1, 2, 3]
    assert persons([takes[0], takes[2], takes[0]._replace(person="")]) == [0, 1, 2]
    by_person, alone = (
        figures_of(learn(variant, points=120))
        for variant in (takes, [take._replace(person="") for take in takes])
    )
    assert table(by_person).startswith("held out by person")
    assert not table(alone).startswith("held out by")
    assert by_person.all.error_mm > alone.all.error_mm  # half of the takes remain to learn from


def squares(errors_mm: np.ndarray) -> np.ndarray:
    return np.asarray((errors_mm / 1000) ** 2)


def test_a_simpler_kind_is_within_a_standard_error() -> None:
    """A kind that is worse in each group is not taken, however little; one that is worse in half of
    the groups is, and one hand only if its memory is as good too.
    """
    simple, rich = Inputs("simple"), Inputs("rich", order=4)
    alone, alone_rich = Inputs("alone", alone=0), Inputs("alone rich", order=4, alone=0)
    random = np.random.default_rng(1)
    for _ in range(50):
        best = random.uniform(30.0, 60.0, 8)
        worse = squares(best + 0.5 + 0.1 * random.random(8))
        noise = np.tile([0.6, -0.6], 4)
        alike = squares(best + noise + 0.05)
        assert simplest_of([simple, rich], {"simple": worse, "rich": squares(best)}) == rich
        assert simplest_of([simple, rich], {"simple": alike, "rich": squares(best)}) == simple
        of_hand = {"alone": alike, "alone rich": squares(best + 5.0), "rich": squares(best)}
        kinds = [alone, simple, alone_rich, rich]
        assert simplest_of(kinds, {**of_hand, "simple": worse}) == rich
        of_hand["alone rich"] = alike
        assert simplest_of(kinds, {**of_hand, "simple": worse}) == alone


@pytest.mark.parametrize("count", [2, 3, 10, 11, 64])
def test_there_are_at_most_ten_folds(count: int) -> None:
    """A person's takes are in one fold, and folds have about as many persons."""
    demonstrations = [shown(i, "both", f"person {i % count}") for i in range(2 * count)]
    takes = takes_of(demonstrations, [str(i) for i in range(2 * count)])
    folds = folds_of(takes)
    assert len(np.unique(folds)) == min(count, MOST_FOLDS)
    for person in range(count):
        assert len({f for f, take in zip(folds, takes, strict=True) if take.person == person}) == 1
    sizes = np.bincount(folds)
    assert sizes.max() - sizes.min() <= 2
    both = folds_of([*takes, *takes], len(takes))
    np.testing.assert_array_equal(both[: len(takes)], folds)
    assert not set(both[: len(takes)]) & set(both[len(takes) :])
