"""What `thirdhand doctor` finds in statuses: nothing in a healthy cell's, and each thing that is
wrong, with what is wanted and what to do.
"""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from service.cli.diagnosis import Finding, findings
from service.cli.status import line, rows
from service.contract.requests import Percentiles, Source, Status

NONE = Percentiles()
GOOD = Source(rate_hz=100.0, age_ms=4.0, fresh=True, clock_ms=1.5, frame="base")
BOXES = {"left": ((0.6, -0.3, 0.0), (1.0, 0.0, 0.3)), "right": ((0.7, 0.05, 0.0), (1.0, 0.4, 0.2))}
HEALTHY = Status(
    cell="lab",
    mode="follow",
    reason="",
    flags=(),
    tick=1000,
    rate_hz=500.0,
    missed=3,
    realtime=True,
    memory_locked=True,
    skill="soldering",
    places=(),
    rejected={},
    hand_age_ms={"left": 4.0, "right": 4.0},
    hand_distance_m=0.5,
    hand_limit_m_s=1.5,
    lateness_us=Percentiles(1, 90, 300),
    work_us=NONE,
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
    target_m=(0.5, 0.1, 0.3),
    deviation_m=0.02,
    threshold_m=0.7,
)


def diagnosed(**changed: Any) -> list[Finding]:
    """The findings of a healthy cell of which something has become otherwise, two seconds later."""
    now = msgspec.structs.replace(HEALTHY, tick=2000, time_ns=HEALTHY.time_ns + 2 * 10**9)
    now = msgspec.structs.replace(now, **changed)
    return list(findings(HEALTHY, now, own_ns=now.time_ns, own_version="0.1.0"))


def source(name: str, **changed: Any) -> dict[str, Source]:
    return HEALTHY.sources | {name: msgspec.structs.replace(HEALTHY.sources[name], **changed)}


def test_of_a_healthy_cell_nothing_is_wrong_and_everything_is_told() -> None:
    found = diagnosed()
    assert {finding.level for finding in found} == {"ok"}
    told = {finding.what for finding in found}
    assert told >= {"mode", "left hand", "right hand", "arm", "arm's driver", "loop", "real time", "memory", "disk"}


@pytest.mark.parametrize(
    ("changed", "what", "words"),
    [
        ({"version": "0.9"}, "daemon", ("version 0.9", "version 0.1.0", "update")),
        ({"tick": -1}, "loop", ("no tick yet", "wait")),
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
            ("nothing came for 3.0 s", "30 to 500 Hz on lab/hands/left", "start the tracker"),
        ),
        ({"sources": source("left", rate_hz=12.0)}, "left hand", ("12 Hz", "30 to 500 Hz", "as often")),
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
            ("100 messages/s rejected as wrong_frame: frame 'camera'; 'base' or none accepted", "[hands] frame"),
        ),
        ({"sources": source("arm", rate_hz=0.0, age_ms=None, fresh=False)}, "arm", ("joints a, b", "the driver")),
        (
            {"sources": source("left", rejected={"older": 90})},
            "left hand",
            ("45% of what came contradicts", "one publisher of lab/hands/left", "stop one"),
        ),
        ({"sources": source("right", contested=0.3)}, "right hand", ("30% of what came", "one publisher", "stop one")),
        (
            {"sources": source("left", scatter_mm=9.0)},
            "left hand",
            ("scatters by 9 mm an axis, 8 accepted", "stop one"),
        ),
        ({"sources": source("left", clock_ms=-4000.0)}, "left hand's clock", ("4 s after it comes", "chrony")),
        ({"sources": source("left", clock_ms=5000.0)}, "left hand's clock", ("5 s before it comes", "no latency")),
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
        ({"deviation_m": 0.9}, "skill", ("deviate by 90.0 cm", "up to 70.0 cm", "demonstrate this too")),
        ({"missed": 100}, "loop", ("97 of 1000 deadlines missed", "less than 1% missed", "bench")),
        ({"lateness_us": Percentiles(1, 3000, 9000)}, "loop", ("late by 3000 µs", "what else runs")),
        ({"realtime": False}, "real time", ("not granted", "SCHED_FIFO", "docs/hardware.md")),
        ({"memory_locked": False}, "memory", ("not locked", "memlock")),
        (
            {"scribe": {"state": "interrupted", "lost": 7, "errors": ["disk full"]}},
            "recording",
            ("7 ticks lost", "full"),
        ),
        ({"scribe": {"state": "recording", "free_mb": 300.0}}, "disk", ("0.3 GB free", "more than 2 GB", "keep_mb")),
    ],
)
def test_what_is_wrong_is_named_with_what_is_wanted_and_what_to_do(
    changed: dict[str, Any], what: str, words: tuple[str, ...]
) -> None:
    lines = [finding.line() for finding in diagnosed(**changed) if finding.level == "wrong" and finding.what == what]
    assert lines
    assert all(word in "\n".join(lines) for word in words), lines
    assert all(" | wanted: " in line and " | what to do: " in line and "\n" not in line for line in lines)


def test_what_need_not_be_mended_is_a_note() -> None:
    assumed = {name: one for name, one in HEALTHY.sources.items() if name != "arm"}
    levels = {
        finding.what: finding.level
        for finding in diagnosed(mode="hold", reason="operator", sources=assumed, scribe={"state": "off"})
    }
    assert (levels["mode"], levels["arm"], levels["recording"]) == ("note", "note", "note")
    assert "wrong" not in levels.values()


def test_a_latency_that_clocks_hide_is_unknown_and_hands_that_are_gone_are_not_near() -> None:
    ahead = msgspec.structs.replace(HEALTHY, sources=source("left", clock_ms=-4000.0))
    assert rows(ahead)["latency"] == "unknown: the left hand's stamps are 4 s ahead of this daemon's clock"
    assert rows(HEALTHY)["latency"] == "p50 1.00, p99 2.00, max 3.00 ms"
    gone = msgspec.structs.replace(GOOD, fresh=False, age_ms=5000.0, rate_hz=0.0)
    unseen = msgspec.structs.replace(HEALTHY, sources={"left": gone, "right": gone})
    assert rows(unseen)["nearest"] == "no hand is seen"
    assert "not seen for 5.0 s" in line(unseen)
    one = msgspec.structs.replace(HEALTHY, sources=HEALTHY.sources | {"left": gone})
    assert rows(one)["nearest"].endswith("; the left one counts where it was last seen")
    assert "±" in line(HEALTHY)
    rejected = msgspec.structs.replace(HEALTHY, sources=source("right", rejected={"jumped": 3}))
    assert rows(rejected)["rejected"] == "right hand 3 jumped"
