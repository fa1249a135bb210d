"""Intake: samples are checked and mapped to frame `base`, ages count in ticks, and a filter
estimates hands between their samples.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from support.tracked import LEFT, RIGHT, STRAIGHT, Hands
from support.wam import JOINT_NAMES
from thirdhand.contract.messages import PoseStamped
from thirdhand.contract.records import Cause
from thirdhand.core.geometry import rotation
from thirdhand.core.intake.stage import z_reversed
from thirdhand.settings.config import HandSettings, TrackerSettings

QUARTER_TURN = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))  # about z


# --- samples of a tracker -----------------------------------------------------------------------


def test_tracker_is_scaled_turned_and_moved() -> None:
    """A tracker's positions are scaled, then rotated, then translated."""
    hands = Hands(HandSettings(unit="mm", base_from_tracker=(1.0, 2.0, 3.0, *QUARTER_TURN)))
    np.testing.assert_allclose(
        hands.hand(1, (100.0, 20.0, 3.0)), [1.0 - 0.02, 2.0 + 0.1, 3.0 + 0.003]
    )


def test_left_handed_axes_are_mirrored() -> None:
    """Left-handed axes are mirrored along z before any other mapping."""
    mapping = (1.0, 2.0, 3.0, *QUARTER_TURN)
    hands = Hands(HandSettings(unit="mm", axes="left-handed", base_from_tracker=mapping))
    np.testing.assert_allclose(
        hands.hand(1, (100.0, 20.0, 3.0)), [1.0 - 0.02, 2.0 + 0.1, 3.0 - 0.003]
    )
    mirrored = np.diag([1.0, 1.0, -1.0])
    for turn in (QUARTER_TURN, (0.1, -0.5, 0.7, 0.5)):
        sample = z_reversed(PoseStamped(1, "unity", (0.1, 0.2, 0.3), turn))
        assert sample.position == (0.1, 0.2, -0.3)
        np.testing.assert_allclose(
            rotation(sample.orientation), mirrored @ rotation(turn) @ mirrored, atol=1e-15
        )
    unity_hands = Hands(HandSettings(frame="unity", axes="left-handed"))
    np.testing.assert_allclose(unity_hands.hand(1, (0.5, 0.1, 0.2)), [0.5, 0.1, 0.2])


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
def test_useless_hand_sample_is_only_counted(
    position: tuple[float, ...], turn: tuple[float, ...], cause: Cause
) -> None:
    hands = Hands()
    hands.hand(1)
    with only_counted(hands, cause):
        hands.hand(2, position, turn)


TRACKERS = {
    "optitrack": TrackerSettings(unit="mm", base_from_tracker=(1.0, 2.0, 3.0, *QUARTER_TURN)),
    "vicon/world": TrackerSettings(),
}
MAPPED = (0.5004, 0.0002, 0.0001)
IN_BASE = (0.4, 0.2, 0.1)
BY_ITS_TABLE = (1.0 - 0.0002, 2.0 + 0.0004, 3.0 + 0.0001)


@pytest.mark.parametrize(
    ("configured", "frame", "at"),
    [
        ("base", "base", MAPPED),
        ("", "base", MAPPED),
        ("camera", "camera", MAPPED),
        ("camera", "", MAPPED),
        ("camera", "base", IN_BASE),  # not mapped: the tracker's frame is another one
        ("camera", "optitrack", BY_ITS_TABLE),
        ("camera", "vicon/world", IN_BASE),
        ("camera", "headset", None),
        ("base", "Base", None),
        ("base", "base\0", None),
    ],
)
def test_frame_decides_the_mapping(
    configured: str, frame: str, at: tuple[float, ...] | None
) -> None:
    """A hand of a configured frame is mapped by its settings; others are refused."""
    settings = HandSettings(
        frame=configured, unit="mm", base_from_tracker=(0.5, 0.0, 0.0, *STRAIGHT)
    )
    hands = Hands(settings, trackers=TRACKERS)
    hands.intake.take_hand(hands.state, LEFT, PoseStamped(1, frame, (0.4, 0.2, 0.1), STRAIGHT))
    assert hands.fresh() == (at is not None)
    assert hands.rejected() == ({Cause.WRONG_FRAME: 1} if at is None else {})
    if at is not None:
        np.testing.assert_allclose(hands.state["hands"][LEFT, 0], at, atol=1e-12)


# --- stamps and ages -----------------------------------------------------------------------------


def test_repeated_and_older_are_counted_apart() -> None:
    hands = Hands()
    for stamp in (200_000_000, 200_000_000, 99_999_999, 100_000_000, 100_000_000):
        hands.hand(stamp)
        hands.advance()
    assert hands.rejected() == {Cause.REPEATED: 2, Cause.OLDER: 1}
    assert int(hands.state["hand_ticks"][LEFT]) == 0


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
def test_hand_is_stale_after_configured_time(rate_hz: int, stale_ms: float, ticks: int) -> None:
    hands = Hands(HandSettings(stale_ms=stale_ms), rate_hz=rate_hz)
    hands.hand(1)
    assert hands.fresh()
    hands.advance(ticks - 1)
    assert hands.fresh()
    hands.advance()
    assert not hands.fresh()


@pytest.mark.parametrize(("stale_max_ms", "most"), [(0.0, 50), (200.0, 100)])
def test_bursts_extend_the_stale_time(stale_max_ms: float, most: int) -> None:
    """The link is blocked again and again, for 0 to 150 ms each time."""
    hands = Hands(HandSettings(stale_max_ms=stale_max_ms))
    random = np.random.default_rng(8)
    arrivals: dict[int, list[int]] = {}
    blocked_until = 0
    limits = []
    stale = 0
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


def test_clock_set_back_locks_a_hand_out_until_stale_only() -> None:
    """The hand is accepted again once it is stale."""
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
def test_stamp_from_the_future_locks_no_source_out(ahead_ns: int) -> None:
    """The sample with a stamp from the future is refused."""
    hands = Hands()
    hands.hand(0, side=RIGHT)  # stamp 0 stands for no sample: repeated
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


def test_stamp_may_be_ahead_by_passed_time() -> None:
    """A stamp may be ahead by the elapsed time and the time-out."""
    hands = Hands()
    hands.hand(1)
    hands.advance(30)
    hands.hand(1 + 160_000_000)
    hands.advance(10)
    hands.hand(1 + 160_000_000 + 120_000_001)
    assert hands.rejected() == {Cause.AHEAD: 1}


@pytest.mark.parametrize("first", [-(2**63), -1, 1, 2**63 - 1])
def test_extreme_stamps_do_not_overflow(first: int) -> None:
    """Stamps at the ends of the int64 range are compared without overflow."""
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


# --- the arm -------------------------------------------------------------------------------------


def test_joints_are_taken_in_any_order() -> None:
    """Other joints may stand between them."""
    hands = Hands()
    values = {name: 0.1 * i for i, name in enumerate(JOINT_NAMES)} | {"gripper": 3.0}
    for stamp, names in (
        (1, tuple(values)),
        (2, tuple(reversed(values))),
        (3, tuple(sorted(values))),
    ):
        hands.arm(
            stamp,
            names,
            tuple(values[name] for name in names),
            tuple(2 * values[name] for name in names),
        )
        np.testing.assert_allclose(hands.state["measured"], 0.1 * np.arange(7))
        np.testing.assert_allclose(hands.state["measured_velocities"], 0.2 * np.arange(7))
    assert hands.rejected() == {}


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
def test_useless_arm_sample_is_only_counted(
    names: tuple[str, ...], position: tuple[float, ...], velocity: tuple[float, ...], cause: Cause
) -> None:
    hands = Hands()
    hands.arm(1)
    with only_counted(hands, cause):
        hands.arm(2, names, position, velocity)


def test_arm_is_silent_after_configured_time() -> None:
    """An arm counts as silent after exactly the configured time, and is accepted again with any
    stamp.
    """
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
