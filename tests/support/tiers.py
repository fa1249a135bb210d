"""The tiers `quick` and `thorough` of tests, and the order of files.

Marks stand at the tests. Only `.ci/run` runs `thorough` tests, and more than the first case of
tests marked `one_case`. `quick` are the other tests of files that start no process and play no
session, and a few marked tests; contributors run these before each commit.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path

SLOW = re.compile(  # words of tests that start a process, open a session, play one, learn or wait
    r"\b(support\.cell|subprocess|chromium|sleep|golden|(serving|launched|open_session|told|main|Controller|Loop|Bench|learn|played"
    r"|replay)\(|mark\.(one_case|thorough|timed))"
)
REAL_STARTS = (  # tests in these files start each command as a user does
    "process/test_interrupt.py",
    "daemon/test_start.py",
    "daemon/test_systemd.py",
    "test_latency.py",
    "test_wheel.py",
)
LONGEST_FIRST = (
    "test_static.py",
    "daemon/test_roles.py",
    "daemon/test_survival.py",
    "trackers/test_calibration.py",
    "core/test_scenes.py",
    "process/test_interrupt.py",
    "daemon/test_daemon.py",
    "cli/test_view_live.py",
    "daemon/test_start.py",
    "cli/test_doctor.py",
    "learning/test_segmented_tasks.py",
)


@functools.cache
def is_quick_file(path: Path) -> bool:
    """True if a file of tests starts no process and plays no session."""
    return SLOW.search(path.read_text(encoding="utf-8")) is None


def order(file: str) -> int:
    """The rank of a file: the longest one runs first."""
    return (*LONGEST_FIRST, file).index(file)
