"""Gain of small motion by its frequency, from true hands to setpoint and tool, for `motion`.

The gain is the amplitude at that frequency, relative to that of the skill's target for the true
hands.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from thirdhand_sim.lab.people.moving_hands import PERIOD_S, SMALL_JUDGED_S, SMALL_KINDS
from thirdhand_sim.lab.results import ADAPTED, TOOL_COLOUR, Array, Results, legend_below, pyplot

PATHS = ("setpoint", "tool")
FOLLOWER_LABELS = {
    "ours": ("ours", TOOL_COLOUR),
    "chase": ("One-Euro filter, then Ruckig after the target", ADAPTED),
}


def gain(target: Array, path: Array, rate_hz: float) -> float:
    """Amplitude of a path (N, 3) [m] at a frequency, relative to the target's (N, 3)."""
    return float(
        np.linalg.norm(_amplitude(path, rate_hz)) / np.linalg.norm(_amplitude(target, rate_hz))
    )


def _amplitude(path: Array, rate_hz: float) -> Array:
    """Coefficients (2, 3) [m] of sine and cosine at the end of a path (N, 3), without its drift."""
    path = path[-round(SMALL_JUDGED_S / PERIOD_S) :]
    t = np.arange(len(path)) * PERIOD_S
    angle = 2 * np.pi * rate_hz * t
    drift = np.vander(t - t.mean(), 4)
    basis = np.column_stack([np.sin(angle), np.cos(angle), drift])
    return np.asarray(np.linalg.lstsq(basis, path, rcond=None)[0][:2])


def draw(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of the gains, by frequency."""
    plt = pyplot()
    figure, axes = plt.subplots(
        1, len(SMALL_KINDS), figsize=(9, 3.4), sharey=True, layout="constrained"
    )
    for panel, kind in zip(axes, SMALL_KINDS, strict=True):
        panel.axhline(1.0, color="0.8", lw=1)
        for follower, (label, colour) in FOLLOWER_LABELS.items():
            for path, style in zip(PATHS, ("-", "--"), strict=True):
                values = numbers[kind][follower][path]
                panel.plot(
                    numbers["hz"],
                    values,
                    style,
                    marker="o",
                    ms=3,
                    color=colour,
                    label=f"{label}: {path}",
                )
        panel.set(title=kind, xlabel="frequency [Hz]", ylim=(0, None))
        panel.set_xticks(range(1, 13))
    axes[0].set_ylabel("gain, from the target for true hands")
    legend_below(figure, axes[0].get_legend_handles_labels()[0], columns=2)
    results.figure(figure, "gain")
