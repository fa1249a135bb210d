"""A primitive as named arrays and as a file: without pickle, exact to the bit, with its units."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kmp.checks import numbers
from kmp.dense import Dense
from kmp.features import Features
from kmp.gaussians import Gaussians, check_pairs
from kmp.kernel import GaussianKernel, Kernel, VelocityKernel
from kmp.low_rank import LowRank
from kmp.problem import Problem

if TYPE_CHECKING:
    from kmp.primitive import KMP

_ARRAYS = (
    *("base_inputs", "base_mean", "base_covariance", "base_weights"),
    *("via_inputs", "via_mean", "via_covariance", "replaced", "weights"),
    *("ell", "lambda_mean", "lambda_covariance", "prior_mean"),
)
_FORMAT = 1


class Stored(NamedTuple):
    """What a file held."""

    primitive: KMP
    input_unit: str
    output_unit: str


def save(path: str | Path, primitive: KMP, *, input_unit: str, output_unit: str) -> None:
    """Writes the primitive and the units of its numbers ("m", "s", "m, m/s") to an .npz file of this very name."""
    units = {
        "kmp_format": np.array(_FORMAT),
        "input_unit": np.array(input_unit),
        "output_unit": np.array(output_unit),
    }
    with Path(path).open("wb") as file:
        np.savez(file, allow_pickle=False, **units, **primitive.to_arrays())


def load(path: str | Path) -> Stored:
    """The primitive and the units that `save` wrote: the same predictions bit for bit, nothing is fitted."""
    from kmp.primitive import KMP

    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except (ValueError, EOFError, OSError) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise ValueError(f"{path}: not an .npz file that `kmp.save` wrote: {error}") from None
    if int(arrays.get("kmp_format", 0)) != _FORMAT:
        raise ValueError(f"{path}: format {int(arrays.get('kmp_format', 0))} given, {_FORMAT} needed.")
    try:
        return Stored(KMP.from_arrays(arrays), str(arrays["input_unit"]), str(arrays["output_unit"]))
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None


def to_arrays(primitive: KMP) -> dict[str, NDArray[Any]]:
    """The arrays of `KMP.to_arrays`."""
    base = primitive.base
    arrays = {
        "base_inputs": base.inputs,
        "base_mean": base.reference.mean,
        "base_covariance": base.reference.covariance,
        "base_weights": base.weights,
        "via_inputs": primitive.via_inputs,
        "via_mean": primitive.via_points.mean,
        "via_covariance": primitive.via_points.covariance,
        "replaced": primitive.replaced,
        "weights": primitive.weights,
        "ell": np.array(primitive.kernel.ell),
        "lambda_mean": np.array(primitive.lambda_mean),
        "lambda_covariance": np.array(primitive.lambda_covariance),
        "prior_mean": primitive.prior_mean,
    }
    if primitive.kernel.channels > 1:
        arrays["channels"] = np.array(primitive.kernel.channels)
    if isinstance(low := base.solution, LowRank):
        arrays |= {"pivots": low.centres, "information": low.information, "features": low.w}
    return arrays


def from_arrays(kind: type[KMP], arrays: Mapping[str, NDArray[Any]]) -> KMP:
    """The primitive of `KMP.from_arrays`."""
    if missing := [name for name in _ARRAYS if name not in arrays]:
        raise ValueError(f"The primitive's arrays lack {', '.join(missing)}. Needed are {', '.join(_ARRAYS)}.")
    kernel = _kernel(arrays)
    inputs = numbers("base_inputs", arrays["base_inputs"], "N", "I")
    reference = Gaussians(arrays["base_mean"], arrays["base_covariance"])
    outputs = reference.outputs
    problem = Problem.of(
        inputs,
        reference,
        kernel,
        lambda_mean=float(arrays["lambda_mean"]),
        lambda_covariance=float(arrays["lambda_covariance"]),
        prior_mean=arrays["prior_mean"],
    )
    solution: Dense | LowRank = Dense(kernel, problem, inputs, reference)
    if "pivots" in arrays:
        pivots = numbers("pivots", arrays["pivots"], "r", inputs.shape[1])
        r, d = len(pivots), outputs // kernel.channels
        information = numbers("information", arrays["information"], r * d, r * d)
        w = numbers("features", arrays["features"], r, d)
        solution = LowRank(problem, Features(kernel, pivots), information, w)
    _keep(solution, "base_weights", arrays, len(solution.centres), outputs)
    base = kind.of_base(inputs, reference, problem, solution)
    via = numbers("via_inputs", arrays["via_inputs"], "V", inputs.shape[1])
    points = Gaussians(arrays["via_mean"], arrays["via_covariance"])
    check_pairs(via, points, outputs)
    if len(via) == 0:
        return base
    replaced = np.array(arrays["replaced"], dtype=np.intp)
    n = len(inputs)
    if not (replaced.ndim == 1 and np.isin(replaced, np.arange(n)).all() and (np.diff(replaced) > 0).all()):
        raise ValueError(f"replaced: {replaced} given, ascending indices of the {n} base points needed.")
    self = base.changed(replaced, via, points)
    _keep(self.solution, "weights", arrays, len(self.solution.centres), outputs)
    return self


def _kernel(arrays: Mapping[str, NDArray[Any]]) -> Kernel:
    if "channels" not in arrays:
        return GaussianKernel(arrays["ell"])
    if int(arrays["channels"]) != 2:
        raise ValueError(f"channels: {int(arrays['channels'])} given, 2 needed where it is given.")
    return VelocityKernel(float(arrays["ell"]))


def _keep(solution: object, name: str, arrays: Mapping[str, NDArray[Any]], centres: int, outputs: int) -> None:
    solution.__dict__["weights"] = numbers(name, arrays[name], centres, outputs)
