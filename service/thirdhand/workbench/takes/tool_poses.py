"""Tool poses by forward kinematics, for demonstrations without a tracked tool."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.frame import Vector
from thirdhand.settings.config import Settings

MOST_HZ = 100  # arms publish their joints more often than a demonstration needs poses


def tool_poses(
    settings: Settings, urdf: str, stamps_ns: NDArray[np.int64], joints: Vector
) -> tuple[Vector, NDArray[np.int64]]:
    """Poses of the tool (M, 7), x y z [m] and quaternion x y z w in frame `base`, for joints (N, J)
    [rad] at `stamps_ns` (N,), and the indices (M,) of the used joints, at most MOST_HZ a second.
    """
    lasts_s = float(np.ptp(stamps_ns)) / 1e9 if len(stamps_ns) else 0.0
    step = max(1, int(len(stamps_ns) / lasts_s / MOST_HZ + 0.01)) if lasts_s else 1
    rows = np.arange(0, len(stamps_ns), step)
    arm = ArmStage(settings, urdf)
    poses = [arm.at(q) for q in joints[rows]]
    quaternions = Rotation.from_matrix([pose.rotation for pose in poses]).as_quat()
    return np.hstack([[pose.position for pose in poses], quaternions]), rows
