"""Speed of the primitive, as ratios to NumPy's own primitives measured in the same run.

    OPENBLAS_NUM_THREADS=1 python -m pytest tests/benchmark_kmp.py --benchmark-only

A limit in milliseconds means little on a machine that is busy or old, so each is a multiple of what
NumPy or LAPACK needs there and then for the work that cannot be avoided. The multiples leave a
factor of about two for a busy machine.
"""

import resource
import time
import warnings
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import lapack
from scipy.spatial.distance import cdist
from threadpoolctl import threadpool_limits

from kmp import KMP, GaussianKernel, GaussianMixture, Gaussians, ViaPointMissed
from kmp.compiled import AVAILABLE

I, O = 6, 3  # noqa: E741
PLACES = np.array(
    [
        [0.98, -0.32, 0.06, 0.98, 0.32, 0.06, 0.45, -0.05, 0.35],
        [0.62, -0.28, 0.30, 0.98, 0.32, 0.06, 0.62, -0.28, 0.30],
        [0.75, 0.00, 0.06, 0.90, 0.42, 0.10, 0.50, 0.38, 0.16],
        [0.75, 0.00, 0.06, 0.78, 0.06, 0.11, 0.62, 0.00, 0.26],
    ]
)  # [m] left hand, right hand, tool, on the way of a soldering task
VIA = PLACES[1:2, :I], Gaussians(PLACES[1:2, I:] + 0.02, [1e-8 * np.eye(O)])


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="module")
def mixture():
    random, demonstrations = np.random.default_rng(0), []
    for _ in range(5):
        places = PLACES + 0.008 * random.normal(size=PLACES.shape)
        u = np.linspace(0, 1, 333)[:, None]
        ways = [a + (b - a) * (10 * u**3 - 15 * u**4 + 6 * u**5) for a, b in pairwise(places)]
        demonstrations.append(np.concatenate(ways) + 0.001 * random.normal(size=(999, I + O)))
    return GaussianMixture.fit(np.concatenate(demonstrations), components=10, seed=0)


def database(mixture, count):
    inputs = mixture.sample_inputs(count, dimensions=I, seed=1)
    return inputs, mixture.regress(inputs)


def fit(mixture, count, **options):
    return KMP.fit(*database(mixture, count), kernel=GaussianKernel(0.5), lambda_mean=2.0, **options)


@pytest.fixture(scope="module")
def small(mixture):
    return fit(mixture, 200)


@pytest.fixture(scope="module")
def large(mixture):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    inputs, reference = database(mixture, 100_000)
    start = time.perf_counter()
    primitive = KMP.fit(inputs, reference, kernel=GaussianKernel(0.5), lambda_mean=2.0)
    took = time.perf_counter() - start
    return primitive, took, (before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def primitive_again(primitive):
    """The fit of a primitive's own base, for the table of times."""
    return KMP.fit(primitive.inputs, primitive.reference, kernel=primitive.kernel, lambda_mean=primitive.lambda_mean)


def best(call, *, rounds, calls=1):
    call()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        for _ in range(calls):
            call()
        times.append((time.perf_counter() - start) / calls)
    return min(times)


def gemm_rate():
    """[multiply-adds/s] of a product of the size that the fits are made of."""
    a = np.random.default_rng(0).random((2048, 256))
    b = a.copy()
    return a.size * 256 / best(lambda: a.T @ b, rounds=10)


def compare(benchmark, call, unit, limit, what, *, calls=1):
    """Both in turn, so that a machine that is busy is busy for both; the best of each."""
    call(), unit()
    times = []
    for _ in range(60):
        times.append((best(call, rounds=1, calls=calls), best(unit, rounds=1, calls=calls)))
    report(benchmark, *np.min(times, axis=0), limit, what)


def report(benchmark, seconds, unit_s, limit, what):
    ratio = float(seconds / unit_s)
    benchmark.extra_info.update(best_us=round(1e6 * float(seconds), 2), ratio=round(ratio, 2), of=what, limit=limit)
    assert ratio < limit, f"{1e6 * seconds:.1f} us is {ratio:.1f} times {what} ({1e6 * unit_s:.1f} us); {limit} allowed"


def primitive_query(primitive):
    """The least that a mean can cost: the offsets, the kernel, one product, written out."""
    s, weights, query = primitive.inner.solution.centres, primitive.inner.solution.weights, primitive.inputs[:1]

    def call():
        offsets = query - s
        return np.exp(-0.5 * np.vecdot(offsets, offsets)) @ weights

    return call


def page(primitive, queries):
    """The mean of several queries on a page of SciPy and NumPy."""
    s, weights = primitive.inner.solution.centres, primitive.inner.solution.weights

    return lambda: np.exp(-0.5 * cdist(queries, s, "sqeuclidean")) @ weights


def factorised():
    """What a fit of 200 points cannot do without."""
    a = np.eye(600) * 600 + np.random.default_rng(0).random((600, 600))
    a = np.asfortranarray(a + a.T)
    return lambda: lapack.dpotrf(a, lower=1)


def test_fit_200(benchmark, mixture):
    data = database(mixture, 200)
    call = lambda: KMP.fit(*data, kernel=GaussianKernel(0.5), lambda_mean=2.0)  # noqa: E731
    benchmark(call)
    compare(benchmark, call, factorised(), 4, "dpotrf(600 x 600)")


def test_mean_of_one_query_200(benchmark, small):
    query = small.inputs[:1].copy()
    benchmark(small.mean, query)
    limit = 0.8 if AVAILABLE else 1.8
    compare(benchmark, lambda: small.mean(query), primitive_query(small), limit, "NumPy's five calls", calls=300)


@pytest.mark.parametrize(("count", "limit"), [(10, 1.0), (1000, 1.0)])
def test_mean_of_several_queries_200(benchmark, small, count, limit):
    pytest.importorskip("numba")
    queries = np.repeat(small.inputs, 5, axis=0)[:count] + 0.01
    benchmark(small.mean, queries)
    calls = max(1, 1000 // count)
    compare(
        benchmark, lambda: small.mean(queries), page(small, queries), limit, "SciPy's and NumPy's page", calls=calls
    )


def test_mean_and_covariance_of_one_query_200(benchmark, small):
    query = small.inputs[:1].copy()
    benchmark(small.predict, query)
    inverse = np.random.default_rng(0).random((1800, 200))
    k = np.random.default_rng(0).random(200)
    compare(benchmark, lambda: small.predict(query), lambda: inverse @ k, 4, "dgemv(1800 x 200)", calls=50)


def test_mean_and_covariance_of_one_query_200_beside_numpys_mean(benchmark, small):
    pytest.importorskip("numba")
    query = small.inputs[:1].copy()
    benchmark(small.predict, query)
    compare(benchmark, lambda: small.predict(query), primitive_query(small), 8, "NumPy's five calls", calls=100)


def test_jacobian_200(benchmark, small):
    query = small.inputs[0].copy()
    benchmark(small.jacobian, query)
    limit = 1.0 if AVAILABLE else 2.5
    compare(benchmark, lambda: small.jacobian(query), primitive_query(small), limit, "NumPy's five calls", calls=300)


def test_adapt_200(benchmark, small):
    call = lambda: small.adapt(*VIA, tolerance=0.0)  # noqa: E731
    benchmark(call)
    compare(benchmark, call, factorised(), 0.6, "dpotrf(600 x 600)")


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")  # others near it say something else
@pytest.mark.parametrize(("count", "inserted", "replaced"), [(200, 0.22, 0.45), (1000, 0.07, 0.2)])
def test_adapt_beside_a_fit(benchmark, mixture, count, inserted, replaced):
    data = database(mixture, count)
    fitted = KMP.fit(*data, kernel=GaussianKernel(0.5), lambda_mean=2.0, representation="dense")
    calls = (
        lambda: KMP.fit(*data, kernel=GaussianKernel(0.5), lambda_mean=2.0, representation="dense"),
        lambda: fitted.adapt(*VIA, tolerance=0.0),
        lambda: fitted.adapt(data[0][3:4], data[1][3:4], tolerance=1e-9),
    )
    benchmark.pedantic(calls[1], rounds=5)
    fit_s, insert_s, replace_s = np.min([[best(one, rounds=1) for one in calls] for _ in range(5)], axis=0)
    report(benchmark, insert_s, fit_s, inserted, "a fit, for one more point")
    report(benchmark, replace_s, fit_s, replaced, "a fit, for an early point replaced")


@pytest.mark.parametrize(
    ("count", "more", "limit"), [(200, 10, 0.6), (200, 100, 1.2), (1000, 10, 0.3), (1000, 100, 0.6)]
)
def test_extended_beside_a_fit(benchmark, mixture, count, more, limit):
    data, options = database(mixture, count + more), {"kernel": GaussianKernel(0.5), "lambda_mean": 2.0}
    first = KMP.fit(data[0][:count], data[1][:count], **options, representation="dense")
    calls = (
        lambda: KMP.fit(*data, **options, representation="dense"),
        lambda: first.extended(data[0][count:], data[1][count:]),
    )
    benchmark.pedantic(calls[1], rounds=3)
    fit_s, extended_s = np.min([[best(one, rounds=1) for one in calls] for _ in range(4)], axis=0)
    report(benchmark, extended_s, fit_s, limit, "a fit of all points")


def test_fit_100_000(benchmark, large):
    primitive, took, (before, peak) = large
    r, d = primitive.inner.solution.w.shape
    work = 100_000 * r * r * (d * (d + 1) / 4 + 2)  # multiply-adds: the normal equations, the features three times
    benchmark.pedantic(primitive_again, args=(primitive,), rounds=1)
    benchmark.extra_info.update(fit_s=round(took, 2), rank=r, peak_mb=peak // 1000, before_mb=before // 1000)
    report(benchmark, took, work / gemm_rate(), 5, "its multiply-adds by dgemm")
    assert peak < 2_000_000  # [kB]


@pytest.mark.parametrize("where", ["in the data", "beside it"])
def test_adapt_100_000(benchmark, large, where):
    primitive, (inputs, desired) = large[0], VIA
    inputs = inputs + (0.0 if where == "in the data" else 0.1)
    call = lambda: primitive.adapt(inputs, desired, tolerance=0.05 if where == "in the data" else 0.0)  # noqa: E731
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ViaPointMissed)  # where 100 000 points say something else
        benchmark(call)
        data = primitive.inputs
        compare(benchmark, call, lambda: ((data - inputs) ** 2).sum(axis=1).min(), 2, "NumPy's nearest of 100 000")


def test_mean_of_one_query_100_000(benchmark, large):
    primitive = large[0]
    query = primitive.inputs[:1].copy()
    benchmark(primitive.mean, query)
    limit = 0.8 if AVAILABLE else 1.8
    compare(
        benchmark, lambda: primitive.mean(query), primitive_query(primitive), limit, "NumPy's five calls", calls=300
    )


def test_mean_and_covariance_of_one_query_100_000(benchmark, large):
    primitive = large[0]
    query = primitive.inputs[:1].copy()
    benchmark(primitive.predict, query)
    r, d = primitive.inner.solution.w.shape
    inverse, z = np.random.default_rng(0).random((r * d * d, r)), np.zeros(r)
    compare(benchmark, lambda: primitive.predict(query), lambda: inverse @ z, 4, "dgemv of the rank's size", calls=50)


def test_low_rank_against_dense_2000(benchmark, mixture):
    data = database(mixture, 2000)
    options = {"kernel": GaussianKernel(0.5), "lambda_mean": 2.0}
    start = time.perf_counter()
    dense = KMP.fit(*data, **options, representation="dense")
    dense_s = time.perf_counter() - start
    low = benchmark.pedantic(lambda: KMP.fit(*data, **options, representation="low_rank"), rounds=5)
    difference = np.abs(low.mean(data[0]) - dense.mean(data[0])).max()
    low_s = benchmark.stats.stats.min
    benchmark.extra_info.update(dense_s=round(dense_s, 2), times_faster=round(dense_s / low_s, 1))
    benchmark.extra_info.update(difference_m=float(f"{difference:.2g}"))
    assert difference < 1e-6
    assert low_s < dense_s / 10
