"""The core as a whole: modes and reasons, limits, stops without a jump, smoothness without lag, and
continuing from a state bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from support.followed import changed, followed
from support.in_process import (
    ASSUMED,
    LEFT,
    RIGHT,
    Loop,
    arm,
    assert_limits_hold,
    frames,
    hand,
    led,
    resting,
    script_hands,
    ticks_of,
)
from support.paths import RECORDINGS
from support.wam import URDF
from thirdhand.contract import channels
from thirdhand.contract.records import Flag, Mode, Reason
from thirdhand.core.controller import Controller
from thirdhand.core.frame import Event, Tick, definitions, order
from thirdhand.core.skill.model import Regions
from thirdhand.core.skill.skill import Skill
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import decoded
from thirdhand.skills.via_points import adapted
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

PERIOD_S = 0.002
POSTURE = Settings().arm.posture
Session = tuple[list[Tick], np.ndarray]  # ticks and the frame of each


def modes(seen: np.ndarray) -> list[tuple[str, str]]:
    """The modes and reasons in the order of their occurrence."""
    pairs = [(Mode(f["mode"]).name.lower(), Reason(f["reason"]).name.lower()) for f in seen]
    return [pair for i, pair in enumerate(pairs) if i == 0 or pair != pairs[i - 1]]


def test_demonstrated_relation_with_little_tremor() -> None:
    """Tremor is half a millimetre at 8 to 10 Hz, noise the same; a setpoint that can stop lags by v
    / 2a.
    """
    skill = decoded((RECORDINGS / "experiments" / "as-paper.npz").read_bytes(), origin="as-paper")
    taught = adapted(skill, Scene().via_points(), tolerance=0.05)
    script = HandScript(Scene(), seed=6)
    trace = followed(taught, ticks_of(script))
    time_s = np.arange(len(trace)) * PERIOD_S - 1.5
    hands = np.array(
        [np.concatenate([m.position for m in script.truth(max(0.0, t))]) for t in time_s]
    )
    ideal = taught.mean(hands)
    inner = slice(750, -100)
    error = np.linalg.norm(trace["tool"][inner] - ideal[inner], axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.014
    speed, ideal_speed = (
        np.linalg.norm(np.gradient(x, PERIOD_S, axis=0), axis=1) for x in (trace["tool"], ideal)
    )
    score = [float(ideal_speed[inner] @ np.roll(speed, -shift)[inner]) for shift in range(-40, 41)]
    assert (int(np.argmax(score)) - 40) * PERIOD_S <= 0.075
    shaken = trace["tool"][-150:]
    assert np.sqrt(np.mean(np.sum((shaken - shaken.mean(axis=0)) ** 2, axis=1))) < 0.002
    assert speed.max() <= ASSUMED.tool.max_speed + 1e-6


def test_first_setpoint_is_at_the_tool(taught: Skill) -> None:
    trace = followed(taught, resting(0, 300, every=1))
    assert modes(trace) == [("follow", "none")]
    assert np.linalg.norm(trace["setpoint"] - trace["tool"], axis=1).max() < 0.002


def unseen(ticks: Iterable[Tick], when: range, *kinds: str) -> list[Tick]:
    """The ticks without the samples of these kinds in a period."""
    return [
        Tick(t.index, tuple(e for e in t.inbox if not (e.kind in kinds and t.index in when)))
        for t in ticks
    ]


@pytest.fixture(scope="module")
def moving(taught: Skill) -> Session:
    """The ticks of a scene, and the frame of each."""
    ticks = list(ticks_of(HandScript(Scene(), seed=8)))
    return ticks, followed(taught, ticks)


def without(unseen_ms: float) -> Settings:
    """Settings with this longest time for which the arm moves without a hand."""
    return changed(ASSUMED, hands={"unseen_ms": unseen_ms})


@pytest.mark.parametrize(
    ("side", "most"), [("left", 1.0), ("right", 0.6)], ids=["it conducts", "the other does"]
)
def test_tool_moves_while_one_hand_is_unseen(
    taught: Skill, moving: Session, side: str, most: float
) -> None:
    """The tool keeps moving while one hand is out of sight for a moment."""
    ticks, whole = moving
    away = range(3300, 3500)
    ticks = unseen(ticks[: away.stop + 500], away, f"hands/{side}")
    going, held = (followed(taught, ticks, without(ms)) for ms in (500.0, 0.0))
    assert modes(going[1:]) == [("follow", "none")]
    assert modes(held[1:]) == [("follow", "none"), ("hold", "stale_hand"), ("follow", "none")]
    deviation_m, off_held = (
        np.linalg.norm(trace["tool"] - whole["tool"][: len(trace)], axis=1)[away.start :].max()
        for trace in (going, held)
    )
    assert deviation_m < most * off_held


def test_waits_for_an_unseen_hand_that_matters(taught: Skill, moving: Session) -> None:
    """The arm waits at once if the target depends strongly on the unseen hand."""
    ticks = unseen(moving[0][:2400], range(1650, 2400), "hands/left")
    trace = followed(taught, ticks, without(1000.0))
    assert modes(trace[1:]) == [("follow", "none"), ("hold", "stale_hand")]
    needed = (
        np.flatnonzero(trace["reason"] == Reason.STALE_HAND)[-1]
        + 1
        - np.sum(trace["reason"] == Reason.STALE_HAND)
    )
    assert 1650 + 50 < needed < 1650 + 490


def test_unseen_hand_keeps_arm_farther_away(taught: Skill, moving: Session) -> None:
    """The arm keeps a larger distance from a hand that is out of sight."""
    away = range(3300, 3500)
    trace = followed(taught, unseen(moving[0][: away.stop], away, "hands/left"))
    limit = trace["hand_limit"][away.start :]
    assert limit[-1] < limit[55] - 0.2


def test_silent_hands_hold_within_100_ms(taught: Skill, moving: Session) -> None:
    """Silent hands cause a hold within 100 ms, until both are seen again."""
    ticks = unseen(moving[0], range(1500, 1900), "hands/left", "hands/right")
    ticks = unseen(ticks, range(1900, 1920), "hands/left")
    trace = followed(taught, ticks)
    assert modes(trace[1:]) == [("follow", "none"), ("hold", "stale_hand"), ("follow", "none")]
    held = np.flatnonzero(trace["mode"] == Mode.HOLD)
    assert held[1] - (1500 - 5) <= 50 + 1
    assert held[-1] == 1919
    assert not trace["joint_velocities"][1919].any()


def test_without_hands_it_holds_and_says_so(taught: Skill) -> None:
    trace = followed(taught, [Tick(k, (hand("left", LEFT, k + 1),)) for k in range(100)])
    assert modes(trace) == [("hold", "no_hands")]
    assert trace["hand_ages"][-1].tolist() == [0, -1]


def test_far_hands_are_held_with_hysteresis(taught: Skill) -> None:
    """Hands far from the demonstrations are not followed until they are clearly nearer."""
    hands = np.tile((LEFT, RIGHT), (1600, 1, 1))
    hands[400:800, 0, 2] += 0.5
    trace = followed(taught, led(hands))
    assert modes(trace[1:]) == [
        ("follow", "none"),
        ("hold", "far_from_demonstrations"),
        ("follow", "none"),
    ]


def test_nothing_is_commanded_before_arm_is_heard(taught: Skill) -> None:
    """No command is published before the arm has reported its joints."""
    start = (0.1, 0.5, 0.0, 1.9, 0.0, -0.3, 0.2)
    controller = Controller(Settings(), taught, urdf=URDF)
    before = frames(controller, resting(0, 200))
    assert modes(before) == [("hold", "arm_not_ready")]
    assert not before["commanded"].any()
    after = frames(controller, resting(200, 60, lambda k: (arm(start, k),)))
    assert np.flatnonzero(after["commanded"])[0] == 50  # after 0.1 s of one posture
    after = after[50:]
    assert after["commanded"].all()
    assert np.abs(after["joints"][0] - start).max() < 1e-3


@pytest.fixture
def loop(taught: Skill) -> Loop:
    """A loop whose arm has followed for 300 ticks."""
    loop = Loop(Settings(), taught)
    assert modes(loop.run(300))[-1] == ("follow", "none")
    return loop


def test_arm_error_is_a_fault_until_reset(loop: Loop) -> None:
    """An arm that does not follow is a fault until reset."""
    loop.reports = lambda q, dq: (q + 0.15, dq)
    trace = loop.run(400)
    assert modes(trace) == [("fault", "arm_error")]
    assert not trace["commanded"][-1]
    assert_limits_hold(trace)
    loop.reports = lambda q, dq: (q, 0.0 * dq)
    assert modes(loop.run(100, {0: order("reset")}))[-1] == ("follow", "none")


def test_silent_arm_is_a_fault(loop: Loop) -> None:
    """An arm that falls silent while followed is a fault."""
    trace = loop.run(300, every=0)
    assert modes(trace) == [("follow", "none"), ("fault", "arm_silent")]
    assert np.argmax(trace["mode"] == Mode.FAULT) <= 50


def test_a_tool_measured_too_fast_is_a_fault(loop: Loop) -> None:
    loop.reports = lambda q, dq: (q, 0.0 * dq + 2.0)
    assert modes(loop.run(10))[-1] == ("follow", "none")
    loop.reports = lambda q, dq: (q, 0.0 * dq)
    assert modes(loop.run(1))[-1] == ("follow", "none")
    loop.reports = lambda q, dq: (q, 0.0 * dq + 2.0)
    assert modes(loop.run(20))[-1] == ("fault", "tool_speed")


def test_reset_waits_for_rest(taught: Skill) -> None:
    """A reset while the arm still moves lets it come to rest first."""
    loop = Loop(Settings(), taught)
    was_fault = False
    loop.hands = script_hands(HandScript(Scene(), seed=11), wait_s=0.5)
    for k in range(3000):
        velocity = 9.0 if 1400 <= k < 1420 else 0.0
        loop.reports = lambda q, dq, velocity=velocity: (q, 0.0 * dq + velocity)
        frame = loop.step(*([order("reset")] if was_fault and k % 7 == 0 else []))
        was_fault = frame["mode"] == Mode.FAULT
    trace = loop.frames
    assert [reason for _, reason in modes(trace)][-3:] == ["tool_speed", "arm_not_ready", "none"]
    assert_limits_hold(trace)


def test_reset_without_fault_changes_nothing(taught: Skill) -> None:
    plain = followed(taught, resting(0, 400))
    reset = followed(taught, resting(0, 400, lambda k: (order("reset"),) if k == 200 else ()))
    assert plain.tobytes() == reset.tobytes()


def test_new_skill_is_approached_within_limits(skill: Skill, taught: Skill) -> None:
    """A new skill is adopted at its tick and approached within the limits."""
    moved = adapted(
        skill,
        Scene(handover=(0.66, -0.22, 0.33), glass=(0.45, 0.30, 0.2)).via_points(),
        tolerance=0.05,
    )
    controller = Controller(ASSUMED, taught, urdf=URDF)
    trace = frames(
        controller,
        resting(0, 1500, lambda k: (Event("skill", moved.file, moved),) if k == 700 else ()),
    )
    assert controller.skill is moved
    assert controller.state["skill"].tobytes() == moved.digest
    assert_limits_hold(trace)


@pytest.mark.parametrize(("wrong_s", "holds"), [(0.04, 0), (0.08, 1), (0.12, 1), (0.16, 1)])
@pytest.mark.parametrize("jump_m", [0.25, 0.3, 0.5])
def test_repeated_jumps_hold_once(taught: Skill, jump_m: float, wrong_s: float, holds: int) -> None:
    """Hands that jump again and again cause one hold; shorter jumps are ignored."""
    hands = np.tile((LEFT, RIGHT), (4000, 1, 1))
    time_s = np.arange(len(hands)) * PERIOD_S
    is_jumped = (time_s > 2.0) & (time_s < 4.0) & (time_s % 0.2 < wrong_s)
    hands[is_jumped, 0, 0] += jump_m
    hands += np.random.default_rng(4).normal(0, 3e-4, hands.shape)
    trace = followed(taught, led(hands, every=5))
    assert modes(trace).count(("hold", "far_from_demonstrations")) == holds
    assert (trace["reason"] != Reason.FAR_FROM_DEMONSTRATIONS)[2200:].all()


def test_unsure_flag_does_not_change_motion(taught: Skill) -> None:
    """An uncertain skill raises a flag and moves the arm as a certain one does."""
    ticks = list(ticks_of(HandScript(Scene(), seed=5)))[:1500]
    skills = [replace(taught, regions=Regions(scale)) for scale in (1e-4, 1e4)]
    sure, unsure = (followed(skill, ticks) for skill in skills)
    follows = sure["mode"] == Mode.FOLLOW
    assert follows[-500:].all()
    assert not (sure["flags"] & Flag.UNSURE).any()
    assert ((unsure["flags"] & Flag.UNSURE > 0) == follows).all()
    assert unsure["joints"].tobytes() == sure["joints"].tobytes()


def test_ticks_must_grow(taught: Skill) -> None:
    controller = Controller(ASSUMED, taught, urdf=URDF)
    controller.step(Tick(4))
    with pytest.raises(ValueError, match="tick 4 after tick 4"):
        controller.step(Tick(4))


def test_frames_are_read_only(taught: Skill) -> None:
    """Frames are read-only, and their fields have names."""
    frame = Controller(ASSUMED, taught, urdf=URDF).step(Tick(0))
    with pytest.raises(ValueError, match="read-only"):
        frame["joints"][0] = 1.0
    assert definitions(7)["thirdhand/Frame"].startswith(
        "int64 tick\nint64 hand_stamp_ns\nfloat64[6] hands\n"
    )


def test_every_event_has_a_case(taught: Skill) -> None:
    """Any other event is refused."""
    controller = Controller(ASSUMED, taught, urdf=URDF)
    for index, kind in enumerate(channels.EVENT_NUMBERS):
        values = {
            "hands": hand("left", LEFT, 1).value,
            "joints": arm(POSTURE, 1).value,
            "skill": taught,
        }
        controller.step(
            Tick(index, (Event(kind, order(kind).payload, values.get(kind.split("/")[0])),))
        )
    with pytest.raises(ValueError, match="nothing is done with an event of kind 'pedal'"):
        controller.step(Tick(100, (Event("pedal", b"", None),)))
