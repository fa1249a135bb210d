"""Which tests are `quick` and `thorough`, and the order in which files are begun.

A test's tier stands beside it. `thorough` is run by `.ci/run` alone; so are all cases but the first
of a test marked `one_case`. `quick` is every other test of a file that starts no process and plays
no session, and a few that are marked so; a contributor runs these before each commit.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path

SLOW = re.compile(  # words of tests that start a process, open a session, play one, learn or wait
    r"\b(support\.cell|subprocess|chromium|sleep|golden|(serving|launched|open_session|told|main|Controller|Loop|Bench|learn|played"
    r"|replay)\(|mark\.(one_case|thorough|timed))"
)
REAL_STARTS = (  # these start each command as a user does
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
    """The place of a file in the order in which files are begun: the longest first."""
    return (*LONGEST_FIRST, file).index(file)
