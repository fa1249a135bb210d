"""Against a solution in extended precision (80 bits, refined): 1e-9 of the norm."""

import numpy as np
import pytest

from kmp import KMP, GaussianKernel, Gaussians, VelocityKernel

wide = np.longdouble
pytestmark = pytest.mark.skipif(np.finfo(wide).eps > 1e-18, reason="this machine has no extended precision")


def solved(matrix, right):
    """matrix^-1 right by a Cholesky factor in extended precision, refined once."""
    n = len(matrix)
    factor = matrix.copy()
    for j in range(n):
        factor[j, j] = np.sqrt(factor[j, j])
        factor[j + 1 :, j] /= factor[j, j]
        factor[j + 1 :, j + 1 :] -= np.outer(factor[j + 1 :, j], factor[j + 1 :, j])

    def once(b):
        x = b.copy()
        for j in range(n):
            x[j] = (x[j] - factor[j, :j] @ x[:j]) / factor[j, j]
        for j in reversed(range(n)):
            x[j] = (x[j] - factor[j + 1 :, j] @ x[j + 1 :]) / factor[j, j]
        return x

    found = once(right)
    return found + once(right - matrix @ found)


def blocks(kernel, a, b):
    """The kernel in extended precision: (A C, B C)."""
    if isinstance(kernel, VelocityKernel):
        h, r = wide(kernel.ell), a - b.T
        k = np.exp(-h * r * r)
        parts = np.array([[k, 2 * h * r * k], [-2 * h * r * k, (2 * h - 4 * h * h * r * r) * k]])
        return parts.transpose(2, 0, 3, 1).reshape(2 * len(a), 2 * len(b))
    return np.exp(-(np.asarray(kernel.ell, dtype=wide) * (a[:, None] - b[None]) ** 2).sum(axis=2))


def exact(primitive, queries):
    """Equations (8), (9) and the covariance of IJRR 2019 as they stand, in extended precision."""
    s, kernel = primitive.inputs.astype(wide), primitive.kernel
    n, o = primitive.reference.mean.shape
    unit = np.eye(o // kernel.channels, dtype=wide)
    k = np.kron(blocks(kernel, s, s), unit)
    rows = np.kron(blocks(kernel, queries.astype(wide), s), unit)
    sigma = np.zeros((n, o, n, o), dtype=wide)
    sigma[np.arange(n), :, np.arange(n)] = primitive.reference.covariance
    sigma = sigma.reshape(n * o, n * o)
    right = (primitive.reference.mean - primitive.prior_mean).astype(wide).ravel()
    mean = (rows @ solved(k + wide(primitive.lambda_mean) * sigma, right)).reshape(-1, o) + primitive.prior_mean
    gain = solved(k + wide(primitive.lambda_covariance) * sigma, rows.T)
    own = np.kron(blocks(kernel, s[:1], s[:1]), unit)
    each = [own - rows[i : i + o] @ gain[:, i : i + o] for i in range(0, len(rows), o)]
    return mean, np.array(each) * n / wide(primitive.lambda_covariance)


def hands(seed=0, count=70):
    random = np.random.default_rng(seed)
    t = np.linspace(0, 1, count)
    path = np.stack([0.4 * t, 0.2 * np.sin(5 * t), 0.1 * t, 0.3 * np.cos(3 * t), t**2, 0.1 - 0.1 * t], axis=1)
    root = 0.02 * random.normal(size=(count, 3, 3))
    tool = np.stack([np.sin(3 * t), np.cos(4 * t), t - t**2], axis=1) * 0.5
    inputs = path + 0.01 * random.normal(size=path.shape)
    inputs[10:14] = inputs[9]  # the hands rest
    return inputs, Gaussians(tool, root @ root.swapaxes(1, 2) + 1e-5 * np.eye(3))


@pytest.mark.parametrize("lambda_covariance", [None, 20.0])
@pytest.mark.parametrize("ell", [0.5, 20.0, np.array([0.5, 1, 2, 0.5, 1, 2])])
@pytest.mark.parametrize("adapted", [False, True])
def test_mean_and_covariance_have_nine_digits(lambda_covariance, ell, adapted):
    inputs, reference = hands()
    primitive = KMP.fit(
        inputs,
        reference,
        kernel=GaussianKernel(ell),
        lambda_mean=2.0,
        lambda_covariance=lambda_covariance,
        prior_mean=[0.1, 0.2, 0.3],
    )
    queries = np.concatenate([inputs[::10] + 0.01, inputs[30:31] + 0.5, inputs[:1]])
    if adapted:
        via = Gaussians(reference.mean[[20, 40]] + 0.05, np.tile(1e-8 * np.eye(3), (2, 1, 1)))
        primitive = primitive.adapt(inputs[[20, 40]] + 0.01, via, tolerance=0.05)
        queries = np.concatenate([queries, primitive.via_inputs])
    check(primitive, queries)


@pytest.mark.parametrize("adapted", [False, True])
def test_position_with_velocity_has_nine_digits(adapted):
    t = np.linspace(0, 2, 50)[:, None]
    mean = 10 * np.hstack([np.sin(3 * t), np.cos(2 * t), 3 * np.cos(3 * t), -2 * np.sin(2 * t)])
    reference = Gaussians(mean, np.tile(np.diag([0.1, 0.2, 1.0, 1.0]), (50, 1, 1)))
    primitive = KMP.fit(t, reference, kernel=VelocityKernel(8.0), lambda_mean=0.1)
    if adapted:
        via = Gaussians([[3.0, 2.0, 0.0, 5.0]], [1e-6 * np.eye(4)])
        primitive = primitive.adapt([[0.7]], via, tolerance=0.01)
    check(primitive, np.linspace(0.01, 2.2, 9)[:, None])


def check(primitive, queries):
    mean, covariance = exact(primitive, queries)
    together = primitive.predict(queries)
    singly = [primitive.predict(query[None]) for query in queries]
    for found in (together.mean, np.concatenate([one.mean for one in singly])):
        assert np.linalg.norm((found - mean).astype(float)) <= 1e-9 * np.linalg.norm(mean.astype(float))
    for found in (together.covariance, np.concatenate([one.covariance for one in singly])):
        assert np.linalg.norm((found - covariance).astype(float)) <= 1e-9 * np.linalg.norm(covariance.astype(float))
    near = slice(0, -3)  # and where the covariance is small, in its own right
    error = np.linalg.norm((together.covariance - covariance)[near].astype(float))
    assert error <= 1e-9 * np.linalg.norm(covariance[near].astype(float))


@pytest.mark.parametrize("variance", [1e-9, 1.01e-11])
def test_a_covariance_that_is_not_refused_has_three_digits_where_all_is_known(variance):
    inputs, reference = hands()
    primitive = KMP.fit(inputs, reference, kernel=GaussianKernel(5.0), lambda_mean=1.0)
    via = Gaussians(reference.mean[[20, 40]] + 0.05, np.tile(variance * np.eye(3), (2, 1, 1)))
    primitive = primitive.adapt(inputs[[20, 40]] + 0.01, via, tolerance=0.05)
    wanted = exact(primitive, primitive.via_inputs)[1].astype(float)
    together = primitive.predict(primitive.via_inputs).covariance
    singly = np.concatenate([primitive.predict(s[None]).covariance for s in primitive.via_inputs])
    for found in (together, singly):
        assert np.linalg.norm(found - wanted) < 2e-3 * np.linalg.norm(wanted)
