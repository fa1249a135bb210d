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
* `kernel`, `time_kernels`: k between `functionals`, the values and derivatives of the output.
* `problem/`: the reference database with its via-points, and the hyper-parameters.
* `solution`: the solved problem as a protocol. `dense` solves equation (9), `low_rank/` the cost
  (4) on features of the kernel; `representation` chooses between them.
* `query`, `loops/`: equation (8) and its derivatives for one query.
* `predictor`, `primitive`: the class `KMP`.

Beyond the method: `selection` and `criteria/` choose hyper-parameters; `references/` makes
references in other ways; `orientation`, `constraints`, `plot`, `estimator`; `storage` and
`named_arrays` write files.
"""

import typing

from kmp.arrays.checks import RankReached, ViaPointMissed
from kmp.constraints import LinearConstraints
from kmp.gaussians import Gaussians
from kmp.kernel import GaussianKernel
from kmp.mixture import GaussianMixture
from kmp.orientation import OrientationKMP
from kmp.predictor import Uncertainty
from kmp.primitive import KMP
from kmp.problem.hyperparameters import AffineMean
from kmp.query import MotionPrediction
from kmp.references.correlation import Correlation, Improvement, improve
from kmp.references.frames import CoordinateFrame, LocalKMP
from kmp.references.gaussian_process import gaussian_process_reference
from kmp.references.superposition import superposed
from kmp.selection import Learned, Score, learn
from kmp.storage import Stored, load, save
from kmp.time_kernels import PeriodicKernel, VelocityKernel

if typing.TYPE_CHECKING:
    from kmp.estimator import KMPRegressor as KMPRegressor

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
    "Learned",
    "LinearConstraints",
    "LocalKMP",
    "MotionPrediction",
    "OrientationKMP",
    "PeriodicKernel",
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


def __getattr__(name: str) -> typing.Any:
    """`KMPRegressor`, imported when it is first needed, as scikit-learn loads slowly."""
    if name == "KMPRegressor":
        from kmp.estimator import KMPRegressor

        return KMPRegressor
    raise AttributeError(f"module 'kmp' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), "KMPRegressor"])
