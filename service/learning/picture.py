"""A picture of what a skill was judged by: errors of held-out demonstrations and what was predicted
of them, and what the gate lets through.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service import palette
from service.core.frame import Vector
from service.learning.choice import mahalanobis
from service.learning.gate import nonsense
from service.learning.learn import Evidence

SHARES = np.linspace(0.05, 0.95, 19)
TOOL, TARGET, OFF, GATE = map(palette.written, (palette.TOOL, palette.TARGET, palette.OFF, palette.GATE))
NONSENSE = {"hands swapped": "0.7", "both 30 cm beside": "0.5", "one 30 cm beside": "0.3"}  # shades of grey


def draw(evidence: Evidence, path: Path) -> None:
    """Writes the picture, a PNG."""
    from matplotlib.figure import Figure  # heavy, and most learn without
    from scipy.stats import chi2

    figure = Figure(figsize=(11, 7.5), layout="constrained", dpi=110)
    (above, errors), (regions, gate) = figure.subplots(2, 2)
    skill, held_out = evidence.skill, evidence.held_out

    above.set(title="the tool from above: demonstrated, and predicted by the others", xlabel="x [m]", ylabel="y [m]")
    for i, ((_, tool), one) in enumerate(zip(evidence.paths, held_out, strict=True)):
        predicted = tool - one.errors
        above.plot(tool[:, 0], tool[:, 1], color=TOOL, lw=1, label="demonstrated" if i == 0 else None)
        above.plot(predicted[:, 0], predicted[:, 1], color=TARGET, lw=1, label="predicted" if i == 0 else None)
    above.set_aspect("equal", adjustable="datalim")
    above.legend(frameon=False)

    grid = np.linspace(0.0, 1.0, 200)
    lengths = np.array([_along(np.linalg.norm(one.errors, axis=1), grid) for one in held_out])
    expected = np.array([_along(np.sqrt(3.0) * one.gate_m, grid) for one in held_out])
    errors.plot(grid, 1000 * lengths.T, color="0.6", lw=0.8)
    errors.plot([], [], color="0.6", lw=0.8, label="each demonstration, held out")
    errors.plot(grid, 1000 * np.sqrt((lengths**2).mean(axis=0)), color=TOOL, lw=2, label="root mean square")
    errors.plot(grid, 1000 * np.sqrt((expected**2).mean(axis=0)), color=TARGET, ls="--", lw=2, label="predicted")
    errors.set(title="error", xlabel="share of the demonstration's time", ylabel="[mm]", ylim=(0, None), xlim=(0, 1))
    errors.legend(frameon=False)

    distances = np.concatenate([mahalanobis(one.errors, one.covariance) for one in held_out])
    inside = (distances[:, None] <= chi2.ppf(SHARES, 3)).mean(axis=0)
    regions.plot((0, 100), (0, 100), color="0.6", lw=1, label="as it should be")
    regions.plot(100 * SHARES, 100 * inside, "o-", color=TARGET, ms=4, label="held out")
    regions.set(title="regions of so many per cent hold", xlabel="[%]", ylabel="of the samples [%]")
    regions.set(xlim=(0, 100), ylim=(0, 100))
    regions.legend(frameon=False)

    hands = np.concatenate([hands[:: max(1, len(hands) // 50)] for hands, _ in evidence.paths])
    shown = {"held-out demonstrations": (np.concatenate([one.gate_m for one in held_out]), OFF)}
    for (name, colour), wrong in zip(NONSENSE.items(), nonsense(hands[:, :6]), strict=True):
        shown[name] = skill.model.gates_m(wrong), colour
    for name, (values, colour) in shown.items():
        gate.plot(1000 * np.sort(values), 100 * np.linspace(0, 1, len(values)), color=colour, label=name)
    gate.axvline(1000 * skill.threshold, color=GATE, ls="--", lw=1, label=f"gate, {1000 * skill.threshold:.0f} mm")
    gate.set(title=f"{skill.model.measure}: what is held lies to the right", xlabel="[mm]", ylabel="of the samples [%]")
    gate.set(xscale="log", ylim=(0, 100))
    gate.legend(frameon=False, fontsize=8)

    overall, count = evidence.figures.all, len(held_out)
    told = (
        f"{count} demonstrations, each predicted by the others to {overall.error_mm:.0f} mm rms"
        if count > 1
        else f"one demonstration, none held out: {overall.error_mm:.0f} mm rms in what was learned"
    )
    figure.suptitle(f"{skill.name}: {told}, {overall.predicted_mm:.0f} mm predicted")
    figure.savefig(path, format="png")


def _along(values: Vector, grid: Vector) -> Vector:
    """Values (T,) over the share of the time, at a grid (M,)."""
    return np.interp(grid, np.linspace(0.0, 1.0, len(values)), values)
