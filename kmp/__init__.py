"""Kernelized movement primitives: robot skills learned from few demonstrations.

They are driven by inputs of any dimension: time, or the positions of two hands.

"The paper" in this package is Huang, Rozo, Silverio, Caldwell: Non-parametric Imitation Learning of
Robot Motor Skills, ICRA 2019; the covariance is from their Kernelized Movement Primitives, IJRR
2019 ("IJRR 2019").

Symbols: s an input (I,), xi an output (O,), (s_n, mu_n, Sigma_n) the N reference points, k the
kernel with parameter ell, K its matrix (N, N), lambda the weight of the penalty, alpha (N, O) the
fitted weights.

The method, in the order in which it computes:

* `mixture`: demonstrations become a reference, `gaussians` at inputs (section II-A).
* `kernel`: k between `functionals`, the values and derivatives of the output. `radial`,
  `time_kernels`: the kernels; `composition`: sums and products of them.
* `problem/`: the reference database with its via-points, and the hyper-parameters.
* `solution`: the solved problem as a protocol. `dense` solves equation (9), `low_rank/` the cost
  (4) on features of the kernel; `representation` chooses between them.
* `query`, `loops/`: equation (8) and its derivatives for one query.
* `predictor`, `primitive`: the class `KMP`.

Beyond the method: `selection` and `criteria/` choose hyper-parameters; `references/` makes
references in other ways; `orientation`, `constraints`, `plot`, `estimator`; `storage` and
`named_arrays` write files.
"""

import importlib
import typing

if typing.TYPE_CHECKING:
    from kmp.arrays.checks import RankReached, ViaPointMissed
    from kmp.constraints import LinearConstraints
    from kmp.estimator import KMPRegressor as KMPRegressor
    from kmp.gaussians import Gaussians
    from kmp.kernel import Kernel
    from kmp.mixture import GaussianMixture
    from kmp.orientation import OrientationKMP, PoseKMP
    from kmp.predictor import Uncertainty
    from kmp.primitive import KMP
    from kmp.problem.hyperparameters import AffineMean
    from kmp.query import MotionPrediction
    from kmp.radial import GaussianKernel, Matern32, Matern52, RadialKernel
    from kmp.references.correlation import Correlation, Improvement, improve
    from kmp.references.frames import CoordinateFrame, LocalKMP
    from kmp.references.gaussian_process import gaussian_process_reference
    from kmp.references.superposition import superposed
    from kmp.selection import Learned, Score, learn
    from kmp.storage import Stored, load, save
    from kmp.time_kernels import PeriodicKernel, VelocityKernel

__version__ = "0.1.0"

__all__ = [
    "KMP",
    "AffineMean",
    "CoordinateFrame",
    "Correlation",
    "GaussianKernel",
    "GaussianMixture",
    "Gaussians",
    "Improvement",
    "Kernel",
    "Learned",
    "LinearConstraints",
    "LocalKMP",
    "Matern32",
    "Matern52",
    "MotionPrediction",
    "OrientationKMP",
    "PeriodicKernel",
    "PoseKMP",
    "RadialKernel",
    "RankReached",
    "Score",
    "Stored",
    "Uncertainty",
    "VelocityKernel",
    "ViaPointMissed",
    "gaussian_process_reference",
    "improve",
    "learn",
    "load",
    "save",
    "superposed",
]


_MODULES = {
    "AffineMean": "kmp.problem.hyperparameters",
    "CoordinateFrame": "kmp.references.frames",
    "Correlation": "kmp.references.correlation",
    "GaussianKernel": "kmp.radial",
    "GaussianMixture": "kmp.mixture",
    "Gaussians": "kmp.gaussians",
    "Improvement": "kmp.references.correlation",
    "KMP": "kmp.primitive",
    "KMPRegressor": "kmp.estimator",
    "Kernel": "kmp.kernel",
    "Learned": "kmp.selection",
    "LinearConstraints": "kmp.constraints",
    "LocalKMP": "kmp.references.frames",
    "Matern32": "kmp.radial",
    "Matern52": "kmp.radial",
    "MotionPrediction": "kmp.query",
    "OrientationKMP": "kmp.orientation",
    "PeriodicKernel": "kmp.time_kernels",
    "PoseKMP": "kmp.orientation",
    "RadialKernel": "kmp.radial",
    "RankReached": "kmp.arrays.checks",
    "Score": "kmp.selection",
    "Stored": "kmp.storage",
    "Uncertainty": "kmp.predictor",
    "VelocityKernel": "kmp.time_kernels",
    "ViaPointMissed": "kmp.arrays.checks",
    "gaussian_process_reference": "kmp.references.gaussian_process",
    "improve": "kmp.references.correlation",
    "learn": "kmp.selection",
    "load": "kmp.storage",
    "save": "kmp.storage",
    "superposed": "kmp.references.superposition",
}


def __getattr__(name: str) -> typing.Any:
    """A name or a module of this package, which is imported when it is first needed."""
    if name not in _MODULES:
        try:
            return importlib.import_module(f"kmp.{name}")
        except ModuleNotFoundError:
            raise AttributeError(f"module 'kmp' has no attribute {name!r}") from None
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
