"""The pose of a palm from its landmarks in one picture.

The palm is rigid, so the picture of five of its points determines its pose, if their distances are
known. The distances are those of an average palm, scaled by the person's hand length. A single
camera measures depth by size alone: with a length that is wrong by 5 %, the position of a hand that
is 0.5 m away is wrong by 2.5 cm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# MediaPipe's numbers of the wrist and of the knuckles
WRIST = 0
INDEX = 5
MIDDLE = 9
RING = 13
LITTLE = 17
PALM = (WRIST, INDEX, MIDDLE, RING, LITTLE)
# An average palm in shares of the hand's length, from the crease of the wrist to the tip of the
# middle finger: x to the middle knuckle, y towards the thumb.
AVERAGE_PALM = np.array(
    [
        [0.0, 0.0, 0.0],
        [0.505, 0.125, 0.0],
        [0.515, 0.0, 0.0],
        [0.475, -0.115, 0.0],
        [0.41, -0.215, 0.0],
    ]
)
# the palm's position is their mean
PALM_CORNERS = [PALM.index(point) for point in (WRIST, INDEX, LITTLE)]
_AHEAD = AVERAGE_PALM[PALM_CORNERS].sum(axis=0) / np.linalg.norm(
    AVERAGE_PALM[PALM_CORNERS].sum(axis=0)
)
# root mean square error of x / z and y / z; with a larger one, the points are not those of a palm
MAX_ERROR = 0.02
NEWTON_STEPS = 10  # Gauss-Newton steps; the last one changes the pose by less than 0.1 mm
MAX_TURN_RAD = 0.3  # largest turn in one step
RANK_SHARE = 1e-3  # directions that the picture hardly determines keep their initial value


class Lens(NamedTuple):
    """A pinhole camera: focal length and size of its picture [pixels]; the optical axis is in the
    middle.
    """

    focal: float
    width: int
    height: int

    @classmethod
    def of_view(cls, view_deg: float, width: int, height: int) -> Lens:
        """The lens with this horizontal angle of view [degrees]."""
        return cls(width / 2 / np.tan(np.radians(view_deg) / 2), width, height)

    def rays(self, points: Array) -> Array:
        """Points (N, 2) of the picture, 0 to 1 of its width and height, as x / z and y / z."""
        return (points - 0.5) * [self.width, self.height] / self.focal


class PalmPose(NamedTuple):
    """A palm in the camera's frame: x to the right in the picture, y down, z away, in metres.

    `position` (3,) is the mean of the wrist and of the knuckles of index and little finger. The
    axes of `orientation` are those of a headset: -z from the wrist to the middle of these two
    knuckles, y out of the back of the hand, x to the right.
    """

    position: Array
    orientation: Rotation


def palm_pose(
    side: str, picture: Array, shape: Array, lens: Lens, hand_length: float
) -> PalmPose | None:
    """The palm of the `left` or `right` hand whose points are seen at `picture` (21, 2), 0 to 1 of
    width and height; None if no palm of this size [m] explains them.

    The points s of the palm, turned by R and moved by t, are seen at u: R and t minimise

        Σ_k |π(R s_k + t) - u_k|²,   π(x, y, z) = (x, y) / z

    by Gauss-Newton steps. `shape` (21, 3), a rough shape of the hand in the camera's axes, gives
    the initial R.
    """
    u = lens.rays(picture[list(PALM)])
    palm = hand_length * (AVERAGE_PALM - AVERAGE_PALM.mean(axis=0))
    roughly = shape[list(PALM)] - shape[list(PALM)].mean(axis=0)
    turn = Rotation.align_vectors(roughly, palm)[0]
    position_m = where_seen(turn.apply(palm), u)
    for _ in range(NEWTON_STEPS):
        turned = turn.apply(palm)
        x, y, z = (turned + position_m).T
        if z.min() < hand_length / 2:
            # a hand this near would not fit into the picture
            return None
        errors = np.stack([x, y], 1) / z[:, None] - u
        none = np.zeros(len(z))
        rows = np.stack([1 / z, none, -x / z**2], 1), np.stack([none, 1 / z, -y / z**2], 1)
        of_point = np.stack(rows, 1)
        jacobian = np.concatenate([of_point @ _crossed(turned), of_point], axis=2)
        step = np.linalg.lstsq(jacobian.reshape(-1, 6), -errors.ravel(), rcond=RANK_SHARE)[0]
        step *= min(1.0, MAX_TURN_RAD / max(float(np.linalg.norm(step[:3])), 1e-9))
        turn = Rotation.from_rotvec(step[:3]) * turn
        position_m = position_m + step[3:]
    if np.sqrt(np.mean(errors**2)) > MAX_ERROR:
        return None
    back = np.array([0.0, 0.0, 1.0 if side == "right" else -1.0])
    axes = np.stack([np.cross(back, -_AHEAD), back, -_AHEAD], axis=1)
    return PalmPose(
        (turn.apply(palm) + position_m)[PALM_CORNERS].mean(axis=0),
        turn * Rotation.from_matrix(axes),
    )


def _crossed(vectors: Array) -> Array:
    """The matrices (N, 3, 3) by which vectors v (N, 3) change with a small turn w: w × v."""
    crossed: Array = -np.cross(vectors[:, None, :], np.eye(3)[None]).transpose(0, 2, 1)
    return crossed


def where_seen(points: Array, u: Array) -> Array:
    """The translation t (3,) for which points (N, 3) are seen at u (N, 2), by linear least squares:
    (x + t_x) - u_x (z + t_z) = 0, and the same in y.
    """
    ones = np.ones(len(u))
    none = np.zeros(len(u))
    left = np.concatenate(
        [np.stack([ones, none, -u[:, 0]], 1), np.stack([none, ones, -u[:, 1]], 1)]
    )
    right = (u * points[:, 2:] - points[:, :2]).T.ravel()
    moved: Array = np.linalg.lstsq(left, right, rcond=None)[0]
    return moved
