"""Ways out of postures in which a step-by-step controller is stuck: paths in joint space from the
arm's posture to one that has the tool at its target.

They are planned outside of the control loop, which receives them as events. Goal postures are found
by damped Gauss-Newton steps from many starts; the path is found by two trees that grow toward each
other (RRT-Connect; Kuffner and LaValle, ICRA 2000), and then shortened. The whole path keeps the
joints' position limits, and keeps clear of people as they are now, of things and of the arm itself.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator

import numpy as np

from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.decision import WAY
from thirdhand.core.frame import Vector
from thirdhand.core.geometry import axis_of, quaternion_of, swing, turn_between
from thirdhand.core.kinematics import Kinematics
from thirdhand.core.separation.stage import Separation
from thirdhand.settings.config import Settings

# random starts of the search for postures, and steps from each start
STARTS = 60
ITERATIONS = 120
STEP_RAD = 0.2  # largest change of a joint in one step
# [rad, m] distance from the position limits; at most this share of the range
SLACK = 0.03
SLACK_SHARE = 0.1
# a posture this near to position and orientation is accepted
REACHED_M = 2e-3
REACHED_RAD = 0.1
DAMPING = 1e-5  # [m²] damping of the Gauss-Newton steps
# below this cosine, two directions are opposite and have no single shortest rotation
OPPOSITE = -0.9999
GOALS = 6  # largest number of postures to which a path is planned
WAYS = 3  # planning ends when this number of paths is found
MARGIN_M = 0.02  # clearance required along the path; that of its ends, if one of them has less
SMALL_M = 1e-3  # tolerance of the clearance along a path, so that the path's ends have it
GRAIN_RAD = 0.05  # distance between the postures of a path at which clearance is checked
REACH_RAD = 0.5  # largest extension of a tree in one step
NODES = 1500  # largest number of random postures toward which the trees grow
SHORTCUTS = 150  # attempts to shorten a path


class WayOut:
    """Planner of ways out for the arm of one cell; equal arguments give equal paths."""

    def __init__(self, settings: Settings, urdf: str) -> None:
        self._arm = ArmStage(settings, urdf)
        self._separation = Separation(settings, urdf)
        limits = settings.joints
        lower = np.array(limits.lower)
        upper = np.array(limits.upper)
        slack = np.minimum(SLACK, SLACK_SHARE * (upper - lower))
        self._lower = lower + slack
        self._upper = upper - slack
        self._is_continuous = np.array(limits.every_kind) == "continuous"
        self._home = np.array(settings.arm.posture)
        self._whole = settings.tool.orientation == "full"
        self._lever = float(self._arm.parameters["turn_lever"][0])

    def find(
        self, joints: Vector, position: Vector, orientation: Vector, hands: Vector
    ) -> list[Vector]:
        """Path of at most WAY postures (J,) [rad] from `joints` (J,) to one with the tool at a
        position (3,) [m] in an orientation (4,), past hands (2, 3) [m] at rest; empty if none is
        found.

        If no path reaches the orientation, one that reaches the position alone is taken. Of up to
        WAYS paths, the shortest one is returned.
        """
        random = np.random.default_rng(0)
        here_m = self._separation.clearance(joints, hands)[0]
        limits = self._around(joints)
        ways: list[list[Vector]] = []
        for turned in (True, False):  # without a path to position and orientation, position alone
            for goal in self._postures(
                joints, limits, position, orientation if turned else None, hands, random
            ):
                least = min(here_m, self._separation.clearance(goal, hands)[0], MARGIN_M) - SMALL_M
                path = self._connect(joints, goal, limits, hands, least, random)
                if path:
                    ways.append(self._shortened(path, hands, least, random))
                if len(ways) == WAYS:
                    break
            if ways:
                break
        return min(
            (candidate for candidate in ways if len(candidate) <= WAY), key=_length, default=[]
        )

    def has_posture(
        self, joints: Vector, position: Vector, orientation: Vector, hands: Vector
    ) -> bool:
        """True if the arm has a collision-free posture with the tool at a position (3,) [m], in an
        orientation (4,) or any other one, beside hands (2, 3) [m]. It is looked for from `joints`
        (J,) [rad] on.
        """
        random = np.random.default_rng(0)
        limits = self._around(joints)
        starts = (np.clip(joints, *limits), *self._starts(joints, limits, random))
        return any(
            True
            for turned in (orientation, None)
            for _ in self._free(starts, limits, position, turned, hands)
        )

    def _starts(self, joints: Vector, limits: Vector, random: np.random.Generator) -> list[Vector]:
        """Starts (J,) of the search for postures: the arm's posture in the settings, and STARTS
        random ones.
        """
        drawn = random.uniform(limits[0], limits[1], (STARTS, len(joints)))
        turns = 2.0 * math.pi * np.rint((joints - self._home) / (2.0 * math.pi))
        return [self._home + np.where(self._is_continuous, turns, 0.0), *drawn]

    def _free(
        self,
        starts: Iterable[Vector],
        limits: Vector,
        position: Vector,
        orientation: Vector | None,
        hands: Vector,
    ) -> Iterator[Vector]:
        """Collision-free postures (J,) with the tool at its target, found from these starts."""
        for start in starts:
            q = self._solved(start, limits, position, orientation)
            if q is not None and self._separation.clearance(q, hands)[0] > 0.0:
                yield q

    def _around(self, joints: Vector) -> Vector:
        """Lower and upper limits (2, J) [rad, m] of the search. A continuous joint is searched half
        a turn each way, which covers all its postures.
        """
        lower = np.where(
            self._is_continuous, np.maximum(joints - math.pi, self._lower), self._lower
        )
        upper = np.where(
            self._is_continuous, np.minimum(joints + math.pi, self._upper), self._upper
        )
        return np.array([lower, upper])

    def _postures(
        self,
        joints: Vector,
        limits: Vector,
        position: Vector,
        orientation: Vector | None,
        hands: Vector,
        random: np.random.Generator,
    ) -> list[Vector]:
        """Collision-free postures with the tool at its target, at most GOALS, the nearest one to
        `joints` first. Without an `orientation`, any orientation is accepted.
        """
        starts = self._starts(joints, limits, random)
        postures = list(
            itertools.islice(self._free(starts, limits, position, orientation, hands), 2 * GOALS)
        )
        return sorted(postures, key=lambda q: float(np.abs(q - joints).max()))[:GOALS]

    def _solved(
        self, q: Vector, limits: Vector, position: Vector, orientation: Vector | None
    ) -> Vector | None:
        """Posture (J,) within the limits with the tool at its target, from the start q (J,); None
        if the iteration does not converge.

            step = Jᵀ (J Jᵀ + DAMPING I)⁻¹ e,   q = clip(q + step min(1, STEP_RAD / max |step_j|))

        e is the error of position [m], and that of orientation in the tool's frame, times the arm's
        `turn_lever` [m]; J are the rows of `tasks` for it.
        """
        for _ in range(ITERATIONS):
            kinematics = self._arm.at(q)
            error = position - kinematics.position
            tasks = kinematics.tasks[:3]
            turn = 0.0
            if orientation is not None:
                angles = kinematics.rotation.T @ self._turn(kinematics, orientation)
                turn = float(np.linalg.norm(angles))
                error = np.append(error, self._lever * angles[: len(kinematics.tasks) - 3])
                tasks = kinematics.tasks
            if np.linalg.norm(error[:3]) < REACHED_M and turn < REACHED_RAD:
                return q
            step = tasks.T @ np.linalg.solve(tasks @ tasks.T + DAMPING * np.eye(len(tasks)), error)
            q = np.clip(
                q + step * min(1.0, STEP_RAD / max(float(np.abs(step).max()), 1e-9)), *limits
            )
        return None

    def _turn(self, here: Kinematics, orientation: Vector) -> Vector:
        """Rotation vector (3,) [rad] in frame base from the tool's orientation to the target's. If
        the arm follows only the direction of the tool's z axis, it is the shortest rotation of that
        axis.
        """
        turn = np.empty(3)
        target_axis = np.empty(3)
        if self._whole:
            now = np.empty(4)
            quaternion_of(here.rotation, now)
            turn_between(now, orientation, turn)
            return turn

        axis_of(orientation, target_axis)
        axis = np.ascontiguousarray(here.rotation[:, 2])
        swing(axis, orientation, turn)
        return math.pi * here.rotation[:, 0] if axis @ target_axis < OPPOSITE else turn

    def _is_free(self, a: Vector, b: Vector, hands: Vector, least: float) -> bool:
        """True if all postures on a straight line in joint space, GRAIN_RAD apart, have more than
        the clearance `least` [m].
        """
        count = max(1, int(np.ceil(np.abs(b - a).max() / GRAIN_RAD)))
        return all(
            self._separation.clearance(a + k / count * (b - a), hands)[0] > least
            for k in range(1, count + 1)
        )

    def _connect(
        self,
        start: Vector,
        goal: Vector,
        limits: Vector,
        hands: Vector,
        least: float,
        random: np.random.Generator,
    ) -> list[Vector]:
        """Collision-free path of straight lines from `start` to `goal` (J,); empty if none is
        found.
        """
        if self._is_free(start, goal, hands, least):
            return [start, goal]
        trees = [([start], [-1]), ([goal], [-1])]
        for number in range(NODES):
            grown, parents = trees[number % 2]
            other, other_parents = trees[1 - number % 2]
            drawn = random.uniform(limits[0], limits[1])
            new = self._grow(grown, parents, drawn, hands, least)
            while new is not None:
                met = self._grow(other, other_parents, new, hands, least)
                if met is None:
                    break
                if np.array_equal(met, new):
                    branch = _to_root(grown, parents)
                    tail = _to_root(other, other_parents)[::-1]
                    path = branch[::-1] + tail[::-1][1:] if number % 2 == 0 else tail + branch[1:]
                    return path if np.array_equal(path[0], start) else path[::-1]
        return []

    def _grow(
        self, nodes: list[Vector], parents: list[int], toward: Vector, hands: Vector, least: float
    ) -> Vector | None:
        """Grow a tree toward a posture (J,), by at most REACH_RAD. Returns the new node, which may
        be that posture; None if the line to it is not free.

        `parents` has the index of each node's parent.
        """
        nearest = int(np.argmin(np.abs(np.array(nodes) - toward).max(axis=1)))
        step = toward - nodes[nearest]
        size = float(np.abs(step).max())
        new = toward if size <= REACH_RAD else nodes[nearest] + REACH_RAD / size * step
        if not self._is_free(nodes[nearest], new, hands, least):
            return None
        nodes.append(new)
        parents.append(nearest)
        return new

    def _shortened(
        self, path: list[Vector], hands: Vector, least: float, random: np.random.Generator
    ) -> list[Vector]:
        """Path without the corners that straight lines can bypass, by SHORTCUTS random attempts."""
        for _ in range(SHORTCUTS):
            if len(path) < 3:
                break
            i, j = sorted(random.choice(len(path), 2, replace=False).tolist())
            if j - i > 1 and self._is_free(path[i], path[j], hands, least):
                path = path[: i + 1] + path[j:]
        return path


def _length(path: list[Vector]) -> float:
    """Length of a path [rad]: the sum over its lines of the largest joint difference."""
    return sum(float(np.abs(b - a).max()) for a, b in itertools.pairwise(path))


def _to_root(nodes: list[Vector], parents: list[int]) -> list[Vector]:
    """Postures from the newest node of a tree back to its root."""
    path = []
    index = len(nodes) - 1
    while index >= 0:
        path.append(nodes[index])
        index = parents[index]
    return path
