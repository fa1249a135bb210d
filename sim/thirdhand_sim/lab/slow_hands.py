"""Speed of a tool while a hand begins to move slowly, for `motion`."""

from __future__ import annotations

from typing import Any

import numpy as np

from thirdhand_sim.lab.gains import FOLLOWER_LABELS
from thirdhand_sim.lab.people.moving_hands import PERIOD_S, SLOW_BEGINS_S, SLOW_RISE_S
from thirdhand_sim.lab.results import REFERENCE, Array, Results, legend_below, pyplot

SLOW_HANDS_MPS = (0.01, 0.05)
TRACKERS = {100: 0.0005, 30: 0.002}  # noise [m] by rate [Hz]
EVERY = 10  # ticks from one point of a curve to the next
BEGIN = round(0.8 / PERIOD_S / EVERY)  # first point that is shown
RISEN = round((SLOW_BEGINS_S + SLOW_RISE_S) / PERIOD_S / EVERY)
EVEN = round(2.5 / PERIOD_S / EVERY)  # from this point on the motion should be even


def curves(target: Array, tool: Array) -> list[list[float]]:
    """Speeds [m/s] of target and tool (N, 3) along the target's motion, at every EVERYth tick."""
    direction = target[-1] - target[0]
    direction = direction / np.linalg.norm(direction)
    velocities = [np.gradient(path, PERIOD_S, axis=0) @ direction for path in (target, tool)]
    return [velocity[EVERY // 2 :: EVERY].tolist() for velocity in velocities]


def evenness(speeds: Array) -> dict[str, float]:
    """Largest speed of the tool, its mean, and its standard deviation around that, as shares of the
    target's speed; the mean of (K, 2, T) curves over K hands.
    """
    wanted = speeds[:, 0, EVEN:-1].mean(axis=1)
    even = speeds[:, 1, EVEN:-1]
    return {
        "largest": float(np.mean(speeds[:, 1, RISEN:-1].max(axis=1) / wanted)),
        "mean": float(np.mean(even.mean(axis=1) / wanted)),
        "deviation": float(np.mean(even.std(axis=1) / wanted)),
    }


def draw(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of the first hand's speeds, by speed and tracker."""
    plt = pyplot()
    figure, axes = plt.subplots(1, len(numbers), figsize=(10, 3.2), layout="constrained")
    for panel, (kind, by_follower) in zip(axes, numbers.items(), strict=True):
        for follower, (label, colour) in reversed(FOLLOWER_LABELS.items()):
            wanted, seen = 1000 * np.array(by_follower[follower]["first"])
            times_s = (np.arange(len(wanted)) * EVERY + EVERY // 2) * PERIOD_S
            panel.plot(times_s[BEGIN:-1], seen[BEGIN:-1], color=colour, lw=1.2, label=label)
        panel.plot(times_s[BEGIN:-1], wanted[BEGIN:-1], "--", color=REFERENCE, label="target")
        panel.set(title=kind, xlabel="time [s]")
    axes[0].set_ylabel("speed of the tool [mm/s]")
    legend_below(figure, axes[0].get_legend_handles_labels()[0], columns=3)
    results.figure(figure, "slow")
