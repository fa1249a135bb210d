"""What every solution must be, whichever way it was found."""

import inspect
import tracemalloc

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
    named_arrays,
)
from kmp.arrays.linear_algebra import kron_identity
from kmp.dense import Dense
from kmp.low_rank import LowRank
from kmp.low_rank.solution import Conditioned
from kmp.predictor import Inner
from kmp.solution import Solution, mean_at

S = np.random.default_rng(0).normal(size=(40, 2))
REFERENCE = Gaussians.of(np.sin(S), deviation=0.1)
VIA = S[:3] + 0.01, REFERENCE.take(slice(0, 3))
MANY = S[:38] + 0.01, REFERENCE.take(slice(0, 38))

MEMBERS = [name for name in vars(Solution) if not name.startswith("_")]


def fitted(representation, via=None):
    one = KMP.fit(S, REFERENCE, kernel=GaussianKernel(0.05), lambda_mean=1.0, representation=representation)
    return one.adapt(*via, tolerance=0.1) if via else one


SOLUTIONS = {
    "dense": (fitted("dense"), Dense),
    "dense adapted": (fitted("dense", VIA), Dense),
    "low rank": (fitted("low_rank"), LowRank),
    "conditioned": (fitted("low_rank", VIA), Conditioned),
    "low rank, fitted anew": (fitted("low_rank", MANY), LowRank),
}


@pytest.fixture(params=SOLUTIONS)
def primitive(request):
    return SOLUTIONS[request.param][0]


def test_each_is_the_solution_that_is_meant():
    assert {type(primitive.inner.solution) for primitive, _ in SOLUTIONS.values()} == {Dense, LowRank, Conditioned}
    assert all(type(primitive.inner.solution) is kind for primitive, kind in SOLUTIONS.values())


@pytest.mark.parametrize("kind", [Dense, LowRank, Conditioned])
def test_a_method_takes_what_the_protocol_says(kind):
    for name in MEMBERS:
        wanted = vars(Solution)[name]
        if inspect.isfunction(wanted):
            given = inspect.signature(getattr(kind, name)).parameters
            assert list(given) == list(inspect.signature(wanted).parameters), name


def test_all_that_the_protocol_names_is_there(primitive):
    assert [name for name in MEMBERS if not hasattr(primitive.inner.solution, name)] == []


def test_counts_and_shapes_agree(primitive):
    solution = primitive.inner.solution
    assert len(solution.database) == len(primitive.inputs) == len(primitive.reference)
    assert primitive.inner.query.covariance_scale == len(primitive.base.inputs) / primitive.lambda_covariance
    assert solution.weights.shape == (len(solution.centres), 2)
    rows = primitive.kernel(S[:5], solution.centres)
    assert mean_at(solution, S[:5]).shape == (5, 2)
    together = solution.posterior_covariance(rows)
    for n in range(5):
        np.testing.assert_allclose(solution.posterior_covariance_one(rows[n]), together[n], atol=1e-9)


def test_solving_again_gives_the_solution_itself(primitive):
    assert primitive.inner.solution.solved() is primitive.inner.solution


def test_an_adapted_solution_is_adapted_from_its_base(primitive):
    changes = fitted("dense", VIA).inner.changes
    again, base = (
        primitive.inner.solution.adapted(changes).solved(),
        primitive.base.inner.solution.adapted(changes).solved(),
    )
    assert np.array_equal(mean_at(again, S), mean_at(base, S))


def test_weights_that_are_given_are_kept_and_the_solution_is_left_as_it_was(primitive):
    solution, ones = primitive.inner.solution, np.ones_like(primitive.weights)
    other = solution.with_weights(ones)
    assert np.array_equal(other.weights, ones)
    assert not np.array_equal(solution.weights, ones)


def test_each_is_stored_with_what_its_base_needs(primitive):
    assert set(primitive.inner.solution.to_arrays()) == set(primitive.base.inner.solution.to_arrays())
    assert primitive.representation == primitive.base.representation
    again = named_arrays.from_arrays(named_arrays.to_arrays(primitive))
    assert type(again.inner.solution) is type(primitive.inner.solution)
    assert np.array_equal(again.mean(S), primitive.mean(S))


@pytest.mark.parametrize("name", ["information", "features"])
def test_an_array_of_the_low_rank_solution_that_lacks_is_named(name):
    arrays = named_arrays.to_arrays(fitted("low_rank"))
    del arrays[name]
    with pytest.raises(ValueError, match=f"The primitive's arrays lack {name}. Needed are .*pivots"):
        named_arrays.from_arrays(arrays)


def test_pivots_that_rounding_does_not_tell_apart_are_refused():
    arrays = named_arrays.to_arrays(fitted("low_rank"))
    pivots = arrays["pivots"].copy()
    pivots[-1] = pivots[0]
    says = rf"pivots: {len(pivots)} given, and rounding tells only {len(pivots) - 1} apart"
    with pytest.raises(ValueError, match=says):
        named_arrays.from_arrays(arrays | {"pivots": pivots})


def leaning(count):
    """Covariances that tell the outputs apart."""
    return np.tile([[0.01, 0.004], [0.004, 0.02]], (count, 1, 1))


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")
@pytest.mark.parametrize("kernel", [GaussianKernel(0.05), VelocityKernel(0.05)], ids=["one", "two"])
def test_outputs_that_nothing_tells_apart_are_solved_as_one_with_the_same_result(kernel):
    """Against the same points, one of which is so slightly unsure otherwise that all are apart."""
    inputs = S[:, :1] if kernel.channels == 2 else S
    random, o = np.random.default_rng(1), 2 * kernel.channels
    mean = random.normal(size=(40, o))
    covariance = np.tile(kron_identity(0.01 * np.eye(kernel.channels), 2), (40, 1, 1))
    other = covariance.copy()
    other[0, 0, 0] *= 1 + 1e-13
    options = {"kernel": kernel, "lambda_mean": 1.0, "lambda_covariance": 2.0, "representation": "dense"}
    one, apart = (KMP.fit(inputs, Gaussians(mean, c), **options) for c in (covariance, other))
    assert (one.inner.solution.distinct, apart.inner.solution.distinct) == (1, 2)
    assert 2 * len(one.inner.solution.mean_factor) == len(apart.inner.solution.mean_factor)
    queries = inputs[:7] + 0.1
    adapted = [x.adapt(queries, via(7, o), tolerance=0) for x in (one, apart)]
    for a, b in ((one, apart), adapted):
        np.testing.assert_allclose(a.mean(queries), b.mean(queries), atol=1e-9)
        np.testing.assert_allclose(a.predict(queries).covariance, b.predict(queries).covariance, atol=1e-9)
        for query in queries:
            alone, too = a.predict(query[None]), b.predict(query[None])
            np.testing.assert_allclose(alone.covariance, too.covariance, atol=1e-9)
        joint = (x.predict_joint(queries[:3]).covariance for x in (a, b))
        np.testing.assert_allclose(*joint, atol=1e-9)


def via(count, outputs):
    return Gaussians.of(np.ones((count, outputs)), deviation=0.03)


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")
@pytest.mark.parametrize("first", ["alike", "apart"])
def test_adapting_changes_whether_outputs_are_solved_as_one(first):
    alike, apart = np.tile(0.01 * np.eye(2), (3, 1, 1)), leaning(3)
    mixed = Gaussians(REFERENCE.mean, np.concatenate([alike[:1].repeat(37, axis=0), apart]))
    options = {"kernel": GaussianKernel(0.05), "lambda_mean": 1.0, "representation": "dense"}
    base = KMP.fit(S, REFERENCE if first == "alike" else mixed, **options)
    points = Gaussians(np.ones((3, 2)), apart if first == "alike" else alike)
    where = S[:3] + 0.01 if first == "alike" else S[37:]  # in the place of those that tell them apart
    adapted = base.adapt(where, points, tolerance=0.0 if first == "alike" else 1e-6)
    assert (base.inner.solution.distinct, adapted.inner.solution.distinct) == ((1, 2) if first == "alike" else (2, 1))
    anew = KMP.fit(adapted.inputs, adapted.reference, **options)
    assert adapted.inner.solution.same > 0
    np.testing.assert_allclose(adapted.mean(S), anew.mean(S), atol=1e-9)
    one, other = (x.predict(S).covariance / n for x, n in ((adapted, len(base.inputs)), (anew, len(anew.inputs))))
    np.testing.assert_allclose(one, other, atol=1e-10)


@pytest.mark.parametrize("lambda_covariance", [None, 3.0])
def test_adapting_copies_no_factor_and_gives_what_a_fit_of_all_points_gives(lambda_covariance):
    inputs = np.random.default_rng(1).normal(size=(600, 2))
    reference = Gaussians.of(np.sin(inputs), deviation=0.1)
    one = KMP.fit(inputs, reference, kernel=GaussianKernel(1.0), lambda_mean=1.0, lambda_covariance=lambda_covariance)
    factor = one.inner.solution.mean_factor
    tracemalloc.start()
    adapted = one.adapt(inputs[:3] + 0.01, reference[:3], tolerance=0.0).inner.solution
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < factor.nbytes / 4
    anew = Dense(adapted.hyperparameters, adapted.database)
    np.testing.assert_allclose(adapted.weights, anew.weights, atol=1e-10)
    for name in ("mean_factor", "covariance_factor"):
        np.testing.assert_allclose(getattr(adapted, name), getattr(anew, name), atol=1e-10)
    assert (adapted.mean_factor is adapted.covariance_factor) == (lambda_covariance is None)


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")
@pytest.mark.parametrize("kernel", [GaussianKernel(1.0), VelocityKernel(1.0)], ids=["one", "two"])
@pytest.mark.parametrize("lambda_covariance", [None, 3.0])
@pytest.mark.parametrize("replaced", [[0], [3, 40], [1, 2, 30, 90]], ids=str)
def test_points_replaced_early_leave_the_factor_of_the_base_and_are_solved_as_a_fit_is(
    kernel, lambda_covariance, replaced
):
    random = np.random.default_rng(1)
    inputs = np.linspace(0, 40, 120)[:, None] if kernel.channels == 2 else random.normal(size=(120, 2)) * 3
    o = 2 * kernel.channels
    root = 0.1 * random.normal(size=(120, o, o))
    reference = Gaussians(random.normal(size=(120, o)), root @ root.swapaxes(1, 2) + 0.01 * np.eye(o))
    options = {"kernel": kernel, "lambda_mean": 1.0, "lambda_covariance": lambda_covariance, "representation": "dense"}
    base = KMP.fit(inputs, reference, **options)
    desired = Gaussians(reference.mean[replaced] + 0.1, reference.covariance[replaced])
    adapted = base.adapt(inputs[replaced] + 1e-3, desired, tolerance=0.01)
    assert list(adapted.inner.changes.replaced) == replaced
    one = adapted.inner.solution
    assert list(one.gone) == replaced
    anew = Dense(one.hyperparameters, one.database)
    np.testing.assert_allclose(one.weights, anew.weights, rtol=0, atol=1e-9 * np.abs(anew.weights).max())
    equation, wanted = anew.mean_factor @ anew.mean_factor.T, one.database.reference.mean
    residual, usual = (np.abs(equation @ x.weights.ravel() - wanted.ravel()).max() for x in (one, anew))
    assert residual < 10 * usual + 1e-13
    queries = inputs[[*replaced, 60]] + 0.05
    again = KMP(Inner(anew, adapted.inner.changes, base.inner.count), base)
    assert np.array_equal(adapted.predict(queries).covariance, again.predict(queries).covariance)
    assert np.array_equal(adapted.refitted(reference).weights, adapted.weights)


def test_a_point_lost_in_rounding_is_refused_in_the_place_of_an_early_one_too():
    inputs = np.arange(40.0)[:, None]
    base = KMP.fit(inputs, REFERENCE, kernel=GaussianKernel(0.5), lambda_mean=1.0, representation="dense")
    twice = Gaussians(np.zeros((2, 2)), np.tile(1e-18 * np.eye(2), (2, 1, 1)))
    with pytest.raises(ValueError, match="at point 40"):
        base.adapt([[3.0], [3.0]], twice, tolerance=0.1)


# --- a primitive that grows by points ---


RANDOM = np.random.default_rng(0)


def points(dimensions, outputs, *, alike):
    inputs = RANDOM.uniform(0, 2, (60, dimensions))
    roots = 0.1 * RANDOM.normal(size=(60, outputs, outputs)) + 0.3 * np.eye(outputs)
    covariance = np.tile(0.04 * np.eye(outputs), (60, 1, 1)) if alike else roots @ roots.transpose(0, 2, 1)
    return inputs, Gaussians(np.sin(inputs @ RANDOM.normal(size=(dimensions, outputs))), covariance)


ALIKE_THEN_APART = points(2, 2, alike=False)
ALIKE_THEN_APART[1].covariance.setflags(write=True)
ALIKE_THEN_APART[1].covariance[:40] = 0.04 * np.eye(2)
CASES = {
    "two inputs": (points(2, 2, alike=False), {"kernel": GaussianKernel([2.0, 1.0]), "lambda_covariance": 3.0}),
    "alike": (points(2, 3, alike=True), {"kernel": GaussianKernel(2.0)}),
    "alike, then apart": (ALIKE_THEN_APART, {"kernel": GaussianKernel(2.0), "lambda_covariance": 3.0}),
    "velocity": (points(1, 4, alike=False), {"kernel": VelocityKernel(2.0)}),
    "periodic": (points(1, 2, alike=False), {"kernel": PeriodicKernel(2.0, 2.0)}),
    "affine": (
        points(2, 2, alike=False),
        {"kernel": GaussianKernel(2.0), "prior_mean": AffineMean(np.eye(2), np.ones(2))},
    ),
    "low rank": (points(2, 2, alike=False), {"kernel": GaussianKernel(0.5), "representation": "low_rank"}),
}


def assert_same(one, other, queries):
    for a, b in zip(*((p.mean(queries), p.predict(queries).covariance) for p in (one, other)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(one.jacobians(queries), other.jacobians(queries), rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("case", CASES)
def test_it_is_the_fit_of_all_points_and_keeps_its_via_points(case):
    (inputs, reference), options = CASES[case]
    options = {"lambda_mean": 0.7} | options
    whole = KMP.fit(inputs, reference, **options)
    first = KMP.fit(inputs[:40], reference[:40], **options)
    queries = np.random.default_rng(1).uniform(0, 2, (9, inputs.shape[1]))
    assert_same(first.extended(inputs[40:], reference[40:]), whole, queries)
    assert_same(first.extended(inputs[40:50], reference[40:50]).extended(inputs[50:], reference[50:]), whole, queries)
    place = Gaussians(0 * reference.mean[:1], 0.5 * np.eye(reference.outputs)[None])
    via = inputs[3:4] + 1e-3, place
    adapted = first.adapt(*via, tolerance=0.01).extended(inputs[40:], reference[40:])
    wanted = whole.adapt(*via, tolerance=0.01)
    assert np.array_equal(adapted.inner.changes.replaced, wanted.inner.changes.replaced)
    assert_same(adapted, wanted, queries)
    assert_same(
        adapted.adapt(queries[:1], place, tolerance=0.0), wanted.adapt(queries[:1], place, tolerance=0.0), queries
    )
    assert_same(adapted.base, whole, queries)
    assert_same(named_arrays.from_arrays(named_arrays.to_arrays(adapted)), adapted, queries)


def test_derivatives_and_constraints_go_with_it():
    (inputs, reference), options = CASES["two inputs"]
    directions = np.zeros((60, 2))
    directions[[5, 50]] = [1.0, 0.5]
    whole = KMP.fit(inputs, reference, directions=directions, lambda_mean=0.7, **options)
    first = KMP.fit(inputs[:40], reference[:40], directions=directions[:40], lambda_mean=0.7, **options)
    limits = LinearConstraints(inputs[:5], np.tile([0.0, 1.0], (5, 1)), whole.mean(inputs[:5])[:, 1] + 0.01)
    grown = first.constrained(limits).extended(inputs[40:], reference[40:], directions=directions[40:])
    assert_same(grown, whole.constrained(limits), inputs[:9])
    with pytest.raises(ValueError, match="inputs: none given"):
        first.extended(inputs[:0], reference[:0])
