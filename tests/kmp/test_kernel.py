"""The kernels: their axioms, and their derivatives against finite differences."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import Matern

from kmp import (
    KMP,
    GaussianKernel,
    Gaussians,
    LinearConstraints,
    Matern32,
    Matern52,
    PeriodicKernel,
    RadialKernel,
    VelocityKernel,
    learn,
)

properties = settings(max_examples=20, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)
ells = st.floats(0.05, 10)


@properties
@given(seeds, ells)
def test_kernel_is_symmetric_and_semidefinite(seed, ell):
    """The kernel is 1 at equal inputs, symmetric and positive semidefinite."""
    s = np.random.default_rng(seed).normal(size=(12, 3))
    k = GaussianKernel(ell)(s, s)
    assert (np.diagonal(k) == 1).all()
    assert np.array_equal(k, k.T)
    assert np.linalg.eigvalsh(k)[0] > -1e-12


@properties
@given(seeds)
def test_ell_for_each_input(seed):
    """One ell for each input gives the formula's kernel; equal ones give that of a single ell."""
    random = np.random.default_rng(seed)
    ell = np.array([0.5, 2.0, 0.1])
    a = random.normal(size=(3, 3))
    b = random.normal(size=(4, 3))
    value = np.exp(-(ell * (a[:, None] - b[None]) ** 2).sum(axis=2))
    np.testing.assert_allclose(GaussianKernel(ell)(a, b), value, rtol=1e-12)
    np.testing.assert_allclose(
        GaussianKernel(np.full(3, 0.7))(a, b), GaussianKernel(0.7)(a, b), rtol=1e-12
    )


@properties
@given(seeds, ells)
def test_velocity_kernel_has_derivatives(seed, ell):
    """The derivatives equal finite differences of the kernel."""
    random = np.random.default_rng(seed)
    h = 1e-4
    k = VelocityKernel(ell)
    plain = GaussianKernel(ell)
    a = random.normal(size=(3, 1))
    b = random.normal(size=(4, 1))
    blocks = k(a, b).reshape(3, 2, 4, 2)
    tolerance = {"rtol": 1e-4, "atol": 1e-5 * max(1, ell) ** 2}
    np.testing.assert_allclose(blocks[:, 0, :, 0], plain(a, b), rtol=1e-12)
    np.testing.assert_allclose(
        blocks[:, 1, :, 0], (plain(a + h, b) - plain(a - h, b)) / (2 * h), **tolerance
    )
    np.testing.assert_allclose(
        blocks[:, 0, :, 1], (plain(a, b + h) - plain(a, b - h)) / (2 * h), **tolerance
    )
    mixed = plain(a + h, b + h) - plain(a + h, b - h) - plain(a - h, b + h) + plain(a - h, b - h)
    np.testing.assert_allclose(blocks[:, 1, :, 1], mixed / (4 * h * h), **tolerance)
    np.testing.assert_allclose(k(a[:1], a[:1]), k.prior_variance, atol=1e-12)
    assert np.linalg.eigvalsh(k(a, a))[0] > -1e-9


@dataclass(frozen=True, eq=False, repr=False)
class RationalQuadratic(RadialKernel):
    """(1 + u / alpha)^-alpha, without a third derivative."""

    alpha: float = 2.0

    def profile(self, u):
        return (1 + u / self.alpha) ** -self.alpha

    def first_derivative(self, u):
        return -((1 + u / self.alpha) ** (-self.alpha - 1))

    def second_derivative(self, u):
        return (1 + 1 / self.alpha) * (1 + u / self.alpha) ** (-self.alpha - 2)


class Exponential(RadialKernel):
    """exp(-sqrt(u)): its functions have no derivative."""

    def profile(self, u):
        return np.exp(-np.sqrt(u))


class Halved(GaussianKernel):
    """A subclass that overrides the kernel's matrix alone."""

    def __call__(self, *points):
        return 0.5 * super().__call__(*points)


class Wider(GaussianKernel):
    """A subclass with another profile."""

    def profile(self, u):
        return np.exp(-0.5 * u)

    def first_derivative(self, u):
        return -0.5 * self.profile(u)

    def second_derivative(self, u):
        return 0.25 * self.profile(u)


OWN = {
    "matern32": (Matern32(3.0), 2),
    "matern52": (Matern52([3.0, 2.0]), 2),
    "own": (RationalQuadratic(2.0, 1.5), 2),
    "sum": (0.5 * Matern52(3.0) + GaussianKernel([2.0, 1.0]), 2),
    "product": (Matern52(2.0) * (RationalQuadratic(1.0) + 2 * GaussianKernel([2.0, 1.0])), 2),
    "periodic product": (PeriodicKernel(1.0, 1.5) * GaussianKernel(2.0), 1),
    "overridden call": (Halved(2.0), 2),
    "overridden profile": (Wider(2.0), 2),
}
kernels = pytest.mark.parametrize(("kernel", "inputs"), OWN.values(), ids=OWN)
S = np.random.default_rng(0).uniform(0, 1, size=(40, 2))
MU = np.hstack([np.sin(3 * S[:, :1]), np.cos(2 * S[:, :1])])


def fitted(kernel, inputs, **options):
    reference = Gaussians.of(MU, deviation=0.05)
    return KMP.fit(S[:, :inputs], reference, kernel=kernel, lambda_mean=1.0, **options)


def differences(function, query, step=1e-5):
    """Central differences (..., I) of a function along each input."""
    axes = step * np.eye(len(query))
    return np.stack(
        [(function(query + axis) - function(query - axis)) / (2 * step) for axis in axes], axis=-1
    )


@kernels
def test_derivatives_equal_finite_differences(kernel, inputs):
    a = S[:1, :inputs] + 0.013
    b = np.vstack([S[:6, :inputs], a])
    u = np.ones((1, inputs))
    v = np.full((7, inputs), 0.7)
    by_a = differences(lambda x: kernel(x[None], b)[0], a[0]) @ u[0]
    np.testing.assert_allclose(kernel(a, b, u)[0], by_a, atol=1e-4)
    np.testing.assert_allclose(kernel(b, a, None, u)[:, 0], by_a, atol=1e-4)
    across = differences(lambda x: kernel(x[None], b, None, v)[0], a[0]) @ u[0]
    np.testing.assert_allclose(kernel(a, b, u, v)[0], across, atol=2e-3)
    at_a = kernel(a, a, u, u)
    np.testing.assert_allclose(kernel.variances(np.vstack([u, 0 * u]))[0], at_a[0])
    np.testing.assert_allclose(kernel.variances(0 * u), kernel.prior_variance)
    np.testing.assert_allclose(kernel(a, a), kernel.prior_variance)
    assert np.linalg.eigvalsh(kernel(S[:, :inputs], S[:, :inputs]))[0] > -1e-12


@kernels
@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")
def test_primitive_takes_any_kernel(kernel, inputs):
    """Each prediction is that of the kernel's matrix, and each derivative that of the mean."""
    skill = fitted(kernel, inputs)
    query = np.full(inputs, 0.41)
    goal = query + 0.03  # elsewhere, as a Matern 3/2 has a kink there
    velocity = np.linspace(0.5, 1.0, inputs)
    through = skill.adapt(
        [goal, query + 0.1],
        Gaussians.of(np.zeros((2, 2)), deviation=0.01),
        directions=[velocity, 0 * velocity],
        tolerance=0.0,
    )
    for primitive in (skill, through):
        solution = primitive.inner.solution
        along = solution.functionals.directions
        row = kernel(query[None], solution.centres, None, along)
        np.testing.assert_allclose(primitive.mean([query])[0], (row @ solution.weights)[0])
        np.testing.assert_allclose(primitive.mean([query] * 2)[0], (row @ solution.weights)[0])
        np.testing.assert_allclose(
            primitive.predict([query]).covariance[0], primitive.predict([query] * 2).covariance[0]
        )
        slope = differences(lambda s, of=primitive: of.mean([s])[0], query)
        np.testing.assert_allclose(primitive.jacobian(query), slope, atol=1e-5)
        np.testing.assert_allclose(primitive.jacobians([query])[0], primitive.jacobian(query))
    bend = differences(lambda s: skill.jacobian(s) @ velocity, query) @ velocity
    motion = skill.predict_motion(query, velocity, velocity)
    np.testing.assert_allclose(motion.curvature, bend, atol=1e-4)
    np.testing.assert_allclose(motion.acceleration, motion.velocity + motion.curvature)
    assert np.abs(through.jacobian(goal) @ velocity).max() < 0.1
    still = 0 * velocity
    assert np.array_equal(skill.predict_motion(query, still, still).curvature, [0.0, 0.0])
    assert (np.linalg.eigvalsh(skill.uncertainty([query]).distance) > 0).all()
    assert skill.sample([query, query + 0.1], 2, seed=0).shape == (2, 2, 2)
    assert (skill.via_point_reach(query) > 0).all()
    above = LinearConstraints(S[:3, :inputs], np.tile([1.0, 0.0], (3, 1)), np.full(3, 0.5))
    assert skill.constrained(above).mean(S[:3, :inputs])[:, 0].min() > 0.5 - 1e-8
    low = fitted(kernel, inputs, representation="low_rank")
    np.testing.assert_allclose(low.mean(S[:, :inputs]), skill.mean(S[:, :inputs]), atol=1e-6)
    halves = [(S[i::2, :inputs], MU[i::2]) for i in range(2)]
    assert learn(halves, components=3, seed=0, kernel=kernel).primitive.kernel is kernel


@pytest.mark.parametrize(
    "kernel", [Matern52([3.0, 2.0]), 0.5 * Matern52(3.0) + GaussianKernel([2.0, 1.0])]
)
def test_curvature_with_observed_derivatives(kernel):
    query = np.full(2, 0.41)
    v = np.array([1.0, -0.5])
    rest = Gaussians.of([0.0, 0.0], deviation=0.01)
    for at in (query, query + 0.05):
        skill = fitted(kernel, 2).adapt([at], rest, directions=[v], tolerance=0.0)
        bend = differences(lambda s, of=skill: of.jacobian(s) @ v, query) @ v
        np.testing.assert_allclose(skill.predict_motion(query, v, v).curvature, bend, atol=1e-4)


@pytest.mark.parametrize(("kind", "nu"), [(Matern32, 1.5), (Matern52, 2.5)])
def test_matern_equals_scikit_learn(kind, nu):
    lengths = np.array([0.4, 0.7])
    other = GaussianProcessRegressor(Matern(lengths, nu=nu), alpha=1e-2, optimizer=None)
    other.fit(S, MU[:, 0])
    skill = KMP.fit(
        S,
        Gaussians.of(MU[:, :1], deviation=0.1),
        kernel=kind(0.5 / lengths**2),
        lambda_mean=1.0,
    )
    queries = S + 0.1
    mean, covariance = other.predict(queries, return_cov=True)
    np.testing.assert_allclose(skill.mean(queries)[:, 0], mean, atol=1e-9)
    joint = skill.predict_joint(queries).covariance[0] / len(S)
    np.testing.assert_allclose(joint, covariance, atol=1e-9)


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")
def test_what_a_kernel_lacks_is_refused_by_name():
    rough = fitted(Exponential(2.0), 2)
    with pytest.raises(ValueError, match=r"Exponential\(ell=2.0\) has no first_derivative"):
        rough.jacobian([0.3, 0.3])
    rest = Gaussians.of([0.0, 0.0], deviation=0.1)
    observed = {"directions": [[1.0, 0.0]], "tolerance": 0.0}
    with pytest.raises(ValueError, match="Exponential"):
        rough.adapt([[0.3, 0.3]], rest, **observed)
    for kernel, message in (
        (Matern32(2.0), "Matern32.* has no third_derivative"),
        (RationalQuadratic(2.0), "RationalQuadratic.* has no third_derivative"),
        (Halved(2.0), "Halved.* overrides __call__: override `third`"),
        (Matern52(2.0) * Matern52(1.0), "has no `third`"),
    ):
        skill = fitted(kernel, 2).adapt([[0.3, 0.3]], rest, **observed)
        with pytest.raises(ValueError, match=message):
            skill.predict_motion([0.3, 0.4], [1.0, 0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match=r"kernel: 3\.0 given, a kernel needed: .* It lacks ell"):
        _ = GaussianKernel(1.0) + 3.0
    with pytest.raises(ValueError, match=r"VelocityKernel.* has rates, and no sum or product"):
        _ = GaussianKernel(1.0) * VelocityKernel(1.0)
    with pytest.raises(ValueError, match="factor of a kernel is -1, and must be"):
        _ = -1.0 * GaussianKernel(1.0)
    with pytest.raises(ValueError, match="kernel's ell: 3 values given, 1 or 2 needed"):
        fitted(GaussianKernel(1.0) + GaussianKernel([1.0, 2.0, 3.0]), 2)


def test_sums_and_products_are_values():
    """They have an algebra, a repr and equality."""
    a = GaussianKernel(1.0)
    b = Matern52(2.0)
    for left, right in (
        (a * b, b(S, S) * a(S, S)),
        (a + b, a(S, S) + b(S, S)),
        (np.float64(2) * (a + 0.5 * b), 2 * a(S, S) + b(S, S)),
    ):
        np.testing.assert_allclose(left(S, S), right, rtol=1e-14)
    assert repr(2 * (a + b) * b) == (
        "(2.0 * GaussianKernel(ell=1.0) + 2.0 * Matern52(ell=2.0)) * Matern52(ell=2.0)"
    )
    assert a + b == a + Matern52(2.0)
    assert hash(a * b) == hash(a * Matern52(2.0))
    assert a + b != a + Matern32(2.0)
    periodic = PeriodicKernel(1.0, 2.0)
    assert (periodic + periodic).period == 2.0
    assert (periodic * GaussianKernel(1.0)).period is None
