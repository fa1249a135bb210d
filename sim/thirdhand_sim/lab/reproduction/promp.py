"""KMP beside ProMP on letters (the paper, section III-A and Figure 2), and what each costs as the
input's dimension grows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from kmp import KMP, GaussianKernel, GaussianMixture, Gaussians
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.reproduction.letters import SETS, Case, Letter, Line, by_kmp, cases, draw_lines, gathered, record
from thirdhand_sim.lab.reproduction.writing import DURATION_S, TIMES
from thirdhand_sim.lab.results import ADAPTED, DESIRED, OTHER, Array, Options, Results, pyplot
from thirdhand_sim.lab.rivals.promp import BASES, RIDGE, learned_promp

COLUMNS = 5  # letters in a row of the figure
COLOURS = {"kmp": ADAPTED, "promp": OTHER}
STYLES = (
    ("o-", ADAPTED),
    ("x-", DESIRED),
    ("v--", "#009E73"),
    ("s:", "#56B4E9"),
    ("^--", OTHER),
    ("D-.", "black"),
    ("+-", "#8B5A2B"),
    ("*:", "#595959"),
)
FAINT = "#595959"
VIA_VARIANCE = 1e-6  # [cm²] as for KMP

DIMENSIONS = (1, 2, 3, 6)
PER_DIMENSION = (3, 5, 10)  # basis functions along each input
MOST_BYTES = 2**30  # for the covariance of the weights; beyond it, it is not made
ELL, LAMBDA, COMPONENTS, POINTS = 2.0, 0.1, 20, 200
SAMPLES, DEMONSTRATIONS = 200, 5
SAMPLE_DEVIATION = 0.003  # deviation of a sample as reference point: lambda Sigma is about WEIGHT_RIDGE
WEIGHT_RIDGE = 1e-6  # the functions are known without noise
FUNCTIONS = EXPERIMENTS["promp"].seeds.evaluation["functions"]  # times and errors are averaged over them
OUTPUTS = 3


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    numbers: dict[str, Any] = {"unit": "cm", "promp_bases_per_output": BASES, "promp_ridge": RIDGE}
    stream = results.recording()
    sets: dict[str, Drawn] = {}
    for name, rows in gathered(results, options).items():
        found = {row.name: [_compared(row, case) for case in cases(row)] for row in rows}
        numbers[name] = {letter: [_numbers(one) for one in per] for letter, per in found.items()}
        flat = [one for per in found.values() for one in per]
        bare = [Line(row, case, conditioned(row, case, ridge=0.0)) for row in rows for case in cases(row)]
        numbers[f"{name}_summary"] = {
            **_summary(flat),
            "promp_without_ridge": {
                "largest_miss_cm": max(one.measured()["miss_cm"] for one in bare),
                "mean_rms_deviation_elsewhere_cm": _mean(bare, "rms_deviation_elsewhere_cm"),
            },
        }
        sets[SETS[name]] = found
        for letter, per in found.items():
            for number, both in enumerate(per):
                lines = {who: (line.points, COLOURS[who]) for who, line in both.items()}
                record(stream, f"/{name}/{letter}", number, lines, both["kmp"].case)
    stream.disconnect()
    _draw_letters(results, sets)
    functions = FUNCTIONS.share(options.share)
    dimensions = [one for inputs in DIMENSIONS for one in averaged([grown(inputs, number) for number in functions])]
    results.say("dimensions done")
    numbers["dimensions"] = [one._asdict() for one in dimensions]
    draw_numbers(results, numbers)
    return numbers


Both: TypeAlias = dict[str, Line]
"""One case by both methods."""
Drawn: TypeAlias = dict[str, list[Both]]
"""The cases of each letter of a set."""


def conditioned(letter: Letter, case: Case, *, ridge: float = RIDGE) -> Array:
    """The trajectory (200, 2) [cm] of the letter's ProMP through the desired points."""
    primitive = learned_promp(
        [TIMES] * len(letter.demonstrations), list(letter.demonstrations), bases=BASES, ridge=ridge
    )
    for t, point in zip(case.times, case.points, strict=True):
        primitive = primitive.condition_position(point, VIA_VARIANCE * np.eye(2), t=t, t_max=DURATION_S)
    return np.asarray(primitive.mean_trajectory(TIMES.copy()))


def _compared(letter: Letter, case: Case) -> Both:
    return {"kmp": Line(letter, case, by_kmp(letter, case)), "promp": Line(letter, case, conditioned(letter, case))}


def _numbers(both: Both) -> dict[str, Any]:
    found = {who: line.measured() for who, line in both.items()}
    return {"case": both["kmp"].case.name, **{n: {who: one[n] for who, one in found.items()} for n in found["kmp"]}}


def _mean(lines: Sequence[Line], name: str) -> float:
    return float(np.mean([line.measured()[name] for line in lines]))


def _summary(rows: list[Both]) -> dict[str, Any]:
    def off(both: Both, who: str) -> float:
        return both[who].measured()["rms_deviation_elsewhere_cm"]

    summary: dict[str, Any] = {
        "adaptations": len(rows),
        "kmp_leaves_the_rest_better_alone": sum(off(both, "kmp") < off(both, "promp") for both in rows),
    }
    for who in COLOURS:
        lines = [both[who] for both in rows]
        summary[who] = {
            "largest_miss_cm": max(line.measured()["miss_cm"] for line in lines),
            "largest_deviation_elsewhere_cm": max(line.measured()["largest_deviation_elsewhere_cm"] for line in lines),
            **{f"mean_{name}": _mean(lines, name) for name in lines[0].measured() if name != "miss_cm"},
        }
    return summary


class Grown(NamedTuple):
    """A method at one number of input dimensions: free numbers, bytes of its largest matrix,
    seconds, rms error as a share of the output's rms deviation from its mean along what is tried.
    """

    method: str
    inputs: int
    functions: int  # basis functions, or reference points
    largest_matrix_bytes: float
    seconds: float | None  # to learn; None: not possible
    error: float | None


def averaged(runs: list[list[Grown]]) -> list[Grown]:
    """The means of runs that differ in the function only: of times, and of errors as geometric
    means.
    """
    out = []
    for same in zip(*runs, strict=True):
        one = same[0]
        if one.seconds is not None:
            times, errors = [r.seconds for r in same], [r.error for r in same]
            one = one._replace(seconds=float(np.mean(times)), error=float(np.exp(np.mean(np.log(errors)))))
        out.append(one)
    return out


def grown(inputs: int, seed: int) -> list[Grown]:
    """The methods on a smooth function of so many inputs, known along five demonstrations, tried
    along a sixth.
    """
    random = np.random.default_rng([seed, inputs])
    lines = _lines(inputs, random)
    function = _function(inputs, random)
    train, test = lines[:-1].reshape(-1, inputs), lines[-1]
    y, wanted = function(train), function(test)
    scale = float(np.sqrt(np.mean((wanted - wanted.mean(axis=0)) ** 2)))

    def tried(method: str, functions: int, size: float, guess: Callable[[], Array]) -> Grown:
        began = time.process_time()
        error = float(np.sqrt(np.mean((guess() - wanted) ** 2))) / scale
        return Grown(method, inputs, functions, size, time.process_time() - began, error)

    def kmp() -> Array:
        mixture = GaussianMixture.fit(np.hstack([train, y]), components=COMPONENTS, seed=seed)
        at = mixture.sample_inputs(POINTS, dimensions=inputs, seed=seed)
        reference = mixture.regress(at)
        kernel, centre = GaussianKernel(ELL), y.mean(axis=0)
        return KMP.fit(at, reference, kernel=kernel, lambda_mean=LAMBDA, prior_mean=centre).mean(test)

    some = slice(None, None, len(train) // POINTS)

    def kmp_at_samples() -> Array:
        reference, centre = Gaussians.of(y[some], deviation=SAMPLE_DEVIATION), y.mean(axis=0)
        return KMP.fit(train[some], reference, kernel=GaussianKernel(ELL), lambda_mean=LAMBDA, prior_mean=centre).mean(
            test
        )

    def mixture_regression() -> Array:
        mixture = GaussianMixture.fit(np.hstack([train, y]), components=COMPONENTS, seed=seed)
        return mixture.regress(test).mean

    def kernel_ridge() -> Array:
        kernel, centre = GaussianKernel(ELL), y.mean(axis=0)
        gram = kernel(train[some], train[some]) + WEIGHT_RIDGE * np.eye(POINTS)
        return np.asarray(kernel(test, train[some]) @ np.linalg.solve(gram, y[some] - centre) + centre)

    def promp(phi: Callable[[Array], Array]) -> Callable[[], Array]:
        return lambda: _promp([phi(line) for line in lines[:-1]], y.reshape(DEMONSTRATIONS, -1, OUTPUTS), phi(test))

    size = 8.0 * (POINTS * OUTPUTS) ** 2
    rows = [
        tried("KMP", POINTS, size, kmp),
        tried("KMP, at 200 samples", POINTS, size, kmp_at_samples),
        tried("GMM", COMPONENTS, 8.0 * COMPONENTS * (inputs + OUTPUTS) ** 2, mixture_regression),
        tried("kernel ridge, 200 samples", POINTS, 8.0 * POINTS**2, kernel_ridge),
        tried("ProMP, at 200 samples", POINTS, size, promp(lambda s: GaussianKernel(ELL)(s, train[some]))),
    ]
    for each in PER_DIMENSION:
        functions, method = each**inputs, f"ProMP, {each} per input"
        size = 8.0 * (functions * OUTPUTS) ** 2
        if size > MOST_BYTES:
            rows.append(Grown(method, inputs, functions, size, None, None))
        else:
            rows.append(tried(method, functions, size, promp(_grid(inputs, each))))
    return rows


def _grid(inputs: int, each: int) -> Callable[[Array], Array]:
    """Normalised basis functions on a grid over the inputs: from (M, I) to (M, each^I)."""
    grid = np.linspace(0, 1, each)
    width = grid[1] - grid[0]

    def phi(s: Array) -> Array:
        rows = np.ones((len(s), 1))
        for axis in range(inputs):
            bumps = np.exp(-0.5 * ((s[:, axis : axis + 1] - grid) / width) ** 2)
            rows = (rows[:, :, None] * (bumps / bumps.sum(axis=1, keepdims=True))[:, None, :]).reshape(len(s), -1)
        return rows

    return phi


def _promp(designs: list[Array], y: Array, query: Array) -> Array:
    """Predictions (M, O) at the rows of a query (M, B) by a ProMP with the basis functions of
    demonstrations (200, B) and outputs (H, 200, O).

    The weights' mean is the ridge regression of all demonstrations, each demonstration's weights
    that of what the mean leaves of it: few demonstrations do not reach every basis function, and
    their own weights alone would average to less than what any of them shows.
    """

    def ridge(design: Array, wanted: Array) -> Array:
        gram = design @ design.T + WEIGHT_RIDGE * np.eye(len(design))  # the dual: fewer rows than functions
        return np.asarray(design.T @ np.linalg.solve(gram, wanted))

    mean = ridge(np.concatenate(designs), np.concatenate(list(y)))
    weights = [
        (mean + ridge(design, wanted - design @ mean)).ravel() for design, wanted in zip(designs, y, strict=True)
    ]
    covariance = np.cov(np.array(weights).T)  # conditioning needs that of all weights
    assert covariance.shape == (mean.size,) * 2
    return np.asarray(query @ mean)


def _lines(inputs: int, random: np.random.Generator) -> Array:
    """Demonstrations' inputs (6, 200, I) in the unit cube: one smooth curve, scattered."""
    t = np.linspace(0, 1, SAMPLES)[:, None]
    phases = random.uniform(0, 2 * np.pi, (3, inputs))
    sizes = random.uniform(0.3, 1.0, (3, inputs))
    lines = []
    for _ in range(DEMONSTRATIONS + 1):
        shift = 0.15 * random.standard_normal((3, inputs))
        curve = sum(sizes[k] / (k + 1) * np.sin((k + 1) * np.pi * t + phases[k] + shift[k]) for k in range(3))
        lines.append(t[:, :1] if inputs == 1 else np.asarray(curve))
    stacked = np.array(lines)
    low, high = stacked.min(axis=(0, 1)), stacked.max(axis=(0, 1))
    return np.asarray((stacked - low) / (high - low))


def _function(inputs: int, random: np.random.Generator) -> Any:
    """A smooth function from the cube to O outputs, as rough in every number of dimensions."""
    directions = random.standard_normal((6, inputs)) / np.sqrt(inputs) * 4.0
    phases, sizes = random.uniform(0, 2 * np.pi, 6), random.standard_normal((6, OUTPUTS))
    return lambda s: np.sin(s @ directions.T + phases) @ sizes


def _draw_letters(results: Results, sets: dict[str, Drawn]) -> None:
    plt = pyplot()
    lines = {name: -(-len(found) // COLUMNS) for name, found in sets.items()}
    figure = plt.figure(figsize=(9.5, 0.3 + 2.05 * sum(lines.values())))
    blocks = np.atleast_1d(figure.subfigures(len(sets), 1, height_ratios=list(lines.values()), squeeze=True))
    for block, (name, found) in zip(blocks, sets.items(), strict=True):
        grid = block.subplots(lines[name], COLUMNS, squeeze=False)
        block.supylabel(f"{name} [cm]", fontsize=9)
        for axes, (*_, last) in zip(grid.flat, found.values(), strict=False):
            letter, case, _ = last["kmp"]
            shown = {label: (last[who].points, COLOURS[who]) for label, who in (("ProMP", "promp"), ("KMP", "kmp"))}
            draw_lines(axes, letter, case, shown, DESIRED)
        for axes in grid.flat[len(found) :]:
            axes.set_axis_off()
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    results.figure(figure)


def draw_numbers(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of what the dimensions cost. The letters' shows more than the numbers."""
    plt, rows = pyplot(), [Grown(**one) for one in numbers["dimensions"]]
    figure, (functions, seconds, error) = plt.subplots(1, 3, figsize=(10.5, 3.9))
    methods = list(dict.fromkeys(one.method for one in rows))
    for method, (style, colour) in zip(methods, STYLES, strict=True):
        mine = [one for one in rows if one.method == method]
        functions.plot([one.inputs for one in mine], [one.functions for one in mine], style, color=colour, label=method)
        possible = [one for one in mine if one.seconds is not None and one.error is not None]
        inputs = [one.inputs for one in possible]
        seconds.plot(inputs, [one.seconds for one in possible], style, color=colour)
        error.plot(inputs, [100 * one.error for one in possible if one.error is not None], style, color=colour)
        if len(possible) < len(mine):
            last = possible[-1]
            for axes, value in ((seconds, last.seconds), (error, 100 * (last.error or 0.0))):
                axes.plot(last.inputs, value, "o", ms=13, mfc="none", mec=colour, mew=1)
    at = (MOST_BYTES / 8) ** 0.5 / OUTPUTS
    functions.axhline(at, color=FAINT, lw=0.8)
    functions.text(
        0.9, at * 1.4, "above: more than 1 GiB\nfor their covariance,\nwhich is not made", fontsize=7.5, color=FAINT
    )
    functions.text(6, 165, "four at 200", fontsize=7.5, color=FAINT, ha="right", va="top")
    functions.set(yscale="log", ylim=(2, 3e6), ylabel="basis functions, or reference points")
    seconds.set(yscale="log", ylabel="time to learn [s]")
    error.set(
        yscale="log",
        ylabel="rms error along a held-out demonstration\n[% of the output's rms deviation there]",
    )
    for axes in (functions, seconds, error):
        axes.set(xlabel="input dimensions", xticks=DIMENSIONS)
    error.yaxis.set_major_formatter("{x:g}")
    figure.suptitle(
        "ringed: where a line ends, as with six inputs it has more functions than the line at the left allows",
        fontsize=9,
    )
    figure.legend(*functions.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    results.figure(figure, "dimensions")
