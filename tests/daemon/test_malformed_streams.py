"""Malformed messages of all input streams are counted and named in the same way."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from support.cell import LISTENING, serving, until
from thirdhand.cli.diagnosis import findings
from thirdhand.contract import cdr, channels
from thirdhand.contract.requests import Status

EVERY_INPUT = f"""{LISTENING}
[hands]
clutch = "key"
gripper = "key"
[skill]
source = "tool/wish"
[recording]
also = ["camera"]
"""
HEARD = [
    channel.key for channel in channels.CHANNELS if channel.direction == "in" and channel.recorded
]
SOURCES = {
    "hands/left": "left hand",
    "hands/right": "right hand",
    "joints/state": "arm",
    "tool/wish": "wish",
}


@pytest.mark.timeout(120)
@pytest.mark.thorough
def test_malformed_messages_are_counted_by_stream(tmp_path: Path) -> None:
    keys = {key: channels.key("thirdhand", key) for key in HEARD} | {"camera": "camera"}
    unstamped_pose = cdr.CDR_HEADER + struct.pack("<7d", *[0.5] * 7)
    payloads = {keys["hands/left"]: unstamped_pose, keys["hands/right"]: bytes(100_000)}
    with serving(tmp_path, "--joints", "state", network=EVERY_INPUT) as daemon:
        before = daemon.client.status()

        def complete_status() -> Status | None:
            for key in keys.values():
                daemon.session.put(key, payloads.get(key, b"\0\1\0\0"))
            status = daemon.client.status()
            return status if all(f"malformed {key}" in status.rejected for key in keys) else None

        status = until(complete_status)
        assert (
            "60 bytes that fit geometry_msgs/msg/Pose or Transform; geometry_msgs/msg/PoseStamped "
            "needed"
        ) in status.sources["left"].refused
        named = {SOURCES.get(key, key) for key in keys}
        for key, stream in status.streams.items():
            assert f"what arrives on {key} is malformed: {stream.refused}" in status.because
        report = findings(before, status, own_ns=status.time_ns, own_version=status.version)
        assert {
            finding.what for finding in report if "rejected as malformed: " in finding.found
        } - {"mode"} == named
    log = daemon.log.read_text(encoding="utf-8")
    assert all(f"{name}: rejected as malformed: " in log for name in named)
