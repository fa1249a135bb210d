"""Kernelized movement primitives: robot skills learned from few demonstrations.

They are driven by inputs of any dimension: time, or the positions of two hands.

"The paper" in this package is Huang, Rozo, Silverio, Caldwell: Non-parametric Imitation Learning of
Robot Motor Skills, ICRA 2019; the covariance is from their Kernelized Movement Primitives, IJRR
2019 ("IJRR 2019").

Symbols: s an input (I,), xi an output (O,), (s_n, mu_n, Sigma_n) the N reference points, k the
kernel with parameter ell, K its matrix (N, N), lambda the weight of the penalty, alpha (N, O) the
fitted weights.
"""

import typing

from kmp.affine_mean import AffineMean
from kmp.checks import RankReached, ViaPointMissed
from kmp.constraints import LinearConstraints
from kmp.correlation import Correlation, Improvement, improve
from kmp.gaussian_process import gaussian_process_reference
from kmp.gaussians import Gaussians
from kmp.gmm import GaussianMixture
from kmp.kernel import GaussianKernel
from kmp.orientation import OrientationKMP
from kmp.predictor import Uncertainty
from kmp.primitive import KMP
from kmp.query import MotionPrediction
from kmp.references import CoordinateFrame, LocalKMP, superposed
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
