"""Superposition by priority, and frames that move with the task."""

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
    gaussian_process_reference,
    superposed,
)
from support.shown_skills import off, two_hands


def some(seed, count=6, outputs=2):
    random = np.random.default_rng(seed)
    root = random.normal(size=(count, outputs, outputs))
    return Gaussians(random.normal(size=(count, outputs)), root @ root.swapaxes(1, 2) + 0.1 * np.eye(outputs))


def test_priority_one_is_the_reference_alone_and_its_covariance():
    a, b = some(0), some(1)
    for priorities, one in (([1, 0], a), ([0, 1], b)):
        found = superposed([a, b], priorities)
        np.testing.assert_allclose(found.mean, one.mean, atol=1e-12)
        np.testing.assert_allclose(found.covariance, one.covariance, atol=1e-12)


def test_superposition_is_the_product_of_the_covariances_over_their_priorities():
    a, b, g = some(0), some(1), [0.3, 0.7]
    found = superposed([a, b], g)
    product = Gaussians(a.mean, a.covariance / g[0]).product(Gaussians(b.mean, b.covariance / g[1]))
    np.testing.assert_allclose(found.mean, product.mean, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, product.covariance, rtol=1e-9)


def test_priorities_along_the_inputs_blend_from_one_reference_to_the_other():
    t = np.linspace(0, 1, 50)[:, None]
    flat = np.tile(1e-3 * np.eye(1), (50, 1, 1))
    low, high = Gaussians(np.zeros((50, 1)), flat), Gaussians(np.ones((50, 1)), flat)
    share = 1 / (1 + np.exp(-30 * (t[:, 0] - 0.5)))
    blend = superposed([low, high], np.stack([1 - share, share]))
    skill = KMP.fit(t, blend, kernel=GaussianKernel(30.0), lambda_mean=0.1)
    np.testing.assert_allclose(skill.mean([[0.1], [0.5], [0.9]])[:, 0], [0, 0.5, 1], atol=0.02)


@pytest.mark.parametrize(
    ("priorities", "says"),
    [
        ([0.5, 0.6], "of sum 1.1 given; needed are sums of 1, none below 0"),
        ([-0.5, 1.5], "priorities: from -0.5"),
        ([1.0], r"priorities: shape \(1, 1\) given, \(2, N\) needed"),
        (np.full((2, 3), 0.5), r"priorities: shape \(2, 3\) given, \(2,\) or \(2, 6\) needed"),
    ],
)
def test_priorities_that_are_none_are_refused(priorities, says):
    with pytest.raises(ValueError, match=says):
        superposed([some(0), some(1)], priorities)


def test_references_over_unlike_inputs_are_refused():
    with pytest.raises(ValueError, match=r"references\[1\]: means of shape \(5, 2\) given, \(6, 2\) needed"):
        superposed([some(0), some(1, count=5)], [0.5, 0.5])
    with pytest.raises(ValueError, match="references: none given"):
        superposed([], [])


def test_into_a_frame_and_back_changes_nothing():
    frame = CoordinateFrame([[0.0, -1.0], [1.0, 0.0]], [3.0, 4.0])
    normals = some(0)
    back = frame.placed(frame.localised(normals))
    np.testing.assert_allclose(back.mean, normals.mean, atol=1e-12)
    np.testing.assert_allclose(back.covariance, normals.covariance, atol=1e-12)
    np.testing.assert_allclose(frame.local(normals.mean), frame.localised(normals).mean, atol=1e-12)


def test_a_velocity_is_turned_and_not_moved():
    frame = CoordinateFrame([[0.0, -1.0], [1.0, 0.0]], [3.0, 4.0]).with_velocity()
    placed = frame.placed(Gaussians([[1.0, 0, 1, 0]], [np.eye(4)]))
    np.testing.assert_allclose(placed.mean, [[3.0, 5, 0, 1]])


def reaching(random, start, goal, t):
    bend = np.sin(np.pi * t)[:, None] * (np.array([0.0, 0.3]) + 0.02 * random.normal(size=2))
    return start + (goal - start) * (10 * t**3 - 15 * t**4 + 6 * t**5)[:, None] + bend


def learned(velocity=False):
    random, t = np.random.default_rng(0), np.linspace(0, 1, 60)
    ends = np.array([[0, 0], [1, 0]])
    paths = [reaching(random, *(random.uniform(-0.3, 0.3, size=(2, 2)) + ends), t) for _ in range(6)]
    frames = [CoordinateFrame.start_and_goal(path) for path in paths]
    if velocity:
        frames = [[frame.with_velocity() for frame in one] for one in frames]
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


def test_start_and_goal_frames_carry_the_skill_to_new_places():
    skill, t = learned()
    start, goal = np.array([-0.6, 0.5]), np.array([1.5, -0.6])  # none of them demonstrated
    path = skill.placed([CoordinateFrame.at(start), CoordinateFrame.at(goal)]).mean(t)
    np.testing.assert_allclose(path[0], start, atol=0.02)
    np.testing.assert_allclose(path[-1], goal, atol=0.02)


def test_via_points_of_the_world_are_met_in_frames_elsewhere():
    skill, t = learned()
    desired = Gaussians.of([[0.4, 0.9]], deviation=1e-4)
    placed = skill.placed([CoordinateFrame([[0.0, -1.0], [1.0, 0.0]], [0.1, 0.2]), CoordinateFrame.at([1.5, -0.6])])
    adapted = placed.adapt([[0.5]], desired, tolerance=0.01)
    np.testing.assert_allclose(adapted.mean([[0.5]]), desired.mean, atol=1e-3)
    np.testing.assert_allclose(adapted.mean(t[-1:]), [[1.5, -0.6]], atol=0.03)


def test_turning_the_frames_turns_positions_and_velocities():
    skill, t = learned(velocity=True)
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    straight = skill.predict(t)
    turned = skill.placed([CoordinateFrame(turn, turn @ f.offset[:2]).with_velocity() for f in skill.frames]).predict(t)
    both = np.kron(np.eye(2), turn)
    np.testing.assert_allclose(turned.mean, straight.mean @ both.T, atol=1e-7)
    np.testing.assert_allclose(turned.covariance, both @ straight.covariance @ both.T, atol=1e-7)


def test_frames_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="must have an inverse"):
        CoordinateFrame(np.zeros((2, 2)), np.zeros(2))
    with pytest.raises(ValueError, match="path: no point given, at least 1 needed"):
        CoordinateFrame.start_and_goal(np.empty((0, 2)))
    skill, t = learned()
    with pytest.raises(ValueError, match="frames: 1 given, 2 over 2 outputs needed"):
        skill.placed([CoordinateFrame.at([0.0, 0.0])])
    with pytest.raises(ValueError, match=r"frames: \[1, 2\] given for 2 demonstrations, as many for each needed"):
        LocalKMP.learn(
            [(t, np.zeros((60, 2)))] * 2,
            [[CoordinateFrame.at([0, 0])], [CoordinateFrame.at([0, 0])] * 2],
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
    return np.mean(np.abs(normals.mean - wanted) < 2 * np.sqrt(np.diagonal(normals.covariance, axis1=1, axis2=2)))


def judged(offset):
    """Errors and shares (S, 2) at a demonstration that was left out: the process, the mixture."""
    errors, shares = [], []
    for seed in SEEDS:
        *shown, (hands, tool) = two_hands(seed, offset=offset)
        mixture = GaussianMixture.fit(np.vstack([np.hstack(one) for one in shown]), components=10, seed=seed)
        both = gaussian_process_reference(shown, hands, count=200), mixture.regress(hands)
        errors.append([off(one.mean, tool) for one in both])
        shares.append([within(one, tool) for one in both])
    return np.array(errors), np.array(shares)


def test_two_hands_in_space_are_followed_better_than_by_a_mixture_and_it_is_known_how_well():
    errors, shares = judged(offset=0.0)
    assert (errors[:, 0] < 0.02).all()
    assert (errors[:, 0] < 0.15 * errors[:, 1]).all()
    assert 0.8 < shares[:, 0].mean() <= 1
    assert shares[:, 1].mean() < 0.4


def test_demonstrations_that_are_off_as_a_whole_are_known_to_be():
    errors, shares = judged(offset=0.15)
    assert np.exp(np.mean(np.log(errors[:, 0] / errors[:, 1]))) < 0.65
    assert 0.8 < shares[:, 0].mean() <= 1
    assert shares[:, 1].mean() < 0.4


def test_a_primitive_of_it_keeps_what_it_found():
    *shown, (hands, tool) = two_hands(0)
    at = np.vstack([hands[::2] for hands, _ in shown])
    reference = gaussian_process_reference(shown, at, count=200)
    skill = KMP.fit(at, reference, kernel=GaussianKernel(0.3), lambda_mean=0.1, prior_mean=reference.mean.mean(axis=0))
    assert off(skill.mean(hands), tool) < 0.03


def test_outputs_that_are_off_together_are_correlated():
    random, t = np.random.default_rng(0), np.linspace(0, 1, 50)[:, None]
    shown = []
    for _ in range(6):
        shift = 0.2 * random.normal(size=2)
        shown.append((t, np.sin(3 * t) + [shift[0], shift[0], shift[1]] + 0.02 * random.normal(size=(50, 3))))
    found = gaussian_process_reference(shown, t[::10], count=90)
    deviation = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    correlation = found.covariance / deviation[:, :, None] / deviation[:, None, :]
    assert (correlation[:, 0, 1] > 0.95).all()
    assert (np.abs(correlation[:, 0, 2]) < 0.7).all()
    spread = np.std([path.mean(axis=0) for _, path in shown], axis=0, ddof=1)
    np.testing.assert_allclose(deviation[2], spread, rtol=0.5)


def test_one_demonstration_is_followed_and_an_input_or_output_that_never_changes_is_none_of_its_business():
    t = np.linspace(0, 1, 30)[:, None]
    still = np.hstack([t, np.full_like(t, 0.7)])
    found = gaussian_process_reference([(still, np.hstack([np.sin(5 * t), np.full_like(t, 0.2)]))], still[::3])
    np.testing.assert_allclose(found.mean, np.hstack([np.sin(5 * t), np.full_like(t, 0.2)])[::3], atol=5e-3)
    assert (np.abs(found.covariance) < 1e-2).all()


def test_the_same_demonstrations_give_the_same_reference_in_any_unit():
    shown = [(hands[::5], tool[::5]) for hands, tool in two_hands(1, demonstrations=3)]
    hands = shown[0][0][:5]
    found = gaussian_process_reference(shown, hands, regularization=1e-12)
    again = gaussian_process_reference(shown, hands, regularization=1e-12)
    np.testing.assert_array_equal(found.covariance, again.covariance)
    millimetres = [(1000 * s, 1000 * y) for s, y in shown]
    other = gaussian_process_reference(millimetres, 1000 * hands, regularization=1e-6)
    np.testing.assert_allclose(other.mean / 1e3, found.mean, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(other.covariance / 1e6, found.covariance, rtol=0.05, atol=1e-7)
