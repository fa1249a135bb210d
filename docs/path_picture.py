"""`python docs/path_picture.py` draws path.png: the share of its path that a hand has
covered, as the skill between via-points computes it.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from thirdhand.core.frame import structured
from thirdhand.core.skill.segments import SEGMENT, along_way, on_way

PICTURE = Path(__file__).with_name("path.png")
DPI = 90
# lengths of two paths
LONG_M = 0.5
SHORT_M = 0.2
HAND = np.array([0.22, 0.09, 0.0])  # beside a path along the first axis


def segment_of(length_m: float) -> np.record:
    """A segment in which the left hand moves straight along the first axis."""
    segment = structured(1, SEGMENT)
    segment["way"][0, 0, 0] = length_m
    segment["square"][0, 0] = length_m**2
    return segment[0]


def draw_path(axes: Axes) -> None:
    """A hand beside its path, with λ and d."""
    share, off_m = on_way(HAND, segment_of(LONG_M), 0)
    foot = share * LONG_M
    axes.annotate(
        "",
        (LONG_M, 0.0),
        (0.0, 0.0),
        arrowprops={"arrowstyle": "-|>", "color": "tab:blue", "lw": 2},
    )
    axes.plot([0.0, LONG_M], [0.0, 0.0], "o", color="tab:blue")
    axes.plot([foot, foot], [0.0, HAND[1]], ":", color="0.4")
    axes.plot(*HAND[:2], "o", color="tab:orange", ms=9)
    axes.text(HAND[0] + 0.015, HAND[1], "hand h", va="center")
    axes.text(foot + 0.012, 0.5 * HAND[1], f"d = {off_m:g} m", va="center", color="0.3")
    axes.annotate("", (foot, -0.03), (0.0, -0.03), arrowprops={"arrowstyle": "<->", "color": "0.3"})
    axes.text(0.5 * foot, -0.055, f"λ w, λ = {share:g}", ha="center", color="0.3")
    axes.text(0.0, -0.055, "via-point b", ha="center")
    axes.text(LONG_M, -0.055, "next via-point", ha="center")
    axes.text(0.75 * LONG_M, 0.012, "path w", ha="center", color="tab:blue")
    axes.set(xlim=(-0.08, LONG_M + 0.12), ylim=(-0.09, 0.15), title="Where a hand is in a segment")
    axes.set_aspect("equal")
    axes.axis("off")


def draw_shares(axes: Axes) -> None:
    """The share by λ, of hands that move and of hands that rest."""
    covered = np.linspace(0.0, 1.0, 201)
    axes.plot(covered, covered, color="0.5", label="the hand moves")
    for length_m, style in ((LONG_M, "-"), (SHORT_M, "--")):
        segment = segment_of(length_m)
        shares = [along_way(np.array([x * length_m, 0.0, 0.0]), 1.0, segment, 0) for x in covered]
        axes.plot(
            covered, shares, style, color="tab:orange", label=f"it rests, path of {length_m:g} m"
        )
    axes.set(xlabel="λ", ylabel="share of the path", title="Resting hands are drawn to the ends")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)


def main() -> None:
    """Draw the picture beside this file."""
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(11, 3.6), width_ratios=(1.3, 1.0), layout="constrained"
    )
    draw_path(left)
    draw_shares(right)
    figure.savefig(PICTURE, dpi=DPI)


if __name__ == "__main__":
    main()
