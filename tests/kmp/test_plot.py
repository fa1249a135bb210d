"""What `plot` draws: the predictions' very numbers, in axes of its own or given ones."""

import subprocess
import sys

import numpy as np
import pytest

from kmp import KMP, CoordinateFrame, GaussianKernel, Gaussians, LocalKMP, PeriodicKernel, VelocityKernel
from support.paths import ROOT

pytest.importorskip("matplotlib", reason="pip install 'kmp[plot]'")

from matplotlib import pyplot as plt

T = np.linspace(0, 2, 40)[:, None]
REFERENCE = Gaussians(np.hstack([np.sin(T), np.cos(T)]), np.tile([[4e-4, 2e-4], [2e-4, 9e-4]], (40, 1, 1)))
PLAIN = KMP.fit(T, REFERENCE, kernel=GaussianKernel(4.0), lambda_mean=1.0)
VIA = Gaussians([[0.8, 0.5]], [np.diag([1e-4, 4e-4])])
SLOPE = Gaussians([[0.5, -0.8]], [np.diag([1e-2, 1e-2])])
ADAPTED = PLAIN.adapt([[1.0]], VIA, tolerance=0.03)


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


def drawn(axes, label):
    """What has that label in the legend."""
    return next(one for one in axes.get_children() if one.get_label() == label)


def test_over_its_input_a_primitive_is_drawn_with_its_deviations_and_references():
    axes = PLAIN.plot(input_unit="s", output_unit="m", outputs=["x", "y"])
    assert [one.get_ylabel() for one in axes] == ["x [m]", "y [m]"]
    assert axes[1].get_xlabel() == "input [s]"
    queries = np.linspace(0, 2, 200)[:, None]
    found = PLAIN.predict(queries)
    for i, one in enumerate(axes):
        np.testing.assert_array_equal(drawn(one, "mean").get_xydata(), np.hstack([queries, found.mean[:, i, None]]))
        np.testing.assert_array_equal(drawn(one, "reference").get_xydata(), np.hstack([T, REFERENCE.mean[:, i, None]]))
        for times, label in ((1, "1 deviation"), (2, "2 deviations")):
            [path] = drawn(one, label).get_paths()
            far = times * np.sqrt(found.covariance[:, i, i])
            for sign in (-1, 1):
                edge = found.mean[:, i] + sign * far
                assert {*edge} <= {*path.vertices[:, 1]}
    texts = [text.get_text() for text in axes[0].get_legend().get_texts()]
    assert texts == ["mean", "2 deviations", "1 deviation", "reference"]


def test_via_points_are_drawn_with_two_deviations_and_the_points_that_they_replace_no_more():
    axes = ADAPTED.plot()
    for i, one in enumerate(axes):
        [bars] = [bars for bars in one.containers if bars.get_label() == "via-point"]
        points, _, [lines] = bars
        np.testing.assert_array_equal(points.get_xydata(), [[1.0, (0.8, 0.5)[i]]])
        np.testing.assert_allclose(lines.get_segments()[0][:, 1], (0.8, 0.5)[i] + np.array([-2, 2]) * (0.01, 0.02)[i])
        assert len(drawn(one, "reference").get_xdata()) == 39 - (len(T) - len(ADAPTED.inputs))
        assert not (np.abs(drawn(one, "reference").get_xdata() - 1.0) < 0.02).any()


def test_points_that_are_derivatives_are_left_out():
    resting = PLAIN.adapt([[1.0]], SLOPE, tolerance=0.0, directions=[[1.0]])
    for one in resting.plot():
        assert "via-point" not in one.get_legend_handles_labels()[1]
        assert len(drawn(one, "reference").get_xdata()) == len(T)


def test_in_a_plane_the_region_is_that_of_the_ellipses():
    [axes] = ADAPTED.plot(T, plane=(1, 0), output_unit="m")
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("output 1 [m]", "output 0 [m]")
    found = ADAPTED.predict(T)
    np.testing.assert_array_equal(drawn(axes, "mean").get_xydata(), found.mean[:, ::-1])
    np.testing.assert_array_equal(drawn(axes, "via-point").get_xydata(), [[0.5, 0.8]])
    for times, label in ((1, "1 deviation"), (2, "2 deviations")):
        rings = drawn(axes, label).get_path().to_polygons(closed_only=False)
        assert len(rings) == len(T)
        for ring, mean, covariance in zip(rings, found.mean, found.covariance, strict=True):
            apart = ring[:, ::-1] - mean
            squares = np.einsum("no,op,np->n", apart, np.linalg.inv(covariance), apart)
            np.testing.assert_allclose(squares, times**2, rtol=1e-6)
            turned = ring - ring.mean(axis=0)
            assert (
                np.cross(np.pad(turned[:-1], ((0, 0), (0, 1))), np.pad(turned[1:], ((0, 0), (0, 1))))[:, 2].min() >= 0
            )
    axes.figure.canvas.draw()
    assert axes.get_aspect() == 1.0


def test_two_in_the_same_axes_have_two_colours_and_one_legend():
    figure, axes = plt.subplots(1, 2)
    assert [*PLAIN.plot(axes=axes, output_unit="m")] == [*axes]
    ADAPTED.plot(axes=axes, label="adapted")
    assert axes[0].get_ylabel() == "output 0 [m]"
    assert drawn(axes[0], "mean").get_color() != drawn(axes[0], "adapted").get_color()
    texts = [text.get_text() for text in axes[0].get_legend().get_texts()]
    assert sorted(texts) == sorted({*texts})
    assert {"mean", "adapted", "via-point"} <= {*texts}
    assert plt.get_fignums() == [figure.number]


def test_a_skill_in_frames_is_drawn_where_they_are_now():
    turned, moved = [[0.0, -1.0], [1.0, 0.0]], np.array([3.0, 4.0])
    frames = CoordinateFrame.at([0.0, 0.0]), CoordinateFrame(turned, [0.5, 0.0])
    other = KMP.fit(T, frames[1].localised(REFERENCE), kernel=GaussianKernel(4.0), lambda_mean=1.0)
    taught = LocalKMP((PLAIN, other), frames).adapt([[1.0]], VIA, tolerance=0.03)
    skill = taught.placed([CoordinateFrame(frame.matrix, frame.offset + moved) for frame in frames])
    [axes] = skill.plot(T, plane=(0, 1))
    np.testing.assert_array_equal(drawn(axes, "mean").get_xydata(), skill.mean(T))
    np.testing.assert_allclose(drawn(axes, "via-point").get_xydata(), VIA.mean + moved, atol=1e-12)
    kept = skill.primitives[0].inputs[:-1]
    means = np.hstack([np.sin(kept), np.cos(kept)]) + moved
    np.testing.assert_allclose(drawn(axes, "reference").get_xydata(), np.vstack([means, means]), atol=1e-12)


def test_rates_have_their_unit_a_period_goes_once_round_and_a_path_is_counted():
    rated = Gaussians(np.hstack([np.sin(T), np.cos(T)]), REFERENCE.covariance)
    moving = KMP.fit(T, rated, kernel=VelocityKernel(4.0), lambda_mean=1.0)
    labels = [one.get_ylabel() for one in moving.plot(input_unit="s", output_unit="m")]
    assert labels == ["output 0 [m]", "rate of output 0 [m/s]"]
    circling = KMP.fit(T, REFERENCE, kernel=PeriodicKernel(1.0, 7.0), lambda_mean=1.0)
    assert drawn(circling.plot()[0], "mean").get_xdata()[[0, -1]].tolist() == [0.0, 7.0]
    led = KMP.fit(REFERENCE.mean, REFERENCE, kernel=GaussianKernel(4.0), lambda_mean=1.0)
    axes = led.plot(REFERENCE.mean[:5])
    assert axes[-1].get_xlabel() == "query"
    assert drawn(axes[0], "mean").get_xdata().tolist() == [0, 1, 2, 3, 4]
    assert "reference" not in axes[0].get_legend_handles_labels()[1]


def test_an_output_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="plane is too large, and must be at most 1"):
        PLAIN.plot(plane=(0, 2))
    with pytest.raises(ValueError, match="outputs: 1 names given, 2 needed"):
        PLAIN.plot(outputs=["x"])
    with pytest.raises(ValueError, match="axes: 1 given, 2 needed"):
        PLAIN.plot(axes=[plt.subplots()[1]])


def test_more_inputs_than_one_need_a_path():
    led = KMP.fit(REFERENCE.mean, REFERENCE, kernel=GaussianKernel(4.0), lambda_mean=1.0)
    with pytest.raises(ValueError, match=r"queries: none given, a path \(M, 2\) needed"):
        led.plot()


def test_without_matplotlib_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'kmp\[plot\]'"):
        PLAIN.plot()


def test_who_draws_nothing_loads_no_matplotlib():
    code = "import sys, kmp; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=60, check=False).returncode == 0
