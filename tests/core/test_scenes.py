"""Scenes: an arm, a tracker and hands that move as people's do. `played` asserts what must hold in
every scene; each family of scenes asserts more.

`THIRDHAND_EXAMPLES=300 pytest tests/core/test_scenes.py` draws more of each family.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from dataclasses import replace as replaced
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as example_settings
from hypothesis import strategies as st
from msgspec.structs import replace
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from support.arms import MODELS, cell_of
from support.in_process import (
    ASSUMED,
    LEFT,
    RIGHT,
    assert_limits_hold,
    assert_replays,
    frames,
    led,
    seen,
    ticks_of,
)
from support.paths import RECORDINGS
from thirdhand.contract.records import Mode, Reason
from thirdhand.core.controller import Controller, start_state
from thirdhand.core.frame import Tick, Vector, order
from thirdhand.core.skill.skill import Skill
from thirdhand.core.tuning import TUNING
from thirdhand.recordings.shipped import cell_of as shipped
from thirdhand.settings.config import FOLLOWING, Settings, robot_description
from thirdhand.skills.skill_file import decoded
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript
from thirdhand_sim.teach import demonstrations

HAND_BRAKE_MPS2 = TUNING.setpoint.hand_brake_mps2


MANY = int(os.environ.get("THIRDHAND_EXAMPLES", "0"))
# docs/bounds.md: speed of the tool in a stop
RISE = 1.01
RISE_MPS = 0.01
AT_REST_RADPS2 = 0.02  # root mean square of each joint
PERIOD_S = ASSUMED.period_s
NOISE_M = 0.0005  # standard deviation of a tracker, each axis
COMES_S = 2.0  # the tool reaches its target within this time
KNOWN_S = 2.0  # the speed of a slow hand is estimated within this time
FAST = butter(4, 4.0, "highpass", fs=1.0 / PERIOD_S, output="sos")


def everywhere(skill: Skill) -> Skill:
    """The skill, followed however far hands are from what was demonstrated."""
    return replaced(skill, threshold=math.inf)


def stored(name: str) -> Skill:
    return everywhere(decoded((RECORDINGS / f"{name}.npz").read_bytes(), origin=name))


def played(
    cell: Settings, skill: Skill, ticks: Iterable[Tick], *, start: Vector | None = None
) -> np.ndarray:
    """The frames (T,) of a scene. Asserts that there is no fault, and that joints and tool keep
    their limits, in stops too.
    """
    state = start_state(cell, skill)
    if start is not None:
        state["joints"][0] = start
    trace = frames(Controller(cell, skill, state, urdf=robot_description(cell)), ticks)
    faults = trace["mode"] == Mode.FAULT
    assert not faults.any(), (
        f"tick {faults.argmax()}: {Reason(trace['reason'][faults.argmax()]).name}"
    )
    assert_limits_hold(trace, cell)
    speeds = np.linalg.norm(np.diff(trace["tool"], axis=0), axis=1) / cell.period_s
    assert speeds[trace["mode"][1:] == Mode.FOLLOW].max(initial=0.0) <= 1.001 * cell.tool.max_speed
    assert speeds.max() <= RISE * cell.tool.max_speed + RISE_MPS
    return trace


def changed(
    cell: Settings,
    *,
    rate_hz: int = 500,
    speed: float = 1.0,
    acceleration: float = 1.0,
    jerk: float = 1.0,
    **tool: object,
) -> Settings:
    """A cell with another tool and a share of the joints' speed, acceleration and jerk."""
    shares = {"velocity": speed, "acceleration": acceleration, "jerk": jerk}
    limits = {
        name: tuple(share * x for x in getattr(cell.joints, name)) for name, share in shares.items()
    }
    return replace(
        cell,
        rate_hz=rate_hz,
        tool=replace(cell.tool, **tool),
        joints=replace(cell.joints, **limits),
    )


def every(cell: Settings) -> int:
    """Ticks between the samples of a tracker at 100 Hz."""
    return max(1, round(0.01 * cell.rate_hz))


def smooth(u: Vector) -> Vector:
    """The share of its distance that a minimum-jerk reach has covered after a share of its time."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u * u))


# --- legal hands ---


@example_settings(max_examples=MANY or 20, deadline=None, derandomize=True)
@given(
    st.floats(0.1, 1.5),
    st.floats(0.0, 0.003),
    st.floats(30.0, 500.0),
    st.sampled_from([500, 250, 1000]),
    st.integers(0, 10**6),
)
def test_legal_hands_are_hardly_held_for(
    max_speed: float, noise_m: float, rate_hz: float, loop_hz: int, seed: int
) -> None:
    """The hands reach there and back at up to 1.5 m/s, with noise and dropouts of 30 to 90 ms."""
    random = np.random.default_rng(seed)
    lasts_s = 2.0
    offsets_m = random.standard_normal((2, 3))
    offsets_m *= random.uniform(0.05, 0.3) / np.linalg.norm(offsets_m, axis=1, keepdims=True)
    far = np.linalg.norm(offsets_m, axis=1).max()
    # the duration of a minimum-jerk reach that brakes no harder than the setpoint assumes
    reach_s = max(1.875 * far / max_speed, math.sqrt(5.774 * far / HAND_BRAKE_MPS2))
    stamps = np.arange(0.0, lasts_s, 1.0 / rate_hz)
    missing = np.zeros(len(stamps), bool)
    for begin_s in random.uniform(0.0, lasts_s, 2):
        missing |= (stamps > begin_s) & (
            stamps < begin_s + random.uniform(0.03, 0.09) - 1.0 / rate_hz
        )
    inboxes = {}
    for stamp in stamps[~missing]:
        turns, u = divmod(stamp / reach_s, 1.0)
        progress = smooth(u)
        moved = offsets_m * (
            1.0 - progress if turns % 2 else progress
        ) + noise_m * random.standard_normal((2, 3))
        k = math.ceil(stamp * loop_hz - 1e-9)
        inboxes[k] = seen(np.array((LEFT, RIGHT)) + moved, k)
    ticks = (Tick(k, inboxes.get(k, ())) for k in range(round(lasts_s * loop_hz)))
    trace = played(replace(ASSUMED, rate_hz=loop_hz), stored("soldering"), ticks)
    assert not trace["rejected"][-1].any()
    # Such reaches were not demonstrated, so holds for that reason are allowed.
    unknown = np.isin(trace["reason"], (Reason.FAR_FROM_DEMONSTRATIONS, Reason.AMBIGUOUS))
    assert ((trace["mode"] == Mode.HOLD) & ~unknown).mean() <= 0.02


# --- quick reaches, and lowered speeds ---


def reaches(skill: Skill, cell: Settings, random: np.random.Generator, count: int) -> Vector:
    """Hands (T, 2, 3) [m] that reach for demonstrated positions in 0.3 to 0.7 s, with rests
    between.
    """
    places = skill.hands.reshape(-1, 2, 3)
    hands_m = places[random.integers(len(places))].copy()
    path = [hands_m] * cell.rate_hz
    for _ in range(count):
        to = hands_m.copy()
        seconds = random.uniform(0.3, 0.7)
        goal = places[random.integers(len(places))]
        for side in (0, 1):
            if random.random() < 0.7:
                to[side] = goal[side] + random.normal(0.0, 0.02, 3)
        ticks = int(seconds * cell.rate_hz)
        path += list(
            hands_m + smooth(np.arange(1, ticks + 1) / ticks)[:, None, None] * (to - hands_m)
        )
        path += [to] * int(random.uniform(0.2, 1.0) * cell.rate_hz)
        hands_m = to
    return np.array(path)


@pytest.mark.parametrize("seed", range(MANY or 8))
@pytest.mark.thorough
def test_lowered_speed_never_faults(skill: Skill, taught: Skill, seed: int) -> None:
    """docs/hardware.md lowers joint speeds to a tenth for the first start of a new arm."""
    random = np.random.default_rng(seed)
    name = ("wam", "panda", "ur5", "shipped franka", "shipped ur5")[seed % 5]
    base = shipped(name.removeprefix("shipped ")) if name.startswith("shipped") else cell_of(name)
    slower = float(random.choice([0.1, 1.0, 1.0]))
    cell = changed(
        replace(base, arm=replace(base.arm, source="assumed")),
        rate_hz=int(random.choice([500, 500, 100, 250, 1000])),
        speed=slower,
        max_speed=float(random.choice([0.03, 0.05, 0.08, 0.1, 0.2, 0.5])),
        orientation=str(random.choice(["full", "direction"])),
    )
    candidate = everywhere((skill, taught)[random.integers(2)])
    hands = reaches(taught, cell, random, 3)
    stops = set(random.integers(0, len(hands), 2).tolist())
    orders = dict.fromkeys(stops, "hold") | {k + cell.rate_hz // 4: "resume" for k in stops}
    trace = played(
        cell,
        candidate,
        led(hands, lambda k: (order(orders[k]),) if k in orders else (), every=every(cell)),
    )
    speeds = np.linalg.norm(np.diff(trace["tool"], axis=0), axis=1) / cell.period_s
    assert speeds.max() >= 0.3 * slower * cell.tool.engaging_speed  # the arm moved


# --- hands that rest ---


def settled(
    cell: Settings, skill: Skill, start: Vector, hands: list[Vector], seconds: float
) -> None:
    """Assert that an arm rests in the last second, from any start; the hands (2, 3) move from the
    first position to the second at 2 s, and rest there.
    """
    times = np.arange(1, round(seconds / cell.period_s)) * cell.period_s
    path = hands[0] + smooth((times - 2.0) / 0.8)[:, None, None] * (hands[1] - hands[0])
    trace = played(cell, skill, led(path, every=every(cell)), start=start)
    last = trace["joint_accelerations"][times > seconds - 1.0]
    assert np.sqrt(np.mean(last**2, axis=0)).max() < AT_REST_RADPS2


@pytest.mark.parametrize("number", sorted({*range(MANY or 2), 10}))  # 10 once oscillated for ever
@pytest.mark.one_case
def test_any_cell_comes_to_rest(taught: Skill, number: int) -> None:
    random = np.random.default_rng(number)
    cell = cell_of(("wam", "panda", "ur5")[number % 3])
    rate_hz = int(random.choice([250, 500, 1000]))
    slower = float(random.choice([0.3, 1.0]))
    cell = changed(
        cell,
        rate_hz=rate_hz,
        speed=slower,
        acceleration=slower,
        jerk=float(random.choice([0.2, 0.5, 1.0])),
        follow=str(random.choice(list(FOLLOWING))),
        orientation=str(random.choice(["direction", "full"])),
        plate_from_tool=(0.0, 0.0, float(random.choice([0.0, 0.2])), 0.0, 0.0, 0.0, 1.0),
    )
    places = taught.hands.reshape(-1, 2, 3)
    first = places[random.integers(len(places))]
    second = places[random.integers(len(places))]
    settled(
        cell,
        taught,
        np.array(cell.arm.posture),
        [first, second + random.normal(0, 0.03, (2, 3))],
        20.0,
    )


# --- the scripted task on other arms ---


@pytest.fixture(scope="module")
def reach() -> Skill:
    """A coarse skill of two demonstrations, with which the tool moves a metre."""
    return learn(
        [demonstration.every(2) for demonstration in demonstrations(Scene(), count=2, seed=1)],
        components=5,
        points=60,
    )


@pytest.mark.parametrize("arm", ["wam", *MODELS])
@pytest.mark.one_case
def test_targets_are_followed_to_half_a_mm(arm: str, reach: Skill, tmp_path: Path) -> None:
    cell = cell_of(arm)
    ticks = list(ticks_of(HandScript(Scene(), seed=3)))
    trace = played(cell, reach, ticks)
    assert_replays(tmp_path / "a.mcap", cell, reach, list(zip(ticks, trace, strict=True))[:1500])
    assert (trace["mode"] == Mode.FOLLOW).all()
    error_mm = 1000 * np.linalg.norm(trace["tool"] - trace["setpoint"], axis=1)
    assert np.sqrt(np.mean(error_mm**2)) < 0.5, f"{np.sqrt(np.mean(error_mm**2)):.3f} mm rms"
    assert error_mm.max() < 5.0, f"{error_mm.max():.3f} mm"
    assert np.ptp(trace["tool"], axis=0).max() > 0.3


# --- hands that tremble, and slow ones ---


def tracked(skill: Skill, hands: Vector) -> np.ndarray:
    """The frames (T,) while a noisy tracker reports hands (T, 6) [m]."""
    noisy = hands + NOISE_M * np.random.default_rng(1).standard_normal(hands.shape)
    return played(ASSUMED, skill, led(noisy.reshape(-1, 2, 3)))


def above_4_hz(values: Vector) -> float:
    """The root mean square of frequencies above 4 Hz, after the tool has reached its target."""
    fast = sosfiltfilt(FAST, values, axis=0)[round(COMES_S / PERIOD_S) : -250]
    return float(np.sqrt(np.mean(np.sum(fast**2, axis=1))))


@pytest.mark.parametrize("size_m", [0.0003, 0.001, 0.002])
@pytest.mark.parametrize("name", ["soldering", "experiments/as-paper"])
def test_tremor_does_not_reach_the_tool(name: str, size_m: float) -> None:
    """A tremor of hands at rest does not reach the tool."""
    skill = stored(name)
    random = np.random.default_rng(0)
    t = np.arange(0.0, 5.0, PERIOD_S)
    hands = np.tile(skill.hands.mean(axis=0), (len(t), 1))
    for side in (0, 3):
        rates = np.interp(t, np.arange(0.0, 6.0, 0.5), random.uniform(8.0, 12.0, 12))
        direction = random.standard_normal(3)
        tremor = np.sin(2.0 * np.pi * np.cumsum(rates) * PERIOD_S)
        hands[:, side : side + 3] += (
            size_m * tremor[:, None] * direction / np.linalg.norm(direction)
        )
    trace = tracked(skill, hands)
    assert above_4_hz(trace["tool"]) < 0.0002
    axes = Rotation.from_quat(trace["tool_orientation"]).apply((0.0, 0.0, 1.0))
    assert math.degrees(above_4_hz(axes)) < 0.2


def along(speed: float, parts: slice) -> Vector:
    """Speeds (T,) [m/s] of the tool while parts of the hands (6,) move evenly. The skill is a
    function of the hands' positions only.
    """
    skill = stored("experiments/as-paper")
    t = np.arange(0.0, 9.0, PERIOD_S)
    hands = np.tile(skill.hands.mean(axis=0), (len(t), 1))
    direction = np.array([0.3, 0.9, 0.3] * 2)[parts] / np.linalg.norm([0.3, 0.9, 0.3])
    hands[:, parts] += speed * np.maximum(t - COMES_S, 0.0)[:, None] * direction
    tool = tracked(skill, hands)["tool"][round((COMES_S + KNOWN_S) / PERIOD_S) :]
    return np.asarray(
        np.diff(tool, axis=0) / PERIOD_S @ (tool[-1] - tool[0]) / np.linalg.norm(tool[-1] - tool[0])
    )


@pytest.mark.parametrize("speed", [0.002, 0.005, 0.02])
def test_slow_hand_moves_tool_evenly(speed: float) -> None:
    assert along(speed, slice(0, 3)).std() < 0.001


QUICK = {
    "wam": (cell_of("wam"), 2),
    "wam, 1 kHz": (changed(cell_of("wam"), rate_hz=1000), 0),
    "wam, slow": (changed(cell_of("wam"), rate_hz=250, max_speed=0.3), 19),
    "ur5": (cell_of("ur5"), 3),
    "panda, 250 Hz": (changed(cell_of("panda"), rate_hz=250), 0),
    "panda, orientation": (changed(cell_of("panda"), orientation="full"), 0),
}


@pytest.mark.parametrize("name", QUICK)
@pytest.mark.one_case
def test_quick_reaches_never_fault(taught: Skill, name: str) -> None:
    cell, first = QUICK[name]
    for seed in range(first, first + (MANY or 1)):
        hands = reaches(taught, cell, np.random.default_rng(seed), 8)
        trace = played(cell, taught, led(hands, first=1, every=every(cell)))
        speed = np.linalg.norm(np.diff(trace["tool"], axis=0), axis=1).max() / cell.period_s
        assert speed <= cell.tool.max_speed, f"seed {seed}: {speed:.4f} m/s"
        assert np.ptp(trace["tool"], axis=0).max() > 0.1
