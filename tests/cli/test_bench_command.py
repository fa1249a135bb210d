"""`thirdhand bench`: what happens beside the loop, and the soak; its report: test_latency."""

from __future__ import annotations

import numpy as np
import pytest

from service.timing import loads, soak
from support.cell import told

pytestmark = pytest.mark.timeout(180)


@pytest.mark.timed
@pytest.mark.thorough
def test_what_happens_beside_the_loop_is_put_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loads, "LOADS", tuple(load for load in loads.LOADS if load.what == "scribe killed"))
    monkeypatch.setattr(loads, "large_skill", bytes)
    (row,) = loads.run(500, 1.0)
    assert row["mode"] == "follow"
    assert row["ticks"] == pytest.approx(500, abs=150)
    assert row["identical"] == row["recorded"] > 0
    assert row["scribe"]["restarts"] > 0
    assert row["scribe"]["errors"]


def test_a_leak_is_told_from_noise() -> None:
    rng = np.random.default_rng(0)
    at = np.arange(0.0, 1800.0, 5.0)
    files = np.full_like(at, 40)
    flat = np.column_stack([at, 250 + rng.normal(scale=0.3, size=len(at)), files])
    leaking = flat + np.column_stack([0 * at, 5 * at / 3600, 0 * at])
    found, leak = soak.judged(flat), soak.judged(leaking)
    assert abs(found["slope_mb_per_h"]) < 2 * found["interval_mb_per_h"] < 1.5
    assert leak["slope_mb_per_h"] == pytest.approx(5, abs=2 * leak["interval_mb_per_h"])


@pytest.mark.timed
@pytest.mark.thorough
def test_soak_reports_each_process() -> None:
    report = soak.run(0.12, 500)
    assert set(report["processes"]) == {"daemon", "fork server", "scribe", "skill worker"}
    assert report["lost"] == report["restarts"] == 0
    assert "MB/h" in soak.text(report)


@pytest.mark.parametrize("rate", ["49", "1001", "fast"])
@pytest.mark.parametrize("command", ["demo", "bench", "serve"])
def test_a_rate_out_of_range_is_bad_usage(command: str, rate: str) -> None:
    done = told(command, "--rate", rate)
    assert done.returncode == 2
    assert f"{rate} given, 50 to 1000 Hz needed" in done.stderr
