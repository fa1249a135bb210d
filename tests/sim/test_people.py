"""Modelled people and what is judged of skills on them: the hands, the trackers, the places, the
rivals, and a reduced run of the comparison.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thirdhand.core.skill.skill import Skill
from thirdhand_sim.lab.people.comparison import (
    METHODS,
    Task,
    chosen,
    outcomes,
    run,
)
from thirdhand_sim.lab.people.recorded_people import recorded_people
from thirdhand_sim.lab.people.trials import (
    RATE_HZ,
    Seen,
    judge,
    seen,
)
from thirdhand_sim.lab.results import ExperimentError, Options, Results
from thirdhand_sim.lab.rivals.gaussian_process import GaussianProcess
from thirdhand_sim.lab.rivals.method import DependsOn, Observed, Predicted
from thirdhand_sim.lab.rivals.mixtures import frames
from thirdhand_sim.lab.rivals.places import LookUp, NoDemonstrations
from thirdhand_sim.lab.rivals.service import Service
from thirdhand_sim.people import Group, Person, person
from thirdhand_sim.scene import TOOL_FROM_HAND
from thirdhand_sim.sessions import (
    BREAKING,
    MISTAKES,
    Session,
    breaking,
    demonstrations,
    played,
    session,
)

pytestmark = pytest.mark.thorough

GROUPS: tuple[Group, ...] = ("demonstrations", "tuning", "test")


@pytest.fixture(scope="module")
def run_of_tuning() -> Session:
    return session(person("tuning", 1), 0, group="tuning", sigma_m=0.005)


@pytest.fixture(scope="module")
def as_seen(run_of_tuning: Session) -> Seen:
    return seen(run_of_tuning)


def test_the_groups_share_nobody() -> None:
    habits = [person(group, number).start.tobytes() for group in GROUPS for number in range(20)]
    assert len(set(habits)) == len(habits)


def test_a_session_is_the_same_from_the_same_numbers() -> None:
    one, other = (session(person("tuning", 3), 1, group="tuning", sigma_m=0.01) for _ in range(2))
    for a, b in zip(one.samples(), other.samples(), strict=True):
        assert a[0].tobytes() == b[0].tobytes()
        assert a[1].tobytes() == b[1].tobytes()
    assert one.told.glass.tobytes() == other.told.glass.tobytes()


@pytest.mark.parametrize("mistake", ["", *MISTAKES])
def test_hands_move_as_hands_do_and_come_to_their_places(mistake: str) -> None:
    for number in range(4):
        who = person("tuning", number)
        scene = session(who, 0, group="tuning")
        one = played(who, 0, scene.places, scene.places, seed=(1, 2, number), mistake=mistake)
        times = np.arange(0.0, one.lasts_s, 0.005)
        hands = one.hands(times)
        speed = np.linalg.norm(np.diff(hands.reshape(-1, 2, 3), axis=0), axis=2) / 0.005
        assert speed.max() < 1.2
        ends = (
            np.concatenate([one.places.handover, [np.nan] * 3]),
            frames(one.places)[2, :6],
            frames(one.places)[3, :6],
        )
        for (begin, end), at in zip(one.windows, ends, strict=True):
            inside = (times >= begin) & (times <= end)
            assert end - begin > 0.6
            assert np.nanmax(np.abs(hands[inside] - at)) < 0.09


def test_the_teacher_is_at_each_place_while_the_hands_wait_there() -> None:
    for number in range(6):
        one = session(person("tuning", number), 0, group="tuning")
        times = np.arange(0.0, one.lasts_s, 0.01)
        tool, hands = one.tool(times), one.hands(times)
        wanted = (hands[:, :3] + TOOL_FROM_HAND, one.places.glass, one.places.carry)
        for (begin, end), place in zip(one.windows, wanted, strict=True):
            late = (times > begin + 0.05) & (times < end - 0.05)
            assert np.linalg.norm(tool - place, axis=1)[late].max() < 0.005
        assert np.linalg.norm(np.diff(tool, axis=0), axis=1).max() / 0.01 < 0.8


def test_a_tracker_has_its_noise_jumps_and_dropouts() -> None:
    who = person("tuning", 1)
    tracker = who.tracker._replace(rate_hz=100.0, noise_m=0.002, jumps_hz=0.5, dropouts_hz=0.2)
    one = session(who._replace(tracker=tracker, swaps=0.0, sway=0.0), 0, group="tuning")
    (stamps, left), _ = one.samples()
    off = left - one.hands(stamps)[:, :3]
    assert np.median(np.abs(off)) / 0.6745 == pytest.approx(0.002, rel=0.1)
    assert 1 <= (np.linalg.norm(off, axis=1) > 0.015).sum() < 40
    assert 0.1 <= np.diff(stamps).max() <= 1.1


def test_places_are_perceived_with_the_error_they_are_said_to_have() -> None:
    places = session(person("tuning", 0), 0, group="tuning").places
    random = np.random.default_rng(0)
    off = np.array([np.array(places.perceived(0.01, random)[:6]) - np.array(places[:6]) for _ in range(400)])
    assert np.sqrt((off**2).sum(axis=2).mean()) == pytest.approx(0.01, rel=0.03)
    assert places.perceived(0.01, random).robot_start.tobytes() == places.robot_start.tobytes()


@pytest.mark.parametrize("kind", BREAKING)
def test_a_scene_that_breaks_differs_in_one_way_and_can_be_done(kind: str) -> None:
    one = breaking(kind, 0, group="tuning")
    assert one.told.std_m == 0.0
    assert one.told.glass.tobytes() == one.places.glass.tobytes()
    taken = one.legs[0][1].begin_s - one.legs[1][0].begin_s
    assert taken == pytest.approx(2.0 if kind == "right hand 2 s early" else 0.0, abs=1e-9)
    moved = {
        name for name in one.places._fields if not np.array_equal(getattr(one.places, name), getattr(one.told, name))
    }
    expected = {"hands start 15 cm elsewhere": {"left_start", "right_start"}, "iron 10 cm elsewhere": {"iron"}}
    assert moved == expected.get(kind, set())
    assert judge(None, seen(one)).success


class Still:
    """A skill whose tool stays where it is, and that says it is far."""

    depends_on = DependsOn.HANDS

    def __init__(self, at: np.ndarray, *, far: bool) -> None:
        self.at, self.far = at, far

    def mean(self, seen: Observed) -> np.ndarray:
        return np.tile(self.at, (len(seen.hands), 1))

    def predict(self, seen: Observed) -> Predicted:
        count = len(seen.hands)
        return Predicted(self.mean(seen), np.tile(np.eye(3), (count, 1, 1)), np.full(count, self.far))


class TestJudging:
    """What is counted, on skills whose outcome is known."""

    def test_the_teacher_succeeds_and_is_on_the_way(self, as_seen: Seen) -> None:
        found = judge(None, as_seen)
        assert found.success
        assert found.kept
        assert found.falsely_followed == 0.0
        assert found.path_mm < 15  # what the places are perceived off by

    def test_a_tool_that_stays_reaches_its_place_alone_and_follows_falsely(self, as_seen: Seen) -> None:
        found = judge(Still(as_seen.session.told.glass, far=False), as_seen)
        assert [event.reached for event in found.events] == [False, True, False]
        assert found.falsely_followed > 0.3
        assert found.inside[-1] == 1.0

    def test_a_skill_that_is_always_far_holds_and_never_moves(self, as_seen: Seen) -> None:
        found = judge(Still(as_seen.session.told.glass, far=True), as_seen)
        assert found.held == 1.0
        assert found.falsely_followed == 0.0
        assert not any(event.reached for event in found.events)
        assert all(event.held for event in found.events)
        due = (as_seen.due & (as_seen.times > 0.5)).sum() / (as_seen.times > 0.5).sum()
        assert found.falsely_held == pytest.approx(1.0 - due)  # stale and swapped hands are held for rightly

    def test_the_service_lets_no_skill_pass_a_hand_that_it_sees(self, as_seen: Seen) -> None:
        class Onto(Still):
            def mean(self, seen: Observed) -> np.ndarray:
                return seen.hands[:, :3] + 0.02 * np.sin(12 * np.arange(len(seen.hands)) / RATE_HZ)[:, None]

        assert not judge(Onto(np.zeros(3), far=False), as_seen).too_near

    def test_a_passage_by_a_hand_is_no_success(self, as_seen: Seen) -> None:
        """By one that is not where the tracker says."""
        unseen = replace(as_seen, hands=np.hstack([as_seen.tool, as_seen.hands[:, 3:]]))
        found = judge(None, unseen)
        assert found.too_near
        assert not found.success


@pytest.mark.parametrize("method", [NoDemonstrations(), LookUp(), GaussianProcess(each=12), Service()])
def test_skills_go_to_the_places_they_are_told(
    method: NoDemonstrations | LookUp | GaussianProcess | Service, run_of_tuning: Session
) -> None:
    places = run_of_tuning.places
    placed = method.learn(demonstrations(2)).place(places)
    hands = frames(places)[1:, :6]

    def mean() -> np.ndarray:
        return placed.mean(hands) if isinstance(placed, Skill) else placed.mean(Observed.resting(hands))

    np.testing.assert_allclose(mean(), frames(places)[1:, 6:], atol=0.008)
    if not isinstance(placed, Skill):
        np.testing.assert_allclose(placed.predict(Observed.resting(hands)).mean, mean(), atol=1e-9)
    hands[:, 0] += 0.01  # only at the handover the tool goes with the left hand
    moved = mean() - frames(places)[1:, 6:]
    np.testing.assert_allclose(moved[:, 0], [0.01, 0.0, 0.0], atol=0.003)


def test_the_process_tells_the_demonstrations_apart() -> None:
    """Its likelihood's slopes, by differences, are those it is maximised with: it comes to rest."""
    model = GaussianProcess(each=10).learn(demonstrations(3))
    assert model.shared.variance > model.own.variance
    known = model.without(0).variances(model.inputs[model.owner == 1])
    assert known.max() < model.shared.variance + model.own.variance


def test_of_candidates_as_good_the_one_nearest_to_the_teacher_is_chosen(as_seen: Seen) -> None:
    good = judge(None, as_seen)
    worse, missed = good._replace(path_mm=good.path_mm + 1), good._replace(success=False, path_mm=0.0)
    assert chosen([[missed], [worse], [good]]) == 2


def test_each_method_had_as_many_candidates() -> None:
    assert {len(entry.candidates) for name, entry in METHODS.items() if not name.startswith(("ours", "as_paper"))} == {
        6
    }


def test_recorded_hands_make_people_for_tuning(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match="time_s"):
        recorded_people(tmp_path)
    times = np.arange(0.0, 10.0, 1 / 30)
    sway = 0.1 * np.sin(times)[:, None] * (1.0, 0.2, 0.1) + 0.002 * np.random.default_rng(0).standard_normal((300, 3))
    np.savez(tmp_path / "one.npz", time_s=times, left=sway, right=-sway)
    (who,) = recorded_people(tmp_path)
    assert isinstance(who, Person)
    assert who.shapes
    one = session(who, 0, group="tuning")
    assert one.hands(np.arange(0.0, one.lasts_s, 0.01)).shape[1] == 6
    assert judge(None, seen(replace(one, swapped_s=(np.inf, np.inf)))).path_mm < 1


@pytest.mark.timeout(120)
def test_a_reduced_comparison_keeps_the_order_that_is_stable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    for table, value in (("PEOPLE", 3), ("SCENES", 2), ("BREAKING_SCENES", 2)):
        monkeypatch.setattr(f"thirdhand_sim.lab.people.comparison.{table}", {"tuning": value, "test": value})
    monkeypatch.setattr("thirdhand_sim.lab.people.comparison.BREAKING", BREAKING[:1])
    few = {name: METHODS[name] for name in ("ours", "none", "look_up", "gmr")}
    monkeypatch.setattr("thirdhand_sim.lab.people.comparison.METHODS", few)
    results = Results(tmp_path, "people", said=False)
    found = json.loads(results.numbers(run(results, Options(group="tuning", share=0.99))).read_text())
    mean = {name: {m: one[m]["mean"] for m in ("success", "path_rms_mm")} for name, one in found["methods"].items()}
    assert found["people"] == 3
    assert mean["teacher"]["success"] == 1.0
    assert mean["look_up"]["success"] >= mean["none"]["success"] > mean["gmr"]["success"]
    # what demonstrations buy is the way between the places
    assert mean["ours"]["path_rms_mm"] < mean["none"]["path_rms_mm"] < mean["look_up"]["path_rms_mm"]
    assert mean["look_up"]["path_rms_mm"] < mean["gmr"]["path_rms_mm"]
    assert mean["ours"]["success"] >= mean["look_up"]["success"]
    assert (tmp_path / "people.png").read_bytes()[:4] == b"\x89PNG"


def test_a_method_meets_the_same_sessions_as_another() -> None:
    rows = [outcomes(Task(method, 0, "tuning", "", 2, 1, None)) for method in ("look_up", "none")]
    assert [(one.person, one.number) for one in rows[0]] == [(one.person, one.number) for one in rows[1]]
