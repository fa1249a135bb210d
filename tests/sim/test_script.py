"""Scripted hands and the teacher: smooth, repeatable, in phase with each other, and a function from
hands to tool.
"""

from __future__ import annotations

import numpy as np
import pytest

from thirdhand_sim.scene import Scene
from thirdhand_sim.script import (
    HandScript,
    PointMotion,
    ScriptPause,
    Teacher,
)
from thirdhand_sim.teach import demonstrations

SCENE = Scene()


def motions(script: HandScript, t: float) -> tuple[PointMotion, PointMotion, PointMotion]:
    return (*script.truth(t), Teacher(SCENE, seed=3, clock=script.clock).truth(t))


@pytest.mark.parametrize("options", [{}, {"speed": 1.7}, {"pauses": (ScriptPause(1.2, 1.0), ScriptPause(5.0, 0.6))}])
def test_velocity_and_acceleration_are_the_derivatives_of_position(options: dict[str, object]) -> None:
    script = HandScript(SCENE, seed=3, **options)  # type: ignore[arg-type]
    h = 1e-5
    for t in np.random.default_rng(0).uniform(0.01, 12.0, 60):
        before, now, after = (motions(script, t + step) for step in (-h, 0.0, h))
        for b, n, a in zip(before, now, after, strict=True):
            np.testing.assert_allclose(n.velocity, (a.position - b.position) / (2 * h), atol=1e-6)
            np.testing.assert_allclose(n.acceleration, (a.velocity - b.velocity) / (2 * h), atol=1e-4)


def test_hands_and_tool_pass_the_scenes_places_when_nothing_scatters() -> None:
    script, teacher = HandScript(SCENE, seed=1, offset_std=0.0), Teacher(SCENE, seed=1, offset_std=0.0)
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


def test_everything_rests_in_the_dwells() -> None:
    script = HandScript(SCENE, seed=5)
    for begin, end in SCENE.dwells:
        for motion in motions(script, 0.5 * (begin + end)):
            assert not motion.velocity.any()


def test_hands_and_tool_stay_as_slow_as_people_and_the_arm_move() -> None:
    script = HandScript(SCENE, seed=1, offset_std=0.0)
    speeds = np.array([[np.linalg.norm(m.velocity) for m in motions(script, t)] for t in np.arange(0.0, 10.6, 0.01)])
    assert speeds[:, :2].max() < 0.35
    assert speeds[:, 2].max() < 0.50


def test_the_same_seed_repeats_every_sample_and_another_does_not() -> None:
    one, same, other = (HandScript(SCENE, seed=seed) for seed in (1, 1, 2))
    times = np.arange(0.0, 2.0, 0.01)
    first = np.array([one.sample(t) for t in times])
    np.testing.assert_array_equal(first, [same.sample(t) for t in times])
    assert np.abs(first - [other.sample(t) for t in times]).max() > 0.001


def test_ends_scatter_by_eight_millimetres_on_each_axis() -> None:
    ends = np.array([HandScript(SCENE, seed=seed).truth(3.2).left.position for seed in range(300)]) - SCENE.handover
    np.testing.assert_allclose(ends.std(axis=0), 0.008, rtol=0.15)
    np.testing.assert_allclose(ends.mean(axis=0), 0.0, atol=0.002)


def test_tremor_has_the_size_and_the_band_that_were_asked_for() -> None:
    script = HandScript(SCENE, seed=4, tremor_rms=0.0015, noise_std=0.0)
    times = np.arange(0.0, 10.0, 0.01)
    shake = np.array([script.sample(t)[0][:3] - script.truth(t).left.position for t in times])
    np.testing.assert_allclose(np.sqrt((shake**2).mean()), 0.0015, rtol=0.1)
    power = (np.abs(np.fft.rfft(shake, axis=0)) ** 2).sum(axis=1)
    band = np.abs(np.fft.rfftfreq(len(times), 0.01) - 9.0) <= 1.2
    assert power[band].sum() > 0.97 * power.sum()


def test_noise_has_its_own_size_and_leaves_the_truth_alone() -> None:
    script = HandScript(SCENE, seed=4, tremor_rms=0.0, noise_std=0.0005)
    truth = script.truth(1.0).right.position.copy()
    noise = np.array([script.sample(1.0)[1][:3] for _ in range(2000)]) - truth
    np.testing.assert_allclose(noise.std(axis=0), 0.0005, rtol=0.1)
    np.testing.assert_array_equal(script.truth(1.0).right.position, truth)


def test_quaternions_have_unit_norm() -> None:
    for pose in (*HandScript(SCENE, seed=1).sample(2.0), Teacher(SCENE, seed=1).sample(2.0)):
        assert np.linalg.norm(pose[3:]) == pytest.approx(1.0)


def test_the_taught_tool_points_forward_and_down_with_a_level_axis_across() -> None:
    x, y, z, w = Teacher(SCENE, seed=1).sample(0.0)[3:]
    points = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    across = (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x))
    np.testing.assert_allclose(points, (np.sqrt(0.5), 0.0, -np.sqrt(0.5)), atol=1e-12)
    np.testing.assert_allclose(across, (0.0, 1.0, 0.0), atol=1e-12)


def test_a_pause_stops_the_hands_and_makes_the_script_longer() -> None:
    script = HandScript(SCENE, seed=1, pauses=(ScriptPause(1.0, 1.5),))
    assert not script.truth(1.8).left.velocity.any()
    assert script.duration_s == pytest.approx(SCENE.duration_s + 1.5 - 0.3)
    np.testing.assert_allclose(
        script.truth(script.duration_s).left.position, HandScript(SCENE, seed=1).truth(10.6).left.position
    )


def test_in_a_deep_pause_the_hands_go_back_the_way_they_came_and_come_again() -> None:
    clock = HandScript(SCENE, seed=1, pauses=(ScriptPause(4.0, 1.5, depth=2.0),)).clock
    before, turned, after = clock.at(3.9), clock.at(4.8), clock.at(6.0)
    assert (before[1], turned[1], after[1]) == pytest.approx((1.0, -1.0, 1.0))
    assert after[0] == pytest.approx(6.0 - 2 * (1.5 - 0.3))
    assert clock.elapsed(SCENE.duration_s) == pytest.approx(SCENE.duration_s + 2 * (1.5 - 0.3))
    assert clock.at(clock.elapsed(4.0))[0] == pytest.approx(4.0)
    assert clock.elapsed(4.0) > 5.5  # for good


@pytest.mark.parametrize(
    "options",
    [{"speed": 0.0}, {"pauses": (ScriptPause(1.0, 0.1),)}, {"pauses": (ScriptPause(1.0, 2.0), ScriptPause(2.0, 1.0))}],
)
def test_a_clock_that_cannot_run_is_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"speed|pause"):
        HandScript(SCENE, seed=1, **options)  # type: ignore[arg-type]


def test_one_hand_configuration_never_goes_with_two_places_of_the_tool() -> None:
    taught = demonstrations(SCENE, count=5, seed=1)
    hands = np.concatenate([np.hstack((d.left[::5, :3], d.right[::5, :3])) for d in taught])
    tool = np.concatenate([d.tool[::5, :3] for d in taught])
    near = np.linalg.norm(hands[:, None] - hands[None], axis=2) < 0.01
    apart = np.linalg.norm(tool[:, None] - tool[None], axis=2)[near]
    assert np.percentile(apart, 99) < 0.025  # [m]
