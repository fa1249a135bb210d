"""Joint speeds by frequency while the tool moves, for `motion`. A person's motion has no components
between 4 and 13 Hz.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import butter, sosfiltfilt

from thirdhand_sim.lab.people.moving_hands import PERIOD_S
from thirdhand_sim.lab.results import ADAPTED, OTHER, REFERENCE, TOOL_COLOUR, Array, Results, pyplot

RIPPLE_HZ = (4.0, 13.0)
RIPPLE_BANDS = 3  # bands within RIPPLE_HZ
EDGES_HZ = RIPPLE_HZ[0] * (RIPPLE_HZ[1] / RIPPLE_HZ[0]) ** (np.arange(-5, 7) / RIPPLE_BANDS)
MOVING_MPS = 0.05  # speed of a moving tool
SPECTRUM_LABELS = {
    "truth": ("true hands, through the arm", REFERENCE, "--"),
    "ours": ("ours", TOOL_COLOUR, "-"),
    "chase": ("One-Euro filter, then Ruckig after the target", ADAPTED, "-"),
    "no smoothing": ("no smoothing", OTHER, "-"),
}


def speeds(tool: Array, joints: Array) -> list[float]:
    """The joints' speeds (N, J) [rad/s], rms within each of the bands of `EDGES_HZ`, below and
    above them, while the tool (N, 3) [m] moves.
    """
    moving = np.linalg.norm(np.gradient(tool, PERIOD_S, axis=0), axis=1) > MOVING_MPS
    low = [
        sosfiltfilt(butter(4, edge, fs=1 / PERIOD_S, output="sos"), joints, axis=0)
        for edge in EDGES_HZ
    ]
    bands = np.diff(np.stack([np.zeros_like(joints), *low, joints]), axis=0)[:, moving]
    return [
        math.sqrt(np.mean(np.sum(band**2, axis=1))) if len(band) else math.nan for band in bands
    ]


def ripple(bands: list[float]) -> float:
    """The share of the speeds that lies in RIPPLE_HZ."""
    begin = int(np.argmin(abs(EDGES_HZ - RIPPLE_HZ[0]))) + 1
    return float(np.linalg.norm(bands[begin : begin + RIPPLE_BANDS]) / np.linalg.norm(bands))


def draw(results: Results, by_follower: dict[str, list[float]]) -> None:
    """The figure of the joints' speeds by frequency."""
    plt = pyplot()
    figure, panel = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
    panel.axvspan(*RIPPLE_HZ, color="0.93", lw=0)
    for name, bands in by_follower.items():
        label, colour, style = SPECTRUM_LABELS[name]
        middles = np.sqrt(EDGES_HZ[1:] * EDGES_HZ[:-1])
        panel.plot(
            middles,
            1000 * np.array(bands[1:-1]),
            style,
            marker="o",
            ms=4,
            color=colour,
            label=label,
        )
    panel.set(
        xscale="log",
        yscale="log",
        xlabel="frequency [Hz]",
        ylabel="joints' speed in a band, rms [mrad/s]",
    )
    ticks = (1, 2, 4, 7, 13, 30)
    panel.set_xticks(ticks, [str(tick) for tick in ticks])
    panel.set_xticks([], minor=True)
    panel.legend(frameon=False, fontsize=8)
    results.figure(figure, "spectra")
