"""Findings of `thirdhand doctor` in statuses: none in a healthy cell's; each fault is named with
the expected value and the remedy.
"""

from __future__ import annotations

import re
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np
import pytest

from support.statuses import holding
from thirdhand.cli.diagnosis import Y_UP, Finding, findings
from thirdhand.cli.status import rows
from thirdhand.contract.incidents import what_to_do
from thirdhand.contract.requests import Percentiles, Source, Status
from thirdhand.core.geometry import rotation
from thirdhand.settings.config import converted

GOOD = Source(rate_hz=100.0, age_ms=4.0, fresh=True, clock_ms=1.5, frame="base")
BOXES = {"left": ((0.6, -0.3, 0.0), (1.0, 0.0, 0.3)), "right": ((0.7, 0.05, 0.0), (1.0, 0.4, 0.2))}
HEALTHY = msgspec.structs.replace(
    holding("lab", 1000),
    mode="follow",
    reason="",
    missed=3,
    realtime=True,
    memory_locked=True,
    awake=True,
    skill="soldering",
    hand_age_ms={"left": 4.0, "right": 4.0},
    hand_distance_m=0.5,
    lateness_us=Percentiles(1, 90, 300),
    latency_ms=Percentiles(1, 2, 3),
    scribe={"state": "recording", "lost": 0, "free_mb": 50_000.0, "errors": []},
    endpoints=("tcp/127.0.0.1:7447",),
    version="0.1.0",
    time_ns=10**18,
    sources={"left": GOOD, "right": GOOD, "arm": msgspec.structs.replace(GOOD, rate_hz=500.0)},
    frames=("base", ""),
    joints=("a", "b"),
    hands_m={"left": (0.8, -0.2, 0.1), "right": (0.9, 0.3, 0.1)},
    demonstrated_m=BOXES,
    tool_m=(0.5, 0.0, 0.3),
    setpoint_m=(0.5, 0.0, 0.3),
    target_m=(0.5, 0.01, 0.3),
    deviation_m=0.02,
    threshold_m=0.7,
)


def differing(**fields: Any) -> Status:
    """The status of a healthy cell, with other fields."""
    return msgspec.structs.replace(HEALTHY, **fields)


def diagnosed(
    before: Status = HEALTHY, more: Any = MappingProxyType({}), **changed: Any
) -> list[Finding]:
    """The findings of a healthy cell whose status differs in these fields two seconds later."""
    now = msgspec.structs.replace(before, tick=2000, time_ns=HEALTHY.time_ns + 2 * 10**9)
    now = msgspec.structs.replace(now, **changed)
    return findings(before, now, own_ns=now.time_ns, own_version="0.1.0", **more)


def wrongs(found: list[Finding]) -> list[str]:
    return [finding.text() for finding in found if finding.level == "wrong"]


def source(name: str, **changed: Any) -> dict[str, Source]:
    return HEALTHY.sources | {name: msgspec.structs.replace(HEALTHY.sources[name], **changed)}


def test_healthy_cell_has_no_findings() -> None:
    """Every line is printed, and none is a fault."""
    diagnosis = diagnosed()
    assert {finding.level for finding in diagnosis} == {"ok"}
    subjects = {finding.what for finding in diagnosis}
    assert subjects >= {
        "mode",
        "left hand",
        "right hand",
        "arm",
        "arm's driver",
        "loop",
        "real time",
        "memory",
        "disk",
    }


def test_hand_below_the_table_shows_a_wrong_calibration() -> None:
    """Only if the hand is below the table all the time, and deeper than the tracker's noise."""
    below = {"right": 0.05, "left": 0.01}
    (text,) = wrongs(diagnosed(differing(below_table_m=below)))
    assert "calibration        below the table top: right hand 5 cm" in text
    assert (
        "thirdhand calibrate --check measures by how much, thirdhand calibrate finds the pose"
        in text
    )
    assert wrongs(diagnosed(below_table_m=below)) == []


@pytest.mark.parametrize(
    ("changed", "what", "words"),
    [
        ({"version": "0.9"}, "daemon", ("version 0.9", "version 0.1.0", "update")),
        ({"tick": -1}, "loop", ("no tick yet", "wait")),
        (
            {"sources": source("left", rate_hz=12.0)},
            "left hand",
            ("12 Hz", "30 to 500 Hz", "as often"),
        ),
        (
            {"lateness_us": Percentiles(1, 3000, 9000)},
            "loop",
            ("late by 3000 µs", "what else runs"),
        ),
        ({"realtime": False}, "real time", ("not granted", "SCHED_FIFO", "docs/hardware.md")),
        ({"memory_locked": False}, "memory", ("not locked", "memlock")),
        (
            {"scribe": {"state": "recording", "free_mb": 300.0}},
            "disk",
            ("0.3 GB free", "more than 2 GB", "keep_mb"),
        ),
        (
            {
                "mode": "fault",
                "reason": "tool_speed",
                "because": "the tool was measured at 1.30 m/s",
                "remedy": "check",
            },
            "mode",
            ("fault (tool_speed): the tool was measured at 1.30 m/s", "what to do: check"),
        ),
        (
            {"sources": source("left", rate_hz=0.0, age_ms=3000.0, fresh=False)},
            "left hand",
            ("nothing arrived for 3.0 s", "30 to 500 Hz on lab/hands/left", "start the tracker"),
        ),
        (
            {
                "sources": source(
                    "right",
                    fresh=False,
                    age_ms=None,
                    frame="camera",
                    rejected={"wrong_frame": 200},
                    cause="wrong_frame",
                    refused="frame 'camera'; 'base' or none accepted",
                )
            },
            "right hand",
            (
                "100 messages/s rejected as wrong_frame: frame 'camera'; 'base' or none accepted",
                "[hands] frame",
            ),
        ),
        (
            {"sources": source("arm", rate_hz=0.0, age_ms=None, fresh=False)},
            "arm",
            ("joints a, b", "the driver"),
        ),
        (
            {"sources": source("arm", rejected={"older": 90})},
            "arm",
            ("9% of the states contradict", "one publisher of lab/joints/state", "stop one"),
        ),
        (
            {"sources": source("left", rejected={"other_publisher": 200})},
            "left hand",
            ("100 messages/s rejected as other_publisher", "stop one of the two trackers"),
        ),
        (
            {"sources": source("left", scatter_mm=9.0)},
            "left hand",
            ("scatter by 9 mm on each axis", "at most 8 mm", "look at what the tracker sees"),
        ),
        (
            {"sources": source("left", clock_ms=-4000.0)},
            "left hand's clock",
            ("4 s after it arrives", "chrony"),
        ),
        ({"command_heard": False}, "arm's driver", ("nobody listens to lab/joints/command",)),
        (
            {"hands_m": {"left": (0.8, -0.2, 0.9), "right": (0.9, 0.3, 0.1)}},
            "left hand's place",
            (
                "0.60 m from where the skill knows it",
                "(0.60, -0.30, 0.00) to (1.00, 0.00, 0.30) m",
                "base_from_tracker",
            ),
        ),
        (
            {"hands_m": {"left": (0.9, 0.35, 0.1), "right": (0.8, -0.25, 0.1)}},
            "right hand's place",
            ("left and right look swapped",),
        ),
        (
            {"deviation_m": 0.9},
            "skill",
            ("deviate by 90.0 cm", "up to 70.0 cm", "demonstrate this too"),
        ),
        ({"missed": 100}, "loop", ("97 of 1000 deadlines missed", "less than 1% missed", "bench")),
        (
            {"scribe": {"state": "interrupted", "lost": 7, "errors": ["disk full"]}},
            "recording",
            ("7 ticks lost", "full"),
        ),
        (
            {
                "scribe": {
                    "state": "recording",
                    "free_mb": 2400.0,
                    "mb_per_hour": 3600.0,
                    "keep_mb_left": 9000.0,
                }
            },
            "disk",
            ("2.4 GB free", "3.6 GB an hour written: full in 40 min", "1 h", "keep_mb"),
        ),
    ],
)
def test_findings_name_what_is_wrong_and_what_to_do(
    changed: dict[str, Any], what: str, words: tuple[str, ...]
) -> None:
    """Each finding names the expected value too."""
    lines = [
        finding.text()
        for finding in diagnosed(**changed)
        if finding.level == "wrong" and finding.what == what
    ]
    assert lines
    assert all(word in "\n".join(lines) for word in words), lines
    assert all(re.fullmatch(r"wrong .*\n +required: .*\n +what to do: .*", line) for line in lines)


def test_what_need_not_be_mended_is_a_note() -> None:
    assumed = {name: entry for name, entry in HEALTHY.sources.items() if name != "arm"}
    levels = {
        finding.what: finding.level
        for finding in diagnosed(
            mode="hold", reason="operator", sources=assumed, scribe={"state": "off"}
        )
    }
    assert (levels["mode"], levels["arm"], levels["recording"]) == ("note", "note", "note")
    assert "wrong" not in levels.values()


def test_hidden_latency_is_unknown_and_lost_hands_are_not_near() -> None:
    """A latency that clocks hide is unknown; hands that have disappeared are not near."""
    ahead = differing(sources=source("left", clock_ms=-4000.0))
    assert (
        rows(ahead)["latency"]
        == "unknown: the left hand's stamps are 4 s ahead of the daemon's clock"
    )
    assert rows(HEALTHY)["latency"] == "p50 1.00, p99 2.00, max 3.00 ms"
    lost_hand = msgspec.structs.replace(GOOD, fresh=False, age_ms=5000.0, rate_hz=0.0)
    status = differing(sources=HEALTHY.sources | {"left": lost_hand})
    assert rows(status)["nearest"].endswith("; the left hand is assumed where it was last seen")
    rejected = differing(sources=source("right", rejected={"jumped": 3}))
    assert rows(rejected)["rejected"] == "right hand 3 jumped"


def test_causes_come_before_their_effects() -> None:
    """Faults stand before notes, and causes before their effects."""
    silent = source("arm", rate_hz=0.0, age_ms=4000.0, fresh=False)
    diagnosis = diagnosed(
        mode="fault", reason="arm_silent", sources=silent, command_heard=False, realtime=False
    )
    ranked = [(finding.level, finding.what) for finding in diagnosis]
    assert [subject for level, subject in ranked if level == "wrong"] == [
        "arm",
        "arm's driver",
        "mode",
        "real time",
    ]
    assert [level for level, _ in ranked] == sorted((level for level, _ in ranked), reverse=True)


def test_stuck_joint_is_named_before_its_fault() -> None:
    """A joint that does not follow its command is named before it causes a fault."""
    travels = {"a": (0.05, 0.049), "b": (0.31, 0.001), "c": (0.01, 0.0)}
    lines = wrongs(
        diagnosed(
            more={"travels": travels},
            mode="fault",
            reason="arm_error",
            because="a joint was 0.102 rad off",
        )
    )
    assert "b was commanded to move by 0.31 rad, but has not moved since commands began" in lines[0]
    assert "are the drives on?" in lines[0]
    assert [line.split()[1] for line in lines] == ["arm's", "mode"]
    assert "whether its drives are on" in what_to_do("arm_error")


@pytest.mark.parametrize(
    ("lag_ms", "level", "words"),
    [
        (
            None,
            "ok",
            "not measured, because the arm did not follow a motion evenly: "
            "move the hands meanwhile",
        ),
        (12.3, "ok", "the arm follows its commands 12 ms late"),
        (51.7, "note", "the arm follows its commands 52 ms late"),
    ],
)
def test_the_lag_of_the_arm_is_reported_with_what_to_do(
    lag_ms: float | None, level: str, words: str
) -> None:
    diagnosis = diagnosed(more={"lag_ms": lag_ms})
    (lag_finding,) = (finding for finding in diagnosis if finding.what == "arm's lag")
    assert (lag_finding.level, lag_finding.found) == (level, words)
    assert ("lead by the lag: set lag_s of its class" in lag_finding.text()) == (level == "note")
    assert "arm's lag" not in {
        finding.what for finding in diagnosed(sources={"left": GOOD, "right": GOOD})
    }


@pytest.mark.parametrize(
    "changed",
    [
        {"mode": "fault", "reason": "arm_silent"},
        {"mode": "fault", "reason": "arm_error"},
        {"sources": source("arm", rate_hz=0.0, age_ms=4000.0, fresh=False)},
        {"sources": source("left", clock_ms=400.0)},
        {
            "sources": source(
                "right",
                rejected={"ahead": 90},
                cause="ahead",
                refused="stamped 0.2 s after the newest",
            )
        },
    ],
    ids=["silent", "error", "nothing comes", "clock", "ahead"],
)
def test_busy_machine_is_named_before_arm_and_network(changed: dict[str, Any]) -> None:
    """A machine that is too busy is named before arm, network and clock."""
    words = "90 of 1000 deadlines were missed, the loop was up to 60 ms late"
    first, *others = wrongs(diagnosed(busy=words, **changed))
    assert first.startswith(f"wrong  machine            too busy: {words}")
    assert "thirdhand bench measures it" in first
    assert others == wrongs(diagnosed(**changed))


def paths(*hands: tuple[tuple[float, float, float], tuple[float, float, float]]) -> list[Finding]:
    """The findings of statuses over two seconds with the left and right hand at these positions."""
    statuses = [
        differing(
            tick=1000 * (i + 1),
            time_ns=HEALTHY.time_ns + round(2e9 * i / (len(hands) - 1)),
            hands_m={"left": left, "right": right},
        )
        for i, (left, right) in enumerate(hands)
    ]
    return findings(*statuses, own_ns=statuses[-1].time_ns, own_version="0.1.0")


def test_a_tracker_whose_y_points_up_is_told_with_what_to_write() -> None:
    raised = [((-0.2, 0.9 + up, 0.5), (0.2, 0.95 + up / 2, 0.51)) for up in (0.0, 0.1, 0.2)]
    lines = [line for line in wrongs(paths(*raised)) if "tracker's axes" in line]
    assert "write base_from_tracker = [0, 0, 0, 0.7071, 0, 0, 0.7071]" in lines[0]
    settings = converted({"hands": {"base_from_tracker": list(Y_UP)}}, origin="here")
    turned = rotation(settings.hands.base_from_tracker[3:]) @ np.array([0.0, 1.0, 0.0])
    assert np.allclose(turned, [0, 0, 1], atol=1e-4)


def test_hands_on_the_table_do_not_mean_that_y_points_up() -> None:
    """Hands slide over the table along y."""
    inside = [((0.8, -0.3 + shift_m, 0.1), (0.9, 0.3, 0.1)) for shift_m in (0.0, 0.1, 0.2)]
    outside = [((1.4, -0.3 + shift_m, 0.1), (1.4, 0.3, 0.1)) for shift_m in (0.0, 0.1, 0.2)]
    assert not any(
        finding.what == "tracker's axes" for hands in (inside, outside) for finding in paths(*hands)
    )


def test_a_tool_that_is_off_its_target_for_long_is_told() -> None:
    first = differing(target_m=(0.5, 0.2, 0.3))
    now = {"target_m": (0.5, 0.15, 0.3)}
    lines = wrongs(diagnosed(first, **now))
    assert "tool               15 cm or more from its target for 2.0 s" in lines[0]
    diagnosis = diagnosed(first, flags=("separation",), **now)
    assert [
        (finding.level, "give it room" in finding.remedy)
        for finding in diagnosis
        if finding.what == "tool"
    ] == [("note", True)]
    assert not any(
        finding.what == "tool" for finding in diagnosed(first, target_m=HEALTHY.target_m)
    )


def test_a_hand_that_the_skill_does_without_need_not_be_there() -> None:
    unseen = {
        "hands": "left",
        "sources": source("right", rate_hz=0.0, age_ms=None, fresh=False),
        "hand_age_ms": {"left": 4.0},
        "hands_m": {"left": HEALTHY.hands_m["left"]},
        "demonstrated_m": {"left": BOXES["left"]},
    }
    diagnosis = diagnosed(**unseen)
    assert {finding.level for finding in diagnosis} == {"ok"}
    assert "right hand         nothing arrives; the skill does not need it" in [
        finding.text()[7:] for finding in diagnosis
    ]
    assert wrongs(diagnosed(**unseen | {"hands": "both"}))  # a needed hand is missing
    lost_fields = {
        "sources": source("right", rate_hz=0.0, age_ms=3000.0, fresh=False),
        "hand_age_ms": HEALTHY.hand_age_ms,
    }
    # a hand that was lost may be anywhere
    assert "nothing arrived for 3.0 s" in wrongs(diagnosed(**unseen | lost_fields))[0]
    now = differing(**unseen | {"target_m": None})
    assert rows(now)["target"] == "none: the skill needs the left hand"
    assert (
        rows(msgspec.structs.replace(now, hands="both"))["target"]
        == "none: the skill needs both hands"
    )
