"""The kernelized movement primitive: the output at any input, and how sure it is (the paper, sections II-B, II-C)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import blas, lapack
from scipy.spatial.distance import cdist

from kmp.checks import Array, frozen, numbers, positive
from kmp.gaussians import Gaussians
from kmp.kernel import GaussianKernel

_BATCH = 256  # queries at once, which bounds the memory of `predict`
_BANDS = 4  # of the whitener: with 4, five eighths of the square are kept
_MACHINE = float(np.finfo(np.float64).eps)


@dataclass(frozen=True, eq=False)
class KMP:
    """A skill: the reference database, the via-points in it, and the weights. From `fit`, `adapt`, `from_arrays`.

    N points in all, I inputs, O outputs. Immutable, so that threads may share it. `inputs` (N, I) and `reference` (N)
    are the database after adaptation: the points of `base` that were not replaced, then `via_inputs` with `via_points`.
    What is fitted depends on the fields alone, bit for bit, however the primitive came about.
    """

    kernel: GaussianKernel
    lambda_mean: float
    lambda_covariance: float
    prior_mean: Array
    inputs: Array
    reference: Gaussians
    replaced: NDArray[np.intp]
    """(R,) the indices of the base's points that via-points took the place of, ascending."""
    origin: KMP | None
    """The base, or None in the base itself."""

    @classmethod
    def fit(
        cls,
        inputs: ArrayLike,
        reference: Gaussians,
        *,
        kernel: GaussianKernel,
        lambda_mean: float,
        lambda_covariance: float | None = None,
        prior_mean: ArrayLike | None = None,
    ) -> KMP:
        """The primitive of a reference database: inputs (N, I), N normals over O outputs.

        `prior_mean` (O,) [unit of the outputs] is what the mean returns to far from the inputs, the origin by default.
        `lambda_covariance` None is `lambda_mean`; another value costs a second Cholesky factor.
        """
        return cls._base(
            inputs,
            reference,
            kernel=kernel,
            lambda_mean=lambda_mean,
            lambda_covariance=lambda_covariance,
            prior_mean=prior_mean,
        )._solved()

    def mean(self, queries: ArrayLike) -> Array:
        """xi(s) at queries (M, I): (M, O). Equation (8). One query alone may differ by rounding from it in a set."""
        s = self._checked(queries)
        if len(s) == 1:
            return (self.kernel.value_at(s - self.inputs) @ self.weights + self.prior_mean)[None]
        return self.kernel(s, self.inputs) @ self.weights + self.prior_mean

    def predict(self, queries: ArrayLike) -> Gaussians:
        """xi(s) with its covariance at queries (M, I): M normals. The mean is that of `mean`, bit for bit.

        Covariance: N / lambda_c (k(s, s) I - k (K + lambda_c Sigma)^-1 k^T), IJRR 2019.
        The first prediction inverts the triangular factor: make one before there is a deadline.
        """
        s = self._checked(queries)
        if len(s) == 1:
            k = self.kernel.value_at(s - self.inputs)
            mean = (k @ self.weights + self.prior_mean)[None]
            root = np.concatenate([band @ k[: band.shape[1]] for band in self._whitener]).reshape(-1, self.outputs).T
            explained = blas.dgemm(1.0, root, root, trans_b=1)[None]
        else:
            mean = self.mean(s)
            parts = [self._explained(s[i : i + _BATCH]) for i in range(0, len(s), _BATCH)]
            explained = np.concatenate(parts) if parts else np.empty((0, self.outputs, self.outputs))
        unexplained = _positive(self._unit - explained)  # k(s, s) = 1
        return Gaussians.trusted(mean, unexplained * (len(self.inputs) / self.lambda_covariance))

    def jacobian(self, query: ArrayLike) -> Array:
        """dxi/ds at one query (I,): (O, I) [unit of the outputs / unit of the inputs]. Equation (8), derived."""
        offsets = self._checked_one("query", query) - self.inputs
        return np.asarray((self._weight_rows * self.kernel.slope_at(offsets)) @ offsets)

    def curvature(self, query: ArrayLike, direction: ArrayLike) -> Array:
        """d^2 xi(s + t v)/dt^2 at t = 0, for one query s (I,), direction v (I,): (O,). Equation (8), derived twice.

        Where v is the velocity of the input, this is the part of the output's acceleration that the velocity makes.
        """
        offsets = self._checked_one("query", query) - self.inputs
        return self.kernel.curvature_at(offsets, self._checked_one("direction", direction)) @ self.weights

    def adapt(self, inputs: ArrayLike, desired: Gaussians, *, tolerance: float) -> KMP:
        """A new primitive that also goes through the desired points: inputs (V, I), V normals. Algorithm 1.

        A desired point nearer than `tolerance` [unit of the inputs] to a point of the *base's* reference takes the
        place of its nearest one (of all, where several are equally near); any other is inserted. The order of
        the desired points does not matter. Earlier via-points stay: to be rid of them, adapt `base` anew.
        """
        via = numbers("inputs", inputs, "V", self.inputs.shape[1])
        _check_pairs(via, desired, self.outputs)
        if not tolerance >= 0:
            raise ValueError(f"tolerance is {tolerance:g}, and must not be below 0.")
        if len(via) == 0:
            return self
        base = self.base
        distance = cdist(via, base.inputs)  # (V, N of the base)
        nearest = distance.min(axis=1, keepdims=True)
        claimed = ((distance == nearest) & (nearest < tolerance)).any(axis=0)
        claimed[self.replaced] = True
        return base._adapted(
            np.flatnonzero(claimed),
            np.concatenate([self.via_inputs, via]),
            Gaussians.concatenated([self.via_points, desired]),
        )._solved()

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """All that `from_arrays` needs, by name: base and via-points apart, their fitted weights, the parameters."""
        return {
            "base_inputs": self.base.inputs,
            "base_mean": self.base.reference.mean,
            "base_covariance": self.base.reference.covariance,
            "base_weights": self.base.weights,
            "via_inputs": self.via_inputs,
            "via_mean": self.via_points.mean,
            "via_covariance": self.via_points.covariance,
            "replaced": self.replaced,
            "weights": self.weights,
            "ell": np.array(self.kernel.ell),
            "lambda_mean": np.array(self.lambda_mean),
            "lambda_covariance": np.array(self.lambda_covariance),
            "prior_mean": self.prior_mean,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> KMP:
        """The primitive that `to_arrays` gave these arrays for, with its very weights. Other names are left alone.

        Nothing is fitted here: the factors are made when `predict` or `adapt` first asks for them, and come out the
        same bit for bit, given the same libraries and kind of processor.
        """
        if missing := [name for name in _ARRAYS if name not in arrays]:
            raise ValueError(f"The primitive's arrays lack {', '.join(missing)}. Needed are {', '.join(_ARRAYS)}.")
        base = cls._base(
            arrays["base_inputs"],
            Gaussians(arrays["base_mean"], arrays["base_covariance"]),
            kernel=GaussianKernel(float(arrays["ell"])),
            lambda_mean=float(arrays["lambda_mean"]),
            lambda_covariance=float(arrays["lambda_covariance"]),
            prior_mean=arrays["prior_mean"],
        )
        base.__dict__["weights"] = numbers("base_weights", arrays["base_weights"], len(base.inputs), base.outputs)
        via = numbers("via_inputs", arrays["via_inputs"], "V", base.inputs.shape[1])
        points = Gaussians(arrays["via_mean"], arrays["via_covariance"])
        _check_pairs(via, points, base.outputs)
        if len(via) == 0:
            return base
        replaced = np.array(arrays["replaced"], dtype=np.intp)
        n = len(base.inputs)
        if not (replaced.ndim == 1 and np.isin(replaced, np.arange(n)).all() and (np.diff(replaced) > 0).all()):
            raise ValueError(f"replaced: {replaced} given, ascending indices of the {n} base points needed.")
        self = base._adapted(replaced, via, points)
        self.__dict__["weights"] = numbers("weights", arrays["weights"], len(self.inputs), self.outputs)
        return self

    @property
    def base(self) -> KMP:
        """The primitive before any adaptation: itself, if there was none."""
        return self.origin or self

    @property
    def via_inputs(self) -> Array:
        """(V, I) where the via-points are."""
        return self.inputs[self._kept :]

    @property
    def via_points(self) -> Gaussians:
        """The V via-points."""
        return self.reference.take(slice(self._kept, None))

    @property
    def outputs(self) -> int:
        """O."""
        return self.reference.outputs

    @cached_property
    def weights(self) -> Array:
        """alpha (N, O) = (K + lambda Sigma)^-1 (mu - prior mean). Equation (9)."""
        solution, _ = lapack.dpotrs(self._factor, (self.reference.mean - self.prior_mean).ravel(), lower=1)
        return frozen(np.ascontiguousarray(solution).reshape(self.reference.mean.shape))

    @cached_property
    def _weight_rows(self) -> Array:
        return frozen(np.ascontiguousarray(self.weights.T))

    @cached_property
    def _unit(self) -> Array:
        return frozen(np.eye(self.outputs))

    @property
    def _kept(self) -> int:
        return len(self.inputs) if self.origin is None else len(self.origin.inputs) - len(self.replaced)

    @cached_property
    def _factor(self) -> Array:
        return self._factorised(self.lambda_mean, self.origin._factor if self.origin else None)

    @cached_property
    def _covariance_factor(self) -> Array:
        if self.lambda_covariance == self.lambda_mean:
            return self._factor
        return self._factorised(self.lambda_covariance, self.origin._covariance_factor if self.origin else None)

    def _factorised(self, penalty: float, base_factor: Array | None) -> Array:
        """The lower Cholesky factor (N O, N O) of K (x) I + lambda Sigma: the base's, down to the first changed row."""
        o = self.outputs
        same = 0
        if base_factor is not None:
            same = int(self.replaced[0]) if len(self.replaced) else self._kept
        n, p = len(self.inputs) * o, same * o
        new = np.zeros((len(self.inputs) - same, o, len(self.inputs), o))
        k = self.kernel(self.inputs[same:], self.inputs)
        for i in range(o):
            new[:, i, :, i] = k
        points = np.arange(len(new))
        new[points, :, points + same, :] += penalty * self.reference.covariance[same:]
        rows = new.reshape(n - p, n)
        factor = np.zeros((n, n), order="F")  # as LAPACK reads it, or each use would copy it
        corner = rows[:, p:]
        if base_factor is not None and p > 0:
            factor[:p, :p] = base_factor[:p, :p]
            left, _ = lapack.dtrtrs(factor[:p, :p], rows[:, :p].T, lower=1)
            factor[p:, :p] = left.T
            corner = corner - left.T @ left
        factor[p:, p:], info = lapack.dpotrf(corner, lower=1, clean=1)
        if info:
            raise ValueError(
                f"K + lambda Sigma is not positive definite to working precision at point {same + (info - 1) // o}, "
                f"with lambda {penalty:g}. A point this near to others needs more variance, or a larger lambda or ell."
            )
        return frozen(factor)

    @cached_property
    def _whitener(self) -> tuple[Array, ...]:
        """The inverse of the triangular factor L, (N O O, N), so that it times k (N,) is L^-1 (k (x) I).

        In bands of rows, each without the columns beyond the triangle.
        """
        n, o = self.reference.mean.shape
        inverse, _ = lapack.dtrtri(self._covariance_factor, lower=1)
        rows = inverse.reshape(n * o, n, o)
        edges = [n * band // _BANDS for band in range(_BANDS + 1)]
        return tuple(
            frozen(np.ascontiguousarray(rows[a * o : b * o, :b].transpose(0, 2, 1)).reshape(-1, b))
            for a, b in pairwise(edges)
            if a < b  # fewer points than bands
        )

    def _explained(self, queries: Array) -> Array:
        k = self.kernel(queries, self.inputs)
        root = np.concatenate([band @ k[:, : band.shape[1]].T for band in self._whitener])
        roots = root.reshape(-1, self.outputs, len(queries)).transpose(2, 0, 1)  # (M, N O, O)
        return np.asarray(roots.transpose(0, 2, 1) @ roots)

    @classmethod
    def _base(
        cls,
        inputs: ArrayLike,
        reference: Gaussians,
        *,
        kernel: GaussianKernel,
        lambda_mean: float,
        lambda_covariance: float | None,
        prior_mean: ArrayLike | None,
    ) -> KMP:
        s = numbers("inputs", inputs, "N", "I")
        if len(s) == 0:
            raise ValueError("inputs: no reference point given, at least 1 needed.")
        _check_pairs(s, reference, reference.outputs)
        if lambda_covariance is None:
            lambda_covariance = lambda_mean
        if prior_mean is None:
            prior_mean = np.zeros(reference.outputs)
        return cls(
            kernel=kernel,
            lambda_mean=positive("lambda_mean", lambda_mean),
            lambda_covariance=positive("lambda_covariance", lambda_covariance),
            prior_mean=numbers("prior_mean", prior_mean, reference.outputs),
            inputs=s,
            reference=reference,
            replaced=frozen(np.empty(0, dtype=np.intp)),
            origin=None,
        )

    def _adapted(self, replaced: NDArray[np.intp], via_inputs: Array, via_points: Gaussians) -> KMP:
        kept = np.delete(np.arange(len(self.inputs)), replaced)
        return KMP(
            kernel=self.kernel,
            lambda_mean=self.lambda_mean,
            lambda_covariance=self.lambda_covariance,
            prior_mean=self.prior_mean,
            inputs=frozen(np.concatenate([self.inputs[kept], via_inputs])),
            reference=Gaussians.concatenated([self.reference.take(kept), via_points]),
            replaced=frozen(replaced),
            origin=self,
        )

    def _solved(self) -> KMP:
        # What cannot be fitted fails here, not in the first prediction.
        self.weights  # noqa: B018
        self._covariance_factor  # noqa: B018
        return self

    def _checked(self, queries: ArrayLike) -> Array:
        s = np.asarray(queries, dtype=np.float64)
        if s.ndim != 2 or s.shape[1] != self.inputs.shape[1]:
            raise ValueError(f"queries: shape {s.shape} given, (M, {self.inputs.shape[1]}) needed.")
        return s

    def _checked_one(self, name: str, value: ArrayLike) -> Array:
        s = np.asarray(value, dtype=np.float64)
        if s.shape != self.inputs.shape[1:]:
            raise ValueError(f"{name}: shape {s.shape} given, {self.inputs.shape[1:]} needed.")
        return s

    def __getstate__(self) -> dict[str, Any]:
        # A copy in another process predicts at once; the factors, which only `adapt` needs, are made again there.
        return {name: value for name, value in self.__dict__.items() if name not in {"_factor", "_covariance_factor"}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Unpickled arrays come back writeable.
        for value in state.values():
            for array in value if isinstance(value, tuple) else (value,):
                if isinstance(array, np.ndarray):
                    frozen(array)
        self.__dict__.update(state)


_ARRAYS = (
    *("base_inputs", "base_mean", "base_covariance", "base_weights"),
    *("via_inputs", "via_mean", "via_covariance", "replaced", "weights"),
    *("ell", "lambda_mean", "lambda_covariance", "prior_mean"),
)


def _check_pairs(inputs: Array, points: Gaussians, outputs: int) -> None:
    if points.mean.shape != (len(inputs), outputs):
        raise ValueError(f"{len(points)} normals over {points.outputs} outputs given for {len(inputs)} inputs; {len(inputs)} over {outputs} needed.")


def _positive(covariance: Array) -> Array:
    """The nearest positive definite covariances (M, O, O): rounding can leave some just below zero."""
    covariance = (covariance + covariance.swapaxes(1, 2)) / 2
    if len(covariance) == 1 and lapack.dpotrf(covariance[0])[1] == 0:
        return covariance  # the same as below, without NumPy's overhead
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(covariance)
        raised = (vectors * np.maximum(values, _MACHINE)[:, None, :]) @ vectors.swapaxes(1, 2)
        below = (values[:, 0] < _MACHINE)[:, None, None]
        covariance = np.where(below, (raised + raised.swapaxes(1, 2)) / 2, covariance)
    return covariance
