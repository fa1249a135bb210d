"""Drawings of `plot` have exactly the predicted numbers, in new or given axes."""

import sys

import numpy as np
import pytest

from kmp import KMP, GaussianKernel, Gaussians

pytest.importorskip("matplotlib", reason="pip install matplotlib")

from matplotlib import pyplot as plt

T = np.linspace(0, 2, 40)[:, None]
REFERENCE = Gaussians(
    np.hstack([np.sin(T), np.cos(T)]), np.tile([[4e-4, 2e-4], [2e-4, 9e-4]], (40, 1, 1))
)
PLAIN = KMP.fit(T, REFERENCE, kernel=GaussianKernel(4.0), lambda_mean=1.0)
VIA = Gaussians([[0.8, 0.5]], [np.diag([1e-4, 4e-4])])
ADAPTED = PLAIN.adapt([[1.0]], VIA, tolerance=0.03)


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


def drawn(axes, label):
    """The artist with this label in the legend."""
    return next(artist for artist in axes.get_children() if artist.get_label() == label)


def test_plot_over_input():
    """Over its input a primitive is drawn with its deviations and references."""
    axes = PLAIN.plot(input_unit="s", output_unit="m", outputs=["x", "y"])
    assert [panel.get_ylabel() for panel in axes] == ["x [m]", "y [m]"]
    assert axes[1].get_xlabel() == "input [s]"
    queries = np.linspace(0, 2, 200)[:, None]
    prediction = PLAIN.predict(queries)
    for i, panel in enumerate(axes):
        np.testing.assert_array_equal(
            drawn(panel, "mean").get_xydata(), np.hstack([queries, prediction.mean[:, i, None]])
        )
        np.testing.assert_array_equal(
            drawn(panel, "reference").get_xydata(), np.hstack([T, REFERENCE.mean[:, i, None]])
        )
        for times, label in ((1, "1 deviation"), (2, "2 deviations")):
            [path] = drawn(panel, label).get_paths()
            far = times * np.sqrt(prediction.covariance[:, i, i])
            for sign in (-1, 1):
                edge = prediction.mean[:, i] + sign * far
                assert {*edge} <= {*path.vertices[:, 1]}
    texts = [text.get_text() for text in axes[0].get_legend().get_texts()]
    assert texts == ["mean", "2 deviations", "1 deviation", "reference"]


def test_via_points_replace_references():
    """Via-points are drawn with two standard deviations, without the points that they replace."""
    axes = ADAPTED.plot()
    for i, panel in enumerate(axes):
        [bars] = [bars for bars in panel.containers if bars.get_label() == "via-point"]
        points, _, [lines] = bars
        np.testing.assert_array_equal(points.get_xydata(), [[1.0, (0.8, 0.5)[i]]])
        np.testing.assert_allclose(
            lines.get_segments()[0][:, 1], (0.8, 0.5)[i] + np.array([-2, 2]) * (0.01, 0.02)[i]
        )
        assert len(drawn(panel, "reference").get_xdata()) == 39 - (len(T) - len(ADAPTED.inputs))
        assert not (np.abs(drawn(panel, "reference").get_xdata() - 1.0) < 0.02).any()


def test_region_in_a_plane():
    """The region consists of the ellipses of the covariances."""
    [axes] = ADAPTED.plot(T, plane=(1, 0), output_unit="m")
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("output 1 [m]", "output 0 [m]")
    prediction = ADAPTED.predict(T)
    np.testing.assert_array_equal(drawn(axes, "mean").get_xydata(), prediction.mean[:, ::-1])
    np.testing.assert_array_equal(drawn(axes, "via-point").get_xydata(), [[0.5, 0.8]])
    for times, label in ((1, "1 deviation"), (2, "2 deviations")):
        rings = drawn(axes, label).get_path().to_polygons(closed_only=False)
        assert len(rings) == len(T)
        for ring, mean, covariance in zip(
            rings, prediction.mean, prediction.covariance, strict=True
        ):
            offsets = ring[:, ::-1] - mean
            squares = np.einsum("no,op,np->n", offsets, np.linalg.inv(covariance), offsets)
            np.testing.assert_allclose(squares, times**2, rtol=1e-6)
            turned = ring - ring.mean(axis=0)
            assert (
                np.cross(
                    np.pad(turned[:-1], ((0, 0), (0, 1))), np.pad(turned[1:], ((0, 0), (0, 1)))
                )[:, 2].min()
                >= 0
            )
    axes.figure.canvas.draw()
    assert axes.get_aspect() == 1.0


def test_missing_matplotlib_is_named(monkeypatch):
    """The error names the package."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ModuleNotFoundError, match="pip install matplotlib"):
        PLAIN.plot()
