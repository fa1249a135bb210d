"""Success rate of the task with via-points: 100 random scenes in closed loop, our skill beside
rivals, some of which need no demonstration.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
import rerun as rr

from thirdhand.recordings.shipped import shipped_skill
from thirdhand_sim.lab.catalogue import DRAWING, EXPERIMENTS
from thirdhand_sim.lab.reached import EVENTS, places_in, shown
from thirdhand_sim.lab.rehearsal import rehearse
from thirdhand_sim.lab.results import ADAPTED, OTHER, Options, Results, pyplot, rgb
from thirdhand_sim.lab.rivals.as_skill import in_bench
from thirdhand_sim.lab.rivals.gaussian_process import SampleProcess
from thirdhand_sim.lab.rivals.method import Learn, RivalModel
from thirdhand_sim.lab.rivals.mixtures import MixtureRegression
from thirdhand_sim.lab.rivals.places import LookUp, NoDemonstrations
from thirdhand_sim.lab.rivals.service import GMR_COMPONENTS, LearnedByService
from thirdhand_sim.lab.scenes import draw
from thirdhand_sim.lab.workers import shared_out
from thirdhand_sim.people import Places
from thirdhand_sim.scene import GRASP_DISTANCE

TASK_SEEDS = EXPERIMENTS["statistics"].seeds
TASK_SCENES = TASK_SEEDS.evaluation["scenes"]
SHIPPED_ELL = 5.0  # [1/m²] ell of the shipped skill
# rivals have a lower rate to save time, which changes errors by 2 mm at most
OURS_HZ = 500
RIVALS_HZ = 125
TASK_METHODS: dict[str, tuple[str, Learn]] = {
    "ours": ("KMP, via-points\n(the service)", lambda shown: LearnedByService(shipped_skill())),
    "none": (
        "the places and the start,\nno demonstrations",
        NoDemonstrations(ell=SHIPPED_ELL).learn,
    ),
    "look_up": ("look-up of these,\nweighted by distance", LookUp().learn),
    "gaussian_process_5": (
        "Gaussian process,\nour ell, same places",
        SampleProcess(ell=SHIPPED_ELL).learn,
    ),
    "gaussian_process": ("Gaussian process,\nsame places", SampleProcess().learn),
    "gmr": ("GMR alone", MixtureRegression(GMR_COMPONENTS).learn),
}
SHOWN_LEAST_MM = 1e-3  # smaller errors are drawn at this value, as the axis is logarithmic


def colour_of(method: str) -> str:
    """The colour of a method in the figure and in the recording."""
    return ADAPTED if method == "ours" else OTHER


class TaskOutcome(NamedTuple):
    """One scene with one method: errors [mm] of the three events, success, and the time in which
    the service held [s].
    """

    method: str
    number: int
    errors_mm: tuple[float, float, float]
    success: bool
    held_s: float


@functools.cache
def _learned(method: str) -> RivalModel[Places]:
    """The model of a method, learned once in a process."""
    return TASK_METHODS[method][1](shown())


def outcome(task: tuple[str, int]) -> TaskOutcome:
    """One scene with one method."""
    method, number = task
    drawn = draw(number, seed=TASK_SCENES.seed)
    skill_for = in_bench(shipped_skill(), _learned(method).place(places_in(drawn.scene)))
    done = rehearse(drawn.script(), skill_for, rate_hz=OURS_HZ if method == "ours" else RIVALS_HZ)
    return TaskOutcome(method, number, done.errors_mm, done.events.success, done.held_s)


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    scenes = TASK_SCENES.moved(options.seed_offset).share(options.share)
    count = len(scenes)
    tasks = [(method, number) for method in TASK_METHODS for number in scenes]
    by_method: dict[str, list[TaskOutcome]] = {method: [] for method in TASK_METHODS}
    for row in shared_out(outcome, tasks, options.workers):
        by_method[row.method].append(row)
        done = by_method[row.method]
        if not row.success and row.method == "ours":
            results.say(f"scene {row.number} missed: {row.errors_mm} mm")
        if len(done) % max(1, count // 5) == 0:
            results.say(f"{row.method}: {sum(o.success for o in done)} of {len(done)} scenes")
    _draw_errors(results, by_method)
    numbers = {
        "scenes": count,
        "rate_hz": {"ours": OURS_HZ, "rivals": RIVALS_HZ},
        "within_mm": 1000 * GRASP_DISTANCE,
        "methods": {method: _summary(rows) for method, rows in by_method.items()},
        "failed_scenes_of_ours": [row.number for row in by_method["ours"] if not row.success],
        "held_s_of_ours": max(row.held_s for row in by_method["ours"]),
        "errors_mm_by_scene": {
            method: [row.errors_mm for row in rows] for method, rows in by_method.items()
        },
    }
    draw_numbers(results, numbers)
    return numbers


def _draw_errors(results: Results, by_method: dict[str, list[TaskOutcome]]) -> None:
    """The errors of each event over the scenes, by method."""
    paths = {
        f"/{name}/{method}": (method, i) for method in by_method for i, name in enumerate(EVENTS)
    }
    styles = {
        path: rr.SeriesPoints(colors=[rgb(colour_of(method))], names=[method])
        for path, (method, _) in paths.items()
    }
    values = {
        path: [row.errors_mm[i] for row in by_method[method]] for path, (method, i) in paths.items()
    }
    results.series(values, "scene", styles)


def _summary(rows: list[TaskOutcome]) -> dict[str, Any]:
    errors = np.array([row.errors_mm for row in rows])
    successes = sum(row.success for row in rows)
    low, high = wilson(successes, len(rows))
    return {
        "successes": successes,
        "of": len(rows),
        "rate_95_percent_interval": [low, high],
        **{
            f"{name}_mm": {
                "median": float(np.median(errors[:, i])),
                "p95": float(np.percentile(errors[:, i], 95)),
                "max": float(errors[:, i].max()),
                "missed": int((errors[:, i] > 1000 * GRASP_DISTANCE).sum()),
            }
            for i, name in enumerate(EVENTS)
        },
    }


def wilson(successes: int, of: int) -> tuple[float, float]:
    """The 95 % interval of a rate of success (Wilson 1927)."""
    z = 1.96
    p = successes / of
    middle = p + z * z / (2 * of)
    half = z * math.sqrt(p * (1 - p) / of + z * z / (4 * of * of))
    return max(0.0, (middle - half) / (1 + z * z / of)), min(
        1.0, (middle + half) / (1 + z * z / of)
    )


def draw_numbers(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of the experiment's numbers, with a row for each method."""
    plt = pyplot()
    methods = numbers["methods"]
    figure, (rates, *events) = plt.subplots(
        1, 4, figsize=(11, 4.6), sharey=True, width_ratios=(1.1, 1, 1, 1)
    )
    random = np.random.default_rng(DRAWING)
    for i, (method, scores) in enumerate(methods.items()):
        colour = colour_of(method)
        rate = 100 * scores["successes"] / scores["of"]
        low, high = scores["rate_95_percent_interval"]
        rates.barh(i, rate, color=colour, height=0.6)
        rates.plot((100 * low, 100 * high), (i, i), color="black", lw=1.2)
        rates.text(max(rate, 100 * high) + 2, i, f"{rate:.0f}", va="center")
        errors = np.array(numbers["errors_mm_by_scene"][method])
        for axes, name, error in zip(events, EVENTS, errors.T, strict=True):
            y = i + random.uniform(-0.25, 0.25, len(error))
            axes.scatter(np.maximum(error, SHOWN_LEAST_MM), y, s=5, color=colour, alpha=0.5, lw=0)
            axes.plot(
                [max(scores[f"{name}_mm"]["median"], SHOWN_LEAST_MM)] * 2,
                (i - 0.38, i + 0.38),
                color="black",
                lw=1.6,
            )
    rates.set(
        xlim=(0, 116),
        xticks=range(0, 101, 25),
        xlabel="scenes in which all three\nevents succeeded [%]",
    )
    rates.set_yticks(range(len(methods)), [TASK_METHODS[method][0] for method in methods])
    rates.invert_yaxis()
    titles = (
        "board handed over:\ntool to left hand",
        "glass grasped:\ntool to handle",
        "glass carried:\ntool to place",
    )
    for axes, title in zip(events, titles, strict=True):
        axes.axvline(numbers["within_mm"], color="black", ls="--", lw=0.8)
        axes.set(xscale="log", xlim=(0.7 * SHOWN_LEAST_MM, 1500), xticks=[1e-3, 0.1, 10, 1000])
        axes.set_xticklabels(["0.001", "0.1", "10", "1000"])
        axes.set_title(title, fontsize=9)
        axes.minorticks_off()
    events[1].set_xlabel(
        "smallest distance at the event [mm]\ndots: scenes; bars: medians; dashed: within "
        f"{numbers['within_mm']:g} mm"
    )
    figure.suptitle(
        f"{numbers['scenes']} random scenes: places up to 15 cm away, hands 0.5 to 2 times as "
        "fast, pauses, going back",
        fontsize=10,
    )
    results.figure(figure)
