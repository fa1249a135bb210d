"""The demo at any rate, with any arm and in both engines: the bench plays commands back at the
service's rate.
"""

from __future__ import annotations

import importlib.util

import pytest

from support.demo import SCENE, Played, played, taught
from thirdhand.daemon.launch import ENGINES
from thirdhand.recordings.shipped import ARMS, cell_of
from thirdhand_sim.lab.rehearsal import rehearse
from thirdhand_sim.network import BenchError
from thirdhand_sim.script import HandScript

RATES_HZ = (100, 250, 500, 700, 1000)
LAG_TICKS = 2.0  # lag of the arm behind its command
SPEED_RADPS = 0.75  # approximate speed of the fastest joint in this scene


def done(rate_hz: int, arm: str, engine: str, bench_hz: int | None = None) -> Played:
    if importlib.util.find_spec(engine) is None:
        pytest.skip(f"{ENGINES[engine]} is not installed")
    return played(cell_of(arm, rate_hz=rate_hz), engine, bench_hz=bench_hz)


def assert_succeeded(run: Played, rate_hz: int, bench_hz: int | None = None) -> None:
    assert run.events.success
    assert run.followed
    for name in ("handover", "grasp", "carry"):
        assert getattr(run.events, name).error_mm < 1.0
    assert run.error_rad < SPEED_RADPS * (LAG_TICKS / rate_hz + LAG_TICKS / (bench_hz or rate_hz))


@pytest.mark.parametrize(("rate_hz", "bench_hz"), [(1000, 250), (100, 500)])
def test_bench_follows_rate_of_service(rate_hz: int, bench_hz: int) -> None:
    """The bench has another rate than the service."""
    assert_succeeded(done(rate_hz, "wam", "pybullet", bench_hz), rate_hz, bench_hz)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.one_case
def test_demo_succeeds_with_every_arm(rate_hz: int, engine: str, arm: str) -> None:
    """The demo succeeds at every rate and in every engine too."""
    assert_succeeded(done(rate_hz, arm, engine), rate_hz)


@pytest.mark.parametrize("arm", ARMS)
def test_loop_at_50_hz_does_the_task(arm: str) -> None:
    """A follower, which needs a faster loop, explains its refusal."""
    cell = cell_of(arm, rate_hz=50)
    run = rehearse(HandScript(SCENE, seed=1), lambda _: taught(), settings=cell)
    assert run.events.success
    assert max(run.errors_mm) < 1.0
    with pytest.raises(
        BenchError, match=r"50 Hz is too slow: .* an arm brakes 20 ms after its last command; 67 Hz"
    ):
        played(cell)
