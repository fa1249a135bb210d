"""Correlations learned from a reward (the paper, section III-B and Figure 3): a 3-D letter D that
costs the arm's joints less and less motion.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import rerun as rr
from scipy.stats import ttest_1samp, wilcoxon

from kmp import KMP, Correlation, GaussianKernel, GaussianMixture, Gaussians, improve
from service.config import WAM, Settings
from sim.experiments.results import ADAPTED, DESIRED, OTHER, REFERENCE, Array, Options, Results, equal_box, pyplot, rgb
from sim.experiments.writing import write

ELL, LAMBDA, SHARPNESS = 0.1, 2.0, 5.0  # the paper's ell, lambda and gamma; here over seconds and centimetres
DURATION_S, POINTS, DEMONSTRATIONS, COMPONENTS = 10.0, 100, 4, 8
CENTRE_CM = np.array([55.0, 0.0, 40.0])  # of the letter, frame base
TILT = np.radians(60)  # of the plane it is written in, against the table
DEPTH_STD_CM = 0.8
VIA_ROW, VIA_STEP_CM, VIA_VARIANCE = 65, np.array([2.0, -3.0, 2.0]), 1e-6
JOINT_WEIGHTS = np.array([3.0, 3.0, 2.0, 2.0, 1.0, 1.0, 1.0])  # W: what moves much of the arm costs more
BASES, EXPLORATION, UPDATES, ROLLOUTS, RUNS = 8, 0.25, 30, 12, 10
TIMES = np.linspace(0.0, DURATION_S, POINTS)
VIA_S = float(TIMES[VIA_ROW])


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    runs, updates = max(2, round(RUNS * options.share)), max(2, round(UPDATES * options.share))
    shown = letter()
    demonstrations, _, base = shown
    at = base.mean([[VIA_S]])[0] + VIA_STEP_CM
    primitive = base.adapt(
        [[VIA_S]], Gaussians(at[None], VIA_VARIANCE * np.eye(3)[None]), tolerance=DURATION_S / POINTS
    )
    joints = Joints()
    learned = []
    for seed in range(runs):
        learned.append(_learned(primitive, joints, updates=updates, seed=seed))
        results.say(f"run {seed + 1} of {runs}: cost {learned[-1].costs[0]:.3f} to {learned[-1].costs[-1]:.3f} rad")
    costs = np.array([one.costs for one in learned])
    _draw(results, shown, at, learned[0].trajectories, costs)
    _record(results, demonstrations, learned[0].trajectories, at, costs)
    falls = costs[:, 0] - costs[:, -1]
    final = [one.trajectories[-1] for one in learned]
    return {
        "units": "s, cm, rad",
        "ell": ELL,
        "lambda": LAMBDA,
        "gamma": SHARPNESS,
        "runs": runs,
        "updates": updates,
        "rollouts": ROLLOUTS,
        "cost_at_first_rad": float(costs[0, 0]),
        "cost_at_last_rad": {"mean": float(costs[:, -1].mean()), "std": float(costs[:, -1].std())},
        "fall_percent": float(100 * (falls / costs[:, 0]).mean()),
        "wilcoxon_p": float(wilcoxon(falls, alternative="greater").pvalue),
        "t_test_p": float(ttest_1samp(falls, 0.0, alternative="greater").pvalue),
        "largest_miss_of_the_via_point_cm": max(one.largest_miss for one in learned),
        "deviation_from_the_reference_rms_cm": float(
            np.mean([np.sqrt(np.mean(np.sum((f - base.reference.mean) ** 2, axis=1))) for f in final])
        ),
        "deviation_before_learning_rms_cm": float(
            np.sqrt(np.mean(np.sum((learned[0].trajectories[0] - base.reference.mean) ** 2, axis=1)))
        ),
    }


class Letter(NamedTuple):
    """Demonstrations (4, 100, 3) [cm], their mixture over time and place, and the primitive."""

    demonstrations: Array
    mixture: GaussianMixture
    base: KMP


class Run(NamedTuple):
    """One run of the learning: the policy's cost [rad] and trajectory (M, 3) [cm] before the first
    update and after each; the largest miss [cm].
    """

    costs: Array
    trajectories: list[Array]
    largest_miss: float


def _learned(primitive: KMP, joints: Joints, *, updates: int, seed: int) -> Run:
    seen: list[Array] = []

    def reward(trajectory: Array) -> float:
        seen.append(trajectory)
        return float(np.exp(-SHARPNESS * joints.cost(trajectory)))

    centres = np.linspace(0.0, DURATION_S, BASES)[:, None]
    start = Correlation.neutral(centres, width=DURATION_S / BASES, outputs=3)
    found = improve(
        primitive,
        reward,
        TIMES[:, None],
        correlation=start,
        exploration=EXPLORATION,
        updates=updates,
        rollouts=ROLLOUTS,
        seed=seed,
    )
    policies = seen[:: ROLLOUTS + 1]  # before the first update, and after the rollouts of each
    wanted = primitive.via_points.mean[0]
    miss = float(np.linalg.norm(found.primitive.mean([[VIA_S]])[0] - wanted))
    return Run(-np.log(found.rewards) / SHARPNESS, policies, miss)


class Joints:
    """The WAM's joints along a trajectory of its tool, by the pseudo-inverse of the Jacobian."""

    def __init__(self) -> None:
        self._model = pin.buildModelFromUrdf(str(WAM))
        self._data = self._model.createData()
        self._tool = self._model.getFrameId("tool_plate")
        self._posture = np.array(Settings().arm.posture)

    def _jacobian(self, q: Array) -> Array:
        jacobian: Array = pin.computeFrameJacobian(
            self._model, self._data, q, self._tool, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )[:3]
        return jacobian

    def _step(self, q: Array, way: Array) -> Array:
        jacobian = self._jacobian(q)
        return np.asarray(q + jacobian.T @ np.linalg.solve(jacobian @ jacobian.T, way))

    def along(self, trajectory: Array) -> Array:
        """Joints (M, 7) [rad] for the tool (M, 3) [cm], as the paper moves them: q + J^+ (xi' -
        xi), from the posture's nearest at the start.
        """
        metres = trajectory / 100
        q = self._posture
        for _ in range(20):
            pin.framesForwardKinematics(self._model, self._data, q)
            q = self._step(q, metres[0] - self._data.oMf[self._tool].translation)
        rows = [q]
        for way in np.diff(metres, axis=0):
            rows.append(self._step(rows[-1], way))
        return np.array(rows)

    def cost(self, trajectory: Array) -> float:
        """C, the sum of |W^(1/2) (q' - q)| [rad]."""
        return float(np.sqrt(np.sum(JOINT_WEIGHTS * np.diff(self.along(trajectory), axis=0) ** 2, axis=1)).sum())


def letter() -> Letter:
    """A letter D before the arm, from the model of handwriting."""
    flat = write("D", count=DEMONSTRATIONS, seed=3)[:, ::2]
    random = np.random.default_rng(3)
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
    mixture = GaussianMixture.fit(samples, components=COMPONENTS, seed=0, regularization=1e-4)
    reference = mixture.regress(TIMES[:, None])
    base = KMP.fit(
        TIMES[:, None], reference, kernel=GaussianKernel(ELL), lambda_mean=LAMBDA, prior_mean=stacked.mean(axis=(0, 1))
    )
    return Letter(stacked, mixture, base)


def _draw(results: Results, shown_letter: Letter, via: Array, trajectories: list[Array], costs: Array) -> None:
    demonstrations, mixture, base = shown_letter
    plt = pyplot()
    figure = plt.figure(figsize=(12, 4.4))
    places = figure.add_gridspec(1, 4, width_ratios=(1, 1, 0.12, 0.8))
    first, second = (figure.add_subplot(places[i], projection="3d") for i in (0, 1))
    third = figure.add_subplot(places[3])
    for one in demonstrations:
        first.plot(*one.T, color=REFERENCE, lw=0.9)
    sphere = _sphere()
    for mean, covariance in zip(mixture.means[:, 1:], mixture.covariances[:, 1:, 1:], strict=True):
        first.plot_surface(
            *(mean[:, None, None] + np.einsum("ij,jkl->ikl", np.linalg.cholesky(covariance), sphere)),
            color=ADAPTED,
            alpha=0.35,
            lw=0,
        )
    first.set_title("(a) demonstrations and mixture", loc="left")
    shown = np.unique(np.linspace(0, len(trajectories) - 1, 8).round().astype(int))
    for shade, k in zip(np.linspace(0.25, 1.0, len(shown)), shown, strict=True):
        second.plot(*trajectories[k].T, color=plt.get_cmap("Blues")(shade), lw=1.4)
    last = trajectories[-1]
    second.plot(*base.reference.mean.T, "--", color=REFERENCE, lw=1.2, label="reference")
    second.plot(*last[:1].T, "*", color="black", ms=8, label="start")
    second.plot(*last[-1:].T, "+", color="black", ms=9, mew=2, label="end")
    second.plot(*via[:, None], "o", mfc="none", mec=DESIRED, mew=2, ms=10, label="via-point")
    figure.legend(*second.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    second.set_title("(b) adapted, from light to dark", loc="left")
    for axes in (first, second):
        equal_box(axes, np.concatenate([demonstrations.reshape(-1, 3), *trajectories]))
        axes.view_init(elev=18, azim=-30)
        axes.set(xlabel="x [cm]", ylabel="y [cm]", zlabel="z [cm]")
        axes.tick_params(labelsize=7)
    third.errorbar(
        range(costs.shape[1]), costs.mean(axis=0), costs.std(axis=0), color=OTHER, ecolor="#56B4E9", capsize=2
    )
    third.set(xlabel="updates", ylabel="cost of the joints' motion [rad]")
    third.set_title(f"(c) {len(costs)} runs: mean, standard deviation", loc="left")
    results.figure(figure)


def _sphere() -> Array:
    u, v = np.mgrid[0 : 2 * np.pi : 20j, 0 : np.pi : 12j]
    return np.array([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])


def _record(results: Results, demonstrations: Array, trajectories: list[Array], via: Array, costs: Array) -> None:
    stream = results.recording()
    stream.log(
        "/letter/demonstrations",
        rr.LineStrips3D(list(demonstrations), colors=[rgb(REFERENCE)], radii=[0.05]),
        static=True,
    )
    stream.log("/letter/via_point", rr.Points3D([via], colors=[rgb(DESIRED)], radii=[0.4]), static=True)
    for k, trajectory in enumerate(trajectories):
        stream.set_time("update", sequence=k)
        stream.log("/letter/adapted", rr.LineStrips3D([trajectory], colors=[rgb(OTHER)], radii=[0.1]))
        stream.log("/cost", rr.Scalars(costs[:, k].tolist()))
    stream.disconnect()
