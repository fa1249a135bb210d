"""Error on tasks that were not demonstrated, against the number of demonstrations, 1 to 10."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr

from thirdhand.core.skill.skill import Skill
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.reached import open_loop_mm, taught
from thirdhand_sim.lab.rehearsal import demonstrated
from thirdhand_sim.lab.results import (
    OTHER,
    REFERENCE,
    TOOL,
    Options,
    Results,
    pyplot,
    rgb,
)
from thirdhand_sim.lab.scenes import draw
from thirdhand_sim.scene import GRASP_DISTANCE, Scene

SEEDS = EXPERIMENTS["demonstrations"].seeds
MOST, ORDERS, SCENES = 10, SEEDS.learned["orders"], SEEDS.evaluation["scenes"]
EVERY = 4  # every fourth sample is used, to save time


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    most, orders = max(2, round(MOST * options.share)), ORDERS.share(options.share)
    known, held_out = (
        [one.every(EVERY) for one in demonstrated(part["demonstrations"])] for part in (SEEDS.learned, SEEDS.evaluation)
    )
    random, draws = np.random.default_rng(ORDERS.seed), len(orders)
    counts = list(range(1, most + 1))
    as_learned, with_places = np.zeros((2, most, draws))
    events = np.zeros((most, draws, len(SCENES.numbers), 3))
    scenes = [draw(number, seed=SCENES.seed) for number in SCENES.numbers]
    for draw_number in orders:
        order = random.permutation(len(known))
        for count in counts:
            skill = learn([known[k] for k in order[:count]], components=10, seed=draw_number)
            at = count - 1, draw_number
            as_learned[at] = _reproduction_mm(skill, held_out)
            with_places[at] = _reproduction_mm(taught(skill, Scene().via_points()), held_out)
            events[at] = [open_loop_mm(taught(skill, one.scene.via_points()), one) for one in scenes]
        results.say(f"draw {draw_number + 1} of {draws}: {as_learned[:, draw_number].round(1)} mm")
    floor = _floor_mm(known, held_out)
    success = 100 * (events <= 1000 * GRASP_DISTANCE).all(axis=3).mean(axis=2)
    stream = results.recording()
    for name, values, colour in (("reproduction_mm", as_learned, OTHER), ("success_percent", success, TOOL)):
        stream.log(f"/{name}", rr.SeriesLines(colors=[rgb(colour)], names=[name]), static=True)
        for count in counts:
            stream.set_time("demonstrations", sequence=count)
            stream.log(f"/{name}", rr.Scalars(float(values[count - 1].mean())))
    stream.disconnect()
    worst = events.max(axis=3).reshape(most, -1)
    numbers = {
        "draws": draws,
        "held_out": len(held_out),
        "scenes": len(SCENES.numbers),
        "floor_mm": floor,
        "by_count": {
            count: {
                "reproduction_rms_mm": float(as_learned[count - 1].mean()),
                "taught_rms_mm": float(with_places[count - 1].mean()),
                "reproduction_std_mm": float(as_learned[count - 1].std()),
                "taught_std_mm": float(with_places[count - 1].std()),
                "events_median_mm": float(np.median(events[count - 1])),
                "events_p95_mm": float(np.percentile(events[count - 1], 95)),
                "largest_event": {
                    name: float(np.percentile(worst[count - 1], share))
                    for name, share in (("median_mm", 50), ("p95_mm", 95), ("most_mm", 100))
                },
                "success_percent": float(success[count - 1].mean()),
            }
            for count in counts
        },
    }
    draw_numbers(results, numbers)
    return numbers


def _reproduction_mm(skill: Skill, held_out: list[Demonstration]) -> float:
    """Root mean square distance along demonstrations that the skill does not know."""
    squares = [np.sum((skill.mean(one.hands) - one.tool[:, :3]) ** 2, axis=1) for one in held_out]
    return float(1000 * np.sqrt(np.mean(np.concatenate(squares))))


def _floor_mm(known: list[Demonstration], held_out: list[Demonstration]) -> float:
    """The demonstrations' own scatter: the distance of held-out ones from the mean of all known
    ones at the same time.
    """
    mean = np.mean([one.tool[:, :3] for one in known], axis=0)
    return float(1000 * np.sqrt(np.mean([np.sum((one.tool[:, :3] - mean) ** 2, axis=1) for one in held_out])))


def draw_numbers(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of the experiment's numbers."""
    plt = pyplot()
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4))
    counts, rows = [int(count) for count in numbers["by_count"]], list(numbers["by_count"].values())
    for name, label, style, colour in (
        ("reproduction", "as learned", "o-", OTHER),
        ("taught", "with the three places taught", "s--", TOOL),
    ):
        mean, std = ([row[f"{name}_{what}_mm"] for row in rows] for what in ("rms", "std"))
        left.errorbar(counts, mean, std, fmt=style, color=colour, capsize=3, label=label)
    left.axhline(numbers["floor_mm"], color=REFERENCE, ls="--", label="the demonstrations' own scatter")
    left.set(
        xlabel="demonstrations", ylabel="rms error on held-out\ndemonstrations [mm]", xticks=counts, ylim=(0, None)
    )
    below = {"frameon": False, "loc": "upper center", "bbox_to_anchor": (0.5, -0.2)}  # the curves fill the axes
    left.legend(**below)
    for name, style, label in (
        ("median", "o-", "median"),
        ("p95", "s--", "95th percentile"),
        ("most", "^:", "largest"),
    ):
        right.plot(counts, [row["largest_event"][f"{name}_mm"] for row in rows], style, color=TOOL, label=label)
    right.axhline(1000 * GRASP_DISTANCE, color="black", ls="--", lw=0.8)
    right.set(xlabel="demonstrations", ylabel="largest error of the\nthree events [mm]", xticks=counts, ylim=(0, 33))
    right.set_title(f"new places up to 15 cm away, taught: {numbers['scenes']} scenes", fontsize=9)
    right.legend(**below, ncols=3)
    results.figure(figure)
