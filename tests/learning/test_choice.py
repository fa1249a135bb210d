"""Hyper-parameters chosen by leaving one demonstration out: the closed form and the choice."""

from __future__ import annotations

import numpy as np
import pytest

from kmp import KMP, GaussianKernel, Gaussians
from kmp.criteria.errors import rms
from thirdhand.workbench.learning.choice import (
    MAX_GAIN,
    POSITION_SCALES,
    RIDGE_M,
    sampled,
    selection_of,
)
from thirdhand.workbench.learning.direct_selection import DirectSelection, ridge_mean
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript, Teacher


def shown(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Hands (T, 6) and tool (T, 3) [m] of one run through the scene."""
    scene = Scene()
    script = HandScript(scene, seed=seed)
    teacher = Teacher(scene, seed=seed)
    times = np.arange(0.0, scene.duration_s, 0.1)
    hands = np.array([np.concatenate([pose[:3] for pose in script.sample(t)]) for t in times])
    return hands, np.array([teacher.truth(t).position for t in times])


@pytest.fixture(scope="module")
def choice() -> DirectSelection:
    return selection_of([shown(seed) for seed in range(4)], 60)


@pytest.mark.parametrize("ridge_m", [None, RIDGE_M])
def test_residuals_are_those_of_left_out_fits(
    choice: DirectSelection, ridge_m: float | None
) -> None:
    """Residuals equal those of primitives and prior means that are fitted without the
    demonstration.
    """
    ell = 4.0
    noise = 0.1
    for group in range(4):
        mine = choice.group == group
        inputs = choice.inputs[~mine]
        outputs = choice.outputs[~mine]
        prior = choice.outputs.mean(axis=0)
        if ridge_m is not None:
            prior = ridge_mean(inputs, outputs, ridge_m, max_gain=MAX_GAIN)
        reference = Gaussians.of(outputs, deviation=1.0)
        fitted = KMP.fit(
            inputs, reference, kernel=GaussianKernel(ell), lambda_mean=noise, prior_mean=prior
        )
        expected = choice.outputs[mine] - fitted.mean(choice.inputs[mine])
        np.testing.assert_allclose(choice.residuals(ell, noise, ridge_m)[mine], expected, atol=1e-9)


def test_choice_is_the_best_tried(choice: DirectSelection) -> None:
    parameters = choice.parameters()
    errors = {
        (ell, noise): rms(choice.residuals(ell, noise))
        for ell in POSITION_SCALES.ells
        for noise in 10.0 ** np.arange(-3.0, 0.1, 0.5)
    }
    assert errors[parameters.ell, parameters.noise] == min(errors.values())
    assert choice.parameters(8.0).ell == 8.0


@pytest.mark.parametrize("earlier", [0, 30])
@pytest.mark.parametrize("new", [1, 7, 12, 150, 600, 5000])
def test_many_takes_have_few_points(new: int, earlier: int) -> None:
    """Each take has its least number of points while these are few; then takes are sampled at
    different shares, and their points stay as many.
    """
    shares = sampled(200, new, earlier, 4, 600)
    assert len(shares) == new + earlier
    total = sum(map(len, shares))
    assert total <= 600
    assert total >= (100 if earlier else min(200, 4 * new)) - new % 200
    assert all(len(one) >= 4 for one in shares) or total > 100
    everything = np.concatenate(shares)
    assert everything.min() >= 0.0
    assert everything.max() <= 1.0
    if new >= 600:
        occupied = np.histogram(everything, bins=20, range=(0.0, 1.0))[0]
        assert occupied.min() > 0.5 * occupied.mean(), "the points are everywhere in the takes"
