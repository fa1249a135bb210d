"""References by Gaussian process regression: two hands in space, beside mixture regression."""

import numpy as np

from kmp import KMP, GaussianKernel, GaussianMixture, gaussian_process_reference
from support.shown_skills import off, two_hands

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
