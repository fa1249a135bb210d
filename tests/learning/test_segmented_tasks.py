"""Tasks between via-points: learned from demonstrations, valid for other positions of the
via-points, with a via-point that is visited twice, and stored in a file.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.skills import at_rest, figures_of, file_with, made, turns_of
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.skill import TURNS
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.core.skill.memory import turn_lag_s
from thirdhand.core.skill.segmented import SegmentedKMP
from thirdhand.core.skill.segments import LEFT, NONE
from thirdhand.core.skill.skill import Skill
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import SkillError, StoredSkill, decoded, with_file
from thirdhand.skills.via_points import adapted, in_force
from thirdhand.workbench.learning.division import task_of, via_points_never_reached
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.learning.records import Figures
from thirdhand.workbench.learning.table import table
from thirdhand_sim.lab.people.left_out import judged, left_out, predicted
from thirdhand_sim.made_tasks import CARRIED_M
from thirdhand_sim.teach import by_people


@pytest.fixture(scope="module")
def shown() -> list[Demonstration]:
    return by_people(3)


@pytest.fixture(scope="module")
def between(shown: list[Demonstration]) -> Skill:
    return learn(shown, name="between")


def hands_at(point: ViaPoint, off: float = 0.0) -> np.ndarray:
    return np.array([[*point.left, *point.right]]) + off


def moved(
    via_points: tuple[ViaPoint, ...], by: dict[str, tuple[float, float, float]]
) -> tuple[ViaPoint, ...]:
    """The via-points, some of them with another tool position."""
    return tuple(
        msgspec.structs.replace(p, tool=tuple(np.add(p.tool, by.get(p.name, (0, 0, 0))).tolist()))
        for p in via_points
    )


@pytest.mark.thorough
def test_common_positions_of_a_hand_are_found(between: Skill) -> None:
    """Equal positions of a hand are recognised."""
    assert isinstance(between.model, SegmentedKMP)
    task = between.model.task
    assert task.names == ("start", "handover", "glass", "soldering")
    assert task.corners.tolist() == [[0, 0], [1, 0], [2, 1], [2, 2]]
    assert task.follow.tolist() == [-1, 0, -1, -1]


def test_tool_goes_to_its_via_points(between: Skill, shown: list[Demonstration]) -> None:
    """The tool also moves with the hand that it follows."""
    for via_points in (
        shown[1].via_points,
        moved(shown[3].via_points, {"glass": (0.0, 0.1, 0.05)}),
    ):
        aimed = adapted(between, via_points, tolerance=0.05)
        assert max(point.missed_by_m for point in in_force(aimed)) < 0.008
        for point in via_points:
            near = aimed.mean(hands_at(point, 0.02))[0] - (0.02 if point.follow == "left" else 0.0)
            assert np.linalg.norm(near - point.tool) < 0.015
        far, near = (
            aimed.model.gates_m(hands_at(via_points[2], offset_m))[0] for offset_m in (0.3, 0.0)
        )
        assert far > aimed.threshold > near


def test_unusable_via_points_are_explained(shown: list[Demonstration]) -> None:
    """Takes with unusable via-points are refused with a reason."""
    assert task_of([take._replace(via_points=()) for take in shown]) == (None, "")
    fewer = [shown[0], shown[1]._replace(via_points=shown[1].via_points[:2])]
    assert "not all demonstrations name the same via-points" in task_of(fewer)[1]
    assert (
        "1 named via-points: 2 to 65"
        in task_of([take._replace(via_points=take.via_points[:1]) for take in shown])[1]
    )


def test_via_point_never_reached_is_named(shown: list[Demonstration]) -> None:
    """A via-point that the tool never came near is named."""
    names = [f"take-{i}" for i in range(len(shown))]
    task, _ = task_of(shown)
    assert task is not None
    assert via_points_never_reached(task, shown, names) == []
    wrong = [
        take._replace(via_points=moved(take.via_points, {"glass": (0.0, 0.4, 0.3)}))
        for take in shown
    ]
    (remark,) = via_points_never_reached(task, [*shown[:-1], wrong[-1]], names)
    assert re.fullmatch(
        r"via-point 'glass': the tool never came near it in take-5 \(\d{3} mm\)", remark
    )
    with pytest.raises(
        SkillError,
        match=r"via-point 'glass': the tool never came nearer to it than \d{3} mm \(take-\d\)",
    ):
        learn(wrong, names=names)


def test_file_holds_segments_or_is_refused(between: Skill) -> None:
    """The task comes back exactly; arrays that do not fit are refused."""
    back = decoded(between.file, origin="x.npz")
    hands = between.hands + 0.01
    assert back.mean(hands).tobytes() == between.mean(hands).tobytes()
    assert back.file == between.file

    def refusal(**changes: Any) -> str:
        with pytest.raises(SkillError, match=r"^x\.npz: ") as caught:
            decoded(file_with(between, **changes), origin="x.npz")
        return str(caught.value)

    assert "corners has 99, 0 to 65" in refusal(corners=np.full((4, 2), 99))
    assert "Expected `str`" in refusal(names=np.array("[1]"))
    assert "follow has shape" in refusal(follow=np.zeros(3, int))
    assert "seen has shape" in refusal(seen=np.zeros((3, 5)))
    assert "nominal has nan" in refusal(nominal=np.full((4, 9), np.nan))
    assert "off_ways has 0" in refusal(off_ways=np.zeros((3, 2)))
    assert "are not numbered through" in refusal(corners=np.array([[0, 0], [1, 0], [3, 1], [3, 1]]))
    assert "no skill has" in refusal(more=np.zeros(3))


def rms_mm(kind: str, skill: Skill) -> float:
    """The error of the core at each moment in four takes of other people."""
    total = 0.0
    count = 0
    for demonstration in made(kind, (6, 7)):
        take = left_out("", "", demonstration)
        aimed = adapted(skill, demonstration.via_points, tolerance=0.05)
        score = judged(take, predicted(aimed, take))
        total = total + score.squares
        count = count + score.samples
    return 1000.0 * float(np.sqrt(total / count))


@pytest.fixture(scope="module")
def cyclic() -> Skill:
    return learn(made("cyclic", range(4)))


def test_via_point_is_visited_twice(cyclic: Skill) -> None:
    """Once the hands have left it, the past distinguishes the visits."""
    assert cyclic.model.names == ("start", "left out", "work", "left out again")
    # a Gaussian process with 2 s of memory: 51, one without: 101
    assert rms_mm("cyclic", cyclic) < 50.0
    via_points = {point.name: point for point in made("cyclic", [6], each=1)[0].via_points}
    aimed = adapted(cyclic, tuple(via_points.values()), tolerance=0.05)
    first_visit = via_points["left out"]
    second_visit = via_points["left out again"]
    assert np.allclose(first_visit.left, second_visit.left)
    assert np.linalg.norm(np.subtract(first_visit.tool, second_visit.tool)) > 0.1
    assert max(point.missed_by_m for point in in_force(aimed)) < 0.005


def test_delay_of_teacher_is_learned(cyclic: Skill) -> None:
    """The teacher's delay is learned, and the tool lags by less."""
    figures = figures_of(cyclic)
    late_s = figures.delay_s
    std_s = figures.delay_std_s
    # the teacher's delays are 0.09 to 0.34 s
    assert cyclic.model.delay_s == late_s == pytest.approx(0.22, abs=0.06)
    assert 0.0 < std_s < 0.2
    assert f"the teacher was {late_s:.2f} s late" in table(figures)


def late_right(shown: Demonstration, by_s: float) -> Demonstration:
    """The demonstration with a delayed right hand."""
    steps = round(by_s / shown.period_s)
    right = shown.right[np.maximum(np.arange(len(shown.right)) - steps, 0)]
    return shown._replace(right=right)


def without_follow(shown: Demonstration) -> Demonstration:
    """A demonstration whose via-points do not state which hand the tool follows."""
    return shown._replace(
        via_points=tuple(
            msgspec.structs.replace(point, follow="none") for point in shown.via_points
        )
    )


@pytest.fixture(scope="module")
def on_path() -> list[Demonstration]:
    """Takes in which the tool follows the left hand, independently of the right one."""
    return made("path", range(4))


def lead_of(shown: list[Demonstration]) -> tuple[int, Figures]:
    skill = learn(shown, name="path")
    assert isinstance(skill.model, SegmentedKMP)
    assert decoded(skill.file, origin="memory").model.task.leads == skill.model.task.leads
    return skill.model.task.leads, figures_of(skill)


@pytest.mark.thorough
def test_leading_hand(on_path: list[Demonstration]) -> None:
    """Unless demonstrations show a leading hand, the tool waits for both hands."""
    free = [without_follow(take) for take in on_path]
    leads, figures = lead_of(free)
    assert leads == NONE
    assert "positions, shares of the left hand alone" not in figures.tried_mm
    leads, figures = lead_of([*free[4:], *(late_right(take, 4.0) for take in free[:4])])
    assert "positions, shares of the left hand alone" in figures.tried_mm
    assert leads == LEFT


def test_where_it_waits_it_waits_to_the_end() -> None:
    skill = learn(made("three", range(3)), name="three")
    via_points = made("three", [0], each=1)[0].via_points
    adapted_skill = adapted(skill, via_points, tolerance=0.05)
    left_alone = np.array([[*via_points[1].left, *via_points[0].right]])
    assert np.linalg.norm(adapted_skill.mean(left_alone)[0] - via_points[0].tool) < 0.03


@pytest.fixture(scope="module")
def carried() -> StoredSkill:
    """A skill of a tool that is fixed to a part in the left hand."""
    return learn([without_follow(take) for take in made("heading", range(4))])


@pytest.mark.thorough
def test_carried_tool_turns_with_hand(carried: StoredSkill) -> None:
    figures = figures_of(carried)
    assert figures.taken == "orientation of the left hand"
    assert figures.tried_mm[figures.taken] < 0.6 * figures.tried_mm["positions"]
    assert isinstance(carried.model, SegmentedKMP)
    np.testing.assert_allclose(carried.model.task.levers, np.tile(CARRIED_M, (3, 1)), atol=0.004)
    # without the orientation: 39; a Gaussian process with the via-points: 80
    assert rms_mm("heading", carried) < 22.0
    restored = decoded(carried.file, origin="a file")
    assert (
        restored.model.own_arrays()["levers"].tobytes()
        == carried.model.own_arrays()["levers"].tobytes()
    )
    assert with_file(replace(restored, file=b"")).file == carried.file


@pytest.mark.thorough
def test_carried_tool_has_velocity_of_turn(carried: StoredSkill) -> None:
    """The velocity includes the hand's rotation; without orientations only its translation."""
    model = carried.model
    hands = model.hands[1].reshape(2, 3)
    belief = model.belief(model.hands[1])
    lag_s = turn_lag_s(model.delay_s)
    h = 1e-3
    rate = np.array([0.0, 0.0, 0.5])
    behind, now, ahead = (
        at_rest(carried, hands, turns=turns_of(rate, at_s, lag_s), belief=belief.copy())
        for at_s in (-h, 0.0, h)
    )
    np.testing.assert_allclose(
        now.velocity, (ahead.position - behind.position) / (2 * h), atol=2e-3
    )
    lever = Rotation.from_rotvec(-TURNS * lag_s * rate).apply(CARRIED_M)
    np.testing.assert_allclose(now.velocity, np.cross(rate, lever), atol=0.01)
    np.testing.assert_allclose(now.position, hands[0] + lever, atol=0.02)
    untold = at_rest(carried, hands, belief=belief.copy())
    assert not untold.velocity.any()
    np.testing.assert_allclose(untold.position, model.nominal.at[1, 6:], atol=0.02)


def test_via_points_that_mislead_are_left_out() -> None:
    """If the tool is where the hands are, and via-points are given some centimetres off, it is
    learned from the hands, and said.
    """
    random = np.random.default_rng(7)
    demonstrations = []
    for demonstration in made("path", range(6), each=1):
        tool = demonstration.tool.copy()
        hands = demonstration.hands
        tool[:, :3] = 0.5 * (hands[:, :3] + hands[:, 3:]) + (0.0, 0.0, 0.2)
        points = tuple(
            msgspec.structs.replace(
                point,
                follow="none",
                tool=tuple((0.5 * np.add(point.left, point.right) + off).tolist()),
            )
            for point in demonstration.via_points
            for off in [np.array([0.0, 0.0, 0.2]) + 0.04 * random.standard_normal(3)]
        )
        demonstrations.append(demonstration._replace(tool=tool, via_points=points).every(4))
    learned = learn(demonstrations)
    assert isinstance(learned.model, HandsKMP)
    (said,) = [
        text for text in figures_of(learned).warnings if "not between its via-points" in text
    ]
    assert said.startswith("it is learned where the hands are")
    assert figures_of(learned).conclusion.startswith("conclusion: learned well")
