"""Orientation: tangent space against SciPy, signs, angular velocity, via-points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kmp import (
    KMP,
    GaussianKernel,
    Gaussians,
    OrientationKMP,
    PoseKMP,
    VelocityKernel,
    load,
    orientation,
)

properties = settings(max_examples=20, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)


def drawn(seed, count=5):
    return Rotation.random(count, random_state=seed).as_quat()


def same(a, b, atol=1e-9):
    np.testing.assert_allclose(np.abs((a * b).sum(axis=-1)), 1, atol=atol)


@properties
@given(seeds)
def test_log_is_half_the_rotation_vector(seed):
    """Exp undoes log and log is half the rotation vector."""
    q = drawn(seed % 2**31)
    a = drawn((seed + 1) % 2**31, 1)[0]
    zeta = orientation.log(q, a)
    np.testing.assert_allclose(orientation.exp(zeta, a), q, atol=1e-12)
    angle = 2 * np.linalg.norm(zeta, axis=1)
    turn = (Rotation.from_quat(q) * Rotation.from_quat(a).inv()).magnitude()
    np.testing.assert_allclose(np.minimum(angle, 2 * np.pi - angle), turn, atol=1e-7)


@pytest.mark.parametrize("angle", [0, 1e-12, 1e-8, 1e-5, 1e-4, 2e-4, 1.0])
def test_small_angles_lose_no_digits(angle):
    zeta = np.array([[angle, 0, 0]])
    recovered = orientation.log(orientation.exp(zeta, np.array([0, 0, 0, 1.0])), [0, 0, 0, 1])
    np.testing.assert_allclose(recovered, zeta, rtol=1e-9, atol=1e-300)


@properties
@given(seeds, st.sampled_from([1e-7, 1e-3, 1.0]))
def test_rotation_per_zeta_is_the_derivative(seed, size):
    """Rotations per zeta agree with finite differences."""
    random = np.random.default_rng(seed)
    h = 1e-6
    zeta = size * random.normal(size=3)
    change = random.normal(size=3)
    a = np.array([0, 0, 0, 1.0])
    ahead, behind = (
        Rotation.from_quat(orientation.exp((zeta + t * change)[None], a)[0]) for t in (h, -h)
    )
    omega = (ahead * behind.inv()).as_rotvec() / (2 * h)
    np.testing.assert_allclose(
        orientation.rotation_per_zeta(zeta) @ change, omega, rtol=1e-6, atol=1e-7
    )


def test_signs_are_continuous():
    """Signs of quaternions are chosen so that successive ones are near."""
    t = np.linspace(0, 4, 50)
    q = Rotation.from_rotvec(np.outer(t, [0.3, 0.9, 0.1])).as_quat()
    flipped = q * np.random.default_rng(0).choice([-1, 1], size=(50, 1))
    aligned = orientation.continuous(flipped)
    assert ((aligned[1:] * aligned[:-1]).sum(axis=1) > 0.9).all()
    same(aligned, q)
    assert (
        np.linalg.norm(np.diff(orientation.log(aligned, aligned[25]), axis=0), axis=1).max() < 0.1
    )


def path(t):
    turned = np.stack([np.sin(2 * t), t, 0.5 * t**2], axis=1)
    return Rotation.from_rotvec([0.3, 0.2, -0.5]) * Rotation.from_rotvec(turned)


def skill(velocity):
    t = np.linspace(0, 1.5, 120)
    q = orientation.continuous(
        path(t).as_quat() * np.where(np.arange(120) % 3 == 0, -1, 1)[:, None]
    )
    auxiliary = q[60]
    zeta = orientation.log(q, auxiliary)
    mean = np.hstack([zeta, np.gradient(zeta, t, axis=0, edge_order=2)]) if velocity else zeta
    variance = np.diag([1e-4] * 3 + [1e-2] * 3) if velocity else 1e-4 * np.eye(3)
    kernel = VelocityKernel(5.0) if velocity else GaussianKernel(5.0)
    reference = Gaussians(mean, np.tile(variance, (120, 1, 1)))
    return OrientationKMP(KMP.fit(t[:, None], reference, kernel=kernel, lambda_mean=0.1), auxiliary)


@pytest.mark.parametrize("velocity", [False, True])
def test_skill_has_orientation_and_angular_velocity(velocity):
    """A skill reproduces orientations and their angular velocity."""
    primitive = skill(velocity)
    t = np.linspace(0.1, 1.4, 20)
    h = 1e-5
    q = primitive.mean(t[:, None])
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-12)
    same(q, path(t).as_quat(), atol=1e-4)
    for now in t:
        ahead, behind = (Rotation.from_quat(primitive.mean([[now + d]])[0]) for d in (h, -h))
        omega = (ahead * behind.inv()).as_rotvec() / (2 * h)
        moving = primitive.predict_motion(now, 1.0, 0.0)
        np.testing.assert_allclose(moving.velocity, omega, atol=1e-5)
        np.testing.assert_allclose(moving.jacobian[:, 0], omega, atol=1e-5)
        np.testing.assert_allclose(primitive.jacobian(now)[:, 0], omega, atol=1e-5)
        faster = [primitive.predict_motion(now + d, 1.0, 0.0).velocity for d in (-h, h)]
        np.testing.assert_allclose(
            moving.acceleration, (faster[1] - faster[0]) / (2 * h), atol=1e-4
        )


def test_via_points_of_either_sign_are_met():
    """Via-points of orientation are met, whatever the quaternion's sign."""
    primitive = skill(velocity=False)
    desired = (Rotation.from_rotvec([0.3, -0.2, 0.1]) * path(np.array([0.7]))).as_quat()
    for sign in (1, -1):
        adapted = primitive.adapt([[0.7]], sign * desired, 1e-8 * np.eye(3), tolerance=0.02)
        same(adapted.mean([[0.7]]), desired)
    np.testing.assert_allclose(primitive.mean([[0.7]]), skill(velocity=False).mean([[0.7]]))


def test_via_point_is_on_the_present_branch():
    """Beyond half a turn from the auxiliary quaternion, the nearest zeta is used."""
    times = np.linspace(0, 1, 25)[:, None]
    zeta = times * [4.0, 1.0, 0.5]
    inner = KMP.fit(
        times, Gaussians.of(zeta, deviation=0.1), kernel=GaussianKernel(10.0), lambda_mean=1
    )
    winding = OrientationKMP(inner, [0, 0, 0, 1])
    present = inner.mean([0.9])
    assert np.linalg.norm(present) > np.pi
    for sign in (1, -1):
        adapted = winding.adapt([0.9], sign * winding.mean([0.9]), np.zeros((3, 3)))
        np.testing.assert_allclose(adapted.primitive.mean([0.9]), present, atol=1e-8)


@pytest.mark.parametrize("exact", [1, 2])
def test_a_rotation_is_exact_about_all_axes(exact):
    primitive = skill(velocity=False)
    covariance = np.diag([0.0] * exact + [1e-2] * (3 - exact))
    with pytest.raises(ValueError, match=rf"covariance\[0\] is 0 for {exact} of the 3 axes"):
        primitive.adapt([0.5], primitive.mean([0.5]), covariance)


def test_least_variance_is_that_of_each_output():
    """Large positions do not limit how certain a rotation may be."""
    times = np.linspace(0, 1, 20)[:, None]
    sizes = np.array([1e3] * 3 + [0.3] * 3)
    reference = Gaussians.of(sizes * np.sin(3 * times + np.arange(6)), deviation=1e-3 * sizes)
    inner = KMP.fit(
        times, reference, kernel=GaussianKernel(5.0), lambda_mean=1, prior_covariance=sizes**2
    )
    pose = PoseKMP(inner, [0, 0, 0, 1])
    adapted = pose.adapt([0.5], pose.mean([0.5]), np.diag([1.0] * 3 + [1e-7] * 3))
    assert (np.diagonal(adapted.predict([0.5])[1][0])[3:] < 1e-5).all()


def test_via_point_may_fix_angular_velocity():
    primitive = skill(velocity=True)
    omega = np.array([[0.5, -0.3, 0.8]])
    desired = (Rotation.from_rotvec([0.1, -0.1, 0.1]) * path(np.array([0.7]))).as_quat()
    free = primitive.adapt([[0.7]], desired, 1e-8 * np.eye(3), tolerance=0.02)
    same(free.mean([[0.7]]), desired)
    fixed = primitive.adapt(
        [[0.7]],
        desired,
        1e-8 * np.eye(3),
        tolerance=0.02,
        velocities=omega,
        velocity_covariance=1e-8 * np.eye(3),
    )
    same(fixed.mean([[0.7]]), desired)
    np.testing.assert_allclose(fixed.predict_motion(0.7, 1.0, 0.0).velocity, omega[0], atol=1e-3)


def test_pose_turns_as_its_orientation_and_is_correlated():
    """Position and orientation of one primitive: a via-point of the position moves the other."""
    turning = skill(velocity=False)
    t = turning.primitive.inputs
    zeta = turning.primitive.reference.mean
    mean = np.hstack([np.sin(t), np.cos(t), t, zeta])
    correlated = 1e-4 * np.eye(6)
    correlated[0, 3] = correlated[3, 0] = 8e-5
    reference = Gaussians(mean, np.tile(correlated, (len(t), 1, 1)))
    pose = PoseKMP(
        KMP.fit(t, reference, kernel=GaussianKernel(5.0), lambda_mean=0.1), turning.auxiliary
    )
    found, covariance = pose.predict([0.7])
    same(found[:, 3:], turning.mean([0.7]), atol=1e-4)
    np.testing.assert_allclose(found[0, :3], [np.sin(0.7), np.cos(0.7), 0.7], atol=1e-3)
    assert covariance.shape == (1, 6, 6)
    assert pose.sample([0.5, 0.7], 3).shape == (3, 2, 7)
    causes = pose.uncertainty([0.7])
    np.testing.assert_allclose(causes.variability + causes.distance, covariance, atol=1e-9)

    desired = np.array(found)
    desired[0, 0] += 0.05
    only_position = np.diag([0.0, 0.0, 0.0, 1e4, 1e4, 1e4])
    moved = pose.adapt([0.7], desired, only_position)
    np.testing.assert_allclose(moved.mean([0.7])[0, :3], desired[0, :3], atol=1e-5)
    step = pose.jacobian(0.7)
    np.testing.assert_allclose(step[:3, 0], [np.cos(0.7), -np.sin(0.7), 1.0], atol=1e-2)


@pytest.mark.parametrize("kind", [OrientationKMP, PoseKMP])
def test_rotating_skill_is_stored(kind, tmp_path):
    size = 3 if kind is OrientationKMP else 6
    t = np.linspace(0.0, 1.0, 20)
    reference = Gaussians.of(0.1 * np.random.default_rng(1).normal(size=(20, size)), deviation=0.01)
    made = kind(KMP.fit(t, reference, kernel=GaussianKernel(4.0), lambda_mean=1.0), [0, 0, 0, 1])
    made.save(tmp_path / "turn.npz")
    again = load(tmp_path / "turn.npz").value
    assert type(again) is kind
    np.testing.assert_array_equal(again.mean(t), made.mean(t))


@properties
@given(seeds, st.floats(1e-6, 3.0))
def test_rate_of_the_rotations_jacobian(seed, size):
    zeta, rate = np.random.default_rng(seed).normal(size=(2, 3))
    zeta *= size / (2 * np.linalg.norm(zeta))
    h = 1e-6
    ahead, behind = (orientation.rotation_per_zeta(zeta + d * rate) for d in (h, -h))
    np.testing.assert_allclose(
        orientation.rotation_rate_per_zeta(zeta, rate), (ahead - behind) / (2 * h), atol=1e-6
    )


def test_covariance_is_of_world_rotations():
    model = skill(velocity=False)
    q, covariance = model.predict([[0.7], [0.9]])
    same(q, model.mean([[0.7], [0.9]]))
    zeta = model.primitive.predict([[0.7], [0.9]])
    draws = np.random.default_rng(0).multivariate_normal(
        zeta.mean[0], 1e-6 * zeta.covariance[0], size=20_000
    )
    turns = (
        Rotation.from_quat(orientation.exp(draws, model.auxiliary)) * Rotation.from_quat(q[0]).inv()
    ).as_rotvec()
    scale = np.abs(covariance[0]).max()
    np.testing.assert_allclose(np.cov(turns.T) / 1e-6, covariance[0], atol=0.03 * scale)


def test_impossible_orientations_are_refused():
    """Impossible requests are refused, with what is possible."""
    model = skill(velocity=False)
    q = drawn(0, 1)
    for call, says in (
        (
            lambda: orientation.log([[0, 0, 0, 2.0]], [0, 0, 0, 1]),
            r"quaternions\[0\] has norm 2, and must have 1",
        ),
        (
            lambda: orientation.log([[0, 0, 0, -1.0]], [0, 0, 0, 1]),
            r"quaternions\[0\] is .* give -q",
        ),
        (
            lambda: model.adapt(
                [[0.5]],
                q,
                np.eye(3),
                tolerance=0,
                velocities=[[0, 0, 0]],
                velocity_covariance=np.eye(3),
            ),
            "the skill has no rates; fit it with a VelocityKernel",
        ),
    ):
        with pytest.raises(ValueError, match=says):
            call()
    flat = KMP.fit(
        [[0.0]], Gaussians([[0.0]], [[[1.0]]]), kernel=GaussianKernel(1.0), lambda_mean=1
    )
    with pytest.raises(ValueError, match="primitive: 1 outputs given, 3 needed"):
        OrientationKMP(flat, [0, 0, 0, 1])
