"""Memory of learning: it may grow with the number of samples, not with its square."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from support.paths import ROOT

WHOLE_MB = 400  # limit of the process's largest resident memory
LEARNING_MB = 260  # limit of the memory that learning adds to its imports
# 150 samples last 3 s
TAKES = 72
SAMPLES = 150
CODE = f"""
from thirdhand.process import one_blas_thread
import re
from pathlib import Path
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.learn import learn
from support.circling import circling

def peak_mb():
    return int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024

takes = []
for seed in range({TAKES}):
    stamps_ns, left, right, tool = (part[:{SAMPLES}] for part in circling(seed)[:4])
    takes.append(Demonstration(stamps_ns, left, right, tool, person=str(seed // 6)))
before = peak_mb()
learn(takes, ell=8.0)
print(before, peak_mb())
"""


@pytest.mark.timeout(300)
@pytest.mark.thorough
def test_many_takes_need_little_memory() -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT / "tests")},
    )
    assert done.returncode == 0, done.stderr
    before_mb, after_mb = map(float, done.stdout.split())
    assert after_mb < WHOLE_MB
    assert after_mb - before_mb < LEARNING_MB
