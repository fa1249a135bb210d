"""Tasks between via-points: what demonstrations tell of one, that it holds wherever these are,
and what its file may hold.
"""

from __future__ import annotations

import io
import re
from typing import Any

import msgspec
import numpy as np
import pytest

from kmp.storage import checksum
from service.contract.requests import ViaPoint
from service.core.skill.skill import Skill
from service.core.skill.task import MOST_CORNERS
from service.core.skill.task_parameterized import TaskInstance, TaskParameterized, nearest_between
from service.learning.demonstration import Demonstration
from service.learning.learn import learn
from service.learning.skill_file import SkillError, decoded
from service.learning.tasks import task_of, via_points_never_reached
from service.learning.via_points import adapted, in_force, warnings_of
from sim.teach import by_people

AT_REST = np.zeros(6)


@pytest.fixture(scope="module")
def shown() -> list[Demonstration]:
    return by_people(3)


@pytest.fixture(scope="module")
def between(shown: list[Demonstration]) -> Skill:
    return learn(shown, name="between")


def hands_at(place: ViaPoint, off: float = 0.0) -> np.ndarray:
    return np.array([[*place.left, *place.right]]) + off


def moved(places: tuple[ViaPoint, ...], by: dict[str, tuple[float, float, float]]) -> tuple[ViaPoint, ...]:
    """The places with the tool elsewhere at some of them."""
    return tuple(
        msgspec.structs.replace(p, tool=tuple(np.add(p.tool, by.get(p.name, (0, 0, 0))).tolist())) for p in places
    )


def test_places_of_a_hand_that_are_one_and_that_make_no_difference_are_found(between: Skill) -> None:
    assert isinstance(between.model, TaskParameterized)
    task = between.model.task
    assert task.names == ("start", "handover", "glass", "soldering")
    assert task.corners.tolist() == [[0, 0], [1, 0], [2, 1], [2, 2]]
    assert task.inputs.tolist() == [[0, 1, 2], [3, 3, 4]]  # the right hand at rest or at the iron
    assert task.follow.tolist() == [-1, 0, -1, -1]


def test_what_makes_no_difference_is_found_by_demonstrations_that_are_left_out(
    shown: list[Demonstration], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where nobody waited at any pair of places for long."""
    monkeypatch.setattr("service.learning.tasks.LEAST_SAMPLES_S", np.inf)
    found = learn(shown, name="hasty").model
    assert isinstance(found, TaskParameterized)
    assert found.task.inputs.tolist() == [[0, 1, 2], [3, 3, 4]]


def test_the_tool_goes_to_the_places_that_are_told_and_with_the_hand_where_it_follows(
    between: Skill, shown: list[Demonstration]
) -> None:
    for places in (shown[1].places, moved(shown[3].places, {"glass": (0.0, 0.1, 0.05)})):
        aimed = adapted(between, places, tolerance=0.05)
        assert max(point.missed_by_m for point in in_force(aimed)) < 0.008
        for place in places:
            near = aimed.mean(hands_at(place, 0.02))[0] - (0.02 if place.follow == "left" else 0.0)
            assert np.linalg.norm(near - place.tool) < 0.015
        far, near = (aimed.model.gates_m(hands_at(places[2], off))[0] for off in (0.3, 0.0))
        assert far > aimed.threshold > near


def test_a_moving_hand_is_on_its_way_and_a_trembling_one_moves_nothing(between: Skill) -> None:
    assert isinstance(between.model, TaskParameterized)
    left, right = between.model.instance.tasks["corners"][0]
    handover, board, rest = left[1], left[2], right[0]
    half = np.concatenate([0.7 * handover + 0.3 * board, rest])
    way = np.concatenate([(board - handover) / np.linalg.norm(board - handover), np.zeros(3)])
    still, going = np.ones((1, 2)), np.array([[0.0, 1.0]])
    assert np.linalg.norm(between.mean(half[None], going) - between.mean(half[None], still)) > 0.05
    found = between.predict(half.reshape(2, 3), (0.4 * way).reshape(2, 3), AT_REST.reshape(2, 3), going[0])
    h = 1e-3
    ahead, behind = (between.mean((half + s * h * 0.4 * way)[None], going)[0] for s in (1, -1))
    np.testing.assert_allclose(found.velocity, (ahead - behind) / (2 * h), atol=0.05)
    calm = between.predict(half.reshape(2, 3), (0.02 * way).reshape(2, 3), AT_REST.reshape(2, 3))
    assert np.linalg.norm(calm.velocity) < 1e-3
    assert np.linalg.eigvalsh(found.covariance).min() > 0


def test_what_is_near_to_a_via_point_is_smaller_where_these_lie_close_together(between: Skill) -> None:
    """For a watchmaker all of it is smaller."""
    assert isinstance(between.model, TaskParameterized)
    task, at = between.model.task, between.model.nominal
    large, small = (
        TaskInstance.of(task, task.parameters(at._replace(at=share * at.at))) for share in (0.3 / 0.44, 0.1 / 0.44)
    )
    assert (large.tasks["size"] <= 1.0).all()
    assert (small.tasks["size"] < 0.4).all()
    hands = np.random.default_rng(3).uniform(-0.1, 0.1, (50, 6)) + np.hstack([*large.tasks["corners"][0].mean(axis=1)])
    expected, found = large.inputs(hands)[0], small.inputs(hands / 3.0)[0]
    assert np.abs(expected - found).max() < 2e-3  # edges are taken to be a millimetre longer
    assert between.model.instance.tasks["size"].tolist() == [[1.0, 1.0]]


def test_a_via_point_of_another_name_is_added_and_forgotten(between: Skill, shown: list[Demonstration]) -> None:
    places = shown[0].places
    extra = ViaPoint("magnifier", (0.62, 0.1, 0.2), places[1].right, (0.5, 0.0, 0.3), std=0.001)
    aimed = adapted(between, (*places, extra), tolerance=0.05)
    missed = {point.name: point.missed_by_m for point in in_force(aimed)}
    assert missed["magnifier"] < 0.002
    assert max(missed.values()) < 0.01
    back = adapted(aimed, places, tolerance=0.05)
    assert back.file == adapted(between, places, tolerance=0.05).file
    assert warnings_of(back, back) == ()


def test_shares_are_those_of_the_nearest_point_between_the_places() -> None:
    random = np.random.default_rng(0)
    for count in range(1, MOST_CORNERS + 1):
        share = random.dirichlet(np.ones(count), 20_000)
        for _ in range(5):
            corners, found = random.standard_normal((MOST_CORNERS, 3)), np.empty(3)
            for point in 2.0 * random.standard_normal((20, 3)):
                off = nearest_between(point, corners, count, found)
                assert found.min() >= 0.0
                assert found.sum() == pytest.approx(1.0)
                assert off == pytest.approx(np.linalg.norm(point - found @ corners), abs=1e-5)
                assert off < np.linalg.norm(point - share @ corners[:count], axis=1).min() + 1e-3


def test_what_cannot_be_learned_between_places_says_why(shown: list[Demonstration]) -> None:
    assert task_of([one._replace(places=()) for one in shown]) == ""
    fewer = [shown[0], shown[1]._replace(places=shown[1].places[:2])]
    assert "not all demonstrations name the same via-points" in str(task_of(fewer))
    assert "two named via-points" in str(task_of([one._replace(places=one.places[:1]) for one in shown]))
    fourth = [
        one._replace(places=(*one.places, ViaPoint("shelf", (0.2, 0.6, 0.5), one.places[0].right, (0.5, 0.0, 0.3))))
        for one in shown
    ]
    assert "the left hand has 4 positions, 3 at most" in str(task_of(fourth))


def test_a_place_that_the_tool_never_came_near_is_named(shown: list[Demonstration]) -> None:
    names = [f"take-{i}" for i in range(len(shown))]
    task = task_of(shown)
    assert not isinstance(task, str)
    assert via_points_never_reached(task, shown, names) == []
    wrong = [one._replace(places=moved(one.places, {"glass": (0.0, 0.4, 0.3)})) for one in shown]
    (said,) = via_points_never_reached(task, [*shown[:-1], wrong[-1]], names)
    assert re.fullmatch(r"via-point 'glass': the tool never came near it in take-5 \(\d{3} mm\)", said)
    with pytest.raises(
        SkillError, match=r"via-point 'glass': the tool never came nearer to it than \d{3} mm \(take-\d\)"
    ):
        learn(wrong, names=names)


def test_its_file_holds_it_exactly_and_what_does_not_fit_is_refused(between: Skill) -> None:
    back = decoded(between.file, origin="x.npz")
    hands = between.hands + 0.01
    assert back.mean(hands).tobytes() == between.mean(hands).tobytes()
    assert back.file == between.file
    with np.load(io.BytesIO(between.file)) as archive:
        arrays = dict(archive)

    def refusal(**changes: Any) -> str:
        spoilt = arrays | changes
        out = io.BytesIO()
        np.savez(out, allow_pickle=False, **spoilt | {"checksum": np.array(checksum(spoilt))})
        with pytest.raises(SkillError, match=r"^x\.npz: ") as caught:
            decoded(out.getvalue(), origin="x.npz")
        return str(caught.value)

    assert "corners has 9, 0 to 2" in refusal(corners=np.full((4, 2), 9))
    assert "do not fit each other" in refusal(corners=np.zeros((4, 2), int))
    assert "Expected `str`" in refusal(names=np.array("[1]"))
    assert "follow has shape" in refusal(follow=np.zeros(3, int))
    assert "seen has shape" in refusal(seen=np.zeros((3, 5)))
    assert "nominal has nan" in refusal(nominal=np.full((4, 9), np.nan))
    assert "are not numbered through" in refusal(shares=np.array([[0, 2, 2], [3, 3, 4]]))
    assert "no skill has" in refusal(more=np.zeros(3))


def test_places_near_each_other_are_taught_where_the_task_tells_them_apart(between: Skill) -> None:
    """Hands at rest are at one place or the other, however near: the tool does not shake."""
    model = between.model
    assert isinstance(model, TaskParameterized)
    at = model.nominal.at.copy()
    one, other = 1, 2
    corners = model.task.corners
    for side in (0, 1):
        here = slice(3 * side, 3 * side + 3)
        for row in np.flatnonzero(corners[:, side] == corners[other, side]):
            at[row, here] = at[one, here] + (0.05, 0.0, 0.02)
    at[other, 6:] = at[one, 6:] + (0.0, 0.5, 0.0)
    places = [
        ViaPoint(name, tuple(row[:3]), tuple(row[3:6]), tuple(row[6:]), std=0.001)
        for name, row in zip(model.names, at.tolist(), strict=True)
    ]
    taught = adapted(between, places, tolerance=0.05)
    assert all(point.missed_by_m < 0.005 for point in in_force(taught))
    for point in places:
        hands = np.array([[*point.left, *point.right]])
        steps = 1e-3 * np.concatenate([np.eye(6), -np.eye(6)])
        assert np.linalg.norm(taught.mean(hands + steps) - taught.mean(hands), axis=1).max() < 2e-3
