"""Outputs with a prior covariance, and outputs that decouple, equal one plain system."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.spatial.distance import cdist

import kmp
from kmp import KMP, GaussianKernel, Gaussians, LinearConstraints

pytestmark = pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")  # the reference is sure

ELL = 8.0
PENALTY = 10.0
COUNT = 200
OUTPUTS = 3
INPUTS = np.linspace(0, 2, COUNT)[:, None]
QUERIES = INPUTS[::7] + 0.01
MEAN = np.hstack([np.sin(3 * INPUTS + o) for o in range(OUTPUTS)])
VIA = QUERIES[5:7]


def random():
    return np.random.default_rng(4)


def covariances(kind):
    variances = random().uniform(1e-4, 3e-4, (COUNT, OUTPUTS))
    shape = random().normal(size=(OUTPUTS, OUTPUTS))
    if kind == "one shape":
        return variances[:, :1, None] * (shape @ shape.T + np.eye(OUTPUTS))
    if kind == "two alike":
        variances[:, 1] = variances[:, 0]
    return variances[:, :, None] * np.eye(OUTPUTS)


def priors(kind):
    deviations = random().uniform(0.1, 3.0, OUTPUTS)
    correlated = 0.5 * np.eye(OUTPUTS) + 0.5
    return {
        "none": None,
        "variances": deviations**2,
        "covariance": deviations[:, None] * correlated * deviations,
    }[kind]


def plain(inputs, reference, prior):
    """The paper's equations with K (x) B, in one system."""
    b = np.eye(OUTPUTS) if prior is None else prior
    b = np.diag(b) if b.ndim == 1 else b
    total = np.kron(np.exp(-ELL * cdist(inputs, inputs, "sqeuclidean")), b)
    for n, covariance in enumerate(reference.covariance):
        at = slice(n * OUTPUTS, (n + 1) * OUTPUTS)
        total[at, at] += PENALTY * covariance
    across = np.kron(np.exp(-ELL * cdist(QUERIES, inputs, "sqeuclidean")), b)
    mean = across @ np.linalg.solve(total, reference.mean.ravel())
    explained = (across @ np.linalg.solve(total, across.T)).reshape(len(QUERIES), OUTPUTS, -1)
    blocks = explained.reshape(len(QUERIES), OUTPUTS, len(QUERIES), OUTPUTS)
    own = blocks[np.arange(len(QUERIES)), :, np.arange(len(QUERIES))]
    return mean.reshape(-1, OUTPUTS), (b - own) * COUNT / PENALTY


def fitted(kind, prior, representation="dense"):
    return KMP.fit(
        INPUTS,
        Gaussians(MEAN, covariances(kind)),
        kernel=GaussianKernel(ELL),
        lambda_mean=PENALTY,
        prior_covariance=priors(prior),
        representation=representation,
    )


def assert_close(found, expected, share):
    assert np.abs(found - expected).max() <= share * np.abs(expected).max()


@pytest.mark.parametrize("prior", ["none", "variances", "covariance"])
@pytest.mark.parametrize("kind", ["one shape", "diagonal", "two alike"])
@pytest.mark.parametrize("representation", ["dense", "low_rank"])
def test_prediction_is_that_of_one_system(kind, prior, representation, tmp_path):
    primitive = fitted(kind, prior, representation)
    mean, covariance = plain(INPUTS, primitive.reference, priors(prior))
    prediction = primitive.predict(QUERIES)
    exact = 1 if representation == "dense" else 20
    assert_close(prediction.mean, mean, 1e-12 * exact)
    assert_close(prediction.covariance, covariance, 3e-10 * exact)
    assert_close(primitive.predict(QUERIES[:1]).covariance, covariance[:1], 3e-10 * exact)

    desired = Gaussians.of(mean[5:7] + 0.1, deviation=0.01)
    adapted = primitive.adapt(VIA, desired, tolerance=0.0)
    reference = Gaussians.concatenated([primitive.reference, desired])
    mean, covariance = plain(np.vstack([INPUTS, VIA]), reference, priors(prior))
    prediction = adapted.predict(QUERIES)
    assert_close(prediction.mean, mean, 1e-11 * exact)
    assert_close(prediction.covariance, covariance, 3e-10 * exact)

    exactly = primitive.adapt(VIA, Gaussians.of(mean[5:7] + 0.1, deviation=0.0))
    assert np.abs(exactly.mean(VIA) - mean[5:7] - 0.1).max() < 1e-6

    kmp.save(tmp_path / "adapted.npz", adapted)
    for copy in (kmp.load(tmp_path / "adapted.npz").primitive, pickle.loads(pickle.dumps(adapted))):
        again = copy.predict(QUERIES)
        np.testing.assert_array_equal(again.mean, prediction.mean)
        assert_close(again.covariance, prediction.covariance, 1e-13)


def test_coupled_via_point_of_outputs_that_decouple():
    """A via-point whose covariance couples the outputs makes them one system again."""
    primitive = fitted("diagonal", "none")
    assert len(primitive.inner.solution.parts) == 3
    coupled = Gaussians(primitive.mean(VIA) + 0.1, np.tile(1e-4 * (np.eye(3) + 0.5), (2, 1, 1)))
    adapted = primitive.adapt(VIA, coupled, tolerance=0.0)
    reference = Gaussians.concatenated([primitive.reference, coupled])
    mean, covariance = plain(np.vstack([INPUTS, VIA]), reference, None)
    assert_close(adapted.mean(QUERIES), mean, 1e-11)
    assert_close(adapted.predict(QUERIES).covariance, covariance, 3e-10)
    assert_close(adapted.without_via_points(VIA).mean(QUERIES), primitive.mean(QUERIES), 1e-11)


@pytest.mark.parametrize("kind", ["one shape", "diagonal"])
@pytest.mark.parametrize("prior", ["none", "covariance"])
def test_constraint_on_outputs(kind, prior, tmp_path):
    primitive = fitted(kind, prior)
    bound = LinearConstraints(VIA, np.eye(3)[:2], [2.0, 1.5])
    constrained = primitive.constrained(bound)
    assert constrained.mean(VIA)[0, 0] == pytest.approx(2.0, abs=1e-8)
    assert constrained.mean(VIA)[1, 1] == pytest.approx(1.5, abs=1e-8)

    more = constrained.constrained(LinearConstraints(INPUTS[:1], [[0.0, 0.0, 1.0]], [3.0]))
    adapted = more.adapt(QUERIES[9:10], Gaussians.of([0.0, 0.0, 0.0], deviation=1e-3))
    assert adapted.mean(VIA)[0, 0] == pytest.approx(2.0, abs=1e-8)
    assert adapted.mean(INPUTS[:1])[0, 2] == pytest.approx(3.0, abs=1e-8)
    kmp.save(tmp_path / "constrained.npz", adapted)
    loaded = kmp.load(tmp_path / "constrained.npz").primitive
    np.testing.assert_array_equal(loaded.mean(QUERIES), adapted.mean(QUERIES))
    back = loaded.without_via_points(QUERIES[9:10])
    assert_close(back.mean(QUERIES), more.mean(QUERIES), 1e-9)

    refitted = adapted.refitted(adapted.base.reference)
    assert_close(refitted.mean(QUERIES), adapted.mean(QUERIES), 1e-9)


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("prior", ["none", "covariance"])
@pytest.mark.parametrize("exact", [0, 1, 2])
def test_exact_and_free_outputs_of_one_point(exact, prior, representation):
    """A map of outputs hides neither: the exact one is met, and the free ones follow it alone."""
    primitive = fitted("one shape", prior, representation=representation)
    point = VIA[:1]
    desired = primitive.mean(point) + 0.3
    deviation = np.full(3, np.inf)
    deviation[exact] = 0.0
    joint = primitive.predict_joint(np.vstack([point, QUERIES]))
    gain = joint.covariance[0][:, exact] / joint.covariance[0][exact, exact]
    expected = (joint.mean[0] + 0.3 * gain).reshape(-1, 3)
    for means in (desired, desired + 7 * (deviation > 0)):
        adapted = primitive.adapt(point, Gaussians.of(means, deviation=deviation), tolerance=0.0)
        assert adapted.mean(point)[0, exact] == pytest.approx(desired[0, exact], abs=1e-6)
        assert_close(adapted.mean(QUERIES), expected[1:], 1e-4)
        variance = adapted.predict(point).covariance[0, exact, exact]
        assert 0 < variance < 1e-6 * np.trace(joint.covariance[0])


def test_unit_of_one_output_does_not_change_another():
    """With the outputs' variances as prior covariance."""
    deviations = np.array([1.0, 1000.0, 1e-3])
    covariance = covariances("one shape")
    scaled = Gaussians(MEAN * deviations, covariance * np.outer(deviations, deviations))
    primitive = KMP.fit(
        INPUTS,
        scaled,
        kernel=GaussianKernel(ELL),
        lambda_mean=PENALTY,
        prior_covariance=deviations**2,
    )
    assert primitive.inner.solution.t is not None
    prediction = primitive.predict(QUERIES)
    usual = fitted("one shape", "none").predict(QUERIES)
    assert_close(prediction.mean / deviations, usual.mean, 1e-12)
    assert_close(prediction.covariance[:, 0, 0], usual.covariance[:, 0, 0], 1e-10)


def test_variance_lost_in_rounding_is_over_that_of_the_prior():
    with pytest.raises(ValueError, match=r"lost in rounding.*over those of prior_covariance"):
        KMP.fit(
            INPUTS[::20],
            Gaussians(MEAN[::20], np.tile(1e-9 * np.eye(3), (COUNT // 20, 1, 1))),
            kernel=GaussianKernel(ELL),
            lambda_mean=1.0,
            prior_covariance=[1.0, 1.0, 1e6],
        )
