"""Intake: samples checked and mapped to frame `base`, ages in ticks, and a filter that knows a hand
between its samples.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from support.tracked import LEFT, RIGHT, STRAIGHT, Hands, follow
from support.wam import JOINT_NAMES
from thirdhand.contract.messages import PoseStamped
from thirdhand.contract.records import Cause
from thirdhand.core.geometry import rotation
from thirdhand.core.intake.far_away import too_far
from thirdhand.core.intake.stage import z_reversed
from thirdhand.settings.config import HandSettings, TrackerSettings

QUARTER_TURN = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))  # about z


# --- what a tracker says -------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("cm", 100.0), ("mm", 1000.0)])
def test_a_trackers_unit_becomes_metres(unit: str, scale: float) -> None:
    hands = Hands(HandSettings(unit=unit))  # type: ignore[arg-type]
    np.testing.assert_allclose(hands.hand(1, (0.5 * scale, -0.1 * scale, 0.2 * scale)), [0.5, -0.1, 0.2])


def test_a_turned_tracker_is_scaled_then_turned_then_moved() -> None:
    hands = Hands(HandSettings(unit="mm", base_from_tracker=(1.0, 2.0, 3.0, *QUARTER_TURN)))
    np.testing.assert_allclose(hands.hand(1, (100.0, 20.0, 3.0)), [1.0 - 0.02, 2.0 + 0.1, 3.0 + 0.003])


def test_left_handed_axes_become_right_handed_by_their_z_before_all_else() -> None:
    mapping = (1.0, 2.0, 3.0, *QUARTER_TURN)
    hands = Hands(HandSettings(unit="mm", axes="left-handed", base_from_tracker=mapping))
    np.testing.assert_allclose(hands.hand(1, (100.0, 20.0, 3.0)), [1.0 - 0.02, 2.0 + 0.1, 3.0 - 0.003])
    mirrored = np.diag([1.0, 1.0, -1.0])
    for turn in (QUARTER_TURN, (0.1, -0.5, 0.7, 0.5)):
        sample = z_reversed(PoseStamped(1, "unity", (0.1, 0.2, 0.3), turn))
        assert sample.position == (0.1, 0.2, -0.3)
        np.testing.assert_allclose(rotation(sample.orientation), mirrored @ rotation(turn) @ mirrored, atol=1e-15)
    own = Hands(HandSettings(frame="unity", axes="left-handed"))
    np.testing.assert_allclose(own.hand(1, (0.5, 0.1, 0.2)), [0.5, 0.1, 0.2])


def test_a_rotation_turns_as_its_quaternion_does() -> None:
    np.testing.assert_allclose(rotation(QUARTER_TURN), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    matrix = rotation((0.1, -0.4, 0.3, 0.8))
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation((-0.1, 0.4, -0.3, -0.8)), matrix)


@contextmanager
def only_counted(hands: Hands, cause: Cause) -> Iterator[None]:
    """Assert that a sample is counted as rejected and changes nothing else."""
    expected = hands.state.copy()
    expected["rejected"][cause] += 1
    yield
    assert hands.rejected() == {cause: 1}
    assert hands.state.tobytes() == expected.tobytes()


@pytest.mark.parametrize(
    ("position", "turn", "cause"),
    [
        ((math.nan, 0.0, 0.0), STRAIGHT, Cause.NOT_FINITE),
        ((0.0, math.inf, 0.0), STRAIGHT, Cause.NOT_FINITE),
        ((0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), Cause.NOT_FINITE),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), Cause.NOT_A_ROTATION),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.02), Cause.NOT_A_ROTATION),
        ((0.0, 0.0, 0.0), (1e308, 1e308, 1e308, 1e308), Cause.NOT_A_ROTATION),
        ((500.0, 100.0, 200.0), STRAIGHT, Cause.OUT_OF_RANGE),
        ((1e308, 1e308, 1e308), STRAIGHT, Cause.OUT_OF_RANGE),
    ],
)
def test_a_useless_hand_sample_is_counted_and_changes_nothing_else(
    position: tuple[float, ...], turn: tuple[float, ...], cause: Cause
) -> None:
    hands = Hands()
    hands.hand(1)
    with only_counted(hands, cause):
        hands.hand(2, position, turn)


def test_a_quaternion_and_its_negative_are_the_same_rotation() -> None:
    hands = Hands()
    hands.hand(1, turn=(0.0, 0.0, 0.0, -1.0))
    assert hands.fresh()


TRACKERS = {
    "optitrack": TrackerSettings(unit="mm", base_from_tracker=(1.0, 2.0, 3.0, *QUARTER_TURN)),
    "vicon/world": TrackerSettings(),
}
MAPPED, IN_BASE = (0.5004, 0.0002, 0.0001), (0.4, 0.2, 0.1)
BY_ITS_TABLE = (1.0 - 0.0002, 2.0 + 0.0004, 3.0 + 0.0001)


@pytest.mark.parametrize(
    ("configured", "frame", "at"),
    [
        ("base", "base", MAPPED),
        ("base", "", MAPPED),
        ("", "base", MAPPED),
        ("", "", MAPPED),
        ("camera", "camera", MAPPED),
        ("camera", "", MAPPED),
        ("camera", "base", IN_BASE),  # not mapped again, as the tracker has a frame of its own
        ("camera", "optitrack", BY_ITS_TABLE),
        ("camera", "vicon/world", IN_BASE),
        ("camera", "headset", None),
        ("base", "camera", None),
        ("base", "Base", None),
        ("base", "base\0", None),
    ],
)
def test_a_hand_is_mapped_as_its_frame_is_configured_or_refused(
    configured: str, frame: str, at: tuple[float, ...] | None
) -> None:
    own = HandSettings(frame=configured, unit="mm", base_from_tracker=(0.5, 0.0, 0.0, *STRAIGHT))
    hands = Hands(own, trackers=TRACKERS)
    hands.intake.take_hand(hands.state, LEFT, PoseStamped(1, frame, (0.4, 0.2, 0.1), STRAIGHT))
    assert hands.fresh() == (at is not None)
    assert hands.rejected() == ({Cause.WRONG_FRAME: 1} if at is None else {})
    if at is not None:
        np.testing.assert_allclose(hands.state["hands"][LEFT, 0], at, atol=1e-12)


def test_what_is_rejected_is_counted_by_source_too() -> None:
    hands = Hands()
    hands.hand(1, (math.nan, 0.0, 0.0), side=RIGHT)
    hands.arm(1, names=("other",), position=(0.0,))
    hands.arm(2, position=(90.0,) * 7)
    counted = {(source, Cause(cause)) for source, cause in zip(*np.nonzero(hands.intake.rejected), strict=True)}
    assert counted == {(RIGHT, Cause.NOT_FINITE), (2, Cause.INCOMPLETE), (2, Cause.OUT_OF_RANGE)}
    np.testing.assert_array_equal(hands.intake.rejected.sum(axis=0), hands.state["rejected"])
    assert hands.intake.refused.keys() == {
        ("right", Cause.NOT_FINITE),
        ("arm", Cause.INCOMPLETE),
        ("arm", Cause.OUT_OF_RANGE),
    }


# --- stamps and ages -----------------------------------------------------------------------------


def test_repeated_and_older_stamps_are_counted_apart() -> None:
    hands = Hands()
    for stamp in (200_000_000, 200_000_000, 99_999_999, 100_000_000, 100_000_000):
        hands.hand(stamp)
        hands.advance()
    assert hands.rejected() == {Cause.REPEATED: 2, Cause.OLDER: 1}
    assert int(hands.state["hand_ticks"][LEFT]) == 0


def test_hands_do_not_share_stamps() -> None:
    hands = Hands()
    hands.hand(1000, side=LEFT)
    hands.hand(1000, side=RIGHT)
    assert hands.fresh(LEFT)
    assert hands.fresh(RIGHT)


@pytest.mark.parametrize(
    ("rate_hz", "stale_ms", "ticks"),
    [
        (500, 100.0, 50),
        (1000, 100.0, 100),
        (140, 100.0, 14),
        (500, 99.0, 50),
        (50, 1.0, 1),
    ],
)
def test_a_hand_is_stale_after_exactly_the_configured_time(rate_hz: int, stale_ms: float, ticks: int) -> None:
    hands = Hands(HandSettings(stale_ms=stale_ms), rate_hz=rate_hz)
    hands.hand(1)
    assert hands.fresh()
    hands.advance(ticks - 1)
    assert hands.fresh()
    hands.advance()
    assert not hands.fresh()


@pytest.mark.parametrize(("stale_max_ms", "most"), [(0.0, 50), (200.0, 100)])
def test_a_hand_becomes_stale_later_while_its_samples_come_in_bursts(stale_max_ms: float, most: int) -> None:
    """The link is blocked again and again, for 0 to 150 ms."""
    hands, random = Hands(HandSettings(stale_max_ms=stale_max_ms)), np.random.default_rng(8)
    arrivals: dict[int, list[int]] = {}
    blocked_until, limits, stale = 0, [], 0
    for k in range(0, 3000, 5):
        while blocked_until < k:
            blocked_until += 1 + int(random.uniform(0.0, 75.0))
        arrivals.setdefault(blocked_until if k > 250 else k, []).append(k)
    for tick in range(3000):
        for k in arrivals.get(tick, []):
            hands.hand(1_000_000_000 + k * 2_000_000)
        limits.append(int(hands.state["stale_ticks"][LEFT]))
        stale += tick > 1500 and hands.state["tick"] - hands.state["hand_ticks"][LEFT] >= limits[-1]
        hands.advance()
    assert limits[0] == 50
    assert 50 <= min(limits) <= max(limits) <= most
    assert (stale == 0) == (stale_max_ms > 0.0)


def test_a_repeated_sample_does_not_keep_a_hand_fresh() -> None:
    hands = Hands()
    for _ in range(51):
        hands.hand(1000)
        hands.advance()
    assert not hands.fresh()
    hands.hand(1000)
    assert not hands.fresh()


def test_a_clock_set_back_locks_a_hand_out_until_it_is_stale_only() -> None:
    hands = Hands()
    hands.hand(5_000_000_000)
    for stamp in range(49):
        hands.advance()
        hands.hand(stamp + 1)
    assert hands.rejected() == {Cause.OLDER: 49}
    hands.advance()
    np.testing.assert_array_equal(hands.hand(50, (0.6, 0.0, 0.0)), [0.6, 0.0, 0.0])
    assert hands.fresh()
    hands.hand(51, (0.6, 0.0, 0.0))
    assert hands.rejected() == {Cause.OLDER: 49}


@pytest.mark.parametrize("ahead_ns", [110_000_000, 10**9, 3600 * 10**9, 2**62, 2**63 - 1])
def test_a_stamp_from_the_future_is_refused_and_locks_no_source_out(ahead_ns: int) -> None:
    hands = Hands()
    hands.hand(0, side=RIGHT)  # repeated: the same as none
    for tick in range(1, 60):
        hands.hand(tick)
        hands.arm(tick)
        if tick == 5:
            hands.hand(ahead_ns)
            hands.arm(ahead_ns)
        hands.advance()
    assert hands.rejected() == {Cause.REPEATED: 1, Cause.AHEAD: 2}
    assert hands.fresh()
    assert hands.heard()


def test_a_stamp_may_be_ahead_by_the_time_that_passed_and_the_time_to_silence() -> None:
    hands = Hands()
    hands.hand(1)
    hands.advance(30)
    hands.hand(1 + 160_000_000)
    hands.advance(10)
    hands.hand(1 + 160_000_000 + 120_000_001)
    assert hands.rejected() == {Cause.AHEAD: 1}


@pytest.mark.parametrize("first", [-(2**63), -1, 1, 2**63 - 1])
def test_stamps_at_the_ends_of_their_numbers_are_compared_without_overflow(first: int) -> None:
    hands = Hands()
    hands.hand(first)
    hands.arm(first)
    for other in (-(2**63), 2**63 - 1, 0):
        hands.hand(other)
        hands.arm(other)
    assert hands.state["hand_stamps_ns"][LEFT] in {first, 0}
    hands.advance(50)
    hands.hand(7)
    hands.arm(7)
    assert hands.fresh()
    assert hands.heard()


def test_a_stale_hand_stands_still_and_starts_anew() -> None:
    hands = Hands()
    follow(hands, lambda t: np.array([0.5 * t, 0.0, 0.0]), until_s=0.5)
    hands.advance(250)
    where = hands.state["hands"][LEFT].copy()
    assert not where[1:].any()
    hands.advance(100)
    np.testing.assert_array_equal(hands.state["hands"][LEFT], where)
    np.testing.assert_allclose(hands.hand(10**10, (0.1, 0.2, 0.3)), [0.1, 0.2, 0.3], rtol=1e-14)
    assert not hands.state["hands"][LEFT, 1:].any()


# --- the arm -------------------------------------------------------------------------------------


def test_joints_are_taken_in_any_order_among_others() -> None:
    hands = Hands()
    values = {name: 0.1 * i for i, name in enumerate(JOINT_NAMES)} | {"gripper": 3.0}
    for stamp, names in ((1, tuple(values)), (2, tuple(reversed(values))), (3, tuple(sorted(values)))):
        hands.arm(stamp, names, tuple(values[name] for name in names), tuple(2 * values[name] for name in names))
        np.testing.assert_allclose(hands.state["measured"], 0.1 * np.arange(7))
        np.testing.assert_allclose(hands.state["measured_velocities"], 0.2 * np.arange(7))
    assert hands.rejected() == {}


def test_joints_without_velocities_stand_still() -> None:
    hands = Hands()
    hands.arm(1, velocity=(1.0,) * 7)
    hands.arm(2)
    assert not hands.state["measured_velocities"].any()


@pytest.mark.parametrize(
    ("names", "position", "velocity", "cause"),
    [
        (JOINT_NAMES[:6], (0.1,) * 6, (), Cause.INCOMPLETE),
        ((), (), (), Cause.INCOMPLETE),
        (JOINT_NAMES, (0.1,) * 6, (), Cause.INCOMPLETE),
        (JOINT_NAMES, (math.nan,) + (0.1,) * 6, (), Cause.NOT_FINITE),
        (JOINT_NAMES, (0.1,) * 7, (math.inf,) * 7, Cause.NOT_FINITE),
        (JOINT_NAMES, (7.0,) * 7, (), Cause.OUT_OF_RANGE),
        (JOINT_NAMES, (2.81,) + (0.1,) * 6, (), Cause.OUT_OF_RANGE),  # 0.21 outside
        (JOINT_NAMES, (5e-324,) * 7, (-1e308,) * 7, Cause.OUT_OF_RANGE),
        (JOINT_NAMES, (0.1,) * 7, (101.0,) * 7, Cause.OUT_OF_RANGE),
    ],
)
def test_a_useless_arm_sample_is_counted_and_changes_nothing_else(
    names: tuple[str, ...], position: tuple[float, ...], velocity: tuple[float, ...], cause: Cause
) -> None:
    hands = Hands()
    hands.arm(1)
    with only_counted(hands, cause):
        hands.arm(2, names, position, velocity)


def test_an_arm_is_silent_after_exactly_the_configured_time_and_heard_again_with_any_stamp() -> None:
    hands = Hands()
    assert not hands.heard()
    hands.arm(1000)
    hands.advance(49)
    hands.arm(999)
    hands.arm(1000)
    assert hands.rejected() == {Cause.OLDER: 1, Cause.REPEATED: 1}
    assert hands.heard()
    hands.advance()
    assert not hands.heard()
    hands.arm(5)
    assert hands.heard()


# --- positions that are too far away: the unit that was meant ---


@pytest.mark.parametrize(
    ("position", "unit"), [((98.0, -32.0, 6.0), "cm"), ((980.0, -320.0, 60.0), "mm"), ((40.0, 30.0, 20.0), "cm")]
)
def test_the_unit_that_fits_best_is_named(position: tuple[float, ...], unit: str) -> None:
    assert f"which looks like {unit};" in too_far(position, "m")


def test_no_unit_is_named_where_none_fits() -> None:
    assert "looks like" not in too_far((1e6, 0.0, 0.0), "m")
