"""`python kmp/docs/benchmark.py` measures kmp beside plain NumPy and scikit-learn, and writes
benchmark.md. It takes a minute, on one thread.
"""

import platform
import timeit
import warnings
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag, cho_solve, cholesky, solve_triangular
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF
from threadpoolctl import threadpool_limits

import kmp

SIZES = (50, 200, 1000)  # reference points N
ROUNDS = 5
ELL = 8.0
PAGE = Path(__file__).with_suffix(".md")
HEAD = """# Benchmark

<!-- Written by `python kmp/docs/benchmark.py`: run it to change this page. -->

Each row has the time of `kmp`, and how many times as long plain NumPy and scikit-learn take: the
median of five rounds, and in brackets the least and the greatest. Below 1, the other one is faster.
All three were measured in turn in one run, on one thread of {machine}, with three outputs and
{compiled}. The first prediction of a skill takes longer, since it inverts the triangular factor; it
is not counted.

* **Plain NumPy** is ten lines: a Cholesky factor of K + lambda Sigma, and triangular solves.
  A via-point is a new fit.
* **scikit-learn** is its `GaussianProcessRegressor`, without a search for parameters. It takes one
  variance for each point, where the others take a covariance between the outputs.
"""


class Plain:
    """The mean and covariance of the paper, in NumPy and SciPy."""

    def __init__(self, inputs, mean, covariance):
        self.inputs = inputs
        matrix = np.kron(self.kernel(inputs), np.eye(3)) + block_diag(*covariance)
        self.factor = cholesky(matrix, lower=True, overwrite_a=True)
        self.weights = cho_solve((self.factor, True), mean.ravel()).reshape(mean.shape)

    def kernel(self, queries):
        squares = (queries**2).sum(axis=1)[:, None] + (self.inputs**2).sum(axis=1)
        return np.exp(-ELL * (squares - 2 * queries @ self.inputs.T))

    def mean(self, queries):
        return self.kernel(queries) @ self.weights

    def covariance(self, query):
        rows = np.kron(self.kernel(query), np.eye(3))
        half = solve_triangular(self.factor, rows.T, lower=True)
        return len(self.inputs) * (np.eye(3) - half.T @ half)


def calls(count, dimensions):
    """The three libraries' calls for each task."""
    random = np.random.default_rng(0)
    inputs = np.linspace(0, 2, count)[:, None] + 0.1 * random.random((count, dimensions))
    mean = np.sin(inputs[:, :1] + [0, 1, 2])
    root = 0.1 * random.normal(size=(count, 3, 3))
    covariance = root @ root.mT + 0.01 * np.eye(3)
    reference = kmp.Gaussians(mean, covariance)
    parameters = {"kernel": kmp.GaussianKernel(ELL), "lambda_mean": 1.0}
    query = inputs[:1] + 0.01
    queries = np.repeat(inputs, 1000 // count, axis=0) + 0.01
    point = kmp.Gaussians.of(mean[:1] + 0.1, deviation=0.1)
    new = [np.concatenate(pair) for pair in ((inputs, query), (mean, point.mean))]
    new_covariance = np.concatenate([covariance, point.covariance])

    variances = np.trace(covariance, axis1=1, axis2=2) / 3
    kernel = RBF((2 * ELL) ** -0.5)
    regressor = GaussianProcessRegressor(kernel, alpha=variances, optimizer=None)
    grown = GaussianProcessRegressor(kernel, alpha=np.append(variances, 0.01), optimizer=None)

    skill = kmp.KMP.fit(inputs, reference, **parameters)
    plain = Plain(inputs, mean, covariance)
    return {
        "fit": (
            lambda: kmp.KMP.fit(inputs, reference, **parameters),
            lambda: Plain(inputs, mean, covariance),
            lambda: regressor.fit(inputs, mean),
        ),
        "mean of 1": (
            lambda: skill.mean(query),
            lambda: plain.mean(query),
            lambda: regressor.predict(query),
        ),
        "mean of 1000": (
            lambda: skill.mean(queries),
            lambda: plain.mean(queries),
            lambda: regressor.predict(queries),
        ),
        "predict 1": (
            lambda: skill.predict(query),
            lambda: (plain.mean(query), plain.covariance(query)),
            lambda: regressor.predict(query, return_cov=True),
        ),
        "via-point": (
            lambda: skill.adapt(query, point, tolerance=0.0),
            lambda: Plain(*new, new_covariance),
            lambda: grown.fit(*new),
        ),
    }


def seconds(call):
    """The time of a call, of as queries as take 20 ms."""
    timer = timeit.Timer(call)
    once = timer.timeit(1)
    number = max(1, int(0.02 / max(once, 1e-7)))
    return min(timer.timeit(number) / number, once)


def brief(number):
    """Two significant digits, without an exponent."""
    return f"{float(f'{number:.2g}'):g}"


def row(name, trio):
    """A row of the table."""
    for call in trio:  # caches and compilation
        call()
    times = np.array([[seconds(call) for call in trio] for _ in range(ROUNDS)])
    cells = [f"{brief(1000 * np.median(times[:, 0]))} ms"]
    for other in (1, 2):
        ratios = times[:, other] / times[:, 0]
        middle, least, greatest = map(brief, (np.median(ratios), ratios.min(), ratios.max()))
        cells.append(f"{middle} ({least} to {greatest})")
    return f"| {name} | {' | '.join(cells)} |\n"


def cpu():
    """The processor's name."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def page():
    """The page, measured now."""
    compiled = "with" if kmp.compiled.AVAILABLE else "without"
    text = HEAD.format(machine=cpu(), compiled=f"{compiled} Numba")
    for dimensions, title in ((1, "Over time"), (6, "Over six inputs")):
        for count in SIZES:
            text += f"\n## {title}, {count} points\n\n"
            text += "| | kmp | plain NumPy | scikit-learn |\n|---|---|---|---|\n"
            text += "".join(row(*task) for task in calls(count, dimensions).items())
    return text


def main():
    """Write the page."""
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
