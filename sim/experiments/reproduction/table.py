"""The paper's Table I in numbers: DMP, ProMP, mixture regression and KMP on the same letters.

Each letter is adapted as in `letters`. A DMP can be given another start and another end, so its
via-points are those of the mean that it imitates; mixture regression cannot be given any point. The
row of inputs of many dimensions is in `promp`, with six of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from kmp import Gaussians
from sim.experiments.reproduction.letters import SETS, Case, Letter, adapted, cases, elsewhere, gathered, learned
from sim.experiments.reproduction.promp import conditioned
from sim.experiments.reproduction.writing import DURATION_S, TIMES
from sim.experiments.results import ADAPTED, DESIRED, OTHER, REFERENCE, Array, ExperimentError, Options, Results, pyplot

WEIGHTS = 20  # of the DMP, for each of x and y: as many as ProMP has basis functions
METHODS = {"kmp": ADAPTED, "promp": OTHER, "dmp": "#009E73", "gmm": DESIRED}
SHOWN = ("B", "G")

Trajectory: TypeAlias = Callable[[Letter, Case], Array]
"""A method: from a letter and an adaptation to a trajectory (200, 2) [cm]."""


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    methods: dict[str, Trajectory] = {
        "kmp": lambda letter, case: adapted(letter, case).mean(TIMES[:, None]),
        "promp": conditioned,
        "dmp": configured,
        "gmm": lambda letter, _: letter.reference,
    }
    numbers: dict[str, Any] = {"unit": "cm", "dmp_weights_per_output": WEIGHTS}
    shown: list[tuple[Letter, dict[str, Array]]] = []
    for name, letters in gathered(options).items():
        rows = [learned(letter, demonstrations) for letter, demonstrations in letters.items()]
        found = {
            who: [(row, case, method(row, case)) for row in rows for case in cases(row)]
            for who, method in methods.items()
        }
        numbers[SETS[name]] = {who: _summary(lines) for who, lines in found.items()}
        numbers[SETS[name]]["inside_95_percent"] = _coverage(rows)
        results.say(f"{len(rows)} letters ({name})")
        last = [n for n, (_, case, _) in enumerate(found["kmp"]) if len(case.times) == 3]
        shown += [
            (found["kmp"][n][0], {who: lines[n][2] for who, lines in found.items()} | {"": found["kmp"][n][1].points})
            for n in last
            if found["kmp"][n][0].name in SHOWN or len(last) < len(SHOWN)
        ]
    _draw(results, shown)
    return numbers


def configured(letter: Letter, case: Case) -> Array:
    """The letter's DMP (of movement_primitives), with the start and the end that the case wants."""
    try:
        from movement_primitives.dmp import DMP
    except ImportError:
        raise ExperimentError(
            "DMPs need movement_primitives and pytransform3d: pip install 'thirdhand[experiments]'"
        ) from None
    mean = letter.demonstrations.mean(axis=0)
    primitive = DMP(2, execution_time=DURATION_S, dt=TIMES[1], n_weights_per_dim=WEIGHTS)
    primitive.imitate(TIMES, mean)
    points = {float(t): point for t, point in zip(case.times, case.points, strict=True)}
    primitive.configure(start_y=points.get(TIMES[0], mean[0]), goal_y=points.get(TIMES[-1], mean[-1]))
    times, line = primitive.open_loop()
    return np.column_stack([np.interp(TIMES, times, one) for one in line.T])


def _summary(lines: list[tuple[Letter, Case, Array]]) -> dict[str, float]:
    """The largest misses of start, via-point and end, the mean rms deviation elsewhere [cm]."""
    misses: dict[str, list[float]] = {"start": [], "via": [], "end": []}
    away = []
    for letter, case, line in lines:
        for t, point in zip(case.times, case.points, strict=True):
            kind = {TIMES[0]: "start", TIMES[-1]: "end"}.get(t, "via")
            misses[kind].append(float(np.linalg.norm(line[int(np.argmin(np.abs(TIMES - t)))] - point)))
        off = np.linalg.norm(line - letter.demonstrations.mean(axis=0), axis=1)[elsewhere(case)]
        away.append(float(np.sqrt(np.mean(off**2))))
    return {
        **{f"largest_miss_of_{kind}_cm": max(values) for kind, values in misses.items()},
        "mean_rms_deviation_elsewhere_cm": float(np.mean(away)),
    }


def _coverage(rows: list[Letter]) -> dict[str, float]:
    """Share of the demonstrations' samples within the predicted 95 % regions [%].

    Of KMP with the scale of its covariance as the paper has it, and of the mixture. A DMP predicts
    no covariance.
    """
    found = {
        "kmp": [row.primitive.predict(TIMES[:, None]) for row in rows],
        "gmm": [row.primitive.reference for row in rows],
    }
    return {
        who: 100 * float(np.mean([_inside(row, one) for row, one in zip(rows, each, strict=True)]))
        for who, each in found.items()
    }


def _inside(row: Letter, predicted: Gaussians) -> float:
    off = row.demonstrations - predicted.mean
    squares = np.einsum("hti,tij,htj->ht", off, np.linalg.inv(predicted.covariance), off)
    return float(np.mean(squares < 5.991))  # chi-square of two degrees of freedom


def _draw(results: Results, shown: list[tuple[Letter, dict[str, Array]]]) -> None:
    plt = pyplot()
    figure, grid = plt.subplots(1, len(shown), figsize=(2.6 * len(shown), 3.2), squeeze=False)
    for axes, (letter, lines) in zip(grid[0], shown, strict=True):
        axes.plot(
            *letter.demonstrations.mean(axis=0).T, "--", color=REFERENCE, lw=1.1, label="mean of the demonstrations"
        )
        for who, colour in METHODS.items():
            axes.plot(
                *lines[who].T,
                color=colour,
                lw=1.4,
                label={"gmm": "GMM"}.get(who, who.upper().replace("PROMP", "ProMP")),
            )
        axes.plot(*lines[""].T, "o", mfc="none", mec="black", mew=1.6, ms=7, label="desired points")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title(letter.name, loc="left", fontweight="bold", fontsize=9)
        axes.tick_params(labelsize=7)
    grid[0][0].set_ylabel("cm")
    figure.legend(*grid[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    results.figure(figure)
