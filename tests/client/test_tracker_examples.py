"""The examples of trackers: what their conversions make of synthetic hands and rigid bodies."""

from __future__ import annotations

import importlib.util
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.contract import cdr
from service.contract.messages import PoseStamped
from support.paths import ROOT


def example(name: str) -> ModuleType:
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("seed", range(4))
def test_a_hand_in_a_picture_is_where_it_was_seen(seed: int) -> None:
    """Landmarks of a hand of 18 cm at a known pose, seen by a pinhole camera."""
    mediapipe = example("mediapipe_hands")
    rng = np.random.default_rng(seed)
    hand = rng.uniform(-0.09, 0.09, (21, 3)) * [1.0, 0.6, 0.3]
    turn, at = Rotation.random(rng=rng), np.array([0.1, -0.15, 0.8]) + 0.1 * rng.standard_normal(3)
    shape = turn.apply(hand)
    seen = shape + at
    picture = 900.0 * seen[:, :2] / seen[:, 2:] / [1280, 720] + 0.5
    pose = mediapipe.hand_pose(shape, picture, 900.0, (1280, 720), 5)
    assert (pose.stamp_ns, pose.frame_id) == (5, "camera")
    np.testing.assert_allclose(pose.position, (seen[0] + seen[5] + seen[17]) / 3, atol=1e-9)
    axes = Rotation.from_quat(pose.orientation).as_matrix()
    along = (seen[9] - seen[0]) / np.linalg.norm(seen[9] - seen[0])
    np.testing.assert_allclose(axes[:, 0], along, atol=1e-3)
    assert axes[:, 1] @ (seen[5] - seen[17]) > 0
    assert np.linalg.norm(pose.orientation) == pytest.approx(1.0)
    noisy = mediapipe.hand_pose(shape, picture + 0.001 * rng.standard_normal((21, 2)), 900.0, (1280, 720), 5)
    assert np.abs(np.array(noisy.position) - pose.position).max() < 0.05
    assert cdr.decode_pose(cdr.encode_pose(pose)) == pose


def test_rigid_bodies_that_are_tracked_are_hands() -> None:
    def body(number: int, *, tracked: bool = True) -> SimpleNamespace:
        return SimpleNamespace(id_num=number, pos=(0.1, 1.0, 0.2), rot=(0.0, 0.6, 0.0, 0.8), tracking_valid=tracked)

    keys = {1: "hands/left", 2: "hands/right", None: "tool/pose"}
    found = dict(example("optitrack_hands").poses([body(2), body(1, tracked=False), body(7)], keys, 9))
    assert found == {"hands/right": PoseStamped(9, "optitrack", (0.1, 1.0, 0.2), (0.0, 0.6, 0.0, 0.8))}


@pytest.mark.parametrize("name", ["mediapipe_hands", "optitrack_hands"])
def test_an_example_is_short(name: str) -> None:
    assert len((ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8").splitlines()) < 80
