"""Publishes hands that a camera sees: `pip install mediapipe`, fetch its `hand_landmarker.task`,
then `python examples/mediapipe_hands.py hand_landmarker.task`.

Frame `camera`: x to the right in the picture, y down, z away from the camera, in metres.
"""

from __future__ import annotations

import argparse
import contextlib
import time

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.client import client_settings
from service.contract.cdr import encode_pose
from service.contract.messages import PoseStamped

FRAME = "camera"
WRIST, INDEX, MIDDLE, LITTLE = 0, 5, 9, 17  # MediaPipe's numbers of the wrist and of knuckles
Array = NDArray[np.float64]


def hand_pose(shape: Array, picture: Array, focal_px: float, size_px: tuple[int, int], stamp_ns: int) -> PoseStamped:
    """The palm's pose, from a hand's 21 landmarks as a shape in metres about its own centre (21, 3)
    and in the picture (21, 2), 0 to 1 of its width and height.

    The shape, moved by t, is seen in the picture: (x + t_x) / (z + t_z) = u for each landmark,
    which is linear in t.
    """
    width, height = size_px
    u = (picture - 0.5) * np.array([width, height]) / focal_px
    one, none = np.ones(len(u)), np.zeros(len(u))
    left = np.concatenate([np.stack([one, none, -u[:, 0]], 1), np.stack([none, one, -u[:, 1]], 1)])
    right = (u * shape[:, 2:] - shape[:, :2]).T.ravel()
    moved = np.linalg.lstsq(left, right, rcond=None)[0]
    palm = shape[[WRIST, INDEX, LITTLE]].mean(axis=0) + moved
    along, across = shape[MIDDLE] - shape[WRIST], shape[INDEX] - shape[LITTLE]
    turn = Rotation.align_vectors(np.stack([along, across]), np.eye(3)[:2], weights=[1e6, 1.0])[0]
    x, y, z = palm.tolist()
    qx, qy, qz, qw = turn.as_quat().tolist()
    return PoseStamped(stamp_ns, FRAME, (x, y, z), (qx, qy, qz, qw))


def main() -> None:
    """Publishes until Ctrl-C."""
    import cv2
    import mediapipe as mp

    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("model")
    p.add_argument("--camera", type=int, default=0)
    p.add_argument("--focal", type=float, default=900.0, help="length in pixels, by the camera's calibration")
    p.add_argument("--swap", action="store_true", help="left and right: some versions take pictures for mirrored")
    p.add_argument("--connect", action="append", help="of the daemon, of `thirdhand record` or of a router")
    args = p.parse_args()
    client, vision = client_settings(connect=args.connect), mp.tasks.vision
    options = vision.HandLandmarkerOptions(
        mp.tasks.BaseOptions(model_asset_path=args.model), running_mode=vision.RunningMode.VIDEO, num_hands=2
    )
    camera, names = cv2.VideoCapture(args.camera), ("right", "left") if args.swap else ("left", "right")
    seeing = vision.HandLandmarker.create_from_options(options)
    with seeing as landmarker, client.session(timeout_s=None) as session:
        hands = {side: session.declare_publisher(f"{client.cell}/hands/{side}") for side in names}
        while (read := camera.read())[0]:
            stamp_ns, (height, width) = time.time_ns(), read[1].shape[:2]
            image = mp.Image(image_format=mp.ImageFormat.SRGB, data=cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB))
            found = landmarker.detect_for_video(image, stamp_ns // 1_000_000)
            for kinds, *parts in zip(found.handedness, found.hand_landmarks, found.hand_world_landmarks, strict=True):
                picture, shape = (np.array([[one.x, one.y, one.z] for one in part]) for part in parts)
                pose = hand_pose(shape, picture[:, :2], args.focal, (width, height), stamp_ns)
                hands[names[kinds[0].category_name == "Right"]].put(encode_pose(pose))


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
