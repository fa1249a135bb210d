"""Engaging: after a start, a hold or a fault, the tool approaches its target slowly, once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as example_settings
from hypothesis import strategies as st

from support.arm_geometry import ArmGeometry
from support.followed import changed, followed
from support.in_process import ASSUMED, LEFT, RIGHT, Loop, assert_limits_hold, clutch, led, ticks_of
from support.setpoints import MIDDLE, PERIOD_S, at_rest, driven
from thirdhand.contract.records import Flag, Mode, Reason
from thirdhand.core.frame import Event, Tick, Vector, order
from thirdhand.core.skill.skill import Skill
from thirdhand.core.tuning import TUNING
from thirdhand.settings.config import (
    Settings,
    SettingsError,
    ToolSettings,
    parse,
    robot_description,
)
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

BRIEF_HOLD_S = TUNING.intake.tracker_memory_s
ENGAGED_GAP_M = 2.0 * TUNING.decision.stuck_gap_m


E = 0.15  # [m/s]
LOOP_HZ = (100, 250, 500, 1000)
TOOL_RISE_MPS = 0.1  # the tool may be faster than its slow setpoint, as in a stop
RAISED = np.array(((0.75, -0.30, 0.25), RIGHT))  # the left hand has left its start
RESUMED = 600  # tick in which the hands of the script move
inside = st.tuples(st.floats(0.2, 1.0), st.floats(-0.6, 0.6), st.floats(0.05, 0.8))
wild = st.tuples(*(st.floats(-1e3, 1e3),) * 3)


def cell(
    base: Settings = ASSUMED, rate_hz: int = 500, engage_speed: float = E, **hands: Any
) -> Settings:
    return changed(base, rate_hz=rate_hz, tool={"engage_speed": engage_speed}, hands=hands)


def resumed(script: HandScript) -> Iterator[Tick]:
    """Ticks of the script in which the arm is held until the hands move."""
    orders = {0: order("hold"), RESUMED: order("resume")}
    for tick in ticks_of(script, wait_s=0.0):
        yield Tick(
            tick.index, (*tick.inbox, *([orders[tick.index]] if tick.index in orders else []))
        )


def engages(seen: np.ndarray) -> np.ndarray:
    return (seen["flags"] & Flag.ENGAGING) > 0


@pytest.fixture(scope="module")
def reached(taught: Skill) -> tuple[Vector, Vector]:
    """Positions of both hands (K, 2, 3) along the task, and of the tool's target (K, 3)."""
    script = HandScript(Scene(), seed=0)
    hands = np.array([script.sample(t) for t in np.linspace(0.0, script.duration_s, 300)])[:, :, :3]
    return hands, np.array([taught.mean(pair.reshape(1, 6))[0] for pair in hands])


@pytest.mark.parametrize("rate_hz", LOOP_HZ)
@pytest.mark.parametrize("apart_m", [0.1, 0.3, 0.6])
@pytest.mark.one_case
def test_tool_engages_slowly_after_a_hold(
    taught: Skill, reached: tuple[Vector, Vector], rate_hz: int, apart_m: float
) -> None:
    """The hands have moved during the hold."""
    hands, targets = reached
    between = np.linalg.norm(targets[:, None] - targets, axis=2)
    before, after = np.unravel_index(np.abs(between - apart_m).argmin(), between.shape)
    start_s = 0.0
    hold_s = 5.5
    resume_s = 6.5
    end_s = 12.5
    orders = {round(hold_s * rate_hz): order("hold"), round(resume_s * rate_hz): order("resume")}
    moved = round((hold_s + 0.5) * rate_hz)
    path = (hands[before] if k < moved else hands[after] for k in range(round(end_s * rate_hz)))
    settings = cell(rate_hz=rate_hz)
    ticks = led(path, lambda k: (orders[k],) if k in orders else (), every=rate_hz // 100)
    frames = followed(taught, ticks, settings)
    slow = engages(frames)
    geometry = ArmGeometry(settings, robot_description(settings))
    speed = geometry.tool_speeds(frames["joints"], frames["joint_velocities"])
    assert np.linalg.norm(frames["setpoint_velocity"][slow], axis=1).max() <= E
    assert speed[slow].max() <= E + TOOL_RISE_MPS
    for begin_s in (start_s, resume_s):
        begin = round(begin_s * rate_hz)
        first = begin + int(np.argmax(frames["mode"][begin:] == Mode.FOLLOW))
        lasts = int(np.argmin(slow[first:]))
        gap = float(np.linalg.norm(frames["target"][first] - frames["tool"][first]))
        assert lasts / rate_hz <= 0.4 + max(gap - ENGAGED_GAP_M, 0.0) / (0.95 * E)
        assert not slow[
            first + lasts : round(hold_s * rate_hz) if begin_s == start_s else None
        ].any(), "engaged once"
    assert np.linalg.norm(frames["tool"][-1] - frames["target"][-1]) < 0.005


@pytest.mark.parametrize(
    ("unseen_s", "orders", "anew"),
    [
        (0.3, {}, False),
        (BRIEF_HOLD_S, {}, False),
        (BRIEF_HOLD_S + 0.3, {}, True),
        (0.3, {0.2: "hold", 0.25: "resume"}, True),
        (0.3, {0.2: "fault", 0.25: "reset"}, True),
    ],
)
@pytest.mark.one_case
def test_brief_hold_by_hands_does_not_engage(
    taught: Skill, unseen_s: float, orders: dict[float, str], anew: bool
) -> None:
    """Unseen hands cause a hold after 0.1 s. They have moved when they are seen again."""
    loop = Loop(cell(Settings()), taught)
    loop.hands = lambda k: RAISED
    assert not engages(loop.run(3000))[-1]
    loop.hands = None
    unseen = loop.run(
        round(unseen_s / PERIOD_S), {round(s / PERIOD_S): order(name) for s, name in orders.items()}
    )
    assert unseen["mode"][-1] != Mode.FOLLOW
    loop.hands = lambda k: np.array((LEFT, RIGHT))
    frames = loop.run(1000)
    begins = int(np.argmax(frames["mode"] == Mode.FOLLOW))
    assert frames["mode"][begins] == Mode.FOLLOW
    assert engages(frames)[begins + 1] == anew
    speed = np.linalg.norm(frames["setpoint_velocity"], axis=1)
    assert speed[engages(frames)].max() <= E if anew else speed.max() > 2 * E
    assert_limits_hold(loop.frames, cell(Settings()))


def test_a_brief_hold_does_not_end_engaging(taught: Skill) -> None:
    loop = Loop(cell(Settings(), engage_speed=0.02), taught)
    loop.hands = lambda k: RAISED
    assert engages(loop.run(1000))[-1]
    moving = loop.hands
    loop.hands = None
    assert loop.run(150)["mode"][-1] == Mode.HOLD
    loop.hands = moving
    frames = loop.run(500)
    assert frames["mode"][-1] == Mode.FOLLOW
    assert engages(frames)[-1]


@pytest.mark.parametrize("rate_hz", LOOP_HZ)
@pytest.mark.parametrize("what", ["resume", "clutch"])
def test_storms_of_holds_break_no_limit(taught: Skill, rate_hz: int, what: str) -> None:
    """Holds begin at random and last from one tick to a third of a second, while the hands move."""
    random = np.random.default_rng(rate_hz)
    count = 3 * rate_hz
    lengths = np.maximum(1, (rate_hz * 10 ** random.uniform(-3, -0.5, count)).astype(int))
    is_on = np.repeat(np.arange(count) % 2 == 0, lengths)[:count]
    messages: Callable[[int], tuple[Event, ...]] = {
        "resume": lambda k: (order("resume" if is_on[k] else "hold"),),
        "clutch": lambda k: (clutch(bool(is_on[k])),),
    }[what]
    times = np.arange(count)[:, None, None] / rate_hz
    path = np.array(((0.75, -0.3, 0.25), (0.75, 0.3, 0.2))) + 0.15 * np.sin(
        2 * np.pi * random.uniform(0.3, 0.8, (1, 2, 3)) * times
    )
    settings = cell(rate_hz=rate_hz, **({"clutch": "key"} if what == "clutch" else {}))
    frames = followed(taught, led(path, messages, every=max(1, rate_hz // 100)), settings)
    assert not (frames["mode"] == Mode.FAULT).any()
    held = frames["reason"] == {"resume": Reason.OPERATOR, "clutch": Reason.CLUTCH}[what]
    assert np.array_equal(held, ~is_on)
    speed = np.linalg.norm(frames["setpoint_velocity"], axis=1)
    slow = engages(frames)
    follows = (frames["mode"] == Mode.FOLLOW)[:-1] & slow[1:]
    assert (speed[1:] <= np.maximum(E, speed[:-1]) + 1e-9)[follows].all()


@example_settings(max_examples=40, deadline=None, derandomize=True)
@given(
    st.lists(st.tuples(inside, wild, wild), min_size=1, max_size=15),
    st.integers(20, 200),
    st.floats(0.0, 0.75),
    st.sampled_from([0.01, 0.05, 0.15, 0.4]),
)
def test_engaging_setpoint_keeps_its_bounds(
    told: list[tuple[tuple[float, ...], ...]], ticks: int, speed: float, engage_speed: float
) -> None:
    """The setpoint starts at any speed, with any target; `driven` asserts the bounds of every
    step.
    """
    tool = ToolSettings(engage_speed=engage_speed)
    start = np.array([MIDDLE, (speed, 0.0, 0.0), (0.0, 0.0, 0.0)])
    targets = [np.array(target) for target in told for _ in range(ticks)] + [
        at_rest(told[-1][0])
    ] * 10
    states, _ = driven(targets, start=start, tool=tool)
    speeds = np.linalg.norm(states[:, 1], axis=1)
    near = (
        np.linalg.norm(states[:-1, 0] - [target[0] for target in targets], axis=1) < ENGAGED_GAP_M
    )
    end = int(np.argmax(near)) if near.any() else len(near)
    assert (speeds[1 : end + 1] <= np.maximum(speeds[:end], engage_speed) + 1e-9).all()


def test_turn_is_slowed_in_proportion(taught: Skill) -> None:
    """The tool's rotation is slowed in proportion to its translation."""
    ticks = [*resumed(HandScript(Scene(), seed=5))][: RESUMED + 1000]
    frames = followed(taught, ticks, cell(engage_speed=0.05))[RESUMED:]
    assert engages(frames).all()
    turning = np.linalg.norm(frames["setpoint_turning"], axis=1)
    assert turning.max() <= 0.05 / ASSUMED.tool.max_speed * ASSUMED.tool.max_turn_speed


def test_without_engage_speed_nothing_engages(taught: Skill) -> None:
    ticks = list(ticks_of(HandScript(Scene(), seed=3), wait_s=0.2))[:800]
    disabled, full = (followed(taught, ticks, cell(engage_speed=e)) for e in (0.0, 0.8))
    assert disabled.tobytes() == full.tobytes()
    assert not engages(disabled).any()


@pytest.mark.parametrize(
    ("text", "speed", "words"),
    [
        ("engage_speed = 0.1\nmax_speed = 0.1", 0.1, ""),
        ("max_speed = 0.1", 0.1, ""),
        (
            "engage_speed = 0.3\nmax_speed = 0.25",
            0.0,
            r"engage_speed: 0.3 given; at most .*max_speed = 0.25 accepted",
        ),
        ("engage_speed = -0.1", 0.0, "engage_speed"),
    ],
)
def test_engage_speed_is_at_most_tool_speed(text: str, speed: float, words: str) -> None:
    if words:
        with pytest.raises(SettingsError, match=words):
            parse(f"[tool]\n{text}", origin="cell.toml")
        return
    assert parse(f"[tool]\n{text}", origin="cell.toml").tool.engaging_speed == speed
