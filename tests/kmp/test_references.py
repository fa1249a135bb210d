"""References by superposition, by frames that move with the task, and by Gaussian processes."""

import numpy as np
import pytest

from kmp import (
    KMP,
    CoordinateFrame,
    GaussianKernel,
    GaussianMixture,
    Gaussians,
    LocalKMP,
    VelocityKernel,
    load,
    superposed,
)
from kmp.reference import gaussian_process_reference
from support.shown_skills import off, two_hands


def some(seed):
    random = np.random.default_rng(seed)
    root = random.normal(size=(6, 2, 2))
    return Gaussians(random.normal(size=(6, 2)), root @ root.swapaxes(1, 2) + 0.1 * np.eye(2))


def test_superposition_is_a_product():
    """Superposition is the product of the covariances over their priorities."""
    a = some(0)
    b = some(1)
    g = [0.3, 0.7]
    superposition = superposed([a, b], g)
    product = Gaussians(a.mean, a.covariance / g[0]).product(Gaussians(b.mean, b.covariance / g[1]))
    np.testing.assert_allclose(superposition.mean, product.mean, rtol=1e-9)
    np.testing.assert_allclose(superposition.covariance, product.covariance, rtol=1e-9)


def reaching(random, start, goal, t):
    bend = np.sin(np.pi * t)[:, None] * (np.array([0.0, 0.3]) + 0.02 * random.normal(size=2))
    return start + (goal - start) * (10 * t**3 - 15 * t**4 + 6 * t**5)[:, None] + bend


def learned(velocity=False):
    random = np.random.default_rng(0)
    t = np.linspace(0, 1, 60)
    ends = np.array([[0, 0], [1, 0]])
    paths = [
        reaching(random, *(random.uniform(-0.3, 0.3, size=(2, 2)) + ends), t) for _ in range(6)
    ]
    frames = [CoordinateFrame.start_and_goal(path) for path in paths]
    if velocity:
        frames = [[frame.with_velocity() for frame in pair] for pair in frames]
        paths = [np.hstack([path, np.gradient(path, t, axis=0)]) for path in paths]
    skill = LocalKMP.learn(
        [(t[:, None], path) for path in paths],
        frames,
        t[:, None],
        kernel=VelocityKernel(20.0) if velocity else GaussianKernel(20.0),
        lambda_mean=0.1,
        components=8,
        seed=0,
        regularization=1e-5,
    )
    return skill, t[:, None]


def test_frames_carry_skill_to_new_places():
    """Start and goal frames carry the skill to new places."""
    skill, t = learned()
    # none of these places was demonstrated
    start = np.array([-0.6, 0.5])
    goal = np.array([1.5, -0.6])
    path = skill.placed([CoordinateFrame.at(start), CoordinateFrame.at(goal)]).mean(t)
    np.testing.assert_allclose(path[0], start, atol=0.02)
    np.testing.assert_allclose(path[-1], goal, atol=0.02)


def test_via_points_are_met_in_other_frames():
    """Via-points in world coordinates are met in moved frames."""
    skill, t = learned()
    desired = Gaussians.of([[0.4, 0.9]], deviation=1e-4)
    placed = skill.placed(
        [CoordinateFrame([[0.0, -1.0], [1.0, 0.0]], [0.1, 0.2]), CoordinateFrame.at([1.5, -0.6])]
    )
    adapted = placed.adapt([[0.5]], desired, tolerance=0.01)
    np.testing.assert_allclose(adapted.mean([[0.5]]), desired.mean, atol=1e-3)
    np.testing.assert_allclose(adapted.mean(t[-1:]), [[1.5, -0.6]], atol=0.03)


@pytest.mark.parametrize("deviation", [[0, np.inf], [np.inf, 0.01], [0, 0.01]])
@pytest.mark.parametrize("degrees", [90, 30])
def test_exact_and_free_outputs_in_turned_frame(deviation, degrees):
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[cosine, -sine], [sine, cosine]])
    inner = learned()[0].primitives[0]
    skill = LocalKMP((inner,), (CoordinateFrame(turn, [0.1, 0.2]),))
    before = skill.mean([0.5])[0]
    adapted = skill.adapt([0.5], Gaussians.of(before + 0.1, deviation=deviation), tolerance=0.0)
    moved = adapted.mean([0.5])[0] - before
    for move, spread in zip(moved, deviation, strict=True):
        if spread == 0:
            assert move == pytest.approx(0.1, abs=1e-6)


def test_via_point_of_one_frame_moves_with_it():
    skill, t = learned()
    goal = skill.frames[1]
    near_goal = Gaussians.of(goal.offset[None] + [[-0.2, 0.1]], deviation=1e-4)
    adapted = skill.adapt([0.9], near_goal, frame=1)
    away = np.array([0.3, -0.2])
    moved = adapted.placed([skill.frames[0], CoordinateFrame.at(goal.offset + away)])
    np.testing.assert_allclose(moved.mean([0.9]), near_goal.mean + away, atol=2e-3)
    assert moved.primitives[0] is skill.primitives[0]

    third = KMP.fit(
        t,
        Gaussians.of(0 * t + [[0.5, 0.5]], deviation=1e-3),
        kernel=GaussianKernel(20.0),
        lambda_mean=1.0,
    )
    more = LocalKMP((*skill.primitives, third), (*skill.frames, CoordinateFrame.at([0.0, 0.1])))
    assert len(more.frames) == 3
    np.testing.assert_allclose(more.mean([0.5]), [[0.5, 0.6]], atol=0.05)


def test_motion_of_frames_is_the_derivative_of_their_mean():
    skill, _ = learned()
    h = 3e-4
    motion = skill.predict_motion(0.43, 1.5, -2.0)
    before, now, after = (skill.mean([0.43 + 1.5 * d - d * d])[0] for d in (-h, 0.0, h))
    np.testing.assert_allclose(motion.mean, now, atol=1e-12)
    np.testing.assert_allclose(motion.velocity, (after - before) / (2 * h), rtol=1e-4)
    np.testing.assert_allclose(motion.acceleration, (after - 2 * now + before) / h**2, rtol=1e-3)
    np.testing.assert_allclose(1.5 * skill.jacobian(0.43)[:, 0], motion.velocity, rtol=1e-7)


@pytest.mark.parametrize("ells", [(0.1, 2000.0), (2000.0, 0.1)])
def test_motion_of_frames_with_unequal_kernels(ells):
    """The step of differences suits the shortest length."""
    t = np.linspace(0, 1, 60)[:, None]
    reference = Gaussians.of(np.hstack([np.sin(9 * t), np.cos(5 * t)]), deviation=0.1)
    parts = [KMP.fit(t, reference, kernel=GaussianKernel(ell), lambda_mean=1.0) for ell in ells]
    skill = LocalKMP(tuple(parts), (CoordinateFrame.at([0, 0]), CoordinateFrame.at([0.1, 0])))
    steps = 2e-4 * np.array([-4, -3, -2, -1, 1, 2, 3, 4])
    weights = np.array([3, -32, 168, -672, 672, -168, 32, -3]) / 0.168
    expected = weights @ skill.mean(0.4 + steps)
    np.testing.assert_allclose(skill.jacobian(0.4)[:, 0], expected, rtol=1e-6)


def test_uncertainty_and_samples_of_frames_are_of_their_product(tmp_path):
    skill, t = learned()
    expected = skill.predict(t[::6])
    causes = skill.uncertainty(t[::6])
    total = causes.variability + causes.distance
    np.testing.assert_allclose(total, expected.covariance, atol=1e-3 * expected.covariance.max())
    drawn = skill.sample(t[::6], 4000, seed=1)
    spread = drawn.std(axis=0)
    deviation = np.sqrt(np.diagonal(expected.covariance, axis1=1, axis2=2))
    # joint normals of all points know more than those of one point
    assert (spread < 1.1 * deviation).all()
    np.testing.assert_allclose(drawn.mean(axis=0), expected.mean, atol=0.5 * deviation.max())
    skill.save(tmp_path / "frames.npz")
    again = load(tmp_path / "frames.npz").value
    np.testing.assert_array_equal(again.mean(t), skill.mean(t))


def test_velocity_is_turned_and_not_moved():
    frame = CoordinateFrame([[0.0, -1.0], [1.0, 0.0]], [3.0, 4.0]).with_velocity()
    placed = frame.placed(Gaussians([[1.0, 0, 1, 0]], [np.eye(4)]))
    np.testing.assert_allclose(placed.mean, [[3.0, 5, 0, 1]])


def test_turned_frames_turn_predictions():
    """Turning the frames turns positions and velocities."""
    skill, t = learned(velocity=True)
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    straight = skill.predict(t)
    turned = skill.placed(
        [CoordinateFrame(turn, turn @ f.offset[:2]).with_velocity() for f in skill.frames]
    ).predict(t)
    block_turn = np.kron(np.eye(2), turn)
    np.testing.assert_allclose(turned.mean, straight.mean @ block_turn.T, atol=1e-7)
    np.testing.assert_allclose(
        turned.covariance, block_turn @ straight.covariance @ block_turn.T, atol=1e-7
    )


def test_frames_that_do_not_fit_are_refused():
    origin = CoordinateFrame.at([0.0, 0.0])
    with pytest.raises(ValueError, match="must have an inverse"):
        CoordinateFrame(np.zeros((2, 2)), np.zeros(2))
    takes = [(np.zeros((9, 1)), np.zeros((9, 2)))] * 2
    t = np.zeros((9, 1))
    with pytest.raises(
        ValueError, match=r"frames: \[1, 2\] given for 2 demonstrations, as many for each needed"
    ):
        LocalKMP.learn(
            takes,
            [[origin], [origin, origin]],
            t,
            kernel=GaussianKernel(1.0),
            lambda_mean=1,
            components=1,
            seed=0,
        )


# --- by Gaussian process regression ---


SEEDS = range(4)


def within(normals, wanted):
    """The share of outputs within two deviations."""
    return np.mean(
        np.abs(normals.mean - wanted)
        < 2 * np.sqrt(np.diagonal(normals.covariance, axis1=1, axis2=2))
    )


def judged(offset):
    """Errors and shares (S, 2) on a left-out demonstration, for the process and the mixture."""
    errors = []
    shares = []
    for seed in SEEDS:
        *takes, (hands, tool) = two_hands(seed, offset=offset)
        mixture = GaussianMixture.fit(
            np.vstack([np.hstack(take) for take in takes]), components=10, seed=seed
        )
        predictions = gaussian_process_reference(takes, hands, count=200), mixture.regress(hands)
        errors.append([off(prediction.mean, tool) for prediction in predictions])
        shares.append([within(prediction, tool) for prediction in predictions])
    return np.array(errors), np.array(shares)


def test_process_knows_common_offsets():
    """The demonstrations are shifted as a whole."""
    errors, shares = judged(offset=0.15)
    assert np.exp(np.mean(np.log(errors[:, 0] / errors[:, 1]))) < 0.65
    assert 0.8 < shares[:, 0].mean() <= 1
    assert shares[:, 1].mean() < 0.4


def test_common_offsets_are_correlated():
    """Common offsets of several outputs are correlated."""
    random = np.random.default_rng(0)
    t = np.linspace(0, 1, 50)[:, None]
    takes = []
    for _ in range(6):
        shift = 0.2 * random.normal(size=2)
        takes.append(
            (t, np.sin(3 * t) + [shift[0], shift[0], shift[1]] + 0.02 * random.normal(size=(50, 3)))
        )
    reference = gaussian_process_reference(takes, t[::10], count=90)
    deviation = np.sqrt(np.diagonal(reference.covariance, axis1=1, axis2=2))
    correlation = reference.covariance / deviation[:, :, None] / deviation[:, None, :]
    assert (correlation[:, 0, 1] > 0.95).all()
    assert (np.abs(correlation[:, 0, 2]) < 0.7).all()
    spread = np.std([path.mean(axis=0) for _, path in takes], axis=0, ddof=1)
    np.testing.assert_allclose(deviation[2], spread, rtol=0.5)


def test_reference_follows_units():
    """The same demonstrations give the same reference in any unit."""
    takes = [(hands[::5], tool[::5]) for hands, tool in two_hands(1, demonstrations=3)]
    hands = takes[0][0][:5]
    reference = gaussian_process_reference(takes, hands, regularization=1e-12)
    repetition = gaussian_process_reference(takes, hands, regularization=1e-12)
    np.testing.assert_array_equal(reference.covariance, repetition.covariance)
    millimetres = [(1000 * s, 1000 * y) for s, y in takes]
    other = gaussian_process_reference(millimetres, 1000 * hands, regularization=1e-6)
    np.testing.assert_allclose(other.mean / 1e3, reference.mean, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(other.covariance / 1e6, reference.covariance, rtol=0.05, atol=1e-7)
