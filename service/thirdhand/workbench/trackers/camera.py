"""Hands that a camera of this machine sees, by MediaPipe: `thirdhand hands --camera`.

It needs `pip install 'thirdhand[camera]'`.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thirdhand.client import Tracker
from thirdhand.contract.explain import ExplainedError
from thirdhand.contract.records import SIDES
from thirdhand.workbench.trackers.palm import Array, Lens, PalmPose, palm_pose

CAMERA_FRAME = "camera"  # x to the right in the picture, y down, z away from the camera
REPORT_S = 2.0


class CameraError(ExplainedError, RuntimeError):
    """The camera gives no picture, or MediaPipe is missing; the message has the cause."""


class HandPoints(NamedTuple):
    """MediaPipe's points of a hand: in the picture (21, 2), 0 to 1 of its width and height, and as
    a shape (21, 3) [m] about its own centre, in the camera's axes.
    """

    picture: Array
    shape: Array


class HandCamera(AbstractContextManager["HandCamera"]):
    """Finds both palms in one picture after the other; a context."""

    def __init__(self, model: Path, *, view_deg: float, hand_length: float) -> None:
        """`view_deg`: horizontal angle of view; `hand_length` [m]: from the crease of the wrist to
        the tip of the middle finger. Raises CameraError.
        """
        self._view_deg = view_deg
        self._length = hand_length
        self._last_ms = 0
        self._mediapipe = mediapipe()
        vision = self._mediapipe.tasks.vision
        options = vision.HandLandmarkerOptions(
            self._mediapipe.tasks.BaseOptions(model_asset_path=str(model)),
            running_mode=vision.RunningMode.VIDEO,
            num_hands=2,
        )
        try:
            with _silenced():
                self._landmarker = vision.HandLandmarker.create_from_options(options)
        except (RuntimeError, ValueError) as error:
            raise CameraError(
                f"{model} is no model of hands that MediaPipe loads: {error}"
            ) from None

    def hands(self, picture: Any, at_ms: int) -> dict[str, HandPoints]:
        """The hands by side, in a picture (H, W, 3) in RGB, not mirrored; its time must grow.
        MediaPipe names the sides. If both hands have the same side, the more certain one counts.
        """
        quiet = _silenced() if self._last_ms == 0 else contextlib.nullcontext()
        self._last_ms = max(at_ms, self._last_ms + 1)
        image = self._mediapipe.Image(image_format=self._mediapipe.ImageFormat.SRGB, data=picture)
        with quiet:
            detection = self._landmarker.detect_for_video(image, self._last_ms)
        hands = zip(
            detection.handedness,
            detection.hand_landmarks,
            detection.hand_world_landmarks,
            strict=True,
        )
        hand_points = dict[str, HandPoints]()
        for kinds, *parts in sorted(hands, key=lambda hand: hand[0][0].score, reverse=True):
            points, shape = (
                np.array([[point.x, point.y, point.z] for point in part]) for part in parts
            )
            side = kinds[0].category_name.lower()
            if side in hand_points:
                (side,) = set(SIDES) - {side}
            hand_points.setdefault(side, HandPoints(points[:, :2], shape))
        return hand_points

    def palms(self, picture: Any, at_ms: int) -> dict[str, PalmPose]:
        """The palms by side, in a picture as `hands` takes it."""
        height, width = picture.shape[:2]
        lens = Lens.of_view(self._view_deg, width, height)
        poses = {
            side: palm_pose(side, hand.picture, hand.shape, lens, self._length)
            for side, hand in self.hands(picture, at_ms).items()
        }
        return {side: pose for side, pose in poses.items() if pose is not None}

    def __exit__(self, *_: object) -> None:
        with _silenced():
            self._landmarker.close()


def pictures(source: str) -> Iterator[tuple[int, Any]]:
    """Times of arrival [ns] and pictures (H, W, 3) in RGB of a camera, given by its number, or of a
    video file; ends with the file. Raises CameraError.
    """
    cv2 = _module("cv2")
    device = cv2.VideoCapture()
    try:
        is_open = False
        # OpenCV raises for numbers or names that it cannot use
        with contextlib.suppress(cv2.error, ValueError):
            is_open = device.open(int(source) if source.isdecimal() else source)
        if not is_open:
            raise CameraError(
                f"no camera {source} can be opened; the number of a camera that no program uses "
                "needed, or a video file"
            )
        device.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest picture, not a queued one
        any_read = False
        while (read := device.read())[0]:
            any_read = True
            yield time.time_ns(), cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB)
        if source.isdecimal() or not any_read:
            raise CameraError(f"camera {source} gives no pictures{' any more' * any_read}")
    finally:
        device.release()


def publish(
    tracker: Tracker, camera: HandCamera, source: str, say: Callable[[str], object]
) -> None:
    """Publish the hands of each picture of a source, until it ends; every 2 s, print which hands
    are seen. Raises CameraError.
    """
    count = 0
    since = time.monotonic()
    last = dict[str, PalmPose]()
    for stamp_ns, picture in pictures(source):
        palms = camera.palms(picture, stamp_ns // 1_000_000)
        for side, pose in palms.items():
            x, y, z = pose.position.tolist()
            qx, qy, qz, qw = pose.orientation.as_quat().tolist()
            tracker.publish(
                side, (x, y, z), (qx, qy, qz, qw), stamp_ns=stamp_ns, frame_id=CAMERA_FRAME
            )
        count = count + 1
        last = last | palms
        if (passed_s := time.monotonic() - since) > REPORT_S:
            summary = ", ".join(
                f"{side} {last[side].position[2]:.2f} m away"
                if side in last
                else f"{side} not seen"
                for side in SIDES
            )
            say(f"{summary}; {count / passed_s:.0f} pictures a second")
            count = 0
            since = time.monotonic()
            last = {}


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """A context in which MediaPipe's libraries cannot write their notes on standard error."""
    stderr_copy = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(stderr_copy, 2)
        os.close(stderr_copy)
        os.close(nowhere)


def mediapipe() -> Any:
    """The package MediaPipe. Raises CameraError."""
    return _module("mediapipe")


def _module(name: str) -> Any:
    with contextlib.suppress(ImportError):
        return importlib.import_module(name)
    raise CameraError("MediaPipe is not installed: pip install 'thirdhand[camera]'")
