"""An affine prior mean is the same as learning the outputs minus that mean, for every solution."""

import numpy as np
import pytest

from kmp import (
    KMP,
    AffineMean,
    GaussianKernel,
    Gaussians,
    LinearConstraints,
    PeriodicKernel,
    VelocityKernel,
)
from kmp.functionals import Functionals
from kmp.solution import mean_of
from support.primitives import KERNELS, curve

POSITIONS = AffineMean([[0.5, -1.0, 2.0], [1.5, 0.25, -0.75]], [0.3, -0.2])
# offsets of the rates equal slopes of the values
OVER_TIME = AffineMean([[0.5], [-1.5], [0.0], [0.0]], [0.3, -0.2, 0.5, -1.5])


def at(prior, points):
    """The prior mean of functionals by its definition."""
    if points.directions is None:
        return points.inputs @ prior.matrix.T + prior.offset
    of_values = points.inputs @ prior.matrix.T + prior.offset
    return np.where(points.values[:, None], of_values, points.along @ prior.matrix.T)


def both(kernel, representation, how):
    """A primitive with an affine prior mean, and one without, fitted to the outputs minus that
    mean.
    """
    kernel = KERNELS[kernel]
    s, reference = curve(kernel)
    prior = OVER_TIME if kernel.channels == 2 else POSITIONS
    along = np.zeros_like(s)
    along[40:] = 0.7
    points = Functionals.checked(s, along if how == "directions" else None)
    moved = at(prior, points)
    parameters = {"kernel": kernel, "lambda_mean": 1.0, "lambda_covariance": 3.0}
    parameters |= {"representation": representation, "directions": points.directions}
    primitive = KMP.fit(
        s, Gaussians(reference.mean + moved, reference.covariance), prior_mean=prior, **parameters
    )
    remainder = KMP.fit(s, reference, **parameters)
    if how == "adapted":
        via = s[20:22] + 0.01
        desired = Gaussians(reference.mean[20:22] + 0.05, reference.covariance[20:22])
        shifted = Gaussians(desired.mean + at(prior, Functionals(via)), desired.covariance)
        primitive = primitive.adapt(via, shifted, tolerance=0.02)
        remainder = remainder.adapt(via, desired, tolerance=0.02)
    return prior, primitive, remainder


@pytest.mark.parametrize("how", ["fitted", "adapted", "directions"])
@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_equals_learning_the_remainder(kernel, representation, how):
    """The result equals learning from the remaining data."""
    prior, primitive, remainder = both(kernel, representation, how)
    queries = np.random.default_rng(1).normal(size=(5, primitive.inputs.shape[1]))
    close = {"rtol": 0, "atol": 1e-8 * np.abs(primitive.inner.solution.weights).max()}
    np.testing.assert_allclose(
        primitive.mean(queries), remainder.mean(queries) + at(prior, Functionals(queries)), **close
    )
    np.testing.assert_allclose(
        primitive.jacobians(queries), remainder.jacobians(queries) + prior.matrix, **close
    )
    np.testing.assert_array_equal(
        primitive.predict(queries).covariance, remainder.predict(queries).covariance
    )
    for s in queries:
        v, a = np.random.default_rng(2).normal(size=(2, len(s)))
        for motion, left in (
            # compiled if Numba is installed
            (primitive.predict_motion(s, v, a), remainder.predict_motion(s, v, a)),
            (
                primitive.inner.query.motion(s, v, a, covariance=True),
                remainder.inner.query.motion(s, v, a, covariance=True),
            ),
        ):
            np.testing.assert_allclose(
                motion.mean, left.mean + prior.matrix @ s + prior.offset, **close
            )
            np.testing.assert_allclose(motion.velocity, left.velocity + prior.matrix @ v, **close)
            np.testing.assert_allclose(
                motion.acceleration, left.acceleration + prior.matrix @ a, **close
            )
            np.testing.assert_allclose(motion.jacobian, left.jacobian + prior.matrix, **close)
            np.testing.assert_allclose(motion.covariance, left.covariance, rtol=0, atol=1e-9)

    slopes = Functionals(queries, np.ones_like(queries))
    expected = mean_of(remainder.inner.solution, slopes) + slopes.along @ prior.matrix.T
    np.testing.assert_allclose(mean_of(primitive.inner.solution, slopes), expected, **close)


def test_via_points_and_constraints_hold():
    """Via-points and their velocities are met, and constraints are satisfied."""
    _, primitive, _ = both("a length an input", "dense", "fitted")
    where = primitive.inputs[[10, 10]] + 0.3
    desired = np.array([[9.0, -9.0], [0.5, 0.7]])
    exact = Gaussians.of(desired, deviation=1e-4)
    through = primitive.adapt(
        where, exact, tolerance=0.0, directions=[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    )
    np.testing.assert_allclose(through.mean(where[:1])[0], desired[0], atol=1e-3)
    np.testing.assert_allclose(through.jacobian(where[0])[:, 0], desired[1], atol=1e-3)
    above = LinearConstraints(primitive.inputs, np.tile([1.0, 0.0], (60, 1)), np.zeros(60))
    assert primitive.mean(primitive.inputs)[:, 0].min() < -0.1
    assert primitive.constrained(above).mean(primitive.inputs)[:, 0].min() > -1e-9


@pytest.mark.parametrize(
    ("kernel", "prior", "says"),
    [
        (
            GaussianKernel(1.0),
            AffineMean(np.eye(2), [0, 0]),
            r"shape \(2, 2\) given, \(4, 1\) needed",
        ),
        (VelocityKernel(1.0), AffineMean([[1], [1], [0], [0]], [0, 0, 0, 0]), "rates of .* given"),
        (VelocityKernel(1.0), AffineMean([[0], [0], [1], [0]], [0, 0, 0, 0]), "rates of .* given"),
        (PeriodicKernel(1.0, 2.0), AffineMean([[1], [1], [0], [0]], [0, 0, 0, 0]), "a slope given"),
    ],
)
def test_mismatch_with_kernel_is_refused(kernel, prior, says):
    """A constraint that the kernel does not support is refused."""
    reference = Gaussians(np.zeros((3, 4)), np.tile(np.eye(4), (3, 1, 1)))
    with pytest.raises(ValueError, match=says):
        KMP.fit(
            np.arange(3.0)[:, None], reference, kernel=kernel, lambda_mean=1.0, prior_mean=prior
        )
