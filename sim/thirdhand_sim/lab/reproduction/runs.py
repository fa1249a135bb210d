"""Ten runs of the search for correlations (the paper, Figure 3(c)): the same letter D with one
via-point, and another seed for each run.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kmp import Gaussians
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.reproduction import correlation
from thirdhand_sim.lab.reproduction.correlation import SHARPNESS, SHOWN, TIMES
from thirdhand_sim.lab.results import (
    OTHER,
    Array,
    Options,
    Results,
    pyplot,
)

SEARCHES = EXPERIMENTS["runs"].seeds.evaluation["searches"]
VIA_ROW = 50  # row of the via-point, of 100 along the letter


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    one, joints, at = correlation.letter(SHOWN), correlation.Joints(), TIMES[VIA_ROW : VIA_ROW + 1, None]
    place = one.base.mean(at)[0] + correlation.VIA_STEP_CM * np.array([0.0, 0.6, 0.8])
    desired = Gaussians(place[None], correlation.VIA_VARIANCE * np.eye(3)[None])
    primitive = one.base.adapt(at, desired, tolerance=correlation.DURATION_S / correlation.POINTS)

    def reward(trajectory: Array) -> float:
        return float(np.exp(-SHARPNESS * joints.cost(trajectory)))

    updates, costs, misses = max(2, round(correlation.UPDATES * options.share)), [], []
    for seed in SEARCHES.share(options.share, least=2):
        found = correlation.searched(primitive, reward, correlation.unlearned(), updates=updates, seed=seed)
        costs.append(-np.log(found.rewards) / SHARPNESS)
        misses.append(float(np.linalg.norm(found.primitive.mean(at)[0] - place)))
        results.say(f"run {seed}: {costs[-1][0]:.2f} to {costs[-1][-1]:.2f} rad")
    each = np.array(costs)
    numbers = {
        "units": "rad, cm",
        "letter": SHOWN,
        "runs": len(each),
        "updates": updates,
        "cost_rad": {"first": float(each[0, 0]), **_spread("last", each[:, -1])},
        "cost_fall_percent": _spread("mean", 100 * (1 - each[:, -1] / each[:, 0])),
        "runs_that_fell": int((each[:, -1] < each[:, 0]).sum()),
        "largest_miss_of_the_via_point_cm": max(misses),
        "mean_cost_rad": each.mean(axis=0).tolist(),
        "deviation_rad": each.std(axis=0, ddof=1).tolist(),
    }
    draw_numbers(results, numbers)
    return numbers


def _spread(name: str, values: Array) -> dict[str, float]:
    return {
        name: float(values.mean()),
        "deviation": float(values.std(ddof=1)),
        "least": float(values.min()),
        "largest": float(values.max()),
    }


def draw_numbers(results: Results, numbers: dict[str, Any]) -> None:
    """The figure: mean cost after each update, and bars of one deviation."""
    figure, axes = pyplot().subplots(figsize=(5.4, 3.2))
    mean, deviation = np.array(numbers["mean_cost_rad"]), np.array(numbers["deviation_rad"])
    axes.errorbar(np.arange(len(mean)), mean, deviation, color=OTHER, capsize=2.5, lw=1.6, elinewidth=0.9)
    axes.set(xlabel="updates", ylabel="cost of the joints' motion [rad]", ylim=(0, None))
    axes.set_title(f"mean and 1 deviation of {numbers['runs']} runs", loc="left", fontsize=9)
    results.figure(figure)
