"""Hands of a camera: palms found in a picture, and MediaPipe's model."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thirdhand.workbench.trackers.camera import CameraError, HandCamera, pictures
from thirdhand.workbench.trackers.palm import (
    AVERAGE_PALM,
    PALM,
    PALM_CORNERS,
    Array,
    Lens,
    palm_pose,
)

LENS = Lens(600.0, 640, 480)
LENGTH_M = 0.18
HAS_MEDIAPIPE = importlib.util.find_spec("mediapipe") is not None


def seen(turn: Rotation, centre: Array, length: float = LENGTH_M) -> tuple[Array, Array, Array]:
    """Points in the picture (21, 2), the hand's shape (21, 3), and the palm's true position
    (3,).
    """
    shape = np.zeros((21, 3))
    shape[list(PALM)] = turn.apply(length * AVERAGE_PALM)
    points = shape + centre
    picture = LENS.focal * points[:, :2] / points[:, 2:] / [LENS.width, LENS.height] + 0.5
    return picture, shape, points[list(PALM)][PALM_CORNERS].mean(axis=0)


def drawn(seed: int) -> tuple[Rotation, Array]:
    rng = np.random.default_rng(seed)
    facing = Rotation.from_matrix(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).T)
    return Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)) * facing, rng.uniform(
        [-0.2, -0.1, 0.35], [0.2, 0.1, 0.9]
    )


@pytest.mark.parametrize("seed", range(20))
def test_a_palm_is_where_it_was_seen(seed: int) -> None:
    turn, centre = drawn(seed)
    picture, shape, position = seen(turn, centre)
    rough = Rotation.from_rotvec(np.random.default_rng(seed).uniform(-0.3, 0.3, 3)).apply(shape)
    ahead = (position - centre) / np.linalg.norm(position - centre)
    thumb = turn.apply([0.0, 1.0, 0.0])
    for side, right in (("right", -thumb), ("left", thumb)):
        pose = palm_pose(side, picture, rough, LENS, LENGTH_M)
        assert pose is not None
        np.testing.assert_allclose(pose.position, position, atol=1e-4)
        x, y, z = pose.orientation.as_matrix().T
        np.testing.assert_allclose(z, -ahead, atol=1e-3)
        np.testing.assert_allclose(y, np.cross(z, x), atol=1e-9)
        assert x @ right > 0.99


@pytest.mark.parametrize(
    "spoil",
    [
        lambda picture: np.full_like(picture, 0.5),
        lambda picture: np.random.default_rng(0).random(picture.shape),
    ],
)
def test_points_that_are_no_palm_are_no_hand(spoil: Callable[[Array], Array]) -> None:
    picture, shape, _ = seen(*drawn(2))
    assert palm_pose("left", spoil(picture), shape, LENS, LENGTH_M) is None


@pytest.mark.skipif(
    not HAS_MEDIAPIPE, reason="MediaPipe is not installed: pip install 'thirdhand[camera]'"
)
def test_missing_camera_and_bad_model_are_refused(tmp_path: Path) -> None:
    """The camera is missing, or the file is no model."""
    with pytest.raises(CameraError, match="no camera 63"):
        next(pictures("63"))
    (tmp_path / "model.task").write_bytes(b"nothing")
    with pytest.raises(CameraError, match="no model of hands"):
        HandCamera(tmp_path / "model.task", view_deg=60.0, hand_length=0.18)
