"""Demonstrations of different durations over a common phase, and seeds as numpy generators."""

import numpy as np
import pytest

import kmp
from kmp import GaussianMixture, aligned


def path(duration_s, count, begin_s=0.0):
    """The same path in the plane in another time, with its rates."""
    time = np.linspace(0, duration_s, count)[:, None]
    phase = time / duration_s
    values = np.hstack([np.sin(3 * phase), phase**2])
    rates = np.hstack([3 * np.cos(3 * phase), 2 * phase]) / duration_s
    return time + begin_s, np.hstack([values, rates])


DEMONSTRATIONS = [path(2.0, 80), path(3.0, 120, begin_s=10.0), path(1.5, 51)]


def test_aligned_demonstrations_are_the_same_path():
    expected = path(1.0, 51)
    for phase, outputs in aligned(DEMONSTRATIONS, velocity=True):
        assert (phase[0, 0], phase[-1, 0]) == (0.0, 1.0)
        interpolated = np.interp(expected[0][:, 0], phase[:, 0], outputs[:, 0])
        np.testing.assert_allclose(interpolated, expected[1][:, 0], atol=1e-3)
        np.testing.assert_allclose(outputs[[0, -1]], expected[1][[0, -1]], atol=1e-12)
    for (_, kept), (_, given) in zip(aligned(DEMONSTRATIONS), DEMONSTRATIONS, strict=True):
        assert np.array_equal(kept, given)


def test_aligned_demonstrations_are_learned():
    """Over time the different durations blur the path; over the phase they do not."""
    values = [(time - time[0], outputs[:, :2]) for time, outputs in DEMONSTRATIONS]
    blurred, clear = (
        kmp.learn(data, components=6).scores[0].rmse for data in (values, aligned(values))
    )
    assert clear < 0.01
    assert blurred > 0.1
    learned = kmp.learn(aligned(DEMONSTRATIONS, velocity=True), components=6, velocity=True)
    phase, expected = path(1.0, 20)
    np.testing.assert_allclose(learned.primitive.mean(phase)[:, :2], expected[:, :2], atol=0.02)


@pytest.mark.parametrize(
    ("time", "width", "words"),
    [
        ([[0.0], [0.0]], 4, "must increase"),
        ([[0.0], [2.0], [1.0], [3.0]], 4, "must increase"),
        ([[0.0, 0.0], [1.0, 1.0]], 4, "2 inputs .* needed is time"),
        ([[0.0], [1.0]], 3, "3 outputs .* as many rates as values"),
    ],
)
def test_what_has_no_phase_is_refused(time, width, words):
    with pytest.raises(ValueError, match=rf"demonstrations\[0\]: .*{words}"):
        aligned([(time, np.zeros((len(time), width)))], velocity=True)


def test_seed_may_be_a_generator():
    """It is 0 by default; generators in the same state give the same, and advance."""
    samples = np.hstack(DEMONSTRATIONS[0])
    mixture = GaussianMixture.fit(samples, components=3)
    again = GaussianMixture.fit(samples, components=3, seed=0)
    assert np.array_equal(mixture.means, again.means)
    first, second = (np.random.default_rng(1) for _ in range(2))
    drawn = mixture.sample_inputs(5, dimensions=1, seed=first)
    assert np.array_equal(drawn, mixture.sample_inputs(5, dimensions=1, seed=second))
    assert not np.array_equal(drawn, mixture.sample_inputs(5, dimensions=1, seed=first))
