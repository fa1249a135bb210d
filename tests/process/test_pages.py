"""Memory of the start: it is released, and released code still works."""

from __future__ import annotations

from support.cell_commands import python

PROGRAM = """
import re
import numpy as np
from numba import njit
from thirdhand.process.pages import release_start_memory, share_one_heap

def mapped_mb():
    return int(re.search(r"^RssFile:\\s+(\\d+) kB", open("/proc/self/status").read(), re.M)[1]) / 1e3

double = njit(lambda x: 2 * x)
before = double(3), np.linalg.inv(np.diag([2.0, 4.0])).tolist()
used_mb = mapped_mb()
share_one_heap()
release_start_memory()
left_mb = mapped_mb()
assert (double(3), np.linalg.inv(np.diag([2.0, 4.0])).tolist()) == before
assert njit(lambda x: x + 1)(1.5) == 2.5
print(used_mb, left_mb)
"""


def test_code_of_the_start_is_released_and_runs_again() -> None:
    done = python(PROGRAM)
    assert done.returncode == 0, done.stderr
    used_mb, left_mb = map(float, done.stdout.split())
    assert used_mb > 60
    assert left_mb < 0.3 * used_mb
