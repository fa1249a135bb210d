"""Division of demonstrations into the segments of their task, each from a via-point to the next.

The segments k(t) are those of least cost (Viterbi 1967):

    Σ_t c(k(t), t) dt / CORRELATED_S + Σ of the costs of changes
    c(k, t) = Σ_i min(d_i² / OFF_M², FARTHEST) / 2 - DIRECTED tanh(u_i / DIRECTION_SPEED_MPS)

with i = left hand, right hand and tool, d_i its distance from its path, and u_i its speed along
it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Records, Vector
from thirdhand.core.skill import TURNS
from thirdhand.core.skill.memory import along as filtered
from thirdhand.core.skill.memory import turn_lag_s
from thirdhand.core.skill.segments import LEFT, MOST_SEGMENTS, NONE, RIGHT
from thirdhand.core.skill.task import Indices, NamedViaPoints, Task
from thirdhand.core.skill.tuning import DIRECTION_SPEED_MPS, WITH_HAND_POWER
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.recognition import all_followed, covered, stillness_of
from thirdhand.skills.skill_file import SkillError

SMOOTHED_S = 0.28  # width of the window that smooths hands and tool
# positions of a hand that are this near to each other in all demonstrations are the same
SAME_VIA_POINT_M = 0.05
OFF_M = 0.06  # unit of the distances d_i
FARTHEST = 25.0  # d_i² / OFF_M² is limited to this value
DIRECTED = 2.0  # gain of moving along the path
CORRELATED_S = 0.2  # samples within this time count as one
NEXT = 2.0  # cost of a change to the next segment
ANOTHER = 12.0  # cost of any other change
LATER = 3.0  # cost of each segment that is left out at the beginning
NEAR = 0.15  # shares that differ by less are near to each other
FAR_M = 0.10  # a via-point is refused if the tool never came nearer than this
# of a sample far from a via-point: a via-point that no sample is near has the mean lever
LEAST_WEIGHT = 1e-6
FOLLOWED_HAND = {"none": NONE, "left": LEFT, "right": RIGHT}


def task_of(demonstrations: Sequence[Demonstration]) -> tuple[Task | None, str]:
    """The task of demonstrations, and why there is none although they name via-points."""
    named = [
        tuple(point.name for point in demonstration.via_points) for demonstration in demonstrations
    ]
    if not any(named):
        return None, ""
    if len(set(map(frozenset, named))) > 1:
        return None, (
            "not all demonstrations name the same via-points, so it is learned where the hands "
            "are, not between them"
        )
    names = Counter(named).most_common(1)[0][0]
    if not 2 <= len(names) <= MOST_SEGMENTS + 1:
        return None, f"{len(names)} named via-points: 2 to {MOST_SEGMENTS + 1} are learned between"
    via_point_hands = np.array(
        [
            [[*p.left, *p.right] for p in ordered(demonstration.via_points, names)]
            for demonstration in demonstrations
        ]
    )
    corners = np.stack(
        [_corners(via_point_hands[:, :, :3]), _corners(via_point_hands[:, :, 3:])], axis=1
    )
    return Task(
        names,
        corners,
        np.array([FOLLOWED_HAND[p.follow] for p in ordered(demonstrations[0].via_points, names)]),
    ), ""


def _corners(at: Vector) -> Indices:
    """The index (N,) of a hand's position at each via-point, for positions (D, N, 3) [m] in D
    demonstrations.
    """
    out: list[int] = []
    for i in range(at.shape[1]):
        alike = [
            out[j]
            for j in range(i)
            if np.linalg.norm(at[:, i] - at[:, j], axis=1).max() <= SAME_VIA_POINT_M
        ]
        out.append(alike[0] if alike else max(out, default=-1) + 1)
    return np.array(out, np.int64)


def ordered(points: Sequence[ViaPoint], names: Sequence[str]) -> Iterator[ViaPoint]:
    """The via-points in the order of these names."""
    by_name = {point.name: point for point in points}
    return (by_name[name] for name in names)


def via_points_never_reached(
    task: Task, demonstrations: Sequence[Demonstration], names: Sequence[str]
) -> list[str]:
    """Warnings about via-points that the tool never came near in some demonstrations.

    Raises SkillError if it came near in none.
    """
    warned = []
    for named, follow in zip(task.names, task.follow.tolist(), strict=True):
        distances_m = [
            float(
                off_via_point(
                    demonstration, next(ordered(demonstration.via_points, (named,))), follow
                ).min()
            )
            for demonstration in demonstrations
        ]
        if min(distances_m) > FAR_M:
            raise SkillError(
                f"via-point {named!r}: the tool never came nearer to it than "
                f"{1000 * min(distances_m):.0f} "
                f"mm ({names[int(np.argmin(distances_m))]}), {1000 * FAR_M:.0f} mm needed: is it "
                "given in "
                "metres, in frame base, where it was in these demonstrations?"
            )
        missed = [
            f"{name} ({1000 * m:.0f} mm)"
            for name, m in zip(names, distances_m, strict=True)
            if m > FAR_M
        ]
        if missed:
            warned.append(
                f"via-point {named!r}: the tool never came near it in {', '.join(missed)}"
            )
    return warned


def off_via_point(demonstration: Demonstration, point: ViaPoint, follow: int) -> Vector:
    """The tool's distances (T,) [m] from a via-point, or from it moved with the hand that the tool
    follows, whichever is smaller.
    """
    offset_m = demonstration.tool[:, :3] - point.tool
    out: Vector = np.linalg.norm(offset_m, axis=1)
    if follow == NONE:
        return out
    hand = demonstration.hands[:, 3 * follow : 3 * follow + 3] - (point.left, point.right)[follow]
    return np.asarray(np.minimum(out, np.linalg.norm(offset_m - hand, axis=1)))


@dataclass(frozen=True, eq=False)
class Divided:
    """A demonstration (T samples), divided into the segments of its task."""

    demonstration: Demonstration
    at: NamedViaPoints
    segments: Records  # (K,) at the via-points of the demonstration
    moving: Vector  # (T, 3, 6) position, velocity and acceleration of the hands
    stillness: Vector  # (T, 2) of each hand, 0 to 1
    labels: Indices  # (T,) numbers of the segments

    @staticmethod
    def of(task: Task, demonstration: Demonstration) -> Divided:
        """The segments of a demonstration."""
        period_s = demonstration.period_s
        window = round(SMOOTHED_S / period_s)
        hands, smooth_tool = (
            demonstration.by_pieces(lambda x: _smoothed(x, window), x)
            for x in (demonstration.hands, demonstration.tool[:, :3])
        )
        velocities, tool_velocities = (
            demonstration.by_pieces(lambda x: np.gradient(x, period_s, axis=0), x)
            for x in (hands, smooth_tool)
        )
        moving = np.stack([hands, velocities, np.zeros_like(hands)], axis=1)
        via_points = NamedViaPoints.of(demonstration.via_points)
        segments = _segments(task, via_points)
        labels = _divided(segments, moving, (smooth_tool, tool_velocities), period_s)
        return Divided(
            demonstration, via_points, segments, moving, stillness_of(velocities, period_s), labels
        )

    @property
    def tool(self) -> Vector:
        """The tool's position (T, 3) [m]."""
        return self.demonstration.tool[:, :3]

    @property
    def period_s(self) -> float:
        """The mean time [s] between samples."""
        return self.demonstration.period_s

    def in_task(self, task: Task) -> Divided:
        """The demonstration in a task with the same segments, but other leading, followed or
        turning hands.
        """
        return replace(self, segments=_segments(task, self.at))

    def turns(self, late_s: float) -> Vector:
        """The entries (T, 18) of the hands' rotation matrices, filtered so that they are `late_s`
        late; (T, 0) if the tool does not turn with the hands.
        """
        if not self.segments["turned"].any():
            return np.empty((len(self.labels), 0))
        return filtered(self.demonstration.turns, self.period_s, turn_lag_s(late_s), TURNS)[:, -1]

    def late(self, late_s: float) -> Encoded:
        """The shares of the segments, for a teacher whose tool is late by `late_s`."""
        steps = round(late_s / self.period_s)
        labels = self.labels
        segments = self.segments
        tool = self.tool
        hands, rested = (
            self.demonstration.by_pieces(lambda x: _delayed(x, steps), x)
            for x in (self.moving[:, 0], self.stillness)
        )
        hands = np.hstack([hands, self.turns(late_s)])
        coverage = covered(hands, rested, labels, segments)
        along = coverage[:, :2]
        distances_m = coverage[:, 2:]
        begins = segments["tool"][labels]
        way_m = segments["tool_way"][labels]
        square = (way_m**2).sum(axis=1)
        goes = square > SAME_VIA_POINT_M**2
        share = np.where(
            goes,
            ((tool - begins) * way_m).sum(axis=1) / np.where(goes, square, 1.0),
            along.min(axis=1),
        )
        outputs = np.column_stack([share.clip(0.0, 1.0), np.zeros_like(tool)])
        encoded = Encoded(**vars(self), hands=hands, along=along, off=distances_m, wanted=outputs)
        outputs[:, 1:] = tool - encoded.tools(np.arange(len(tool)), outputs)
        return encoded


@dataclass(frozen=True, eq=False)
class Encoded(Divided):
    """A divided demonstration in shares of its segments."""

    # (T, 6) [m] positions of the hands, delayed as the tool is; (T, 24) with their turns
    hands: Vector
    along: Vector  # (T, 2) shares of the segment that the hands have covered
    off: Vector  # (T, 2) [m] distances of the hands from their paths
    # (T, OUTPUTS) share of the segment that the tool has covered, and its offset (3,) [m]
    wanted: Vector

    def tools(self, rows: Indices, outputs: Vector) -> Vector:
        """Tool positions (M, 3) [m] for outputs (M, OUTPUTS) of the primitive at rows (M,)."""
        labels = self.labels[rows]
        share = outputs[:, 0]
        out = (
            self.segments["tool"][labels]
            + share[:, None] * self.segments["tool_way"][labels]
            + outputs[:, 1:]
        )
        all_followed(self.hands[rows], share.clip(0.0, 1.0), labels, self.segments, out)
        return np.asarray(out)

    def near(self, corner: tuple[float, float], segments: Sequence[int]) -> NDArray[np.bool_]:
        """Return whether the hands' shares are near these in one of these segments (T,)."""
        left, right = (
            np.abs(share - place) < NEAR for share, place in zip(self.along.T, corner, strict=True)
        )
        return np.asarray(np.isin(self.labels, segments) & left & right)

    def rows(self, shares: Vector) -> Indices:
        """Rows at shares of the path of hands and tool, and a little of the time."""
        steps = np.abs(np.diff(np.column_stack([self.along, self.wanted[:, 0]]), axis=0)).sum(
            axis=1
        )
        path = np.concatenate([[0.0], np.cumsum(steps + 0.05 * self.period_s)])
        rows = np.searchsorted(path, shares * path[-1]).clip(0, len(path) - 1)
        return np.asarray(np.unique(rows), np.int64)


def _segments(task: Task, at: NamedViaPoints) -> Records:
    return task.segments(at, np.full((len(task.names) - 1, 2), OFF_M))


def encode(
    task: Task, shown: Sequence[Divided], late_s: Sequence[float]
) -> tuple[Task, list[Encoded]]:
    """The demonstrations encoded for teachers who are late by `late_s` in each, and the task; if
    the tool turns with the hands there, with the levers that the demonstrations lead to.
    """
    out = [demo.in_task(task).late(s) for demo, s in zip(shown, late_s, strict=True)]
    if task.levers is None:
        return task, out
    task = task._replace(
        levers=np.array([_lever(out, i, side) for i, side in enumerate(task.follow.tolist())])
    )
    return task, [demo.in_task(task).late(s) for demo, s in zip(shown, late_s, strict=True)]


def _lever(shown: Sequence[Encoded], number: int, side: int) -> Vector:
    """The mean position (3,) [m] of the tool in the frame of a hand at the via-point of this
    number; zeros if the tool follows no hand there:

        l = Σ_t w_t R_tᵀ (x_t - h_t) / Σ_t w_t

    with the tool x and the hand's position h and rotation matrix R, delayed as the tool is. With
    the tool's share s, w = sⁿ in the segment that ends at the via-point and (1 - s)ⁿ in the one
    that begins there.
    """
    if side == NONE:
        return np.zeros(3)
    total = np.zeros(3)
    weight = 0.0
    for demo in shown:
        share = demo.wanted[:, 0]
        near = np.where(
            demo.labels == number, 1.0 - share, np.where(demo.labels == number - 1, share, 0.0)
        )
        weights = near**WITH_HAND_POWER + LEAST_WEIGHT
        turned = demo.hands[:, 6 + 9 * side :][:, :9].reshape(-1, 3, 3)
        total += np.einsum(
            "t,tji,tj->i", weights, turned, demo.tool - demo.hands[:, 3 * side : 3 * side + 3]
        )
        weight += float(weights.sum())
    return np.asarray(total / weight)


def _divided(
    segments: Records, moving: Vector, tool: tuple[Vector, Vector], period_s: float
) -> Indices:
    """The segments (T,) of least cost, for the motion (T, 3, 6) of the hands and the positions and
    velocities (T, 3) of the tool.
    """
    count = len(segments)
    cost = np.zeros((len(moving), len(segments)))
    ways = [
        (segments["begins"][:, i], segments["way"][:, i], moving[:, 0], moving[:, 1], 3 * i)
        for i in (0, 1)
    ]
    ways.append((segments["tool"], segments["tool_way"], *tool, 0))
    for begins, way_m, points, velocities, first in ways:
        position_m = points[:, None, first : first + 3]
        velocity = velocities[:, first : first + 3]
        square = (way_m**2).sum(axis=1)
        moves = square > SAME_VIA_POINT_M**2
        along = (((position_m - begins) * way_m).sum(axis=2) / np.where(moves, square, 1.0)).clip(
            0.0, 1.0
        ) * moves
        distance_m2 = ((position_m - begins - along[:, :, None] * way_m) ** 2).sum(axis=2)
        goes = np.where(moves, velocity @ way_m.T / np.sqrt(np.where(moves, square, 1.0)), 0.0)
        goes -= 0.7 * ~moves * np.linalg.norm(velocity, axis=1)[:, None]
        cost += np.minimum(distance_m2 / OFF_M**2, FARTHEST) / 2.0 - DIRECTED * np.tanh(
            goes / DIRECTION_SPEED_MPS
        )
    cost *= period_s / CORRELATED_S
    change = np.where(np.eye(count, k=1) > 0, NEXT, ANOTHER) * (1.0 - np.eye(count))
    total = cost[0] + LATER * np.arange(count)
    back = []
    for row in cost[1:]:
        through = total[:, None] + change
        back.append(through.argmin(axis=0))
        total = through.min(axis=0) + row
    labels = [int(total.argmin())]
    for before in reversed(back):
        labels.append(int(before[labels[-1]]))
    return np.array(labels[::-1], np.int64)


def _delayed(values: Vector, samples: int) -> Vector:
    """The values (T, D) delayed by a number of samples; before the first one they are constant."""
    return values[np.maximum(np.arange(len(values)) - samples, 0)]


def _smoothed(hands: Vector, samples: int) -> Vector:
    window = np.hanning(samples + 2)[1:-1] if samples else np.ones(1)
    before = len(window) // 2
    padded = [np.pad(column, (before, len(window) - 1 - before), mode="edge") for column in hands.T]
    return np.stack(
        [np.convolve(column, window / window.sum(), mode="valid") for column in padded], axis=1
    )
