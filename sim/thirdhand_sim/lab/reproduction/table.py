"""The paper's Table I in numbers: DMP, ProMP, mixture regression and KMP on the same letters.

Each letter is adapted as in `letters`. A DMP can be given another start and another end, so its
via-points are those of the mean that it imitates; mixture regression cannot be given any point.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from thirdhand_sim.lab.reproduction.letters import (
    SETS,
    Case,
    Letter,
    Line,
    by_kmp,
    cases,
    draw_lines,
    gathered,
)
from thirdhand_sim.lab.reproduction.writing import DURATION_S, TIMES
from thirdhand_sim.lab.results import (
    ADAPTED,
    DESIRED,
    OTHER,
    Array,
    ExperimentError,
    Options,
    Results,
    pyplot,
)
from thirdhand_sim.lab.rivals.promp import BASES, learned_promp

RIVAL_VIA_VARIANCE = 1e-6  # [cm²] as for KMP
DMP_WEIGHTS = 20  # weights of the DMP for each of x and y: the number of ProMP's basis functions
LETTER_METHODS = {
    "kmp": ("KMP", ADAPTED),
    "promp": ("ProMP", OTHER),
    "dmp": ("DMP", "#009E73"),
    "gmm": ("GMM", DESIRED),
}
SHOWN_LETTERS = ("B", "G")

Trajectory: TypeAlias = Callable[[Letter, Case], Array]
"""A method: from a letter and an adaptation to a trajectory (200, 2) [cm]."""


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    methods: dict[str, Trajectory] = {
        "kmp": by_kmp,
        "promp": conditioned,
        "dmp": configured,
        "gmm": lambda letter, _: letter.reference,
    }
    numbers: dict[str, Any] = {"unit": "cm", "dmp_weights_per_output": DMP_WEIGHTS}
    examples: list[dict[str, Line]] = []
    for name, rows in gathered(results, options).items():
        line_sets = [
            {key: Line(row, case, method(row, case)) for key, method in methods.items()}
            for row in rows
            for case in cases(row)
        ]
        numbers[SETS[name]] = {
            key: _summary([lines[key] for lines in line_sets]) for key in methods
        }
        last = [lines for lines in line_sets if len(lines["kmp"].case.times) == 3]
        examples += [
            lines
            for lines in last
            if lines["kmp"].letter.name in SHOWN_LETTERS or len(last) < len(SHOWN_LETTERS)
        ]
    _draw(results, examples)
    return numbers


def conditioned(letter: Letter, case: Case) -> Array:
    """The trajectory (200, 2) [cm] of the letter's ProMP through the desired points."""
    primitive = learned_promp(
        [TIMES] * len(letter.demonstrations), list(letter.demonstrations), bases=BASES
    )
    for t, point in zip(case.times, case.points, strict=True):
        primitive = primitive.condition_position(
            point, RIVAL_VIA_VARIANCE * np.eye(2), t=t, t_max=DURATION_S
        )
    return np.asarray(primitive.mean_trajectory(TIMES.copy()))


def configured(letter: Letter, case: Case) -> Array:
    """The letter's DMP (of movement_primitives), with the start and the end of the case."""
    try:
        from movement_primitives.dmp import DMP
    except ImportError:
        raise ExperimentError(
            "DMPs need movement_primitives and pytransform3d: pip install 'thirdhand[experiments]'"
        ) from None
    mean = letter.demonstrations.mean(axis=0)
    primitive = DMP(2, execution_time=DURATION_S, dt=TIMES[1], n_weights_per_dim=DMP_WEIGHTS)
    primitive.imitate(TIMES, mean)
    points = {float(t): point for t, point in zip(case.times, case.points, strict=True)}
    primitive.configure(
        start_y=points.get(TIMES[0], mean[0]), goal_y=points.get(TIMES[-1], mean[-1])
    )
    times, line = primitive.open_loop()
    return np.column_stack([np.interp(TIMES, times, column) for column in line.T])


def _summary(lines: list[Line]) -> dict[str, float]:
    """The largest misses of start, via-point and end, the mean rms deviation elsewhere [cm]."""
    misses: dict[str, list[float]] = {"start": [], "via": [], "end": []}
    for line in lines:
        for t, miss in zip(line.case.times, line.misses, strict=True):
            misses[{TIMES[0]: "start", TIMES[-1]: "end"}.get(t, "via")].append(float(miss))
    return {
        **{f"largest_miss_of_{kind}_cm": max(values) for kind, values in misses.items()},
        "mean_rms_deviation_elsewhere_cm": float(
            np.mean([line.rms_deviation_elsewhere_cm for line in lines])
        ),
    }


def _draw(results: Results, shown: list[dict[str, Line]]) -> None:
    figure, grid = pyplot().subplots(1, len(shown), figsize=(2.6 * len(shown), 3.2), squeeze=False)
    for axes, example in zip(grid[0], shown, strict=True):
        lines = {
            label: (example[key].points, colour) for key, (label, colour) in LETTER_METHODS.items()
        }
        draw_lines(axes, example["kmp"].letter, example["kmp"].case, lines, "black")
    grid[0][0].set_ylabel("cm")
    figure.legend(
        *grid[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False
    )
    results.figure(figure)
