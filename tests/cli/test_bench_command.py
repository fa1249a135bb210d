"""The rate of `thirdhand bench` and of other commands; its report: test_latency."""

from __future__ import annotations

import pytest

from support.cell import told


@pytest.mark.parametrize("rate", ["49", "1001", "fast"])
@pytest.mark.parametrize("command", ["demo", "bench", "serve"])
def test_a_rate_out_of_range_is_bad_usage(command: str, rate: str) -> None:
    done = told(command, "--rate", rate)
    assert done.returncode == 2
    assert f"{rate} given, 50 to 1000 Hz needed" in done.stderr
