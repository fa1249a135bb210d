"""Properties of every type: storage in a file, read-only arrays, and a short repr."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest

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
)
from kmp.arrays.immutable import Immutable
from kmp.correlation import Correlation, improve
from kmp.storage import checksum
from support.primitives import offered, same_bits

S = np.random.default_rng(0).normal(size=(20, 2))
R = Gaussians.of(S, deviation=0.1)
EYES = np.tile(0.01 * np.eye(3), (20, 1, 1))
K = GaussianKernel(1.0)
ONE = KMP.fit(S, R, kernel=K, lambda_mean=1.0)
CONSTRAINED = ONE.constrained(LinearConstraints(S[:3], S[:3], np.zeros(3)))
TURNING = OrientationKMP(
    KMP.fit(S, Gaussians(0.1 * S @ np.eye(2, 3), EYES), kernel=K, lambda_mean=1.0), [0, 0, 0, 1]
)
POSE = PoseKMP(
    KMP.fit(S, Gaussians.of(0.1 * S @ np.eye(2, 6), deviation=0.1), kernel=K, lambda_mean=1.0),
    [0, 0, 0, 1],
)
DEMONSTRATIONS = [(S, S + 0.1 * i) for i in range(3)]
FRAMES = [(CoordinateFrame.at([0.1 * i, 0]), CoordinateFrame.at([0, 1])) for i in range(3)]
LOCAL = LocalKMP.learn(DEMONSTRATIONS, FRAMES, S, kernel=K, lambda_mean=1.0, components=2, seed=0)
NEUTRAL = Correlation.neutral(S[:2], width=1.0, outputs=2)
LEARNED = kmp.learn(DEMONSTRATIONS, components=2, seed=0, count=20, kernel=K, lambda_mean=1.0)
IMPROVED = improve(
    ONE,
    lambda x: -float(x.sum()),
    S[:3],
    correlation=NEUTRAL,
    exploration=0.1,
    updates=1,
    rollouts=2,
    seed=0,
)
VELOCITY = VelocityKernel(1.5)
VELOCITY.prior_variance  # noqa: B018  (it is remembered)
RATED = Gaussians(np.hstack([np.sin(S[:, :1]), np.cos(S[:, :1])]), R.covariance)


def used(representation, kernel=K, inputs=S, reference=R):
    """An adapted primitive whose cached properties are all set."""
    options = {
        "kernel": kernel,
        "lambda_mean": 1.0,
        "lambda_covariance": 2.0,
        "representation": representation,
    }
    fitted = KMP.fit(inputs, reference, **options)
    adapted = fitted.adapt(inputs[:1] + 0.3, reference[:1], tolerance=0.0)
    for primitive in (fitted, adapted):
        (
            primitive.predict(inputs),
            primitive.predict(inputs[:1]),
            primitive.uncertainty(inputs),
            primitive.jacobian(inputs[0]),
        )
    return adapted


VALUES = [
    used("dense"),
    used("low_rank"),
    used("dense", VELOCITY, S[:, :1], RATED),
    used("low_rank", VELOCITY, S[:, :1], RATED),
    ONE,
    CONSTRAINED,
    ONE.adapt_jacobian(S[:1], [np.eye(2)], deviation=1.0),
    TURNING,
    POSE,
    LOCAL,
    FRAMES[1][0],
    R,
    GaussianMixture.fit(np.hstack([S, S]), components=2, seed=0),
    NEUTRAL,
    IMPROVED,
    LEARNED,
    LEARNED.scores[0],
    K,
    GaussianKernel([1.0, 2.0]),
    PeriodicKernel(1.0, 2.0),
    VELOCITY,
    Matern32(1.0),
    Matern52([1.0, 2.0]),
    0.5 * Matern52(1.0) + K * GaussianKernel([1.0, 2.0]),
    used("dense", Matern52([1.0, 2.0])),
    used("dense", 0.1 * K + Matern32(2.0) * Matern52(1.0)),
    ONE.uncertainty(S),
    ONE.predict_motion(S[0], S[1], S[2]),
    ONE.predict_motion(S[0], S[1], S[2], covariance=False),
    AffineMean(np.eye(2), [1.0, 2.0]),
    KMP.fit(S, R, kernel=K, lambda_mean=1.0, prior_mean=AffineMean(S[:2], S[2])),
    LinearConstraints(S, S, S[:, 0]),
    LinearConstraints(S, S, S[:, 0], S),
    CONSTRAINED.adapt(S[5:6], R[5:6], tolerance=0.01),
    KMP.fit(
        S,
        R,
        kernel=K,
        lambda_mean=1.0,
        prior_mean=AffineMean(S[:2], S[2]),
        representation="low_rank",
    ),
]


def same(a, b):
    """True if two values are the same bit for bit."""
    if isinstance(a, KMP):
        stored = isinstance(b, KMP) and same(named_arrays.to_arrays(a), named_arrays.to_arrays(b))
        return stored and same_bits(a, b, a.inputs[:5] + 0.1)
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b) and a.dtype == b.dtype
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[name], b[name]) for name in a)
    if isinstance(a, tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(
            same(getattr(a, n), getattr(b, n))
            for n in (field.name for field in dataclasses.fields(a))
        )
    return a == b


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")
@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_file_returns_same_bits(tmp_path, value):
    """Each value is saved and loaded bit for bit."""
    kmp.save(tmp_path / "value", value, input_unit="m", output_unit="rad")
    stored = kmp.load(tmp_path / "value")
    assert same(value, stored.value)
    assert (stored.input_unit, stored.output_unit) == ("m", "rad")
    if isinstance(value, KMP):
        place = value.inputs[3:4] + 0.05, value.reference[:1]
        assert same(
            stored.primitive.adapt(*place, tolerance=0.01), value.adapt(*place, tolerance=0.01)
        )


def arrays(value):
    """All arrays in a value, however deep."""
    if isinstance(value, np.ndarray):
        return [value]
    parts = value if isinstance(value, tuple) else ()
    if isinstance(value, Immutable):
        parts = vars(value).values()
    return [array for part in parts for array in arrays(part)]


IMMUTABLE = [value for value in VALUES if isinstance(value, Immutable)]


@pytest.mark.parametrize("value", IMMUTABLE, ids=lambda value: type(value).__name__)
def test_arrays_are_read_only_in_every_copy(value):
    """Every array is read-only, also after pickling and copying."""
    for instance in (
        value,
        pickle.loads(pickle.dumps(value)),
        copy.copy(value),
        copy.deepcopy(value),
    ):
        assert [array.shape for array in arrays(instance) if array.flags.writeable] == []


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
def test_pickle_leaves_factors_out(representation):
    """The copy computes them again."""
    primitive = used(representation)
    restored = pickle.loads(pickle.dumps(primitive))
    dropped = {"mean_factor", "covariance_factor"}
    assert dropped & vars(primitive.base.inner.solution).keys()
    assert not dropped & vars(restored.base.inner.solution).keys()
    assert same(
        restored.adapt(S[3:4] + 0.7, R[3:4], tolerance=0.0),
        primitive.adapt(S[3:4] + 0.7, R[3:4], tolerance=0.0),
    )


def test_every_public_type_is_tested():
    """The cases contain all types of the package."""
    types = {value for value in offered().values() if isinstance(value, type)}
    names = {kind.__name__ for kind in types if not issubclass(kind, Warning)}
    tested = {type(value).__name__ for value in VALUES} - {"SumKernel"}
    assert names - {"Stored", "Kernel", "RadialKernel"} == tested


def test_other_values_are_refused(tmp_path):
    """The error names the stored kind; unknown kinds are refused too."""
    kmp.save(tmp_path / "value", R, input_unit="m", output_unit="m")
    with pytest.raises(
        ValueError, match="the stored value: Gaussians given, KMP needed: take `value`"
    ):
        _ = kmp.load(tmp_path / "value").primitive
    arrays = dict(np.load(tmp_path / "value"))
    arrays["kind"] = np.array("Skill")
    arrays["checksum"] = np.array(checksum(arrays))
    np.savez(tmp_path / "other.npz", **arrays)
    with pytest.raises(ValueError, match=r"other\.npz: kind: Skill given, one of KMP, .* needed"):
        kmp.load(tmp_path / "other.npz")
    with pytest.raises(ValueError, match=r"value: ndarray given, one of KMP, .* needed"):
        kmp.save(tmp_path / "value", S, input_unit="m", output_unit="m")
