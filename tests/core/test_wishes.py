"""Wishes: the tool follows what a policy wants, in chunks or pose by pose, and holds for a reason
that is said.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from support.bounds import broken
from support.drawn_cells import ARMS
from support.drawn_policy import wish
from support.drawn_session import play
from support.in_process import ASSUMED, clutch, seen
from thirdhand.contract.records import Cause, Flag, Mode, Reason
from thirdhand.core.controller import Controller, start_state
from thirdhand.core.frame import Event, Frame, Tick, Vector
from thirdhand.recordings.recording import Recorder
from thirdhand.recordings.replay import replay
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings, SkillSettings, TrackerSettings, robot_description
from thirdhand.skills.no_skill import no_skill

START_NS = 10**18
LED = msgspec.structs.replace(ASSUMED, skill=SkillSettings(source="tool/wish"))
BLENDED = msgspec.structs.replace(ASSUMED, skill=SkillSettings(source="tool/wish", blend=True))
AWAY_M = np.array([0.0, 0.1, 0.05])


class Policy:
    """A cell whose tool wishes lead, tick by tick."""

    def __init__(self, cell: Settings = LED) -> None:
        self.cell = cell
        self.skill = shipped_skill() if cell.skill.blend else no_skill()
        self.controller = Controller(cell, self.skill, urdf=robot_description(cell))
        self.steps: list[tuple[Tick, Frame]] = []
        first = self.run(1)[0]
        self.start = first["tool"].copy()
        self.turn = first["tool_orientation"].copy()

    @property
    def now_ns(self) -> int:
        """The time of the next tick."""
        return START_NS + round(1e9 * self.cell.period_s) * len(self.steps)

    def pose(self, off: Vector, after_s: float = 0.0) -> Event:
        """A wish for the start's pose, moved by an offset (3,) [m]."""
        return wish(self.start + off, self.turn, self.now_ns + round(1e9 * after_s))

    def run(self, ticks: int, *events: Event) -> np.ndarray:
        """The frames of further ticks; events come in the first of them."""
        for k in range(ticks):
            tick = Tick(len(self.steps), events if k == 0 else (), self.now_ns)
            self.steps.append((tick, self.controller.step(tick)))
        return np.array([frame for _, frame in self.steps[-ticks:]])

    def lead(self, off: Vector, seconds: float) -> np.ndarray:
        """The frames while the same pose is wished 50 times a second."""
        return np.concatenate([self.run(10, self.pose(off)) for _ in range(round(50 * seconds))])


def test_tool_follows_chunks_that_come_late() -> None:
    policy = Policy()
    policy.lead(0.0 * AWAY_M, 1.0)

    def meant(time_s: Vector) -> Vector:
        return np.outer(np.sin(2.0 * time_s), AWAY_M)

    frames = []
    for _ in range(20):
        begun_s = 0.002 * len(policy.steps)
        steps_s = np.arange(20) / 30
        answered = zip(steps_s, meant(begun_s + steps_s), strict=True)
        chunk = [policy.pose(off, after_s) for after_s, off in answered]
        frames += [policy.run(100), policy.run(100, *chunk)]  # 0.2 s later
    tool = np.concatenate(frames)[1000:]
    times_s = 0.002 * tool["tick"]
    errors = np.linalg.norm(tool["tool"] - policy.start - meant(times_s), axis=1)
    assert (tool["mode"] == Mode.FOLLOW).all()
    assert errors.max() < 2e-3
    assert np.abs(np.diff(tool["target_velocity"], axis=0)).max() / 0.002 < 1.0  # [m/s²]


def test_chunks_that_disagree_are_joined_without_a_step() -> None:
    """Each answer is 5 cm beside the one before."""
    policy = Policy()
    policy.lead(0.0 * AWAY_M, 1.0)
    frames = []
    for number in range(12):
        off = np.array([0.0, 0.05 * (number % 2), 0.0])
        chunk = [policy.pose(off, k / 30) for k in range(15)]
        frames.append(policy.run(150, *chunk))
    seam = np.concatenate(frames)
    assert np.abs(np.diff(seam["target"], axis=0)).max() < 2e-3
    assert np.abs(np.diff(seam["target_velocity"], axis=0)).max() < 0.05


def test_a_shorter_answer_leaves_the_rest_of_the_one_before() -> None:
    policy = Policy()
    policy.lead(0.0 * AWAY_M, 1.0)
    policy.run(50, *(policy.pose(AWAY_M * k / 30, k / 30) for k in range(30)))
    policy.run(400, *(policy.pose(AWAY_M * (k + 3) / 30, k / 30) for k in range(4)))
    np.testing.assert_allclose(policy.steps[-1][1]["target"], policy.start + AWAY_M, atol=0.02)


def test_a_chunk_that_ends_in_motion_ends_in_a_stop() -> None:
    policy = Policy()
    policy.lead(0.0 * AWAY_M, 1.0)
    chunk = [policy.pose(np.array([0.0, 0.2 * k / 30, 0.0]), k / 30) for k in range(15)]
    frames = policy.run(450, *chunk)
    speed = frames["target_velocity"][:, 1]
    assert speed[200] == pytest.approx(0.2, abs=0.01)
    assert speed[-1] == pytest.approx(0.0, abs=1e-3)
    assert np.abs(np.diff(speed)).max() / 0.002 < 5.0


def test_single_poses_are_followed_smoothly() -> None:
    """A headset's controller: 90 Hz, noise of 1 mm, no chunks."""
    random = np.random.default_rng(0)
    policy = Policy()
    policy.lead(0.0 * AWAY_M, 1.0)
    frames = []
    for k in range(500):
        off = AWAY_M * np.sin(0.02 * k) + random.normal(0.0, 1e-3, 3)
        frames.append(policy.run(5 if k % 2 else 6, policy.pose(off)))
    tool = np.concatenate(frames)[500:]
    truth = np.concatenate(
        [np.tile(AWAY_M * np.sin(0.02 * k), (5 if k % 2 else 6, 1)) for k in range(500)]
    )
    errors = np.linalg.norm(tool["tool"] - policy.start - truth[500:], axis=1)
    assert np.sqrt(np.mean(errors**2)) < 5e-3
    jerk = np.diff(tool["tool"], n=3, axis=0) / 0.002**3
    assert np.sqrt((jerk**2).sum(axis=1).mean()) < 60.0


@pytest.mark.parametrize("rate_hz", [50, 100, 500])
@pytest.mark.parametrize("every", [1, 2])
def test_a_wish_in_each_tick_is_followed(rate_hz: int, every: int) -> None:
    """From rest, and to a stop from full motion."""
    policy = Policy(msgspec.structs.replace(LED, rate_hz=rate_hz))
    for _ in range(rate_hz // every):
        policy.run(every, policy.pose(0.0 * AWAY_M))
    frames = []
    for k in range(3 * rate_hz // every):
        off = AWAY_M * np.sin(1.5 * k * every / rate_hz)
        frames.append(policy.run(every, policy.pose(off)))
    tool = np.concatenate(frames)
    seconds = np.arange(len(tool)) // every * every / rate_hz
    errors = np.linalg.norm(
        tool["tool"] - policy.start - np.outer(np.sin(1.5 * seconds), AWAY_M), axis=1
    )
    assert np.sqrt(np.mean(errors[rate_hz:] ** 2)) < 8e-3

    stopped = tool["tool"][-1] - policy.start
    for _ in range(rate_hz // every):
        rest = policy.run(every, policy.pose(stopped))
    assert np.linalg.norm(rest["tool"][-1] - policy.start - stopped) < 2e-3


@pytest.mark.parametrize("step_s", [0.002, 0.008, 0.0101])
def test_a_fine_chunk_is_followed_along_its_path(step_s: float) -> None:
    policy = Policy()
    policy.lead(0.0 * AWAY_M, 1.0)
    times_s = np.arange(0.0, 0.9, step_s)
    policy.run(1, *(policy.pose(AWAY_M * np.sin(3.0 * t), t) for t in times_s))
    tool = policy.run(400)
    truth = np.outer(np.sin(3.0 * 0.002 * np.arange(1, 401)), AWAY_M)
    assert np.linalg.norm(tool["tool"] - policy.start - truth, axis=1)[300:].max() < 6e-3


def test_a_leap_within_a_chunk_holds_when_it_is_due() -> None:
    policy = Policy()
    policy.lead(0.0 * AWAY_M, 1.0)
    far = np.array([0.0, 0.4, 0.0])
    chunk = [policy.pose(far * (k >= 20), k / 30) for k in range(30)]
    frames = policy.run(2000, *chunk, *())
    reasons = frames["reason"].tolist()
    assert reasons[100] == Reason.NONE
    assert reasons[325] == Reason.JUMPED_WISH
    speed = np.linalg.norm(np.diff(frames["setpoint"], axis=0), axis=1) / 0.002
    assert speed.max() < LED.tool.engage_speed + 0.1


def test_arm_holds_without_a_wish_and_goes_on_with_the_next() -> None:
    policy = Policy()
    assert set(policy.run(100)["reason"]) == {Reason.NO_WISH}
    assert policy.lead(AWAY_M, 2.0)["mode"][-1] == Mode.FOLLOW
    silent = policy.run(700)
    assert (silent["mode"][480], silent["reason"][-1]) == (Mode.FOLLOW, Reason.STALE_WISH)
    assert policy.lead(AWAY_M, 0.5)["mode"][-1] == Mode.FOLLOW


def test_arm_holds_for_a_wish_that_jumps_then_goes_there_slowly() -> None:
    policy = Policy()
    policy.lead(0.0 * AWAY_M, 1.0)
    jumped = policy.lead(np.array([0.0, 0.4, 0.0]), 4.0)
    assert jumped["reason"][10] == Reason.JUMPED_WISH
    assert (jumped["mode"][260:] == Mode.FOLLOW).all()
    speeds = np.linalg.norm(np.diff(jumped["setpoint"], axis=0), axis=1) / 0.002
    speeds = speeds[jumped["flags"][1:] & Flag.ENGAGING > 0]
    assert speeds.max() < LED.tool.engage_speed + 0.01
    assert abs(jumped["tool"][-1, 1] - policy.start[1] - 0.4) < 1e-3


def test_arm_holds_while_the_wish_is_out_of_reach() -> None:
    policy = Policy()
    policy.lead(0.0 * AWAY_M, 1.0)
    for k in range(60):
        frames = policy.lead(np.array([0.0, -0.02 * k, 0.0]), 0.02)
    assert frames["reason"][-1] == Reason.UNREACHABLE_WISH
    for k in range(60, 0, -1):
        frames = policy.lead(np.array([0.0, -0.02 * k, 0.0]), 0.02)
    assert policy.lead(0.0 * AWAY_M, 2.0)["mode"][-1] == Mode.FOLLOW


def test_clutch_and_holds_are_those_of_every_cell() -> None:
    hands = msgspec.structs.replace(LED.hands, clutch="key")
    policy = Policy(msgspec.structs.replace(LED, hands=hands))
    assert policy.lead(AWAY_M, 0.2)["reason"][-1] == Reason.CLUTCH
    policy.run(1, clutch(True))
    assert policy.lead(AWAY_M, 0.2)["mode"][-1] == Mode.FOLLOW


def test_arm_keeps_away_from_hands_wherever_wishes_lead() -> None:
    policy = Policy()
    policy.lead(0.0 * AWAY_M, 1.0)
    beside = policy.start + np.array([[0.3, 0.15, 0.0], [0.3, -0.6, 0.0]])
    flags = 0
    for k in range(100):
        toward = policy.pose(np.array([0.0, 0.15, 0.0]))
        frames = policy.run(10, *seen(beside, k), toward)
        flags |= int(np.bitwise_or.reduce(frames["flags"]))
    assert flags & Flag.SEPARATION
    assert np.linalg.norm(frames["tool"][-1] - beside[0]) > 0.1


WRONG = {
    "not a number": (Cause.NOT_FINITE, {"off": (np.nan, 0.0, 0.0)}),
    "far away": (Cause.OUT_OF_RANGE, {"off": (1e6, 0.0, 0.0)}),
    "not a rotation": (Cause.NOT_A_ROTATION, {"turn": (0.0, 0.0, 0.0, 0.0)}),
    "from the past": (Cause.OLDER, {"after_s": -1.2}),
    "from the future": (Cause.AHEAD, {"after_s": 1.2}),
    "in another frame": (Cause.WRONG_FRAME, {"frame": "camera"}),
    "a huge variance": (Cause.NOT_FINITE, {"covariance": tuple((1e9 * np.eye(6)).ravel())}),
    "no covariance": (Cause.NOT_FINITE, {"covariance": tuple((3.0 - np.eye(6)).ravel())}),
    "a negative variance": (Cause.NOT_FINITE, {"covariance": tuple((-np.eye(6)).ravel())}),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_wish_is_counted_and_changes_nothing(name: str) -> None:
    cause, changed = WRONG[name]
    policies = Policy(), Policy()
    for policy in policies:
        policy.lead(AWAY_M, 1.0)
    good, bad = policies
    stamp_ns = bad.now_ns + round(1e9 * changed.get("after_s", 0.0))
    event = wish(
        bad.start + np.array(changed.get("off", (0.0, 0.0, 0.0))),
        np.array(changed.get("turn", bad.turn)),
        stamp_ns,
        frame=changed.get("frame", "base"),
        covariance=changed.get("covariance", ()),
    )
    frames = bad.run(100, event)
    assert (frames["target"] == good.run(100)["target"]).all()
    assert frames["rejected"][-1].nonzero()[0].tolist() == [cause]
    assert bad.controller.intake.refused["wish", cause].sample == event.value


def test_no_more_wishes_are_kept_than_there_is_room_for() -> None:
    policy = Policy()
    policy.run(10, *(policy.pose(AWAY_M, 0.0081 * k) for k in range(129)))
    policy.run(10, *(policy.pose(AWAY_M, 0.0101 * k + 0.004) for k in range(104)))
    assert np.isfinite(policy.run(600)["tool"]).all()
    assert policy.controller.state["wish_count"] <= 128


def test_wishes_in_a_tracker_s_frame_are_mapped() -> None:
    """Millimetres, turned by a quarter about z."""
    half = 0.5**0.5
    tracker = TrackerSettings(unit="mm", base_from_tracker=(0.1, 0.2, 0.3, 0.0, 0.0, half, half))
    policy = Policy(msgspec.structs.replace(LED, trackers={"desk": tracker}))
    own = (policy.start - (0.1, 0.2, 0.3)) * 1000.0
    turned = np.array([own[1], -own[0], own[2]])
    covariance = np.diag([4.0, 1.0, 9.0, 0.04, 0.01, 0.09]).ravel()
    x, y, z, w = policy.turn
    rotation = (half * (x + y), half * (y - x), half * (z - w), half * (w + z))
    event = wish(
        turned, np.array(rotation), policy.now_ns, frame="desk", covariance=tuple(covariance)
    )
    frame = policy.run(1, event)[0]
    np.testing.assert_allclose(frame["target"], policy.start, atol=1e-9)
    np.testing.assert_allclose(np.abs(frame["orientation"] @ policy.turn), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.diag(frame["covariance"]), [1e-6, 4e-6, 9e-6], atol=1e-12)
    np.testing.assert_allclose(
        np.diag(frame["orientation_covariance"]), [0.01, 0.04, 0.09], atol=1e-12
    )


def test_skill_and_wishes_lead_together_by_their_covariances() -> None:
    policy = Policy(BLENDED)
    hands = policy.skill.hands[0].reshape(2, 3)
    for k in range(0, 1500, 5):
        policy.run(5, *seen(hands, START_NS + k))
    alone = policy.steps[-1][1]
    assert alone["mode"] == Mode.FOLLOW
    skill_m = alone["target"].copy()
    of_skill = alone["covariance"].copy()

    off = np.array([0.0, 0.04, 0.02])
    of_wish = np.zeros((6, 6))
    of_wish[:3, :3] = 2.0 * of_skill + 1e-4 * np.eye(3)
    of_wish[3:, 3:] = np.eye(3)
    frames = []
    for k in range(0, 1000, 5):
        event = wish(skill_m + off, policy.turn, policy.now_ns, covariance=tuple(of_wish.ravel()))
        frames.append(policy.run(5, *seen(hands, START_NS + 2000 + k), event))
    both = np.concatenate(frames)
    gain = of_skill @ np.linalg.inv(of_skill + of_wish[:3, :3])
    np.testing.assert_allclose(both["target"][-1], skill_m + gain @ off, atol=2e-5)
    np.testing.assert_allclose(
        both["covariance"][-1], of_skill - gain @ of_skill, rtol=0.01, atol=1e-9
    )
    assert (both["mode"] == Mode.FOLLOW).all()
    assert np.abs(np.diff(both["target"], axis=0)).max() < 1e-3  # no step where wishes begin

    ended = []
    for k in range(0, 1000, 5):
        ended.append(policy.run(5, *seen(hands, START_NS + 4000 + k)))
    after = np.concatenate(ended)
    np.testing.assert_allclose(after["target"][-1], skill_m, atol=1e-4)
    assert np.abs(np.diff(after["target"], axis=0)).max() < 1e-3


@pytest.mark.timeout(600)
@pytest.mark.parametrize("seed", [10, *range(12, 24)])
@pytest.mark.one_case
def test_bounds_hold_in_drawn_sessions_of_a_policy(seed: int) -> None:
    """Every bound of docs/bounds.md is kept for any wishes, and a session plays again."""
    skill = SkillSettings(source="tool/wish", blend=seed % 3 == 0, silent_ms=300.0)
    played = play(
        900 + seed,
        ARMS[seed % len(ARMS)],
        wild_ticks=1000,
        quiet_s=8.0,
        most_quiet_ticks=2700,
        skill=skill,
    )
    assert not broken(played.session)
    assert not played.replayed_otherwise


def test_a_session_replays_bit_for_bit(tmp_path: Path) -> None:
    """From its begin, and from a state within a chunk."""
    policy = Policy()
    state = start_state(LED, policy.skill)
    for k in range(20):
        chunk = [policy.pose(AWAY_M * np.sin(0.1 * (k + i)), i / 30) for i in range(12)]
        policy.run(61, *chunk)
    middle = 0
    again = Controller(LED, policy.skill, state, urdf=robot_description(LED))
    with Recorder(tmp_path / "a.mcap", settings=LED, skill=policy.skill.file, state=state) as out:
        for tick, frame in policy.steps:
            again.step(tick)
            kept = again.state if tick.index == 700 else None
            middle += kept is not None
            out.write(tick, frame, time_ns=tick.time_ns, state=kept)
    assert middle
    count = len(policy.steps)
    assert replay(tmp_path / "a.mcap").text() == f"{count} ticks, {count} frames identical"
    assert replay(tmp_path / "a.mcap", after=700).exact
