"""Status of hands and arm: rates, clocks, and rejected samples with their causes, in words."""

from __future__ import annotations

import itertools
import math
import re
from typing import Any

import pytest

from support.in_process import LEFT, RIGHT
from support.wam import JOINT_NAMES, URDF
from thirdhand.contract.channels import POSE
from thirdhand.contract.evidence import explained
from thirdhand.contract.joint_states import JointStates
from thirdhand.contract.messages import JointState, PoseStamped, WireError
from thirdhand.contract.other_types import Refusal
from thirdhand.contract.records import Cause
from thirdhand.contract.requests import Percentiles, Status
from thirdhand.core.controller import Controller
from thirdhand.core.frame import Event, Frame, Tick, blank, frame_layout
from thirdhand.core.intake.stage import UNIT_M
from thirdhand.core.skill.skill import Skill
from thirdhand.daemon.input_monitor import KEY_OF_SOURCE, InputMonitor, evidence
from thirdhand.daemon.status import CellStatus
from thirdhand.settings.config import HandSettings, Settings

STRAIGHT = (0.0, 0.0, 0.0, 1.0)
S = 1_000_000_000
POSTURE = Settings().arm.posture


def pose(
    stamp_ns: int, position: tuple[float, ...] = LEFT, turn: Any = STRAIGHT, frame: str = "base"
) -> PoseStamped:
    return PoseStamped(stamp_ns, frame, position, turn)  # type: ignore[arg-type]


def joints(
    stamp_ns: int, position: tuple[float, ...] = POSTURE, names: tuple[str, ...] = JOINT_NAMES
) -> JointState:
    return JointState(stamp_ns, names, position, (0.0,) * len(position))


def resting_hands(stamp_ns: int) -> list[tuple[str, PoseStamped]]:
    """A sample of each hand."""
    return [("left", pose(stamp_ns, LEFT)), ("right", pose(stamp_ns, RIGHT))]


class Cell:
    """A controller and its input monitor, which receive messages tick by tick."""

    def __init__(self, skill: Skill, settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        self.controller = Controller(self.settings, skill, urdf=URDF)
        self.sources = InputMonitor(self.settings)
        self.ticks = itertools.count()
        self.frame: Frame = blank(frame_layout(7))
        self.log: list[str] = []

    def tell(
        self,
        *messages: tuple[str, PoseStamped | JointState],
        late_ns: int = 0,
        at_ns: int | None = None,
    ) -> None:
        """One tick with messages by source; they arrive at a given time, or with a delay after
        their stamps.
        """
        index = next(self.ticks)
        for source, message in messages:
            arrival_ns = message.stamp_ns + late_ns if at_ns is None else at_ns
            self.sources.arrivals[KEY_OF_SOURCE[source]].take(message, arrival_ns)
        inbox = tuple(Event(KEY_OF_SOURCE[source], b"", message) for source, message in messages)
        self.frame = self.controller.step(Tick(index, inbox))

    def status(self, now_s: float, *, failure: str = "") -> Status:
        state = self.controller.state
        sources = dict(self.sources.update(self.controller, state, now_s))
        self.log += self.sources.news(sources, now_s)
        none = Percentiles()
        more = {
            "rate_hz": 500.0,
            "missed": 0,
            "realtime": True,
            "memory_locked": True,
            "awake": True,
            "scribe": {},
            "endpoints": (),
        }
        cell = CellStatus(self.frame, self.controller, state, sources, self.settings, failure)
        return cell.status(**more, version="", lateness_us=none, work_us=none, latency_ms=none)


@pytest.mark.parametrize(
    ("source", "message", "cause", "words"),
    [
        (
            "left",
            pose(2, frame="camera"),
            Cause.WRONG_FRAME,
            "frame 'camera'; 'base' or none accepted",
        ),
        (
            "left",
            pose(2, (980.0, -320.0, 60.0)),
            Cause.OUT_OF_RANGE,
            "at (980, -320, 60), which looks like mm;",
        ),
        (
            "left",
            pose(2, turn=(0.0, 0.0, 0.0, 0.0)),
            Cause.NOT_A_ROTATION,
            "of norm 0; norm 1 needed",
        ),
        (
            "right",
            pose(2, (math.nan, 0.0, 0.0)),
            Cause.NOT_FINITE,
            "at (nan, 0, 0) in the tracker's frame, orientation (0, 0, 0, 1); finite",
        ),
        ("right", pose(S, RIGHT), Cause.REPEATED, "stamp 1.000 s again"),
        (
            "right",
            pose(3 * S, RIGHT),
            Cause.AHEAD,
            "stamped 2 s after the newest accepted one: its clock stepped",
        ),
        (
            "right",
            pose(S // 2, RIGHT),
            Cause.OLDER,
            "stamped 500 ms before the newest accepted one",
        ),
        (
            "left",
            pose(S + 1, (0.5, 0.0, 0.3)),
            Cause.JUMPED,
            "at (0.5, 0, 0.3) in the tracker's frame",
        ),
        (
            "arm",
            joints(2, (90.0,) * 7),
            Cause.OUT_OF_RANGE,
            "base_yaw_joint at 90 rad, which looks like degrees; -2.8",
        ),
        ("arm", joints(2, (0.0, 0.0), ("a", "b")), Cause.INCOMPLETE, "missing among 2, a, b"),
        (
            "arm",
            joints(2, (*POSTURE[:6], math.nan)),
            Cause.NOT_FINITE,
            "palm_yaw_joint at nan rad; a finite number needed",
        ),
        (
            "arm",
            joints(2)._replace(velocity=(*(math.nan,) * 5, -math.inf, 0.0)),
            Cause.NOT_FINITE,
            "wrist_pitch_joint at -inf rad/s; a finite number needed",
        ),
    ],
)
def test_what_is_rejected_is_said_in_words(
    skill: Skill, source: str, message: Any, cause: Cause, words: str
) -> None:
    cell = Cell(skill)
    cell.tell(*resting_hands(S))
    cell.tell((source, message))
    refused = cell.controller.intake.refused[source, cause]
    assert refused[:2] == (cause, message)
    cell.tell(*resting_hands(2 * S))
    assert (
        words
        in explained(
            cause, evidence(refused, cell.settings, cell.sources.arrivals[KEY_OF_SOURCE[source]])
        ).why
    )


@pytest.mark.parametrize("rate_hz", [3, 5, 8])
@pytest.mark.one_case
def test_hands_that_come_too_seldom_are_told_how_often(skill: Skill, rate_hz: int) -> None:
    cell = Cell(skill)
    told_of = set()
    for k in range(2500):
        cell.tell(("arm", joints(k + 1)), *resting_hands(k + 1) * (k % (500 // rate_hz) == 0))
        status = cell.status(k / 500)
        if k > 1000 and status.reason == "stale_hand":
            told_of.add(status.because)
            for side in ("left", "right"):
                assert re.search(
                    rf"the {side} hand arrives at \d\.\d Hz, 10 Hz at least needed", status.because
                )
            assert (
                status.remedy
                == "publish hands more often, or raise [hands] stale_ms; or [hands] stale_max_ms "
                "if they come in bursts"
            )
    assert told_of


@pytest.mark.parametrize("named_twice", JOINT_NAMES)
def test_joint_named_twice_is_refused(skill: Skill, named_twice: str) -> None:
    """A joint with two positions would seem to have left its command."""
    cell = Cell(skill)
    for k in range(1, 100):
        state = joints(k, (*POSTURE, 1.0), (*JOINT_NAMES, named_twice))
        cell.tell(("arm", state), *resting_hands(k))
        status = cell.status(k / 500)
    assert (status.mode, status.reason) == ("hold", "arm_not_ready")
    assert (
        f"['{named_twice}'] named more than once among 8; one position each needed"
        in status.because
    )
    part = joints(1, POSTURE[:3], (*JOINT_NAMES[:2], JOINT_NAMES[1]))
    with pytest.raises(WireError, match="named more than once among 3"):
        JointStates(JOINT_NAMES, 0.1).take(part, 0.0)


class Clock:
    """Samples of the right hand at 100 Hz, each with its stamp and its delay [ns]."""

    def __init__(self, skill: Skill) -> None:
        self.cell = Cell(skill)
        self.now_ns = 100 * S

    def tell(self, stamp_ns: int) -> None:
        self.cell.tell(("right", pose(stamp_ns, RIGHT)), late_ns=self.now_ns - stamp_ns)
        self.now_ns += 2_000_000
        for _ in range(4):
            self.cell.tell()
            self.now_ns += 2_000_000


@pytest.mark.parametrize("apart_s", [-3600, 0, 5])  # publisher's clock minus the daemon's
def test_delayed_samples_are_distinguished_from_a_clock_step(skill: Skill, apart_s: int) -> None:
    held = Clock(skill)
    stepped = Clock(skill)
    for clock in (held, stepped):
        for _ in range(50):
            clock.tell(clock.now_ns + apart_s * S - 5_000_000)
    # a network that delivers nothing for 3 s, then one old sample, then the newest
    for k in range(300):
        held.cell.tell()
        held.now_ns += 2_000_000 if k else 2 * S
    held.tell(held.now_ns + apart_s * S - 2 * S)
    held.tell(held.now_ns + apart_s * S - 8_000_000)
    stepped.tell(stepped.now_ns + apart_s * S + 2 * S)
    told_held = held.cell.status(1.0)
    told_stepped = stepped.cell.status(1.0)
    assert (told_held.rejected, told_stepped.rejected) == ({"ahead": 1}, {"ahead": 1})
    delayed = told_held.sources["right"]
    ahead = told_stepped.sources["right"]
    assert delayed.refused.endswith("which arrived 1.99 s late (its clock is right)")
    assert "find what holds them up: the network" in delayed.advice
    assert ahead.refused.endswith("after the newest accepted one: its clock stepped ahead")
    assert ahead.advice.startswith("correct the publisher's clock")
    assert delayed.advice in held.cell.log[-1]


@pytest.mark.parametrize("set_back_s", [0.3, 3600, 10 * 365 * 86_400])
def test_a_clock_that_was_set_back_is_told_from_a_second_source(
    skill: Skill, set_back_s: float
) -> None:
    set_back = Clock(skill)
    second = Clock(skill)
    for clock in (set_back, second):
        for _ in range(50):
            clock.tell(clock.now_ns)
    for k in range(6):
        set_back.tell(set_back.now_ns - round(set_back_s * S))
        second.tell(second.now_ns - round(set_back_s * S) * (k % 2))
    told_back, told_second = (
        clock.cell.status(1.0).sources["right"] for clock in (set_back, second)
    )
    assert (told_back.cause, told_second.cause) == ("older", "older")
    assert told_back.refused.endswith(" before the newest accepted one: its clock was set back")
    assert told_back.advice.startswith(
        "correct the publisher's clock; samples are accepted again after"
    )
    assert told_second.refused.endswith(" before the newest accepted one")
    assert "stop a second tracker or driver of this key" in told_second.advice
    for _ in range(30):
        set_back.tell(set_back.now_ns - round(set_back_s * S))
    assert set_back.cell.status(2.1).sources["right"].fresh


def test_first_rejection_is_logged_and_others_are_counted(skill: Skill) -> None:
    """Each kind of rejection has a log entry of its own."""
    cell = Cell(skill)
    for k in range(30):
        cell.tell(("left", pose(k + 1, frame="camera")))
        cell.status(100 + k / 10)
    assert [line.split(":")[0] for line in cell.log] == ["left hand"]
    assert (
        "rejected as wrong_frame: frame 'camera'; 'base' or none accepted. What to do: find [hands]"
        in cell.log[0]
    )
    cell.sources.arrivals[KEY_OF_SOURCE["right"]].refuse(
        Refusal("a header of another kind", POSE.type)
    )
    cell.status(103.0)
    assert "right hand: rejected as malformed: a header of another kind" in cell.log[1]
    cell.status(109.0)
    assert len(cell.log) == 2
    cell.status(111.0)
    assert "left hand: rejected in the last 11 s: 29 wrong_frame (30 in all)" in cell.log[2]
    cell.status(122.0)
    assert len(cell.log) == 3


def test_what_was_rejected_long_ago_is_blamed_for_nothing(skill: Skill) -> None:
    cell = Cell(skill)
    cell.tell(*resting_hands(S), ("left", pose(1, (900.0, 0.0, 0.0))))
    assert cell.status(1.0).sources["left"].cause == "out_of_range"
    for k in range(1500):
        left_samples = (("left", pose(S + 1 + k, LEFT)),) if k < 1200 else ()
        cell.tell(("right", pose(S + 1 + k, RIGHT)), ("arm", joints(k + 1)), *left_samples)
        if k % 50 == 0:
            status = cell.status(1.0 + k / 500)
    assert status.reason == "stale_hand"
    assert status.because == "the left hand was last seen 502 ms ago"
    assert status.remedy.startswith("look at the tracker; if a counter")
    assert status.rejected == {"out_of_range": 1}


def test_hold_names_the_missing_sample_and_the_remedy(skill: Skill) -> None:
    """The reason of the hold names the source, the cause and the remedy."""
    settings = Settings(hands=HandSettings(frame="optitrack"))
    cell = Cell(skill, settings)
    for k in range(200):
        cell.tell(
            ("right", pose(k + 1, RIGHT)),
            ("left", pose(k + 1, frame="camera")),
            ("arm", joints(k + 1)),
        )
        if k % 50 == 0:
            status = cell.status(k / 500)
    status = cell.status(0.4)
    assert (status.mode, status.reason) == ("hold", "no_hands")
    assert status.because == (
        "the left hand has not been seen yet, as what arrives is rejected as wrong_frame: "
        "frame 'camera'; 'base', 'optitrack' or none accepted"
    )
    assert status.remedy.startswith(
        "find [hands] frame and base_from_tracker by thirdhand calibrate, also after the"
    )
    assert status.frames == ("base", "optitrack", "")
    assert status.sources["right"].rate_hz == pytest.approx(500, rel=0.05)
    assert (status.sources["right"].fresh, status.sources["left"].fresh) == (True, False)
    assert status.rejected == {"wrong_frame": 200}
    for _ in range(100):
        cell.tell(("arm", joints(1000 + next(cell.ticks))))
    status = cell.status(0.6)
    assert "the right hand was last seen" in status.because
    assert not status.sources["right"].fresh


@pytest.mark.parametrize(
    ("unit", "reported"), [("mm", "m"), ("cm", "m"), ("m", "mm"), ("m", "cm"), ("cm", "mm")]
)
def test_wrong_unit_explains_the_hold(skill: Skill, unit: str, reported: str) -> None:
    """The hands' positions are in another unit."""
    settings = Settings(hands=HandSettings(unit=unit))  # type: ignore[arg-type]
    cell = Cell(skill, settings)
    for k in range(100):
        hands = [
            (side, pose(1 + k, tuple(metres / UNIT_M[reported] for metres in position)))
            for side, position in (("left", LEFT), ("right", RIGHT))
        ]
        cell.tell(*hands, ("arm", joints(1 + k)))
        cell.status(k / 500)
    status = cell.status(0.2)
    assert status.mode == "hold"
    assert (
        f"look like {reported}," in status.because
        or f"which looks like {reported}; " in status.because
    )
    assert {source.unit for name, source in status.sources.items() if name != "arm"} == {reported}


@pytest.mark.parametrize("batch_ticks", [60, 100, 150])
def test_batches_of_samples_get_their_setting(skill: Skill, batch_ticks: int) -> None:
    """The hint names the setting for hands that arrive in batches."""
    cell = Cell(skill)
    period_ns = S // 500
    waiting: list[tuple[str, PoseStamped]] = []
    status = cell.status(0.0)
    for k in range(5 * batch_ticks):
        stamp_ns = 1 + k * period_ns
        if k % 7 == 0:
            waiting += resting_hands(stamp_ns)
        is_sent = k % batch_ticks == batch_ticks - 1
        cell.tell(("arm", joints(stamp_ns)), *(waiting[-8:] if is_sent else ()), at_ns=stamp_ns)
        if is_sent:
            waiting.clear()
        status = cell.status(k / 500)
        if k % batch_ticks == batch_ticks - 2 and k > 4 * batch_ticks:
            assert (status.mode, status.reason) == ("hold", "stale_hand")
            assert f"arrives in batches, {1000 * batch_ticks // 500} ms apart" in status.because
            assert "raise [hands] stale_max_ms" in status.remedy


def test_an_arm_that_is_not_ready_says_why(skill: Skill) -> None:
    cell = Cell(skill)
    cell.tell()
    assert cell.status(0.0).because == "no joint states arrived yet"
    cell.tell(("arm", joints(1, (0.0, 0.0), ("a", "b"))))
    assert (
        "what arrives from the arm is rejected as incomplete: joints ['wam/"
        in cell.status(0.1).because
    )
    cell.tell(("arm", joints(2)))
    status = cell.status(0.2)
    assert status.because == "the arm has not rested in one posture for long enough"
    assert (
        status.remedy
        == "wait: the service begins by itself once the arm has rested within its limits for 0.1 s"
    )
    outside = (2.7, *POSTURE[1:])
    for k in range(120):
        cell.tell(("arm", joints(10 + k, outside)))
    assert (
        cell.status(0.5).because
        == "wam/base_yaw_joint at 2.700 rad is outside -2.6 to 2.6, and is moved back"
    )
    for _ in range(60):
        cell.tell()
    assert (cell.status(0.7).reason, cell.status(0.8).because) == (
        "arm_silent",
        "no joint states for 120 ms",
    )


def test_clocks_are_told_apart_from_latency(skill: Skill) -> None:
    cell = Cell(skill)
    for k in range(10):
        cell.tell(("left", pose(S + k)), late_ns=-5 * S)
        status = cell.status(k / 10)
    assert status.sources["left"].clock_ms == pytest.approx(-5000.0)
    assert status.sources["right"].clock_ms is None


@pytest.mark.parametrize("rate_hz", [1, 8])
def test_an_arm_that_reports_too_seldom_is_told_how_often(skill: Skill, rate_hz: int) -> None:
    cell = Cell(skill)
    for k in range(1500):
        cell.tell(*[("arm", joints(k + 1))] * (k % (500 // rate_hz) == 0))
        status = cell.status(k / 500)
        if k > 1000:
            assert re.fullmatch(
                r"joint states arrive at \d\.\d Hz, 10 Hz at least needed", status.because
            )
            assert status.remedy == "publish joints/state more often, or raise [arm] silent_ms"
    assert status.reason == "arm_not_ready"
