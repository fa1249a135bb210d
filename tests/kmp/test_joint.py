"""Several queries together: joint covariance, sampled trajectories, Jacobians in a batch."""

import numpy as np
import pytest

from kmp import KMP, GaussianKernel, Gaussians, PeriodicKernel, VelocityKernel
from support.primitives import naive

KERNELS = {
    "gaussian": GaussianKernel(0.5),
    "periodic": PeriodicKernel(0.5, 2.5),
    "velocity": VelocityKernel(2.0),
}
T = np.linspace(0, 2, 40)[:, None]
QUERIES = np.concatenate([T[::8] + 0.01, [[5.0]]])


def fitted(kernel="gaussian", representation="dense", adapted=False):
    mean = np.hstack([np.sin(2 * T), 2 * np.cos(2 * T)])
    root = 0.05 * np.random.default_rng(0).normal(size=(40, 2, 2))
    reference = Gaussians(mean, root @ root.swapaxes(1, 2) + 1e-3 * np.eye(2))
    options = {"lambda_mean": 1.0, "lambda_covariance": 3.0, "representation": representation}
    primitive = KMP.fit(T, reference, kernel=KERNELS[kernel], **options)
    if not adapted:
        return primitive
    return primitive.adapt(
        [[0.5], [1.51]],
        Gaussians(mean[[10, 29]] + 0.1, np.tile(0.5 * np.eye(2), (2, 1, 1))),
        tolerance=0.02,
    )


@pytest.fixture(
    params=[(k, r, a) for k in KERNELS for r in ("dense", "low_rank") for a in (False, True)],
    ids=str,
)
def skill(request):
    return fitted(*request.param)


def test_joint_covariance_is_the_naive_one(skill):
    _, covariance = naive(skill, QUERIES)
    within = 1e-9 if skill.representation == "dense" else 1e-6
    np.testing.assert_allclose(
        skill.predict_joint(QUERIES).covariance[0], covariance.reshape(12, 12), atol=within
    )


def test_trajectories_have_mean_and_covariance():
    """The trajectories follow from the seed."""
    skill = fitted()
    drawn = skill.sample(QUERIES, 20_000, seed=3)
    joint = skill.predict_joint(QUERIES)
    assert drawn.shape == (20_000, 6, 2)
    flat = drawn.reshape(20_000, -1)
    scale = np.sqrt(np.diagonal(joint.covariance[0]))
    np.testing.assert_allclose((flat.mean(axis=0) - joint.mean[0]) / scale, 0, atol=0.04)
    np.testing.assert_allclose(
        (np.cov(flat.T) - joint.covariance[0]) / np.outer(scale, scale), 0, atol=0.05
    )
    np.testing.assert_array_equal(
        skill.sample(QUERIES, 2, seed=3), skill.sample(QUERIES, 2, seed=3)
    )
    assert not np.array_equal(skill.sample(QUERIES, 2, seed=3), skill.sample(QUERIES, 2, seed=4))


def test_jacobians_are_those_of_one_by_one(skill):
    jacobians = skill.jacobians(QUERIES)
    assert jacobians.shape == (6, 2, 1)
    np.testing.assert_allclose(jacobians, [skill.jacobian(s) for s in QUERIES], atol=1e-9)
    assert skill.jacobians(QUERIES[:0]).shape == (0, 2, 1)


@pytest.mark.parametrize("size", [(1e-9, 1e-9), (1.0, 1e-9)])
def test_small_outputs_scale(size):
    """Covariances, their causes and samples are those of outputs of size 1."""
    queries = np.linspace(0, 2, 60)[:, None]

    def scaled(unit):
        reference = Gaussians.of(unit * np.hstack([np.sin(2 * T), np.cos(T)]), deviation=0.1 * unit)
        prior = np.square(unit)
        skill = KMP.fit(
            T, reference, kernel=KERNELS["gaussian"], lambda_mean=1, prior_covariance=prior
        )
        causes = skill.uncertainty(queries)
        joint = np.diagonal(skill.predict_joint(queries).covariance[0]).reshape(-1, 2)
        variances = [joint, *np.diagonal([causes.variability, causes.distance], axis1=2, axis2=3)]
        spread = skill.sample(queries, 400).std(axis=0)
        return [variance / prior for variance in variances], spread / unit

    (expected, spread), (variances, scaled_spread) = scaled(np.ones(2)), scaled(np.array(size))
    np.testing.assert_allclose(variances, expected, atol=1e-9)
    np.testing.assert_allclose(scaled_spread, spread, rtol=0.2)


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
def test_a_rhythmic_skill_has_no_seam(representation):
    phase = np.linspace(0, 2 * np.pi, 60, endpoint=False)[:, None]
    mean = np.hstack([np.sin(phase), np.cos(2 * phase)])
    reference = Gaussians.of(mean, deviation=0.01)
    kernel = PeriodicKernel(1.0, 2 * np.pi)
    primitive = KMP.fit(
        phase, reference, kernel=kernel, lambda_mean=1.0, representation=representation
    )
    via = primitive.adapt(
        [[2 * np.pi - 0.02]], Gaussians.of([[0.2, 0.9]], deviation=1e-4), tolerance=0.06
    )
    assert list(via.inner.changes.replaced) == [0]  # the nearest point across the seam
    a = np.zeros((1, 1))
    b = np.full((1, 1), 2 * np.pi)
    for skill in (primitive, via):
        assert np.array_equal(skill.mean(a), skill.mean(b))
        assert np.array_equal(skill.predict(a).covariance, skill.predict(b).covariance)
        assert np.array_equal(skill.jacobian(a[0]), skill.jacobian(b[0]))
        bends = [skill.predict_motion(s[0], [1.0], [0.0]).curvature for s in (a, b)]
        assert np.array_equal(*bends)
        many = np.linspace(-9, 9, 7)[:, None]
        np.testing.assert_allclose(skill.mean(many + 4 * np.pi), skill.mean(many), atol=1e-9)
        just = np.array([[2 * np.pi - 1e-9], [1e-9]])
        np.testing.assert_allclose(*skill.mean(just), atol=1e-7)
    np.testing.assert_allclose(primitive.mean(phase), mean, atol=1e-2)
    np.testing.assert_allclose(via.mean([[2 * np.pi - 0.02]]), [[0.2, 0.9]], atol=1e-4)
