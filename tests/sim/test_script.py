"""Scripted hands and the teacher: smooth, repeatable and in phase; the tool is a function of the
hands.
"""

from __future__ import annotations

import numpy as np
import pytest

from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript, PointMotion, ScriptPause, Teacher

SCENE = Scene()


def motions(script: HandScript, t: float) -> tuple[PointMotion, PointMotion, PointMotion]:
    return (*script.truth(t), Teacher(SCENE, seed=3, clock=script.clock).truth(t))


@pytest.mark.parametrize(
    "options", [{}, {"speed": 1.7}, {"pauses": (ScriptPause(1.2, 1.0), ScriptPause(5.0, 0.6))}]
)
def test_motion_has_its_derivatives(options: dict[str, object]) -> None:
    """Velocity and acceleration are the derivatives of position."""
    script = HandScript(SCENE, seed=3, **options)  # type: ignore[arg-type]
    h = 1e-5
    for t in np.random.default_rng(0).uniform(0.01, 12.0, 60):
        before, now, after = (motions(script, t + step) for step in (-h, 0.0, h))
        for b, n, a in zip(before, now, after, strict=True):
            np.testing.assert_allclose(n.velocity, (a.position - b.position) / (2 * h), atol=1e-6)
            np.testing.assert_allclose(
                n.acceleration, (a.velocity - b.velocity) / (2 * h), atol=1e-4
            )


def test_places_are_passed_without_scatter() -> None:
    """Hands and tool pass the scene's places when nothing scatters."""
    script = HandScript(SCENE, seed=1, offset_std=0.0)
    teacher = Teacher(SCENE, seed=1, offset_std=0.0)
    ends = [0.0, *(end for end, _ in SCENE.dwells)]
    np.testing.assert_allclose(
        [script.truth(t).left.position for t in ends],
        [SCENE.left_start, SCENE.handover, SCENE.soldering, SCENE.soldering],
        atol=1e-12,
    )
    np.testing.assert_allclose(
        [script.truth(t).right.position for t in ends],
        [SCENE.right_start, SCENE.right_start, SCENE.iron, SCENE.right_final],
        atol=1e-12,
    )
    np.testing.assert_allclose(
        [teacher.truth(t).position for t in ends],
        [SCENE.robot_start, SCENE.offer, SCENE.glass, SCENE.carry],
        atol=1e-12,
    )


def test_seed_repeats_every_sample() -> None:
    """Another seed gives other samples."""
    script, twin, other = (HandScript(SCENE, seed=seed) for seed in (1, 1, 2))
    times = np.arange(0.0, 2.0, 0.01)
    first = np.array([script.sample(t) for t in times])
    np.testing.assert_array_equal(first, [twin.sample(t) for t in times])
    assert np.abs(first - [other.sample(t) for t in times]).max() > 0.001


def test_tremor_has_size_and_band() -> None:
    script = HandScript(SCENE, seed=4, tremor_rms=0.0015, noise_std=0.0)
    times = np.arange(0.0, 10.0, 0.01)
    shake = np.array([script.sample(t)[0][:3] - script.truth(t).left.position for t in times])
    np.testing.assert_allclose(np.sqrt((shake**2).mean()), 0.0015, rtol=0.1)
    power = (np.abs(np.fft.rfft(shake, axis=0)) ** 2).sum(axis=1)
    band = np.abs(np.fft.rfftfreq(len(times), 0.01) - 9.0) <= 1.2
    assert power[band].sum() > 0.97 * power.sum()


def test_hands_go_back_in_a_deep_pause() -> None:
    """In a long pause, the hands return along their path and come again."""
    clock = HandScript(SCENE, seed=1, pauses=(ScriptPause(4.0, 1.5, depth=2.0),)).clock
    before = clock.at(3.9)
    turned = clock.at(4.8)
    after = clock.at(6.0)
    assert (before[1], turned[1], after[1]) == pytest.approx((1.0, -1.0, 1.0))
    assert after[0] == pytest.approx(6.0 - 2 * (1.5 - 0.3))
    assert clock.elapsed(SCENE.duration_s) == pytest.approx(SCENE.duration_s + 2 * (1.5 - 0.3))
    assert clock.at(clock.elapsed(4.0))[0] == pytest.approx(4.0)
    assert clock.elapsed(4.0) > 5.5  # when script time 4 s is passed for the last time


@pytest.mark.parametrize(
    "options",
    [
        {"speed": 0.0},
        {"pauses": (ScriptPause(1.0, 0.1),)},
        {"pauses": (ScriptPause(1.0, 2.0), ScriptPause(2.0, 1.0))},
    ],
)
def test_a_clock_that_cannot_run_is_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"speed|pause"):
        HandScript(SCENE, seed=1, **options)  # type: ignore[arg-type]
