"""Memory of a process that runs for months and sends a blueprint with each file."""

from __future__ import annotations

import os
from pathlib import Path

import rerun as rr

from thirdhand.settings.config import Settings
from thirdhand.viewer.blueprint import blueprint


def test_a_sent_blueprint_leaves_no_thread_behind(tmp_path: Path) -> None:
    stream = rr.RecordingStream("thirdhand")
    stream.set_sinks(rr.FileSink(tmp_path / "a.rrd"))
    counts = []
    for _ in range(4):
        blueprint(Settings(), live=False).send_to(stream)
        counts.append(len(os.listdir("/proc/self/task")))
    stream.disconnect()
    assert counts[-1] <= counts[0]
