"""A running daemon receives damaged bytes on all its input keys at once, between legal messages:
its recording replays bit for bit, and every bound was kept.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import zenoh

from support.cell import serving
from support.fuzzed import QUIET_S, Traffic, assert_recorded_session_keeps_the_bounds
from thirdhand.contract import cdr
from thirdhand.contract.records import Mode
from thirdhand.settings.config import Settings

SECONDS = 5.0
INTERVAL_S = 0.01
INPUTS = ("hands/left", "hands/right", "joints/state")


@pytest.mark.thorough
def test_a_daemon_under_spoilt_bytes_keeps_every_bound(tmp_path: Path) -> None:
    traffic = Traffic(seed=3)
    traffic.joints = np.array(Settings().arm.posture)

    def follow(sample: zenoh.Sample) -> None:
        traffic.joints = np.array(cdr.decode_joints(sample.payload.to_bytes()).position)

    with serving(tmp_path, "--record", str(tmp_path / "recorded")) as daemon:
        publishers = {key: daemon.session.declare_publisher(f"thirdhand/{key}") for key in INPUTS}
        commands = daemon.session.declare_subscriber("thirdhand/joints/command", follow)
        asked = []
        began = time.monotonic()
        while (t := time.monotonic() - began) < SECONDS:
            for key, payload in traffic.at(t, time.time_ns()):
                if key in publishers:
                    publishers[key].put(payload)
                else:
                    asked.append(
                        daemon.session.get(f"thirdhand/{key}", payload=payload, timeout=5.0)
                    )
            time.sleep(INTERVAL_S)
        answers = [reply.ok is not None for replies in asked[:-5] for reply in replies]
        status = daemon.client.status()
        commands.undeclare()
        assert daemon.end() == 0
    (path,) = (tmp_path / "recorded").glob("*.mcap")
    frames = assert_recorded_session_keeps_the_bounds(path)
    assert sum(status.rejected.values()) > 20, status
    assert answers.count(False) > 0, "of the spoilt requests none was refused"
    followed = (frames["mode"] == Mode.FOLLOW).sum() * Settings().period_s
    assert followed > 0.2 * QUIET_S
