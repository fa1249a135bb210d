"""Picture of tried settings: error against jerk, the spectrum of the hands, and the second with the
largest difference.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from thirdhand.core.frame import Vector
from thirdhand.settings import palette
from thirdhand.workbench.report.true_hands import TREMOR_RANGE_HZ
from thirdhand.workbench.report.variants import JudgedHands, VariantFigures, changed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RECORDED_COLOUR, PROPOSED_COLOUR, IDEAL_COLOUR = map(palette.written, (palette.NEAREST, palette.TOOL, palette.TARGET))
BY_SIDE = {"left": palette.written(palette.LEFT), "right": palette.written(palette.RIGHT)}
TAG_SHARE = 0.06  # points nearer than this share of the plot have one tag
MOTION_SHOWN_S = 4.0  # length of the motion that is shown


def draw(judged_hands: JudgedHands, variants: list[VariantFigures], chosen: VariantFigures, path: Path) -> None:
    """Write the picture as a PNG file. Raises OSError if the file cannot be written."""
    figure = Figure(figsize=(11, 10), layout="constrained", dpi=110)
    parts = figure.subplot_mosaic("e;s;m")
    _draw_trade_off(parts["e"], variants, chosen)
    _draw_spectrum(parts["s"], judged_hands)
    _draw_motion(parts["m"], judged_hands, chosen)
    for axes in parts.values():
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(f"{judged_hands.hands.path.name}: {judged_hands.judged_s:.1f} s judged")
    figure.savefig(path, format="png")


def _draw_trade_off(axes: Axes, variants: list[VariantFigures], chosen: VariantFigures) -> None:
    """Error against jerk; variants with nearly the same figures share a number tag."""
    at = np.array([(one.tracking.jerk, one.tracking.error_mm) for one in variants])
    logged = np.log(np.maximum(at, 1e-3))
    apart = logged / np.maximum(np.ptp(logged, axis=0), 1e-3)
    tagged: dict[int, list[int]] = {}
    for i, here in enumerate(apart):
        tagged.setdefault(next((k for k in tagged if np.linalg.norm(apart[k] - here) < TAG_SHARE), i), []).append(i)
    axes.plot(*at.T, "o", color="0.5", ms=5)
    axes.plot(*at[0], "o", color=RECORDED_COLOUR, ms=6)
    for i, numbers in tagged.items():
        text = ", ".join(map(str, numbers))
        axes.annotate(text, at[i], xytext=(6, 5), textcoords="offset points", fontsize=8)
    for i, one in enumerate(variants):
        axes.plot([], [], " ", label=f"{i}: {one.name}")
    if chosen is not variants[0]:
        row = variants.index(chosen)
        axes.plot(*at[row], "o", color=PROPOSED_COLOUR, ms=12, mfc="none", label=f"proposed: {row}")
    axes.set(title="tried settings: left and below is better", xlabel="jerk of the tool [m/s³]", ylabel="error [mm]")
    axes.set(xscale="log", yscale="log")
    for each in (axes.xaxis, axes.yaxis):
        each.set_major_formatter("{x:g}")
        each.set_minor_formatter("{x:g}")
    axes.margins(0.12)


def _draw_spectrum(axes: Axes, judged_hands: JudgedHands) -> None:
    for side, hand in judged_hands.truth.items():
        hz, density = hand.spectrum()
        tremor = hand.tremor()
        found = f"tremor {tremor.amplitude_mm:.2f} mm, {tremor.rate_hz:.1f} Hz" if tremor else "no tremor"
        label = f"{side} hand: {found},\nnoise {hand.noise_mm:.2f} mm"
        axes.plot(hz[1:], 1000 * np.sqrt(density[1:]), color=BY_SIDE[side], lw=1, label=label)
    axes.axvspan(*TREMOR_RANGE_HZ, color="0.93", lw=0, label="frequencies of tremor")
    axes.set(title="motion of the hands by frequency", xlabel="[Hz]", ylabel="[mm/√Hz]")
    if not axes.lines[0].get_xdata().size:  # type: ignore[union-attr]
        axes.text(0.5, 0.5, "too few samples", transform=axes.transAxes, ha="center")
        return
    axes.set(xscale="log", yscale="log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_major_formatter("{x:g}")


def _draw_motion(axes: Axes, judged_hands: JudgedHands, chosen: VariantFigures) -> None:
    """The tool's fastest axis around the target's fastest moment, with both settings."""
    hands, target, frames = judged_hands.hands, judged_hands.target, judged_hands.frames
    velocity = np.where(judged_hands.judged[:, None], np.gradient(target, axis=0), 0.0)
    half = round(0.5 * MOTION_SHOWN_S / hands.period_s)
    fastest = int(np.argmax(_smoothed(np.linalg.norm(velocity, axis=1), half)))
    shown = slice(max(fastest - half, 0), fastest + half)
    axis = int(np.argmax(np.abs(velocity[shown]).sum(axis=0)))
    times = (frames["tick"] - frames["tick"][0])[shown] * hands.period_s
    axes.plot(times, target[shown, axis], color=IDEAL_COLOUR, lw=1.5, label="target for the true hands")
    axes.plot(times, frames["tool"][shown, axis], color=RECORDED_COLOUR, lw=1.2, label="tool, as recorded")
    axes.fill_between(
        times, 0, 1, where=~judged_hands.judged[shown], transform=axes.get_xaxis_transform(), color="0.9", lw=0,
        label="not judged",
    )  # fmt: skip
    settings = changed(hands.settings, chosen.change)
    if settings is not None:
        axes.plot(
            times, hands.frames(settings)["tool"][shown, axis], color=PROPOSED_COLOUR, lw=1.2, label="tool, as proposed"
        )
    axes.set(
        title=f"the {MOTION_SHOWN_S:g} s with the most motion", xlabel="[s]", ylabel=f"{'xyz'[axis]} of the tool [m]"
    )


def _smoothed(values: Vector, half: int) -> Vector:
    """The mean of values (T,) over `half` rows on both sides."""
    return np.convolve(values, np.ones(2 * half + 1) / (2 * half + 1), "same")
