"""Hands that pause pause the robot, and hands that go back take it back, without segmentation or
phase; a trajectory over time continues.

At the same progress of the hands the tool is behind by its lag, either way.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import rerun as rr

from thirdhand.recordings.shipped import shipped_skill
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.reached import ours, places_in, shown
from thirdhand_sim.lab.rehearsal import TREMOR_M, Rehearsed, rehearse
from thirdhand_sim.lab.results import (
    OTHER,
    REFERENCE,
    SERIES,
    TOOL,
    Array,
    Options,
    Results,
    pyplot,
    rgb,
)
from thirdhand_sim.lab.rivals.as_skill import in_bench
from thirdhand_sim.lab.rivals.promp import ProMPOverTime
from thirdhand_sim.lab.scenes import Drawn
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import PAUSE_RAMP_S, ScriptPause

STOP, BACK = ScriptPause(1.6, 2.0), ScriptPause(8.0, 3.2, depth=2.0)
SEED, RATE_HZ = EXPERIMENTS["phase"].seeds.evaluation["hands"].seed, 500
STOPPED_S = STOP.at_s + PAUSE_RAMP_S, STOP.at_s + STOP.lasts_s - PAUSE_RAMP_S  # the hands stand still
SETTLED_S = 0.3  # after the hands have stopped
SHOWN_HZ = 20  # rate of the samples in the figure


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    rate_hz = RATE_HZ if options.share == 1 else 250
    scene = Scene()
    promp = ProMPOverTime().learn(shown()).place(places_in(scene))
    runs: dict[str, Rehearsed] = {}
    progress: dict[str, Array] = {}
    for name, skill_for in {"ours": ours(scene), "promp": in_bench(shipped_skill(), promp)}.items():
        script = Drawn(scene, 1.0, (STOP, BACK), SEED).script()
        runs[name] = rehearse(script, skill_for, rate_hz=rate_hz, keep=True)
        progress[name] = np.array([script.clock.at(t)[0] for t in runs[name].time_s])
        results.say(f"{name}: {runs[name].errors_mm} mm")
    _record(results, runs, progress["ours"])
    samples = slice(int(np.argmax(runs["ours"].time_s > 0)), None, round(rate_hz / SHOWN_HZ))
    numbers = {
        "pause": STOP._asdict(),
        "back": BACK._asdict(),
        "tremor_mm": 1000 * TREMOR_M,
        "tremor_in_space_rms_mm": 1000 * TREMOR_M * math.sqrt(3),
        "hand_from_its_place_in_the_pause_mm": _from_its_place_mm(runs["ours"], scene),
        **{name: _measured(one, progress[name]) for name, one in runs.items()},
        "shown": {
            "time_s": runs["ours"].time_s[samples].round(3),
            "progress_s": progress["ours"][samples].round(3),
            **{name: one.tool[samples].round(4).T for name, one in runs.items()},
        },
    }
    draw_numbers(results, numbers)
    return numbers


def _from_its_place_mm(one: Rehearsed, scene: Scene) -> float:
    """Distance of the left hand from the handover while the hands pause."""
    at = int(np.searchsorted(one.time_s, STOPPED_S[0]))
    return float(1000 * np.linalg.norm(one.hands[at, 0] - scene.handover))


def _passes(time_s: Array, script_s: Array) -> tuple[Any, Any, Any]:
    """Ticks forth, back, and forth again on the part of the path that the hands repeat."""
    began, ended = BACK.at_s + PAUSE_RAMP_S / 2, BACK.at_s + BACK.lasts_s - PAUSE_RAMP_S / 2
    back = (time_s >= began) & (time_s <= ended)
    low, high = script_s[back].min(), script_s[back].max()
    over = (script_s >= low) & (script_s <= high)
    return over & (time_s > 0) & (time_s < began), back, over & (time_s > ended)


def _measured(one: Rehearsed, script_s: Array) -> dict[str, Any]:
    forth, back, again = _passes(one.time_s, script_s)

    def along(which: Any, at: Array) -> Array:
        order = np.argsort(script_s[which])
        return np.stack(
            [np.interp(at, script_s[which][order], one.tool[which][order, axis]) for axis in range(3)], axis=1
        )

    at = np.linspace(
        max(script_s[w].min() for w in (forth, back, again)), min(script_s[w].max() for w in (forth, back, again)), 500
    )
    way = along(forth, at)
    stopped = one.tool[slice(*np.searchsorted(one.time_s, STOPPED_S))]
    paused = (one.time_s > STOPPED_S[0] + SETTLED_S) & (one.time_s < STOPPED_S[1])
    resting, when = one.tool[paused], one.time_s[paused]
    third = np.array_split(resting, 3)
    drift = np.polynomial.polynomial.polyfit(when, resting, 1)
    beside_drift = resting - np.polynomial.polynomial.polyval(when, drift).T

    def spread(offsets: Array) -> float:
        return float(1000 * np.sqrt(np.mean(np.sum(offsets**2, axis=1))))

    return {
        "back_against_forth_rms_mm": spread(along(back, at) - way),
        "again_against_forth_rms_mm": spread(along(again, at) - way),
        "way_gone_back_mm": float(1000 * np.linalg.norm(np.diff(way, axis=0), axis=1).sum()),
        "drift_in_the_pause_mm": float(1000 * np.linalg.norm(third[-1].mean(axis=0) - third[0].mean(axis=0))),
        "goes_on_in_the_pause_mm": float(1000 * np.linalg.norm(stopped[-1] - stopped[0])),
        "tremor_of_the_tool_in_the_pause_rms_mm": spread(resting - resting.mean(axis=0)),
        "tremor_beside_its_drift_rms_mm": spread(beside_drift),
        "errors_mm": one.errors_mm,
        "success": one.events.success,
    }


def draw_numbers(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of the experiment's numbers."""
    plt = pyplot()
    figure, (top, middle, bottom) = plt.subplots(3, 1, figsize=(9, 7.8), height_ratios=(1, 1.7, 1.6))
    t, script_s, ours, promp = (np.array(numbers["shown"][key]).T for key in ("time_s", "progress_s", "ours", "promp"))
    top.plot(t, script_s, color="black")
    top.set(ylabel="progress of\nthe hands [s]")
    for axis, name in enumerate("xyz"):
        middle.plot(t, ours[:, axis], color=SERIES[axis], label=f"{name}, ours")
        middle.plot(t, promp[:, axis], "--", lw=1.1, color=SERIES[axis], label=f"{name}, ProMP over time")
    middle.set(ylabel="tool [m]", xlabel="time [s]", ylim=(-0.35, 1.0))
    middle.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=6, frameon=False, fontsize=8)
    for axes in (top, middle):
        axes.axvspan(STOP.at_s, STOP.at_s + STOP.lasts_s, color=REFERENCE, alpha=0.2, lw=0)
        axes.axvspan(BACK.at_s, BACK.at_s + BACK.lasts_s, color=OTHER, alpha=0.15, lw=0)
        axes.set_xlim(0, t[-1])
    top.text(STOP.at_s + STOP.lasts_s / 2, script_s.max(), "the hands pause", ha="center", va="top", fontsize=8)
    top.text(BACK.at_s + BACK.lasts_s / 2, 0.2, "they go back", ha="center", va="bottom", fontsize=8)
    shakes, goes_on = (
        [numbers[who][key] for who in ("ours", "promp")]
        for key in ("tremor_of_the_tool_in_the_pause_rms_mm", "goes_on_in_the_pause_mm")
    )
    middle.text(
        STOP.at_s + 0.1,
        0.97,
        f"while they stand,\nthe tool goes on by {goes_on[0]:.0f} mm (ProMP {goes_on[1]:.0f})\n"
        f"and is {shakes[0]:.1f} mm rms off its mean (ProMP {shakes[1]:.1f})",
        va="top",
        fontsize=8,
    )
    for which, style, label in zip(
        _passes(t, script_s), ("-", "--", ":"), ("forth", "back", "forth again"), strict=True
    ):
        order = np.argsort(script_s[which])
        for axis in range(3):
            at, width = (script_s[which][order], ours[which][order, axis]), 2.6 if style == ":" else 1.6
            colour = "black" if style == ":" else SERIES[axis]
            bottom.plot(*at, style, color=colour, lw=width, label=label if axis == 2 else None)
    for axis, name in enumerate("xyz"):
        bottom.annotate(
            name,
            (0.965, ours[np.argmin(np.abs(t - BACK.at_s)), axis]),
            (4, 0),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            color=SERIES[axis],
            va="center",
        )
    bottom.set(
        ylabel="tool, ours [m]", xlabel="progress of the hands [s]; the tool is behind them by its lag, either way"
    )
    bottom.legend(frameon=False, fontsize=8)
    results.figure(figure)


def _record(results: Results, runs: dict[str, Rehearsed], script_s: Array) -> None:
    stream = results.recording()
    for name, one in runs.items():
        colour = TOOL if name == "ours" else OTHER
        stream.log(
            f"/{name}/way",
            rr.LineStrips3D([one.tool[one.time_s > 0]], colors=[rgb(colour)], radii=[0.001]),
            static=True,
        )
        for k in range(0, len(one.tool), 20):
            stream.set_time("time", duration=float(k / len(one.tool) * one.time_s[-1]))
            stream.log(f"/{name}/tool", rr.Points3D([one.tool[k]], colors=[rgb(colour)], radii=[0.01]))
            stream.log("/hands", rr.Points3D(one.hands[k], colors=[rgb(SERIES[0]), rgb(SERIES[1])], radii=[0.015]))
            stream.log("/progress", rr.Scalars(float(script_s[min(k, len(script_s) - 1)])))
    stream.disconnect()
