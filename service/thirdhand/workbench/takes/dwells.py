"""Remarks on the via-points of a take: via-points never reached, and rests far from all of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.division import FAR_M, FOLLOWED_HAND, off_via_point

REST_M = 0.015  # noise and tremor move hands and tool by up to this at rest
DWELL_S = 0.5  # a shorter rest is a pause in a motion
GRID_S = 0.02  # positions are compared at this interval


def remarks_on_via_points(demonstration: Demonstration) -> list[str]:
    """Remarks on via-points that the tool never reached, and on rests far from all via-points."""
    points = demonstration.via_points
    if not points:
        return []
    distances_m = np.array(
        [off_via_point(demonstration, point, FOLLOWED_HAND[point.follow]) for point in points]
    )
    remarks = [
        f"via-point {point.name!r} was never reached: the tool's smallest distance was "
        f"{1000 * least:.0f} mm, {1000 * FAR_M:.0f} mm needed"
        for point, least in zip(points, distances_m.min(axis=1).tolist(), strict=True)
        if least > FAR_M
    ]
    seconds = (demonstration.stamps_ns - demonstration.stamps_ns[0]) / 1e9
    for begin_s, end_s in dwells(demonstration):
        during = (seconds >= begin_s) & (seconds <= end_s)
        near = distances_m[:, during].min(axis=1, initial=np.inf)
        if near.min() > FAR_M:
            remarks.append(
                f"hands and tool rest from {begin_s:.1f} to {end_s:.1f} s, {1000 * near.min():.0f} "
                f"mm from the nearest via-point, {points[int(near.argmin())].name!r}: is a "
                "via-point missing here?"
            )
    return remarks


def dwells(demonstration: Demonstration) -> Iterator[tuple[float, float]]:
    """Begin and end [s] of each rest of both hands and the tool that lasts at least DWELL_S."""
    seconds = (demonstration.stamps_ns - demonstration.stamps_ns[0]) / 1e9
    positions_m = np.hstack([demonstration.hands, demonstration.tool[:, :3]])
    grid = np.arange(0.0, float(seconds[-1]), GRID_S)
    path = np.stack([np.interp(grid, seconds, column) for column in positions_m.T], axis=1)
    for begin in demonstration.begins:
        # motion is unknown where a part is left out
        path[(grid > seconds[begin - 1]) & (grid < seconds[begin])] = np.nan
    count = round(DWELL_S / GRID_S)
    if len(path) <= count:
        return
    windows = np.lib.stride_tricks.sliding_window_view(path, count, axis=0)
    still = np.flatnonzero(np.ptp(windows, axis=2).max(axis=1) <= REST_M)
    for run in np.split(still, np.flatnonzero(np.diff(still) > 1) + 1):
        if len(run):
            yield float(grid[run[0]]), float(grid[run[-1] + count - 1])
