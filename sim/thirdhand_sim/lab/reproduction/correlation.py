"""Correlations learned from a reward (the paper, section III-B and Figure 3): letters in space that
cost the joints less motion, and the share of it that one number saves too.

The paper shows one letter, one via-point and a cost that falls. Here letters and via-points are the
sample, and the learned Lambda is compared with three others at the same distance from the
reference: the best of as many random ones, Lambda = c I with one number c, and what learning adds
to that c.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from scipy.stats import wilcoxon

from kmp import KMP, Correlation, GaussianKernel, GaussianMixture, Gaussians, Improvement, improve
from thirdhand.core.arm.stage import Arm
from thirdhand.core.kinematics import Kinematics
from thirdhand.settings.config import Settings, robot_description
from thirdhand_sim.lab.catalogue import DRAWING, EXPERIMENTS
from thirdhand_sim.lab.reproduction.writing import TARGETS, write
from thirdhand_sim.lab.results import (
    ADAPTED,
    DESIRED,
    OTHER,
    REFERENCE,
    Array,
    Options,
    Results,
    equal_box,
    pyplot,
    rgb,
)

ELL, LAMBDA, SHARPNESS = 0.1, 2.0, 5.0  # the paper's ell, lambda and gamma; here over seconds and centimetres
DURATION_S, POINTS, COMPONENTS = 10.0, 100, 8
CENTRE_CM = np.array([55.0, 0.0, 40.0])  # centre of the letter, frame base
TILT = np.radians(60)  # angle between writing plane and table
DEPTH_STD_CM = 0.8
VIA_ROWS, VIA_STEP_CM, VIA_VARIANCE = (20, 80), 4.0, 1e-6  # rows along the letter, offset, [cm²]
JOINT_WEIGHTS = np.array([3.0, 3.0, 2.0, 2.0, 1.0, 1.0, 1.0])  # W: joints near the base cost more
SEEDS = EXPERIMENTS["correlation"].seeds
LETTERS, VIA_POINTS = SEEDS.evaluation["letters"], SEEDS.evaluation["points"]
BASES, EXPLORATION, UPDATES, ROLLOUTS = 8, 0.25, 30, 12
SPREAD = (0.25, 2.0)  # deviation of random Lambda from 1, uniform in the logarithm
BEYOND = 2.0  # penalty of an exceeded distance: multiple of the first cost, for each share
WITHIN, SECANTS, LEAST_SLOPE = 0.01, 8, 0.05  # distances agree within 1 %, after at most 8 secants
SHOWN = "D"
TIMES = np.linspace(0.0, DURATION_S, POINTS)
METHODS = {
    "learned": "learned",
    "random": "best of as many\nrandom Λ",
    "begun_at_c": "learned, begun\nat Λ = c I",
}


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    names = sorted(TARGETS, key=lambda name: name != SHOWN)[: max(2, round(len(TARGETS) * options.share))]
    via_points, updates = VIA_POINTS.share(options.share), max(2, round(UPDATES * options.share))
    joints = Joints()
    trials: list[Trial] = []
    for name in names:
        one = letter(name)
        trials += [tried(one, number, joints, updates=updates) for number in via_points]
        results.say(f"{name}: {[_said(each) for each in trials[-len(via_points) :]]}")
    _draw(results, letter(SHOWN), trials)
    _record(results, letter(SHOWN), trials[0])
    return {
        "units": "s, cm, rad",
        "ell": ELL,
        "lambda": LAMBDA,
        "gamma": SHARPNESS,
        "letters": names,
        "via_points_each": len(via_points),
        "updates": updates,
        "rollouts": ROLLOUTS,
        "search": "PI^BB: noise constant over a rollout, weighed by its total reward; not PI^2",
        "cost_fall_percent": _interval(
            [100 * (1 - t.policies.learned.cost / t.policies.first.cost) for t in trials], trials
        ),
        "distance_rms_cm": {
            "before": float(np.mean([t.policies.first.distance for t in trials])),
            "learned": float(np.mean([t.policies.learned.distance for t in trials])),
        },
        "c": {"median": float(np.median([t.c for t in trials])), "largest": max(t.c for t in trials)},
        "cost_beside_c_percent": {
            method: _interval([100 * (t.beside_c(method) - 1) for t in trials], trials) for method in METHODS
        },
        "correlations_whose_sign_changed_percent": 100 * float(np.mean([t.flipped for t in trials])),
        "largest_miss_of_a_via_point_cm": max(t.largest_miss for t in trials),
        "trials": [t.numbers() for t in trials],
    }


class Letter(NamedTuple):
    """Demonstrations (4, 100, 3) [cm], their mixture over time and place, and the primitive."""

    name: str
    demonstrations: Array
    mixture: GaussianMixture
    base: KMP

    def distance(self, trajectory: Array) -> float:
        """Root mean square distance [cm] of a trajectory (100, 3) from the reference."""
        return float(np.sqrt(np.mean(np.sum((trajectory - self.base.reference.mean) ** 2, axis=1))))


class Policy(NamedTuple):
    """A letter with a Lambda: cost of the joints [rad], distance from the reference [cm], and the
    trajectory (100, 3) [cm].
    """

    correlation: Correlation
    cost: float
    distance: float
    trajectory: Array


class Policies(NamedTuple):
    """Before learning, learned, and three at the same distance from the reference. The number of
    random ones is that of the rollouts; the secants that scale each are not counted.
    """

    first: Policy
    learned: Policy
    constant: Policy  # Lambda = c I
    random: Policy
    begun_at_c: Policy


class Trial(NamedTuple):
    """One letter with one via-point."""

    letter: str
    via_s: float
    via_cm: Array
    policies: Policies
    costs: Array  # (U + 1,) [rad] of the policy before the first update and after each
    trajectories: list[Array]  # the same
    c: float
    flipped: float  # share of the correlations whose sign learning changed
    largest_miss: float  # distance from the via-point [cm]

    def beside_c(self, method: str) -> float:
        """A method's cost as a multiple of that of Lambda = c I."""
        return float(getattr(self.policies, method).cost / self.policies.constant.cost)

    def numbers(self) -> dict[str, Any]:
        """By name."""
        policies = {
            name: {"cost_rad": one.cost, "distance_cm": one.distance} for name, one in self.policies._asdict().items()
        }
        return {"letter": self.letter, "via_s": self.via_s, "c": self.c, **policies}


def tried(one: Letter, number: int, joints: Joints, *, updates: int) -> Trial:
    """A letter with the via-point of a number, by all methods."""
    random = np.random.default_rng([number, *map(ord, one.name)])
    via_s = float(TIMES[random.integers(*VIA_ROWS)])
    way = random.standard_normal(3)
    via = one.base.mean([[via_s]])[0] + VIA_STEP_CM * way / np.linalg.norm(way)
    desired = Gaussians(via[None], VIA_VARIANCE * np.eye(3)[None])
    primitive = one.base.adapt([[via_s]], desired, tolerance=DURATION_S / POINTS)

    def policy(correlation: Correlation) -> Policy:
        trajectory = correlation.applied(primitive).mean(TIMES[:, None])
        return Policy(correlation, joints.cost(trajectory), one.distance(trajectory), trajectory)

    def distance(correlation: Correlation) -> float:
        return one.distance(correlation.applied(primitive).mean(TIMES[:, None]))

    neutral, seen = unlearned(), list[Array]()

    def reward(trajectory: Array) -> float:
        seen.append(trajectory)
        return float(np.exp(-SHARPNESS * joints.cost(trajectory)))

    found = searched(primitive, reward, neutral, updates=updates, seed=number)
    learned, first = policy(found.correlation), policy(neutral)

    def beyond(trajectory: Array) -> float:
        overdrawn = max(0.0, one.distance(trajectory) / learned.distance - 1)
        return float(np.exp(-SHARPNESS * (joints.cost(trajectory) + BEYOND * first.cost * overdrawn)))

    single, c = scaled(neutral, learned.distance, distance)
    best = min(
        (policy(scaled(_drawn(neutral, random), learned.distance, distance, begun=c)[0]) for _ in range(len(seen))),
        key=lambda each: each.cost,
    )
    more = searched(primitive, beyond, single, updates=updates, seed=number, exploration=EXPLORATION * c)
    policies = Policies(first, learned, policy(single), best, policy(more.correlation))
    misses = [each.correlation.applied(primitive).mean([[via_s]])[0] - via for each in policies[1:]]
    signs = np.sign(learned.correlation(TIMES[:, None]))
    flipped = float(np.mean([signs[:, i] * signs[:, j] < 0 for i, j in ((0, 1), (0, 2), (1, 2))]))
    costs, miss = -np.log(found.rewards) / SHARPNESS, float(np.linalg.norm(misses, axis=1).max())
    return Trial(one.name, via_s, via, policies, costs, seen[:: ROLLOUTS + 1], c, flipped, miss)


def unlearned() -> Correlation:
    """Lambda = I, from which each search starts."""
    return Correlation.neutral(np.linspace(0, DURATION_S, BASES)[:, None], width=DURATION_S / BASES, outputs=3)


def searched(
    primitive: KMP,
    reward: Callable[[Array], float],
    correlation: Correlation,
    *,
    updates: int,
    seed: int,
    exploration: float = EXPLORATION,
) -> Improvement:
    """The result of one search for a Lambda, of ROLLOUTS trajectories an update."""
    search: dict[str, Any] = {"updates": updates, "rollouts": ROLLOUTS, "seed": seed, "exploration": exploration}
    return improve(primitive, reward, TIMES[:, None], correlation=correlation, **search)


def scaled(
    correlation: Correlation, wanted: float, distance: Callable[[Correlation], float], *, begun: float = 1.0
) -> tuple[Correlation, float]:
    """The multiple of a Lambda at the wanted distance [cm] from the reference within 1 %, and the
    multiplier; the nearest one that the secants found where none is. `begun` is a first guess.
    """

    def times(log_c: float) -> Correlation:
        return replace(correlation, theta=np.exp(log_c) * correlation.theta)

    before, now = np.log(begun) - 0.3, np.log(begun)
    off_before, off = (distance(times(x)) / wanted - 1 for x in (before, now))
    for _ in range(SECANTS):
        if abs(off) < WITHIN:
            break
        slope = max((off - off_before) / (now - before), LEAST_SLOPE)
        step = float(np.clip(-off / slope, -1.0, 1.0))
        before, off_before, now = now, off, now + step
        off = distance(times(now)) / wanted - 1
    return times(now), float(np.exp(now))


def _drawn(neutral: Correlation, random: np.random.Generator) -> Correlation:
    spread = np.exp(random.uniform(*np.log(SPREAD)))
    return replace(neutral, theta=neutral.theta + spread * random.standard_normal(neutral.theta.shape))


def _interval(values: list[float], trials: list[Trial]) -> dict[str, float]:
    """The mean of a value of each trial, its 95 % interval by bootstrap over letters, and the
    p-value of the letters' means (Wilcoxon, two-sided).
    """
    each: dict[str, list[float]] = {}
    for value, trial in zip(values, trials, strict=True):
        each.setdefault(trial.letter, []).append(value)
    means = np.array([np.mean(of_one) for of_one in each.values()])
    drawn = np.random.default_rng(DRAWING).choice(means, (10_000, len(means))).mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return {
        "mean": float(means.mean()),
        "low": float(low),
        "high": float(high),
        "p": float(wilcoxon(means).pvalue),
        "letters_above_0": int((means > 0).sum()),
    }


def _said(one: Trial) -> str:
    others = ", ".join(f"{method} {one.beside_c(method):.3f}" for method in METHODS)
    first, learned = one.policies[:2]
    return f"{first.cost:.2f} to {learned.cost:.2f} rad at {learned.distance:.1f} cm, beside c: {others}"


class Joints:
    """The WAM's joints along a trajectory of its tool, by the pseudo-inverse of the Jacobian."""

    def __init__(self) -> None:
        settings = Settings()
        self._arm, self._posture = Arm(settings, robot_description(settings)), np.array(settings.arm.posture)

    def _step(self, here: Kinematics, way: Array) -> Kinematics:
        jacobian = here.jacobian[:3]
        return self._arm.at(here.joints + jacobian.T @ np.linalg.solve(jacobian @ jacobian.T, way))

    def along(self, trajectory: Array) -> Array:
        """Joints (M, 7) [rad] for the tool (M, 3) [cm], as the paper moves them: q + J^+ (xi' -
        xi), from the solution nearest to the posture.
        """
        metres = trajectory / 100
        here = self._arm.at(self._posture)
        for _ in range(20):
            here = self._step(here, metres[0] - here.position)
        rows = [here.joints]
        for way in np.diff(metres, axis=0):
            here = self._step(here, way)
            rows.append(here.joints)
        return np.array(rows)

    def cost(self, trajectory: Array) -> float:
        """C, the sum of |W^(1/2) (q' - q)| [rad]."""
        return float(np.sqrt(np.sum(JOINT_WEIGHTS * np.diff(self.along(trajectory), axis=0) ** 2, axis=1)).sum())


def letter(name: str) -> Letter:
    """A letter before the arm, from the model of handwriting, with some depth."""
    flat = write(name, count=len(LETTERS.numbers), seed=LETTERS.seed)[:, ::2]
    random = np.random.default_rng(LETTERS.seed)
    phase = np.linspace(0, 1, flat.shape[1])
    demonstrations = []
    for one in flat:
        depth = 3.0 * np.sin(np.pi * phase) + DEPTH_STD_CM * sum(
            random.standard_normal() * np.sin((k + 1) * np.pi * phase) for k in range(3)
        )
        across, up, out = one[:, 0], one[:, 1], depth
        x = up * np.cos(TILT) - out * np.sin(TILT)
        z = up * np.sin(TILT) + out * np.cos(TILT)
        demonstrations.append(CENTRE_CM + np.column_stack([x, -across, z]))
    stacked = np.array(demonstrations)
    samples = np.concatenate([np.column_stack([TIMES, one]) for one in stacked])
    mixture = GaussianMixture.fit(samples, components=COMPONENTS, seed=SEEDS.method, regularization=1e-4)
    reference = mixture.regress(TIMES[:, None])
    base = KMP.fit(
        TIMES[:, None], reference, kernel=GaussianKernel(ELL), lambda_mean=LAMBDA, prior_mean=stacked.mean(axis=(0, 1))
    )
    return Letter(name, stacked, mixture, base)


def _draw(results: Results, one: Letter, trials: list[Trial]) -> None:
    plt = pyplot()
    figure = plt.figure(figsize=(10, 7.9))
    above, below = figure.subfigures(2, 1, height_ratios=(1.5, 1), hspace=0.06)
    first, second = above.subplots(1, 2, subplot_kw={"projection": "3d"})
    third, fourth = below.subplots(1, 2)
    trial = trials[0]
    for line in one.demonstrations:
        first.plot(*line.T, color=REFERENCE, lw=0.9)
    sphere = _sphere()
    for mean, covariance in zip(one.mixture.means[:, 1:], one.mixture.covariances[:, 1:, 1:], strict=True):
        first.plot_surface(
            *(mean[:, None, None] + np.einsum("ij,jkl->ikl", np.linalg.cholesky(covariance), sphere)),
            color=ADAPTED,
            alpha=0.35,
            lw=0,
        )
    first.set_title("(a) demonstrations and mixture", loc="left")
    shown = np.unique(np.linspace(0, len(trial.trajectories) - 1, 8).round().astype(int))
    for shade, k in zip(np.linspace(0.25, 1.0, len(shown)), shown, strict=True):
        label = "learned, from light to dark" if k == shown[-1] else None
        second.plot(*trial.trajectories[k].T, color=plt.get_cmap("Blues")(shade), lw=1.4, label=label)
    second.plot(*one.base.reference.mean.T, "--", color=REFERENCE, lw=1.2, label="reference")
    label = f"Λ = {trial.c:.1f} I, as far from the reference"
    second.plot(*trial.policies.constant.trajectory.T, color=ADAPTED, lw=1.6, label=label)
    last = trial.trajectories[-1]
    second.plot(*last[:1].T, "*", color="black", ms=8, label="start")
    second.plot(*last[-1:].T, "+", color="black", ms=9, mew=2, label="end")
    second.plot(*trial.via_cm[:, None], "o", mfc="none", mec=DESIRED, mew=2, ms=10, label="via-point")
    second.set_title("(b) learned, and loosened by one number", loc="left")
    above.legend(*second.get_legend_handles_labels(), loc="outside upper center", ncols=6, frameon=False, fontsize=8)
    for axes in (first, second):
        lines = [one.demonstrations.reshape(-1, 3), *trial.trajectories, trial.policies.constant.trajectory]
        equal_box(axes, np.concatenate(lines))
        axes.view_init(elev=18, azim=-30)
        axes.set(xlabel="x [cm]", ylabel="y [cm]", zlabel="z [cm]")
        axes.tick_params(labelsize=7)
    falls = np.array([100 * t.costs / t.costs[0] for t in trials])
    third.plot(falls.T, color=OTHER, lw=0.6, alpha=0.35)
    third.plot(falls.mean(axis=0), color=OTHER, lw=2.2, label="mean")
    third.set(xlabel="updates", ylabel="cost of the joints' motion [% of the first]", ylim=(0, None), xlim=(0, None))
    third.set_title(f"(c) {len(trials)} trials: letters and via-points", loc="left")
    for row, method in enumerate(METHODS):
        values = np.array([t.beside_c(method) for t in trials])
        aside = np.random.default_rng([DRAWING, row]).uniform(-0.25, 0.25, len(values))
        fourth.plot(values, row + aside, ".", color=OTHER, alpha=0.6)
        fourth.plot([values.mean()] * 2, [row - 0.36, row + 0.36], color="black", lw=2)
    fourth.axvline(1.0, color=ADAPTED, lw=1.6)
    fourth.set(
        yticks=range(len(METHODS)), yticklabels=METHODS.values(), xlim=(0, None), ylim=(len(METHODS) - 0.5, -0.5)
    )
    fourth.set(xlabel="cost, times that of Λ = c I at the same distance from the reference")
    fourth.set_title("(d) what is left beside one number (bars: means)", loc="left")
    results.figure(figure)


def _sphere() -> Array:
    u, v = np.mgrid[0 : 2 * np.pi : 20j, 0 : np.pi : 12j]
    return np.array([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])


def _record(results: Results, one: Letter, trial: Trial) -> None:
    stream = results.recording()
    stream.log(
        "/letter/demonstrations",
        rr.LineStrips3D(list(one.demonstrations), colors=[rgb(REFERENCE)], radii=[0.05]),
        static=True,
    )
    stream.log("/letter/via_point", rr.Points3D([trial.via_cm], colors=[rgb(DESIRED)], radii=[0.4]), static=True)
    constant = rr.LineStrips3D([trial.policies.constant.trajectory], colors=[rgb(ADAPTED)], radii=[0.1])
    stream.log("/letter/constant", constant, static=True)
    for k, (trajectory, cost) in enumerate(zip(trial.trajectories, trial.costs, strict=True)):
        stream.set_time("update", sequence=k)
        stream.log("/letter/adapted", rr.LineStrips3D([trajectory], colors=[rgb(OTHER)], radii=[0.1]))
        stream.log("/cost", rr.Scalars(float(cost)))
    stream.disconnect()
