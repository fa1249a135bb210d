"""A task that one hand conducts: recorded, learned and served without the other hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.circling import circling
from support.followed import followed
from support.in_process import ASSUMED, hand
from support.skills import STILL, at_rest, figures_of, made
from support.spoiled import Streams, streams_of, write_streams
from thirdhand.contract.records import Mode, Reason
from thirdhand.contract.requests import Hands
from thirdhand.core.frame import Records, Tick
from thirdhand.core.skill.segmented import SegmentedKMP
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import SkillError, StoredSkill, decoded
from thirdhand.skills.via_points import adapted
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.learning.table import table
from thirdhand.workbench.takes.demonstration_files import summary
from thirdhand.workbench.takes.demonstration_reader import read_demonstration, write_demonstration
from thirdhand.workbench.takes.pose_streams import PoseTopic

AT = (0.5, 0.2, 0.3)  # conducting hand, amid the demonstrations
Point = tuple[float, float, float]
FAR: Point = (0.5, -1.4, 0.3)  # other hand, away from the arm


def led(seed: int, who: Hands = "left") -> Demonstration:
    """A take in which the tool moves with one hand."""
    take = circling(seed, apart_m=0.03)
    tool = take.tool.copy()
    offset_m = 0.005 * np.random.default_rng(seed).normal(size=3)  # variation between people
    tool[:, :3] = take.left[:, :3] * [0.8, 0.8, 0.5] + [0.1, 0.05, 0.25] + offset_m
    return take._replace(right=take.left, tool=tool, conducts=who)


@pytest.fixture(scope="module", params=["left", "right"])
def skill(request: pytest.FixtureRequest) -> StoredSkill:
    return learn([led(seed, request.param) for seed in range(4)], points=100)


def conducting(skill: StoredSkill, at: tuple[float, ...], other: tuple[float, ...]) -> np.ndarray:
    assert skill.conductor is not None
    return np.concatenate([at, other] if skill.conductor == 0 else [other, at])


def test_take_of_one_hand_through_a_file(tmp_path: Path) -> None:
    """The file has no other hand."""
    for side in ("left", "right"):
        write_demonstration(tmp_path / f"{side}.mcap", led(0, side)._replace(person="Ada"))  # type: ignore[arg-type]
        lines: list[str] = []
        got = read_demonstration(tmp_path / f"{side}.mcap", say=lines.append)
        assert (got.conducts, got.person) == (side, "Ada")
        np.testing.assert_array_equal(got.hands, led(0).hands)
        np.testing.assert_array_equal(got.tool, led(0).tool)
        assert f"the {side} hand leads alone" in lines[0]
        assert [stream.name for stream in summary(tmp_path / f"{side}.mcap").streams] == [
            side,
            "tool",
        ]


def test_other_hand_makes_no_difference(skill: StoredSkill) -> None:
    """The skill is judged without it."""
    figures = figures_of(skill)
    assert figures.unsafe == ()
    assert figures.all.error_mm < min(figures.all.other_mm.values())
    assert figures.beside > 80
    assert f"in wrong samples: {figures.beside:.0f} % of the hand 30 cm beside\n" in table(figures)
    assert "swapped" not in table(figures)
    restored = decoded(skill.file, origin="a file")
    assert restored.conductor == skill.conductor
    predictions = []
    for other in ((0.5, -0.2, 0.3), (9.0, 9.0, 9.0), (0.0, 0.0, 0.0)):
        hands = conducting(skill, AT, other)
        moving = np.stack([[0.1, 0.0, 0.0], [3.0, 3.0, 3.0]])[:: 1 if skill.conductor == 0 else -1]
        found_there = restored.predict(hands.reshape(2, 3), moving, STILL)
        predictions.append(
            np.concatenate(
                [*found_there[:3], found_there.covariance.ravel(), restored.mean(hands[None])[0]]
            )
        )
    np.testing.assert_array_equal(predictions, [predictions[0]] * 3)
    assert (
        np.linalg.norm(predictions[0][:3] - (np.array(AT) * [0.8, 0.8, 0.5] + [0.1, 0.05, 0.25]))
        < 0.02
    )
    prediction = at_rest(restored, conducting(skill, (1.1, 0.2, 0.3), AT))
    assert prediction.gate_m > skill.threshold


def test_takes_with_via_points_of_one_hand() -> None:
    """Takes that name their via-points are learned as a task between via-points."""
    takes = []
    for seed in range(4):
        take = made("one_hand", [seed], each=1)[0]
        takes.append(take._replace(right=take.left, conducts="left"))
    learnt = learn(takes)
    assert isinstance(learnt.model, SegmentedKMP)
    assert learnt.conductor == 0
    aimed = adapted(learnt, takes[0].via_points, tolerance=0.05)
    for point in takes[0].via_points:
        for other in (point.right, (2.0, 2.0, 2.0)):
            hands = np.array([[*point.left, *other]])
            np.testing.assert_allclose(aimed.mean(hands, [point.name])[0], point.tool, atol=2e-3)


def test_different_hands_are_not_mixed() -> None:
    words = r"conducted by different hands: both, left; .*\(both: b; left: a\)"
    with pytest.raises(SkillError, match=words):
        learn([led(0), circling(1)], names=["a", "b"])


def streams_of_one(side: str, take: Demonstration) -> Streams:
    """The streams of a take without the other hand."""
    return {name: stream for name, stream in streams_of(take).items() if name in (side, "tool")}


@pytest.mark.parametrize("side", ["left", "right"])
def test_absent_hand_is_not_needed(side: str, tmp_path: Path) -> None:
    """The absent hand has no topic, has no samples, is never seen, or has the other hand's
    topic.
    """
    take = circling(0)
    other = "right" if side == "left" else "left"
    path = tmp_path / "a.mcap"
    lines = list[str]()
    whole = streams_of(take)
    never = whole[other]._replace(poses=np.full_like(whole[other].poses, np.nan))
    for streams in (streams_of_one(side, take), whole | {other: never}):
        got = read_demonstration(write_streams(path, streams), say=lines.append)
        assert got.conducts == side
        np.testing.assert_array_equal(got.hands, np.tile(getattr(take, side)[:, :3], 2))
        assert any(f"the {side} hand leads alone" in line for line in lines)
    write_streams(path, streams_of_one(side, take))
    for topics in (
        {other: PoseTopic(f"cell/hands/{side}")},
        dict.fromkeys(("left", "right"), PoseTopic(f"cell/hands/{side}")),
    ):
        assert read_demonstration(path, topics=topics).conducts == side
    skill = learn(
        [
            read_demonstration(write_streams(path, streams_of_one(side, circling(i))))
            for i in range(3)
        ],
        points=60,
    )
    assert skill.conductor == ("left", "right").index(side)


def test_one_stream_for_both_hands_is_refused(tmp_path: Path) -> None:
    """The stream's name does not say which hand it is."""
    streams = streams_of(circling(0))
    path = write_streams(tmp_path / "a.mcap", {"left": streams["left"], "tool": streams["tool"]})
    topics = dict.fromkeys(("left", "right"), PoseTopic("cell/tool/pose"))
    with pytest.raises(
        RecordingError, match=r"cell/tool/pose is given as left and as right; another topic needed"
    ):
        read_demonstration(path, topics=topics)


def served(
    skill: StoredSkill,
    other_from: int,
    other_to: int,
    one_to: int = 10_000,
    *,
    count: int = 1200,
    at: Point = FAR,
) -> Records:
    """The frame of each tick; the other hand is seen in [other_from, other_to), the conducting one
    until `one_to`.
    """
    side, other = ("left", "right") if skill.conductor == 0 else ("right", "left")
    ticks = []
    for k in range(count):
        events = [hand(side, AT, k + 1)] if k % 5 == 0 and k < one_to else []
        events += [hand(other, at, k + 1)] if k % 5 == 0 and other_from <= k < other_to else []
        ticks.append(Tick(k, tuple(events)))
    return followed(skill, ticks)


def modes(
    skill: StoredSkill, *hands: int, one_to: int = 10_000, count: int = 1200
) -> list[tuple[int, int]]:
    """Mode and reason in each frame of `served`."""
    records = served(skill, *hands, one_to, count=count)
    return list(zip(records["mode"].tolist(), records["reason"].tolist(), strict=True))


def test_served_without_absent_hand(skill: StoredSkill) -> None:
    """A skill runs without the other hand if it was never seen or disappeared 5 s ago, and holds
    before that.
    """
    follow = (Mode.FOLLOW, Reason.NONE)
    assert set(modes(skill, 0, 0)[5:]) == {follow}
    lost = modes(skill, 300, 600, count=3200)
    assert set(lost[10:840]) == {follow}  # also while both hands are seen
    assert set(lost[860:3090]) == {(Mode.HOLD, Reason.STALE_HAND)}
    assert set(lost[3100:]) == {follow}  # 5 s after the other hand was last seen
    vanished = modes(skill, 300, 600, one_to=3150, count=3300)
    assert set(vanished[3210:]) == {(Mode.HOLD, Reason.STALE_HAND)}
    assert set(modes(skill, 0, 0, one_to=600)[660:]) == {(Mode.HOLD, Reason.STALE_HAND)}
    assert set(modes(skill, 0, 1200, one_to=0)) == {(Mode.HOLD, Reason.NO_HANDS)}


def test_arm_keeps_away_from_vanished_hand(skill: StoredSkill) -> None:
    """The arm keeps its distance from where a lost hand was last seen."""
    goal_m = (0.5, 0.21, 0.4)  # the tool's target
    records = served(skill, 0, 50, count=3500, at=goal_m)
    assert set(records["mode"][2600:].tolist()) == {Mode.FOLLOW}
    assert records["hand_distance"].min() > ASSUMED.people.distance - 0.001
    free = served(skill, 0, 0, count=3500)
    near, away = (np.linalg.norm(run["tool"][-1] - goal_m) for run in (free, records))
    assert near < 0.03
    assert away > 0.05
