"""Modelled people and the judgement of skills on them: hands, trackers, places, rivals, and a
reduced run of the comparison.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thirdhand.core.skill.skill import Skill
from thirdhand_sim.lab.people.comparison import PEOPLE_METHODS, run
from thirdhand_sim.lab.people.trials import SeenSession, judge, seen
from thirdhand_sim.lab.results import Options, Results
from thirdhand_sim.lab.rivals.gaussian_process import GaussianProcess
from thirdhand_sim.lab.rivals.method import DependsOn, Observed, Predicted
from thirdhand_sim.lab.rivals.mixtures import frames
from thirdhand_sim.lab.rivals.places import LookUp, NoDemonstrations
from thirdhand_sim.lab.rivals.service import Service
from thirdhand_sim.people import Group, person
from thirdhand_sim.sessions import BREAKING, MISTAKES, Session, demonstrations, played, session

pytestmark = pytest.mark.thorough

GROUPS: tuple[Group, ...] = ("demonstrations", "tuning", "test")


@pytest.fixture(scope="module")
def run_of_tuning() -> Session:
    return session(person("tuning", 1), 0, group="tuning", sigma_m=0.005)


@pytest.fixture(scope="module")
def as_seen(run_of_tuning: Session) -> SeenSession:
    return seen(run_of_tuning)


def test_the_groups_share_nobody() -> None:
    habits = [person(group, number).start.tobytes() for group in GROUPS for number in range(20)]
    assert len(set(habits)) == len(habits)


@pytest.mark.parametrize("mistake", ["", *MISTAKES])
def test_hands_come_to_their_places(mistake: str) -> None:
    for number in range(4):
        subject = person("tuning", number)
        scene = session(subject, 0, group="tuning")
        motion = played(
            subject, 0, scene.places, scene.places, seed=(1, 2, number), mistake=mistake
        )
        times = np.arange(0.0, motion.lasts_s, 0.005)
        hands = motion.hands(times)
        speed = np.linalg.norm(np.diff(hands.reshape(-1, 2, 3), axis=0), axis=2) / 0.005
        assert speed.max() < 1.2
        ends = (
            np.concatenate([motion.places.handover, [np.nan] * 3]),
            frames(motion.places)[2, :6],
            frames(motion.places)[3, :6],
        )
        for (begin, end), position_m in zip(motion.windows, ends, strict=True):
            inside = (times >= begin) & (times <= end)
            assert end - begin > 0.6
            assert np.nanmax(np.abs(hands[inside] - position_m)) < 0.09


class Still:
    """A skill whose tool does not move, and whose hands are always far."""

    depends_on = DependsOn.HANDS

    def __init__(self, at: np.ndarray, *, far: bool) -> None:
        self.at = at
        self.far = far

    def mean(self, seen: Observed) -> np.ndarray:
        return np.tile(self.at, (len(seen.hands), 1))

    def predict(self, seen: Observed) -> Predicted:
        count = len(seen.hands)
        return Predicted(
            self.mean(seen), np.tile(np.eye(3), (count, 1, 1)), np.full(count, self.far)
        )


class TestJudging:
    """Counts for skills whose outcome is known."""

    def test_teacher_succeeds(self, as_seen: SeenSession) -> None:
        """The teacher is on the path too."""
        judgement = judge(None, as_seen)
        assert judgement.success
        assert judgement.kept
        assert judgement.falsely_followed == 0.0
        assert judgement.path_mm < 15  # the errors with which people perceive places

    def test_still_tool_follows_falsely(self, as_seen: SeenSession) -> None:
        """The tool reaches only the place at which it stays."""
        judgement = judge(Still(as_seen.session.told.glass, far=False), as_seen)
        assert [event.reached for event in judgement.events] == [False, True, False]
        assert judgement.falsely_followed > 0.3
        assert judgement.inside[-1] == 1.0

    def test_skill_always_far_never_moves(self, as_seen: SeenSession) -> None:
        judgement = judge(Still(as_seen.session.told.glass, far=True), as_seen)
        assert judgement.held == 1.0
        assert judgement.falsely_followed == 0.0
        assert not any(event.reached for event in judgement.events)
        assert all(event.held for event in judgement.events)
        due = (~as_seen.fresh & (as_seen.times > 0.5)).sum() / (as_seen.times > 0.5).sum()
        # holds for stale hands are right
        assert judgement.falsely_held == pytest.approx(1.0 - due)

    def test_a_passage_by_a_hand_is_no_success(self, as_seen: SeenSession) -> None:
        """The true hand is at the tool, the tracked one is not."""
        unseen = replace(as_seen, hands=np.hstack([as_seen.tool, as_seen.hands[:, 3:]]))
        judgement = judge(None, unseen)
        assert judgement.too_near
        assert not judgement.success


@pytest.mark.parametrize(
    "method", [NoDemonstrations(), LookUp(), GaussianProcess(each=12), Service()]
)
def test_skills_go_to_told_places(
    method: NoDemonstrations | LookUp | GaussianProcess | Service, run_of_tuning: Session
) -> None:
    """The places are the via-points."""
    places = run_of_tuning.places
    placed = method.learn(demonstrations(2)).place(places)
    hands = frames(places)[1:, :6]

    def mean() -> np.ndarray:
        return (
            placed.mean(hands)
            if isinstance(placed, Skill)
            else placed.mean(Observed.resting(hands))
        )

    np.testing.assert_allclose(mean(), frames(places)[1:, 6:], atol=0.008)
    if not isinstance(placed, Skill):
        np.testing.assert_allclose(placed.predict(Observed.resting(hands)).mean, mean(), atol=1e-9)
    hands[:, 0] += 0.01  # only at the handover the tool follows the left hand
    moved = mean() - frames(places)[1:, 6:]
    np.testing.assert_allclose(moved[:, 0], [0.01, 0.0, 0.0], atol=0.003)


def test_each_method_had_as_many_candidates() -> None:
    assert {
        len(entry.candidates)
        for name, entry in PEOPLE_METHODS.items()
        if not name.startswith(("ours", "as_paper"))
    } == {6}


@pytest.mark.timeout(120)
def test_reduced_comparison_keeps_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the stable part of the order is compared."""
    pytest.importorskip("matplotlib")
    for table, value in (("PEOPLE_OF_GROUP", 3), ("SCENES_OF_GROUP", 2), ("BREAKING_SCENES", 2)):
        monkeypatch.setattr(
            f"thirdhand_sim.lab.people.comparison.{table}", {"tuning": value, "test": value}
        )
    monkeypatch.setattr("thirdhand_sim.lab.people.comparison.BREAKING", BREAKING[:1])
    few = {name: PEOPLE_METHODS[name] for name in ("ours", "none", "look_up", "gmr")}
    monkeypatch.setattr("thirdhand_sim.lab.people.comparison.PEOPLE_METHODS", few)
    results = Results(tmp_path, "people", said=False)
    result = json.loads(
        results.numbers(run(results, Options(group="tuning", share=0.99))).read_text()
    )
    mean = {
        name: {m: method[m]["mean"] for m in ("success", "path_rms_mm")}
        for name, method in result["methods"].items()
    }
    assert result["people"] == 3
    assert mean["teacher"]["success"] == 1.0
    assert mean["look_up"]["success"] >= mean["none"]["success"] > mean["gmr"]["success"]
    # demonstrations improve the path between the places
    assert (
        mean["ours"]["path_rms_mm"] < mean["none"]["path_rms_mm"] < mean["look_up"]["path_rms_mm"]
    )
    assert mean["look_up"]["path_rms_mm"] < mean["gmr"]["path_rms_mm"]
    assert mean["ours"]["success"] >= mean["look_up"]["success"]
    assert (tmp_path / "people.png").read_bytes()[:4] == b"\x89PNG"
