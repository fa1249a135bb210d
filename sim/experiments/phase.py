"""No segmentation and no phase: hands that pause pause the robot, hands that go back take it back
(behind them by its lag, either way), where a trajectory over time goes on.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr

from service.shipped import shipped_skill
from sim.experiments import rivals
from sim.experiments.rehearsal import NOISE_M, TREMOR_M, Rehearsed, demonstrated, rehearse
from sim.experiments.results import OTHER, REFERENCE, SERIES, TOOL, Array, Options, Results, pyplot, rgb
from sim.scene import Scene
from sim.script import PAUSE_RAMP_S, HandScript, Pause

STOP, BACK = Pause(1.6, 2.0), Pause(8.0, 3.2, depth=2.0)
SEED, RATE_HZ = 11, 500
SETTLED_S = 0.3  # after the hands have stopped


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    rate_hz = RATE_HZ if options.share == 1 else 250
    skill, scene = shipped_skill(), Scene()
    adapts = {"ours": rivals.ours(skill), "promp": rivals.promp(skill, demonstrated(5))}
    runs: dict[str, Rehearsed] = {}
    progress: dict[str, Array] = {}
    for name, adapt in adapts.items():
        script = HandScript(scene, seed=SEED, pauses=(STOP, BACK), tremor_rms=TREMOR_M, noise_std=NOISE_M)
        runs[name] = rehearse(script, adapt(scene), rate_hz=rate_hz, keep=True)
        progress[name] = np.array([script.clock.at(t)[0] for t in runs[name].time_s])
        results.say(f"{name}: {runs[name].errors_mm} mm")
    _draw(results, runs, progress["ours"])
    _record(results, runs, progress["ours"])
    numbers = {name: _measured(one, progress[name]) for name, one in runs.items()}
    return {"pause": STOP._asdict(), "back": BACK._asdict(), "tremor_mm": 1000 * TREMOR_M, **numbers}


def _passes(time_s: Array, script_s: Array) -> tuple[Any, Any, Any]:
    """Which ticks are the way forth, back, and forth again over what the hands go back over."""
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
    paused = (one.time_s > STOP.at_s + PAUSE_RAMP_S + SETTLED_S) & (
        one.time_s < STOP.at_s + STOP.lasts_s - PAUSE_RAMP_S
    )
    resting = one.tool[paused]
    third = np.array_split(resting, 3)

    def rms(line: Array) -> float:
        return float(1000 * np.sqrt(np.mean(np.sum((line - way) ** 2, axis=1))))

    return {
        "back_against_forth_rms_mm": rms(along(back, at)),
        "again_against_forth_rms_mm": rms(along(again, at)),
        "way_gone_back_mm": float(1000 * np.linalg.norm(np.diff(way, axis=0), axis=1).sum()),
        "drift_in_the_pause_mm": float(1000 * np.linalg.norm(third[-1].mean(axis=0) - third[0].mean(axis=0))),
        "tremor_of_the_tool_in_the_pause_rms_mm": float(
            1000 * np.sqrt(np.mean(np.sum((resting - resting.mean(axis=0)) ** 2, axis=1)))
        ),
        "errors_mm": one.errors_mm,
        "success": one.events.success,
    }


def _draw(results: Results, runs: dict[str, Rehearsed], script_s: Array) -> None:
    plt = pyplot()
    figure, (top, middle, bottom) = plt.subplots(3, 1, figsize=(9, 7.5), height_ratios=(1, 1.6, 1.6))
    ours, other = runs["ours"], runs["promp"]
    on = ours.time_s > 0
    t = ours.time_s[on]
    top.plot(t, script_s[on], color="black")
    top.set(ylabel="progress of\nthe hands [s]")
    for axis, name in enumerate("xyz"):
        middle.plot(t, ours.tool[on, axis], color=SERIES[axis], label=f"{name}, ours")
        middle.plot(
            other.time_s[other.time_s > 0],
            other.tool[other.time_s > 0, axis],
            "--",
            lw=1.1,
            color=SERIES[axis],
            label=f"{name}, ProMP over time",
        )
    middle.set(ylabel="tool [m]", xlabel="time [s]")
    middle.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=6, frameon=False, fontsize=8)
    for axes in (top, middle):
        axes.axvspan(STOP.at_s, STOP.at_s + STOP.lasts_s, color=REFERENCE, alpha=0.2, lw=0)
        axes.axvspan(BACK.at_s, BACK.at_s + BACK.lasts_s, color=OTHER, alpha=0.15, lw=0)
        axes.set_xlim(0, t[-1])
    top.text(STOP.at_s + STOP.lasts_s / 2, script_s.max(), "the hands pause", ha="center", va="top", fontsize=8)
    top.text(BACK.at_s + BACK.lasts_s / 2, 0.2, "they go back", ha="center", va="bottom", fontsize=8)
    for which, style, label in zip(
        _passes(ours.time_s, script_s), ("-", "--", ":"), ("forth", "back", "forth again"), strict=True
    ):
        order = np.argsort(script_s[which])
        for axis in range(3):
            bottom.plot(
                script_s[which][order],
                ours.tool[which][order, axis],
                style,
                color=SERIES[axis],
                lw=1.8,
                label=label if axis == 2 else None,
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
