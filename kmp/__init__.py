"""Kernelized movement primitives: robot skills learned from few demonstrations.

They are driven by inputs of any dimension: time, or the positions of two hands.

"The paper" in this package is Huang, Rozo, Silverio, Caldwell: Non-parametric Imitation Learning of
Robot Motor Skills, ICRA 2019; the covariance is from their Kernelized Movement Primitives, IJRR
2019 ("IJRR 2019").

Symbols: s an input (I,), xi an output (O,), (s_n, mu_n, Sigma_n) the N reference points, k the
kernel with parameter ell, K its matrix (N, N), lambda the weight of the penalty, alpha (N, O) the
fitted weights.

The method, in the order in which it computes:

* `alignment`, `mixture`: demonstrations become a reference, `gaussians` at inputs (section II-A).
* `kernel`: k between `functionals`, the values and derivatives of the output. `radial`,
  `time_kernels`: the kernels; `composition`: sums and products of them.
* `problem/`: the reference database with its via-points, and the hyper-parameters.
* `solution`: the solved problem as a protocol. `dense` solves equation (9), `low_rank/` the cost
  (4) on features of the kernel; `representation` chooses between them.
* `query`, `loops/`: equation (8) and its derivatives for one query.
* `predictor`, `primitive`: the class `KMP`.

Beyond the method: `selection` and `criteria/` choose hyper-parameters; `frames` and `superposition`
make primitives and references of several. `reference`, `correlation`, `selection`, `results` and
`sklearn` offer names of their own; `storage` and `named_arrays` write files.
"""

import importlib
import typing

if typing.TYPE_CHECKING:
    from kmp.alignment import aligned as aligned
    from kmp.arrays.checks import RankReached as RankReached
    from kmp.arrays.checks import ViaPointMissed as ViaPointMissed
    from kmp.constraints import LinearConstraints as LinearConstraints
    from kmp.frames import CoordinateFrame as CoordinateFrame
    from kmp.frames import LocalKMP as LocalKMP
    from kmp.gaussians import Gaussians as Gaussians
    from kmp.kernel import Kernel as Kernel
    from kmp.mixture import GaussianMixture as GaussianMixture
    from kmp.orientation import OrientationKMP as OrientationKMP
    from kmp.orientation import PoseKMP as PoseKMP
    from kmp.primitive import KMP as KMP
    from kmp.problem.hyperparameters import AffineMean as AffineMean
    from kmp.radial import GaussianKernel as GaussianKernel
    from kmp.radial import Matern32 as Matern32
    from kmp.radial import Matern52 as Matern52
    from kmp.radial import RadialKernel as RadialKernel
    from kmp.selection import learn as learn
    from kmp.storage import load as load
    from kmp.storage import save as save
    from kmp.superposition import superposed as superposed
    from kmp.time_kernels import PeriodicKernel as PeriodicKernel
    from kmp.time_kernels import VelocityKernel as VelocityKernel

__version__ = "0.1.0"

_NAMES = {
    "alignment": "aligned",
    "arrays.checks": "RankReached ViaPointMissed",
    "constraints": "LinearConstraints",
    "frames": "CoordinateFrame LocalKMP",
    "gaussians": "Gaussians",
    "kernel": "Kernel",
    "mixture": "GaussianMixture",
    "orientation": "OrientationKMP PoseKMP",
    "primitive": "KMP",
    "problem.hyperparameters": "AffineMean",
    "radial": "GaussianKernel Matern32 Matern52 RadialKernel",
    "selection": "learn",
    "storage": "load save",
    "superposition": "superposed",
    "time_kernels": "PeriodicKernel VelocityKernel",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = list(_MODULES)


def __getattr__(name: str) -> typing.Any:
    """A name or a module of this package, which is imported when it is first needed."""
    module = f"kmp.{_MODULES.get(name, name)}"
    try:
        value = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module:
            raise
        raise AttributeError(f"module 'kmp' has no attribute {name!r}") from None
    if name in _MODULES:
        value = globals()[name] = getattr(value, name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
