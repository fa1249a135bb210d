"""The same demonstrations through this package and its peers: how well, how fast. Table I, run.

    pip install -e '.[compare]'
    OPENBLAS_NUM_THREADS=1 python -m tests.compare

Two tasks. "Over time": a planar letter, 2 outputs, adapted to a via-point in its midst and to
another end. "By hands": a tool that goes with two hands, 6 inputs, 3 outputs, adapted to a place
that was not demonstrated. All in metres and seconds: the RMSE on a demonstration that was left
out, or the distance at the adapted point.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import gmr
import numpy as np
from movement_primitives.dmp import DMP
from movement_primitives.promp import ProMP
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel
from threadpoolctl import threadpool_limits

from kmp import KMP, GaussianKernel, GaussianMixture, Gaussians, learn

COMPONENTS, POINTS, VARIANCE = 10, 200, 1e-8
CANNOT = "cannot"


class Outcome(NamedTuple):
    """One row; None where the method has no such thing."""

    name: str
    fit_s: float | None = None
    mean_s: float | None = None
    covariance_s: float | None = None
    adapt_s: float | None = None
    rmse_m: float | None = None
    via_m: float | None = None
    end_m: float | None = None


class Data(NamedTuple):
    """Demonstrations: inputs (T, I), outputs (T, O), one held out. Points: (1, I), (1, O)."""

    demonstrations: list[tuple[np.ndarray, np.ndarray]]
    held_out: tuple[np.ndarray, np.ndarray]
    via: tuple[np.ndarray, np.ndarray]
    end: tuple[np.ndarray, np.ndarray]


def best(call: Callable[[], object], rounds: int = 20) -> float:
    """[s] the shortest of some calls, after one that warms up."""
    call()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def letters() -> Data:
    random, t = np.random.default_rng(0), np.linspace(0, 2, 200)[:, None]

    def drawn():
        a, b, shift = 1 + 0.1 * random.normal(), 1 + 0.1 * random.normal(), 0.005 * random.normal(size=2)
        return t, np.hstack([0.1 * a * np.sin(3 * t), 0.08 * b * np.cos(2.2 * t) * t]) + shift

    demonstrations = [drawn() for _ in range(6)]
    mean = np.mean([xi for _, xi in demonstrations], axis=0)
    end = mean[-1:] + np.array([0.02, 0.02])
    return Data(demonstrations[:5], demonstrations[5], (t[80:81], mean[80:81] + np.array([0.03, -0.02])), (t[-1:], end))


def hands() -> Data:
    random = np.random.default_rng(0)
    left = np.array([[0.98, -0.32, 0.06], [0.62, -0.28, 0.30], [0.75, 0, 0.06], [0.75, 0, 0.06]])
    right = np.array([[0.98, 0.32, 0.06], [0.98, 0.32, 0.06], [0.90, 0.42, 0.10], [0.78, 0.06, 0.11]])
    tool = np.array([[0.45, -0.05, 0.35], [0.62, -0.28, 0.30], [0.50, 0.38, 0.16], [0.62, 0, 0.26]])
    places = np.hstack([left, right, tool])

    def worked():
        mine = places + 0.008 * random.normal(size=places.shape)
        u = np.linspace(0, 1, 67)[:, None]
        ways = [a + (b - a) * (10 * u**3 - 15 * u**4 + 6 * u**5) for a, b in pairwise(mine)]
        path = np.concatenate(ways) + 0.001 * random.normal(size=(201, 9))
        return path[:, :6], path[:, 6:]

    demonstrations = [worked() for _ in range(6)]
    shifted = places + np.array([0, 0.06, 0.03, 0, 0, 0, 0, 0.06, 0.03])
    via, end = shifted[1:2], places[3:] + np.array([0.05, -0.05, 0, 0.05, -0.05, 0, 0.05, -0.05, 0])
    return Data(demonstrations[:5], demonstrations[5], (via[:, :6], via[:, 6:]), (end[:, :6], end[:, 6:]))


def rmse(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.sqrt(((found - wanted) ** 2).sum(axis=-1).mean()))


def samples(data: Data) -> np.ndarray:
    return np.concatenate([np.hstack(one) for one in data.demonstrations])


def of_kmp(data: Data, ell: float, penalty: float) -> Outcome:
    """With the paper's parameters. The fit is from the reference, without that of the mixture."""
    inputs = data.demonstrations[0][0].shape[1]
    mixture = GaussianMixture.fit(samples(data), components=COMPONENTS, seed=0, regularization=1e-6)
    where = data.demonstrations[0][0] if inputs == 1 else mixture.sample_inputs(POINTS, dimensions=inputs, seed=0)
    reference = mixture.regress(where)

    def fit():
        prior = reference.mean.mean(axis=0)
        return KMP.fit(where, reference, kernel=GaussianKernel(ell), lambda_mean=penalty, prior_mean=prior)

    return measured("KMP (this package)", data, fit(), best(fit))


def of_chosen_kmp(data: Data) -> Outcome:
    """With lengths and lambdas by leaving one demonstration out; the fit is all that, with EM."""
    start = time.perf_counter()
    learned = learn(data.demonstrations, components=COMPONENTS, seed=0, count=POINTS)
    return measured("KMP, parameters chosen", data, learned.primitive, time.perf_counter() - start)


def measured(name: str, data: Data, skill: KMP, fit_s: float) -> Outcome:
    def adapt(point):
        desired = Gaussians(point[1], [VARIANCE * np.eye(point[1].shape[1])])
        return skill.adapt(point[0], desired, tolerance=0.02)

    query = data.held_out[0][50:51]
    return Outcome(
        name,
        fit_s,
        best(lambda: skill.mean(query), 500),
        best(lambda: skill.predict(query), 200),
        best(lambda: adapt(data.via)),
        rmse(skill.mean(data.held_out[0]), data.held_out[1]),
        *(rmse(adapt(point).mean(point[0]), point[1]) for point in (data.via, data.end)),
    )


def of_regression(data: Data) -> Outcome:
    def fit():
        return GaussianMixture.fit(samples(data), components=COMPONENTS, seed=0, regularization=1e-6)

    mixture, query = fit(), data.held_out[0][50:51]
    both = best(lambda: mixture.regress(query), 100)
    return Outcome(
        "GMM/GMR (this package)",
        best(fit, 3),
        both,
        both,
        None,
        rmse(mixture.regress(data.held_out[0]).mean, data.held_out[1]),
    )


def of_gmr(data: Data) -> Outcome:
    index = np.arange(data.held_out[0].shape[1])

    def fit():
        return gmr.GMM(n_components=COMPONENTS, random_state=0).from_samples(samples(data), init_params="kmeans++")

    mixture, query = fit(), data.held_out[0][50:51]
    return Outcome(
        "gmr",
        best(fit, 3),
        best(lambda: mixture.predict(index, query), 50),
        best(lambda: mixture.condition(index, query[0]).to_mvn(), 50),
        None,
        rmse(mixture.predict(index, data.held_out[0]), data.held_out[1]),
    )


def of_gaussian_process(data: Data, ell: float) -> Outcome:
    """On the samples, thinned to as many points; a via-point is one more, of small noise."""
    every = samples(data)[:: len(samples(data)) // POINTS]
    i = data.held_out[0].shape[1]
    scale = every[:, i:].mean(axis=0)
    kernel = 0.1 * RBF(1 / np.sqrt(2 * ell), "fixed") + WhiteKernel(1e-12, "fixed")

    def fit(point=None):
        s, xi, noise = every[:, :i], every[:, i:], np.full(len(every), 1e-4)
        if point is not None:
            s, xi, noise = np.vstack([s, point[0]]), np.vstack([xi, point[1]]), np.append(noise, VARIANCE)
        return GaussianProcessRegressor(kernel, alpha=noise, optimizer=None).fit(s, xi - scale)

    process, query = fit(), data.held_out[0][50:51]
    return Outcome(
        "scikit-learn GP",
        best(fit),
        best(lambda: process.predict(query), 200),
        best(lambda: process.predict(query, return_std=True), 200),
        best(lambda: fit(data.via)),
        rmse(process.predict(data.held_out[0]) + scale, data.held_out[1]),
        *(rmse(fit(point).predict(point[0]) + scale, point[1]) for point in (data.via, data.end)),
    )


def of_promp(data: Data) -> Outcome:
    """Whole trajectories: a query's time is that of 200 points. It writes to the times."""
    if data.held_out[0].shape[1] > 1:
        return Outcome("ProMP (movement_primitives)")
    t = data.demonstrations[0][0][:, 0]
    stacked = np.array([xi for _, xi in data.demonstrations])

    def fit():
        promp = ProMP(n_dims=2, n_weights_per_dim=20)
        promp.imitate(np.tile(t, (len(stacked), 1)), stacked)
        return promp

    def adapt(point):
        return promp.condition_position(point[1][0], y_cov=VARIANCE * np.eye(2), t=point[0][0, 0], t_max=2.0)

    def missed(point):
        path = adapt(point).mean_trajectory(t.copy())
        return rmse(path[np.abs(t - point[0][0, 0]).argmin()], point[1][0])

    promp = fit()
    return Outcome(
        "ProMP (movement_primitives)",
        best(fit, 3),
        best(lambda: promp.mean_trajectory(t.copy())) / len(t),
        best(lambda: (promp.mean_trajectory(t.copy()), promp.var_trajectory(t.copy()))) / len(t),
        best(lambda: adapt(data.via)),
        rmse(promp.mean_trajectory(t.copy()), data.held_out[1]),
        *(missed(point) for point in (data.via, data.end)),
    )


def of_dmp(data: Data) -> Outcome:
    """One demonstration, their mean. A query's time is that of the open loop over the points."""
    if data.held_out[0].shape[1] > 1:
        return Outcome("DMP (movement_primitives)")
    t = data.demonstrations[0][0][:, 0]
    mean = np.mean([xi for _, xi in data.demonstrations], axis=0)

    def fit():
        dmp = DMP(n_dims=2, execution_time=2.0, dt=2.0 / (len(t) - 1), n_weights_per_dim=50)
        dmp.imitate(t, mean)
        return dmp

    def moved():
        dmp = fit()
        dmp.configure(goal_y=data.end[1][0])
        return dmp

    dmp, other = fit(), moved()
    path = dmp.open_loop()[1]
    return Outcome(
        "DMP (movement_primitives)",
        best(fit, 3),
        best(dmp.open_loop, 3) / len(t),
        None,
        best(lambda: other.configure(goal_y=data.end[1][0])),
        rmse(path[: len(t)], data.held_out[1][: len(path)]),
        None,
        rmse(other.open_loop()[1][-1], data.end[1][0]),
    )


def of_all(data: Data, ell: float, penalty: float) -> list[Outcome]:
    """The rows of all methods."""
    return [
        of_kmp(data, ell, penalty),
        of_chosen_kmp(data),
        of_regression(data),
        of_gmr(data),
        of_gaussian_process(data, ell),
        of_promp(data),
        of_dmp(data),
    ]


COLUMNS = ("fit ms", "query us", "+ cov. us", "adapt ms", "RMSE mm", "via mm", "end mm")
SCALES = (1e3, 1e6, 1e6, 1e3, 1e3, 1e3, 1e3)


def printed(title: str, outcomes: list[Outcome]) -> None:
    print(f"\n{title}\n| {'':28} |" + "".join(f" {name:>9} |" for name in COLUMNS))
    print(f"|{'-' * 30}|" + f"{'-' * 10}:|" * len(COLUMNS))
    for one in outcomes:
        scaled = zip(one[1:], SCALES, strict=True)
        cells = [CANNOT if value is None else f"{scale * value:.3g}" for value, scale in scaled]
        print(f"| {one.name:28} |" + "".join(f" {cell:>9} |" for cell in cells))


def table_one(over_time: list[Outcome], by_hands: list[Outcome]) -> None:
    """What Table I of the paper claims, run: met within 1 mm, a covariance, a fit to 6 inputs."""
    hands_by_name = {one.name: one for one in by_hands}
    print(f"\nTable I of the paper, executed\n| {'':28} | probabilistic | via-point | end-point | high-dim. inputs |")
    print(f"|{'-' * 30}|---|---|---|---|")
    for one in over_time:
        ticks = (
            one.covariance_s is not None,
            one.via_m is not None and one.via_m < 1e-3,
            one.end_m is not None and one.end_m < 1e-3,
            hands_by_name[one.name].fit_s is not None,
        )
        print(f"| {one.name:28} |" + "".join(f" {'yes' if tick else '-':>4} |" for tick in ticks))


def main() -> None:
    warnings.simplefilter("ignore")
    with threadpool_limits(1):
        over_time = letters()
        by_hands = hands()
        first = of_all(over_time, 8.0, 0.1)
        second = of_all(by_hands, 0.5, 2.0)
    printed("Over time: 1 input, 2 outputs, 200 points", first)
    printed("By hands: 6 inputs, 3 outputs, 200 points", second)
    table_one(first, second)


if __name__ == "__main__":
    main()
