"""What a take tells of the places of its task: those it never reached, and rests at no place."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from service.learning.demonstration import Demonstration
from service.learning.division import FAR_M, FOLLOW, off_via_point

REST_M = 0.015  # [m] motion of hands and tool at rest: trackers are noisy, and hands tremble
DWELL_S = 0.5  # a shorter rest is a pause on the way
GRID_S = 0.02


def remarks_on_places(demonstration: Demonstration) -> list[str]:
    """In words, which told places the tool never came near, and where all rested far from any."""
    points = demonstration.places
    if not points:
        return []
    off = np.array([off_via_point(demonstration, point, FOLLOW[point.follow]) for point in points])
    remarks = [
        f"place {point.name!r} was never reached: the tool came no nearer to it than {1000 * least:.0f} mm "
        f"({1000 * FAR_M:.0f} needed)"
        for point, least in zip(points, off.min(axis=1).tolist(), strict=True)
        if least > FAR_M
    ]
    seconds = (demonstration.stamps_ns - demonstration.stamps_ns[0]) / 1e9
    for begin_s, end_s in dwells(demonstration):
        during = (seconds >= begin_s) & (seconds <= end_s)
        near = off[:, during].min(axis=1, initial=np.inf)
        if near.min() > FAR_M:
            remarks.append(
                f"hands and tool rest from {begin_s:.1f} to {end_s:.1f} s, {1000 * near.min():.0f} mm from the nearest "
                f"place, {points[int(near.argmin())].name!r}: is this a place that is not named?"
            )
    return remarks


def dwells(demonstration: Demonstration) -> Iterator[tuple[float, float]]:
    """From when to when [s] both hands and the tool rest for DWELL_S at least."""
    seconds = (demonstration.stamps_ns - demonstration.stamps_ns[0]) / 1e9
    at = np.hstack([demonstration.hands, demonstration.tool[:, :3]])
    grid = np.arange(0.0, float(seconds[-1]), GRID_S)
    path = np.stack([np.interp(grid, seconds, column) for column in at.T], axis=1)
    for begin in demonstration.begins:
        path[(grid > seconds[begin - 1]) & (grid < seconds[begin])] = np.nan  # nothing is known of what is left out
    count = round(DWELL_S / GRID_S)
    if len(path) <= count:
        return
    windows = np.lib.stride_tricks.sliding_window_view(path, count, axis=0)
    still = np.flatnonzero(np.ptp(windows, axis=2).max(axis=1) <= REST_M)
    for run in np.split(still, np.flatnonzero(np.diff(still) > 1) + 1):
        if len(run):
            yield float(grid[run[0]]), float(grid[run[-1] + count - 1])
