"""Every public call of the package, with wrong values for one argument at a time.

Each call ends in a ValueError that names the argument and the accepted values, in words that are
not NumPy's. Calls that may be legal, such as those with huge numbers, may also succeed.
"""

import inspect
import re

import numpy as np
import pytest
from matplotlib.figure import Figure

import kmp
from kmp import (
    KMP,
    AffineMean,
    CoordinateFrame,
    GaussianKernel,
    GaussianMixture,
    Gaussians,
    LinearConstraints,
    LocalKMP,
    Matern32,
    Matern52,
    OrientationKMP,
    PeriodicKernel,
    PoseKMP,
    VelocityKernel,
    named_arrays,
    orientation,
)
from kmp.correlation import Correlation, improve
from kmp.reference import gaussian_process_reference
from kmp.sklearn import KMPRegressor
from support.primitives import offered

S = np.random.default_rng(0).normal(size=(6, 2))
R = Gaussians(S, np.tile(0.01 * np.eye(2), (6, 1, 1)))
K = GaussianKernel(1.0)
ONE = KMP.fit(S, R, kernel=K, lambda_mean=1.0)
TAUGHT = ONE.adapt(S[:1] + 9, R[:1])
LOW = KMP.fit(S, R, kernel=K, lambda_mean=1.0, representation="low_rank").adapt(
    S[:1], R[:1], tolerance=0.1
)
Q = np.tile([0.0, 0.0, 0.0, 1.0], (6, 1))
ZETA = Gaussians(0.1 * S @ np.eye(2, 3), np.tile(0.01 * np.eye(3), (6, 1, 1)))
TURNING = OrientationKMP(KMP.fit(S, ZETA, kernel=K, lambda_mean=1.0), Q[0])
T = np.linspace(0, 1, 6)[:, None]
SIX = Gaussians(np.hstack([ZETA.mean, ZETA.mean]), np.tile(0.01 * np.eye(6), (6, 1, 1)))
IN_TIME = KMP.fit(T, SIX, kernel=VelocityKernel(1.0), lambda_mean=1.0).adapt(
    T[:1], SIX[:1], tolerance=0.1
)
POSE = PoseKMP(
    KMP.fit(S, Gaussians.of(np.tile(ZETA.mean, 2), deviation=0.1), kernel=K, lambda_mean=1.0), Q[0]
)
TURNING_IN_TIME = OrientationKMP(IN_TIME, Q[0])
FRAME = CoordinateFrame.at([0.0, 1.0])
PAIRS = [(S, S + 0.1 * i) for i in range(2)]
FRAMES = [(FRAME, CoordinateFrame.at([0.1 * i, 0.0])) for i in range(2)]
MIXTURE = GaussianMixture.fit(np.hstack([S, S]), components=2, seed=0)
NEUTRAL = Correlation.neutral(S[:2], width=1.0, outputs=2)
LIMITS = LinearConstraints(S[:2], S[:2], np.full(2, -9.0))
LEARN = {"components": 2, "seed": 0, "kernel": K, "lambda_mean": 1.0, "lambda_covariance": 1.0}
LOCAL = LocalKMP.learn(PAIRS, FRAMES, S, **LEARN)
LEARNED = kmp.learn(PAIRS, count=5, **LEARN)
IMPROVE = {"correlation": NEUTRAL, "exploration": 0.1, "updates": 1, "rollouts": 2, "seed": 0}


def regressor(*, ell, lambda_mean, lambda_covariance, noise, components, random_state):
    """scikit-learn checks a parameter when it is used, so the estimator is fitted too."""
    arguments = locals()
    return KMPRegressor(**arguments).fit(S, S).predict(S, return_std=True)


# Right arguments of each public callable.
RIGHT = {
    Gaussians: {"mean": R.mean, "covariance": R.covariance},
    Gaussians.of: {"mean": R.mean, "deviation": np.ones(2)},
    R.affine: {"matrix": np.eye(2), "offset": np.zeros(2)},
    Gaussians.concatenated: {"parts": [R, R]},
    GaussianMixture: {
        "weights": np.ones(1),
        "means": np.zeros((1, 2)),
        "covariances": np.eye(2)[None],
    },
    GaussianMixture.fit: {
        "samples": np.hstack([S, S]),
        "components": 2,
        "seed": 0,
        "regularization": 1e-6,
    },
    MIXTURE.regress: {"inputs": S},
    MIXTURE.sample_inputs: {"count": 3, "dimensions": 2, "seed": 0},
    GaussianKernel: {"ell": np.ones(2)},
    Matern32: {"ell": np.ones(2)},
    Matern52: {"ell": np.ones(2)},
    PeriodicKernel: {"ell": 1.0, "period": 2.0},
    VelocityKernel: {"ell": 1.0},
    KMP.fit: {
        "inputs": S,
        "reference": R,
        "kernel": K,
        "lambda_mean": 1.0,
        "lambda_covariance": 2.0,
        "prior_covariance": [1.0, 2.0],
        "prior_mean": np.zeros(2),
        "directions": np.zeros((6, 2)),
        "representation": "low_rank",
        "rank": 10,
        "rank_tolerance": 1e-9,
    },
    ONE.adapt: {
        "inputs": S[:2],
        "desired": R[:2],
        "tolerance": 0.1,
        "directions": np.zeros((2, 2)),
    },
    TAUGHT.without_via_points: {"inputs": S[:1] + 9, "tolerance": 0.1},
    TAUGHT.goal_jacobian: {"queries": S},
    ONE.adapt_many: {"points": [(S[:2], R[:2]), (S[2:3], R[2:3])], "tolerance": 0.1},
    ONE.with_lambda_covariance: {"lambda_covariance": 2.0},
    ONE.via_point_reach: {"query": S[0], "share": 0.5},
    ONE.save: {"path": "other.npz", "input_unit": "m", "output_unit": "m"},
    KMP.load: {"path": "skill.npz", "kernels": {}},
    ONE.adapt_jacobian: {"inputs": S[:1], "jacobians": np.eye(2)[None], "deviation": 0.1},
    ONE.constrained: {"constraints": LIMITS},
    ONE.refitted: {"reference": R},
    named_arrays.from_arrays: {"arrays": named_arrays.to_arrays(LOW), "kernels": {}},
    ONE.mean: {"queries": S},
    LOW.mean: {"queries": S[:1]},
    ONE.predict: {"queries": S},
    LOW.predict: {"queries": S[:1]},
    ONE.predict_joint: {"queries": S},
    ONE.sample: {"queries": S, "count": 2, "seed": 0},
    ONE.predict_motion: {"query": S[0], "velocity": S[1], "acceleration": S[2]},
    ONE.jacobian: {"query": S[0]},
    ONE.jacobians: {"queries": S},
    ONE.uncertainty: {"queries": S},
    LinearConstraints: {"inputs": S, "normals": S, "bounds": S[:, 0], "directions": S},
    LIMITS.joined: {"other": LIMITS},
    Correlation: {"centres": S, "width": 1.0, "theta": S},
    Correlation.neutral: {"centres": S, "width": 1.0, "outputs": 2},
    NEUTRAL.__call__: {"inputs": S},
    NEUTRAL.applied: {"primitive": ONE},
    improve: {
        "primitive": ONE,
        "reward": lambda path: -float(path.sum()),
        "queries": S,
        **IMPROVE,
    },
    AffineMean: {"matrix": np.eye(2), "offset": np.zeros(2)},
    CoordinateFrame: {"matrix": np.eye(2), "offset": np.zeros(2)},
    CoordinateFrame.at: {"origin": np.zeros(2)},
    CoordinateFrame.start_and_goal: {"path": S},
    FRAME.local: {"points": S},
    FRAME.localised: {"normals": R},
    FRAME.placed: {"normals": R},
    LocalKMP: {"primitives": LOCAL.primitives, "frames": FRAMES[0]},
    LocalKMP.learn: {
        "demonstrations": PAIRS,
        "frames": FRAMES,
        "inputs": S,
        **LEARN,
        "regularization": 1e-6,
    },
    LOCAL.placed: {"frames": FRAMES[0]},
    LOCAL.mean: {"queries": S},
    LOCAL.predict: {"queries": S},
    LOCAL.adapt: {"inputs": S[:1], "desired": R[:1], "frame": 0, "tolerance": 0.1},
    LOCAL.jacobian: {"query": S[0]},
    LOCAL.predict_motion: {
        "query": S[0],
        "velocity": S[1],
        "acceleration": S[2],
    },
    LOCAL.sample: {"queries": S, "count": 2, "seed": 0},
    LOCAL.uncertainty: {"queries": S},
    orientation.rotation_rate_per_zeta: {"zeta": [0.1, 0.2, 0.3], "rate": [1.0, 0.0, 2.0]},
    PoseKMP: {"primitive": POSE.primitive, "auxiliary": Q[0]},
    OrientationKMP: {"primitive": TURNING.primitive, "auxiliary": Q[0]},
    TURNING.mean: {"queries": S},
    TURNING.predict: {"queries": S},
    TURNING.jacobian: {"query": S[0]},
    TURNING.predict_motion: {
        "query": S[0],
        "velocity": S[1],
        "acceleration": S[2],
    },
    TURNING.sample: {"queries": S, "count": 2, "seed": 0},
    TURNING.uncertainty: {"queries": S},
    TURNING_IN_TIME.adapt: {
        "inputs": T[:2],
        "desired": Q[:2],
        "covariance": 0.01 * np.eye(3),
        "tolerance": 0.1,
        "velocities": np.zeros((2, 3)),
        "velocity_covariance": np.eye(3),
    },
    orientation.continuous: {"quaternions": Q},
    orientation.multiplied: {"a": Q, "b": Q},
    orientation.log: {"quaternions": Q, "auxiliary": Q[0]},
    orientation.exp: {"zeta": ZETA.mean, "auxiliary": Q[0]},
    orientation.rotation_per_zeta: {"zeta": ZETA.mean[0]},
    gaussian_process_reference: {
        "demonstrations": PAIRS,
        "inputs": S,
        "count": 12,
        "regularization": 1e-6,
    },
    kmp.aligned: {"demonstrations": [(T, S)], "velocity": False},
    kmp.superposed: {"references": [R, R], "priorities": np.full((2, 6), 0.5)},
    kmp.learn: {
        "demonstrations": PAIRS,
        "count": 5,
        "velocity": False,
        "regularization": 1e-6,
        "points": "shown",
        "criterion": "likelihood",
        "scales": "one",
        **LEARN,
    },
    kmp.save: {"path": "skill.npz", "value": ONE, "input_unit": "m", "output_unit": "m"},
    kmp.load: {"path": "skill.npz", "kernels": {}},
    LEARNED.report: {"count": 3},
    regressor: {
        "ell": np.ones(2),
        "lambda_mean": 1.0,
        "lambda_covariance": 2.0,
        "noise": 0.1,
        "components": 2,
        "random_state": 0,
    },
    ONE.plot: {
        "queries": S,
        "plane": (0, 1),
        "axes": Figure().subplots(),
        "label": "mean",
        "outputs": ["x", "y"],
        "input_unit": "s",
        "output_unit": "m",
    },
}
# Not tested: the variable arguments `others`, indices as in NumPy, and arguments used as booleans.
LEFT_OUT = {
    ("product", "others"),
    ("take", "index"),
    ("__getitem__", "index"),
    ("predict_motion", "covariance"),
}
MADE_BY_THE_PACKAGE = {
    "Improvement",
    "Learned",
    "MotionPrediction",
    "Score",
    "Stored",
    "Uncertainty",
    "KMP",
    "Kernel",
    "RadialKernel",
}
OF_THE_KERNEL = {
    "profile",
    "first_derivative",
    "second_derivative",
    "third_derivative",
    "third",
    "check",
    "coordinates",
    "variances",
    "values",
    "blocks",
    "row",
    "jacobian",
    "curvature",
}

OF_KNOWN_COLUMNS = {"queries", "query", "velocity", "acceleration", "offset"}
WRONG_COLUMNS = {0, 1}  # indices in the second list of `wrong_arrays`: one column more, none
OF_ANY_SIZE = {GaussianKernel, Matern32, Matern52, Gaussians.of, regressor}
OPTIONAL = {
    "kernels",
    "lambda_covariance",
    "prior_covariance",
    "prior_mean",
    "directions",
    "velocities",
    "frame",
    "velocity_covariance",
}
WHOLE = {"components", "count", "rank", "dimensions", "updates", "rollouts", "outputs"}
LONGEST = 450  # [characters] of a message
NO_NUMBERS = [
    None,
    "text",
    b"bytes",
    object(),
    object,
    {},
    {"a": 1.0},
    {1.0},
    [["a"]],
    [[1.0], [1.0, 2.0]],
    1j,
    [1j],
    lambda: 0.0,
    np.array("1"),
    np.array([None]),
    np.datetime64("2020-01-01"),
    [{}],
    10**400,
    [[[]]],
    slice(2),
]
NO_SCALARS = [
    *NO_NUMBERS,
    np.nan,
    np.inf,
    -np.inf,
    -1.0,
    [1.0],
    [],
    np.ones(2),
    np.ones((1, 1)),
    [True],
]
NUMPYS = re.compile(
    "broadcast|could not|ambiguous|inhomogeneous|ufunc|reshape|matmul|dimension mismatch|out of "
    "bounds|unpack|core dimension|concatenat|index|iterable|has no "
    "attr|unsupported|convert|stack|Object arrays|not callable"
)

ACCEPTED = re.compile(r"\b(needed|needs?|must|enough|[Gg]ive|[Dd]ivide|[Ff]it|takes?|[Ss]ave)\b")


def wrong_arrays(array):
    """Values that are wrong for an array of this shape, and values that may work."""
    spoilt = np.array(array, dtype=float)
    spoilt.flat[0] = np.inf
    wrong = [
        *NO_NUMBERS,
        spoilt * 0,
        spoilt,
        -spoilt,
        array[None],
        array[..., None],
        1.0,
        [],
        array * 1j,
    ]
    wrong += [
        np.array(array, dtype=str),
        np.array(array, dtype=object),
        np.zeros((*array.shape, 0)),
    ]
    other = [
        np.concatenate([array, array[..., :1]], axis=-1),
        array[..., :0],
        array[:0],
        array[:-1],
        array[0],
    ]
    huge = [
        1e308 * np.sign(array),
        1e160 * array,
        1e200 * array,
        np.full(array.shape, 1e155),
        1e-308 * array,
        -array,
        0 * array,
        array > 0,
        array.tolist(),
    ]
    return wrong, [*other, *huge]


def wrong_values(name, right):  # noqa: C901, PLR0912 - a case for each kind
    """Values that are wrong for an argument like this, and values that may work."""
    if name in {"seed", "random_state"}:
        return [*NO_SCALARS, 1.5, True, 2**40], [0, np.int64(3), np.random.default_rng(0)]
    if name == "frame":
        return [value for value in NO_SCALARS if value is not None] + [1.5, True, 9], [0]
    if name in WHOLE:
        return [*NO_SCALARS, 1.5, 0, True, np.array(2.0)], [1, np.int64(2)]
    if name == "tolerance":
        return [value for value in NO_SCALARS if value is not None and value is not np.inf], [
            1e308,
            np.inf,
            0,
            True,
        ]
    if isinstance(right, float):
        return [*NO_SCALARS, 0.0], [1e308, 1e200, 1e-308, True, np.array(1.0), 1e-160]
    if isinstance(right, np.ndarray):
        return wrong_arrays(right)
    objects = [*NO_NUMBERS, 1.0, -1, True, np.nan, S, [S], [], [None], R[:0], GaussianKernel, KMP]
    if isinstance(right, Gaussians):
        others = [R[:1], ZETA, ZETA[:1], [R], Gaussians.concatenated([R, R])]
        return [value for value in objects if not isinstance(value, Gaussians)], [*others, R[:0]]
    if name == "kernel":
        return [
            *objects,
            GaussianKernel([1.0, 2.0, 3.0]),
            VelocityKernel(1.0),
            PeriodicKernel(1.0, 1.0),
            R,
        ], []
    if name in {"path", "input_unit", "output_unit", "label"}:
        return [value for value in objects if not isinstance(value, (str, bytes))], []
    if name == "value":
        return [*NO_NUMBERS, 1.0, True, S, [], [ONE], KMP], []
    if name == "kernels":
        return [value for value in objects if not isinstance(value, dict)], []
    if name == "arrays":
        return [*objects, [("ell", 1.0)]], []
    if name == "reward":
        bad = (None, "text", np.nan, np.inf, 1j, S, [1.0, 2.0], object())
        return [value for value in objects if not callable(value)] + [
            lambda path, one=value: one for value in bad
        ], []
    return [
        *objects,
        np.zeros((2, 6, 2)),
        "sparse",
        ["dense"],
        np.array(["dense"]),
        FRAME,
        K,
        (FRAME,),
        (FRAME, R),
        R,
    ], []


def is_infinite(value):
    return isinstance(value, np.ndarray) and value.dtype.kind == "f" and (value == np.inf).any()


def calls():
    """Each call: function, name of the argument, right arguments, wrong value, and True if it must
    fail.
    """
    for function, right in RIGHT.items():
        for name, value in right.items():
            wrong, other = wrong_values(name, value)
            # CoordinateFrame names its matrix
            must_fail = name in OF_KNOWN_COLUMNS and function is not CoordinateFrame
            for candidate in wrong:
                if function in OF_ANY_SIZE and isinstance(candidate, float):
                    continue  # one number for all inputs is right
                if function == Gaussians.of and name == "deviation" and is_infinite(candidate):
                    continue  # a free output
                if function is regressor and name == "components" and candidate is None:
                    continue  # None: each sample is a reference point
                if candidate is None and (
                    (name in OPTIONAL and function != ONE.with_lambda_covariance)
                    or function == ONE.plot
                    or (function is kmp.learn and name in {"kernel", "lambda_mean"})
                ):
                    continue
                if name == "velocity" and candidate is True:
                    continue
                yield function, name, right, candidate, True
            for place, candidate in enumerate(other):
                yield function, name, right, candidate, must_fail and place in WRONG_COLUMNS


def fault(function, name, right, value, must_fail):
    """The fault of a call's result or error; None if there is none."""
    call = f"{getattr(function, '__qualname__', function)}({name}={str(value)[:60]!r})"
    try:
        function(**(right | {name: value}))
    except ValueError as error:
        message = str(error)
        near = [*right, "lost in rounding", "to working precision"]  # faults of combinations
        named = any(re.search(rf"\b{word}\b", message) for word in ([name] if must_fail else near))
        if not named:
            return f"{call} does not name it: {message[:150]}"
        if len(message) > LONGEST:
            return f"{call} says {len(message)} characters: {message[:150]}"
        if not ACCEPTED.search(message):
            return f"{call} does not say what is accepted: {message[:150]}"
        return f"{call} speaks NumPy: {message[:150]}" if NUMPYS.search(message) else None
    except OSError:
        return None if name == "path" else f"{call} ends in an OSError"
    except Exception as error:
        return f"{call} ends in {type(error).__name__}: {str(error)[:150]}"
    return f"{call} works" if must_fail else None


@pytest.mark.filterwarnings("ignore")
def test_wrong_call_names_its_argument(tmp_path, monkeypatch):
    """Every wrong call raises a ValueError that names the argument."""
    monkeypatch.chdir(tmp_path)
    kmp.save("skill.npz", ONE, input_unit="m", output_unit="m")
    wrong_calls = list(calls())
    assert len(wrong_calls) > 4000
    faults = [said for call in wrong_calls if (said := fault(*call))]
    assert not faults, f"{len(faults)} of {len(wrong_calls)}:\n" + "\n".join(faults)


def test_each_right_call_works(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ONE.save("skill.npz")
    for function, right in RIGHT.items():
        function(**right)


def public():
    """Each public callable of the package, by type and name, and its parameters."""
    for name, member in offered().items():
        if not inspect.isclass(member):
            yield "", name, inspect.signature(member).parameters
        elif not issubclass(member, Warning):
            if name not in MADE_BY_THE_PACKAGE:
                yield name, name, inspect.signature(member).parameters
            for part, value in inspect.getmembers(member, callable):
                if not part.startswith("_") and not (
                    ("Kernel" in name or "Matern" in name) and part in OF_THE_KERNEL
                ):
                    yield name, part, inspect.signature(value).parameters
    for name, member in inspect.getmembers(orientation, inspect.isfunction):
        if not name.startswith("_") and member.__module__ == orientation.__name__:
            yield "", name, inspect.signature(member).parameters


def test_every_public_argument_is_tested():
    """All are in `RIGHT` or left out explicitly."""
    tested = {(function.__name__, name) for function, right in RIGHT.items() for name in right}
    lacking = set()
    for of, name, parameters in public():
        if not of.startswith(("Motion", "Stored")):
            lacking |= {(name, parameter) for parameter in parameters if parameter != "self"}
    assert lacking - tested - LEFT_OUT == set()


@pytest.mark.parametrize(
    "primitive", [LOW, ONE.adapt(S[:1], R[:1], tolerance=0.1), IN_TIME], ids=str
)
def test_every_array_that_is_spoilt_is_named(primitive):
    arrays = named_arrays.to_arrays(primitive)
    faults = []
    for name, array in arrays.items():
        for value in [
            None,
            "text",
            object(),
            {},
            np.full(array.shape, np.nan),
            np.full(array.shape, 1e200),
            np.array(array, dtype=object),
            array[None],
            array[None, None],
        ]:
            may_work = (
                np.ndim(array) == 0
                and value is not None
                and np.size(value) == 1
                and np.any(value == 1e200)
            )
            loader = lambda **given: named_arrays.from_arrays(arrays | given)  # noqa: E731
            finding = fault(loader, name, {name: array}, value, not may_work)
            faults += [finding] if finding else []
    assert not faults, "\n".join(faults)
