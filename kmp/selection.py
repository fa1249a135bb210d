"""From demonstrations to a primitive, with a choice of the hyper-parameters that are not given. The
criterion is the error on left-out demonstrations, of primitives learned from the others, or the
marginal likelihood of the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.arrays.checks import (
    Array,
    Seed,
    check_kind,
    checked_demonstrations,
    one_of,
    positive,
    seeded,
    whole,
)
from kmp.arrays.immutable import Immutable, frozen
from kmp.criteria.errors import preferred, rms
from kmp.criteria.folds import Fold
from kmp.criteria.likelihood import most_likely
from kmp.gaussians import Gaussians
from kmp.kernel import Kernel, checked_kernel
from kmp.mixture import GaussianMixture, deviations, mixture_of, one_thread, varies
from kmp.primitive import KMP
from kmp.radial import GaussianKernel
from kmp.time_kernels import VelocityKernel

_ELLS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)  # ell times twice the inputs' variance
_LAMBDAS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # lambda / mean variance of the reference
_OF_MEAN = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3, 1e4, 1e5)  # lambda_c over lambda
_STEP = 4.0  # factor of the first steps around the best parameters
_SWEEPS = 2
_AS_GOOD = 1.03  # the shortest lengths up to this multiple of the least RMSE are taken
_AROUND = 10.0 ** np.arange(-1, 4)  # multiples of the best lambda that are tried with each length
# multiples of the best ell that are tried, up to the last of _ELLS
_SHORTER = 2.0 ** np.arange(1, 9)
_ROUNDED = 1 + 1e-9
_PLACES = 9  # reference points at which the reach of a via-point is measured
_COARSEST = 1e-3  # largest step between two numbers of the inputs' size / deviation of the inputs
_HELD_OUT = 200  # points of a held-out demonstration that are predicted


@dataclass(frozen=True, eq=False, repr=False)
class Score(Immutable):
    """The errors of some hyper-parameters on a left-out demonstration."""

    ell: float | Array
    lambda_mean: float
    lambda_covariance: float | None
    """None where only the mean was tried."""
    rmse: float
    """Of the mean, over all demonstrations, each output over its deviation; rates do not count."""
    negative_log_likelihood: float | None
    """[nat] the mean of a point's, so standardised; None where only the mean was tried."""


@dataclass(frozen=True, eq=False, repr=False)
class Learned(Immutable):
    """A primitive, the mixture of its reference, and the scores of all that was tried.

    The primitive's lengths are the shortest ones whose RMSE is within 3 % of the best score's.
    """

    primitive: KMP
    mixture: GaussianMixture
    """Of inputs and outputs, each column over its deviation in the demonstrations."""
    scores: tuple[Score, ...]
    """The best first."""
    regression_rmse: float
    """Of mixture regression without a kernel; nan if none was tried."""

    @cached_property
    def reach(self) -> Array:
        """Distances (I,) [unit of the inputs] up to which a via-point matters, along each input.

        The median of `KMP.via_point_reach` over some of the reference points: up to there, the mean
        moves by at least a tenth of what it moves at the via-point. For another reach, give `learn`
        a kernel: a larger ell makes it shorter.
        """
        base = self.primitive.base
        places = base.inputs[np.linspace(0, len(base.inputs) - 1, _PLACES).round().astype(int)]
        return frozen(
            np.median([base.via_point_reach(place) for place in np.unique(places, axis=0)], axis=0)
        )

    def report(self, count: int = 10) -> str:
        """The best `count` of the scores as a table, then what was chosen and its reach."""
        lines = [_row("ell", "lambda", "lambda_c", "RMSE", "-log lik.")]
        for score in self.scores[: whole("count", count)]:
            lines.append(
                _row(
                    " ".join(f"{value:.3g}" for value in np.atleast_1d(score.ell)),
                    f"{score.lambda_mean:.3g}",
                    "" if score.lambda_covariance is None else f"{score.lambda_covariance:.3g}",
                    f"{score.rmse:.4g}",
                    ""
                    if score.negative_log_likelihood is None
                    else f"{score.negative_log_likelihood:.3f}",
                )
            )
        lines.append(_row("mixture regression alone", "", "", f"{self.regression_rmse:.4g}"))
        kernel = self.primitive.kernel
        penalty = self.primitive.lambda_mean
        reach = " ".join(f"{distance:.3g}" for distance in self.reach)
        lines.append(
            f"chosen: {kernel!r}, lambda {penalty:.3g}; a via-point matters up to {reach} from it"
        )
        return "\n".join(lines)


def _row(name: str, *cells: str) -> str:
    return f"{name:>40}" + "".join(f" {cell:>10}" for cell in cells)


@dataclass(frozen=True)
class _Recipe:
    """The parameters by which a reference is made of demonstrations."""

    components: int
    seed: int
    count: int
    regularization: float
    channels: int
    unit: Array
    """Of each column (I + O,) in the mixture: its deviation."""

    def mixture(
        self, data: Sequence[tuple[Array, Array]], start: GaussianMixture | None = None
    ) -> GaussianMixture:
        """The mixture of all samples; EM begins at `start`, the mixture of a few more samples, if
        given.

        Its columns are over `unit`, so that the regularization is a share of each variance.
        """
        return mixture_of(
            np.concatenate([np.hstack(pair) for pair in data]) / self.unit,
            components=self.components,
            seed=self.seed,
            regularization=self.regularization,
            start=start,
        )

    def regressed(self, mixture: GaussianMixture, inputs: Array) -> Gaussians:
        """The regression of a mixture at inputs (N, I), in the units of the outputs."""
        dimensions = inputs.shape[1]
        output_unit = self.unit[dimensions:]
        regression = mixture.regress(inputs / self.unit[:dimensions])
        return Gaussians(
            regression.mean * output_unit,
            regression.covariance * np.multiply.outer(output_unit, output_unit),
        )

    def reference(
        self, data: Sequence[tuple[Array, Array]], mixture: GaussianMixture, shown: bool
    ) -> Fold:
        """The reference of these demonstrations."""
        samples = np.concatenate([s for s, _ in data])
        if shown:
            inputs = samples[
                np.linspace(0, len(samples) - 1, min(self.count, len(samples))).astype(int)
            ]
        elif samples.shape[1] == 1:
            inputs = np.linspace(samples.min(), samples.max(), self.count)[:, None]
        else:
            dimensions = samples.shape[1]
            drawn = mixture.sample_inputs(self.count, dimensions=dimensions, seed=self.seed)
            inputs = drawn * self.unit[:dimensions]
        reference = self.regressed(mixture, inputs)
        prior = reference.mean.mean(axis=0)
        prior[len(prior) // self.channels :] = 0
        nothing = np.empty((0, 0))
        return Fold(frozen(inputs), reference, frozen(prior), nothing, nothing, np.nan)


class _Taught(NamedTuple):
    """Demonstrations, each inputs (T, I) and outputs (T, O), and their mixture."""

    recipe: _Recipe
    data: list[tuple[Array, Array]]
    mixture: GaussianMixture

    def of_outputs(self, chosen: NDArray[np.bool_]) -> _Taught:
        """The same with the chosen outputs (O,) only; with all, if none is chosen."""
        if chosen.all() or not chosen.any():
            return self
        data = [(s, xi[:, chosen]) for s, xi in self.data]
        unit = self.recipe.unit
        inputs = len(unit) - len(chosen)
        recipe = replace(self.recipe, unit=np.append(unit[:inputs], unit[inputs:][chosen]))
        return _Taught(recipe, data, recipe.mixture(data))

    def reference(self, shown: bool) -> Fold:
        """The reference of all demonstrations."""
        return self.recipe.reference(self.data, self.mixture, shown)

    def folds(self, options: Sequence[bool]) -> list[_Folds]:
        """The folds, each without one demonstration, for each option of `shown`.

        Raises ValueError if there is only one demonstration.
        """
        if len(self.data) < 2:
            raise ValueError(
                f"{len(self.data)} demonstration given: at least 2 needed to choose parameters by "
                "leaving one out. Give kernel, lambda_mean and lambda_covariance, or criterion "
                '"likelihood", or another demonstration.'
            )
        recipe = self.recipe
        others = [[*self.data[:h], *self.data[h + 1 :]] for h in range(len(self.data))]
        mixtures = [recipe.mixture(training, self.mixture) for training in others]
        return [
            _Folds(
                tuple(
                    self._held_out(recipe.reference(training, mixture, option), mixture, held_out)
                    for training, mixture, held_out in zip(others, mixtures, self.data, strict=True)
                ),
                option,
                recipe.channels,
            )
            for option in options
        ]

    def _held_out(
        self, training: Fold, mixture: GaussianMixture, held_out: tuple[Array, Array]
    ) -> Fold:
        """The fold of a reference, with the errors of its mixture on what is held out."""
        samples = len(held_out[0])
        indices = np.linspace(0, samples - 1, min(samples, _HELD_OUT)).astype(int)
        inputs = held_out[0][indices]
        outputs = held_out[1][indices]
        values = outputs.shape[1] // self.recipe.channels
        miss = (self.recipe.regressed(mixture, inputs).mean - outputs)[:, :values]
        return replace(
            training, held_inputs=inputs, held_outputs=outputs, regression_rmse=rms(miss)
        )


class _Folds(NamedTuple):
    """The folds of all demonstrations, with references at demonstrated inputs (`shown`) or drawn
    ones.
    """

    each: tuple[Fold, ...]
    shown: bool
    channels: int

    @property
    def outputs(self) -> int:
        """The number of outputs that are values, not rates."""
        return self.each[0].reference.outputs // self.channels

    def rmses(self, kernel: Kernel, penalties: Sequence[float]) -> list[float]:
        """The RMSE over all folds, for each penalty."""
        fold_rmses = [fold.rmses(kernel, penalties, self.outputs) for fold in self.each]
        return [float(rmse) for rmse in np.sqrt(np.mean(np.square(fold_rmses), axis=0))]

    def likelihoods(self, kernel: Kernel, penalty: float, others: Sequence[float]) -> list[float]:
        """The mean negative log likelihoods, for each lambda of the covariance."""
        fold_likelihoods = [
            fold.negative_log_likelihoods(kernel, penalty, others, self.outputs)
            for fold in self.each
        ]
        return [float(likelihood) for likelihood in np.mean(fold_likelihoods, axis=0)]


def learn(
    demonstrations: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    components: int,
    seed: Seed = 0,
    count: int = 200,
    velocity: bool = False,
    kernel: Kernel | None = None,
    lambda_mean: float | None = None,
    lambda_covariance: float | None = None,
    regularization: float = 1e-6,
    points: Literal["auto", "shown", "drawn"] = "auto",
    criterion: Literal["left-out", "likelihood"] = "left-out",
    scales: Literal["each", "one"] = "each",
) -> Learned:
    """The primitive of demonstrations, each inputs (T, I) and outputs (T, O), and its scores.

    The paper, sections II-A, II-B: a mixture of `components`, its regression at `count` inputs, and
    the primitive, whose mean returns to the reference's. Each output is standardised, so that none
    depends on the unit of another: its variance in the demonstrations is the `prior_covariance` of
    `KMP.fit`. `regularization` is that of `GaussianMixture.fit`, as a share of the variance of each
    input and output, and `seed` its seed.

    Demonstrations may have different lengths T. Over time, those of different durations should be
    `aligned` first: they then have a common phase.

    `points`: the inputs are "drawn" from the marginal as in the paper (evenly spaced over time,
    where I is 1), or "shown", the demonstrations' own. "auto": drawn where I is 1; else those
    with the least RMSE on what is left out, or shown where nothing is left out.

    A kernel and a lambda that are not given are chosen by the `criterion`. "left-out": the shortest
    lengths whose RMSE on the demonstration that is left out, over all of them, is within 3 % of the
    least, so that a via-point changes little else (`Learned.reach`); then a lambda of the
    covariance that is not given is the one with the least negative log likelihood there.
    "likelihood": those of the greatest marginal likelihood of the reference (Rasmussen and Williams
    2006, section 5.4.1), for normals of the covariance s^2 (K + lambda Sigma), s^2 the likeliest;
    then a lambda of the covariance that is not given is N / s^2. One demonstration is enough, and
    no scores are made. Give enough components: with too few, the primitive imitates the kinks of
    the mixture.

    `scales`: a length for "each" input, or "one" for all, over their deviations. `velocity`: the
    outputs are values and then their rates over time, the kernel a VelocityKernel. What is tried
    follows the data's units.

    An output that never changes has no part in the choice.

    Raises ValueError if shapes do not agree, a number is not finite, a parameter is out of its
    range, the inputs are too far from 0 for their deviation, or there are too few samples for the
    components, or demonstrations for a choice.
    """
    data = checked_demonstrations(demonstrations)
    for name, value in (("lambda_mean", lambda_mean), ("lambda_covariance", lambda_covariance)):
        if value is not None:
            positive(name, value)
    whole("count", count)
    check_kind("velocity", velocity, bool, "True or False")
    one_of("points", points, ("auto", "shown", "drawn"))
    one_of("criterion", criterion, ("left-out", "likelihood"))
    one_of("scales", scales, ("each", "one"))
    if kernel is not None:
        checked_kernel(kernel).check(data[0][0].shape[1], data[0][1].shape[1])
    elif velocity:
        VelocityKernel(1.0).check(data[0][0].shape[1], data[0][1].shape[1])
    channels = 2 if velocity else 1
    values = data[0][1].shape[1] // channels
    size = deviations(np.concatenate([xi[:, :values] for _, xi in data]))
    output_unit = np.tile(size, channels)
    data = [(s, xi / output_unit) for s, xi in data]
    unit = deviations(np.concatenate([np.hstack(pair) for pair in data]))
    recipe = _Recipe(components, seeded(seed), count, regularization, channels, unit)
    _check_precision(data)
    taught = _Taught(recipe, data, recipe.mixture(data))
    # an output that never changes has no part in the choice
    is_varying = varies(np.concatenate([xi[:, :values] for _, xi in data]))
    decisive = taught.of_outputs(np.tile(is_varying, channels))
    is_shown = points == "shown" or (points == "auto" and data[0][0].shape[1] > 1)
    scores: list[Score] = []
    plain = np.nan
    is_incomplete = kernel is None or lambda_mean is None or lambda_covariance is None
    if is_incomplete and criterion == "left-out":
        search = _Search(kernel, lambda_mean, scales == "one")
        options = [is_shown, False] if points == "auto" and is_shown else [is_shown]
        choices = decisive.folds(options)
        # over one input the matrices are those of few features
        with one_thread() if data[0][0].shape[1] == 1 else nullcontext():
            folds, kernel, lambda_mean, scores = search.best(choices)
            if lambda_covariance is None:
                lambda_covariance = _likeliest(folds, kernel, lambda_mean, scores)
        is_shown = folds.shown
        plain = float(np.sqrt(np.mean([fold.regression_rmse**2 for fold in folds.each])))
    if is_incomplete and criterion == "likelihood":
        informative = decisive.reference(is_shown)
        start = 0.5 / _variances(informative.inputs)
        likeliest = most_likely(
            informative.database,
            informative.prior_mean,
            kernel or (VelocityKernel(float(start[0])) if velocity else GaussianKernel(start)),
            lambda_mean,
            free="none" if kernel else scales,
        )
        kernel = likeliest.kernel
        lambda_mean = likeliest.lambda_mean
        lambda_covariance = lambda_covariance or len(informative.inputs) / likeliest.signal_variance
    assert kernel is not None, "given or chosen"
    assert lambda_mean is not None, "given or chosen"
    full = taught.reference(is_shown)
    order = sorted(scores, key=_best_first)
    primitive = KMP.fit(
        full.inputs,
        full.reference.affine(np.diag(output_unit), np.zeros(len(output_unit))),
        kernel=kernel,
        lambda_mean=lambda_mean,
        lambda_covariance=lambda_covariance,
        prior_mean=full.prior_mean * output_unit,
        prior_covariance=size**2,
    )
    return Learned(primitive, taught.mixture, tuple(order), plain)


def _check_precision(data: Sequence[tuple[Array, Array]]) -> None:
    """Raise ValueError for inputs that vary too little for the precision of numbers of their
    size.
    """
    inputs = np.concatenate([s for s, _ in data])
    widest = int(inputs.std(axis=0).argmax())
    deviation = float(inputs[:, widest].std())
    largest = float(np.abs(inputs[:, widest]).max())
    if deviation < float(np.spacing(largest)) / _COARSEST:
        raise ValueError(
            f"demonstrations: the inputs deviate by {deviation:.3g} from their mean, which is too "
            f"little at {largest:.3g}: subtract the begin of each demonstration."
        )


def _variances(inputs: Array) -> Array:
    """The variances (I,) of inputs (N, I), above 0."""
    variances = np.var(inputs, axis=0)
    # one that never changed has no length
    largest = variances.max() if varies(inputs).any() else 1.0
    return np.where(varies(inputs), variances, largest)


def _best_first(score: Score) -> tuple[float, float]:
    return (
        score.rmse,
        np.inf if score.negative_log_likelihood is None else score.negative_log_likelihood,
    )


def _likeliest(folds: _Folds, kernel: Kernel, lambda_mean: float, scores: list[Score]) -> float:
    """The covariance's lambda of the least negative log likelihood; appends the scores."""
    others = [factor * lambda_mean for factor in _OF_MEAN]
    [rmse] = folds.rmses(kernel, [lambda_mean])
    likelihoods = folds.likelihoods(kernel, lambda_mean, others)
    scores += [
        Score(
            kernel.ell, lambda_mean, other, rmse if np.isfinite(likelihood) else np.inf, likelihood
        )
        for other, likelihood in zip(others, likelihoods, strict=True)
    ]
    return min(zip(likelihoods, others, strict=True))[1]


class _Tried(NamedTuple):
    """Parameters, log ell of each input and log lambda, and their RMSE."""

    rmse: float
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class _Search:
    """The search for the kernel and lambda of the least RMSE; one of them may be given."""

    kernel: Kernel | None
    lambda_mean: float | None
    one_length: bool

    def best(self, choices: Sequence[_Folds]) -> tuple[_Folds, Kernel, float, list[Score]]:
        """Search a grid for each choice of folds, then take steps along each parameter for the
        best.

        Of the lengths that predict as well as the best, the shortest are taken: a via-point then
        changes no more of the skill than the demonstrations ask for.
        """
        grids: list[list[Score]] = [[] for _ in choices]
        candidates = [
            self._grid(folds, scores) for folds, scores in zip(choices, grids, strict=True)
        ]
        i = min(range(len(choices)), key=lambda i: candidates[i])
        folds = choices[i]
        scores = grids[i]
        best = candidates[i]
        dimensions = folds.each[0].inputs.shape[1]
        lengths = [range(dimensions)] if self.one_length else [[i] for i in range(dimensions)]
        free = ([] if self.kernel else lengths) + ([] if self.lambda_mean else [[dimensions]])
        for _ in range(_SWEEPS):
            for indices in free:
                for step in (np.log(_STEP), -np.log(_STEP)):
                    other = tuple(
                        value + step * (n in indices) for n, value in enumerate(best.parameters)
                    )
                    best = min(best, *self._tried(folds, other[:-1], [other[-1]], scores))
        chosen = self._shortest(folds, best, scores)
        return (
            folds,
            self._kernel(folds, chosen.parameters[:-1]),
            self._penalty(chosen.parameters[-1]),
            scores,
        )

    def _shortest(self, folds: _Folds, best: _Tried, scores: list[Score]) -> _Tried:
        """The parameters of the shortest lengths whose RMSE is within 3 % of the best."""
        if self.kernel is not None:
            return best
        *lengths, penalty = best.parameters
        last = max(_ELLS) * 0.5 / self._spread(folds)  # beyond it, a via-point is a spike
        penalties = (
            [0.0] if self.lambda_mean else [penalty + np.log(multiple) for multiple in _AROUND]
        )
        candidates = [best]
        for factor in _SHORTER[
            (_SHORTER * np.exp(lengths)[:, None] <= _ROUNDED * last[:, None]).all(axis=0)
        ]:
            candidates.append(
                min(
                    self._tried(
                        folds,
                        tuple(length + np.log(factor) for length in lengths),
                        penalties,
                        scores,
                    )
                )
            )
        shortest_first = candidates[::-1]
        return preferred(
            shortest_first, [candidate.rmse for candidate in shortest_first], _AS_GOOD * best.rmse
        )

    def _grid(self, folds: _Folds, scores: list[Score]) -> _Tried:
        variances = self._spread(folds)
        traces = [
            np.trace(fold.reference.covariance, axis1=1, axis2=2).mean() for fold in folds.each
        ]
        variance = float(np.mean(traces)) / folds.each[0].reference.outputs
        lengths = [0.0] if self.kernel else np.log(_ELLS)
        penalties = [0.0] if self.lambda_mean else np.log(_LAMBDAS) - np.log(variance)
        start = np.log(0.5 / variances)
        return min(
            candidate
            for n in lengths
            for candidate in self._tried(folds, tuple(start + n), penalties, scores)
        )

    @staticmethod
    def _spread(folds: _Folds) -> Array:
        """The variances (I,) of the inputs."""
        return _variances(np.concatenate([fold.held_inputs for fold in folds.each]))

    def _tried(
        self,
        folds: _Folds,
        lengths: tuple[float, ...],
        penalties: Sequence[float],
        scores: list[Score],
    ) -> list[_Tried]:
        kernel = self._kernel(folds, lengths)
        values = [self._penalty(penalty) for penalty in penalties]
        rmses = folds.rmses(kernel, values)
        scores += [
            Score(kernel.ell, value, None, rmse, None)
            for value, rmse in zip(values, rmses, strict=True)
        ]
        return [
            _Tried(rmse, (*lengths, penalty))
            for rmse, penalty in zip(rmses, penalties, strict=True)
        ]

    def _kernel(self, folds: _Folds, lengths: Sequence[float]) -> Kernel:
        ell = np.exp(np.array(lengths))
        return self.kernel or (
            VelocityKernel(float(ell[0])) if folds.channels == 2 else GaussianKernel(ell)
        )

    def _penalty(self, log: float) -> float:
        return self.lambda_mean or float(np.exp(log))
