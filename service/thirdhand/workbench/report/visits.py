"""Accuracy at taught via-points: the tool's position while the hands were where one was taught."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Records, Vector
from thirdhand.workbench.report.columns import Columns, runs

# hands visit a via-point if nearer than this, or than its radius, to where it was taught
VISIT_M = 0.03
PAUSE_S = 0.3  # hands that leave for a shorter time have not left
LEAST_VISIT_S = 0.1  # a shorter visit does not count
SETTLED_S = 0.1  # the tool's final distance is averaged over this time at the end of a visit


class Visit(NamedTuple):
    """A time of the hands at a via-point: start since the first tick and duration [s]; the tool's
    least and final distance from where it was taught [m].
    """

    start_s: float
    lasts_s: float
    nearest_m: float
    settled_m: float


class ViaPointVisits(NamedTuple):
    """A via-point: the time in which it was in force [s], the least distance of the hands
    from where it was taught [m], and its visits. Of two hands, the farther one counts; the distance
    is infinite if none was seen.
    """

    name: str
    start_s: float
    end_s: float
    hands_m: float
    visits: tuple[Visit, ...]

    @property
    def best_m(self) -> float | None:
        """The tool's least distance over all visits [m]; None without a visit."""
        return min((visit.nearest_m for visit in self.visits), default=None)


def via_point_visits(columns: Columns) -> list[ViaPointVisits]:
    """Every via-point that was in force at some time, in the order of teaching."""
    ticks = columns.frames["tick"]
    times = columns.times
    point_visits: list[ViaPointVisits] = []
    for point, conductor, begin, end in _taught(columns):
        within = slice(*np.searchsorted(ticks, (begin, end)).tolist())
        frames = columns.frames[within]
        if len(frames):
            in_force_s = times[within]
            nearest, visits = _visits(point, conductor, frames, in_force_s, columns.period_s)
            point_visits.append(
                ViaPointVisits(
                    point.name, float(in_force_s[0]), float(in_force_s[-1]), nearest, tuple(visits)
                )
            )
    return point_visits


def _taught(columns: Columns) -> list[tuple[ViaPoint, int | None, int, float]]:
    """Each via-point, the side of the single leading hand or None, and the first tick at which it
    was in force, and the first at which it was no longer.
    """
    begun: dict[tuple[ViaPoint, int | None], int] = {}
    over: list[tuple[ViaPoint, int | None, int, float]] = []
    for tick, skill in columns.skills:
        in_force = {(point, skill.conductor) for point in skill.via_points}
        over += [(*key, begun.pop(key), tick) for key in list(begun) if key not in in_force]
        for point in skill.via_points:
            begun.setdefault((point, skill.conductor), tick)
    return sorted(
        [*over, *((*key, tick, np.inf) for key, tick in begun.items())], key=lambda one: one[2]
    )


def _visits(
    point: ViaPoint, conductor: int | None, frames: Records, times: Vector, period_s: float
) -> tuple[float, list[Visit]]:
    """The least distance of the hands, and their visits."""
    sides = [0, 1] if conductor is None else [conductor] * 2
    taught = np.array([point.left, point.right])[sides]
    hands = frames["hands"][:, sides]
    is_seen = (frames["hand_ages"][:, sides] >= 0).all(axis=1)
    away = np.where(is_seen, np.linalg.norm(hands - taught, axis=2).max(axis=1), np.inf)
    target_m = np.array(point.tool)
    if point.follow != "none":
        side = ("left", "right").index(point.follow)
        target_m = target_m + hands[:, side] - taught[side]
    error_m = np.linalg.norm(frames["tool"] - target_m, axis=1)
    is_near = _closed(away <= max(VISIT_M, point.radius), round(PAUSE_S / period_s))
    visits = []
    least = round(LEAST_VISIT_S / period_s)
    settled = max(1, round(SETTLED_S / period_s))
    for begin, end in runs(is_near):
        if is_near[begin] and end - begin >= least:
            visits.append(
                Visit(
                    float(times[begin]),
                    (end - begin) * period_s,
                    float(error_m[begin:end].min()),
                    float(error_m[max(begin, end - settled) : end].mean()),
                )
            )
    return float(away.min(initial=np.inf)), visits


def _closed(there: NDArray[np.bool_], longest: int) -> NDArray[np.bool_]:
    """The mask with gaps up to a length filled."""
    filled = there.copy()
    for begin, end in runs(there):
        if not there[begin] and end - begin <= longest and begin > 0 and end < len(there):
            filled[begin:end] = True
    return filled
