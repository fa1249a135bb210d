"""Letters adapted to new start-, via- and end-points (the paper, section III-A and Figure 1)."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr

from kmp import KMP, GaussianKernel, GaussianMixture, Gaussians
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.reproduction.writing import DURATION_S, TARGETS, TIMES, recorded, write
from thirdhand_sim.lab.results import (
    ADAPTED,
    DESIRED,
    REFERENCE,
    Array,
    Options,
    Results,
    ellipse,
    legend_below,
    pyplot,
    rgb,
)

# the paper's numbers; time in seconds
LETTER_ELL = 8.0
LAMBDA = 0.1
LETTER_SEEDS = EXPERIMENTS["letters"].seeds
LETTER_COMPONENTS = 8
LETTER_SEED = LETTER_SEEDS.method
WRITTEN = LETTER_SEEDS.evaluation["letters"]
REGULARIZATION = 1e-4  # [cm², s²]
VIA_VARIANCE = 1e-6  # [cm²]
# below half of the reference's step: each desired point replaces one reference point
TOLERANCE_S = 0.004
HALF_CM = 12.5  # half of the width and height of a drawn letter
SETS = {"model": "modelled", "recorded": "recorded"}
# times farther from every desired point are "elsewhere": the kernel has fallen to exp(-2)
NEAR_S = 0.5


class Case(NamedTuple):
    """Desired points: times (V,) [s], and positions of the pen (V, 2) [cm]."""

    name: str
    times: Array
    points: Array


class Letter(NamedTuple):
    """A letter's demonstrations (H, 200, 2) [cm], their mixture, reference and primitive."""

    name: str
    demonstrations: Array
    mixture: GaussianMixture
    primitive: KMP

    @property
    def reference(self) -> Array:
        """The reference's mean (200, 2) [cm]."""
        return self.primitive.reference.mean


def learned(name: str, demonstrations: Array) -> Letter:
    """The letter learned from some demonstrations: mixture by EM, reference by GMR at 200 times,
    KMP with the paper's numbers.
    """
    samples = np.concatenate(
        [np.column_stack([TIMES, demonstration]) for demonstration in demonstrations]
    )
    mixture = GaussianMixture.fit(
        samples, components=LETTER_COMPONENTS, seed=LETTER_SEED, regularization=REGULARIZATION
    )
    primitive = KMP.fit(
        TIMES[:, None],
        mixture.regress(TIMES[:, None]),
        kernel=GaussianKernel(LETTER_ELL),
        lambda_mean=LAMBDA,
    )
    return Letter(name, demonstrations, mixture, primitive)


def cases(letter: Letter) -> list[Case]:
    """Three adaptations of one letter: a new start and a via-point; a via-point and a new end; a
    new start, via-point and end.
    """
    random = np.random.default_rng([LETTER_SEED, *map(ord, letter.name)])
    size = float(np.ptp(letter.reference, axis=0).max())
    chosen = (
        ("start and via-point", (0, 110)),
        ("via-point and end", (70, 199)),
        ("start, via-point and end", (0, 90, 199)),
    )
    out = []
    for name, rows in chosen:
        angles = random.uniform(0, 2 * np.pi, len(rows))
        steps = (
            size
            * random.uniform(0.12, 0.25, (len(rows), 1))
            * np.column_stack([np.cos(angles), np.sin(angles)])
        )
        out.append(Case(name, TIMES[list(rows)], letter.reference[list(rows)] + steps))
    return out


def adapted(letter: Letter, case: Case) -> KMP:
    """The letter's primitive through the desired points."""
    desired = Gaussians(case.points, np.tile(VIA_VARIANCE * np.eye(2), (len(case.times), 1, 1)))
    return letter.primitive.adapt(case.times[:, None], desired, tolerance=TOLERANCE_S)


class Line(NamedTuple):
    """A letter's trajectory (200, 2) [cm] by some method, for a case."""

    letter: Letter
    case: Case
    points: Array

    @property
    def misses(self) -> Array:
        """Distances (V,) [cm] from the desired points at their times."""
        indices = [int(np.argmin(np.abs(TIMES - t))) for t in self.case.times]
        return np.asarray(np.linalg.norm(self.points[indices] - self.case.points, axis=1))

    @property
    def rms_deviation_elsewhere_cm(self) -> float:
        """Distance from the demonstrations' mean, far from every desired point."""
        deviation_cm = np.linalg.norm(self.points - self.letter.demonstrations.mean(axis=0), axis=1)
        return _rms(deviation_cm[elsewhere(self.case)])


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))


def elsewhere(case: Case) -> Any:
    """True for those of the 200 times that are far from every desired point."""
    return np.abs(TIMES[:, None] - case.times).min(axis=1) > NEAR_S


def by_kmp(letter: Letter, case: Case) -> Array:
    """The trajectory (200, 2) [cm] of the adapted primitive."""
    return adapted(letter, case).mean(TIMES[:, None])


def gathered(results: Results, options: Options) -> dict[str, list[Letter]]:
    """The letters of each set: the model's, and recorded ones if a folder is given."""
    names = list(TARGETS)[: max(2, round(len(TARGETS) * options.share))]
    first, *_, last = WRITTEN.moved(options.seed_offset).numbers
    sets = {
        "model": {name: write(name, count=last + 1, seed=WRITTEN.seed)[first:] for name in names}
    }
    if options.letters is not None:
        real = recorded(options.letters)
        sets["recorded"] = {
            name: real[name] for name in list(real)[: max(2, round(len(real) * options.share))]
        }
    learned_sets = {
        name: [learned(*item) for item in letters.items()] for name, letters in sets.items()
    }
    results.say(
        ", ".join(f"{len(rows)} letters learned ({name})" for name, rows in learned_sets.items())
    )
    return learned_sets


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    numbers: dict[str, Any] = {
        "ell": LETTER_ELL,
        "lambda": LAMBDA,
        "components": LETTER_COMPONENTS,
        "duration_s": DURATION_S,
        "unit": "cm",
    }
    stream = results.recording()
    sets = gathered(results, options)
    for name, rows in sets.items():
        numbers[name] = {row.name: [_measured(row, case) for case in cases(row)] for row in rows}
        numbers[f"{name}_summary"] = _summary(numbers[name].values(), rows)
        for row in rows:
            _record_letter(stream, f"/{name}/{row.name}", row)
    stream.disconnect()
    _draw(results, {SETS[name]: rows for name, rows in sets.items()})
    return numbers


def _summary(
    measured: Iterable[list[dict[str, Any]]], letters: Sequence[Letter]
) -> dict[str, float]:
    """The figures over all letters of a set."""
    entries = list(itertools.chain.from_iterable(measured))
    rms_cm = np.array([entry["rms_elsewhere_cm"] for entry in entries])
    scatter_cm = [letter.demonstrations.std(axis=0).mean() for letter in letters]
    return {
        "largest_miss_at_desired_points_cm": max(entry["miss_cm"] for entry in entries),
        "rms_deviation_elsewhere_cm": float(np.sqrt(np.mean(rms_cm**2))),
        "largest_deviation_elsewhere_cm": max(entry["largest_elsewhere_cm"] for entry in entries),
        "demonstrations_scatter_cm": float(np.mean(scatter_cm)),
    }


def _record_letter(stream: rr.RecordingStream, path: str, letter: Letter) -> None:
    """Record a letter's demonstrations and its adaptation in each case."""
    strips = list(letter.demonstrations * (1, -1))
    lines = rr.LineStrips2D(strips, colors=[rgb(REFERENCE)], radii=[0.03])
    stream.log(f"{path}/demonstrations", lines, static=True)
    for number, case in enumerate(cases(letter)):
        record(stream, path, number, {"adapted": (by_kmp(letter, case), ADAPTED)}, case)


def _measured(letter: Letter, case: Case) -> dict[str, Any]:
    primitive = adapted(letter, case)
    away = np.linalg.norm(primitive.mean(TIMES[:, None]) - letter.reference, axis=1)[
        elsewhere(case)
    ]
    return {
        "case": case.name,
        "miss_cm": float(
            np.linalg.norm(primitive.mean(case.times[:, None]) - case.points, axis=1).max()
        ),
        "rms_elsewhere_cm": _rms(away),
        "largest_elsewhere_cm": float(away.max()),
    }


def record(
    stream: rr.RecordingStream,
    path: str,
    number: int,
    lines: Mapping[str, tuple[Array, str]],
    case: Case,
) -> None:
    """Record the trajectories of a case, by name with their colours, and its desired points."""
    stream.set_time("case", sequence=number)
    for name, (line, colour) in lines.items():  # Rerun's y axis points down
        stream.log(
            f"{path}/{name}", rr.LineStrips2D([line * (1, -1)], colors=[rgb(colour)], radii=[0.08])
        )
    stream.log(
        f"{path}/desired", rr.Points2D(case.points * (1, -1), colors=[rgb(DESIRED)], radii=[0.3])
    )


def draw_lines(
    axes: Any, letter: Letter, case: Case, lines: Mapping[str, tuple[Array, str]], mark: str
) -> None:
    """Draw the mean of the demonstrations, trajectories by label with their colours, and desired
    points in the colour `mark`.
    """
    mean = letter.demonstrations.mean(axis=0)
    axes.plot(*mean.T, "--", color=REFERENCE, lw=1.1, label="mean of the demonstrations")
    for label, (line, colour) in lines.items():
        axes.plot(*line.T, color=colour, lw=1.5, label=label)
    axes.plot(*case.points.T, "o", mfc="none", mec=mark, mew=1.7, ms=7, label="desired points")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title(letter.name, loc="left", fontweight="bold", fontsize=9)
    axes.tick_params(labelsize=7)


def _draw(results: Results, sets: dict[str, list[Letter]]) -> None:
    """Draw a row for each letter, and four columns for each set: demonstrations with mixture, and
    three cases.
    """
    plt = pyplot()
    names = sorted({row.name for rows in sets.values() for row in rows})
    figure, grid = plt.subplots(
        len(names), 4 * len(sets), figsize=(5.2 * len(sets), 0.3 + 1.12 * len(names)), squeeze=False
    )
    for axes in grid.flat:
        axes.set_axis_off()
        axes.set_aspect("equal", adjustable="datalim")
    for block, (name, rows) in enumerate(sets.items()):
        columns = grid[:, 4 * block : 4 * block + 4]
        columns[0, 0].set_title(f"{name}\ndemonstrations", fontsize=8.5, loc="left")
        for axes, title in zip(
            columns[0, 1:], ("start,\nvia-point", "via-point,\nend", "all three"), strict=True
        ):
            axes.set_title(title, fontsize=8.5, loc="left")
        for letter in rows:
            _draw_letter(columns[names.index(letter.name)], letter)
    first = next(iter(sets.values()))[-1]
    x, y = _middle(first)
    axes = grid[names.index(first.name), 0]
    axes.plot([x - 5, x + 5], [y - HALF_CM, y - HALF_CM], color="black", lw=1.5, clip_on=False)
    axes.text(x, y - HALF_CM - 0.5, "10 cm", ha="center", va="top", fontsize=7)
    handles = [
        plt.Line2D([], [], color=REFERENCE, lw=0.8, label="demonstrations"),
        plt.Line2D(
            [],
            [],
            color=ADAPTED,
            marker="o",
            ms=7,
            lw=0,
            alpha=0.5,
            label="Gaussians, 1 standard deviation",
        ),
        plt.Line2D([], [], color=REFERENCE, ls="--", label="reference (GMR)"),
        plt.Line2D([], [], color=ADAPTED, label="adapted (KMP)"),
        plt.Line2D(
            [],
            [],
            color=DESIRED,
            marker="o",
            mfc="none",
            mew=1.6,
            ms=6,
            lw=0,
            label="desired points",
        ),
    ]
    legend_below(figure, handles, columns=5 if len(sets) > 1 else 3)
    results.figure(figure)


def _middle(letter: Letter) -> tuple[float, float]:
    x, y = (letter.reference.min(axis=0) + letter.reference.max(axis=0)) / 2
    return float(x), float(y)


def _draw_letter(row: Any, letter: Letter) -> None:
    for demonstration in letter.demonstrations:
        row[0].plot(*demonstration.T, color=REFERENCE, lw=0.7)
    for mean, covariance in zip(
        letter.mixture.means[:, 1:], letter.mixture.covariances[:, 1:, 1:], strict=True
    ):
        ellipse(row[0], mean, covariance, facecolor=ADAPTED, edgecolor=ADAPTED, alpha=0.35)
    for axes, case in zip(row[1:], cases(letter), strict=True):
        axes.plot(*letter.reference.T, "--", color=REFERENCE, lw=0.9)
        axes.plot(*by_kmp(letter, case).T, color=ADAPTED, lw=1.3)
        axes.plot(*case.points.T, "o", mfc="none", mec=DESIRED, mew=1.4, ms=5, clip_on=False)
    x, y = _middle(letter)
    for axes in row:
        axes.set(xlim=(x - HALF_CM, x + HALF_CM), ylim=(y - HALF_CM, y + HALF_CM))
