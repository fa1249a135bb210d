"""Malformed messages of every stream that a cell receives: counted and named in the same way."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from service.cli.diagnosis import findings
from service.contract import cdr, channels
from service.contract.incidents import MALFORMED
from service.contract.messages import JointState
from service.contract.requests import Status
from service.settings.config import Settings
from support.cell import LISTENING, Tracker, serving, until
from support.wam import JOINT_NAMES

IMAGES = "camera/front"
EVERY_INPUT = f'{LISTENING}\n[hands]\nclutch = "key"\ngripper = "key"\n[recording]\nalso = ["{IMAGES}"]\n'
HEARD = [channel.key for channel in channels.CHANNELS if channel.direction == "in" and channel.recorded]


@pytest.mark.timeout(120)
@pytest.mark.thorough
def test_malformed_messages_of_every_stream_are_counted_and_named(tmp_path: Path) -> None:
    keys = {key: channels.key("thirdhand", key) for key in HEARD} | {IMAGES: IMAGES}
    with serving(tmp_path, "--joints", "state", network=EVERY_INPUT) as daemon:
        before = daemon.client.status()

        def complete_status() -> Status | None:
            for key in keys.values():
                daemon.session.put(key, b"\0\1\0\0")
            status = daemon.client.status()
            return status if all(f"{MALFORMED} {key}" in status.rejected for key in keys) else None

        status = until(complete_status)
        assert set(status.streams) == set(keys) - {"hands/left", "hands/right", "joints/state"}
        for key, stream in status.streams.items():
            assert (stream.cause, stream.rejected[MALFORMED]) == (MALFORMED, status.rejected[f"{MALFORMED} {key}"])
            assert f"what arrives on {key} is malformed: {stream.refused}" in status.because
            assert status.received[key] >= stream.rejected[MALFORMED]
        assert "publish the type and encoding that docs/wire.md lists for the key" in status.remedy
        told = [
            one.what
            for one in findings(before, status, own_ns=status.time_ns, own_version=status.version)
            if f"rejected as {MALFORMED}: " in one.found and one.what != "mode"
        ]
        assert sorted(told) == sorted(["left hand", "right hand", "arm", *status.streams])
    log = daemon.log.read_text(encoding="utf-8")
    assert all(f"{key}: rejected as {MALFORMED}: " in log for key in status.streams)


@pytest.mark.timeout(120)
@pytest.mark.thorough
def test_a_state_of_all_joints_of_a_robot_is_accepted(tmp_path: Path) -> None:
    fingers = tuple(f"humanoid/right_hand_ring_finger_distal_pitch_joint_{i:02d}" for i in range(65))
    names, posture = JOINT_NAMES + fingers, (*Settings().arm.posture, *(0.0,) * 65)
    with serving(tmp_path, "--joints", "state", network=LISTENING) as daemon, Tracker(daemon.session):

        def is_following(status: dict[str, Any]) -> bool:
            state = JointState(time.time_ns(), names, posture, (0.0,) * 72, (0.0,) * 72)
            daemon.session.put("thirdhand/joints/state", cdr.encode_joints(state))
            return bool(status["mode"] == "follow")

        assert daemon.until(is_following)["rejected"] == {}
