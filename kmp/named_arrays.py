"""Values of this package as named arrays, exact to the bit: what their files hold.

The arrays of a primitive have the names of `_NAMES`. Any other value has an array with its kind,
and its fields by name. The names of a value within a value, or of a primitive there, begin with the
field's name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from kmp.arrays.checks import brief, check_kind, check_shape, numbers, positive, real
from kmp.arrays.immutable import frozen
from kmp.composition import ProductKernel, SumKernel
from kmp.constraints import LinearConstraints
from kmp.correlation import Correlation, Improvement
from kmp.frames import CoordinateFrame, LocalKMP
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians, check_pairs, covariances, unchecked
from kmp.kernel import Kernel
from kmp.low_rank import LowRank
from kmp.mixture import GaussianMixture
from kmp.orientation import OrientationKMP, PoseKMP
from kmp.outputs import (
    Mapped,
    as_one,
    constrained,
    constraints_of,
    decoupled_groups,
    inner_problem,
)
from kmp.predictor import Inner, Uncertainty
from kmp.primitive import KMP
from kmp.problem.database import Changes, Database
from kmp.problem.hyperparameters import AffineMean, Hyperparameters
from kmp.query import MotionPrediction
from kmp.radial import GaussianKernel, Matern32, Matern52
from kmp.representation import dense
from kmp.selection import Learned, Score
from kmp.solution import BaseSolution, Solution
from kmp.time_kernels import PeriodicKernel, VelocityKernel

_NAMES = (
    "base_inputs",
    "base_mean",
    "base_covariance",
    "base_weights",
    "via_inputs",
    "via_mean",
    "via_covariance",
    "replaced",
    "weights",
    "lambda_mean",
    "lambda_covariance",
    "prior_mean",
)
_KERNEL = "kernel."  # begin of the names of a kernel's arrays, if `_BY_ELL` lacks it
KIND = "kind"
_CONSTRAINTS = "constraints"  # begin of the names of the constraints' arrays
_OF_CONSTRAINTS = tuple(f"constraints.{name}" for name in (KIND, "inputs", "normals", "bounds"))
_OF_LOW_RANK = ("pivots", "information", "features")
_Some = TypeVar("_Some", bound=Solution)
_KINDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        KMP,
        OrientationKMP,
        PoseKMP,
        LocalKMP,
        CoordinateFrame,
        LinearConstraints,
        AffineMean,
        Gaussians,
        GaussianMixture,
        GaussianKernel,
        VelocityKernel,
        PeriodicKernel,
        Matern32,
        Matern52,
        SumKernel,
        ProductKernel,
        Correlation,
        Improvement,
        Learned,
        Score,
        Uncertainty,
        MotionPrediction,
    )
}
_BY_ELL = (GaussianKernel, VelocityKernel, PeriodicKernel)  # told apart by period and channels


def to_arrays(value: object) -> dict[str, NDArray[Any]]:
    """The arrays for `from_arrays`, by name; of a primitive its base, via-points, fitted weights
    and parameters.

    Raises ValueError if the value is not of this package.
    """
    return _of_primitive(value) if isinstance(value, KMP) else _of_value(value, "")


def from_arrays(
    arrays: Mapping[str, NDArray[Any]], kernels: Mapping[str, type] | None = None
) -> Any:
    """The value of the arrays of `to_arrays`, a primitive with its stored weights.

    `kernels` are the classes of kernels of your own, by name. Other arrays are ignored. `predict`
    and `adapt` of a primitive compute the factors when they first need them, to the same bits with
    the same libraries and kind of processor. Raises ValueError if an array is missing, the kernel
    is unknown, or the arrays do not belong together.
    """
    check_kind("arrays", arrays, Mapping, "what `to_arrays` gives")
    kernels = {} if kernels is None else kernels
    check_kind("kernels", kernels, Mapping, '{"Cauchy": Cauchy}')
    kinds = {**kernels, **_KINDS}
    return _value(arrays, "", kinds) if KIND in arrays else _primitive(arrays, kinds)


def _of_primitive(primitive: KMP) -> dict[str, NDArray[Any]]:
    base = cast(BaseSolution, primitive.base.inner.solution)
    changes = primitive.inner.changes
    solution = primitive.inner.solution
    parameters = base.hyperparameters
    kernel = parameters.kernel
    by_ell = type(kernel) in _BY_ELL
    kernel_arrays = {"ell": np.array(kernel.ell)} if by_ell else _of_value(kernel, _KERNEL)
    arrays = {
        "base_inputs": base.database.inputs,
        "base_mean": base.database.reference.mean,
        "base_covariance": base.database.reference.covariance,
        "base_weights": base.weights,
        "via_inputs": changes.inputs,
        "via_mean": changes.points.mean,
        "via_covariance": changes.points.covariance,
        "replaced": changes.replaced,
        "weights": solution.weights,
        **kernel_arrays,
        "lambda_mean": np.array(parameters.lambda_mean),
        "lambda_covariance": np.array(parameters.lambda_covariance),
        "prior_mean": parameters.prior_columns
        if parameters.prior_matrix.any()
        else parameters.prior_offset,
    }
    if by_ell and kernel.period is not None:
        arrays["period"] = np.array(kernel.period)
    if by_ell and kernel.channels > 1:
        arrays["channels"] = np.array(kernel.channels)
    for name, functionals in (("base", base.database.functionals), ("via", changes.functionals)):
        if functionals.directions is not None:
            arrays[f"{name}_directions"] = functionals.directions
    if parameters.prior_covariance is not None:
        arrays["prior_covariance"] = parameters.prior_covariance
    return arrays | _of_field(constraints_of(solution), _CONSTRAINTS) | base.to_arrays()


def _primitive(arrays: Mapping[str, NDArray[Any]], kinds: Mapping[str, Any]) -> KMP:
    kernel_name = _KERNEL + KIND if _KERNEL + KIND in arrays else "ell"
    names = (*_NAMES, kernel_name) + (_OF_LOW_RANK if "pivots" in arrays else ())
    if missing := [name for name in names if name not in arrays]:
        raise ValueError(
            f"The primitive's arrays lack {', '.join(missing)}. Needed are {', '.join(names)}: "
            "give all that `named_arrays.to_arrays` returned."
        )
    base = _base(arrays, kinds)
    changes = _changes(arrays, base.database)
    constraints = _constraints(arrays, kinds)
    if constraints is not None:
        if base.representation == "low_rank":
            raise ValueError(
                "constraints: given for a low rank solution, a dense one needed. Leave out the "
                "arrays of either."
            )
        base = _weighted(as_one(base), "base_weights", arrays)
    solution: Solution = base
    if len(changes.inputs):
        solution = base.adapted(changes)
    if constraints is not None:
        solution = constrained(solution, constraints)
    unadapted = KMP(Inner.of_base(base))
    if solution is base:
        return unadapted
    return KMP(
        Inner(_weighted(solution, "weights", arrays), changes, unadapted.inner.count), unadapted
    )


def _constraints(
    arrays: Mapping[str, NDArray[Any]], kinds: Mapping[str, Any]
) -> LinearConstraints | None:
    if not any(name.startswith(_CONSTRAINTS) for name in arrays):
        return None
    if missing := [name for name in _OF_CONSTRAINTS if name not in arrays]:
        raise ValueError(
            f"The primitive's arrays lack {', '.join(missing)}: give all of "
            f"{', '.join(_OF_CONSTRAINTS)}, or none."
        )
    constraints = _value(arrays, f"{_CONSTRAINTS}.", kinds)
    check_kind(_OF_CONSTRAINTS[0], constraints, LinearConstraints, "inputs, normals, bounds")
    return cast(LinearConstraints, constraints)


def _base(arrays: Mapping[str, NDArray[Any]], kinds: Mapping[str, Any]) -> BaseSolution:
    inputs = numbers("base_inputs", arrays["base_inputs"], "N", "I")
    reference = _normals("base", arrays)
    check_pairs("base_mean", inputs, reference, reference.outputs)
    prior = real("prior_mean", arrays["prior_mean"])
    if prior.ndim == 2:
        check_shape("prior_mean", prior, reference.outputs, 1 + inputs.shape[1])
    parameters = Hyperparameters.checked(
        _kernel(arrays, kinds),
        positive("lambda_mean", arrays["lambda_mean"]),
        positive("lambda_covariance", arrays["lambda_covariance"]),
        AffineMean(prior[:, 1:], prior[:, 0]) if prior.ndim == 2 else prior,
        arrays.get("prior_covariance"),
        inputs=inputs.shape[1],
        outputs=reference.outputs,
    )
    database = Database(Functionals.checked(inputs, arrays.get("base_directions")), reference)
    if "output_map" not in arrays:
        return _weighted(_plain(parameters, database, arrays), "base_weights", arrays)
    t = numbers("output_map", arrays["output_map"], reference.outputs, reference.outputs)
    inner = _plain(*inner_problem(parameters, database, t), arrays)
    return _weighted(Mapped.around(parameters, database, t, inner), "base_weights", arrays)


def _plain(
    parameters: Hyperparameters, database: Database, arrays: Mapping[str, NDArray[Any]]
) -> BaseSolution:
    """The solution without its outputs' map."""
    if "pivots" not in arrays:
        return dense(parameters, database)
    information = real("information", arrays["information"])
    groups = decoupled_groups(parameters, database.reference, alike=False)
    if len(groups) == 1:
        return LowRank.of_arrays(parameters, database, arrays)
    check_shape("information", information, len(groups), "r", "r")
    features = numbers("features", arrays["features"], "r", parameters.channel_outputs)

    def part(of: Hyperparameters, points: Database, group: NDArray[np.intp]) -> LowRank:
        part_arrays = {"information": information[group[0]], "features": features[:, group[:1]]}
        return LowRank.of_arrays(of, points, {**arrays, **part_arrays})

    return Mapped.of_groups(parameters, database, groups, part)


def _changes(arrays: Mapping[str, NDArray[Any]], database: Database) -> Changes:
    via = numbers("via_inputs", arrays["via_inputs"], "V", database.inputs.shape[1])
    points = _normals("via", arrays)
    check_pairs("via_mean", via, points, database.reference.outputs)
    replaced = real("replaced", arrays["replaced"])
    n = len(database)
    if not (
        replaced.ndim == 1
        and np.isin(replaced, np.arange(n)).all()
        and (np.diff(replaced) > 0).all()
    ):
        raise ValueError(
            f"replaced: {brief(arrays['replaced'])} given, ascending indices of the {n} base "
            "points needed."
        )
    return Changes(
        frozen(replaced.astype(np.intp)),
        Functionals.checked(via, arrays.get("via_directions")),
        points,
    )


def _normals(of: str, arrays: Mapping[str, NDArray[Any]]) -> Gaussians:
    mean = numbers(f"{of}_mean", arrays[f"{of}_mean"], "N", "O")
    return unchecked(mean, covariances(f"{of}_covariance", arrays[f"{of}_covariance"], *mean.shape))


def _weighted(solution: _Some, name: str, arrays: Mapping[str, NDArray[Any]]) -> _Some:
    parameters = solution.hyperparameters
    return solution.with_weights(
        numbers(name, arrays[name], len(solution.centres), parameters.outputs)
    )


def _kernel(arrays: Mapping[str, NDArray[Any]], kinds: Mapping[str, Any]) -> Kernel:
    if _KERNEL + KIND in arrays:
        return cast(Kernel, _value(arrays, _KERNEL, kinds))
    if "period" in arrays:
        return PeriodicKernel(positive("ell", arrays["ell"]), positive("period", arrays["period"]))
    if "channels" not in arrays:
        return GaussianKernel(arrays["ell"])
    if (channels := positive("channels", arrays["channels"])) != 2:
        raise ValueError(f"channels: {channels:g} given, 2 needed where it is given.")
    return VelocityKernel(positive("ell", arrays["ell"]))


def _of_value(value: object, prefix: str) -> dict[str, NDArray[Any]]:
    kind = type(value).__name__
    if _KINDS.get(kind) is not type(value):
        if not hasattr(value, "prior_variance"):
            raise ValueError(f"value: {kind} given, one of {', '.join(_KINDS)} needed.")
        _check_restorable(value)
    arrays = {prefix + KIND: np.array(kind)}
    if isinstance(value, KMP):
        return arrays | {prefix + name: array for name, array in _of_primitive(value).items()}
    for name in _fields(value):
        arrays |= _of_field(getattr(value, name), prefix + name)
    return arrays


def _check_restorable(kernel: object) -> None:
    """Raise ValueError unless a user's kernel can be made again of its name and fields."""
    kind = type(kernel)
    names = _fields(kind)
    # a cached property is an attribute of the class, too
    hidden = [name for name in vars(kernel) if name not in names and not hasattr(kind, name)]
    if not names or hidden or kind.__name__ in _KINDS:
        raise ValueError(
            f"kernel: no file restores {kind.__name__}. Derive it from RadialKernel, by a new "
            f"name and with a dataclass field for each of {', '.join(hidden or names)}."
        )


def _value(arrays: Mapping[str, NDArray[Any]], prefix: str, kinds: Mapping[str, Any]) -> Any:
    name = str(arrays[prefix + KIND])
    kind = kinds.get(name)
    if kind is None:
        raise ValueError(
            f"{prefix}{KIND}: {name:.60} given, one of {', '.join(kinds)} needed. Load your "
            f'own kernel with kernels={{"{name:.60}": its class}}.'
        )
    if kind is KMP:
        return _primitive(
            {name[len(prefix) :]: arrays[name] for name in arrays if name.startswith(prefix)}, kinds
        )
    names = set(_fields(kind))
    if prefix.startswith(_KERNEL):  # all that is stored, so that no parameter is lost
        names = {key[len(prefix) :].split(".")[0] for key in arrays if key.startswith(prefix)}
    return kind(**{name: _field(arrays, prefix + name, kinds) for name in names - {KIND}})


def _fields(kind: Any) -> tuple[str, ...]:
    return (
        tuple(field.name for field in fields(kind))
        if is_dataclass(kind)
        else getattr(kind, "_fields", ())
    )


def _of_field(value: object, name: str) -> dict[str, NDArray[Any]]:
    if value is None:
        return {}
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        parts = [_of_field(part, f"{name}.{i}") for i, part in enumerate(value)]
        return {f"{name}.count": np.array(len(value))} | {
            key: array for part in parts for key, array in part.items()
        }
    if isinstance(value, (np.ndarray, float, int, str)):
        return {name: np.array(value)}
    return _of_value(value, f"{name}.")


def _field(arrays: Mapping[str, NDArray[Any]], name: str, kinds: Mapping[str, Any]) -> Any:
    if name in arrays:
        array = np.array(arrays[name])
        return frozen(array) if array.ndim else array.item()
    if f"{name}.count" in arrays:
        count = int(arrays[f"{name}.count"])
        return tuple(_field(arrays, f"{name}.{i}", kinds) for i in range(count))
    return _value(arrays, f"{name}.", kinds) if f"{name}.{KIND}" in arrays else None
