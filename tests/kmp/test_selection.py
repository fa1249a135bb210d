"""Hyper-parameters by leaving one demonstration out."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import kmp
from kmp import KMP, GaussianKernel, Gaussians, VelocityKernel
from kmp.criteria.likelihood import negative_log_likelihood
from kmp.functionals import Functionals
from kmp.problem.database import Database
from support.shown_skills import driven_by_hands, off, over_time, two_hands


def chosen(demonstrations=None, **options):
    return kmp.learn(
        demonstrations or driven_by_hands(), **{"components": 6, "seed": 0, "count": 60} | options
    )


def unseen_rmse(learned):
    """The error at a demonstration that was not shown."""
    s, xi = driven_by_hands(seed=9, count=1)[0]
    return np.sqrt(((learned.primitive.mean(s) - xi) ** 2).sum(axis=1).mean())


def is_of(score, primitive):
    """True if a score belongs to the parameters of a primitive."""
    return (
        np.array_equal(score.ell, primitive.kernel.ell)
        and score.lambda_mean == primitive.lambda_mean
    )


def test_choice_is_as_good_as_best_tried():
    """The chosen primitive predicts a new demonstration too."""
    learned = chosen()
    best = learned.scores[0]
    assert best.rmse == min(score.rmse for score in learned.scores)
    mine = [score.rmse for score in learned.scores if is_of(score, learned.primitive)]
    assert min(mine) <= 1.03 * best.rmse
    ratio = np.asarray(learned.primitive.kernel.ell) / np.asarray(best.ell)
    np.testing.assert_allclose(ratio, ratio[0])  # all lengths are scaled by one factor
    assert ratio[0] > 1 - 1e-9
    assert best.rmse < 1.1 * learned.regression_rmse
    scored = [score for score in learned.scores if score.negative_log_likelihood is not None]
    likeliest = min(scored, key=lambda one: one.negative_log_likelihood)
    assert likeliest.lambda_covariance == learned.primitive.lambda_covariance
    assert unseen_rmse(learned) < 2 * best.rmse
    lines = learned.report(3).splitlines()
    assert len(lines) == 6
    assert lines[-1].startswith("chosen: GaussianKernel(ell=[")
    assert lines[-1].endswith(
        f"matters up to {learned.reach[0]:.3g} {learned.reach[1]:.3g} from it"
    )


def test_reach_is_where_a_tenth_moves():
    """The reach is how far the mean moves by a tenth."""
    t = np.linspace(0, 2, 100)[:, None]
    primitive = KMP.fit(
        t, Gaussians.of(np.sin(3 * t), deviation=0.02), kernel=GaussianKernel(8.0), lambda_mean=0.1
    )
    [reach] = primitive.via_point_reach([1.0])
    moved = primitive.adapt(
        [[1.0]], Gaussians.of(primitive.mean([[1.0]]) + 1, deviation=0), tolerance=0.0
    )
    along = np.linspace(0, 2, 401)[:, None]
    change = np.abs(moved.mean(along) - primitive.mean(along))[:, 0]
    assert np.abs(along[change > 0.1, 0] - 1).max() == pytest.approx(reach, abs=0.02)
    assert primitive.via_point_reach([1.0], share=0.5)[0] < reach
    shorter = KMP.fit(t, primitive.reference, kernel=GaussianKernel(80.0), lambda_mean=0.1)
    assert shorter.via_point_reach([1.0])[0] < 0.7 * reach


@pytest.mark.parametrize(
    ("criterion", "ells", "ell_within", "lambda_within"),
    [("left-out", 2, 1e-6, 1e-3), ("likelihood", 1, 1e-2, 1e-2)],
)
def test_the_choice_follows_the_units(criterion, ells, ell_within, lambda_within):
    c = 100.0
    choice = chosen(criterion=criterion)
    other = chosen(
        [(c * s, c * xi) for s, xi in driven_by_hands()],
        criterion=criterion,
    )
    before = choice.primitive
    after = other.primitive
    np.testing.assert_allclose(
        c**2 * after.kernel.ell[:ells], before.kernel.ell[:ells], rtol=ell_within
    )
    np.testing.assert_allclose(after.lambda_mean, before.lambda_mean, rtol=lambda_within)
    for large, small in zip(other.scores[:1], choice.scores[:1], strict=True):
        np.testing.assert_allclose(large.rmse, small.rmse, rtol=1e-3)
        np.testing.assert_allclose(other.reach, c * choice.reach, rtol=1e-2)


@pytest.mark.parametrize("criterion", ["left-out", "likelihood"])
def test_unit_of_one_output_does_not_change_another(criterion):
    """The second output x 1000."""
    takes = [(s, np.hstack([xi[:, :1], np.cos(3 * s) + 0.1 * xi[:, 1:2]])) for s, xi in over_time()]
    queries = takes[0][0][::7]
    options = {"components": 6, "count": 60, "criterion": criterion}
    usual = kmp.learn(takes, **options).primitive
    scaled = kmp.learn([(s, xi * [1.0, 1000.0]) for s, xi in takes], **options).primitive
    np.testing.assert_allclose(scaled.kernel.ell, usual.kernel.ell, rtol=1e-6)
    expected = usual.predict(queries)
    found = scaled.predict(queries)
    np.testing.assert_allclose(found.mean, expected.mean * [1.0, 1000.0], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(found.covariance[:, 0, 0], expected.covariance[:, 0, 0], rtol=1e-3)


@pytest.mark.parametrize("criterion", ["left-out", "likelihood"])
@pytest.mark.parametrize("constant", [0.0, 0.1])
def test_constant_output_does_not_change_the_choice(criterion, constant):
    takes = over_time()
    options = {"components": 6, "count": 60, "criterion": criterion}
    usual = kmp.learn(takes, **options).primitive
    wider = [(s, np.hstack([xi, np.full_like(s, constant)])) for s, xi in takes]
    skill = kmp.learn(wider, **options).primitive
    for name in ("kernel", "lambda_mean", "lambda_covariance"):
        assert getattr(skill, name) == getattr(usual, name)
    np.testing.assert_allclose(skill.mean([0.3])[0], [*usual.mean([0.3])[0], constant], atol=1e-8)


@pytest.mark.parametrize("criterion", ["left-out", "likelihood"])
@pytest.mark.parametrize("unit", [1e6, 1e3, 1e-3], ids=["um", "mm", "km"])
def test_units_do_not_change_the_skill(criterion, unit):
    """Predictions and deviations agree to 1e-6 of the amplitude; one second is given."""
    takes = over_time()
    queries = takes[0][0][::7]
    options = {"components": 6, "seed": 0, "count": 60, "criterion": criterion}
    metres = kmp.learn(takes, **options).primitive.predict(queries)
    other = kmp.learn([(s, unit * xi) for s, xi in takes], **options).primitive.predict(queries)
    np.testing.assert_allclose(other.mean / unit, metres.mean, atol=1e-6)
    np.testing.assert_allclose(
        np.sqrt(other.covariance[:, 0, 0]) / unit, np.sqrt(metres.covariance[:, 0, 0]), atol=1e-6
    )


@pytest.mark.parametrize("criterion", ["left-out", "likelihood"])
def test_what_is_given_is_kept(criterion):
    for kernel in (GaussianKernel(3.0), GaussianKernel([3.0, 2.0])):
        assert chosen(kernel=kernel, criterion=criterion).primitive.kernel == kernel
    assert chosen(lambda_mean=0.7, criterion=criterion).primitive.lambda_mean == 0.7
    lambdas = {"lambda_mean": 0.7, "lambda_covariance": 3.0}
    learned = chosen(**lambdas, criterion=criterion).primitive
    assert (learned.lambda_mean, learned.lambda_covariance) == (0.7, 3.0)
    assert chosen(kernel=GaussianKernel(3.0), **lambdas, criterion=criterion).scores == ()


@pytest.mark.parametrize("velocity", [False, True])
def test_reference_over_time_is_even(velocity):
    """Skills over time have their reference evenly spaced."""
    learned = chosen(over_time(velocity), velocity=velocity)
    assert isinstance(learned.primitive.kernel, VelocityKernel if velocity else GaussianKernel)
    np.testing.assert_allclose(learned.primitive.inputs[:, 0], np.linspace(0, 2, 60))
    np.testing.assert_allclose(learned.reach, learned.primitive.via_point_reach([1.0]), rtol=0.2)
    t = np.array([[0.5], [1.5]])
    np.testing.assert_allclose(
        learned.primitive.mean(t)[:, :2], np.hstack([np.sin(3 * t), np.cos(2 * t)]), atol=0.08
    )


def test_impossible_choices_are_refused():
    """Impossible requests are refused, with what is possible."""
    takes = driven_by_hands(count=1)
    says = r"1 demonstration given: at least 2 needed to choose .* Give kernel, lambda_mean"
    with pytest.raises(ValueError, match=says):
        chosen(takes)
    with pytest.raises(ValueError, match="demonstrations: none given"):
        kmp.learn([], components=1, seed=0)
    with pytest.raises(
        ValueError, match=r"demonstrations\[1\] outputs: shape \(80, 3\) given, \(80, 2\) needed"
    ):
        chosen([*takes, (np.zeros((80, 2)), np.zeros((80, 3)))])
    for scale, begin, words in ((1.0, 1.76e18, "subtract"),):
        times = begin + scale * np.linspace(0, 2, 80)[:, None]
        with pytest.raises(ValueError, match=f"the inputs deviate by .*{words}"):
            chosen([(times, outputs) for _, outputs in driven_by_hands(count=3)])
    with pytest.raises(ValueError, match="160 samples given for 1000 components"):
        chosen(driven_by_hands(count=2), components=1000)
    alone = chosen(takes, kernel=GaussianKernel(3.0), lambda_mean=1, lambda_covariance=1)
    assert np.isnan(alone.regression_rmse)


def test_shown_points_where_they_predict_better():
    """With many inputs, demonstrated samples become reference points where they predict better."""
    *takes, (hands, tool) = two_hands(0, demonstrations=6)
    learned = {
        points: chosen(takes, points=points, components=10, count=120)
        for points in ("auto", "shown", "drawn")
    }
    misses = {points: off(choice.primitive.mean(hands), tool) for points, choice in learned.items()}
    assert misses["shown"] < 0.8 * misses["drawn"]
    rmses = {points: choice.scores[0].rmse for points, choice in learned.items()}
    assert rmses["auto"] == min(rmses.values())
    samples = np.concatenate([s for s, _ in takes])
    for points in ("shown", "auto"):
        assert all((samples == s).all(axis=1).any() for s in learned[points].primitive.inputs)
    assert not (samples == learned["drawn"].primitive.inputs[0]).all(axis=1).any()


def test_one_scale_keeps_ratio_of_lengths():
    ell = np.asarray(chosen(scales="one").primitive.kernel.ell)
    variances = np.var(np.concatenate([s for s, _ in driven_by_hands()]), axis=0)
    assert ell[0] * variances[0] == pytest.approx(ell[1] * variances[1], rel=1e-9)


# --- by the marginal likelihood of the reference ---


def database():
    dimensions = 3
    outputs = 2
    random = np.random.default_rng(0)
    inputs = random.uniform(0, 2, (20, dimensions))
    roots = 0.1 * random.normal(size=(20, outputs, outputs)) + 0.2 * np.eye(outputs)
    mean = np.sin(inputs @ random.normal(size=(dimensions, outputs)))
    return Database(Functionals(inputs), Gaussians(mean, roots @ roots.transpose(0, 2, 1)))


def test_likelihood_is_that_of_scipy():
    points = database()
    kernel = GaussianKernel([2.0, 0.3, 5.0])
    value, signal = negative_log_likelihood(points, np.zeros(2), kernel, 0.7)
    total = np.kron(kernel(points.inputs, points.inputs), np.eye(2))
    for n, covariance in enumerate(points.reference.covariance):
        total[2 * n : 2 * n + 2, 2 * n : 2 * n + 2] += 0.7 * covariance
    densities = [
        multivariate_normal(cov=s * total).logpdf(points.reference.mean.ravel())
        for s in (signal, 0.9 * signal)
    ]
    assert value == pytest.approx(-densities[0], rel=1e-9)
    assert densities[1] < densities[0]


def test_likelihood_finds_irrelevant_input():
    """The prediction improves without that input."""
    options = {"components": 16, "seed": 0, "count": 80, "criterion": "likelihood"}
    separate, shared = (
        kmp.learn(driven_by_hands(), scales=scales, **options) for scales in ("each", "one")
    )
    variances = np.var(np.concatenate([s for s, _ in driven_by_hands()]), axis=0)
    relevance, alike = (
        np.asarray(learned.primitive.kernel.ell) * variances for learned in (separate, shared)
    )
    assert relevance[1] < 0.1 * relevance[0]
    assert alike[1] == pytest.approx(alike[0], rel=0.3)
    assert unseen_rmse(separate) < 0.9 * unseen_rmse(shared)


@pytest.mark.parametrize("velocity", [False, True])
def test_one_demonstration_is_enough(velocity):
    takes = over_time(velocity)
    options = {"components": 8, "seed": 0, "count": 60, "velocity": velocity}
    learned = kmp.learn(takes[:1], criterion="likelihood", **options)
    assert isinstance(learned.primitive.kernel, VelocityKernel if velocity else GaussianKernel)
    miss = learned.primitive.mean(takes[0][0]) - takes[0][1]
    assert np.sqrt(np.mean(miss[:, :2] ** 2)) < 0.03
    assert learned.scores == ()
    assert np.isnan(learned.regression_rmse)
